"""How a camera's automatic exposure shows the scene in one picture, beside how the map keeps it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from tcgsplat.tensors import Image


@dataclass(frozen=True)
class Exposure:
    """Affine in intensity, the same for all three colours: picture = gain * map + offset.

    A camera with automatic exposure shows the same wall brighter or darker from frame to frame. The map keeps one
    brightness; each picture has its exposure, found by tracking as its pose is.
    """

    gain: float = 1.0
    offset: float = 0.0

    def applied(self, color: Image) -> Image:
        """The map's colours as this picture shows them; nothing is clipped."""
        return color if self == UNCHANGED else color * self.gain + self.offset

    def removed(self, color: Image) -> Image:
        """The picture's colours as the map keeps them; nothing is clipped."""
        return color if self == UNCHANGED else (color - self.offset) * (1.0 / self.gain)

    def relative_to(self, other: "Exposure") -> "Exposure":
        """The same picture's exposure beside a map that is kept as `other` shows it."""
        gain = self.gain / other.gain
        return Exposure(gain, self.offset - gain * other.offset)

    def relaxed(self, share: float) -> "Exposure":
        """A little nearer to no change, by a share of the way."""
        return Exposure(self.gain ** (1.0 - share), self.offset * (1.0 - share))


UNCHANGED = Exposure()


def mean(exposures: Sequence[Exposure]) -> Exposure:
    """The exposure in the middle, geometric in gain; of at least one."""
    n = len(exposures)
    return Exposure(
        math.prod(exposure.gain for exposure in exposures) ** (1.0 / n),
        sum(exposure.offset for exposure in exposures) / n,
    )
