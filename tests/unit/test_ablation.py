"""`tcgsplat bench ablation`: the rows of Table 6 and controls, resumed, compared, and written down."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from analytic_room import Room, walk

from tcgsplat.cli.bench import ablation
from tcgsplat.cli.bench.ablation import Results, Run, differences
from tcgsplat.cli.bench.arms import ARMS, OracleMapper, faulty
from tcgsplat.cli.main import main
from tcgsplat.config import SlamConfig, settings
from tcgsplat.datasets.synthetic.raster import View
from tcgsplat.datasets.synthetic.writer import sequence_files
from tcgsplat.datasets.truth import Truth
from tcgsplat.errors import ArchiveError
from tcgsplat.geometry.camera import Camera
from tcgsplat.mapping.seeding import IdSource
from tcgsplat.presets import preset
from tcgsplat.render.protocol import Rasterizer

QUICK = ["--limit", "6", "--mapper.iterations", "3", "--mapper.first-iterations", "5", "--schedule.map-every", "2"]
COMMON = {"limit": "6", "mapper.iterations": "10"}
TABLE = ("--arms", "I", "II", "III", "IV")


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
    return {(run["arm"], run["seed"]): run for run in written(out)["runs"]}


def some_runs(*errors: tuple[str, str, int, float]) -> tuple[Run, ...]:
    return tuple(Run(arm, name, seed, cm, 20 + cm, 600, seed, 17.0) for arm, name, seed, cm in errors)


def results(*errors: tuple[str, int, float]) -> Results:
    return Results(COMMON, some_runs(*((arm, "/data/room", seed, cm) for arm, seed, cm in errors)))


def test_the_first_rows_are_those_of_the_paper():
    guided = [tuple(arm.switches.values()) for arm in ARMS[:4]]
    assert guided == [(False, False, False), (True, False, False), (True, True, False), (True, True, True)]
    assert [arm.published_cm for arm in ARMS[:4]] == [14.1, 12.8, 12.1, 10.4]
    default = SlamConfig()
    assert ARMS[0].config(default, default.seed) == preset("base")
    assert ARMS[3].config(default, default.seed) == default
    assert set(ARMS[0].switches) < set(settings(default))
    assert len({str(arm.config(default, 0)) for arm in ARMS}) == len(ARMS), "two arms are the same"
    assert [arm.name for arm in ARMS if arm.knows] == ["oracle"]


def test_the_table_by_hand():
    some = some_runs(
        *((arm.name, "room", seed, cm + 1) for arm in ARMS[:4] for seed, cm in ((3, 0.0), (4, 1.0), (5, 2.0)))
    )
    page = ablation.written(some, ARMS, {"all": ("room",)}, "a room").splitlines()
    assert "| I | - | - | - | 2.000 ± 1.000 | 2.000 | 22.00 | 12 | 14.1 |" in page
    assert "| IV | yes | yes | yes | 2.000 ± 1.000 | 2.000 | 22.00 | 12 | 10.4 |" in page
    assert "| all | II | mapping only | +0.0 | +0.0 … +0.0 | - | +0.00 | +0.00 … +0.00 | 3 |" in page
    assert not any(line.startswith("| oracle") for line in page), "an arm without a run"


def test_differences_are_percent_of_the_first_arm_and_pair_by_pair():
    pairs = [("I", "a", 0, 1.0), ("I", "a", 1, 2.0), ("IV", "a", 0, 1.1), ("IV", "a", 1, 2.2), ("IV", "b", 0, 9.0)]
    (one,) = differences(some_runs(*pairs), ("a", "b"))
    assert (one.arm, one.pairs, one.left_out) == ("IV", 2, 1)
    assert (one.mean, one.low, one.high) == pytest.approx((10.0, 10.0, 10.0))
    (psnr,) = differences(some_runs(*pairs), ("a",), "psnr")
    assert psnr.mean == pytest.approx(0.15)
    assert differences(some_runs(*pairs[2:]), ("a", "b")) == ()


def test_sequences_with_faults_are_looked_at_apart():
    some = some_runs(*((arm, name, 0, cm) for name, cm in (("fine", 1.0), ("bad", 0.5)) for arm in ("I", "IV")))
    groups = {"all": ("fine", "bad"), "nothing wrong": ("fine",), "with faults": ("bad",)}
    page = ablation.written(some, ARMS, groups, "two").splitlines()
    assert [line.split("|")[1].strip() for line in page if "| IV | all of it" in line] == list(groups)
    assert "| IV | +0.0 | +0.0 |" in page


def test_one_seed_has_no_spread():
    some = some_runs(("I", "room", 1, 2.0))
    assert "| I | - | - | - | 2.000 | 2.000 | 22.00 | 1 | 14.1 |" in ablation.written(
        some, ARMS, {"all": ("room",)}, ""
    )


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
    assert main([*ask, "--seeds", "1", "--seed", "7", *TABLE]) == 0
    first = runs(out)
    assert list(first) == [("I", 7), ("II", 7), ("III", 7), ("IV", 7)]
    assert all(0 < run["ate_rmse_cm"] < 3 and (run["frames"], run["frames_lost"]) == (6, 0) for run in first.values())
    assert len({run["ate_rmse_cm"] for run in first.values()}) >= 3, "confidence guided nothing"
    said = capsys.readouterr().out
    assert f"{first['IV', 7]['ate_rmse_cm']:.3f}" in said
    assert said.startswith("# Ablation: room; ")
    assert "mapper.iterations = 3" in said

    known = written(out)
    known["runs"] = known["runs"][:2]  # as after an interruption
    known["runs"][0]["ate_rmse_cm"] = 77.0
    (out / "ablation.json").write_text(json.dumps(known))
    assert main([*ask, "--seeds", "2", "--seed", "7", *TABLE]) == 0
    again = runs(out)
    assert sorted(again) == sorted((arm.name, seed) for arm in ARMS[:4] for seed in (7, 8))
    assert again["I", 7]["ate_rmse_cm"] == 77.0, "run again although it was there"
    for arm in ("III", "IV"):
        for told in ("ate_rmse_cm", "psnr"):
            assert again[arm, 7][told] == first[arm, 7][told], "a run repeats to the bit"
    assert 10 < again["IV", 8]["psnr"] < 60
    page = (out / "README.md").read_text()
    mean = (77.0 + again["I", 8]["ate_rmse_cm"]) / 2
    assert f"| I | - | - | - | {mean:.3f} ± " in page
    assert "![difference of the path's error](difference.svg)" in page
    assert (out / "difference.svg").read_text().startswith("<?xml")

    before = (out / "ablation.json").read_bytes()
    capsys.readouterr()
    assert main([*ask, "--mapper.iterations", "4"]) == 1
    assert "mapper.iterations 3, now 4; give another folder by --out" in capsys.readouterr().err
    assert main([*ask[:5], "--limit", "5", "--mapper.iterations", "3"]) == 1
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
            "--confidence.guide_mapping is what the arms differ in; leave it out",
        ),
        (["--seeds", "0"], "--seeds is 0; give at least 1"),
        (["--arms", "V"], "--arms: there is no V; choose from I, II, "),
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
    real, calls = ablation.walked, []

    def second_is_interrupted(*args: Any) -> Any:
        calls.append(1)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return real(*args)

    monkeypatch.setattr(ablation, "walked", second_is_interrupted)
    out = tmp_path / "out"
    assert main(["bench", "ablation", str(folder), "--out", str(out), *QUICK, *TABLE]) == 130
    assert f"interrupted; 1 of 12 runs are kept in {out / 'ablation.json'}" in capsys.readouterr().err
    assert list(runs(out)) == [("I", 0)]


@pytest.fixture(scope="module")
def noisy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny walk with a Kinect's noise, whose truth is known."""
    folder = tmp_path_factory.mktemp("ablation") / "noisy"
    size = ["--frames", "240", "--width", "48", "--height", "36", "--free-views", "0", "--depth-noise"]
    assert main(["synth", str(folder), *size]) == 0
    return folder


