"""`tcgsplat bench gpu`: milliseconds of an iteration beside gsplat's own, frames a second, memory; a page of them."""

import json
import logging
import re
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from tcgsplat.cli.bench import Gpu
from tcgsplat.cli.bench.contenders import BareGsplat, Contender, Ours, Rasterize, Scene, rasterization
from tcgsplat.cli.bench.performing import Job, made
from tcgsplat.cli.bench.render import Size, Times
from tcgsplat.cli.bench.suites import Source
from tcgsplat.cli.bench.tables import NONE, markdown
from tcgsplat.cli.bench.track import measured
from tcgsplat.cli.logs import say
from tcgsplat.cli.recorder import Part
from tcgsplat.cli.settings import resolved
from tcgsplat.cli.summary import machine, versions
from tcgsplat.cli.usage import UsageError
from tcgsplat.config import SlamConfig
from tcgsplat.datasets.synthetic import SynthConfig
from tcgsplat.errors import BackendUnavailableError
from tcgsplat.render.backends import open_rasterizer
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.storage import atomic

logger = logging.getLogger(__name__)

BARE = "gsplat alone"
PAPER = "The paper, on an RTX 4090 with a map of its own size: 12.23 ms for tracking, 14.82 ms for mapping."
NO_MEMORY = "not enough GPU memory"


@dataclass(frozen=True)
class Iterations:
    """What one contender took on one scene."""

    size: str
    contender: str
    tracking: Times | None = None
    """Milliseconds an iteration; None if there was not enough memory."""
    mapping: Times | None = None
    peak_mb: float | None = None
    """Most GPU memory that it held, its data included, MB of 2^20 bytes; None on the CPU."""


@dataclass(frozen=True)
class Run:
    """The whole system through a sequence."""

    preset: str
    backend: str
    device: str
    frames: int
    fps: float | None = None
    """Frames over all the time that was taken, finishing included; None if there was not enough memory."""
    ms_median: float | None = None
    """Of a frame, the first one left out."""
    ate_cm: float | None = None
    lost: int | None = None
    peak_mb: float | None = None
    """As of an iteration."""


@dataclass(frozen=True)
class Results:
    """What there is so far."""

    title: str
    """What ran where."""
    about: str
    iterations: tuple[Iterations, ...] = ()
    runs: tuple[Run, ...] = ()
    left_out: Mapping[str, str] = field(default_factory=dict)
    """Why, by what."""

    def write(self, out: Path) -> None:
        """Put gpu.json and README.md into a folder."""
        told: dict[str, Any] = {**asdict(self), "machine": machine(), "gpu": gpu(), "versions": versions()}
        out.mkdir(parents=True, exist_ok=True)
        atomic.write_text(out / "gpu.json", json.dumps(told, indent=2, allow_nan=False) + "\n")
        atomic.write_text(out / "README.md", self.page())

    def page(self) -> str:
        """As Markdown."""
        rows = markdown(("size", "through", "tracking ms", "mapping ms", "over bare", "peak MB"), self._rows(), 2)
        head = ("preset", "through", "on", "frames", "frames a second", "ms, median", "ATE cm", "lost", "peak MB")
        runs = markdown(head, map(_run_row, self.runs), 3) if self.runs else ""
        missing = "\n".join(f"- {what} is left out: {why}" for what, why in self.left_out.items())
        used = ", ".join(f"{name} {number}" for name, number in versions().items())
        parts = ("# " + self.title, missing, "## An iteration", self.about, rows, PAPER, runs and "## End to end", runs)
        return "\n\n".join(part for part in (*parts, f"{used}.") if part) + "\n"

    def _rows(self) -> Iterator[tuple[str, ...]]:
        bare = {one.size: one for one in self.iterations if one.contender == BARE}
        for one in self.iterations:
            if one.tracking is None or one.mapping is None:
                yield one.size, one.contender, NO_MEMORY, NONE, NONE, NONE
                continue
            beside = bare.get(one.size)
            over = NONE
            if beside is not None and beside.tracking is not None and beside.mapping is not None:
                ratios = one.tracking.median / beside.tracking.median, one.mapping.median / beside.mapping.median
                over = " and ".join(f"{ratio:.2f}" for ratio in ratios)
            yield one.size, one.contender, _ms(one.tracking), _ms(one.mapping), over, _plain(one.peak_mb, 0)


