"""Imports that take less time: in processes of their own, since what is imported once stays."""

import subprocess
import sys
from pathlib import Path

import pytest


def python(code: str) -> subprocess.CompletedProcess[str]:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    return done


WALKED = """
import sys
from tcgsplat.cli.ahead import compiled_meanwhile
with compiled_meanwhile():
    from tcgsplat.cli.kernels import compile_kernels
    from tcgsplat.config import SlamConfig
    from tcgsplat.render.backends import open_rasterizer
    compile_kernels(SlamConfig(), open_rasterizer("numba"))
import torch
from tcgsplat.cli.imports import _SHAPES, _Postponed
assert isinstance(sys.modules[_SHAPES], _Postponed), "a run needs all of torch, after all"
import inspect
assert inspect.getmodule.__module__ == "inspect", "left as it was while torch was imported"
before = [type(finder).__name__ for finder in sys.meta_path]
"""


def test_what_a_run_does_not_need_of_torch_comes_with_the_first_further_module_of_it():
    python(
        WALKED + "import torch.utils._content_store\n"
        "assert not isinstance(sys.modules[_SHAPES], _Postponed)\n"
        "assert torch._meta_registrations is sys.modules[_SHAPES]\n"
        "assert '_BeforeMoreOfTorch' in before and len(sys.meta_path) == len(before) - 1\n"
        "assert torch.Generator().manual_seed(3).initial_seed() == 3\n"
        "weight = torch.nn.Parameter(torch.ones(2))\n"
        "weight.square().sum().backward(); torch.optim.Adam([weight], 0.5).step()\n"  # which imports a compiler
        "assert torch.allclose(weight, torch.full((2,), 0.5)), weight\n"
        "from torch._subclasses.fake_tensor import FakeTensorMode\n"
        "with FakeTensorMode(): shape = torch.linalg.solve(torch.rand(3, 3), torch.rand(3, 2)).shape\n"
        "assert shape == (3, 2)\n"
    )


def test_what_a_run_does_not_need_of_torch_comes_when_it_is_asked_for():
    python(
        WALKED + "assert not hasattr(torch._meta_registrations, '__no_such_thing__')\n"
        "assert isinstance(sys.modules[_SHAPES], _Postponed)\n"
        "assert callable(torch._meta_registrations.register_meta)\n"
        "assert not isinstance(sys.modules[_SHAPES], _Postponed)\n"
        "import torch._dynamo\n"
    )


def test_randomness_is_the_same_whether_torch_was_imported_whole_or_not():
    draws = (
        "from tcgsplat.slam import Slam; from tcgsplat.config import SlamConfig\n"
        "from tcgsplat.render.backends import open_rasterizer\n"
        "generator = Slam(SlamConfig(seed=7), open_rasterizer('numba'))._generator\n"
        "print(torch.randperm(9, generator=generator).tolist(), torch.rand(3, generator=generator).tolist())\n"
    )
    ordinary = "import torch; torch.rand(5); print(torch.randperm(9, generator=(g := torch.Generator().manual_seed(7)))"
    ordinary += ".tolist(), torch.rand(3, generator=g).tolist())"
    assert python(WALKED + "torch.rand(5)\n" + draws).stdout == python(ordinary).stdout


@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="Linux tells which libraries are loaded")
def test_libraries_are_loaded_while_python_goes_on():
    done = python(
        "import sys, time; from tcgsplat.cli.imports import load_meanwhile\n"
        "load_meanwhile(); turns, until = 0, time.monotonic() + 30\n"
        "loaded = lambda: 'libtorch_cpu' in (maps := open('/proc/self/maps').read()) and 'cv2.' in maps\n"
        "while not loaded() and time.monotonic() < until: turns += 1\n"
        "assert loaded() and 'torch' not in sys.modules and 'cv2' not in sys.modules\n"
        "import torch, cv2; load_meanwhile()\n"
        "print(turns, float(torch.ones(3).sum()), cv2.countNonZero(torch.ones(3).numpy()))\n"
    )
    turns, total, counted = done.stdout.split()
    assert int(turns) > 3 and (float(total), int(counted)) == (3, 3)


def test_a_module_that_is_as_if_missing_is_there_again_afterwards():
    python(
        "import json, sys; from tcgsplat.cli.imports import as_if_missing\n"
        "with as_if_missing('json', 'wave'):\n"
        "    import json\n"
        "    try: import wave\n"
        "    except ImportError: missing = True\n"
        "import wave\n"
        "assert missing and json is sys.modules['json']\n"
    )


def test_kernels_are_looked_for_without_linear_algebra_that_can_be_had_all_the_same():
    """Importing it takes a tenth of a second, and only products of matrices need it."""
    python(
        "import sys; from tcgsplat.cli.ahead import compiled_meanwhile\n"
        "with compiled_meanwhile():\n"
        "    assert 'scipy' not in sys.modules and 'yaml' not in sys.modules\n"
        "import scipy.linalg.cython_blas\n"
        "import numba, numpy as np\n"
        "assert (numba.njit(lambda a: a @ a)(np.eye(3)) == np.eye(3)).all()\n"
    )


def test_imports_are_kept_from_the_collector_of_garbage_and_what_comes_later_is_not():
    python(
        "import gc; from tcgsplat.cli.ahead import compiled_meanwhile\n"
        "with compiled_meanwhile():\n"
        "    import torch\n"
        "    assert not gc.isenabled()\n"
        "frozen = gc.get_freeze_count()\n"
        "assert gc.isenabled() and frozen > 100_000, frozen\n"
        "with compiled_meanwhile():\n"
        "    assert gc.isenabled()\n"
        "assert gc.get_freeze_count() <= frozen\n"
    )


def test_another_torch_is_imported_whole():
    """Only of the version that was tried is it known that nothing else hangs on what is left out."""
    python(
        "import sys; import tcgsplat.cli.imports as imports\n"
        "imports._KNOWN = 'no version'; imports.import_torch()\n"
        "import torch; torch.Generator()\n"
        "assert not isinstance(sys.modules[imports._SHAPES], imports._Postponed)\n"
    )
