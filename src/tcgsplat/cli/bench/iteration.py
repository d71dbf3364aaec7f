"""An iteration of mapping's optimisation as its kernels run it, once the loss has been differentiated by the images."""

import numpy as np

from tcgsplat.geometry.camera import Camera
from tcgsplat.mapping import native_kernels as kernels
from tcgsplat.mapping.native_optimization import filled, packed, stepped
from tcgsplat.render.numba_cpu.layout import CHANNELS, FEATURE, PARAMETERS, Floats, to_blocks
from tcgsplat.render.numba_cpu.passes import Drawn, Passes, Workspace
from tcgsplat.render.protocol import Splats
from tcgsplat.scene.harmonics import SH_C0


class Iteration:
    """The calls of `NativeOptimization.step` on any splats, but for the losses: the images' derivative is random.

    Adam's learning rates are zero. It does all that it does otherwise, but each iteration meets the same scene.
    """

    def __init__(self, splats: Splats, camera: Camera, passes: Passes) -> None:
        """Of splats with four features, three colours and a confidence, before a camera at the origin."""
        n = len(splats.means)
        self._camera, self._passes, self._space = camera, passes, Workspace()
        self._padded = -(-n // 16) * 16
        sh = (splats.features[:, None, :3] - 0.5) / SH_C0
        self.raw = packed(self._padded, splats.means, splats.quats, splats.scales.log(), splats.opacities.logit(), sh)
        self.parameters = filled(0.0, self._padded // 16, PARAMETERS, 16)
        to_blocks(self.parameters[:, FEATURE + 3 :], splats.features[:, 3:].numpy())
        kernels.activate(self.raw.reshape(-1), self.parameters.reshape(-1), 0, self._padded)
        self._before = filled(0.0, *self.raw.shape)
        self._before[:] = self.raw
        self.first, self.second = filled(0.0, *self.raw.shape), filled(0.0, *self.raw.shape)
        self._clocks = filled(1.0, self._padded // 16, 2, 16)
        self._allowed, self._scale = filled(np.inf, self._padded), filled(1.0, self._padded)
        self._constants: Floats = np.zeros(kernels.CONSTANTS, np.float32)
        self._excess = filled(0.0, self._padded)
        generator = np.random.default_rng(1)
        self._d_planes = generator.random((CHANNELS, camera.height, camera.width), np.float32)

    def step(self) -> None:
        """Draw, differentiate, and Adam for what was drawn."""
        drawn = self.draw()
        stepped(
            self._passes, self._space, drawn, self._d_planes, self.raw, self._before, self.first, self.second,
            self._clocks, self._allowed, self._scale, self._constants, self._excess,
        )  # fmt: skip

    def draw(self) -> Drawn:
        """The forward pass alone."""
        return self._passes.draw(self.parameters, self._camera, np.eye(4))
