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


def test_every_source_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "a.py").write_text("one = 1")
    monkeypatch.setattr(compilation, "__file__", str(tmp_path / "compilation.py"))
    before = compilation._digest()
    (tmp_path / "b.py").write_text("two = 2")
    between = compilation._digest()
    (tmp_path / "a.py").write_text("one = 3")
    assert len({before, between, compilation._digest()}) == 3
