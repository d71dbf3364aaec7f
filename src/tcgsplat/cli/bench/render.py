"""`tcgsplat bench render`: milliseconds of mapping's stages on random scenes, and how near the limit that is."""

import json
import statistics
import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import torch

from tcgsplat.cli.bench import Render
from tcgsplat.cli.bench.iteration import Iteration
from tcgsplat.cli.bench.limit import Machine, Needs, floors
from tcgsplat.cli.summary import machine
from tcgsplat.cli.usage import UsageError
from tcgsplat.geometry.camera import Camera
from tcgsplat.render.conventions import MAX_OPACITY
from tcgsplat.render.numba_cpu.passes import Drawn, Passes
from tcgsplat.render.numba_cpu.workers import available_cores
from tcgsplat.render.protocol import Splats
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


SIZES = (Size(320, 240, 40_000), Size(640, 480, 150_000), Size(1200, 680, 600_000))


class Stopwatch:
    """Time of each stage, run by run."""

    def __init__(self) -> None:
        self.runs: list[dict[str, float]] = []
        self._last = 0.0

    def start(self) -> None:
        """Begin a run."""
        self.runs.append({})
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        """End a stage: the time since the last one ended was its."""
        now = time.perf_counter()
        self.runs[-1][stage] = now - self._last
        self._last = now


@dataclass(frozen=True)
class Times:
    """Milliseconds over several runs."""

    median: float
    minimum: float
    """What it takes where nothing else is in the way."""

    @staticmethod
    def of(seconds: Sequence[float]) -> "Times":
        """Of at least one run."""
        return Times(1000 * statistics.median(seconds), 1000 * min(seconds))


@dataclass(frozen=True)
class Result:
    """One size: what it took, and what it could have taken."""

    times: Mapping[str, Times]
    """By stage, in the order in which they run; then `iteration`."""
    needs: Needs
    floors: Mapping[str, float]
    """Least milliseconds, for those of the stages that have a floor; their sum as `iteration`."""

    def share(self, stage: str) -> float:
        """Floor over median, 0 to 1."""
        return self.floors[stage] / self.times[stage].median

    def to_dict(self) -> dict[str, float]:
        """For JSON."""
        counts = {f"needed_{what}": getattr(self.needs, what) for what in ("pixels", "blocks", "pairs")}
        return {
            **{f"{stage}_ms": times.median for stage, times in self.times.items()},
            **{f"{stage}_min_ms": times.minimum for stage, times in self.times.items()},
            **{f"{stage}_floor_ms": ms for stage, ms in self.floors.items()},
            **counts,
            "lane_use": self.needs.lane_use,
        }


def command(args: Render) -> int:
    """Print two tables, and write the file that was asked for."""
    cores = available_cores()
    if args.repeats < 1 or not 1 <= (args.threads or 1) <= cores:
        raise UsageError(f"--repeats must be at least 1, and --threads from 1 to {cores}, as many as there are cores")
    if args.json is not None and not args.json.parent.is_dir():
        raise UsageError(f"--json {args.json} cannot be written: give a file in a folder that is there")
    able = Machine.measured(args.threads or cores)
    results: dict[Size, Result] = {}
    for size in SIZES:
        result = results[size] = measured(size, args.repeats, able)
        if len(results) == 1:
            sys.stdout.write(_heading(args.repeats, able.threads))
            sys.stdout.write(_row("", result.times))
        sys.stdout.write(_row(str(size), (f"{times.median:.2f}" for times in result.times.values())))
        sys.stdout.write(_row("  minimum", (f"{times.minimum:.2f}" for times in result.times.values())))
        sys.stdout.flush()
    sys.stdout.write(f"\nwhat must be done, and the least ms for it with the share of the median above; {able}\n")
    sys.stdout.writelines(_limits(results))
    if args.json is not None:
        written = {str(size): result.to_dict() | able.to_dict() for size, result in results.items()}
        atomic.write_text(args.json, json.dumps(written, indent=2) + "\n")
    return 0


def _heading(repeats: int, threads: int) -> str:
    return (
        f"{machine()}, {threads} thread{'s' * (threads != 1)}; milliseconds, medians and minima of {repeats}\n"
        "mapping's iteration, losses left out; seven channels: colour, confidence, depth, plane depth, alpha\n"
        "stages are timed with all threads meeting after each one, `iteration` in runs of its own, where they do not\n"
    )


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
    times = timed(size, splats, repeats, able.threads, warm_up)
    needs = Needs.of(drawn(size, splats, able.threads))
    floor = {stage: ms for stage, ms in floors(needs, able).items() if stage in times}
    return Result(times, needs, {**floor, "iteration": sum(floor.values())})


def timed(size: Size, splats: Splats, repeats: int, threads: int, warm_up: int = 3) -> dict[str, Times]:
    """Each stage of an iteration; and the whole, in runs of its own where threads do not meet between stages."""
    stages, whole = Stopwatch(), Stopwatch()
    for watch, passes in ((stages, Passes(threads, stages.lap)), (whole, Passes(threads))):
        iteration = Iteration(splats, size.camera, passes)
        for _ in range(warm_up + repeats):
            watch.start()
            iteration.step()
            if watch is whole:
                watch.lap("iteration")
    runs = [{**one, **other} for one, other in zip(stages.runs, whole.runs, strict=True)][warm_up:]
    return {stage: Times.of([run[stage] for run in runs]) for stage in runs[0]}


def drawn(size: Size, splats: Splats, threads: int) -> Drawn:
    """The forward pass that is timed, for counting."""
    return Iteration(splats, size.camera, Passes(threads)).draw()


def scene(size: Size, seed: int = 0) -> Splats:
    """Splats on a wavy wall with things before it; about 25 of them show in every pixel."""
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
    return Splats(
        means=torch.stack(((u - camera.cx) * z / camera.fx, (v - camera.cy) * z / camera.fy, z), dim=-1),
        quats=normal(4),
        scales=0.7 * spacing * (z / camera.fx)[:, None] * torch.exp(0.4 * normal(3)),
        opacities=torch.sigmoid(1.0 + 1.5 * normal()).clamp_max(MAX_OPACITY),
        features=torch.rand(n, 4, generator=generator),
    )
