"""Compiled kernels are kept until one of the sources changes, even one of another file."""

import importlib.util
from pathlib import Path

import pytest

from tcgsplat.render.numba_cpu import compilation

MODULE = """
from numba import njit
from tcgsplat.render.numba_cpu.compilation import kept
from tcgsplat.render.numba_cpu.simd import KERNEL

@kept(njit(**KERNEL))
def double(x):
    return 2 * x
"""


def compiled_anew(path: Path) -> bool:
    spec = importlib.util.spec_from_file_location("some_kernels", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert module.double(3) == 6
    hits, misses = (sum(counts.values()) for counts in module.double.stats[1:])
    assert hits + misses == 1
    return misses == 1


def test_kernels_are_kept_until_a_source_changes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = tmp_path / "some_kernels.py"
    path.write_text(MODULE)
    assert compiled_anew(path)
    assert not compiled_anew(path)
    monkeypatch.setattr(compilation, "_SOURCES", "others")
    assert compiled_anew(path)
    assert not compiled_anew(path)


@pytest.mark.parametrize(
    "source",
    [
        "render/numba_cpu/simd.py",
        "render/protocol.py",
        "mapping/loss_kernels.py",
        "mapping/optimizer.py",
        "tracking/alignment_kernels.py",
    ],
)
def test_every_source_counts(source: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    file = tmp_path / source
    file.parent.mkdir(parents=True)
    monkeypatch.setattr(compilation, "__file__", str(tmp_path / "render" / "numba_cpu" / "compilation.py"))
    digests = [compilation._digest()]
    for text in ("one = 1", "one = 2"):
        file.write_text(text)
        digests.append(compilation._digest())
    assert len(set(digests)) == 3
