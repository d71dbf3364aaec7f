"""How the map grows and improves: when, where, by which losses, and what each Gaussian's confidence learns from it."""
