"""A file is complete or absent, also when its writer is killed."""

import subprocess
import sys
import time
from pathlib import Path

import pytest

from tcgsplat.storage import atomic

WRITE_FOR_EVER = """
import sys
from pathlib import Path
from tcgsplat.storage import atomic
for i in range(10**9):
    atomic.write_bytes(Path(sys.argv[1]), bytes([i % 256]) * (100_000 + i % 7))
"""


def test_text_and_bytes_come_back(tmp_path: Path) -> None:
    atomic.write_text(tmp_path / "a.txt", "σ = 1\n")
    atomic.write_bytes(tmp_path / "b", b"\x00\x01")
    atomic.write_bytes(tmp_path / "b", b"\x02")
    assert (tmp_path / "a.txt").read_text(encoding="utf-8") == "σ = 1\n"
    assert (tmp_path / "b").read_bytes() == b"\x02"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.txt", "b"]


def test_failed_write_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "a"
    atomic.write_bytes(path, b"old")
    with pytest.raises(RuntimeError, match="stop"), atomic.writing(path) as file:
        file.write(b"half of the new")
        raise RuntimeError("stop")
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_reader_never_meets_half_a_file_of_a_killed_writer(tmp_path: Path) -> None:
    path = tmp_path / "state.bin"
    reads = 0
    for pause in (0.02, 0.05, 0.11):
        with subprocess.Popen([sys.executable, "-c", WRITE_FOR_EVER, str(path)]) as writer:
            while not path.exists():
                assert writer.poll() is None
                time.sleep(0.01)
            until = time.monotonic() + pause
            while time.monotonic() < until:
                _assert_complete(path.read_bytes())
                reads += 1
            writer.kill()
        _assert_complete(path.read_bytes())
        path.unlink()
    assert reads > 3


def _assert_complete(content: bytes) -> None:
    assert 100_000 <= len(content) <= 100_006
    assert content == content[:1] * len(content)
