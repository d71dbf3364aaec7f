"""Image measures by hand, and SSIM against the definition written out in loops."""

import math

import numpy as np
import pytest
import torch
from scipy import ndimage

from tcgsplat.evaluation import images


def noisy_pair(generator: torch.Generator, height: int = 19, width: int = 23) -> tuple[torch.Tensor, torch.Tensor]:
    a = torch.rand(height, width, 3, generator=generator)
    return a, (a + 0.1 * torch.randn(height, width, 3, generator=generator)).clamp(0, 1)


def test_psnr_by_hand() -> None:
    a, b = torch.full((4, 6, 3), 0.5), torch.full((4, 6, 3), 0.6)
    valid = torch.ones(4, 6, dtype=torch.bool)
    assert images.psnr(a, b, valid) == pytest.approx(20.0, abs=1e-4)  # -10 log10(0.1^2)
    b[0, :, 1] = 5.0
    valid[0] = False
    assert images.psnr(a, b, valid) == pytest.approx(20.0, abs=1e-4)
    assert images.psnr(a, a, valid) == 100.0
    assert math.isnan(images.psnr(a, b, torch.zeros(4, 6, dtype=torch.bool)))


def test_depth_l1_by_hand() -> None:
    a, b = torch.tensor([[1.0, 2.0], [3.0, 0.0]]), torch.tensor([[1.5, 2.0], [9.0, 2.0]])
    assert images.depth_l1(a, b, torch.tensor([[True, True], [False, False]])) == pytest.approx(0.25)
    assert images.depth_l1(a, b, torch.tensor([[False, False], [False, True]])) == pytest.approx(2.0)
    assert math.isnan(images.depth_l1(a, b, torch.zeros(2, 2, dtype=torch.bool)))


def ssim_by_definition(a: np.ndarray, b: np.ndarray, valid: np.ndarray) -> float:
    """Wang et al. 2004, one window after the other; means and variances as weighted sums about the mean."""
    y, x = np.mgrid[-5:6, -5:6]
    weights = np.exp(-(x**2 + y**2) / (2 * 1.5**2))
    weights /= weights.sum()
    values = []
    for row in range(5, a.shape[0] - 5):
        for column in range(5, a.shape[1] - 5):
            window = np.s_[row - 5 : row + 6, column - 5 : column + 6]
            if not valid[window].all():
                continue
            for channel in range(3):
                p, q = a[window][..., channel], b[window][..., channel]
                mp, mq = (weights * p).sum(), (weights * q).sum()
                vp, vq = (weights * (p - mp) ** 2).sum(), (weights * (q - mq) ** 2).sum()
                cov = (weights * (p - mp) * (q - mq)).sum()
                values.append((2 * mp * mq + 1e-4) * (2 * cov + 9e-4) / ((mp**2 + mq**2 + 1e-4) * (vp + vq + 9e-4)))
    return float(np.mean(values))


def test_ssim_is_its_definition(generator: torch.Generator) -> None:
    a, b = noisy_pair(generator)
    valid = torch.ones(19, 23, dtype=torch.bool)
    whole = ssim_by_definition(a.double().numpy(), b.double().numpy(), valid.numpy())
    assert images.ssim(a, b, valid) == pytest.approx(whole, abs=2e-6)
    valid[:2] = False
    valid[9, 22] = False
    masked = ssim_by_definition(a.double().numpy(), b.double().numpy(), valid.numpy())
    assert images.ssim(a, b, valid) == pytest.approx(masked, abs=2e-6)
    assert abs(masked - whole) > 1e-4


def test_ssim_ends() -> None:
    a = torch.rand(16, 16, 3, generator=torch.Generator().manual_seed(1))
    valid = torch.ones(16, 16, dtype=torch.bool)
    assert images.ssim(a, a, valid) == pytest.approx(1.0)
    assert images.ssim(a, 1 - a, valid) < 0.0
    assert math.isnan(images.ssim(a, a, torch.zeros(16, 16, dtype=torch.bool)))


