"""What a scene needs, decided once."""
