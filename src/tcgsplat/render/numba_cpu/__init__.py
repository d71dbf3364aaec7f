"""The CPU backend: explicit 16-wide kernels in numba; see README.md in this folder for the design."""
