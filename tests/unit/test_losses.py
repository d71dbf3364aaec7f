"""Image errors, and structural similarity against its definition written out."""

import math

import numpy as np
import pytest
import torch
from analytic_room import Room, pose
from torch import Tensor

from tcgsplat.render.losses import color_error, depth_error, isotropy_error, ssim_map


def ssim_by_definition(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Wang et al. 2004, one window at a time: an 11 x 11 Gaussian of sigma 1.5, zeros beyond the border."""
    h, w, channels = a.shape
    offsets = np.arange(-5, 6)
    window = np.exp(-0.5 * (offsets[:, None] ** 2 + offsets[None, :] ** 2) / 1.5**2)
    window /= window.sum()
    c1, c2 = 0.01**2, 0.03**2
    out = np.empty_like(a)
    for channel in range(channels):
        x, y = (np.pad(image[..., channel], 5) for image in (a, b))
        for v in range(h):
            for u in range(w):
                px, py = x[v : v + 11, u : u + 11], y[v : v + 11, u : u + 11]
                mx, my = (window * px).sum(), (window * py).sum()
                vx, vy = (window * (px - mx) ** 2).sum(), (window * (py - my) ** 2).sum()
                cov = (window * (px - mx) * (py - my)).sum()
                out[v, u, channel] = (2 * mx * my + c1) * (2 * cov + c2) / ((mx * mx + my * my + c1) * (vx + vy + c2))
    return out


def pair(height: int = 17, width: int = 14, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    g = torch.Generator().manual_seed(0)
    a = torch.rand(height, width, 3, generator=g, dtype=torch.float64)
    b = (0.7 * a + 0.3 * torch.rand(height, width, 3, generator=g, dtype=torch.float64)).clamp(0, 1)
    return a.to(dtype), b.to(dtype)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-10), (torch.float32, 2e-5)])
def test_ssim_is_its_definition(dtype: torch.dtype, tolerance: float) -> None:
    a, b = pair()
    expected = ssim_by_definition(a.numpy(), b.numpy())
    np.testing.assert_allclose(ssim_map(a.to(dtype), b.to(dtype)).numpy(), expected, atol=tolerance)


def test_ssim_gradient_is_the_derivative() -> None:
    a, b = pair(9, 8)
    weights = torch.rand(a.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda x: (weights * ssim_map(x, b)).sum(), a.requires_grad_())


def test_the_fast_path_has_the_gradient_of_the_exact_one() -> None:
    """On the CPU and in float32 the window is OpenCV's."""
    frames = [Room().frame().color, Room().frame(pose(0.02, degrees=(0, 1, 0))).color]
    gradients = []
    for dtype in (torch.float32, torch.float64):
        a, b = frames[0].to(dtype, copy=True).requires_grad_(), frames[1].to(dtype)
        (1 - ssim_map(a, b).mean()).backward()
        assert a.grad is not None
        gradients.append(a.grad.double())
    scale = float(gradients[1].abs().max())
    assert float((gradients[0] - gradients[1]).abs().max()) < 1e-3 * scale


def test_the_fast_path_takes_images_however_they_lie_in_memory() -> None:
    a, b = pair(dtype=torch.float32)
    planar = a.permute(2, 0, 1).contiguous().permute(1, 2, 0)
    assert not planar.is_contiguous()
    torch.testing.assert_close(ssim_map(planar, b), ssim_map(a, b))


def test_ssim_of_equal_images_is_one_and_symmetric() -> None:
    a, b = pair()
    torch.testing.assert_close(ssim_map(a, a), torch.ones_like(a))
    torch.testing.assert_close(ssim_map(a, b), ssim_map(b, a))
    assert (ssim_map(a, 1 - a) < ssim_map(a, b)).double().mean() > 0.9


def test_ssim_and_its_gradient_are_finite_on_black() -> None:
    black = torch.zeros(16, 16, 3, requires_grad=True)
    ssim_map(black, torch.rand(16, 16, 3, generator=torch.Generator().manual_seed(0))).mean().backward()
    assert black.grad is not None and black.grad.isfinite().all()


def test_an_image_smaller_than_the_window() -> None:
    a, b = pair(3, 4)
    np.testing.assert_allclose(ssim_map(a, b).numpy(), ssim_by_definition(a.numpy(), b.numpy()), atol=1e-10)
    np.testing.assert_allclose(ssim_map(a.float(), b.float()).numpy(), ssim_map(a, b).numpy(), atol=2e-5)


def test_color_error_is_the_mean_over_channels() -> None:
    rendered, observed = torch.tensor([[[0.1, 0.5, 0.9]]]), torch.tensor([[[0.4, 0.5, 0.3]]])
    torch.testing.assert_close(color_error(rendered, observed), torch.tensor([[0.3]]))


def test_depth_error_is_zero_and_without_gradient_where_there_is_no_reading() -> None:
    rendered = torch.tensor([[1.0, 2.0, 3.0]], requires_grad=True)
    error = depth_error(rendered, torch.tensor([[1.5, 0.0, 2.0]]))
    torch.testing.assert_close(error, torch.tensor([[0.5, 0.0, 1.0]]))
    error.sum().backward()
    assert rendered.grad is not None
    assert rendered.grad.tolist() == [[-1.0, 0.0, 1.0]]


def test_isotropy_error_by_hand() -> None:
    scales = torch.tensor([[0.1, 0.2, 0.3], [0.2, 0.2, 0.2]])
    assert math.isclose(float(isotropy_error(scales)), (0.1 + 0.0 + 0.1) / 6, rel_tol=1e-5)
