"""Differentiable rendering of Gaussians: one protocol, an oracle to check against, and the backends that are fast."""
