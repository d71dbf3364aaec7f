"""What is said of a machine without a GPU, or with one that does not work yet."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from tcgsplat.errors import BackendUnavailableError
from tcgsplat.geometry.camera import Camera
from tcgsplat.render.availability import (
    Driver,
    architecture_obstacles,
    compiler_obstacles,
    driver_obstacles,
    extension_obstacles,
    gpu_obstacles,
    prove,
    torch_obstacles,
    torch_with_cuda,
)
from tcgsplat.render.protocol import Raster, Rasterizer, Splats
from tcgsplat.tensors import Pose

INDEX = "--index-url https://download.pytorch.org/whl/"


@pytest.mark.parametrize(
    ("found", "build"),
    [
        (None, "cu130"),
        (Driver((13, 1), 0), "cu130"),
        (Driver((12, 9), 0), "cu128"),
        (Driver((12, 2), 0), "cu126"),
    ],
)
def test_the_torch_that_is_proposed_fits_the_driver(found: Driver | None, build: str) -> None:
    assert torch_with_cuda(found) == f"`pip install --force-reinstall torch {INDEX}{build}`"


def test_no_driver_is_said_with_how_to_get_one() -> None:
    (sentence,) = driver_obstacles(None)
    assert "no NVIDIA driver" in sentence and "ubuntu-drivers install`" in sentence and "--gpus all" in sentence


def test_a_hidden_gpu_is_said_with_what_hides_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    (sentence,) = driver_obstacles(Driver((12, 4), 100))
    assert "sees no GPU" in sentence and "`unset CUDA_VISIBLE_DEVICES`" in sentence
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES")
    (sentence,) = driver_obstacles(Driver((12, 4), 100))
    assert "CUDA 12.4" in sentence and "nvidia-smi" in sentence and "VISIBLE" not in sentence


def test_a_driver_that_does_not_start_is_said() -> None:
    assert "reboot" in driver_obstacles(Driver((12, 4), 803))[0]
    assert "error 999" in driver_obstacles(Driver((12, 4), 999))[0]
    assert driver_obstacles(Driver((12, 4), 0)) == ()


def test_a_torch_that_does_not_fit_is_said() -> None:
    (sentence,) = torch_obstacles(None, Driver((12, 8), 0))
    assert "without CUDA" in sentence and f"{INDEX}cu128`" in sentence
    (sentence,) = torch_obstacles("13.0", Driver((12, 2), 0))
    assert "at most" in sentence and f"{INDEX}cu126`" in sentence and "update the driver" in sentence
    assert torch_obstacles("12.8", Driver((12, 2), 0)) == ()  # minor versions run each other's programs
    assert torch_obstacles("12.8", Driver((13, 0), 0)) == ()


@pytest.mark.parametrize(
    ("capability", "built", "build"),
    [
        ((8, 9), ["sm_80", "sm_86", "sm_90"], None),
        ((6, 1), ["sm_75", "sm_80"], "cu126"),
        ((12, 0), ["sm_80", "sm_90"], "cu130"),
        ((12, 0), ["sm_80", "sm_90", "compute_90"], None),
        ((8, 0), ["sm_86"], "cu126"),
    ],
)
def test_a_gpu_that_torch_has_no_kernels_for_is_said(
    capability: tuple[int, int], built: list[str], build: str | None
) -> None:
    said = architecture_obstacles("GeForce", capability, built)
    assert [f"{INDEX}{build}`" in sentence and "GeForce" in sentence for sentence in said] == [True] * (
        build is not None
    )


def toolkit(folder: Path, release: str) -> Path:
    """A folder with an nvcc that only tells its version, and the other tools."""
    (folder / "bin").mkdir()
    for name, says in (
        ("nvcc", f"Cuda compilation tools, release {release}, V{release}.88"),
        ("c++", ""),
        ("ninja", ""),
    ):
        tool = folder / "bin" / name
        tool.write_text(f"#!/bin/sh\necho '{says}'\n")
        tool.chmod(0o755)
    return folder


def test_tools_that_fit_are_no_obstacle(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CUDA_HOME", str(toolkit(tmp_path, "12.9")))
    monkeypatch.setenv("PATH", f"{tmp_path}/bin:/usr/bin:/bin")
    monkeypatch.delenv("CXX", raising=False)
    assert compiler_obstacles("12.8") == ()
    (sentence,) = compiler_obstacles("13.0")
    assert "of CUDA 12.9" in sentence and "built for CUDA 13.0" in sentence and "CUDA_HOME" in sentence


def test_each_tool_that_is_missing_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CUDA_HOME", str(tmp_path))
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setenv("CXX", "g++-12")
    nvcc, compiler, ninja = compiler_obstacles("12.8")
    assert "no nvcc" in nvcc and "cuda-toolkit=12.8" in nvcc
    assert "(g++-12)" in compiler and "`sudo apt install g++`" in compiler
    assert "`pip install ninja`" in ninja


def test_what_is_found_here_is_what_torch_finds() -> None:
    assert (gpu_obstacles() == ()) is torch.cuda.is_available()
    for sentence in (*gpu_obstacles(), *extension_obstacles()):
        assert "`" in sentence and "\n" not in sentence, "names the command that mends it"


class Blurring:
    """A rasterizer that is wrong in one thing."""

    name, device = "blurring", torch.device("cpu")

    def __init__(self, rasterizer: Rasterizer, wrong: str) -> None:
        self._rasterizer, self._wrong, self.reserved = rasterizer, wrong, rasterizer.reserved

    def __call__(self, splats: Splats, camera: Camera, T_cam_map: Pose) -> Raster:
        if self._wrong == "pose":
            return self._rasterizer(splats, camera, T_cam_map.detach() + 0.9 * (T_cam_map - T_cam_map.detach()))
        if self._wrong == "scales":
            splats = replace(splats, scales=splats.scales.detach() + 0.9 * (splats.scales - splats.scales.detach()))
        drawn = self._rasterizer(splats, camera, T_cam_map)
        return replace(drawn, plane_depth=drawn.depth) if self._wrong == "picture" else drawn


def test_a_rasterizer_proves_itself_unless_it_draws_wrongly(rasterizer: Rasterizer) -> None:
    prove(rasterizer)
    prove(Blurring(rasterizer, "nothing"))
    for wrong in ("picture", "pose", "scales"):
        with pytest.raises(BackendUnavailableError, match=rf"blurring draws wrongly .*\({wrong}"):
            prove(Blurring(rasterizer, wrong))
