"""A run that is killed goes on where it was, and ends as if nothing had happened."""

import json
import multiprocessing
import random
import shutil
import sys
import time
from multiprocessing.context import ForkServerProcess
from pathlib import Path

import numpy as np
import pytest

from tcgsplat.cli.main import main
from tcgsplat.datasets.synthetic import SynthConfig, synthesize
from tcgsplat.storage.run_directory import RunDirectory

FRAMES, KILLS = 60, 20
SETTINGS = ["--schedule.map-every", "4", "--schedule.submap-distance", "0.25", "--schedule.submap-angle", "12"]


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("resume") / "walk"
    synthesize(folder, SynthConfig(FRAMES * 8, 160, 120))
    return folder


def begun(walk: Path, out: Path) -> ForkServerProcess:
    """`tcgsplat run ... --resume` in a process of its own, which has imported what it needs before."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["tcgsplat.cli.recorder"])
    arguments = ["run", str(walk), "--out", str(out), "--limit", str(FRAMES), *SETTINGS, "--resume"]
    process = context.Process(target=ended, args=(arguments,))
    process.start()
    return process


def ended(arguments: list[str]) -> None:
    sys.exit(main(arguments))


def contents(out: Path) -> dict[str, bytes]:
    """What a run is about: path, state and submaps, byte by byte."""
    names = ["trajectory.txt", "checkpoint.npz", *(f"submaps/{path.name}" for path in (out / "submaps").iterdir())]
    return {name: arrays(out / name) for name in names}


def arrays(path: Path) -> bytes:
    if path.suffix != ".npz":
        return path.read_bytes()
    with np.load(path, allow_pickle=False) as archive:
        return b"".join(name.encode() + archive[name].tobytes() for name in sorted(archive.files))


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_run_killed_twenty_times_ends_as_one_that_was_not(walk: Path, tmp_path: Path) -> None:
    """SIGKILL at random moments, from before the first frame to after the last submap."""
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    for out in (tmp_path / "warm", whole):  # kernels are compiled in the first one
        started = time.perf_counter()
        begun(walk, out).join()
        seconds = time.perf_counter() - started
    expected = contents(whole)
    assert any(edge.loop for edge in RunDirectory.open(whole).checkpoint().edges), "nothing would be closed twice"
    chance, kills, resumed = random.Random(0), 0, 0
    while True:
        process = begun(walk, killed)
        process.join(chance.uniform(0.1, 0.8) * seconds if kills < KILLS else None)
        kills += process.exitcode is None
        process.kill()
        process.join()
        assert process.exitcode in (0, -9)
        if (killed / "summary.json").exists():
            assert contents(killed) == expected
            summary = json.loads((killed / "summary.json").read_text())
            assert summary["frames"] == FRAMES
            resumed += summary["resumed_at"] is not None
            if kills >= KILLS:
                break
            shutil.rmtree(killed)
    assert resumed, "no run was killed between two submaps"
