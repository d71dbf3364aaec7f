"""The run-time checks of annotations are really there: they refuse what does not fit."""

import pytest
import shapes
import torch
from jaxtyping import TypeCheckError

from tcgsplat.geometry import se3
from tcgsplat.geometry.camera import Camera
from tcgsplat.mapping.schedule import ScheduleConfig
from tcgsplat.scene.gaussians import Gaussians


def test_a_wrong_shape_is_refused() -> None:
    with pytest.raises(TypeCheckError):
        se3.inverse(torch.eye(3))


def test_a_wrong_element_type_is_refused() -> None:
    empty = Gaussians.empty()
    with pytest.raises(TypeCheckError):
        empty.kept(torch.zeros(0))


def test_fields_must_agree_on_their_dimensions() -> None:
    with pytest.raises(TypeCheckError):
        Gaussians(
            ids=torch.zeros(3, dtype=torch.int64),
            means=torch.zeros(3, 3),
            log_scales=torch.zeros(3, 3),
            quats=torch.zeros(2, 4),
            logit_opacities=torch.zeros(3),
            sh=torch.zeros(3, 1, 3),
        )


def test_an_int_may_stand_for_a_float() -> None:
    assert Camera(fx=50, fy=50, cx=10, cy=10, width=20, height=20).scaled(0.5).fx == 25


def test_settings_are_left_to_their_own_checks() -> None:
    with pytest.raises(Exception, match="choose motion or interval"):
        ScheduleConfig(submap_by="mood")  # type: ignore[arg-type]


def test_all_modules_are_checked_but_those_with_kernels() -> None:
    checked = shapes.checkable_modules()
    assert {"tcgsplat.slam", "tcgsplat.tracking.alignment", "tcgsplat.mapping.mapper"} <= set(checked)
    kernels = {"tracking.alignment_kernels", "render.numba_cpu.simd", "render.numba_cpu.blending"}
    assert not {f"tcgsplat.{name}" for name in kernels} & set(checked)
