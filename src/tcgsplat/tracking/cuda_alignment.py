"""Direct alignment on a GPU: the solver of alignment.py, whose passes follow one another without being waited for."""

from dataclasses import replace
from functools import cache

import numpy as np
import torch
from torch import Tensor

from tcgsplat.geometry import se3
from tcgsplat.geometry.camera import Camera
from tcgsplat.render.cuda.launching import THREADS, Compiled, Kernels, source
from tcgsplat.render.view import Rendering
from tcgsplat.scene.frame import Frame
from tcgsplat.tensors import Plane, Pose
from tcgsplat.tracking import alignment as cpu
from tcgsplat.tracking import alignment_kernels as cpu_kernels
from tcgsplat.tracking.alignment import Alignment, Photometry, concluded
from tcgsplat.tracking.pyramids import SOLID
from tcgsplat.tracking.reference import Pair, ReferenceView, pairs
from tcgsplat.tracking.settings import AlignmentConfig

_POSE, _GAIN, _COLOR_SCALE, _DONE, _PASSES, _STATE = 0, 16, 18, 20, 21, 22  # as in the kernels' text
_PADDED = 48


def alignment_text() -> str:
    """The kernels as C++."""
    shared = ("THIN", "SMOOTH", "TINY", "NEAREST", "FACING", "BASE", "STUDENT_DOF")
    solver = ("ENOUGH_FOR_EXPOSURE", "FLAT_VARIANCE", "MAX_GAIN", "STEP_PRIOR", "SMALL")
    constants = {name: f"{float(getattr(cpu_kernels, name))!r}f" for name in shared}
    constants |= {"SOLID": f"{SOLID!r}f"} | {name: repr(getattr(cpu, name)) for name in solver}
    return source(constants, "render/cuda/kernel.cuh", "tracking/alignment.cu")


@cache
def _photometry(device: torch.device) -> Tensor:
    """The state before the first pass, but for the pose."""
    photometry = Photometry()
    start = [photometry.gain, photometry.offset, photometry.color_scale, photometry.depth_scale, 0.0, 0.0]
    return torch.tensor(start, dtype=torch.float64, device=device)


