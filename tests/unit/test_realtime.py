"""What a run in real time tells: in the progress line, in its summary, in its one line at the end."""

import sys
from dataclasses import replace

import pytest
from analytic_room import Room
from test_cli import report

from tcgsplat.cli import summary
from tcgsplat.cli.progress import RunProgress
from tcgsplat.datasets.playback import Arrival
from tcgsplat.geometry import se3
from tcgsplat.scene.trajectory import TrackedPose, Trajectory
from tcgsplat.slam import MapUpdate

PATH = Trajectory(tuple(TrackedPose(i, i / 30, 0, se3.identity()) for i in range(3)))


def test_dropped_frames_are_in_the_progress_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", "120")
    with RunProgress(20) as progress:
        progress.observe(report(0))
        for index in (3, 5):
            progress.observe(report(index), dropped=2)
        progress._bar.refresh()
    said = capsys.readouterr().err
    assert "frame 6/20" in said and "4 dropped" in said
    assert "0 dropped" not in said


def test_a_summary_in_real_time_tells_how_far_behind_it_was():
    tally = summary.Tally()
    arrivals = [(0, 100.0, 0.0), (2, 100.1, 0.25), (1, 100.2, 0.5)]  # dropped, captured, held
    for index, (dropped, captured, held) in enumerate(arrivals):
        tally.follow(Arrival(Room().frame(), captured, dropped, 0.0, held), captured + 0.02 * (index + 1))
        tally.count(report(index), 0.02)
    path = Trajectory(tuple(TrackedPose(i, i / 30, 0, se3.identity()) for i in (0, 3, 5)))
    ended = tally.summary(path, (), submaps=1, gaussians=30, seconds=0.25, interrupted=False)
    result = replace(ended, realtime=True)
    assert (result.frames, result.frames_dropped, result.frames_total) == (3, 3, 6)
    assert (result.ms_late_median, result.ms_late_p95) == pytest.approx((40.0, 58.0))
    assert result.seconds_held == 0.75
    assert str(result) == f"{ended}; 3 of 6 frames dropped (50.0 %), 40 ms late"
    assert "dropped" not in str(ended)


def test_an_ordinary_summary_has_no_delay():
    tally = summary.Tally()
    tally.follow(Arrival(Room().frame()), 5.0)
    tally.count(report(0), 0.02)
    told = tally.summary(PATH, (), submaps=1, gaussians=30, seconds=0.25, interrupted=False).to_dict()
    expected = {"realtime": False, "frames_dropped": 0, "frames_total": 3, "ms_late_median": None, "ms_late_p95": None}
    assert expected.items() <= told.items()


def test_mapping_updates_are_timed_apart_from_the_frames():
    tally = summary.Tally()
    for index, ms in enumerate([None, 30.0, None, 50.0]):
        update = None if ms is None else MapUpdate(index, 1, 1, 0.1, ms / 1000)
        tally.count(replace(report(index), update=update), 0.02)
    assert tally.summary(PATH, (), submaps=1, gaussians=30, seconds=0.25, interrupted=False).ms_update == pytest.approx(
        40.0
    )


def test_a_camera_that_gave_nothing_has_a_summary_too():
    result = summary.Tally().summary(Trajectory(), (), submaps=0, gaussians=0, seconds=0.1, interrupted=True)
    assert str(replace(result, realtime=True)).endswith("; 0 of 0 frames dropped (0.0 %)")
