"""Sharing nogil kernels over threads, in ranges."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from tcgsplat.render.numba_cpu.layout import Ints


def available_cores() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Workers:
    """A few threads that run nogil kernels over ranges."""

    def __init__(self, threads: int) -> None:
        self.threads = threads
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix="splat")

    def run(self, work: Callable[[int, int], object], cuts: list[int]) -> None:
        """Call `work(from, to)` for consecutive cuts, side by side; the first exception is raised."""
        # Even a lone range runs on a worker: kernels that spill registers are faster on a thread's fresh stack.
        futures = [self._pool.submit(work, a, b) for a, b in zip(cuts, cuts[1:], strict=False) if b > a]
        for future in futures:
            future.result()

    def cuts(self, count: int, unit: int = 1) -> list[int]:
        """Equal shares of `count`, at multiples of `unit`."""
        units = -(-count // unit)
        return [min(count, units * k // self.threads * unit) for k in range(self.threads)] + [count]

    def weighted_cuts(self, ends: Ints) -> list[int]:
        """Ranges of tiles with equal shares of pairs; `ends` are running totals, one more than tiles."""
        targets = [int(ends[-1]) * k // self.threads for k in range(1, self.threads)]
        inner = [int(np.searchsorted(ends, target)) for target in targets]
        return [0, *(min(cut, len(ends) - 1) for cut in inner), len(ends) - 1]
