"""A recorded sequence at the pace of its time stamps: what the system would have got from the camera, live.

A live camera's driver keeps one frame, the newest; whoever is busy when the next one comes never sees the one before.
`paced` imitates this on any clock, so that it can be tested on one that is a number; `play` adds a thread that decodes
ahead, since a camera hands over images, not files.
"""

import logging
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass

from tcgsplat.scene.frame import Frame

logger = logging.getLogger(__name__)

DECODED_AHEAD = 8
"""Frames that are decoded before they are asked for: a quarter of a second at 30 Hz, 40 MB at 640x480."""
LONG_WAIT = 10.0
"""Seconds without a frame that a person who watches would wonder about; also the longest single sleep."""


@dataclass(frozen=True)
class Clock:
    """What a playback goes by."""

    now: Callable[[], float] = time.perf_counter
    """Seconds since any fixed moment; never goes back."""
    sleep: Callable[[float], object] = time.sleep
    """Waits so many seconds. An answer that is true ends the playback: `threading.Event.wait` can be given here."""


@dataclass(frozen=True)
class Arrival:
    """A frame as it is handed over."""

    frame: Frame
    captured: float | None = None
    """Reading of the clock at its capture, s; None where frames do not come by their time stamps."""
    dropped: int = 0
    """Frames captured since the one before that this one replaced."""
    waited: float = 0.0
    """Seconds from being asked for a frame until there was this one: time in which nobody was busy with a frame."""
    held: float = 0.0
    """Seconds of these in which the playback stood still, because an image was not decoded yet."""


def in_turn(frames: Iterable[Frame]) -> Generator[Arrival, None, None]:
    """Every frame, as soon as it is asked for."""
    yield from map(Arrival, frames)


def play(frames: Iterable[Frame], clock: Clock) -> Generator[Arrival, None, None]:
    """Frames at the pace of their time stamps (see `paced`), decoded ahead in a thread, which ends with the iterator.

    Args:
        frames: In order of time; reading one may take long.
        clock: The machine's own, but for how it sleeps.
    """
    with closing(_decoded_ahead(frames)) as decoded:
        yield from paced(decoded, clock)


def paced(frames: Iterator[Frame], clock: Clock) -> Generator[Arrival, None, None]:
    """The newest frame captured so far, or the next one as soon as it is captured; those in between are dropped.

    The clock starts with the first frame. The last frame always comes. A time stamp before that of an earlier frame
    counts as the same moment. While `frames` has to be waited for, the playback stands still: slow reading drops no
    frame, makes none late, and is told in `Arrival.held`.

    Args:
        frames: In order of time.
        clock: What the playback goes by.
    """
    asked = clock.now()
    upcoming = next(frames, None)
    if upcoming is None:
        return
    first, start = upcoming.timestamp, clock.now()
    captured = due = 0.0  # seconds after the start: of the newest frame, and of `upcoming`
    while upcoming is not None:
        if due - (clock.now() - start) > LONG_WAIT:
            logger.warning("frame %d comes %.0f s after the one before: waiting", upcoming.index, due - captured)
        while (early := due - (clock.now() - start)) > 0:
            if clock.sleep(min(early, LONG_WAIT)):
                return
        played, dropped, held = clock.now() - start, -1, 0.0
        while upcoming is not None and due <= played:
            newest, captured, dropped = upcoming, due, dropped + 1
            reading = clock.now()
            upcoming = next(frames, None)
            held += clock.now() - reading
            due = due if upcoming is None else max(due, upcoming.timestamp - first)
        start += held
        yield Arrival(newest, start + captured, dropped, clock.now() - asked, held)
        asked = clock.now()


def _decoded_ahead(frames: Iterable[Frame]) -> Generator[Frame, None, None]:
    """The same frames, read in a thread; it has ended when the iterator is closed."""
    source = iter(frames)
    reader = ThreadPoolExecutor(max_workers=1, thread_name_prefix="playback")
    try:
        ahead: deque[Future[Frame | None]] = deque(reader.submit(next, source, None) for _ in range(DECODED_AHEAD))
        while (frame := ahead.popleft().result()) is not None:
            ahead.append(reader.submit(next, source, None))
            yield frame
    finally:
        reader.shutdown(cancel_futures=True)
        if isinstance(source, Generator):
            source.close()
