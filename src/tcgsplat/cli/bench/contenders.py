"""The loops that `tcgsplat bench gpu` times: ours through a rasterizer, and gsplat with nothing around it."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor

from tcgsplat.cli.bench.render import Size, scene
from tcgsplat.confidence.state import ConfidenceState
from tcgsplat.config import SlamConfig
from tcgsplat.geometry import quaternion, se3
from tcgsplat.mapping.optimization import begin
from tcgsplat.render.backends import open_rasterizer
from tcgsplat.render.conventions import BLUR, NEAR_PLANE
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.render.view import render_view
from tcgsplat.scene.frame import Frame
from tcgsplat.scene.gaussians import Gaussians
from tcgsplat.scene.harmonics import SH_C0
from tcgsplat.scene.submap import Keyframe, Submap
from tcgsplat.tensors import Pose
from tcgsplat.tracking.descent import DescentConfig, descend

Rasterize = Callable[..., Any]
"""`gsplat.rasterization`."""


@runtime_checkable
class Contender(Protocol):
    """A way to do the iterations of tracking and of mapping. Each meets the same scene in every iteration of mapping:
    learning rates are zero there, which leaves out nothing that takes time.
    """

    device: torch.device

    def track(self, steps: int) -> object:
        """A frame's pose from a guess, by so many steps: draw, loss, gradient by the pose, Adam."""
        ...

    def map(self, steps: int) -> object:
        """So many steps: draw, loss, gradient by all parameters, Adam."""
        ...


@dataclass(frozen=True)
class Scene:
    """A random map, a picture of it, and a wrong guess of where that was taken."""

    submap: Submap
    """On the CPU, without keyframes; every Gaussian has a history, so that Eqs. 20 to 24 have something to do."""
    frame: Frame
    guess: Pose

    @staticmethod
    def of(size: Size, rasterizer: Rasterizer) -> "Scene":
        """That of `bench render`, drawn from the origin."""
        splats = scene(size)
        n = len(splats.means)
        gaussians = Gaussians(
            ids=torch.arange(n),
            means=splats.means,
            log_scales=splats.scales.log(),
            quats=splats.quats,
            logit_opacities=splats.opacities.logit(),
            sh=(splats.features[:, None, :3] - 0.5) / SH_C0,
        )
        confidence = ConfidenceState(
            value=0.1 + 0.9 * splats.features[:, 3],
            baseline=torch.full((n,), 1e-3),
            born=torch.zeros(n, dtype=torch.int64),
            updates=torch.full((n,), 5),
            expected_error=torch.full((n,), 0.02),
            evidence=torch.full((n,), 5.0),
        )
        submap = Submap(0, se3.identity(), gaussians, confidence, clock=6)
        shown = render_view(submap.to(rasterizer.device), size.camera, se3.identity(), rasterizer)
        color, depth = shown.color.cpu(), shown.depth.cpu()
        frame = Frame(0, 0.0, color, depth, torch.ones_like(depth, dtype=torch.bool), size.camera)
        return Scene(submap, frame, se3.exp(torch.tensor([0.01, 0.0, 0.005, 0.0, 0.005, 0.0], dtype=torch.float64)))


class Ours:
    """The paper's solver and our optimisation, as the system runs them, through one of its rasterizers."""

    def __init__(self, scene: Scene, rasterizer: Rasterizer) -> None:
        config, self.device = SlamConfig(), rasterizer.device
        frame = scene.frame.to(self.device)
        submap = scene.submap.to(self.device)
        self._optimization = begin(
            replace(submap, keyframes=(Keyframe(frame, scene.guess),)), config.mapper, config.confidence, rasterizer
        )
        self._descend = partial(descend, frame, submap, scene.guess, rasterizer, floor=config.confidence.tracking_floor)

    def track(self, steps: int) -> object:
        """See `Contender`."""
        return self._descend(DescentConfig(iterations=steps))

    def map(self, steps: int) -> object:
        """See `Contender`."""
        self._optimization.steps([0] * steps, paces=[0.0] * steps)
        return self._optimization


class BareGsplat:
    """`gsplat.rasterization` of colour and depth, L1, torch's fused Adam: no confidence, no masks, no SSIM, no planes.

    What a loop with gsplat takes at the least; it does less than ours.
    """

    def __init__(self, scene: Scene, device: torch.device, rasterize: Rasterize) -> None:
        self._rasterize, self.device = rasterize, device
        frame, gaussians = scene.frame.to(device), scene.submap.gaussians.to(device)
        camera = frame.camera
        self._frame, self._size = frame, {"width": camera.width, "height": camera.height}
        # gsplat has the centre of the first pixel at 0.5, 0.5, we at the origin.
        intrinsics = [[camera.fx, 0, camera.cx + 0.5], [0, camera.fy, camera.cy + 0.5], [0, 0, 1]]
        self._K = torch.tensor([intrinsics], device=device)
        self._last_row = torch.tensor([[0.0, 0.0, 0.0, 1.0]], device=device)
        self._T_cam_map = se3.inverse(scene.guess).float().to(device)
        raw = (gaussians.means, gaussians.quats, gaussians.log_scales, gaussians.logit_opacities)
        self._parameters = [table.clone().requires_grad_() for table in (*raw, gaussians.colors(torch.zeros(3)))]
        self._adam = torch.optim.Adam(self._parameters, lr=0.0, fused=True)

    def track(self, steps: int) -> object:
        """See `Contender`."""
        fixed = [table.detach() for table in self._parameters]
        q = torch.tensor([1.0, 0.0, 0.0, 0.0], device=self.device, requires_grad=True)
        t = torch.zeros(3, device=self.device, requires_grad=True)
        adam = torch.optim.Adam([{"params": [q], "lr": 0.002}, {"params": [t], "lr": 0.01}], fused=True)
        for _ in range(steps):
            moved = torch.cat((quaternion.to_matrix(q), t[:, None]), dim=1)
            self._follow(adam, fixed, torch.cat((moved, self._last_row)) @ self._T_cam_map)
        return q, t

    def map(self, steps: int) -> object:
        """See `Contender`."""
        for _ in range(steps):
            self._follow(self._adam, self._parameters, self._T_cam_map)
        return self._parameters

    def _follow(self, adam: torch.optim.Optimizer, parameters: list[Tensor], T_cam_map: Tensor) -> None:
        """One step."""
        means, quats, log_scales, logits, colors = parameters
        (drawn,), _, _ = self._rasterize(
            means, quats, log_scales.exp(), logits.sigmoid(), colors, T_cam_map[None], self._K, **self._size,
            near_plane=NEAR_PLANE, eps2d=BLUR, packed=False, render_mode="RGB+D",
        )  # fmt: skip
        loss = (drawn[..., :3] - self._frame.color).abs().mean() + (drawn[..., 3] - self._frame.depth).abs().mean()
        adam.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        adam.step()


def rasterization() -> Rasterize:
    """The function of gsplat that draws.

    Raises:
        BackendUnavailableError: if gsplat cannot draw here.
    """
    open_rasterizer("gsplat")  # it draws something, and says precisely what is missing where it cannot
    import gsplat

    rasterize: Rasterize = gsplat.rasterization
    return rasterize
