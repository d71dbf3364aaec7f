"""`tcgsplat bench render`: milliseconds of the rasterizer's stages on random scenes, and how near the limit that is."""

import json
import statistics
import sys
import time
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch

from tcgsplat.cli.bench import Render
from tcgsplat.cli.bench.limit import Machine, Needs, floors
from tcgsplat.cli.summary import machine
from tcgsplat.geometry import se3
from tcgsplat.geometry.camera import Camera
from tcgsplat.render.numba_cpu import NumbaRasterizer
from tcgsplat.render.numba_cpu.layout import Floats
from tcgsplat.render.numba_cpu.passes import Drawn, Passes
from tcgsplat.render.numba_cpu.workers import available_cores
from tcgsplat.render.protocol import MAX_OPACITY, Splats
from tcgsplat.storage import atomic


@dataclass(frozen=True)
class Size:
    """An image and a number of splats."""

    width: int
    height: int
    splats: int

    def __str__(self) -> str:
        """As the results name it."""
        return f"{self.width}x{self.height}/{self.splats // 1000}k"

    @property
    def camera(self) -> Camera:
        """Wide as a sensor for rooms."""
        focal = 0.9 * self.width
        return Camera(focal, focal, self.width / 2, self.height / 2, self.width, self.height)


WHOLE = ("autograd", "iteration")
"""What is shown after the stages: it runs between them, and all together."""
SIZES = (Size(320, 240, 40_000), Size(640, 480, 150_000), Size(1200, 680, 600_000))


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


@dataclass(frozen=True)
class Result:
    """One size: what it took, and what it could have taken."""

    milliseconds: Mapping[str, float]
    """Median by stage, in the order in which they run; then `autograd` and `iteration`."""
    needs: Needs
    floors: Mapping[str, float]
    """Least milliseconds, for those of the stages that have a floor; their sum as `iteration`."""

    def share(self, stage: str) -> float:
        """Floor over time, 0 to 1."""
        return self.floors[stage] / self.milliseconds[stage]

    def to_dict(self) -> dict[str, float]:
        """For JSON."""
        counts = {f"needed_{what}": getattr(self.needs, what) for what in ("pixels", "blocks", "pairs")}
        return {
            **{f"{stage}_ms": ms for stage, ms in self.milliseconds.items()},
            **{f"{stage}_floor_ms": ms for stage, ms in self.floors.items()},
            **counts,
            "lane_use": self.needs.lane_use,
        }


def command(args: Render) -> int:
    """Print two tables, and write the file that was asked for."""
    able = Machine.measured(args.threads or available_cores())
    results: dict[Size, Result] = {}
    for size in SIZES:
        result = results[size] = measured(size, args.repeats, able)
        if len(results) == 1:
            sys.stdout.write(f"{machine()}; milliseconds, medians of {args.repeats}\n")
            sys.stdout.write(_row("", result.milliseconds))
        sys.stdout.write(_row(str(size), (f"{ms:.2f}" for ms in result.milliseconds.values())))
        sys.stdout.flush()
    sys.stdout.write(f"\nwhat must be done, and the least ms for it with the share of the time above; {able}\n")
    sys.stdout.writelines(_limits(results))
    if args.json is not None:
        written = {str(size): result.to_dict() | able.to_dict() for size, result in results.items()}
        atomic.write_text(args.json, json.dumps(written, indent=2) + "\n")
    return 0


def _limits(results: Mapping[Size, Result]) -> Iterator[str]:
    """Counts and floors by size."""
    stages = next(iter(results.values())).floors
    yield _row("", (*("pixels", "blocks", "tiles", "lane use"), *(f"{stage:>15}" for stage in stages)))
    for size, result in results.items():
        needs = result.needs
        counts = (f"{count / 1000:.0f}k" for count in (needs.pixels, needs.blocks, needs.pairs))
        floored = (f"{ms:>9.2f} {result.share(stage):>5.0%}" for stage, ms in result.floors.items())
        yield _row(str(size), (*counts, f"{needs.lane_use:.0%}", *floored))


def _row(name: str, cells: Iterable[str]) -> str:
    return f"{name:<16}" + "".join(f"{cell:>11}" for cell in cells) + "\n"


def measured(size: Size, repeats: int, able: Machine, warm_up: int = 3) -> Result:
    """Times, counts and floors of one size."""
    splats = scene(size)
    milliseconds = timed(size, splats, repeats, able.threads, warm_up)
    needs = Needs.of(drawn(size, splats, able.threads))
    floor = {stage: ms for stage, ms in floors(needs, able).items() if stage in milliseconds}
    return Result(milliseconds, needs, {**floor, "iteration": sum(floor.values())})


def timed(size: Size, splats: Splats, repeats: int, threads: int, warm_up: int = 3) -> dict[str, float]:
    """Median milliseconds of each stage of an iteration."""
    watch = Stopwatch()
    rasterizer = NumbaRasterizer(threads, lambda stage: watch.lap(stage))
    inputs = [splats.means, splats.quats, splats.scales, splats.opacities, splats.features]
    T_cam_map = se3.identity().requires_grad_()
    generator = torch.Generator().manual_seed(1)
    d_features = torch.rand(size.height, size.width, 4, generator=generator)
    d_depth = torch.rand(size.height, size.width, generator=generator)
    laps = []
    for _ in range(warm_up + repeats):
        watch = Stopwatch()
        raster = rasterizer(splats, size.camera, T_cam_map)
        torch.autograd.grad((raster.features, raster.plane_depth), [*inputs, T_cam_map], (d_features, d_depth))
        watch.lap("autograd")  # an optimiser's kernel would follow here, with a lap of its own: adam
        laps.append({**watch.seconds, "iteration": sum(watch.seconds.values())})
    stages = [*(stage for stage in laps[0] if stage not in WHOLE), *WHOLE]
    return {stage: 1000 * statistics.median(lap[stage] for lap in laps[warm_up:]) for stage in stages}


def drawn(size: Size, splats: Splats, threads: int) -> Drawn:
    """The forward pass that is timed, for counting."""
    rasterizer = NumbaRasterizer(threads)
    rasterizer.passes = keeping = _Keeping(threads)
    rasterizer(splats, size.camera, se3.identity())
    (only,) = keeping.drawn
    return only


class _Keeping(Passes):
    """Passes that remember what they drew."""

    def __init__(self, threads: int) -> None:
        super().__init__(threads)
        self.drawn: list[Drawn] = []

    def draw(self, parameters: Floats, camera: Camera, T_cam_map: npt.NDArray[np.float64]) -> Drawn:
        drawn = super().draw(parameters, camera, T_cam_map)
        self.drawn.append(drawn)
        return drawn


def scene(size: Size, seed: int = 0) -> Splats:
    """Splats on a wavy wall with things before it; about 25 of them show in every pixel. Leaves of autograd."""
    generator = torch.Generator().manual_seed(seed)
    n, camera = size.splats, size.camera

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
