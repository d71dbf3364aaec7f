"""`tcgsplat bench ablation`: the rows of Table 6, resumed, compared, and written down."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from analytic_room import Room, walk

from tcgsplat.cli.bench import ablation
from tcgsplat.cli.bench.ablation import ROWS, Results, Run
from tcgsplat.cli.main import main
from tcgsplat.config import SlamConfig, settings, with_settings
from tcgsplat.datasets.synthetic.raster import View
from tcgsplat.datasets.synthetic.writer import sequence_files
from tcgsplat.errors import ArchiveError
from tcgsplat.geometry.camera import Camera
from tcgsplat.presets import preset

QUICK = ["--limit", "6", "--mapper.iterations", "3", "--mapper.first-iterations", "5", "--schedule.map-every", "2"]
COMMON = {"sequence": "/data/room", "mapper.iterations": "10"}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Eight frames of the analytic room."""
    root, poses, seconds = tmp_path / "room", walk(8), np.arange(8) / 30
    root.mkdir()
    files = sequence_files(root, "tum", seconds, extras=())
    for index, T_world_cam in enumerate(poses):
        frame = Room().frame(T_world_cam, index, Camera(70.0, 70.0, 39.5, 29.5, 80, 60))
        color = (255 * frame.color.clamp(0, 1)).round().byte().numpy()
        files.write_frame(index, color, frame.depth.double().numpy(), None)
    files.write_index(View(80, 60, 70.0, 39.5, 29.5), seconds, torch.stack(poses).numpy(), np.ones(8, dtype=bool))
    return root


def written(out: Path) -> dict[str, Any]:
    return json.loads((out / "ablation.json").read_text())


def runs(out: Path) -> dict[tuple[str, int], dict[str, Any]]:
    return {(run["method"], run["seed"]): run for run in written(out)["runs"]}


def results(*errors: tuple[str, int, float]) -> Results:
    return Results(COMMON, tuple(Run(method, seed, cm, 600, seed, 17.0) for method, seed, cm in errors))


def test_the_rows_are_those_of_the_paper():
    guided = [tuple(row.switches.values()) for row in ROWS]
    assert guided == [(False, False, False), (True, False, False), (True, True, False), (True, True, True)]
    assert [row.published_cm for row in ROWS] == [14.1, 12.8, 12.1, 10.4]
    default = SlamConfig()
    assert with_settings(default, ROWS[0].switches) == preset("base")
    assert with_settings(default, ROWS[-1].switches) == default
    assert set(ROWS[0].switches) < set(settings(default))


def test_the_table_by_hand():
    some = results(*[(row.method, seed, cm + 1) for row in ROWS for seed, cm in ((3, 0.0), (4, 1.0), (5, 2.0))])
    lines = ablation.table(some, range(3, 6)).splitlines()
    assert lines[1].split() == ["I", "-", "-", "-", "2.000", "1.000", "1.000", "3.000", "12", "14.1"]
    assert lines[4].split() == ["IV", "yes", "yes", "yes", "2.000", "1.000", "1.000", "3.000", "12", "10.4"]
    assert len({len(line) for line in lines}) == 1
    page = ablation.markdown(some, range(3, 6)).splitlines()
    assert page[3] == "| II | yes | - | - | 2.000 | 1.000 | 1.000 | 3.000 | 12 | 12.8 |"
    assert {line.count("|") for line in page} == {11}


def test_only_the_seeds_asked_for_count_and_one_has_no_spread():
    some = results(*[(row.method, seed, 1.0 + seed) for row in ROWS for seed in range(3)])
    assert ablation.table(some, range(1, 2)).splitlines()[1].split()[4:8] == ["2.000", "-", "2.000", "2.000"]


def test_finished_runs_are_read_back(tmp_path: Path):
    path = tmp_path / "ablation.json"
    assert Results.begun(path, COMMON) == Results(COMMON)
    some = results(("I", 0, 1.25), ("IV", 2, 0.1))
    some.write(path)
    assert Results.begun(path, COMMON) == some