def test_ssim_does_not_see_invalid_pixels(generator: torch.Generator) -> None:
    a, b = noisy_pair(generator)
    valid = torch.ones(19, 23, dtype=torch.bool)
    valid[:, :3] = False
    spoiled = b.clone()
    spoiled[:, :3] = 0.0
    assert images.ssim(a, spoiled, valid) == pytest.approx(images.ssim(a, b, valid), abs=1e-6)


def ms_ssim_by_definition(a: np.ndarray, b: np.ndarray, valid: np.ndarray) -> float:
    """Wang et al. 2003 with pytorch_msssim's halving, by scipy and slices."""
    product = np.ones(3)
    for scale, exponent in enumerate((0.0448, 0.2856, 0.3001, 0.2363, 0.1333)):
        if scale:
            a, b, valid = (halved(x, x.shape[0] % 2, x.shape[1] % 2) for x in (a, b, valid))
        whole = ndimage.binary_erosion(valid == 1, np.ones((11, 11)))  # beyond the border nothing is valid

        def mean(x: np.ndarray) -> np.ndarray:
            return np.stack([ndimage.gaussian_filter(x[..., c], 1.5, radius=5) for c in range(3)])[:, whole]  # noqa: B023

        ma, mb = mean(a), mean(b)
        va, vb, cov = mean(a * a) - ma**2, mean(b * b) - mb**2, mean(a * b) - ma * mb
        similar = (2 * cov + 9e-4) / (va + vb + 9e-4)
        if scale == 4:
            similar = similar * (2 * ma * mb + 1e-4) / (ma**2 + mb**2 + 1e-4)
        product *= similar.mean(axis=1).clip(0) ** exponent
    return float(product.mean())


def halved(x: np.ndarray, odd_rows: int, odd_columns: int) -> np.ndarray:
    """Means of 2 x 2; of a mask 1 where all that are real are valid."""
    fill = 1.0 if x.ndim == 2 else 0.0
    x = np.pad(x, [(odd_rows, 0), (odd_columns, 0), (0, 0)][: x.ndim], constant_values=fill)
    x = (x[::2] + x[1::2]) / 2
    x = (x[:, ::2] + x[:, 1::2]) / 2
    return (x == 1).astype(float) if x.ndim == 2 else x


@pytest.mark.parametrize("size", [(161, 203), (192, 256)])
def test_ms_ssim_is_its_definition(generator: torch.Generator, size: tuple[int, int]) -> None:
    a, b = noisy_pair(generator, *size)
    valid = torch.ones(*size, dtype=torch.bool)
    whole = ms_ssim_by_definition(a.double().numpy(), b.double().numpy(), valid.double().numpy())
    assert images.ms_ssim(a, b, valid) == pytest.approx(whole, abs=1e-9)
    valid[:, 190:] = False
    b[:, 190:] = 0.0
    masked = ms_ssim_by_definition(a.double().numpy(), b.double().numpy(), valid.double().numpy())
    assert images.ms_ssim(a, b, valid) == pytest.approx(masked, abs=1e-9)
    assert abs(masked - whole) > 1e-6
    spoiled = b.clone()
    spoiled[:, 190:] = 1.0
    assert images.ms_ssim(a, spoiled, valid) == pytest.approx(masked, abs=1e-9)


def test_ms_ssim_ends() -> None:
    a = torch.rand(161, 161, 3, generator=torch.Generator().manual_seed(1))
    valid = torch.ones(161, 161, dtype=torch.bool)
    assert images.ms_ssim(a, a, valid) == pytest.approx(1.0)
    assert images.ms_ssim(a, 1 - a, valid) == 0.0
    assert math.isnan(images.ms_ssim(a[:160], a[:160], valid[:160]))
    valid[:, 80] = False  # at the coarsest scale there is no window left beside it
    assert math.isnan(images.ms_ssim(a, a, valid))
