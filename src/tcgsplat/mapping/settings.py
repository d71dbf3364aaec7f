"""What mapping can be told."""

from dataclasses import dataclass, field

from tcgsplat.errors import ConfigError
from tcgsplat.mapping.optimizer import LearningRates
from tcgsplat.mapping.seeding import SeedingConfig
from tcgsplat.render.view import DepthMode


@dataclass(frozen=True)
class MapperConfig:
    """Losses and effort of mapping."""

    seeding: SeedingConfig = field(default_factory=SeedingConfig)
    rates: LearningRates = field(default_factory=LearningRates)
    iterations: int = 10
    """Adam steps a mapping update. [ours] (base: 100)"""
    first_iterations: int = 20
    """Adam steps of a submap's first mapping update. [ours] (base: 100 on TUM, 1000 on Replica)"""
    current_share: float = 0.4
    """Share of the steps that look at the current frame; the others draw evenly from the older keyframes. [base]"""
    color_weight: float = 0.8
    """lambda_c of Eq. 21, on the mean over valid pixels. [base]"""
    depth_weight: float = 1.0
    """lambda_d of Eq. 21, per metre, on the mean over valid pixels. [base]"""
    ssim_weight: float = 0.2
    """lambda_s of Eq. 21. [base]"""
    isotropy_weight: float = 0.0
    """lambda_r of Eq. 21, per metre. [ours]: discs are meant to be flat (base: 1)"""
    depth_mode: DepthMode = "planar"
    """The depth that is compared with the sensor. [ours] (base: composited)"""
    min_opacity: float = 0.1
    """Gaussians that become fainter are dropped. [base: Replica] (base: 0.5 on TUM and ScanNet)"""
    frozen_color_share: float = 0.0
    """Share of the steps, from the first one, that leave colour alone. [ours] (base: 0.5)"""
    max_keyframes: int = 40
    """Keyframes that a submap keeps; redundant ones go first; 0 for all. Bounds memory and the share of old views
    while the camera stays within one submap. [ours] (base: all)"""
    max_gpu_memory: float = 0.0
    """GB of 2^30 bytes that a run may take of a GPU, as far as it can be planned; 0 for all there is. Where pictures of
    keyframes would exceed it, older ones wait in the CPU's memory; where Gaussians of the active submap would, those
    with the least opacity times confidence are dropped, on every backend alike. [ours]"""
    complete: bool = True
    """Whether a finished submap gets guessed Gaussians where its pictures show what the sensor could not measure; see
    `completion`. [ours]"""
    sh_degree: int = 0
    """Degree of the colour's spherical harmonics, 0 to 3. [base]"""

    def __post_init__(self) -> None:
        if not 0 <= self.sh_degree <= 3:
            raise ConfigError(f"mapper.sh_degree is {self.sh_degree!r}; it must be 0, 1, 2 or 3")
        if self.iterations < 1 or self.first_iterations < 1:
            raise ConfigError("mapper.iterations and mapper.first_iterations must be at least 1")
        for name in ("current_share", "min_opacity", "frozen_color_share"):
            if not 0 <= getattr(self, name) <= 1:
                raise ConfigError(f"mapper.{name} is {getattr(self, name)!r}; it must be between 0 and 1")
        weights = ("color_weight", "depth_weight", "ssim_weight", "isotropy_weight")
        for name in (*weights, "max_keyframes", "max_gpu_memory"):
            if not getattr(self, name) >= 0:
                raise ConfigError(f"mapper.{name} is {getattr(self, name)!r}; it must be at least 0")
