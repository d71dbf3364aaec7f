"""Ctrl-C that asks before it insists."""

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def stopping_on_interrupt(
    told: str = "stopping after this frame; Ctrl-C again to stop at once",
) -> Iterator[threading.Event]:
    """An event that the first Ctrl-C sets, so that nothing is left half done; the second one is as ever.

    Args:
        told: What the person is told at the first one.
    """
    stop = threading.Event()

    def first(*_: object) -> None:
        stop.set()
        signal.signal(signal.SIGINT, previous)
        sys.stderr.write(f"tcgsplat: {told}\n")

    previous = signal.signal(signal.SIGINT, first)
    try:
        yield stop
    finally:
        signal.signal(signal.SIGINT, previous)
