"""Playback at the pace of time stamps: which frames come, when, and what happens to the others."""

import logging
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, field
from itertools import accumulate
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from test_datasets import DAMAGE, LAYOUTS, every_layout, the_files, write_replica, write_tum

from tcgsplat.datasets import open_sequence
from tcgsplat.datasets.playback import DECODED_AHEAD, LONG_WAIT, Arrival, Clock, in_turn, paced, play
from tcgsplat.geometry.camera import Camera
from tcgsplat.scene.frame import Frame

CAMERA = Camera(fx=1.0, fy=1.0, cx=0.0, cy=0.0, width=1, height=1)
PIXEL = torch.ones(1, 1)
WAKING = 1e-6  # seconds by which a sleep is always too long


def frame(index: int, timestamp: float) -> Frame:
    return Frame(index, timestamp, PIXEL[..., None].expand(1, 1, 3), PIXEL, PIXEL.bool(), CAMERA)


def frames(*timestamps: float) -> Iterator[Frame]:
    return iter([frame(index, timestamp) for index, timestamp in enumerate(timestamps)])


@dataclass
class Simulated:
    """Time that passes only where somebody sleeps or works."""

    seconds: float = 1000.0
    sleeps: list[float] = field(default_factory=list)

    @property
    def clock(self) -> Clock:
        return Clock(lambda: self.seconds, self.sleep)

    def sleep(self, seconds: float) -> None:
        self.sleeps.append(seconds)
        self.seconds += seconds + WAKING


def watched(source: Iterator[Frame], work: float | list[float], time: Simulated) -> list[tuple[float, Arrival]]:
    """Each frame that came and when, seconds after the first, to somebody who works on each for so long."""
    seen = []
    durations = iter(work) if isinstance(work, list) else None
    for arrival in paced(source, time.clock):
        seen.append((time.seconds - 1000.0, arrival))
        time.seconds += next(durations, 0.0) if durations else work
    return seen


def indices(seen: list[tuple[float, Arrival]]) -> list[int]:
    return [arrival.frame.index for _, arrival in seen]


def test_who_is_fast_enough_gets_every_frame_at_its_time():
    seen = watched(frames(50.0, 50.1, 50.2, 50.3), 0.09, Simulated())
    assert indices(seen) == [0, 1, 2, 3]
    assert [when for when, _ in seen] == pytest.approx([0.0, 0.1, 0.2, 0.3], abs=1e-5)
    assert [arrival.captured for _, arrival in seen] == pytest.approx([1000.0, 1000.1, 1000.2, 1000.3])
    assert [arrival.waited for _, arrival in seen] == pytest.approx([0.0, 0.01, 0.01, 0.01], abs=1e-5)
    assert {arrival.dropped for _, arrival in seen} == {0}
    assert {arrival.held for _, arrival in seen} == {0.0}


def test_who_is_busy_gets_the_newest_frame_and_is_told_how_many_it_replaced():
    # Captured at 0, 1, 2 ... 7 s; busy for 2.5 s each time: free at 2.5, 5, 7.5.
    seen = watched(frames(*range(8)), 2.5, Simulated())
    assert indices(seen) == [0, 2, 5, 7]
    assert [when for when, _ in seen] == [0.0, 2.5, 5.0, 7.5]
    assert [arrival.dropped for _, arrival in seen] == [0, 1, 2, 1]
    assert [arrival.captured for _, arrival in seen] == [1000.0, 1002.0, 1005.0, 1007.0]


def test_the_last_frame_comes_however_late():
    seen = watched(frames(0.0, 0.1, 0.2, 0.3), 60.0, Simulated())
    assert indices(seen) == [0, 3]
    assert seen[-1][1].dropped == 2
    assert indices(watched(frames(4.0), 60.0, Simulated())) == [0]
    assert watched(frames(), 60.0, Simulated()) == []


def test_gaps_are_waited_for(caplog: pytest.LogCaptureFixture):
    time = Simulated()
    seen = watched(frames(0.0, 5.0, 5.1), 0.01, time)
    assert [when for when, _ in seen] == pytest.approx([0.0, 5.0, 5.1], abs=1e-5)
    assert caplog.records == []


