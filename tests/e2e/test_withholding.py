"""Frames that are kept back from the map, from the command that says so to the report."""

import json
from pathlib import Path

import pytest

from tcgsplat.cli.main import main
from tcgsplat.storage.run_directory import RunDirectory


def test_every_fourth_frame_is_withheld(easy_walk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    part = ["--limit", "18"]
    submaps = ["--schedule.submap-by", "interval", "--schedule.submap-interval", "8", "--schedule.map-every", "2"]
    withheld = ["--schedule.withhold-every", "4"]
    assert main(["run", str(easy_walk), *part, *submaps, *withheld, "--out", str(tmp_path / "run")]) == 0

    rows = RunDirectory.open(tmp_path / "run").trajectory()[0].rows
    assert not any(row.lost for row in rows)
    assert [row.frame_index for row in rows if row.mapped] == [0, 2, 5, 7, 9, 11, 13, 15, 17]
    begun = [b.frame_index for a, b in zip(rows, rows[1:], strict=False) if a.submap_index != b.submap_index]
    assert begun == [9, 17]  # 8 would have begun a submap, and is withheld

    capsys.readouterr()
    assert main(["eval", str(tmp_path / "run")]) == 0
    said, report = capsys.readouterr().out, json.loads((tmp_path / "run" / "report.json").read_text())
    assert "4 of 4 frames that schedule.withhold_every kept back" in report["evaluated"]["withheld"]
    assert "submaps, as mapped online" in said and "schedule.withhold_every" in said
    assert report["psnr_withheld"]["value"] > 15.0 and report["psnr_map_withheld"]["value"] > 15.0
    assert report["frames_tracked"] == {"value": 100.0, "unit": "%"}
