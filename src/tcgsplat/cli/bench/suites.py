"""What a suite is, and the four that there are: sequences, where their files are expected, presets."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType

from tcgsplat.datasets.synthetic import SynthConfig


@dataclass(frozen=True)
class Source:
    """A sequence of a suite, and where its frames come from."""

    name: str
    """In tables."""
    folders: tuple[str, ...] = ()
    """Where its files may be, below the folder of the data; the first that is there is taken."""
    synth: SynthConfig | None = None
    """How to make it instead."""
    column: str | None = None
    """Its name in the published tables, if it is in them."""

    @property
    def slug(self) -> str:
        """For the name of a folder."""
        return self.name.replace("/", "-")

    def expected(self, data: Path) -> tuple[Path, ...]:
        """Where its files may be."""
        return tuple(data / folder for folder in self.folders)

    def found(self, data: Path) -> Path | None:
        """Where its files are; None if nowhere."""
        return next((folder for folder in self.expected(data) if folder.is_dir()), None)


@dataclass(frozen=True)
class Suite:
    """Sequences to run, and the presets to compare on them."""

    name: str
    """On the command line, and of the published tables that belong to it."""
    title: str
    sources: tuple[Source, ...]
    presets: tuple[str, ...] = ("default", "base")
    seeds: int = 2
    advice: str = ""
    """Where its files can be had."""
    stride: int = 1
    """Draw every so many-th keyframe, as `tcgsplat eval`."""
    withheld_every: int | None = None
    """Draw one in so many of the frames that were never mapped, as `tcgsplat eval`."""

    def made(self, frames: int, width: int) -> "Suite":
        """The synthetic one at another length and size; the height is three quarters of the width."""
        sources = tuple(
            replace(source, synth=replace(source.synth, frames=frames, width=width, height=3 * width // 4))
            if source.synth
            else source
            for source in self.sources
        )
        return replace(self, sources=sources)


_FRAMES = 300
"""Of each synthetic sequence: the whole walk, twice as fast as in the demo."""

SYNTHETIC = Suite(
    "synthetic",
    "Synthetic apartment",
    (
        Source("clean", synth=SynthConfig(_FRAMES)),
        Source("kinect", synth=SynthConfig(_FRAMES, depth_noise=True)),
        Source("moving", synth=SynthConfig(_FRAMES, depth_noise=True, moving_object=True)),
        Source("jumps", synth=SynthConfig(_FRAMES, exposure_jumps=True)),
    ),
    stride=2,  # so that all of it takes half an hour on two cores
    withheld_every=4,
)

_TUM = (
    ("fr1/desk", "rgbd_dataset_freiburg1_desk", "fr1/desk"),
    ("fr1/desk2", "rgbd_dataset_freiburg1_desk2", "fr1/desk2"),
    ("fr1/room", "rgbd_dataset_freiburg1_room", "fr1/room"),
    ("fr2/xyz", "rgbd_dataset_freiburg2_xyz", "fr2/xyz"),
    ("fr3/office", "rgbd_dataset_freiburg3_long_office_household", "fr3/off."),
)
TUM = Suite(
    "tum",
    "TUM RGB-D",
    tuple(Source(name, (folder,), column=column) for name, folder, column in _TUM),
    advice="unpack the sequences of https://cvg.cit.tum.de/data/datasets/rgbd-dataset/download there",
)

_REPLICA = (*((f"room{i}", f"R{i}") for i in range(3)), *((f"office{i}", f"Off{i}") for i in range(5)))
REPLICA = Suite(
    "replica",
    "Replica",
    tuple(Source(name, (name,), column=column) for name, column in _REPLICA),
    advice="unpack the rendered sequences that NICE-SLAM distributes there",
)

SCANNET = Suite(
    "scannet",
    "ScanNet",
    tuple(
        Source(scene, (f"scene{scene}_00", f"scene{scene}"), column=scene)
        for scene in ("0000", "0059", "0106", "0169", "0181", "0207")
    ),
    advice="extract the scenes with ScanNet's own tool there; its terms have to be signed first",
)

SUITES: Mapping[str, Suite] = MappingProxyType({suite.name: suite for suite in (SYNTHETIC, TUM, REPLICA, SCANNET)})
