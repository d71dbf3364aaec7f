"""Compiled kernels are kept until one of the sources changes, even one of another file."""

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tcgsplat.cli.ahead import MODULES
from tcgsplat.render.numba_cpu import compilation

ONE_KERNEL = """
from tcgsplat.render.numba_cpu.compilation import kernel

@kernel("i8")
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
    path.write_text(ONE_KERNEL)
    assert compiled_anew(path)
    assert not compiled_anew(path)
    monkeypatch.setattr(compilation, "_SOURCES", "others")
    assert compiled_anew(path)
    assert not compiled_anew(path)


@pytest.mark.parametrize(
    "source",
    [
        "render/numba_cpu/simd.py",
        "render/conventions.py",
        "mapping/loss_kernels.py",
        "mapping/adam.py",
        "scene/harmonics.py",
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


RUN = """
import json
from tcgsplat.cli.ahead import MODULES
from tcgsplat.cli.kernels import compile_kernels
from tcgsplat.config import SlamConfig
from tcgsplat.render.backends import open_rasterizer
from tcgsplat.cli.ahead import MODULES
from tcgsplat.render.numba_cpu import compilation

kernels = compilation.kernels_of(MODULES)
compile_kernels(SlamConfig(), open_rasterizer("numba"))
uses = {kernel.name: (kernel.dispatcher.types, kernel.dispatcher.signatures, kernel.kept) for kernel in kernels}
print(json.dumps({name: [[str(s) for s in signatures] == [str(types)], kept]
    for name, (types, signatures, kept) in uses.items()}))
"""


def test_a_run_uses_every_kernel_with_the_types_that_it_declares_and_no_others(tmp_path: Path):
    """In a process of its own with nothing compiled before, so that several compile them."""
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", RUN], env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    kernels = json.loads(done.stdout.splitlines()[-1])
    assert len(kernels) > 10
    assert [name for name, (as_declared, kept) in kernels.items() if not (as_declared and kept)] == []


CALLS = """
import re
from tcgsplat.cli.ahead import MODULES
from tcgsplat.render.numba_cpu.compilation import kernels_of

for kernel in kernels_of(MODULES):
    kernel.compile()
    (code,) = kernel.dispatcher.inspect_llvm().values()
    called = set(re.findall(r"call [^\\n]*@_ZN8tcgsplat([A-Za-z0-9_]*)", code))
    print(kernel.name, len(code), sorted(name for name in called if f"{len(kernel.name)}{kernel.name}" not in name))
"""


def test_kernels_call_none_of_our_functions(tmp_path: Path):
    """All are written into them; see `inner`."""
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", CALLS], env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    told = [line.split(maxsplit=2) for line in done.stdout.splitlines()]
    assert len(told) > 10 and all(int(length) > 1000 for _, length, _ in told)
    assert [name for name, _, calls in told if calls != "[]"] == []


def test_kernels_need_no_torch():
    """Importing it takes longer than a helping process has to compile."""
    source = f"import sys; from tcgsplat.render.numba_cpu.compilation import kernels_of; kernels_of({MODULES!r})"
    command = [sys.executable, "-c", source + "; print('torch' in sys.modules)"]
    assert subprocess.run(command, capture_output=True, text=True, timeout=60).stdout == "False\n"


TWO_KERNELS = (
    ONE_KERNEL
    + """
@kernel("f8")
def triple(x):
    return 3 * x
"""
)


@pytest.mark.parametrize("fails", [False, True])
def test_processes_compile_side_by_side_and_one_may_die(fails: bool, tmp_path: Path):
    text = TWO_KERNELS + ("import os, sys\nif 'main' not in sys.argv: os._exit(1)\n" if fails else "")
    (tmp_path / "some_kernels.py").write_text(text)
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": str(tmp_path)}
    source = (
        "from tcgsplat.render.numba_cpu import compilation as c; k = c.kernels_of(['some_kernels']);"
        "w = c.compiled(k, 3); w.__enter__(); w.__exit__(None, None, None); before = [x.kept for x in k];"
        "print(all(before), k[0].dispatcher(2), k[1].dispatcher(2.0), [x.kept for x in k])"
    )
    command = [sys.executable, "-c", source, "main"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60)
    assert done.stdout == f"{not fails} 4 6.0 [True, True]\n", done.stderr
