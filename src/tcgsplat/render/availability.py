"""What keeps this machine from drawing on a GPU: sentences, each with the command that mends it.

To find out, nothing is compiled, and torch is asked last: it tells that there is no GPU, and rarely why.
"""

import ctypes
import importlib.util
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from tcgsplat.errors import BackendUnavailableError
from tcgsplat.geometry import se3
from tcgsplat.geometry.camera import Camera
from tcgsplat.render.protocol import Rasterizer, Splats
from tcgsplat.render.reference import ReferenceRasterizer

_DIFFERENTIATED = ("means", "quats", "scales", "opacities", "features", "pose")
_CHANNELS = (4, 2)
"""Of features, as `render.view` has them drawn."""
_ALIKE = 5e-3
"""Of a norm: a hundred times what GPUs' quick exponentials and divisions do, far less than any mistake does."""
_NO_DEVICE, _OTHER_DRIVER = 100, 803  # CUDA_ERROR_NO_DEVICE, CUDA_ERROR_SYSTEM_DRIVER_MISMATCH


@dataclass(frozen=True)
class Driver:
    """NVIDIA's driver, asked without torch."""

    cuda: tuple[int, int]
    """Newest version of CUDA that it runs; of an older one, every minor version of this major one."""
    status: int
    """What starting it gives: 0 if there is a GPU, else an error of CUDA's driver."""

    def __str__(self) -> str:
        """For a sentence."""
        return f"CUDA {self.cuda[0]}.{self.cuda[1]}"


def driver_library() -> ctypes.CDLL:
    """Its C interface.

    Raises:
        OSError: if there is none.
    """
    return ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")


