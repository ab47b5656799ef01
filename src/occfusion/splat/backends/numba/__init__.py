"""The `numba` backend: everything on the CPU in compiled loops, float32."""
