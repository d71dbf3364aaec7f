"""The run-time checks of annotations are really there: they refuse what does not fit."""

from collections.abc import Callable

import pytest
import shapes
import torch
from beartype.roar import BeartypeCallHintViolation
from jaxtyping import Float
from torch import Tensor

from tcgsplat.geometry import se3
from tcgsplat.geometry.camera import Camera
from tcgsplat.mapping.schedule import ScheduleConfig
from tcgsplat.scene.gaussians import Gaussians
from tcgsplat.tensors import Pose


def test_a_wrong_shape_is_refused() -> None:
    with pytest.raises(BeartypeCallHintViolation):
        se3.inverse(torch.eye(3))


def test_a_wrong_element_type_is_refused() -> None:
    empty = Gaussians.empty()
    with pytest.raises(BeartypeCallHintViolation):
        empty.kept(torch.zeros(0))


def test_fields_must_agree_on_their_dimensions() -> None:
    with pytest.raises(BeartypeCallHintViolation):
        Gaussians(
            ids=torch.zeros(3, dtype=torch.int64),
            means=torch.zeros(3, 3),
            log_scales=torch.zeros(3, 3),
            quats=torch.zeros(2, 4),
            logit_opacities=torch.zeros(3),
            sh=torch.zeros(3, 1, 3),
        )


@pytest.mark.parametrize("rows", [2, 3])
def test_a_name_means_one_number_in_arguments_and_result_of_a_call(rows: int) -> None:
    @shapes.checked
    def some(points: Float[Tensor, "n 3"], weights: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
        return weights[:2]

    if rows == 2:
        some(torch.zeros(2, 3), torch.zeros(2))
    with pytest.raises(BeartypeCallHintViolation, match="some"):
        some(torch.zeros(3, 3), torch.zeros(rows))


def test_where_there_are_no_arrays_everything_else_is_checked() -> None:
    assert not any(shapes.has_shape(hint) for hint in Camera.scaled.__annotations__.values() if hint is not Camera)
    with pytest.raises(BeartypeCallHintViolation, match="factor"):
        Camera(fx=50, fy=50, cx=10, cy=10, width=20, height=20).scaled("half")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("hint", "has"),
    [(Float[Tensor, "4 4"], True), (list[Pose] | None, True), (Callable[[Pose], None], True), ("Pose", True),
     (Tensor, False), (tuple[int, ...], False), (Callable[..., float], False), (None, False)],
)  # fmt: skip
def test_arrays_are_found_in_annotations(hint: object, has: bool) -> None:
    assert shapes.has_shape(hint) is has


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
