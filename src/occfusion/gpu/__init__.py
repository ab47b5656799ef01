"""What runs on a GPU besides torch's own kernels."""
