"""`tcgsplat bench`: how long the stages take on this machine."""

import json
import statistics
import sys
import time
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
import tyro

from tcgsplat.cli.summary import machine
from tcgsplat.geometry import se3
from tcgsplat.geometry.camera import Camera
from tcgsplat.render.numba_cpu import NumbaRasterizer
from tcgsplat.render.protocol import MAX_OPACITY, Raster, Splats
from tcgsplat.storage import atomic


@dataclass(frozen=True)
class Args:
    """Time the CPU rasterizer, forward and backward, on random scenes of three sizes.

    Colour, confidence and plane depth take part in the loss; derivatives go to all parameters and to the pose. Times
    are medians in milliseconds. `autograd` is torch's share, `iteration` the whole.
    """

    what: tyro.conf.Positional[Literal["render"]]
    """What to time."""
    json: Path | None = None
    """File to write the times to, as an object from size to stage milliseconds."""
    repeats: int = 20
    """Timed iterations of each size, after three that are not."""
    threads: int | None = None
    """Worker threads; as many as there are cores if left out."""


@dataclass(frozen=True)
class Size:
    """An image and a number of splats."""

    width: int
    height: int
    splats: int

    def __str__(self) -> str:
        """As the results name it."""
        return f"{self.width}x{self.height}/{self.splats // 1000}k"


SIZES = (Size(320, 240, 40_000), Size(640, 480, 150_000), Size(1200, 680, 600_000))
STAGES = ("pack", "project", "sort", "bin", "forward", "backward", "chain", "autograd", "iteration")


class Stopwatch:
    """Adds up the time of each stage."""

    def __init__(self) -> None:
        self.seconds: defaultdict[str, float] = defaultdict(float)
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        """End a stage: the time since the last one ended was its."""
        now = time.perf_counter()
        self.seconds[stage] += now - self._last
        self._last = now


def command(args: Args) -> int:
    """Print a table, and write the file that was asked for."""
    sys.stdout.write(f"{machine()}; milliseconds, medians of {args.repeats}\n")
    sys.stdout.write(f"{'':<16}" + "".join(f"{stage:>11}" for stage in STAGES) + "\n")
    results = {}
    for size in SIZES:
        times = timed(size, args.repeats, args.threads)
        sys.stdout.write(f"{size!s:<16}" + "".join(f"{times[f'{stage}_ms']:>11.2f}" for stage in STAGES) + "\n")
        sys.stdout.flush()
        results[str(size)] = times
    if args.json is not None:
        atomic.write_text(args.json, json.dumps(results, indent=2) + "\n")
    return 0


def timed(size: Size, repeats: int, threads: int | None = None, warm_up: int = 3) -> dict[str, float]:
    """Median milliseconds of each stage of an iteration."""
    watch = Stopwatch()
    rasterizer = NumbaRasterizer(threads, lambda stage: watch.lap(stage))
    camera = Camera(0.9 * size.width, 0.9 * size.width, size.width / 2, size.height / 2, size.width, size.height)
    splats = scene(size, camera)
    inputs = [splats.means, splats.quats, splats.scales, splats.opacities, splats.features]
    T_cam_map = se3.identity().requires_grad_()
    generator = torch.Generator().manual_seed(1)
    d_features = torch.rand(size.height, size.width, 4, generator=generator)
    d_depth = torch.rand(size.height, size.width, generator=generator)
    laps = []
    for _ in range(warm_up + repeats):
        watch = Stopwatch()
        raster: Raster = rasterizer(splats, camera, T_cam_map)
        torch.autograd.grad((raster.features, raster.plane_depth), [*inputs, T_cam_map], (d_features, d_depth))
        watch.lap("autograd")
        laps.append({**watch.seconds, "iteration": sum(watch.seconds.values())})
    return {f"{stage}_ms": 1000 * statistics.median(lap[stage] for lap in laps[warm_up:]) for stage in STAGES}


def scene(size: Size, camera: Camera, seed: int = 0) -> Splats:
    """Splats on a wavy wall with things before it; about 25 of them show in every pixel. Leaves of autograd."""
    generator = torch.Generator().manual_seed(seed)
    n = size.splats

    def uniform() -> torch.Tensor:
        return torch.rand(n, generator=generator)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(n, *shape, generator=generator)

    u, v = uniform() * size.width, uniform() * size.height
    wall = 1.5 + torch.sin(6 * u / size.width) * torch.cos(5 * v / size.height)
    z = wall + 0.01 * normal() + 0.7 * (uniform() < 0.3)
    spacing = (size.width * size.height / n) ** 0.5
    tensors = {
        "means": torch.stack(((u - camera.cx) * z / camera.fx, (v - camera.cy) * z / camera.fy, z), dim=-1),
        "quats": normal(4),
        "scales": 0.7 * spacing * (z / camera.fx)[:, None] * torch.exp(0.4 * normal(3)),
        "opacities": torch.sigmoid(1.0 + 1.5 * normal()).clamp_max(MAX_OPACITY),
        "features": torch.rand(n, 4, generator=generator),
    }
    return Splats(**{name: tensor.requires_grad_() for name, tensor in tensors.items()})
