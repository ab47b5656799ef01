"""Inpainting what an occluder hides, with the coarse rendering of the same person as context (paper §4.3)."""
