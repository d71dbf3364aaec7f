"""What loop closure can be told."""

from dataclasses import dataclass

from tcgsplat.errors import ConfigError


@dataclass(frozen=True)
class LoopConfig:
    """Which submaps are compared, and what is believed of a comparison."""

    enabled: bool = True
    """Whether loops are closed at all. [base]"""
    descriptor: str = "vlad"
    """What recognises a place: `vlad`, local features over words that are learnt on the fly, or a model from a file of
    yours: `netvlad:PATH`, `torchscript:PATH`. [ours] (base: NetVLAD)"""
    min_similarity: float = 0.5
    """Quantile of a view's similarity to its own submap that a view of another one must exceed. [base]"""
    min_score: float = 0.2
    """How much more alike than strangers two submaps must look, where 1 is the rule of the base system; see
    `retrieval.candidates`. [ours] (base: 1)"""
    min_interval: int = 1
    """Submaps nearer in the sequence than this one are no loop. [ours]: an odometry edge hangs on one picture, and
    registering the next but one steadies it (base: 2 to 4)"""
    candidates: int = 3
    """Most submaps that one is registered with, the most similar first: bounds the time of a closure. [ours]: a fourth
    takes a quarter more of the whole time and steadies little"""
    preselected: int = 8
    """Viewpoints a side that equation 25 ranks anew. [ours] (paper: 6)"""
    views: int = 4
    """Viewpoints a side that are registered; one takes some ten milliseconds, and errors of views average out. [ours]
    (paper: 2)"""
    min_coverage: float = 0.3
    """Share of a picture that the other submap must cover for its pose there to count: below it, poses on synthetic
    data with a Kinect's noise were off by centimetres. [ours] (base: overlap of centres 0.2)"""
    min_agreement: float = 0.7
    """Share of the depth there that must agree with the other submap. [ours]"""
    min_correlation: float = 0.8
    """Of the colours there with those of the other submap, whatever the exposure. [ours]"""
    lag: int = 30
    """Frames after which a closure comes into use; no later than the next one begins. [ours]"""
    relocalize_after: int = 5
    """Frames in a row that must be lost before the place is looked up, and between two tries. [ours]"""

    def __post_init__(self) -> None:
        for name in ("candidates", "preselected", "views", "relocalize_after"):
            if getattr(self, name) < 1:
                raise ConfigError(f"loop.{name} is {getattr(self, name)!r}; it must be at least 1")
        for name in ("min_interval", "lag"):
            if getattr(self, name) < 0:
                raise ConfigError(f"loop.{name} is {getattr(self, name)!r}; it must be at least 0")
        for name in ("min_score", "min_similarity", "min_coverage", "min_agreement", "min_correlation"):
            if not 0 <= getattr(self, name) <= 1:
                raise ConfigError(f"loop.{name} is {getattr(self, name)!r}; it must be between 0 and 1")
        kind, colon, path = self.descriptor.partition(":")
        if self.descriptor != "vlad" and not (kind in ("netvlad", "torchscript") and colon and path):
            raise ConfigError(f"loop.descriptor is {self.descriptor!r}; give vlad, netvlad:PATH or torchscript:PATH")
