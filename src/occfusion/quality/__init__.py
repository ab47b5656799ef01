"""How alike pictures are: losses, metrics, SSIM."""
