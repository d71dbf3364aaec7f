"""The oracle against finite differences, and its planes against geometry."""

import math

import pytest
import torch

from tcgsplat.geometry import quaternion, se3
from tcgsplat.geometry.camera import Camera
from tcgsplat.render.protocol import Splats
from tcgsplat.render.reference import ReferenceRasterizer, project

CAMERA = Camera(fx=14.0, fy=15.0, cx=5.1, cy=3.9, width=11, height=9)


def test_gradcheck():
    g = torch.Generator().manual_seed(2)
    n = 6
    means = torch.rand(n, 3, generator=g, dtype=torch.float64) * torch.tensor([1.2, 0.8, 1.5]) + torch.tensor(
        [-0.6, -0.4, 1.0]
    )
    inputs = (
        means,
        torch.randn(n, 4, generator=g, dtype=torch.float64),
        0.1 + 0.3 * torch.rand(n, 3, generator=g, dtype=torch.float64),
        0.3 + 0.6 * torch.rand(n, generator=g, dtype=torch.float64),
        torch.rand(n, 2, generator=g, dtype=torch.float64),
        0.2 * torch.randn(6, generator=g, dtype=torch.float64),
    )

    def rendered(means, quats, scales, opacities, features, twist):
        T = torch.linalg.matrix_exp(
            torch.cat((torch.cat((se3.skew(twist[3:]), twist[:3, None]), 1), torch.zeros(1, 4, dtype=torch.float64)))
        )
        raster = ReferenceRasterizer()(Splats(means, quats, scales, opacities, features), CAMERA, T)
        # Alpha jumps at its 1/255 cut, and with it every sum; finite differences are only meaningful where no splat
        # is near the cut, so compare over pixels where the splats are strong.
        keep = raster.alpha.detach() > 0.3
        return tuple(x[keep] for x in (raster.features, raster.depth, raster.plane_depth, raster.alpha))

    assert torch.autograd.gradcheck(rendered, tuple(x.requires_grad_() for x in inputs), eps=1e-7, atol=2e-5, rtol=2e-3)


@pytest.mark.parametrize("tilt", [0.0, 0.5, 1.0])
def test_a_flat_splat_has_the_slope_of_its_plane(tilt: float):
    """A disc far larger than a pixel: its affine depth is the plane's depth to first order in the image."""
    camera = Camera(500.0, 500.0, 320.0, 240.0, 640, 480)
    center = torch.tensor([[0.2, -0.1, 2.0]], dtype=torch.float64)
    q = torch.tensor([[math.cos(tilt / 2), 0.0, math.sin(tilt / 2), 0.0]], dtype=torch.float64)
    scales = torch.tensor([[0.05, 0.05, 1e-6]], dtype=torch.float64)
    splats = Splats(center, q, scales, torch.ones(1, dtype=torch.float64), torch.ones(1, 1, dtype=torch.float64))
    slopes = project(splats, camera, se3.identity()).slopes[0]

    normal = quaternion.to_matrix(q)[0, :, 2]

    def plane_depth(u: float, v: float) -> float:
        ray = torch.tensor([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1.0], dtype=torch.float64)
        return float((normal @ center[0]) / (normal @ ray))

    u0, v0 = camera.project(center)[0].tolist()
    step = 1e-3
    assert float(slopes[0]) == pytest.approx((plane_depth(u0 + step, v0) - plane_depth(u0 - step, v0)) / 2e-3, abs=2e-5)
    assert float(slopes[1]) == pytest.approx((plane_depth(u0, v0 + step) - plane_depth(u0, v0 - step)) / 2e-3, abs=2e-5)
