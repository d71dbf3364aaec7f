"""Threads that let others run first."""

import sys
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import pytest

from tcgsplat.priority import niceness, step_back
from tcgsplat.render.numba_cpu.workers import Workers

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="threads have no niceness of their own")


def nicer(work: Callable[[], object]) -> object:
    """What some work gives in a thread that has stepped back."""
    with ThreadPoolExecutor(1, initializer=step_back) as thread:
        return thread.submit(work).result()


def test_only_the_thread_that_steps_back_and_those_that_it_begins_are_nicer() -> None:
    before = niceness()

    def both() -> tuple[int, int]:
        with ThreadPoolExecutor(1) as child:
            return niceness(), child.submit(niceness).result()

    assert nicer(both) == (before + 5, before + 5)
    assert niceness() == before


def test_no_thread_is_nicer_than_there_is() -> None:
    assert nicer(lambda: [step_back() for _ in range(5)] and niceness()) == 19


def shared(workers: Workers, come: int) -> dict[int, int]:
    """How nice each thread was that came to some work; the work lasts until so many have come."""
    seen, door = dict[int, int](), threading.Barrier(come)

    def work(worker: int) -> None:
        seen[worker] = niceness()
        door.wait(timeout=10)

    workers.together(work)
    return seen


def test_helpers_are_as_nice_as_who_is_helped_and_the_nicer_leave_a_core() -> None:
    workers, before = Workers(3), niceness()
    for _ in range(2):
        assert shared(workers, 3) == dict.fromkeys(range(3), before)
        assert nicer(lambda: shared(workers, 2)) == dict.fromkeys(range(2), before + 5)


@pytest.mark.parametrize(("holder", "other", "alone"), [("nicer", "plain", False), ("plain", "nicer", True)])
def test_a_core_is_reserved_against_the_nicer_and_not_the_other_way(holder: str, other: str, alone: bool) -> None:
    """Who shares with one who has reserved a core of two works alone, if that one is not nicer."""
    workers, began, end = Workers(2), threading.Event(), threading.Event()

    def hold() -> None:
        with workers.reserved():
            began.set()
            end.wait(timeout=10)

    def came() -> set[int]:
        seen, second = set[int](), threading.Event()

        def work(worker: int) -> None:
            seen.add(worker)
            if worker:
                second.set()
            else:
                second.wait(timeout=0.3 if alone else 10)

        workers.together(work)
        return seen

    def started(who: str) -> ThreadPoolExecutor:
        return ThreadPoolExecutor(1, initializer=step_back if who == "nicer" else None)

    with started(holder) as holding, started(other) as sharing:
        held = holding.submit(hold)
        assert began.wait(timeout=10)
        seen = sharing.submit(came).result()
        end.set()
        held.result()
    assert seen == ({0} if alone else {0, 1})
