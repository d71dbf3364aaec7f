"""What the README shows is what the package does."""

import re
from pathlib import Path

import pytest

from tcgsplat.cli.main import COMMANDS
from tcgsplat.datasets import open_sequence
from tcgsplat.datasets.synthetic import SynthConfig, synthesize

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)


def test_the_python_example_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synthesize(tmp_path / "demo" / "sequence", SynthConfig(frames=4, width=64, height=48))
    monkeypatch.chdir(tmp_path)
    (example,) = blocks("python")
    names: dict[str, object] = {}
    exec(compile(example, "README.md", "exec"), names)
    assert len(names["poses"]) == 4
    assert names["means"].shape == (len(names["confidence"]), 3)


def test_the_camera_file_is_read(tmp_path: Path) -> None:
    synthesize(tmp_path / "data", SynthConfig(frames=2, width=64, height=48))
    (camera,) = blocks("toml")
    smaller = camera.replace("width = 640", "width = 64").replace("height = 480", "height = 48")
    (tmp_path / "data" / "camera.toml").write_text(smaller.replace("= 1000.0", "= 5000.0"))
    assert open_sequence(tmp_path / "data").camera.fx == 525.0


def test_commands_and_files_exist() -> None:
    for command in re.findall(r"^tcgsplat (\w+)", README, re.MULTILINE):
        assert command in COMMANDS
    for path in re.findall(r"\]\(([^)#:]+)\)", README):
        assert (ROOT / path).exists(), path
