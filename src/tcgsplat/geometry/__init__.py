"""Rotations, rigid transforms and the pinhole camera."""
