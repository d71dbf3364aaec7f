"""Files that are complete or absent: written under another name in the same folder, then renamed.

A rename within one file system replaces the old file in one step, so a reader, or the next run after a kill, never
meets half a file. What a killed writer leaves behind ends in `.partial`; no reader looks at such names.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

PARTIAL = ".*.partial"
"""Pattern of the names of what a killed writer leaves behind."""


@contextmanager
def writing(path: Path) -> Iterator[BinaryIO]:
    """A binary file to write into, which takes the name `path` when the block ends without an exception.

    Raises:
        OSError: if the folder is not there or the disk is full; `path` is then as it was before.
    """
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        with partial.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())  # or a power cut could leave the new name on an empty file
        partial.replace(path)
    except OSError as error:  # of a full disk, for instance, which does not tell the file
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        partial.unlink(missing_ok=True)


def write_bytes(path: Path, content: bytes) -> None:
    """Put `content` at `path`, all of it or nothing."""
    with writing(path) as file:
        file.write(content)


def write_text(path: Path, text: str) -> None:
    """Put `text` at `path` in UTF-8, all of it or nothing."""
    write_bytes(path, text.encode())
