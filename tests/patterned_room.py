"""The analytic room with a wallpaper of small random squares: corners everywhere, no two places alike."""

from dataclasses import dataclass

import numpy as np
import torch
from analytic_room import Room
from torch import Tensor

from tcgsplat.geometry.camera import Camera

CAMERA = Camera(fx=228.0, fy=229.0, cx=159.0, cy=120.5, width=320, height=240)
SQUARE = 0.06  # metres


@dataclass(frozen=True)
class PatternedRoom(Room):
    seed: int = 0

    def texture(self, points: Tensor) -> Tensor:
        """One colour for each cube of space that a point may be in."""
        table = torch.from_numpy(np.random.default_rng(self.seed).random((64, 64, 64, 3)))
        x, y, z = ((points / SQUARE + 0.37).floor().long() % 64).unbind(-1)
        return table[x, y, z]
