"""A local Gaussian map in a frame of its own: the only thing that changes hands between the stages.

Loop closure moves one pose, `T_world_map`; everything inside stays in the map frame, so nothing in it is rewritten.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from tcgsplat.confidence.state import ConfidenceConfig, ConfidenceState
from tcgsplat.geometry import se3
from tcgsplat.scene.exposure import UNCHANGED, Exposure
from tcgsplat.scene.frame import Frame
from tcgsplat.scene.gaussians import Gaussians
from tcgsplat.tensors import PerGaussian, PerGaussianFlag, Pose


@dataclass(frozen=True)
class Keyframe:
    """A frame kept for mapping, with its pose in the submap and its exposure beside the submap's."""

    frame: Frame
    T_map_cam: Pose
    exposure: Exposure = UNCHANGED

    @property
    def balanced(self) -> Frame:
        """The frame with its colours as the map keeps them: what mapping compares with."""
        return self.frame.unexposed(self.exposure)

    def to(self, device: torch.device) -> "Keyframe":
        """The same keyframe with its pictures on another device; itself if they are there already."""
        frame = self.frame.to(device)
        return self if frame is self.frame else replace(self, frame=frame)

    def cpu(self) -> "Keyframe":
        """The same keyframe with its pictures in the CPU's memory; itself if they are there already."""
        frame = self.frame.cpu()
        return self if frame is self.frame else replace(self, frame=frame)


@dataclass(frozen=True)
class Submap:
    """Gaussians, their confidence and the keyframes that they were optimised on."""

    index: int
    """Place among the submaps of the run, from 0."""
    T_world_map: Pose
    """Where the map frame stands in the world: the pose of the first camera of the submap."""
    gaussians: Gaussians
    confidence: ConfidenceState
    keyframes: Sequence[Keyframe] = ()
    """In the order of time; perhaps read from disk when asked for."""
    clock: int = 0
    """Mapping updates so far: the paper's t, the time that confidence lives in."""

    @staticmethod
    def anchored(T_world_map: Pose, index: int, sh_degree: int = 0, device: torch.device | None = None) -> "Submap":
        """An empty submap whose frame is the camera at `T_world_map`."""
        return Submap(
            index=index,
            T_world_map=se3.orthonormalized(T_world_map),
            gaussians=Gaussians.empty(sh_degree, device),
            confidence=ConfidenceState.empty(device),
        )

    def __len__(self) -> int:
        return len(self.gaussians)

    @property
    def device(self) -> torch.device:
        """Where its Gaussians are, and the pictures that are drawn of them."""
        return self.gaussians.means.device

    def to(self, device: torch.device) -> "Submap":
        """With its Gaussians and their confidence on another device; keyframes stay where they are, perhaps on disk."""
        if self.device == device:
            return self
        return replace(self, gaussians=self.gaussians.to(device), confidence=self.confidence.to(device))

    def cpu(self) -> "Submap":
        """All of it, keyframes too, in the CPU's memory; itself if its Gaussians are there already."""
        if self.gaussians.means.is_cpu:
            return self
        keyframes = tuple(keyframe.cpu() for keyframe in self.keyframes)
        return replace(self, gaussians=self.gaussians.cpu(), confidence=self.confidence.cpu(), keyframes=keyframes)

    def grown(self, new: Gaussians, config: ConfidenceConfig, expected_error: PerGaussian | None = None) -> "Submap":
        """With new Gaussians appended; their confidence is born at this submap's clock (see `born_at`)."""
        born = ConfidenceState.born_at(
            self.clock, len(new), config, expected_error=expected_error, device=new.means.device
        )
        return replace(self, gaussians=self.gaussians.appended(new), confidence=self.confidence.appended(born))

    def kept(self, keep: PerGaussianFlag) -> "Submap":
        """With only the flagged Gaussians and their confidence."""
        return replace(self, gaussians=self.gaussians.kept(keep), confidence=self.confidence.kept(keep))

    def sealed(self, config: ConfidenceConfig) -> "Submap":
        """The finished submap: confidence calibrated for unequal ages (Eq. 16). Seal once, and keep unchanged."""
        return replace(self, confidence=self.confidence.sealed(config))
