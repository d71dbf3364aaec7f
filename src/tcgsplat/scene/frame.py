"""One RGB-D image pair with its time: all that the online system ever sees of the world.

No pose and no ground truth ride here; those belong to `datasets.Sequence` and are read by `evaluation` only.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch

from tcgsplat.geometry.camera import Camera
from tcgsplat.scene.exposure import Exposure
from tcgsplat.tensors import Image, Mask, Plane


@dataclass(frozen=True)
class Frame:
    """An undistorted colour image and the depth image registered to it."""

    index: int
    """Place in the sequence, from 0; dropped and broken frames leave gaps."""
    timestamp: float
    """Seconds, of the colour image."""
    color: Image
    """RGB in [0, 1], float32."""
    depth: Plane
    """Metres along the optical axis, float32; 0 where there is no reading."""
    valid: Mask
    """Pixels that saw the world: false on the border that undistortion leaves empty."""
    camera: Camera
    depth_timestamp: float | None = None
    """Seconds, of the depth image on the clock of the colour image's stamp; None where both are of one instant."""

    @property
    def depth_delay(self) -> float:
        """Seconds from the colour image to the depth image; negative where depth came first."""
        return 0.0 if self.depth_timestamp is None else self.depth_timestamp - self.timestamp

    @property
    def has_depth(self) -> bool:
        """Whether a surface was measured anywhere: a map can begin."""
        return bool((self.valid & (self.depth > 0)).any())

    @property
    def measured(self) -> float:
        """Share of the valid pixels where a surface was measured; 0 if none is valid."""
        valid, depth = self.valid.numpy(force=True), self.depth.numpy(force=True)  # numpy counts five times as fast
        return int(np.count_nonzero(valid & (depth > 0))) / max(int(np.count_nonzero(valid)), 1)

    def with_depth_later(self, seconds: float) -> "Frame":
        """The same frame whose depth image was taken so much later than it says."""
        return replace(self, depth_timestamp=self.timestamp + self.depth_delay + seconds)

    def unexposed(self, exposure: Exposure) -> "Frame":
        """The same frame with its colours as the map keeps them; they may leave [0, 1]."""
        return replace(self, color=exposure.removed(self.color))

    def to(self, device: torch.device) -> "Frame":
        """The same frame on another device; itself if it is there already."""
        if self.color.device == device:
            return self
        return replace(self, color=self.color.to(device), depth=self.depth.to(device), valid=self.valid.to(device))

    def cpu(self) -> "Frame":
        """The same frame where numpy and the CPU's kernels can read it; itself if it is there already."""
        if self.color.is_cpu:
            return self
        return replace(self, color=self.color.cpu(), depth=self.depth.cpu(), valid=self.valid.cpu())
