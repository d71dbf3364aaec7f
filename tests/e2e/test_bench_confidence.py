"""`tcgsplat bench confidence`, on the beginnings of two tiny walks."""

import json
from dataclasses import replace

import pytest

from tcgsplat.cli.main import main
from tcgsplat.datasets.synthetic import SynthConfig
from tcgsplat.datasets.synthetic.synthesis import record

WALK = SynthConfig(frames=120, width=64, height=48, free_views=0)
CROWD = replace(WALK, moving_object=True, depth_noise=True)
USED = 40


def cut(folder, frames):
    """Forget all but the first frames of a recording."""
    for name in ("rgb.txt", "depth.txt"):
        lines = (folder / name).read_text().splitlines(keepends=True)
        (folder / name).write_text("".join(lines[: frames + 1]))  # the first is a comment


@pytest.mark.slow
def test_the_page_has_what_was_measured(tmp_path, capsys, studio, peopled, workers):
    folders = [tmp_path / "walk", tmp_path / "crowd"]
    for folder, place, config in zip(folders, (studio, peopled), (WALK, CROWD), strict=True):
        folder.mkdir()
        record(place, folder, config, workers)
        cut(folder, USED)
    out = tmp_path / "page"
    assert main(["bench", "confidence", *map(str, folders), "--out", str(out), "--every", "4"]) == 0
    page = (out / "README.md").read_text()
    told = json.loads((out / "confidence.json").read_text())
    assert page in capsys.readouterr().out
    assert (out / "sparsification.png").stat().st_size > 10_000
    assert (out / "reliability.png").stat().st_size > 10_000
    assert [(arm["sequence"], arm["model"]) for arm in told["arms"]] == [
        (name, model) for name in ("walk", "crowd") for model in ("expectation", "paper")
    ]
    ours = told["arms"][0]["depth"]
    assert ours["constant"]["ause"] == pytest.approx(1.0)
    assert ours["shuffled"]["ause"] == pytest.approx(1.0, abs=0.2)
    assert ours["confidence"]["ause"] < 0.8
    assert set(told["calibration"]) == {"walk", "crowd"}
    assert "| walk | expectation |" in page
    walk, _, crowd, _ = told["arms"]
    assert walk["crossing"] is None and walk["fault_auroc"] is None
    assert crowd["crossing"]["places"] > 100
    assert crowd["fault_auroc_in_map"] > 0.8 and "| crowd | expectation |" in page.split("## Somebody walks about")[1]
    events = {event["name"]: event["of"] for event in crowd["events"]}
    assert events == {"moving object": "picture", "absence": "region"}


def test_says_that_the_truth_is_missing(tmp_path, capsys, studio, workers):
    (tmp_path / "walk").mkdir()
    record(studio, tmp_path / "walk", replace(WALK, frames=2), workers)
    (tmp_path / "walk" / "truth" / "events.json").unlink()
    (tmp_path / "walk" / "truth").rmdir()
    assert main(["bench", "confidence", str(tmp_path / "walk"), "--out", str(tmp_path / "page")]) == 1
    assert "has no folder `truth`" in capsys.readouterr().err
