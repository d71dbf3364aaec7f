"""`tcgsplat bench SUITE`: what is run, what is not run again, and what the page says of it."""

import io
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import asdict, dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from analytic_room import Room, walk

from tcgsplat.cli.bench import plots, tables
from tcgsplat.cli.bench.page import Results, page
from tcgsplat.cli.bench.performing import RIVALS, Outcome
from tcgsplat.cli.bench.suites import REPLICA, SCANNET, SYNTHETIC, TUM, Suite
from tcgsplat.cli.bench.watching import Predictions, Watched
from tcgsplat.cli.main import main
from tcgsplat.config import from_toml, settings
from tcgsplat.datasets.synthetic.raster import View
from tcgsplat.datasets.synthetic.writer import sequence_files
from tcgsplat.evaluation import published
from tcgsplat.evaluation.metrics import Metric
from tcgsplat.evaluation.prediction import OURS
from tcgsplat.evaluation.uncertainty import Sparsification
from tcgsplat.geometry.camera import Camera

QUICK = ["--mapper.iterations", "3", "--mapper.first-iterations", "5", "--schedule.map-every", "2", "--refine", "1"]
DESK, XYZ, BROKEN = (f"rgbd_dataset_freiburg{name}" for name in ("1_desk", "2_xyz", "1_desk2"))


FRAMES = 12
"""Two of which are predicted before they are used, the first one from no map at all."""


