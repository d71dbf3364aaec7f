"""What a command takes can be read without loading what it does."""

import subprocess
import sys

import pytest

LIGHT = ["run", "demo", "eval", "export", "presets", "doctor"]
HEAVY = {"torch", "numba", "numpy", "cv2", "scipy", "matplotlib"}


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