def command(args: Gpu, flags: Mapping[str, str]) -> int:
    """Print the page, and write it and gpu.json."""
    sizes = tuple(map(parsed, args.sizes))
    configs = {preset: resolved(preset, args.config, flags, args.seed) for preset in args.presets}
    if min(args.repeats, args.steps) < 1 or args.frames < 0:
        raise UsageError("--repeats and --steps must be at least 1, --frames at least 0")
    rasterizers, left_out = opened(args.backends)
    bare = None
    try:
        bare = rasterization() if args.bare else None
    except BackendUnavailableError as error:
        left_out = {**left_out, BARE: str(error)}
    out = args.out or Path("runs") / "bench-gpu"
    about = (
        f"Milliseconds an iteration, median (minimum) of {args.repeats} runs of {args.steps} iterations each, all "
        "contenders in turn. Tracking: draw, the loss of Eq. 19, gradient by the pose, Adam, as the paper's solver "
        "does it, its beginning included. Mapping: draw, Eq. 21, gradient by all parameters, Adam. "
        f"`{BARE}`: colour and centre depth by `gsplat.rasterization`, L1, torch's fused Adam, and nothing else: no "
        "confidence, planes, masks or SSIM. `over bare`: tracking's and mapping's median over those of it."
    )
    results = Results(f"GPU bench: {gpu() or machine()}", about, left_out=left_out)
    for size in sizes:
        say(f"timing iterations: {named(size)}")
        done = iterations(size, rasterizers, bare, args.repeats, args.steps)
        results = replace(results, iterations=(*results.iterations, *done))
        results.write(out)
    if args.frames:
        synth = SynthConfig(args.frames, width=args.width, height=3 * args.width // 4, free_views=0)
        folder = out / "data" / f"{args.width}"
        made(Job(Source("apartment", synth=synth), folder, "default", 0, ""))
        for run in runs(folder, configs, rasterizers[0]):
            results = replace(results, runs=(*results.runs, run))
            results.write(out)
    sys.stdout.write(f"{results.page()}\n{out / 'README.md'}, {out / 'gpu.json'}\n")
    return 0


def named(size: Size) -> str:
    """As `--sizes` has it."""
    return f"{size.width}x{size.height}x{size.splats}"


def parsed(text: str) -> Size:
    """WIDTHxHEIGHTxGAUSSIANS.

    Raises:
        UsageError: if it is not that.
    """
    found = re.fullmatch(r"(\d+)x(\d+)x(\d+)", text)
    size = Size(*map(int, found.groups())) if found else None
    if size is None or min(size.width, size.height) < 16 or size.splats < 1:
        raise UsageError(f"--sizes: {text} is not WIDTHxHEIGHTxGAUSSIANS, such as 640x480x150000, at least 16x16x1")
    return size


def opened(names: tuple[str, ...]) -> tuple[tuple[Rasterizer, ...], Mapping[str, str]]:
    """The rasterizers to time, and why others are not among them.

    Raises:
        BackendUnavailableError: if one that was named cannot run here, or none was and there is no GPU.
    """
    if names:
        return tuple(open_rasterizer(name) for name in names), {}  # type: ignore[arg-type]  # it checks the name
    if not torch.cuda.is_available():
        raise BackendUnavailableError(
            "there is no GPU that torch can use, so there is nothing to time; `tcgsplat doctor` tells what is missing, "
            "and --backends numba --sizes 320x240x40000 times the CPU"
        )
    own = open_rasterizer("cuda")
    try:
        return (own, open_rasterizer("gsplat")), {}
    except BackendUnavailableError as error:
        return (own,), {"gsplat": str(error)}


def iterations(
    size: Size, rasterizers: tuple[Rasterizer, ...], bare: Rasterize | None, repeats: int, steps: int
) -> tuple[Iterations, ...]:
    """All contenders on one scene, in turn; one that finds too little memory has no times."""
    scene = Scene.of(size, rasterizers[0])
    makers: dict[str, tuple[torch.device, Callable[[], Contender]]] = {
        one.name: (one.device, partial(Ours, scene, one)) for one in rasterizers
    }
    if bare is not None:
        device = rasterizers[0].device
        makers[BARE] = device, partial(BareGsplat, scene, device, bare)
    contenders: dict[str, Contender] = {}
    peaks: dict[str, float | None] = {}
    for name, (device, make) in makers.items():
        try:
            contenders[name], peaks[name] = _warmed(make, device)
        except torch.cuda.OutOfMemoryError as error:
            logger.warning("%s at %s: %s (%s)", name, named(size), NO_MEMORY, str(error).partition("\n")[0])
    tracking: dict[str, list[float]] = {name: [] for name in contenders}
    mapping: dict[str, list[float]] = {name: [] for name in contenders}
    for _ in range(repeats):
        for name, contender in contenders.items():
            tracking[name].append(seconds(contender.device, partial(contender.track, steps)) / steps)
            mapping[name].append(seconds(contender.device, partial(contender.map, steps)) / steps)
    return tuple(
        Iterations(named(size), name, Times.of(tracking[name]), Times.of(mapping[name]), peaks[name])
        if name in contenders
        else Iterations(named(size), name)
        for name in makers
    )


def runs(folder: Path, configs: Mapping[str, SlamConfig], rasterizer: Rasterizer) -> Iterator[Run]:
    """The system by each of some settings, and by the first of them on the CPU, if the others are not."""
    for preset, config in configs.items():
        yield performed(folder, preset, config, rasterizer)
    if rasterizer.device.type == "cuda":
        preset, config = next(iter(configs.items()))
        yield performed(folder, preset, config, open_rasterizer("numba"))


def performed(folder: Path, preset: str, config: SlamConfig, rasterizer: Rasterizer) -> Run:
    """The system through a whole sequence that is on disk."""
    say(f"mapping the apartment: {preset}, {rasterizer.name}")
    sequence, memory = Part().open(folder), Memory(rasterizer.device)
    begun = Run(preset, rasterizer.name, rasterizer.device.type, len(sequence))
    try:
        timed = measured(sequence, config, rasterizer)
    except torch.cuda.OutOfMemoryError as error:
        logger.warning("%s: %s (%s)", preset, NO_MEMORY, str(error).partition("\n")[0])
        return begun
    frames = [row["frame"] for row in timed.seconds]
    return replace(
        begun,
        fps=len(frames) / (sum(frames) + timed.finish),
        ms_median=1000 * statistics.median(frames[1:] or frames),
        ate_cm=timed.ate_cm(sequence.ground_truth()),
        lost=timed.lost,
        peak_mb=memory.peak_mb,
    )


class Memory:
    """GPU memory from its making on."""

    def __init__(self, device: torch.device) -> None:
        self._device = device if device.type == "cuda" else None
        if self._device is not None:
            torch.cuda.empty_cache()
            torch.cuda.reset_peak_memory_stats(self._device)
            self._before = torch.cuda.memory_allocated(self._device)

    @property
    def peak_mb(self) -> float | None:
        """Most that was held above what was held before, MB of 2^20 bytes; None on the CPU."""
        if self._device is None:
            return None
        return (torch.cuda.max_memory_allocated(self._device) - self._before) / 2**20


def seconds(device: torch.device, work: Callable[[], object]) -> float:
    """How long work takes until the device has done it."""
    if device.type != "cuda":
        started = time.perf_counter()
        work()
        return time.perf_counter() - started
    begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))  # type: ignore[no-untyped-call]
    torch.cuda.synchronize(device)
    begin.record()  # type: ignore[no-untyped-call]
    work()
    end.record()  # type: ignore[no-untyped-call]
    torch.cuda.synchronize(device)
    return float(begin.elapsed_time(end)) / 1000  # type: ignore[no-untyped-call]


