"""What the README shows is what the package does."""

import re
from concurrent.futures import Executor
from pathlib import Path

import pytest

from tcgsplat.cli.main import COMMANDS
from tcgsplat.datasets import open_sequence
from tcgsplat.datasets.synthetic import SynthConfig
from tcgsplat.datasets.synthetic.studio import Studio
from tcgsplat.datasets.synthetic.synthesis import record

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)


def recorded(folder: Path, studio: Studio, workers: Executor, frames: int) -> None:
    folder.mkdir(parents=True)
    record(studio, folder, SynthConfig(frames=frames, width=64, height=48, free_views=0), workers)


def test_the_python_example_runs(
    studio: Studio, workers: Executor, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorded(tmp_path / "demo" / "sequence", studio, workers, frames=4)
    monkeypatch.chdir(tmp_path)
    (example,) = blocks("python")
    names: dict[str, object] = {}
    exec(compile(example, "README.md", "exec"), names)
    assert len(names["poses"]) == 4
    assert names["means"].shape == (len(names["confidence"]), 3)


def test_the_camera_file_is_read(studio: Studio, workers: Executor, tmp_path: Path) -> None:
    recorded(tmp_path / "data", studio, workers, frames=2)
    (camera,) = blocks("toml")
    smaller = camera.replace("width = 640", "width = 64").replace("height = 480", "height = 48")
    (tmp_path / "data" / "camera.toml").write_text(smaller.replace("= 1000.0", "= 5000.0"))
    assert open_sequence(tmp_path / "data").camera.fx == 525.0


def test_commands_and_files_exist() -> None:
    for command in re.findall(r"^tcgsplat (\w+)", README, re.MULTILINE):
        assert command in COMMANDS
    for path in re.findall(r"\]\(([^)#:]+)\)", README):
        assert (ROOT / path).exists(), path
