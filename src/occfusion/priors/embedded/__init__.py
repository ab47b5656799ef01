"""The embedded prior: our own diffusion model of silhouettes, weights in the package."""
