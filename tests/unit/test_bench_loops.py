"""`tcgsplat bench loops`: a finished run's submaps are compared again, and timed."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from analytic_room import pose
from patterned_room import CAMERA, PatternedRoom

from tcgsplat.cli.bench.loops import Line, replayed, table
from tcgsplat.cli.main import main
from tcgsplat.datasets.synthetic.raster import View
from tcgsplat.datasets.synthetic.writer import sequence_files
from tcgsplat.loop.closer import Closure
from tcgsplat.loop.registration import Registration
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.storage.run_directory import RunDirectory

FRAMES, SUBMAPS = 10, 5
QUICK = ["--schedule.submap_by", "interval", "--schedule.submap-interval", "2", "--mapper.iterations", "10"]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """To and fro in a small room: five submaps that all see the same."""
    folder = tmp_path_factory.mktemp("loops")
    root, seconds = folder / "room", np.arange(FRAMES) / 30
    camera = (CAMERA.width, CAMERA.height, CAMERA.fx, CAMERA.cx, CAMERA.cy)
    poses = [pose(0.03 * i, 0.01 * i, degrees=(0.0, -2.0 * i, 0.0)) for i in (0, 1, 2, 3, 4, 3, 2, 1, 0, -1)]
    root.mkdir()
    files = sequence_files(root, "tum", seconds, extras=())
    for index, T_world_cam in enumerate(poses):
        frame = PatternedRoom().frame(T_world_cam, index, CAMERA)
        files.write_frame(
            index, (255 * frame.color.clamp(0, 1)).round().byte().numpy(), frame.depth.double().numpy(), None
        )
    files.write_index(View(*camera), seconds, torch.stack(poses).numpy(), np.ones(FRAMES, dtype=bool))
    assert main(["run", str(root), "--out", str(folder / "run"), *QUICK]) == 0
    return folder / "run"


def test_the_table_is_printed_and_written(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    before = {file: file.read_bytes() for file in run.rglob("*") if file.is_file()}
    assert main(["bench", "loops", str(run), "--json", str(tmp_path / "times.json")]) == 0
    said = capsys.readouterr()
    head, row, machine = said.out.splitlines()
    assert said.err == "" and head.split() == ["submaps", "closure", "ms", "pairs", "compared"]
    written = json.loads((tmp_path / "times.json").read_text())
    (line,) = written["lines"]
    assert line["submaps"] == SUBMAPS and line["ms"] > 0
    assert 0.5 < line["registered"] <= SUBMAPS
    assert row.split() == [str(SUBMAPS), f"{line['ms']:.0f}", f"{line['registered']:.1f}"]
    assert re.search(r"\d cores?$", machine) and written["machine"] == machine
    assert {"tcgsplat", "python"} <= written["versions"].keys()
    assert before == {file: file.read_bytes() for file in run.rglob("*") if file.is_file()}


def test_what_the_run_found_is_found_again(run: Path, rasterizer: Rasterizer):
    closures = replayed(RunDirectory.open(run), rasterizer)
    assert len(closures) == SUBMAPS
    assert closures[0].registrations == ()
    then = json.loads((run / "summary.json").read_text())
    loops = [edge for edge in closures[-1].edges if edge.loop]
    assert loops and len(loops) == then["loops"] + then["loops_rejected"]
    known = [edge for edge in RunDirectory.open(run).checkpoint().edges if edge.loop]
    again = {(edge.source, edge.target): edge for edge in loops}
    assert known
    for edge in known:
        assert torch.equal(again[edge.source, edge.target].T_target_source, edge.T_target_source)


def test_one_submap_has_no_loops(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out = tmp_path / "short"
    room = json.loads((run / "run.json").read_text())["sequence"]
    assert main(["run", room, "--limit", "2", "--out", str(out), *QUICK]) == 0
    capsys.readouterr()
    assert main(["bench", "loops", str(out)]) == 1
    assert capsys.readouterr().err == f"tcgsplat: {out} has fewer than two submaps and no loops; give a longer run\n"


def test_what_is_no_run_or_incomplete_is_told(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["bench", "loops", str(tmp_path)]) == 1
    assert "is not a run; give the folder that `tcgsplat run` wrote" in capsys.readouterr().err
    poor = Path(shutil.copytree(run, tmp_path / "poor"))
    (poor / "submaps" / "0001.npz").unlink()
    assert main(["bench", "loops", str(poor)]) == 1
    assert f"{poor} has lost submap 1 of 5; run again with --overwrite" in capsys.readouterr().err
    assert main(["bench", "loops", str(run), "--mapper.iterations", "3"]) == 2
    assert "this bench has no settings, but --mapper.iterations was given" in capsys.readouterr().err


def closure(seconds: float, pairs: int) -> Closure:
    failed = tuple(Registration(7, other, "nothing in common") for other in range(pairs))
    return Closure(7, registrations=failed, seconds=seconds)


def test_a_line_is_the_mean_of_the_last_five():
    closures = [closure(seconds, pairs) for seconds, pairs in ((9, 9), (1, 0), (2, 1), (3, 2), (4, 3), (5, 4), (8, 8))]
    assert Line.at(6, closures) == Line(6, 3000.0, 2.0)
    assert Line.at(2, closures) == Line(2, 5000.0, 4.5)
    assert table([Line(10, 123.4, 3.96), Line(160, 1.6, 0.0)]).splitlines() == [
        " submaps  closure ms  pairs compared",
        "      10         123             4.0",
        "     160           2             0.0",
    ]
