"""`tcgsplat bench track`: milliseconds of the whole system on a recorded sequence, stage by stage."""

import json
import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np
import torch

from tcgsplat import datasets
from tcgsplat.cli.bench import Track
from tcgsplat.cli.kernels import compile_kernels
from tcgsplat.cli.progress import RunProgress
from tcgsplat.cli.recorder import Part
from tcgsplat.cli.settings import resolved
from tcgsplat.cli.summary import machine, versions
from tcgsplat.config import SlamConfig, to_toml
from tcgsplat.evaluation import ate
from tcgsplat.render.backends import open_rasterizer
from tcgsplat.render.numba_cpu.workers import available_cores
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.scene.frame import Frame
from tcgsplat.slam import Slam
from tcgsplat.storage import atomic
from tcgsplat.tensors import Pose


@dataclass(frozen=True)
class Spread:
    """How long a stage takes over the frames, milliseconds."""

    mean: float
    """The only one that adds up over the stages."""
    median: float
    percentile_95: float

    def __str__(self) -> str:
        """As the columns of the table."""
        return f"{self.mean:>9.2f}{self.median:>9.2f}{self.percentile_95:>9.2f}"

    @staticmethod
    def of(seconds: Iterable[float]) -> "Spread":
        """Of at least one duration."""
        ms = 1000.0 * np.fromiter(seconds, np.float64)
        return Spread(float(ms.mean()), float(np.median(ms)), float(np.quantile(ms, 0.95)))


@dataclass(frozen=True)
class Timed:
    """A system's way through a sequence."""

    T_world_cam: Mapping[int, Pose]
    """By frame index."""
    seconds: Sequence[Mapping[str, float]]
    """Of every frame, by stage: `load` first, `frame` (all of it) last."""
    lost: int
    """Frames whose pose is a guess."""
    updates: Sequence[float] = ()
    """Seconds of each mapping update that ran beside the frames."""
    finish: float = 0.0
    """Seconds after the last frame: for what was still being mapped beside it, and the sealing."""

    def milliseconds(self) -> dict[str, Spread]:
        """By stage, without the first frame, if there are others; a stage takes no time in a frame that skips it."""
        rows = self.seconds[1:] or self.seconds
        stages = dict.fromkeys(stage for row in rows for stage in row)
        return {stage: Spread.of(row.get(stage, 0.0) for row in rows) for stage in stages}

    def update_milliseconds(self) -> Spread | None:
        """Of a mapping update, without the first, if there are others; None if there were none."""
        return Spread.of(self.updates[1:] or self.updates) if self.updates else None

    def ate_cm(self, truth: Mapping[int, Pose]) -> float | None:
        """Root mean square of the error of position after rigid alignment; None where fewer than three are known."""
        common = [index for index in self.T_world_cam if index in truth]
        if len(common) < 3:
            return None
        return 100.0 * ate.ate_rmse_of_poses([self.T_world_cam[i] for i in common], [truth[i] for i in common])


def command(args: Track, settings: Mapping[str, str]) -> int:
    """Print a table, and write the file that was asked for."""
    config = resolved(args.preset, args.config, settings, args.seed)
    sequence = Part(limit=args.limit).open(args.folder)
    rasterizer = open_rasterizer(args.backend)  # type: ignore[arg-type]  # it checks the name
    timed = measured(sequence, config, rasterizer)
    error = timed.ate_cm(sequence.ground_truth())
    camera, update = sequence.camera, timed.update_milliseconds()
    changed = "".join(f", {path} = {value}" for path, value in settings.items())
    sys.stdout.write(
        f"{sequence.name}, {camera.width}x{camera.height}, {len(timed.T_world_cam)} frames; {machine()}, a thread on "
        f"each; {rasterizer.name}, preset {args.preset}{changed}, seed {config.seed}\n{table(timed)}\n"
        f"ATE {accuracy(error)}; {timed.lost} lost; {1000 * timed.finish:.0f} ms to finish after the last frame\n"
    )
    if args.json is not None:
        written = {
            "sequence": sequence.name, "width": camera.width, "height": camera.height,
            "frames": len(timed.T_world_cam), "frames_lost": timed.lost, "ate_rmse_cm": error,
            "milliseconds": {stage: asdict(spread) for stage, spread in timed.milliseconds().items()},
            "updates": len(timed.updates), "update_milliseconds": asdict(update) if update else None,
            "finish_ms": 1000 * timed.finish, "machine": machine(), "threads": available_cores(),
            "versions": versions(), "backend": rasterizer.name, "preset": args.preset, "seed": config.seed,
            "config": to_toml(config),
        }  # fmt: skip
        atomic.write_text(args.json, json.dumps(written, indent=2, allow_nan=False) + "\n")
    return 0


def measured(sequence: datasets.Sequence, config: SlamConfig, rasterizer: Rasterizer) -> Timed:
    """SLAM through a whole sequence, once its kernels are compiled, timed frame by frame."""
    compile_kernels(config, rasterizer)
    return through(Slam(config, rasterizer), sequence)


def through(slam: Slam, sequence: datasets.Sequence) -> Timed:
    """A system that has seen nothing yet, through a whole sequence and finished, timed frame by frame."""
    torch.set_num_threads(1)  # as `recorded` does, which says why
    lost = 0
    seconds: list[Mapping[str, float]] = []
    updates: list[float] = []
    with RunProgress(len(sequence)) as progress:
        for frame, waited in waiting(sequence):
            started = time.perf_counter()
            report = slam.step(frame)
            stepped = time.perf_counter() - started
            seconds.append({"load": waited, **report.seconds, "frame": waited + stepped})
            lost += not report.tracked.converged
            updates += [report.update.seconds] if report.update else []
            progress.observe(report)
    started = time.perf_counter()
    slam.finish()
    finish = time.perf_counter() - started
    world = slam.trajectory.world(slam.atlas)
    poses = {row.frame_index: T for row, T in zip(slam.trajectory.rows, world, strict=True)}
    return Timed(poses, seconds, lost, updates, finish)


def waiting(frames: Iterable[Frame]) -> Iterator[tuple[Frame, float]]:
    """Each frame with the seconds that its reader was waited for."""
    reader = iter(frames)
    while True:
        started = time.perf_counter()
        frame = next(reader, None)
        if frame is None:
            return
        yield frame, time.perf_counter() - started


def table(timed: Timed) -> str:
    """A line a stage, and one of the mapping updates that ran beside."""
    rows = [f"{stage:<14}{spread}" for stage, spread in timed.milliseconds().items()]
    update = timed.update_milliseconds()
    if update:
        rows.append(f"{'update':<14}{update}   beside the frames, {len(timed.updates[1:]) or 1} of them")
    return "\n".join([f"{'milliseconds':<14}{'mean':>9}{'median':>9}{'95 %':>9}", *rows])


def accuracy(ate_cm: float | None) -> str:
    """For a line of text."""
    return "unknown: fewer than 3 true poses" if ate_cm is None else f"{ate_cm:.3f} cm, rigid"