def driver() -> Driver | None:
    """The one that is installed, or None."""
    number = ctypes.c_int()
    try:
        library = driver_library()
        library.cuDriverGetVersion(ctypes.byref(number))
        return Driver((number.value // 1000, number.value % 1000 // 10), library.cuInit(0))
    except (OSError, AttributeError):  # no such file; a file that is something else
        return None


def torch_with_cuda(found: Driver | None) -> str:
    """The command that installs a torch which this driver can run."""
    newest = found.cuda if found else (13, 0)
    build = "cu130" if newest >= (13, 0) else "cu128" if newest >= (12, 8) else "cu126"
    return _install(build)


def _install(build: str) -> str:
    return f"`pip install --force-reinstall torch --index-url https://download.pytorch.org/whl/{build}`"


def driver_obstacles(found: Driver | None) -> tuple[str, ...]:
    """Why the driver does not give a GPU to anybody."""
    if found is None:
        return (
            "there is no NVIDIA driver (libcuda cannot be loaded); where there is an NVIDIA GPU, install it (`sudo "
            "ubuntu-drivers install` on Ubuntu, else from https://www.nvidia.com/drivers), or start the container with "
            "`--gpus all`",
        )
    if found.status == _NO_DEVICE:
        shown = os.environ.get("CUDA_VISIBLE_DEVICES")
        hidden = f"; CUDA_VISIBLE_DEVICES is {shown!r}: `unset CUDA_VISIBLE_DEVICES`" if shown is not None else ""
        return (f"the driver ({found}) sees no GPU; `nvidia-smi -L` must list one{hidden}",)
    if found.status == _OTHER_DRIVER:
        return ("the driver's library and its kernel module differ in version: `sudo reboot` after an update",)
    if found.status:
        return (f"the driver ({found}) does not start, error {found.status}; `nvidia-smi` tells more",)
    return ()


def torch_obstacles(built: str | None, found: Driver | None) -> tuple[str, ...]:
    """Why this torch cannot use that driver.

    Args:
        built: The version of CUDA that torch is built for, or None.
        found: The driver, or None.
    """
    if built is None:
        return (f"torch {torch.__version__} is built without CUDA: {torch_with_cuda(found)}",)
    if found and found.cuda[0] < int(built.split(".")[0]):
        return (
            f"the driver runs {found} at most and torch is built for CUDA {built}: update the driver, or "
            f"{torch_with_cuda(found)}",
        )
    return ()


def gpu_obstacles() -> tuple[str, ...]:
    """Why torch cannot use a GPU here; none if it can."""
    found = driver()
    obstacles = driver_obstacles(found) + torch_obstacles(torch.version.cuda, found)
    if obstacles:
        return obstacles
    try:
        torch.cuda.init()  # type: ignore[no-untyped-call]
    except (RuntimeError, AssertionError) as error:
        said = str(error).partition("\n")[0]
        return (f"torch finds no GPU ({said}); `nvidia-smi` tells whether the driver does",)
    name, capability = torch.cuda.get_device_name(), torch.cuda.get_device_capability()
    return architecture_obstacles(name, capability, torch.cuda.get_arch_list())


def architecture_obstacles(name: str, capability: tuple[int, int], built: Sequence[str]) -> tuple[str, ...]:
    """Why this torch has no kernels for that GPU.

    Args:
        name: Of the GPU.
        capability: Its compute capability.
        built: What torch is built for: `sm_86` runs on 8.6 and later ones of 8, `compute_86` on all later ones.
    """
    own = 10 * capability[0] + capability[1]
    known = {entry: int(re.sub(r"\D", "", entry)) for entry in built}
    if any(n <= own and (entry.startswith("compute") or n // 10 == own // 10) for entry, n in known.items()):
        return ()
    build = "cu126" if own < min(known.values(), default=0) else "cu130"  # which still has the oldest; the newest
    return (
        f"{name} has compute capability {capability[0]}.{capability[1]}, and this torch is built for "
        f"{', '.join(built)}: {_install(build)}",
    )


def toolkit() -> Path | None:
    """Folder of CUDA's compiler, looked for where torch's builder of extensions does."""
    named = os.environ.get("CUDA_HOME") or os.environ.get("CUDA_PATH")
    found = shutil.which("nvcc")
    home = Path(named) if named else Path(found).parents[1] if found else Path("/usr/local/cuda")
    return home if (home / "bin" / "nvcc").exists() or (home / "bin" / "nvcc.exe").exists() else None


def toolkit_version(home: Path) -> str:
    """Such as 12.8; empty if its compiler does not tell."""
    done = subprocess.run([home / "bin" / "nvcc", "--version"], capture_output=True, text=True, check=False)
    found = re.search(r"release (\d+\.\d+)", done.stdout)
    return found[1] if found else ""


def compiler_obstacles(built: str) -> tuple[str, ...]:
    """What is missing to compile an extension for a torch that is built for this version of CUDA."""
    obstacles = []
    home = toolkit()
    advice = f"https://developer.nvidia.com/cuda-toolkit-archive, or `conda install -c nvidia cuda-toolkit={built}`"
    if home is None:
        obstacles.append(f"there is no nvcc, neither in CUDA_HOME nor on the PATH: install CUDA {built} ({advice})")
    elif (version := toolkit_version(home)).split(".")[0] != built.split(".")[0]:
        obstacles.append(
            f"nvcc in {home} is of CUDA {version or 'unknown'} and torch is built for CUDA {built}: set CUDA_HOME to "
            f"the folder of CUDA {built} ({advice})"
        )
    compiler = os.environ.get("CXX") or ("cl" if sys.platform == "win32" else "c++")
    if shutil.which(compiler) is None:
        obstacles.append(f"there is no C++ compiler ({compiler}): `sudo apt install g++`")
    if shutil.which("ninja") is None:
        obstacles.append("ninja is not on the PATH: `pip install ninja`, and activate the environment it is in")
    return tuple(obstacles)


def extension_obstacles() -> tuple[str, ...]:
    """Why gsplat cannot be loaded or compiled, as far as one sees without doing so."""
    missing = [name for name in ("gsplat", "packaging") if importlib.util.find_spec(name) is None]
    if missing:
        return (f"{' and '.join(missing)} not installed: `pip install 'tcgsplat[gsplat]'`", *_compilers())
    return () if importlib.util.find_spec("gsplat.csrc") else _compilers()  # there, it was compiled by others


def _compilers() -> tuple[str, ...]:
    """Of this torch; one without CUDA compiles nothing, and with which CUDA the next one will be is not known."""
    return compiler_obstacles(torch.version.cuda) if torch.version.cuda else ()


def prove(rasterizer: Rasterizer) -> None:
    """Draw a few splats, and hold the picture and its derivatives to the oracle's.

    Then all that a backend compiles or loads is there, and works on this very machine.

    Raises:
        BackendUnavailableError: if it cannot draw, or draws something else.
    """
    for channels in _CHANNELS:
        expected, found = (_derivatives(one, channels) for one in (ReferenceRasterizer(), rasterizer))
        for what, a, b in zip(("picture", *_DIFFERENTIATED), expected, found, strict=True):
            apart = float((a - b).norm() / a.norm())
            if not apart < _ALIKE:
                raise BackendUnavailableError(
                    f"{rasterizer.name} draws wrongly on this machine ({what}: {apart:.2g} from what it should be); "
                    "please report it with what `tcgsplat doctor` prints, and use `--backend numba`"
                )


def _derivatives(rasterizer: Rasterizer, channels: int) -> list[Tensor]:
    """A small picture of twelve splats, and the derivatives of a sum over it, on the CPU."""
    place = torch.linspace(0.0, 1.0, 12)
    across, down = torch.sin(9.0 * place), torch.cos(5.0 * place)
    values = (
        torch.stack((0.5 * across, 0.4 * down, 1.5 + place), dim=-1),
        torch.stack((torch.ones(12), across, down, place), dim=-1),
        torch.stack((0.05 + 0.1 * place, 0.12 - 0.05 * place, 0.03 + 0.02 * across), dim=-1),
        0.2 + 0.5 * place,
        torch.stack((place, across.abs(), down.abs(), 1.0 - place), dim=-1)[:, :channels],
    )
    tensors = [value.to(rasterizer.device).requires_grad_() for value in values]
    pose = se3.exp(torch.tensor([0.02, -0.03, 0.05, 0.03, 0.02, -0.04], dtype=torch.float64)).requires_grad_()
    with torch.enable_grad():
        drawn = rasterizer(Splats(*tensors), Camera(fx=40.0, fy=42.0, cx=19.3, cy=14.8, width=40, height=30), pose)
        planes = torch.stack((drawn.depth, drawn.plane_depth, drawn.alpha), dim=-1)
        image = torch.cat((drawn.features, planes), dim=-1)
        derivatives = torch.autograd.grad(image.square().sum(), (*tensors, pose))
    return [tensor.detach().cpu() for tensor in (image, *derivatives)]
