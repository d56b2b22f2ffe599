"""Time and memory of the kernels."""
