"""The GPU's kernels on a CPU, for tests: their text as it is, compiled as C++ against a pretence of CUDA's blocks.

What this shows: the arithmetic, the indices, the barriers and shuffles, and all of the Python around them. What it does
not show: races, the GPU's own arithmetic (its exp2 and division are a little less exact), and speed.
"""

import ctypes
import hashlib
import shutil
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tcgsplat.render.cuda.launching import Signatures

COMPILER = shutil.which("g++") or shutil.which("clang++")


class EmulatedKernels:
    """`Kernels` that run where the tests do."""

    def __init__(self, text: str, folder: Path) -> None:
        assert COMPILER is not None
        name = hashlib.sha256(text.encode()).hexdigest()[:16]
        source, library = folder / f"{name}.cpp", folder / f"{name}.so"
        if not library.exists():
            header = Path(__file__).parent / "emulation" / "cuda.h"
            source.write_text(f'#include "{header}"\n{text}')
            flags = ["-std=c++17", "-O2", "-w", "-shared", "-fPIC"]
            subprocess.run([COMPILER, *flags, str(source), "-o", str(library)], check=True, capture_output=True)
        self._signatures, self._library = Signatures(text), ctypes.CDLL(str(library))

    def launch(self, name: str, blocks: int, arguments: Mapping[str, Any]) -> None:
        """See `Kernels`."""
        filled = self._signatures.filled(name, arguments)
        getattr(self._library, name)(ctypes.c_uint(blocks), ctypes.byref(filled))
