"""Adam's constants, the same on every device (Kingma and Ba, ICLR 2015)."""

BETA_1, BETA_2, EPSILON = 0.9, 0.999, 1e-15
