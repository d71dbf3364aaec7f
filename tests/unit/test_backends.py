"""Choosing a rasterizer by name."""

import pytest
import torch

from tcgsplat.errors import BackendUnavailableError
from tcgsplat.render.backends import open_rasterizer

NO_GPU = pytest.mark.skipif(torch.cuda.is_available(), reason="a GPU is here")


def test_a_name_gives_that_backend() -> None:
    assert open_rasterizer("numba").name == "numba"
    assert open_rasterizer("reference").name == "reference"
    assert open_rasterizer("numba").device == torch.device("cpu")


@NO_GPU
def test_without_a_gpu_auto_is_the_cpu() -> None:
    assert open_rasterizer().name == "numba"


@NO_GPU
@pytest.mark.parametrize("name", ["cuda", "gsplat"])
def test_a_gpu_that_is_asked_for_and_not_there_is_never_replaced(name: str) -> None:
    with pytest.raises(BackendUnavailableError, match=rf"{name} needs an NVIDIA GPU: .*numba"):
        open_rasterizer(name)


@pytest.mark.skipif(torch.version.cuda is not None, reason="this torch is built with CUDA")
def test_auto_says_so_where_the_gpu_cannot_be_used(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A torch that sees a GPU and cannot use it."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert open_rasterizer().name == "numba"
    (record,) = caplog.records
    assert record.getMessage().startswith("the GPU is not used: the rasterizer cuda needs")