def test_a_long_gap_is_waited_for_and_told(caplog: pytest.LogCaptureFixture):
    time = Simulated()
    seen = watched(frames(0.0, 0.1, 3600.1), 0.01, time)
    assert [when for when, _ in seen] == pytest.approx([0.0, 0.1, 3600.1], abs=1e-2)
    assert max(time.sleeps) == LONG_WAIT
    (record,) = caplog.records
    assert record.levelno == logging.WARNING
    assert record.message == "frame 2 comes 3600 s after the one before: waiting"


def test_time_stamps_that_go_back_or_stand_still_count_as_the_same_moment():
    seen = watched(frames(0.0, 1.0, 0.5, 1.0, 1.5), 0.1, Simulated())
    assert indices(seen) == [0, 3, 4]
    assert [when for when, _ in seen] == pytest.approx([0.0, 1.0, 1.5], abs=1e-5)
    assert [arrival.dropped for _, arrival in seen] == [0, 2, 0]
    assert indices(watched(frames(7.0, 7.0, 7.0), 0.1, Simulated())) == [2]
    assert indices(watched(frames(3.0, 2.0, 1.0), 0.1, Simulated())) == [2]


def test_reading_that_is_slow_stops_the_clock_instead_of_dropping_frames():
    time = Simulated()

    def slowly() -> Iterator[Frame]:
        for index in range(6):
            time.seconds += 3.0
            yield frame(index, 0.1 * index)

    quick = watched(frames(*(0.1 * index for index in range(6))), 0.25, Simulated())
    slow = watched(slowly(), 0.25, time)
    assert indices(slow) == indices(quick) == [0, 2, 5]
    assert [arrival.dropped for _, arrival in slow] == [arrival.dropped for _, arrival in quick]
    assert sum(arrival.held for _, arrival in slow) == pytest.approx(5 * 3.0)  # all but the first, before the clock
    for (when, arrival), (quick_when, quick_arrival) in zip(slow, quick, strict=True):
        late, quick_late = (1000.0 + when) - arrival.captured, (1000.0 + quick_when) - quick_arrival.captured
        assert late == pytest.approx(quick_late, abs=1e-5)
        assert arrival.waited >= arrival.held


def test_a_sleep_that_is_interrupted_ends_the_playback():
    time = Simulated()
    stop = threading.Event()
    seen = []
    for arrival in paced(frames(0.0, 1.0, 1e12), Clock(lambda: time.seconds, lambda s: time.sleep(s) or stop.is_set())):
        seen.append(arrival.frame.index)
        if arrival.frame.index == 1:
            stop.set()
    assert seen == [0, 1]


@given(
    steps=st.lists(st.floats(-0.5, 2.0), max_size=30),
    work=st.lists(st.floats(0.0, 5.0), max_size=30),
    first=st.floats(-1e9, 2e9),
)
def test_a_queue_of_one(steps: list[float], work: list[float], first: float):
    """Whatever the time stamps and however long each frame keeps us busy, it is a queue of one with the newest in."""
    stamps = [first, *accumulate(steps, initial=first)][1:]
    seen = watched(frames(*stamps), work, Simulated())
    due = [max(stamps[: index + 1]) - stamps[0] for index in range(len(stamps))]

    assert indices(seen) == sorted(set(indices(seen)))
    assert indices(seen)[-1] == len(stamps) - 1
    assert sum(arrival.dropped + 1 for _, arrival in seen) == len(stamps)
    free = 0.0
    for (when, arrival), busy in zip(seen, work + [0.0] * len(seen), strict=False):
        index = arrival.frame.index
        assert due[index] <= when + 1e-9
        assert when <= max(free, due[index]) + 1e-4  # nobody is kept waiting
        assert index == len(due) - 1 or due[index + 1] > when - 1e-9  # there is none newer
        assert arrival.captured == pytest.approx(1000.0 + due[index])
        free = when + busy


def test_in_turn_means_all_of_them_at_once():
    assert list(in_turn([one := frame(0, 0.0), two := frame(1, 99.0)])) == [Arrival(one), Arrival(two)]


