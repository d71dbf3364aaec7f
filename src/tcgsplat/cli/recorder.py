"""A SLAM run, written down as it goes."""

import json
import logging
import shlex
import shutil
import sys
import time
from collections.abc import Callable, Iterable
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch

from tcgsplat.cli.interrupt import stopping_on_interrupt
from tcgsplat.cli.kernels import compile_kernels
from tcgsplat.cli.logs import say, sentence
from tcgsplat.cli.progress import RunProgress
from tcgsplat.cli.summary import Summary, Tally
from tcgsplat.config import SlamConfig, from_toml, settings, to_toml
from tcgsplat.datasets import Sequence, open_sequence
from tcgsplat.datasets.playback import Arrival, Clock, in_turn, play
from tcgsplat.errors import ArchiveError, DeviceMemoryError
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.scene.frame import Frame
from tcgsplat.slam import Reference, Slam, StepReport
from tcgsplat.storage import atomic
from tcgsplat.storage.run_directory import RunDirectory, is_free

logger = logging.getLogger(__name__)

Watch = Callable[[Frame, Reference, Reference, StepReport], object]
"""Called after a step: with its frame, the reference that it was tracked against, that of the next one, its report."""

MAX_HELD = 0.05
"""Share of a real-time run in which reading may have stopped the camera's clock without a word about it."""


@dataclass(frozen=True)
class Part:
    """Which frames of a sequence a run uses; their indices count what was selected."""

    start: int = 0
    stride: int = 1
    limit: int | None = None

    def __str__(self) -> str:
        """As the flags that ask for it."""
        limit = "no --limit" if self.limit is None else f"--limit {self.limit}"
        return f"--start {self.start}, --stride {self.stride}, {limit}"

    def open(self, folder: Path | str) -> Sequence:
        """The part of the sequence in a folder.

        Raises:
            DatasetError: if there is no such sequence or part.
        """
        return open_sequence(folder, start=self.start, stride=self.stride, limit=self.limit)

    @staticmethod
    def of(run: RunDirectory) -> "Part":
        """That of a run; the whole sequence where the run does not say.

        Raises:
            ArchiveError: if `request.json` is there and makes no sense.
        """
        request: dict[str, Any] | None = run.request
        try:
            return Part() if request is None else Part(request["start"], request["stride"], request["limit"])
        except (KeyError, TypeError) as error:
            raise ArchiveError(f"cannot read {run.path / 'request.json'} ({error}); run again") from error


def resume(path: Path, config: SlamConfig, folder: Path, part: Part, *, backend: str = "") -> RunDirectory:
    """The run directory of the same run, which was interrupted.

    Raises:
        ArchiveError: if the run that is there has other settings, other data or another rasterizer, or has ended.
    """
    run = RunDirectory.open(path)
    if run.summary() and not run.summary().get("interrupted"):
        raise ArchiveError(f"the run in {path} has ended, and there is nothing to resume; use --overwrite to repeat it")
    if Path(run.sequence) != folder.expanduser().resolve() or Part.of(run) != part:
        raise ArchiveError(f"the run in {path} is of {run.sequence}, {Part.of(run)}; resume it with the same")
    now, then = settings(config), settings(from_toml(run.config_toml))
    other = [f"{name} was {then[name]} and is {now[name]}" for name in now if now[name] != then[name]]
    if other:
        raise ArchiveError(f"the run in {path} has other settings: {'; '.join(other)}; resume it with the same ones")
    if (run.request or {}).get("realtime"):
        raise ArchiveError(f"the run in {path} was made in real time: nothing resumes it; replace it by --overwrite")
    if backend != (drawn := (run.request or {}).get("backend") or backend):
        raise ArchiveError(
            f"the run in {path} was drawn by {drawn}, and {backend} has other bits; add --backend {drawn}"
        )
    outdated = (path / name for name in ("summary.json", "map.npz", "report.json", "localized.txt"))
    for file in (*outdated, *path.rglob(atomic.PARTIAL)):
        file.unlink(missing_ok=True)
    return run


def begin(
    path: Path,
    config: SlamConfig,
    folder: Path,
    part: Part,
    *,
    overwrite: bool,
    backend: str = "",
    realtime: bool = False,
) -> RunDirectory:
    """A new run directory that knows its settings and its data, and the rasterizer if that is told.

    Raises:
        ArchiveError: if there is something at `path` already that may not be, or cannot be, replaced.
    """
    if not is_free(path):
        if not overwrite:
            unfinished = (path / "run.json").exists() and not (path / "summary.json").exists()
            resumable = unfinished and not (RunDirectory.open(path).request or {}).get("realtime")
            goes_on = "go on with the unfinished run in it by --resume, " if resumable else ""
            raise ArchiveError(
                f"{path} exists; {goes_on}choose another folder by --out, or replace the run by --overwrite"
            )
        old = path.with_name(f".{path.name}.replaced")  # a kill while it is deleted leaves no half of a run behind
        shutil.rmtree(old, ignore_errors=True)
        shutil.rmtree(RunDirectory.open(path).path.rename(old))  # `open` refuses a folder that holds no run
    data, command = str(folder.expanduser().resolve()), shlex.join(["tcgsplat", *sys.argv[1:]])
    about = {"command": command, "backend": backend, "realtime": realtime, **asdict(part)}
    request = json.dumps(about, indent=2) + "\n"
    return RunDirectory.create(path, config_toml=to_toml(config), sequence=data, request=request)