def test_the_controls_are_real_runs_and_no_two_alike(noisy: Path, tmp_path: Path):
    controls = ["--seeds", "1", "--arms", "IV", "constant", "shuffled", "oracle"]
    assert main(["bench", "ablation", str(noisy), "--out", str(tmp_path), *QUICK, *controls]) == 0
    found = {run["arm"]: run["ate_rmse_cm"] for run in written(tmp_path)["runs"]}
    assert list(found) == ["I", "IV", "constant", "shuffled", "oracle"]
    assert len(set(found.values())) == 5


def test_where_nobody_knows_the_truth_there_is_no_oracle(folder: Path, tmp_path: Path):
    ask = ["bench", "ablation", str(folder), "--out", str(tmp_path / "out"), *QUICK]
    assert main([*ask, "--seeds", "1", "--arms", "IV", "oracle"]) == 0
    assert [run["arm"] for run in written(tmp_path / "out")["runs"]] == ["I", "IV"]


def test_the_oracle_is_told_the_true_error(noisy: Path, rasterizer: Rasterizer):
    truth = Truth.of(noisy)
    assert truth is not None
    frame, depth = truth.sequence.frame(1), truth.depth(1)
    assert depth is not None
    config = SlamConfig()
    source = config.mapper, config.confidence, rasterizer, IdSource(), torch.Generator()
    oracle = OracleMapper(*source, truth=truth, largest=0.5)
    known = (frame.depth > 0) & (depth > 0)
    assert known.float().mean() > 0.5
    error = oracle.birth_error(frame, None)
    assert torch.equal(error[known], (frame.depth - depth).abs().clamp_max(0.5)[known])
    assert error[known].max() > 0, "noise that is none"
    assert (error[~known] == 0.5).all()


def test_what_is_wrong_with_a_sequence_is_known(noisy: Path, tmp_path: Path):
    """Noise is, and a fault; what is only looked at is not."""
    assert faulty(None) is None
    assert faulty(Truth.of(noisy)) is True
    exact = shutil.copytree(noisy, tmp_path / "exact")
    shutil.rmtree(exact / "truth" / "depth")
    for name, wrong in (("still camera", False), ("absence", False), ("moving object", True), ("depth bias", True)):
        (exact / "truth" / "events.json").write_text(json.dumps([{"name": name, "first": 3, "last": 5}]))
        assert faulty(Truth.of(exact)) is wrong, name
