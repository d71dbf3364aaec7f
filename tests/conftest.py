"""What every test shares: environment, annotations checked at run time, a seeded generator, and places to look at."""

import os
import signal
from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from pathlib import Path

os.environ.setdefault("NUMBA_THREADING_LAYER", "omp")
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job ignores it, and so would children

import pytest
import shapes
import torch

shapes.check_from_now_on()

from analytic_room import Room  # after the line above, or what it imports would go unchecked

from tcgsplat.confidence.state import ConfidenceConfig
from tcgsplat.datasets.synthetic import SynthConfig
from tcgsplat.datasets.synthetic.studio import Studio, furnished_studio
from tcgsplat.datasets.synthetic.synthesis import record
from tcgsplat.geometry import se3
from tcgsplat.mapping.feedback import judged
from tcgsplat.mapping.mapper import Mapper
from tcgsplat.mapping.seeding import IdSource, SeedingConfig
from tcgsplat.mapping.settings import MapperConfig
from tcgsplat.render.availability import gpu_obstacles
from tcgsplat.render.backends import open_rasterizer
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.scene.submap import Keyframe, Submap


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


@pytest.fixture
def room() -> Room:
    return Room()


@pytest.fixture(scope="session")
def rasterizer() -> Rasterizer:
    return open_rasterizer("numba")


@pytest.fixture(scope="session")
def cuda_device() -> torch.device:
    """A GPU; the tests that ask for it are skipped where there is none, and say why."""
    if obstacles := gpu_obstacles():
        pytest.skip("; ".join(obstacles))
    return torch.empty(0, device="cuda").device


@pytest.fixture(scope="session")
def corner(rasterizer: Rasterizer) -> Submap:
    """The room, mapped and judged once from the origin: a disc for every pixel."""
    seeding = SeedingConfig(recipe="surface", spacing=1, footprint=0.5, flatness=0.2, opacity=0.9, push_back=0.0)
    config = MapperConfig(seeding=seeding, first_iterations=30, depth_mode="planar", min_opacity=0.1)
    mapper = Mapper(config, ConfidenceConfig(), rasterizer, IdSource(), torch.Generator().manual_seed(0))
    frame = Room().frame()
    mapped = mapper.optimized(mapper.grown(Keyframe(frame, se3.identity()), Submap.anchored(se3.identity(), index=0)))
    return judged(mapped, frame, ConfidenceConfig(), "planar", rasterizer)


@pytest.fixture(scope="session")
def workers() -> Iterator[Executor]:
    with ThreadPoolExecutor(2) as executor:
        yield executor


@pytest.fixture(scope="session")
def studio(workers: Executor) -> Studio:
    """The synthetic apartment, lit for pictures of 64x48; to be recorded with `record`."""
    return furnished_studio(64, 48, 0, moving_object=False, workers=workers)


@pytest.fixture(scope="session")
def peopled(workers: Executor) -> Studio:
    """The apartment with somebody in it."""
    return furnished_studio(64, 48, 0, moving_object=True, workers=workers)


@pytest.fixture(scope="session")
def twin_rooms(workers: Executor) -> Studio:
    """Two rooms that look the same, and a hall between them."""
    return furnished_studio(64, 48, 0, moving_object=False, workers=workers, place="twins")


@pytest.fixture(scope="session")
def easy_walk(studio: Studio, workers: Executor, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The apartment recorded at an easy pace, 300 frames; not to be written to."""
    folder = tmp_path_factory.mktemp("easy") / "walk"
    folder.mkdir()
    record(studio, folder, SynthConfig(frames=300, width=64, height=48, free_views=0), workers)
    return folder