def recorded(
    sequence: Sequence,
    config: SlamConfig,
    rasterizer: Rasterizer,
    run: RunDirectory,
    preset: str,
    *,
    realtime: bool = False,
    watch: Watch | None = None,
    waited: float = 0.0,
) -> Summary:
    """A whole run with progress on the terminal, or what is left of one; its summary is on disk too.

    Args:
        sequence: The frames.
        config: Settings of the system.
        rasterizer: Its backend.
        run: Where to write.
        preset: What the settings started from, for the summary.
        realtime: Play the frames at the pace of their time stamps and drop those that come too fast.
        watch: Sees every step, as in `record`.
        waited: Seconds for which compiling has been waited for before.

    Raises:
        KeyboardInterrupt: at the second Ctrl-C, saying what is on disk.
        DeviceMemoryError: if a GPU has too little memory; what was mapped by then is on disk, as after one Ctrl-C.
    """
    # A frame's arrays are small: handing an operation to a second thread costs more than it saves, measured 141 against
    # 104 ms a frame, and the splat kernels have threads of their own.
    torch.set_num_threads(1)
    compiling = waited + compile_kernels(config, rasterizer)
    checkpoint = run.checkpoint()
    if checkpoint is None:
        slam = Slam(config, rasterizer, live=realtime, store=run)
    else:
        slam = Slam.resumed(config, rasterizer, run, checkpoint)
        say(f"going on from frame {checkpoint.frame_index}, after {checkpoint.sealed} submaps")
    frames = sequence.frames_from(0 if checkpoint is None else checkpoint.frame_index)
    try:
        with (
            RunProgress(len(sequence)) as progress,
            stopping_on_interrupt() as stop,
            # `stop.wait`, so that nobody has to wait for the camera's next frame when the run is to stop
            closing(play(frames, Clock(sleep=stop.wait)) if realtime else in_turn(frames)) as arrivals,
        ):
            summary = record(slam, arrivals, run, progress.observe, stop.is_set, watch)
    except KeyboardInterrupt as interrupt:
        slam.abandon()
        raise KeyboardInterrupt(f"stopped at once; {_saved(run)}") from interrupt
    except OSError as error:  # a full disk, above all
        goes_on = "replace the run by --overwrite" if realtime else "go on by --resume"
        stopped = f"{sentence(error)}; the run has stopped, {_saved(run)}"
        raise ArchiveError(f"{stopped}; mend it and {goes_on}") from error
    if not summary.interrupted:
        summary = replace(summary, frames_unreadable=len(sequence) - summary.frames - summary.frames_dropped)
    summary = replace(
        summary,
        resumed_at=None if checkpoint is None else checkpoint.frame_index,
        realtime=realtime,
        seconds_compiling=compiling,
        backend=rasterizer.name,
        preset=preset,
    )
    if summary.seconds_held > MAX_HELD * summary.seconds:
        logger.warning(
            "the images could not be read fast enough: for %.1f of %.1f s the playback stood still, as no camera would",
            summary.seconds_held, summary.seconds,
        )  # fmt: skip
    run.write_summary(summary.to_dict())
    if summary.out_of_memory:
        raise DeviceMemoryError(
            f"the GPU's memory ran out after {summary.frames} frames; saved {summary}: {run.path}; repeat the run with "
            "--overwrite and --max-gpu-memory GB, fewer than it has free, or with smaller pictures"
        )
    return summary


def _saved(run: RunDirectory) -> str:
    return f"{run.submap_count} submaps sealed before are saved: {run.path}"


def record(
    slam: Slam,
    arrivals: Iterable[Arrival],
    run: RunDirectory,
    observe: Callable[[StepReport, int], object],
    stopped: Callable[[], bool],
    watch: Watch | None = None,
) -> Summary:
    """Step SLAM through the frames.

    Args:
        slam: The system, which keeps its submaps in the run directory.
        arrivals: Frames in order of time.
        run: Where to write the path at the end.
        observe: Called with every report, and the number of frames dropped before it.
        stopped: Asked after every frame; if true, what there is gets sealed and the run ends. So it does where a GPU
            has too little memory.
        watch: Sees every step. Its time is in none of the summary's, but mapping goes on beside it.

    Returns:
        The summary, not yet written: the caller knows more about the run.
    """
    tally = Tally()
    started = before = time.perf_counter()
    watching, exhausted = 0.0, False
    try:
        for arrival in arrivals:
            reference = slam.reference
            report = slam.step(arrival.frame)
            tally.follow(arrival, time.perf_counter())
            observe(report, arrival.dropped)
            now = time.perf_counter()
            tally.count(report, now - before - arrival.waited)
            if watch is not None:
                watch(arrival.frame, reference, slam.reference, report)
            before = time.perf_counter()
            watching += before - now
            if stopped():
                break
        interrupted = stopped()
        slam.finish()
    except torch.OutOfMemoryError as error:
        logger.debug("out of memory", exc_info=error)
        exhausted = interrupted = True
        slam.rescue()
    run.write_trajectory(slam.trajectory, slam.atlas)
    summary = tally.summary(
        slam.trajectory,
        slam.closures,
        submaps=run.submap_count,
        gaussians=run.gaussians,
        seconds=time.perf_counter() - started - watching,
        interrupted=interrupted,
    )
    return replace(summary, depth_delay_ms=1e3 * slam.delay.seconds, out_of_memory=exhausted)
