"""Getting the CPU kernels compiled before the clock starts, and saying so when that takes long."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Final

import torch
from numba.core import event

from tcgsplat.cli.ahead import ANNOUNCEMENT, compiled_meanwhile
from tcgsplat.cli.logs import say
from tcgsplat.config import SlamConfig, with_settings
from tcgsplat.geometry.camera import Camera
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.scene.frame import Frame
from tcgsplat.slam import Slam
from tcgsplat.tracking.synchronization import synchronized

_ONE_STEP: Final = {
    "tracker.descent.iterations": 1,
    "mapper.iterations": 1,
    "mapper.first_iterations": 1,
    "schedule.map_every": 1,
}


def compile_kernels(config: SlamConfig, rasterizer: Rasterizer) -> float:
    """Have every kernel that a run needs compiled or loaded, the rest by a throw-away run over two tiny frames.

    Says so on standard error if something has to be compiled, before that is done.

    Args:
        config: Settings of the run to come.
        rasterizer: Its backend.

    Returns:
        Seconds that it took: a fraction of one where the kernels are on disk.
    """
    started = time.perf_counter()
    if rasterizer.name == "numba":
        with compiled_meanwhile():
            pass
    with _heard_compiling(partial(say, ANNOUNCEMENT)):
        slam = Slam(with_settings(config, _ONE_STEP), rasterizer)
        for index in range(2):
            slam.step(_wall(index))
        synchronized(_wall(2), torch.full((6,), 0.5, dtype=torch.float64))  # the wall stands still, so no step did
        slam.finish()
    return time.perf_counter() - started


def _wall(index: int) -> Frame:
    """A checkered wall at 1.5 metres."""
    height, width = 48, 64
    v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    shade = 0.3 + 0.4 * ((u // 6 + v // 6) % 2).float()
    return Frame(
        index=index,
        timestamp=index / 30,
        depth_timestamp=index / 30 + 0.01,
        color=shade[..., None].repeat(1, 1, 3),
        depth=torch.full((height, width), 1.5),
        valid=torch.ones(height, width, dtype=torch.bool),
        camera=Camera(60.0, 60.0, 31.5, 23.5, width, height),
    )


class _First(event.Listener):  # type: ignore[misc]
    """Calls a function at the first event."""

    def __init__(self, announce: Callable[[], object]) -> None:
        self._announce = announce
        self._done = False

    def on_start(self, event: event.Event) -> None:  # noqa: ARG002
        if not self._done:
            self._done = True
            self._announce()

    def on_end(self, event: event.Event) -> None:
        pass


@contextmanager
def _heard_compiling(announce: Callable[[], object]) -> Iterator[None]:
    listener = _First(announce)
    event.register("numba:compile", listener)  # type: ignore[no-untyped-call]
    try:
        yield
    finally:
        event.unregister("numba:compile", listener)  # type: ignore[no-untyped-call]
