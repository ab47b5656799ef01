"""ZJU-MoCap: as released, refined, and as HumanNeRF and OccNeRF prepare it."""

from occfusion.data.zju.zju_data import ZjuDataModule

__all__ = ["ZjuDataModule"]
