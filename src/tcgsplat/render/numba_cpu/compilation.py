"""How compiled kernels are kept: numba's cache is told of all the files that kernels here are made of.

Numba keeps a compiled function until its own file changes. It does not look into the files of the functions and the
constants that went into it, and would go on to use old ones, even where callers and callees no longer agree on their
arguments. So what it remembers of a kernel's file here also says which sources there were.
"""

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any


def _digest() -> str:
    """Of this folder's sources, of the kernels of other packages, and of where they have constants from."""
    package = Path(__file__).parents[2]
    patterns = (
        "render/numba_cpu/*.py",
        "*/*_kernels.py",
        "render/protocol.py",
        "mapping/optimizer.py",
        "scene/gaussians.py",
    )
    sources = sorted(path for pattern in patterns for path in package.glob(pattern))
    return hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()


_SOURCES = _digest()


def kept(decorator: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """A caching `njit(...)` that compiles anew when any of the sources is another."""

    def decorate(function: Any) -> Any:
        kernel = decorator(function)
        index = kernel._cache._cache_file
        index._source_stamp = index._source_stamp, _SOURCES
        return kernel

    return decorate
