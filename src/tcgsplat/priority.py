"""How much a thread lets others run first, where the operating system knows that of threads (Linux)."""

import os
import sys
import threading


def niceness() -> int:
    """The calling thread's: 0 as a rule; the higher, the more it waits."""
    return os.getpriority(os.PRIO_PROCESS, threading.get_native_id()) if sys.platform == "linux" else 0


def step_back() -> None:
    """Make the calling thread, and all that it begins, nicer; it cannot be undone.

    Beside a thread that did not, on the same core, it gets a quarter of the time; alone all of it. With a tenth, where
    one core has to do all, a camera is lost for want of a map.
    """
    if sys.platform == "linux":
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), min(niceness() + 5, 19))
