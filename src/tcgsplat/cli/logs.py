"""What a person reads on the terminal beside results: what commands say, and what the library logs."""

import logging
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager

SHOWN = 5
"""Warnings of one kind that are shown in full."""


def say(sentence: str) -> None:
    """A line to a person who watches: on standard error if that is a terminal, else nowhere."""
    if sys.stderr.isatty():
        sys.stderr.write(f"{sentence}\n")


def sentence(error: Exception) -> str:
    """What an error says; the system's own ones without their number."""
    if isinstance(error, OSError) and error.strerror and error.filename:
        return f"{error.filename}: {error.strerror}"
    return str(error)


class Capped(logging.Handler):
    """Writes records to standard error, of each kind (the same message but for its values) `SHOWN` at most."""

    def __init__(self) -> None:
        super().__init__()
        self._seen: Counter[str] = Counter()
        self._last: dict[str, str] = {}

    def emit(self, record: logging.LogRecord) -> None:
        """Write the record as one line, unless enough like it have been seen."""
        kind, message = str(record.msg), record.getMessage()
        self._seen[kind] += 1
        self._last[kind] = message
        if self._seen[kind] <= SHOWN or record.levelno < logging.WARNING:
            label = "warning: " if record.levelno >= logging.WARNING else ""
            sys.stderr.write(f"tcgsplat: {label}{message}\n")

    def summarize(self) -> None:
        """Say how many records of each kind were not shown, and the last of them."""
        for kind, count in self._seen.items():
            if count > SHOWN:
                sys.stderr.write(f"tcgsplat: warning: {count - SHOWN} more like this, the last: {self._last[kind]}\n")


@contextmanager
def on_stderr(debug: bool) -> Iterator[None]:
    """Show the package's warnings, or with `debug` all that it logs, while the block runs."""
    logger = logging.getLogger("tcgsplat")
    handler = Capped()
    level = logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.DEBUG if debug else logging.WARNING)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(level)
        handler.summarize()
