"""When the camera is where on its walk: at an even pace, but for one rest in the middle if it is to stand still."""

from dataclasses import dataclass
from typing import Any

import numpy as np

Array = np.ndarray[Any, np.dtype[Any]]

_RAMP = 10
"""Walk frames in which the camera comes to rest, and in which it gets going again; each takes twice as many frames."""


@dataclass(frozen=True)
class Timetable:
    """What moment of the walk each moment of the recording shows.

    While the camera rests, everything does but the sensor's noise: its hand and whoever strolls about. So all frames
    of the walk before it slows and after it has its pace again are the same with the rest and without it.
    """

    walk: int
    """Frames of the walk without its rest."""
    still: int
    """Frames in which the camera stands still."""

    @property
    def _ramp(self) -> int:
        return min(_RAMP, self.walk // 8) if self.still else 0

    @property
    def _slows(self) -> int:
        """The last frame at full pace."""
        return self.walk // 2 - self._ramp

    @property
    def _stands(self) -> int:
        """The first frame that stands still."""
        return self._slows + 2 * self._ramp

    @property
    def added(self) -> int:
        """Frames that the rest adds."""
        return self.still + 2 * self._ramp if self.still else 0

    @property
    def recorded(self) -> int:
        """All frames."""
        return self.walk + self.added

    @property
    def standing(self) -> range:
        """Frames that show the same, from the first one to the last."""
        return range(self._stands, self._stands + self.still + 1) if self.still else range(0)

    def behind(self, moments: Array) -> Array:
        """By how many frames the walk is behind the recording at moments of the recording, frames."""
        if not self.still:
            return np.zeros_like(moments, dtype=float)
        length = 2 * self._ramp
        slowing = np.clip((moments - self._slows) / max(length, 1), 0, 1)
        starting = np.clip((moments - self._stands - self.still) / max(length, 1), 0, 1)
        # Pace falls by a smooth step 3 u^2 - 2 u^3, whose integral is u^3 - u^4 / 2, and rises by one.
        fallen, risen = (length * (u**3 - u**4 / 2) for u in (slowing, 1 - starting))
        return np.asarray(fallen + np.clip(moments - self._stands, 0, self.still) + length / 2 - risen)

    def shown(self) -> Array:
        """For each frame of the recording, the frame of the walk that it is; -1 for those around the rest."""
        frames = np.arange(self.recorded)
        resting = (frames > self._slows) & (frames < self._slows + self.added + 2 * self._ramp) & (self.still > 0)
        return np.where(resting, -1, np.where(frames <= self._slows, frames, frames - self.added))
