"""What a command takes can be read without loading what it does, and in the terminal that there is."""

import subprocess
import sys
from itertools import pairwise

import pytest

from tcgsplat.cli.main import COMMANDS, main

LIGHT = ["run", "demo", "eval", "export", "presets", "doctor"]
HEAVY = {"torch", "numba", "numpy", "cv2", "scipy", "matplotlib", "typeguard"}


@pytest.mark.parametrize("command", LIGHT)
@pytest.mark.parametrize("arguments", [["--help"], ["--no-such-flag"]])
def test_help_and_wrong_flags_load_nothing_heavy(command: str, arguments: list[str]):
    code = (
        "import sys; from tcgsplat.cli.main import main\n"
        f"code = main({[command, *arguments]!r})\n"
        f"heavy = {HEAVY!r} & set(sys.modules)\n"
        "sys.exit(f'imported {heavy}' if heavy else code)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == (0 if arguments == ["--help"] else 2), done.stderr
    if arguments == ["--help"]:
        assert done.stdout.startswith(f"usage: tcgsplat {command}")


PAGES = [
    *COMMANDS,
    *(f"bench {what}" for what in ("render", "track", "loops", "gpu", "ablation", "synthetic", "tum", "replica")),
    "bench scannet",
    "bench confidence",
]


@pytest.mark.parametrize("columns", [80, 120])
@pytest.mark.parametrize("page", PAGES)
def test_help_fits_the_terminal(
    page: str, columns: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setenv("COLUMNS", str(columns))
    assert main([*page.split(), "--help"]) == 0
    lines = capsys.readouterr().out.rstrip("\n").split("\n")
    assert max(map(len, lines)) <= columns
    assert lines[0].startswith(f"usage: tcgsplat {page} [-h]")
    text = "\n".join(lines)
    assert "(default: None)" not in text and "(default: False)" not in text and "(default: )" not in text
    prose = lines[: next(i for i, line in enumerate(lines) if " positional arguments" in line or " options " in line)]
    assert "\n\n\n" not in "\n".join(prose)
    for line, following in pairwise(prose[1:]):
        if line and following:  # within a paragraph no line ends before the terminal does
            assert len(line) + 1 + len(following.split()[0]) > columns, line


def test_a_default_that_says_something_is_told(capsys: pytest.CaptureFixture[str]):
    assert main(["demo", "--help"]) == 0
    said = capsys.readouterr().out
    assert "(default: 600)" in said and "(default: demo)" in said and "(required)" not in said
