"""Progress of a run on a terminal, as an observer of its reports; silent in a pipe."""

import logging
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from tcgsplat.slam import StepReport

logger = logging.getLogger(__name__)

WINDOW = 30
"""Frames that the shown frame rate is an average of."""


class RunProgress:
    """One live line on standard error, if that is a terminal: frame, rate, submap, Gaussians, frames lost, time left.

    Where tracking was lost and found again is logged as a warning.
    """

    def __init__(self, frames: int) -> None:
        console = Console(stderr=True)
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=12),
            TextColumn("{task.fields[state]}"),
            TimeRemainingColumn(compact=True),
            TextColumn("left"),
            console=console,
            disable=not console.is_terminal,
            transient=True,
        )
        self._task = self._bar.add_task(f"frame 0/{frames}", total=frames, state="")
        self._frames = frames
        self._times = deque([time.perf_counter()], maxlen=WINDOW + 1)
        self._lost = 0
        self._dropped = 0
        self._lost_since: int | None = None

    def __enter__(self) -> "RunProgress":
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()

    def observe(self, report: StepReport, dropped: int = 0) -> None:
        """Show what one more frame did, and how many were dropped before it."""
        self._warn(report)
        self._dropped += dropped
        self._times.append(time.perf_counter())
        rate = (len(self._times) - 1) / (self._times[-1] - self._times[0])
        missed = {"lost": self._lost, "dropped": self._dropped}
        counts = "".join(f"  {count} {what}" for what, count in missed.items() if count)
        self._bar.update(
            self._task,
            completed=report.frame_index + 1,
            description=f"frame {report.frame_index + 1}/{self._frames}",
            state=f"{rate:.1f} fps  submap {report.submap_index}  {report.gaussians} Gaussians{counts} ",
        )

    def _warn(self, report: StepReport) -> None:
        """One line when tracking is lost, one when it is found again; not one for every frame between."""
        if not report.tracked.converged:
            self._lost += 1
            if self._lost_since is None:
                self._lost_since = report.frame_index
                logger.warning("tracking is lost at frame %d: %s", report.frame_index, report.tracked.lost)
        elif self._lost_since is not None:
            logger.warning("tracking is found again at frame %d", report.frame_index)
            self._lost_since = None


@contextmanager
def counting(what: str) -> Iterator[Callable[[int, int], None]]:
    """A function of (done, of how many) that shows a live line on standard error, if that is a terminal."""
    console = Console(stderr=True)
    with Progress(console=console, disable=not console.is_terminal, transient=True) as bar:
        task = bar.add_task(what)
        yield lambda done, total: bar.update(task, completed=done, total=total, description=f"{what} {done}/{total}")