class Images:
    """The launches, by name: what alignment does with images on a GPU."""

    def __init__(self, kernels: Kernels) -> None:
        self._kernels = kernels

    def rendered(self, rendering: Rendering, min_alpha: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Intensity and depth; the same as drawn, and where the map is opaque."""
        out = tuple(torch.empty_like(rendering.alpha) for _ in range(4))
        self._each(rendering.alpha.numel(), "rendered_view", {
            "color": rendering.color.permute(2, 0, 1).contiguous(), "alpha": rendering.alpha.contiguous(),
            "plane_depth": rendering.composited_plane_depth.contiguous(), "min_alpha": min_alpha,
            "intensity": out[0], "depth": out[1], "composited": out[2], "solid": out[3],
            "pixels": rendering.alpha.numel(),
        })  # fmt: skip
        return out  # type: ignore[return-value]

    def live(self, frame: Frame) -> tuple[Tensor, Tensor]:
        """Intensity and depth."""
        intensity, depth = torch.empty_like(frame.depth), torch.empty_like(frame.depth)
        self._each(depth.numel(), "live_view", {
            "color": frame.color.contiguous(), "measured": frame.depth.contiguous(), "valid": frame.valid.contiguous(),
            "intensity": intensity, "depth": depth, "pixels": depth.numel(),
        })  # fmt: skip
        return intensity, depth

    def weights(self, weight: Plane) -> Tensor:
        """As the kernels read them."""
        return weight.contiguous()

    def halved(self, image: Tensor) -> Tensor:
        """Means over two by two pixels."""
        return self._halved("intensity", image)

    def halved_depth(self, depth: Tensor) -> Tensor:
        """Means of the readings of two by two pixels that agree."""
        return self._halved("depth", depth)

    def _halved(self, kind: str, image: Tensor) -> Tensor:
        (height, width), pitch = (side // 2 for side in image.shape), image.shape[1]
        half = image.new_empty(height, width)
        given = {"image": image, "half": half, "width": width, "height": height, "pitch": pitch}
        self._each(half.numel(), f"halve_{kind}", given)
        return half

    def sampled(self, intensity: Tensor, depth: Tensor) -> Tensor:
        """What a pass samples."""
        height, width = depth.shape
        image = depth.new_empty(height, width, cpu_kernels.CHANNELS)
        given = {"intensity": intensity, "depth": depth, "image": image, "width": width, "height": height}
        self._each(depth.numel(), "live_image", given)
        return image

    def points(
        self, intensity: Tensor, depth: Tensor, weight: Tensor, camera: Camera, radius: int, stride: int
    ) -> Tensor:
        """Of a rendered view."""
        height, width = depth.shape
        columns, rows = len(range(2, width - 2, stride)), len(range(2, height - 2, stride))
        points = depth.new_empty(cpu_kernels.POINT, columns * rows)
        self._each(columns * rows, "reference_points", {
            "intensity": intensity, "depth": depth, "weight": weight, "points": points, "width": width,
            "columns": columns, "n": columns * rows, "radius": radius, "stride": stride, "fx": camera.fx,
            "fy": camera.fy, "cx": camera.cx, "cy": camera.cy,
        })  # fmt: skip
        return points

    def passed(
        self, pair: Pair[Tensor], state: Tensor, config: AlignmentConfig, *, balance: float, moves: bool, finest: bool
    ) -> Tensor:
        """The sums of a pass [SUMS], after which the state follows if it moves."""
        level, (height, width, _) = pair.level, pair.live.shape
        n, camera = level.points.shape[1], level.camera
        blocks = max(-(-n // THREADS), 1)
        partial = level.points.new_empty(blocks, _PADDED)
        sums = torch.zeros(cpu_kernels.SUMS, dtype=torch.float64, device=state.device)
        self._kernels.launch("normal_equations", blocks, {
            "points": level.points, "live": pair.live, "state": state, "partial": partial, "n": n, "width": width,
            "height": height, "fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy, "gate": level.gate,
            "balance": balance, "sigma_floor": config.sigma_floor, "sigma_slope": config.sigma_slope,
        })  # fmt: skip
        self._kernels.launch("advance", 1, {
            "partial": partial, "sums": sums, "state": state, "blocks": blocks, "moves": int(moves),
            "finest": int(finest),
        })  # fmt: skip
        return sums

    def _each(self, count: int, kernel: str, given: dict[str, object]) -> None:
        """A thread for each of so many."""
        if count:
            self._kernels.launch(kernel, -(-count // THREADS), given)


@cache
def images(device: torch.device) -> Images:
    """Of a GPU, its kernels compiled."""
    return Images(Compiled(alignment_text(), device))


def align(images: Images, frame: Frame, view: ReferenceView[Tensor], guess: Pose, config: AlignmentConfig) -> Alignment:
    """As `alignment.align`, with all images on a GPU; the host waits once, for what was found.

    Args:
        images: Of that GPU.
        frame: The live frame, of the view's camera.
        view: Of the map, from somewhere near.
        guess: `T_map_cam` to start from; on the CPU.
        config: Constants.
    """
    views = pairs(images, frame, view)
    finest, start = views[0], _photometry(frame.depth.device)
    T_live_ref = (se3.inverse(guess) @ view.T_map_ref).to(start.device, non_blocking=True)
    state, last = torch.cat((T_live_ref.flatten(), start)), start.new_zeros(cpu_kernels.SUMS)
    for pair in reversed(views):
        state[_COLOR_SCALE : _DONE + 1] = start[_COLOR_SCALE - _GAIN : _DONE + 1 - _GAIN]
        for _ in range(pair.level.passes):
            last = images.passed(pair, state, config, balance=config.depth_weight, moves=True, finest=pair is finest)
    at_rest = {"moves": False, "finest": True}
    color = images.passed(finest, state, config, balance=0.0, **at_rest)
    both = images.passed(finest, state, config, balance=1.0, **at_rest)
    on_solid = replace(finest, level=replace(finest.level, points=view.solid_points))
    solid = images.passed(on_solid, state, config, balance=config.depth_weight, **at_rest)
    points = (finest.level.points[cpu_kernels.PZ] != 0).sum().double()
    coverage = (view.covered & frame.valid).sum() / frame.valid.sum().clamp_min(1)
    told = torch.cat((state, last, color, both, solid, torch.stack((points, coverage)))).cpu().numpy()
    state_found, *sums, shown = np.split(told, np.cumsum([_STATE, *[cpu_kernels.SUMS] * 4]))
    return concluded(
        view.T_map_ref,
        state_found[_POSE:_GAIN].reshape(4, 4),
        int(state_found[_PASSES]),
        Photometry(*state_found[_GAIN:_DONE].tolist()),
        coverage=float(shown[1]),
        points=int(shown[0]),
        last=sums[0],
        color=sums[1],
        both=sums[2],
        solid=sums[3],
    )
