"""ZJU-MoCap: as released, refined, and as HumanNeRF and OccNeRF prepare it."""
