"""The way of a kernel's text to a GPU and back, through libraries that stand in for NVRTC and the driver."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from emulated_cuda import COMPILER

pytestmark = pytest.mark.skipif(COMPILER is None or sys.platform != "linux", reason="no C++ compiler to emulate with")

EMULATION = Path(__file__).parents[1] / "emulation"

DRAW = """
import sys
from types import SimpleNamespace
import torch
from tcgsplat.render import reference
from tcgsplat.render.cuda import CudaRasterizer, launching
from test_numba_cpu import draw, images, random_inputs

launching._nvrtc_names = lambda: ["libnvrtc.so"]  # the one of this test, though another may be installed
torch.cuda.get_device_capability = lambda device: (9, 0)
torch.cuda.current_stream = lambda device: SimpleNamespace(cuda_stream=7, synchronize=lambda: None)
inputs = random_inputs(60, 1)
leaves = {k: (v if k == "T_cam_map" else v.float()).clone().requires_grad_() for k, v in inputs.items()}
drawn = images(draw(CudaRasterizer(torch.device("cpu")), leaves))
drawn.sum().backward()
expected = images(draw(reference.ReferenceRasterizer(), inputs))
assert (drawn.double() - expected).abs().mean() < 1e-4
assert all(leaf.grad.abs().sum() > 0 for leaf in leaves.values())
"""

REFUSE = """
import torch
from types import SimpleNamespace
from tcgsplat.errors import BackendUnavailableError
from tcgsplat.render.cuda import launching
from tcgsplat.render.cuda.launching import Compiled, compiled, nvrtc_library
from tcgsplat.render.cuda.rasterizer import kernel_text

launching._nvrtc_names = lambda: ["libnvrtc.so"]
torch.cuda.get_device_capability = lambda device: (9, 0)
torch.cuda.current_stream = lambda device: SimpleNamespace(cuda_stream=7, synchronize=lambda: None)
try:
    compiled(nvrtc_library(), kernel_text(4) + "int x = nonsense;", "sm_90")
except BackendUnavailableError as error:
    assert "does not compile the kernels for sm_90" in str(error) and "nonsense" in str(error), error
else:
    raise SystemExit("nothing was refused")
kernels = Compiled("struct Fill { float* out; int n; };\\nKERNEL(fill, Fill) { a.out[threadIdx.x] = a.n; }".replace(
    "{ float* out; int n; };", "{\\n    float* out;\\n    int n;\\n};"), torch.device("cpu"))
out = torch.zeros(256)
kernels.launch("fill", 1, {"out": out, "n": 3})
assert (out == 3).all()
try:
    kernels.launch("fill", 0, {"out": out, "n": 4})
except BackendUnavailableError as error:
    assert "the CUDA driver refuses cuLaunchKernel: invalid argument" in str(error), error
else:
    raise SystemExit("nothing was refused")
"""


@pytest.fixture(scope="module")
def libraries(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """An environment in which NVRTC and the driver are to be found."""
    folder, cache = tmp_path_factory.mktemp("libraries"), tmp_path_factory.mktemp("cache")
    made, flags = folder / "libcuda.so.1", ["-std=c++17", "-shared", "-fPIC"]
    subprocess.run([str(COMPILER), *flags, str(EMULATION / "libraries.cpp"), "-o", str(made), "-ldl"], check=True)
    (folder / "libnvrtc.so").symlink_to(made)
    tests = Path(__file__).parents[1]
    return os.environ | {
        "LD_LIBRARY_PATH": str(folder),
        "XDG_CACHE_HOME": str(cache),
        "EMULATED_CUDA": str(EMULATION / "cuda.h"),
        "EMULATED_CXX": str(COMPILER),
        "PYTHONPATH": os.pathsep.join([str(tests), str(tests / "parity"), *sys.path]),
    }


def run(script: str, environment: dict[str, str]) -> None:
    done = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_a_view_is_drawn_and_differentiated_and_the_code_is_kept(libraries: dict[str, str]):
    kept = Path(libraries["XDG_CACHE_HOME"]) / "tcgsplat"
    run(DRAW, libraries)
    (first,) = kept.iterdir()
    made = first.stat().st_mtime_ns
    run(DRAW, libraries)
    (again,) = kept.iterdir()
    assert again.stat().st_mtime_ns == made, "compiled again, though it was there"


def test_what_the_libraries_refuse_is_said(libraries: dict[str, str]):
    run(REFUSE, libraries)
