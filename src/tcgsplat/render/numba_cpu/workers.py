"""Threads that share nogil kernels; the calling thread is one of them."""

import os
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

from tcgsplat import priority

Arguments = tuple[object, ...]


def available_cores() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Workers:
    """A few threads; several callers may use them at the same time."""

    def __init__(self, threads: int) -> None:
        self.threads = threads
        self._door, self._busy = threading.Lock(), Counter[tuple[int, int]]()
        self._helpers: dict[int, ThreadPoolExecutor] = {}
        self._niceness = priority.niceness()

    def together(self, work: Callable[[int], object], threads: int | None = None) -> None:
        """Call `work(0)` here and `work(1)`, `work(2)` ... on helpers; the first exception is raised.

        A helper may come late, when all is done, or never: `work` must share itself out as threads come. It is as nice
        to the machine's other threads as the caller, and a nicer caller leaves a core to the others: where these take
        one, all who share a phase would wait for the thread that was on it.
        """
        with self.reserved():
            pool, free = self._helping(priority.niceness())
            helpers = max(min((threads or self.threads) - 1, free), 0)
            futures = [pool.submit(work, k + 1) for k in range(helpers)]
            try:
                work(0)
            finally:
                for future in futures:
                    if not future.cancel():
                        future.result()

    @contextmanager
    def reserved(self) -> Iterator[None]:
        """A core for the calling thread while inside: what others share is shared by one thread less.

        More threads than cores would take turns, and in a phase all wait for the one whose turn it is not. A nicer
        thread than those who share takes nothing from them: the operating system has it wait.
        """
        me = priority.niceness(), threading.get_ident()
        with self._door:
            self._busy[me] += 1
        try:
            yield
        finally:
            with self._door:
                self._busy[me] -= 1
                if not self._busy[me]:
                    del self._busy[me]

    def _helping(self, niceness: int) -> tuple[ThreadPoolExecutor, int]:
        """The helpers of callers that are so nice, and how many cores are free for them."""
        with self._door:
            if niceness not in self._helpers:  # its threads are as nice as the one that begins them
                self._helpers[niceness] = ThreadPoolExecutor(max(self.threads - 1, 1), thread_name_prefix="splat")
            left = int(niceness > self._niceness)
            return self._helpers[niceness], self.threads - left - sum(other <= niceness for other, _ in self._busy)

    def share(self, kernel: Callable[..., bool], arguments: Callable[[int], Arguments]) -> None:
        """Run a kernel of phases (see `phases.py`) on all threads, each with its own arguments, until all is done."""

        def work(worker: int) -> None:
            own = arguments(worker)
            while not kernel(*own):
                time.sleep(0)

        self.together(work)

    def run(self, work: Callable[[int, int], object], cuts: list[int]) -> None:
        """Call `work(from, to)` for consecutive cuts, side by side; the first exception is raised."""
        ranges = [(a, b) for a, b in zip(cuts, cuts[1:], strict=False) if b > a]
        left = iter(ranges)

        def take(_: int) -> None:
            for a, b in left:
                work(a, b)

        self.together(take, len(ranges))

    def cuts(self, count: int, unit: int = 1) -> list[int]:
        """Equal shares of `count`, at multiples of `unit`."""
        units = -(-count // unit)
        return [min(count, units * k // self.threads * unit) for k in range(self.threads)] + [count]