def gpu() -> str | None:
    """The GPU's name, and what torch is built for; None where torch sees none."""
    if not torch.cuda.is_available():
        return None
    gib = torch.cuda.get_device_properties(0).total_memory / 2**30
    return f"{torch.cuda.get_device_name()}, {gib:.0f} GiB, CUDA {torch.version.cuda}"


def _warmed(make: Callable[[], Contender], device: torch.device, steps: int = 3) -> tuple[Contender, float | None]:
    """A contender that has compiled what it compiles, and the most memory that it held meanwhile."""
    memory = Memory(device)
    contender = make()
    contender.track(steps)
    contender.map(steps)
    return contender, memory.peak_mb


def _run_row(run: Run) -> tuple[str, ...]:
    told = NO_MEMORY if run.fps is None else f"{run.fps:.1f}"
    lost = NONE if run.lost is None else str(run.lost)
    figures = (told, _plain(run.ms_median, 1), _plain(run.ate_cm, 3), lost, _plain(run.peak_mb, 0))
    return (run.preset, run.backend, run.device, str(run.frames), *figures)


def _ms(times: Times) -> str:
    return f"{times.median:.2f} ({times.minimum:.2f})"


def _plain(value: float | None, decimals: int) -> str:
    return NONE if value is None else f"{value:.{decimals}f}"
