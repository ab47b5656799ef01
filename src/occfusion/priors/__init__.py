"""Diffusion priors: what a whole person looks like when part of one is hidden (paper §4)."""