def test_runs_of_something_else_are_not_mixed_in(tmp_path: Path):
    path = tmp_path / "ablation.json"
    results(("I", 0, 1.25)).write(path)
    with pytest.raises(ArchiveError, match=r"with mapper.iterations 10, now 20; give another folder by --out"):
        Results.begun(path, COMMON | {"mapper.iterations": "20"})
    with pytest.raises(ArchiveError, match=r"loop.new unset, now true"):
        Results.begun(path, COMMON | {"loop.new": "true"})
    with pytest.raises(ArchiveError, match="and 3 more; give"):
        Results.begun(path, COMMON | {str(k): "1" for k in range(8)})


@pytest.mark.parametrize("text", ["{", "[]", '{"common": {}}', '{"common": {}, "runs": [{"seed": 1}]}'])
def test_a_file_that_is_none_of_ours_is_named(tmp_path: Path, text: str):
    (tmp_path / "ablation.json").write_text(text)
    with pytest.raises(ArchiveError, match=r"cannot read .*ablation\.json .*; remove it, or give another folder"):
        Results.begun(tmp_path / "ablation.json", COMMON)


def test_every_row_is_run_and_what_is_there_is_not_run_again(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    out = tmp_path / "out"
    ask = ["bench", "ablation", str(folder), "--out", str(out), *QUICK]
    assert main([*ask, "--seeds", "1", "--seed", "7"]) == 0
    first = runs(out)
    assert list(first) == [("I", 7), ("II", 7), ("III", 7), ("IV", 7)]
    assert all(0 < run["ate_rmse_cm"] < 3 and (run["frames"], run["frames_lost"]) == (6, 0) for run in first.values())
    assert len({run["ate_rmse_cm"] for run in first.values()}) >= 3, "confidence guided nothing"
    said = capsys.readouterr().out
    assert f"{first['IV', 7]['ate_rmse_cm']:.3f}" in said
    assert said.startswith("room, 6 frames; ")
    assert "mapper.iterations = 3" in said

    known = written(out)
    known["runs"] = known["runs"][:2]  # as after an interruption
    known["runs"][0]["ate_rmse_cm"] = 77.0
    (out / "ablation.json").write_text(json.dumps(known))
    assert main([*ask, "--seeds", "2", "--seed", "7"]) == 0
    again = runs(out)
    assert sorted(again) == sorted((row.method, seed) for row in ROWS for seed in (7, 8))
    assert again["I", 7]["ate_rmse_cm"] == 77.0, "run again although it was there"
    for method in ("III", "IV"):
        assert again[method, 7]["ate_rmse_cm"] == first[method, 7]["ate_rmse_cm"], "a run repeats to the bit"
    page = (out / "ablation.md").read_text()
    mean = (77.0 + again["I", 8]["ate_rmse_cm"]) / 2
    assert f"| I | - | - | - | {mean:.3f} | " in page
    assert page.startswith("# Ablation: room, 6 frames; ")

    before = (out / "ablation.json").read_bytes()
    capsys.readouterr()
    assert main([*ask, "--mapper.iterations", "4"]) == 1
    assert "mapper.iterations 3, now 4; give another folder by --out" in capsys.readouterr().err
    assert main([*ask[:5], "--limit", "5"]) == 1
    assert "limit 6, now 5; " in capsys.readouterr().err
    assert (out / "ablation.json").read_bytes() == before


def test_without_truth_nothing_is_run(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (folder / "groundtruth.txt").unlink()
    assert main(["bench", "ablation", str(folder), "--out", str(tmp_path / "out"), *QUICK]) == 1
    said = capsys.readouterr().err
    assert f"{folder} has true poses for 0 of 6 frames" in said
    assert said.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (
            ["--confidence.guide-mapping", "false"],
            "--confidence.guide_mapping is what the rows differ in; leave it out",
        ),
        (["--seeds", "0"], "--seeds is 0; give at least 1"),
    ],
)
def test_what_makes_no_sense_is_refused(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], flags: list[str], said: str
):
    assert main(["bench", "ablation", str(folder), "--out", str(tmp_path / "out"), *flags]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_an_interruption_says_what_is_kept(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    real, calls = ablation.measured, []

    def second_is_interrupted(*args: Any) -> Any:
        calls.append(1)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return real(*args)

    monkeypatch.setattr(ablation, "measured", second_is_interrupted)
    out = tmp_path / "out"
    assert main(["bench", "ablation", str(folder), "--out", str(out), *QUICK]) == 130
    assert f"interrupted; 1 of 12 runs are kept in {out / 'ablation.json'}" in capsys.readouterr().err
    assert list(runs(out)) == [("I", 0)]
