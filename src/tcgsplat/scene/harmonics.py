"""The constant spherical harmonic: a Gaussian's colour is 0.5 + SH_C0 times its first coefficient."""

SH_C0 = 0.28209479177387814
"""1 / (2 sqrt(pi))."""
