"""The priors made of Stable Diffusion 1.5, ControlNet and SAM-HQ (paper §4.1, §4.2)."""