def record_room(root: Path, *, truth: bool) -> None:
    """The analytic room, as in the TUM benchmark; its depth is exact."""
    poses, seconds = walk(FRAMES), np.arange(FRAMES) / 30
    root.mkdir(parents=True)
    files = sequence_files(root, "tum", seconds, ())
    if truth:
        files.write_events(())
    else:
        (root / "truth").rmdir()
    for index, T_world_cam in enumerate(poses):
        frame = Room().frame(T_world_cam, index, Camera(70.0, 70.0, 39.5, 29.5, 80, 60))
        color = (255 * frame.color.clamp(0, 1)).round().byte().numpy()
        files.write_frame(index, color, frame.depth.double().numpy(), None)
    files.write_index(View(80, 60, 70.0, 39.5, 29.5), seconds, torch.stack(poses).numpy(), np.ones(FRAMES, dtype=bool))


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three of the five sequences of the TUM suite. Two have the same frames, and of the first of these the truth is
    known; the third one lacks a file.
    """
    folder = tmp_path_factory.mktemp("data")
    record_room(folder / DESK, truth=True)
    record_room(folder / XYZ, truth=False)
    (folder / BROKEN).mkdir()
    shutil.copy(folder / XYZ / "rgb.txt", folder / BROKEN)
    return folder


@dataclass(frozen=True)
class Ran:
    """A bench that has ended."""

    out: Path
    told: str
    complained: str


@pytest.fixture(scope="module")
def ran(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Ran:
    """All that is there, with two presets."""
    out = tmp_path_factory.mktemp("bench") / "out"
    with redirect_stdout(io.StringIO()) as told, redirect_stderr(io.StringIO()) as complained:
        assert main(ask(data, out, "--seeds", "1", "--seed", "5")) == 0
    return Ran(out, told.getvalue(), complained.getvalue())


def ask(data: Path, out: Path, *more: str) -> list[str]:
    return ["bench", "tum", "--data", str(data), "--out", str(out), *QUICK, *more]


def results(out: Path) -> dict[tuple[str, str, int], dict[str, Any]]:
    written = json.loads((out / "results.json").read_text())
    return {(run["sequence"], run["preset"], run["seed"]): run for run in written["runs"]}


def stamps(out: Path, name: str) -> dict[str, int]:
    return {str(path.relative_to(out)): path.stat().st_mtime_ns for path in out.glob(f"runs/*/*/*/{name}")}


def test_a_suite_runs_what_is_there_and_names_what_is_not(data: Path, ran: Ran):
    out = ran.out
    assert ran.told.startswith("4 of 6 runs, 2 failed or lost: ")
    assert f"fr1/room is left out: no files in {data / 'rgbd_dataset_freiburg1_room'}" in ran.complained
    runs = results(out)
    done = {key for key, run in runs.items() if run["state"] == "done"}
    assert done == {(name, preset, 5) for name in ("fr1/desk", "fr2/xyz") for preset in ("default", "base")}
    assert {run["state"] for key, run in runs.items() if key[0] in ("fr1/room", "fr3/office")} == {"missing"}
    for key in done:
        run = runs[key]
        config = settings(from_toml((out / run["config"]).read_text()))
        assert config["seed"] == 5
        assert config["mapper.iterations"] == 3
        assert config["confidence.guide_mapping"] is (key[1] == "default")
        assert run["summary"]["versions"]["torch"] == torch.__version__
        assert 0 < run["metrics"]["ate_rmse"]["value"] < 3
        assert run["evaluated"]["map"].startswith("refined by ")
        assert (out / run["place"] / "report.json").is_file()
    text = (out / "README.md").read_text()
    mean = runs["fr1/desk", "default", 5]["metrics"]["ate_rmse"]["value"]
    assert f"| `default` | {mean:.2f} | – | – |" in text
    assert "| *TCGSplat (published)* | 1.83 | 3.52 | 6.74 | 1.45 | 3.31 | 3.37 |" in text
    assert f"- fr1/room: no files in {data / 'rgbd_dataset_freiburg1_room'}" in text
    assert "`mapper.iterations = 3`" in text
    for figure in ("ate.svg", "psnr.svg", "difference.svg", "sparsification.svg"):
        assert f"]({figure})" in text
        assert (out / figure).read_text().startswith("<?xml")


def test_a_run_whose_truth_is_known_is_watched(ran: Ran):
    runs = results(ran.out)
    for preset in ("default", "base"):
        told = runs["fr1/desk", preset, 5]["confidence"]
        assert told["frames"] == 1
        assert set(told["depth"]) == {"confidence", "opacity", "observations", "previous residual", "depth edge"}
        assert 0 < told["depth"]["confidence"]["ause"] < 2
        assert runs["fr2/xyz", preset, 5]["confidence"] is None
    text = (ran.out / "README.md").read_text()
    ause, rival = (runs["fr1/desk", "default", 5]["confidence"]["depth"][m]["ause"] for m in ("confidence", "opacity"))
    assert f"| fr1/desk | `default` | {ause:.2f} | {rival:.2f} |" in text
    assert "| fr2/xyz | `default` | 5 | done |" in text
    assert text.count("| fr2/xyz | `default` |") == 1, "not in the table of confidence"


def test_watching_changes_neither_path_nor_map(ran: Ran):
    """The two sequences have the same frames, and one of them is watched."""
    watched, alone = (ran.out / "runs" / name / "default" / "5" for name in ("fr1-desk", "fr2-xyz"))
    assert (watched / "confidence.json").is_file() and not (alone / "confidence.json").exists()
    files = {"trajectory.npz", "trajectory.txt", *(f"submaps/{path.name}" for path in (alone / "submaps").iterdir())}
    assert len(files) > 2
    for name in files:
        assert (watched / name).read_bytes() == (alone / name).read_bytes(), name


def test_what_is_finished_is_not_run_again(data: Path, ran: Ran, tmp_path: Path):
    out = shutil.copytree(ran.out, tmp_path / "out")
    one = ["--sequences", "fr1/desk", "--presets", "default", "--seed", "5", "--seeds", "1"]
    run = out / "runs" / "fr1-desk" / "default" / "5"
    summary, report = (run / "summary.json").stat().st_mtime_ns, stamps(out, "report.json")

    assert main(ask(data, out, *one)) == 0
    assert stamps(out, "report.json") == report
    assert len(results(out)) == 1

    (run / "report.json").unlink()  # as if stopped between the run and its evaluation
    assert main(ask(data, out, *one)) == 0
    assert (run / "report.json").is_file()
    assert (run / "summary.json").stat().st_mtime_ns == summary

    assert main(ask(data, out, *one, "--tracker.smoothing", "false", "--limit", "4")) == 0
    assert (run / "summary.json").stat().st_mtime_ns != summary


def test_a_watched_run_that_was_stopped_begins_anew(data: Path, ran: Ran, tmp_path: Path):
    """What its observer had seen is gone: it is written at the end of the run."""
    out = shutil.copytree(ran.out, tmp_path / "out")
    run = out / "runs" / "fr1-desk" / "default" / "5"
    told, summary = (run / "confidence.json").read_bytes(), (run / "summary.json").stat().st_mtime_ns
    for name in ("report.json", "confidence.json"):
        (run / name).unlink()
    assert main(ask(data, out, "--sequences", "fr1/desk", "--presets", "default", "--seed", "5", "--seeds", "1")) == 0
    assert (run / "summary.json").stat().st_mtime_ns != summary
    assert (run / "confidence.json").read_bytes() == told


def test_a_run_that_fails_is_a_row_and_the_rest_goes_on(data: Path, ran: Ran):
    runs = results(ran.out)
    assert runs["fr2/xyz", "default", 5]["state"] == "done", "its turn came later"
    failed = runs["fr1/desk2", "default", 5]
    assert failed["state"] == "failed"
    assert failed["why"] == f"no depth.txt in {data / BROKEN}; give the folder that holds both rgb.txt and depth.txt"
    assert f"fr1/desk2, default, seed 5: failed: {failed['why']}" in ran.complained
    assert f"failed: {failed['why']}" in (ran.out / "README.md").read_text()


def test_nothing_there_is_an_error_that_says_where_to_get_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["bench", "scannet", "--data", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    told = capsys.readouterr().err
    assert f"0181 is left out: no files in {tmp_path / 'scene0181_00'} or {tmp_path / 'scene0181'}" in told
    assert f"none of the sequences of ScanNet is in {tmp_path}: extract the scenes" in told
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("more", "told"),
    [
        (["--sequences", "fr9"], "there is no fr9 in TUM RGB-D; choose from fr1/desk, "),
        (["--seeds", "0"], "--seeds counts from 1"),
        (["--refine", "-1"], "--refine is -1; give steps from 0 on"),
        (["--presets", "fast"], "there is no preset fast"),
        (["--mapper.nothing", "1"], "mapper.nothing"),
    ],
)
def test_what_makes_no_sense_is_refused(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], more: list[str], told: str
):
    assert main(ask(data, tmp_path / "out", *more)) == 2
    assert told in capsys.readouterr().err


def test_a_folder_of_something_else_is_left_alone(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out = tmp_path / "out"
    out.mkdir()
    (out / "thesis.tex").write_text("x")
    assert main(ask(data, out)) == 1
    assert "holds something else than a bench" in capsys.readouterr().err
    (out / "results.json").write_text('{"suite": "replica"}')
    assert main(ask(data, out)) == 1
    assert "holds the suite replica, not tum" in capsys.readouterr().err
    assert sorted(path.name for path in out.iterdir()) == ["results.json", "thesis.tex"]


def test_the_synthetic_suite_makes_its_data(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """In the place of what it made with other settings. All of the walk in six frames is far too fast: the run is lost,
    and is said to be.
    """
    out, folder = tmp_path / "out", tmp_path / "out" / "data" / "moving"
    (moving,) = (source for source in SYNTHETIC.made(500, 64).sources if source.name == "moving")
    folder.mkdir(parents=True)
    (folder / "old").touch()
    folder.with_name("moving.json").write_text(json.dumps(asdict(moving.synth)))  # type: ignore[call-overload]
    (out / "results.json").write_text('{"suite": "synthetic"}')

    tiny = ["bench", "synthetic", "--out", str(out), "--frames", "6", "--width", "64", *QUICK, "--refine", "0"]
    one = ["--sequences", "moving", "--presets", "default", "--seeds", "1"]
    assert main([*tiny, *one]) == 0
    (run,) = results(out).values()
    assert run["state"] == "lost"
    assert "1 failed or lost" in capsys.readouterr().out
    assert "| moving | `default` | 0 | lost: tracking was lost in" in (out / "README.md").read_text()
    assert (folder / "mask").is_dir() and not (folder / "old").exists()
    assert len(list((folder / "rgb").iterdir())) == 6

    before = (folder / "rgb.txt").stat().st_mtime_ns
    assert main([*tiny, *one]) == 0
    assert (folder / "rgb.txt").stat().st_mtime_ns == before


@pytest.mark.slow
def test_ctrl_c_keeps_what_is_finished_and_the_same_command_goes_on(data: Path, tmp_path: Path):
    out = tmp_path / "out"
    short = ["--limit", "4", "--refine", "0"]
    arguments = ask(data, out, "--presets", "default", "--seeds", "4", "--sequences", "fr2/xyz", *short)
    process = subprocess.Popen([sys.executable, "-m", "tcgsplat.cli.main", *arguments], stderr=subprocess.PIPE)
    until(lambda: len(stamps(out, "report.json")) >= 1)
    process.send_signal(signal.SIGINT)
    told = process.communicate()[1].decode()
    assert process.returncode == 130, told
    kept = stamps(out, "report.json")
    assert 1 <= len(kept) < 4
    assert f"{len(kept)} of 4 runs are kept in {out}: the same command goes on" in told
    states = [run["state"] for run in results(out).values()]
    assert states.count("done") == len(kept)
    assert states.count("waiting") == 4 - len(kept)
    assert "waiting: not run yet" in (out / "README.md").read_text()
    assert main(arguments) == 0
    assert {run["state"] for run in results(out).values()} == {"done"}
    assert kept.items() <= stamps(out, "report.json").items()


@pytest.mark.slow
@pytest.mark.skipif(find_spec("ray") is None, reason="ray is not installed: pip install 'tcgsplat[cluster]'")
def test_a_worker_that_is_killed_costs_one_run_which_is_tried_again(data: Path, tmp_path: Path):
    out = tmp_path / "out"
    arguments = ask(
        data, out, "--presets", "default", "--seeds", "3", "--sequences", "fr1/desk", "--refine", "0", "--cluster"
    )
    process = subprocess.Popen(
        [sys.executable, "-m", "tcgsplat.cli.main", *arguments], stderr=subprocess.PIPE, stdout=subprocess.PIPE
    )
    until(lambda: bool(workers(process.pid)))
    killed = workers(process.pid)[0]
    os.kill(killed, signal.SIGKILL)
    told = b"".join(process.communicate(timeout=250)).decode()
    assert process.returncode == 0, told
    assert "3 of 3 runs: " in told
    runs = results(out)
    assert [run["state"] for run in runs.values()] == ["done"] * 3
    for run in runs.values():
        files = {path.name for path in (out / run["place"]).iterdir()}
        assert {"config.toml", "summary.json", "report.json", "confidence.json"} <= files
    kept = stamps(out, "report.json")
    assert main(arguments) == 0, "what the cluster has done is not done again"
    assert stamps(out, "report.json") == kept


@pytest.mark.skipif(find_spec("ray") is not None, reason="ray is installed")
def test_without_ray_the_error_says_what_to_install(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert main(ask(data, tmp_path / "out", "--cluster")) == 1
    assert "pip install 'tcgsplat[cluster]'" in capsys.readouterr().err


def until(true: Any, seconds: float = 200.0) -> None:
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)


def workers(driver: int) -> list[int]:
    """Processes below the driver that are at work on a run."""
    parents, names = {}, {}
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            try:
                names[int(folder.name)] = (folder / "cmdline").read_bytes()
                parents[int(folder.name)] = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
            except OSError:
                continue

    def below(process: int) -> bool:
        return process == driver or (process in parents and below(parents[process]))

    return [process for process, name in names.items() if name.startswith(b"ray::_task") and below(process)]


def outcome(preset: str, sequence: str, seed: int, cm: float | None, **more: float) -> Outcome:
    if cm is None:
        return Outcome(sequence, preset, seed, "failed", "no reason")
    metrics = {"ate_rmse": Metric(cm, "cm")} | {name: Metric(value) for name, value in more.items()}
    return Outcome(sequence, preset, seed, "done", metrics=metrics, place=f"runs/{sequence}/{preset}/{seed}")


def rows(text: str) -> list[list[str]]:
    """Cells of the lines of a table; all lines are equally long."""
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line[:1] == "|"]


def test_means_and_spreads_by_hand():
    some = [outcome("default", "clean", seed, cm) for seed, cm in ((0, 1.0), (1, 3.0))]
    some += [outcome("default", "moving", 0, 5.0), outcome("default", "moving", 1, None)]
    table = rows(tables.ate(some, ["clean", "moving"], SYNTHETIC))
    assert table[0] == ["method", "clean", "moving", "mean"]
    # the mean over sequences is of seed 0 alone: seed 1 lacks a sequence
    assert table[2] == ["`default`", "2.000 ± 1.414", "5.000 (1 of 2 runs)", "3.000"]
    assert table[3] == ["`base`", "–", "–", "–"]


def test_differences_are_to_the_last_preset():
    some = [outcome("default", "clean", seed, 1.0) for seed in (0, 1)]
    some += [outcome("base", "clean", seed, 1.5) for seed in (0, 1)]
    table = rows(tables.differences(some, SYNTHETIC))
    assert table[2][:3] == ["`default`", "ATE RMSE [%] ↓", "-33.3"]
    assert table[2][-2:] == ["2", "0"]


def watched(ause: float, rival: float, fault: float | None = None) -> Watched:
    removed = np.linspace(0, 0.99, 12)
    pixels = np.random.default_rng(0).random(200)
    return Watched(
        7,
        {OURS: {"ause": ause, "spearman": 0.5, "spearman_p10": None}} | {name: {"ause": rival} for name in RIVALS},
        fault,
        fault,
        {name: Sparsification(removed, 1 - 0.9 * removed, 1 - removed, 1.0) for name in (OURS, *RIVALS)},
        pixels,
        0.1 * pixels,
    )


def test_confidence_by_hand(tmp_path: Path):
    of = {("clean", 0): watched(0.2, 0.3), ("clean", 1): watched(0.4, 0.3), ("moving", 0): watched(0.1, 0.9, 0.8)}
    some = [replace(outcome("default", name, seed, 1.0), watched=one) for (name, seed), one in of.items()]
    some.append(replace(some[0], sequence="moving", seed=1, state="lost", watched=watched(9.9, 0.0)))
    some.append(outcome("base", "clean", 0, 1.0))
    text = tables.confidence(some, SYNTHETIC)
    clean, moving = rows(text)[2:]
    assert clean == ["clean", "`default`", "0.30 ± 0.14", *["0.30 ± 0.00"] * 2, "0.50 ± 0.00", *["–"] * 5]
    assert moving[2:4] == ["0.10 (1 of 2 runs)", "0.90 (1 of 2 runs)"]
    assert moving[-2:] == ["0.80 (1 of 2 runs)"] * 2
    assert "lower with `default`, than opacity in 2 of 3 and than observations in 2 of 3 runs.\n" in text + "\n"
    assert set(plots.figures(some, ["clean", "moving"], SYNTHETIC)) >= {"sparsification.svg", "reliability.svg"}
    assert "reliability.svg" not in plots.figures(some[:2], ["clean", "moving"], SYNTHETIC), "no other to fit to"
    assert tables.confidence([outcome("base", "clean", 0, 1.0)], SYNTHETIC) == ""


def test_what_a_watched_run_showed_is_read_back(tmp_path: Path):
    told, path = watched(0.2, 0.3, 0.8), tmp_path / "confidence.json"
    told.write(path)
    read = Watched.read(path)
    assert read is not None
    assert read.figures == told.figures
    np.testing.assert_allclose(read.curves[OURS].error, told.curves[OURS].error, atol=1e-4)
    np.testing.assert_allclose(read.error, told.error, rtol=1e-5)
    path.write_text("{}")
    assert Watched.read(path) is None
    nothing = Watched.of(Predictions())
    nothing.write(path)
    assert Watched.read(path).frames == 0  # type: ignore[union-attr]


@pytest.mark.parametrize("suite", [SYNTHETIC, TUM, REPLICA, SCANNET], ids=lambda suite: suite.name)
def test_a_page_of_nothing_yet_is_whole(suite: Suite):
    sequences = [source.name for source in suite.sources]
    waiting = [Outcome(name, preset, 0, "waiting") for name in sequences for preset in suite.presets]
    text = page(Results(suite, {}, tuple(waiting)))
    assert ("(published)* | " in text) and ("nan" not in text)
    table: list[list[str]] = []
    for block in text.split("\n\n"):
        if table := rows(block):
            assert len({len(line) for line in table}) == 1, block


def test_every_source_is_in_the_published_tables():
    for suite in (TUM, REPLICA, SCANNET):
        table = published.ATE[suite.name]
        assert [source.column for source in suite.sources] == list(table.columns[:-1])
    assert [source.column for source in REPLICA.sources] == list(published.F1.columns[:-1])


@pytest.mark.parametrize("table", [*published.ATE.values(), published.DEPTH_L1, published.F1], ids=lambda t: t.measures)
def test_the_published_means_are_those_of_the_published_rows(table: published.Table):
    """To the last printed digit, as the paper rounds later than its rows: a digit copied wrongly shows."""
    digits = 1 if table is published.F1 or table is published.ATE["scannet"] else 2
    wrong: Mapping[str, tuple[float, float]] = {
        method: (average, float(np.mean(values)))
        for method, (*values, average) in table.rows.items()
        if average is not None and abs(average - np.mean(values)) > 10**-digits
    }
    assert not wrong
