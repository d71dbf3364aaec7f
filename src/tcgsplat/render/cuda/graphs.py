"""Steps recorded as CUDA graphs: the host launches each as a whole, and asks for nothing that goes on in it.

What a graph works on has its size for good, so a drawing in it cannot ask for as much memory as it has pairs of splat
and tile. It gets room for half as many again as the step before had, and says how many there were; if that was too
little, all steps are done again, from where they began, with more. What fits is the same to the bit whatever the room.
"""

import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from functools import partial
from typing import Final, Protocol, runtime_checkable

import torch
from torch import Tensor

from tcgsplat.render.repetition import Given, Step

logger = logging.getLogger(__name__)

SHORTEST: Final = 4
"""Steps that are worth it: recording one takes the host as long as doing one, and one is done before."""
SPARE: Final = 1.5
"""Room over what the step before had. Views of a submap differ by less, as a rule."""


class Room(threading.local):
    """For how many pairs of splat and tile a thread's drawings ask for memory."""

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self.latest = 0
        """What the last drawing had that was asked."""
        self._fixed: tuple[int, Tensor] | None = None

    def asked_for(self, ends: Tensor) -> int:
        """By a drawing whose splats have so many pairs, each with those before it, [n]."""
        if self._fixed is None:
            self.latest = int(ends[-1]) if len(ends) else 0  # what the host waits for
            return self.latest
        pairs, most = self._fixed
        if len(ends):
            torch.maximum(most, ends[-1:], out=most)
        return pairs

    @contextmanager
    def fixed(self, pairs: int) -> Iterator[Tensor]:
        """Inside, drawings get room for so many, asked or not; gives the most that any of them had, [1]."""
        most = torch.zeros(1, dtype=torch.int64, device=self._device)
        self._fixed = pairs, most
        try:
            yield most
        finally:
            self._fixed = None


@runtime_checkable
class Recorder(Protocol):
    """Records what is launched, so that it can be launched again."""

    def aside(self) -> AbstractContextManager[None]:
        """Where recording happens. What is done there once, before, makes all that is made once."""
        ...

    def recorded(self, step: Callable[[], None]) -> Callable[[], None]:
        """A step, without doing it; what is given back does it, until the next one is recorded."""
        ...

    def forget(self) -> None:
        """Give back the memory of what was recorded."""
        ...


class Graphs(threading.local):
    """CUDA graphs, each thread's on a stream of its own.

    All of a thread's take their tensors from one pool of memory, which lives as long as the latest of them. What does
    not fit into the pieces that it has makes it grow, so of maps that grow it would keep pieces of all sizes: when it
    has become twice as large as it began, another one is begun.
    """

    _one_at_a_time = threading.Lock()  # torch records one in a process

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._stream: torch.cuda.Stream | None = None
        self._latest: torch.cuda.CUDAGraph | None = None
        self._held = self._held_first = 0  # bytes of the pool

    @contextmanager
    def aside(self) -> Iterator[None]:
        """See `Recorder`."""
        if self._stream is None:
            self._stream = torch.cuda.Stream(self._device)  # type: ignore[no-untyped-call]
        current = torch.cuda.current_stream(self._device)
        self._stream.wait_stream(current)
        try:
            with torch.cuda.stream(self._stream):
                yield
        finally:
            current.wait_stream(self._stream)

    def recorded(self, step: Callable[[], None]) -> Callable[[], None]:
        """See `Recorder`."""
        if self._held > 2 * self._held_first:
            self.forget()
        graph = torch.cuda.CUDAGraph()
        with self._one_at_a_time, self.aside():
            pool = torch.cuda.graph_pool_handle() if self._latest is None else self._latest.pool()
            before = torch.cuda.memory_reserved(self._device)
            graph.capture_begin(pool, capture_error_mode="thread_local")
            try:
                step()
            finally:
                self._end(graph, pool)
            self._held += torch.cuda.memory_reserved(self._device) - before
            if self._latest is None:
                self._held_first = self._held
            self._latest = graph  # the one before goes here, not while another thread records
        return graph.replay

    def forget(self) -> None:
        """See `Recorder`."""
        with self._one_at_a_time:
            self._latest, self._held, self._held_first = None, 0, 0
            torch.cuda.empty_cache()

    def _end(self, graph: torch.cuda.CUDAGraph, pool: tuple[int, int]) -> None:
        """End recording. If that fails, torch leaves the pool open, and would find no memory elsewhere from then on."""
        try:
            graph.capture_end()
        except RuntimeError:
            for close in ("_cuda_endAllocateToPool", "_cuda_releasePool"):
                with suppress(RuntimeError, AttributeError):
                    getattr(torch._C, close)(self._device.index, pool)
            raise


def repeat(
    recorder: Recorder, room: Room, step: Step, given: Given, times: int, begin_again: Callable[[], None]
) -> None:
    """See `repetition.repeat`: the first step is done, the others are one recorded step with other inputs.

    The host waits twice: for the first step's pairs of splat and tile, and at the end for whether all had room. If
    not, `begin_again` has to bring back the state before the first step.
    """
    with recorder.aside():
        step(*given(0))
    start, wanted = 1, room.latest
    while True:
        inputs, pairs = [table.clone() for table in given(start)], int(SPARE * wanted)
        with room.fixed(pairs) as most:
            again = recorder.recorded(partial(step, *inputs))
            again()
            for k in range(start + 1, times):
                for table, values in zip(inputs, given(k), strict=True):
                    table.copy_(values)
                again()
        wanted = int(most)
        if wanted <= pairs:
            return
        logger.debug("%d pairs of splat and tile, room for %d: %d steps once more", wanted, pairs, times)
        start = 0
        del again  # so that its graph goes where the recorder lets it go
        begin_again()
