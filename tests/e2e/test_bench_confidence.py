"""`tcgsplat bench confidence`, on two tiny walks."""

import json

import pytest

from tcgsplat.cli.main import main


@pytest.mark.slow
def test_the_page_has_what_was_measured(tmp_path, capsys, monkeypatch):
    for name, flags in (("walk", []), ("crowd", ["--moving-object", "--depth-noise"])):
        size = ["--frames", "120", "--width", "64", "--height", "48", "--free-views", "0"]
        assert main(["synth", str(tmp_path / name), *size, *flags]) == 0
    out = tmp_path / "page"
    folders = [str(tmp_path / name) for name in ("walk", "crowd")]
    assert main(["bench", "confidence", *folders, "--out", str(out), "--every", "6"]) == 0
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


def test_says_that_the_truth_is_missing(tmp_path, capsys):
    assert main(["synth", str(tmp_path / "walk"), "--frames", "2", "--width", "32", "--height", "24"]) == 0
    (tmp_path / "walk" / "truth" / "events.json").unlink()
    (tmp_path / "walk" / "truth").rmdir()
    assert main(["bench", "confidence", str(tmp_path / "walk"), "--out", str(tmp_path / "page")]) == 1
    assert "has no folder `truth`" in capsys.readouterr().err