# On real files, and on the real clock.


def reading_threads() -> list[str]:
    return [t.name for t in threading.enumerate() if t.name.startswith(("playback", "read-ahead"))]


def test_a_second_of_camera_for_somebody_slow(tmp_path: Path):
    sequence = open_sequence(write_tum(tmp_path, frames=31))
    seen: list[tuple[float, Arrival]] = []
    for arrival in play(sequence, Clock()):
        seen.append((time.perf_counter(), arrival))
        time.sleep(0.1)
    assert indices(seen) == sorted(set(indices(seen)))
    assert indices(seen)[-1] == 30
    assert len(seen) + sum(arrival.dropped for _, arrival in seen) == 31
    start = seen[0][1].captured
    for when, arrival in seen:
        assert arrival.captured - start >= arrival.frame.timestamp - 100.0 - 1e-3
        assert when - arrival.captured >= 0
    # One every 100 ms at most, and the last; fewer where a loaded machine is late to wake us up.
    assert 4 <= len(seen) <= 12
    assert seen[-1][0] - start >= 1.0 - 1e-3
    assert reading_threads() == []


def test_nothing_is_lost_on_somebody_quick(tmp_path: Path):
    sequence = open_sequence(write_tum(tmp_path, frames=6))
    seen = [(time.perf_counter(), arrival) for arrival in play(sequence, Clock())]
    assert indices(seen) == list(range(6))
    assert seen[-1][0] - seen[0][1].captured >= 5 / 30 - 1e-3
    for _, arrival in seen:
        assert torch.equal(arrival.frame.color, sequence.frame(arrival.frame.index).color)


@every_layout
def test_every_layout_plays_with_the_warnings_of_ordinary_reading(
    tmp_path: Path, layout: str, caplog: pytest.LogCaptureFixture
):
    root = LAYOUTS[layout](tmp_path)
    the_files(root, "color")[1].write_bytes(DAMAGE)
    sequence = open_sequence(root)
    assert [arrival.frame.index for arrival in in_turn(sequence)] == [0, 2, 3]
    ordinary = [record.getMessage() for record in caplog.records]
    caplog.clear()
    time = Simulated()
    played = list(play(sequence, time.clock))
    assert [arrival.frame.index for arrival in played] == [0, 2, 3]
    assert {arrival.dropped for arrival in played} == {0}
    assert [record.getMessage() for record in caplog.records] == ordinary
    assert len(ordinary) == 1 and "a frame is skipped" in ordinary[0]


def test_chosen_frames_keep_their_own_times(tmp_path: Path):
    time = Simulated()
    sequence = open_sequence(write_replica(tmp_path, frames=10), start=1, stride=3)
    played = list(play(sequence, time.clock))
    captured = [arrival.captured - 1000.0 for arrival in played]
    assert captured == pytest.approx([0.0, 0.1, 0.2], abs=1e-6)


def test_no_more_than_a_few_frames_are_decoded_ahead():
    read: list[int] = []

    def endless() -> Iterator[Frame]:
        for index in range(10_000):
            read.append(index)
            yield frame(index, index / 30)

    with closing(play(endless(), Simulated().clock)) as arrivals:
        for index in range(4):
            assert next(arrivals).frame.index == index
            assert len(read) <= index + 1 + DECODED_AHEAD + 1
    assert len(read) <= 4 + DECODED_AHEAD + 1
    assert reading_threads() == []


def test_closing_early_stops_the_reader_and_the_source(tmp_path: Path):
    closed = threading.Event()

    def source() -> Iterator[Frame]:
        try:
            yield from open_sequence(write_tum(tmp_path, frames=30))
        finally:
            closed.set()

    arrivals = play(source(), Clock())
    next(arrivals)
    assert len(reading_threads()) >= 1
    arrivals.close()
    assert closed.is_set()
    assert reading_threads() == []


def test_an_error_while_reading_comes_through():
    def broken() -> Iterator[Frame]:
        yield frame(0, 0.0)
        raise MemoryError("too large")

    with pytest.raises(MemoryError, match="too large"):
        list(play(broken(), Simulated().clock))
    assert reading_threads() == []
