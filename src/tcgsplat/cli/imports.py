"""Imports that take a third less than they would by themselves: some of it is left out, some of it goes beside.

Of use to a command that has to start at once; nothing else in this package knows of it.
"""

import cmath  # noqa: F401  # numba wants it while `load_meanwhile` is at it, and would wait for it
import ctypes
import gc
import inspect
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from threading import Thread
from types import ModuleType
from typing import Final

_SHAPES: Final = "torch._meta_registrations"
_KNOWN: Final = "2.13."
"""Version of torch. In another, more may hang on `_SHAPES` while it is imported, so it is imported whole."""


@contextmanager
def as_if_missing(*modules: str) -> Iterator[None]:
    """Whoever imports one of them inside finds that it is not installed, unless it is there already."""
    absent = [module for module in modules if module not in sys.modules]
    sys.modules.update(dict.fromkeys(absent))  # type: ignore[arg-type]  # None is what Python itself puts there to say so
    try:
        yield
    finally:
        for module in absent:
            del sys.modules[module]


@contextmanager
def here_to_stay() -> Iterator[None]:
    """Python looks for no garbage inside, nor ever again among what was made there: imports make 340 000 objects.

    Only where they are made indeed: if torch was imported before, what is around may be garbage some day.
    """
    if "torch" in sys.modules:
        yield
        return
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()


def load_meanwhile() -> None:
    """Have the system load torch's and OpenCV's libraries on a thread: Python, which goes on, will find them there.

    They take a quarter of a second, in which whoever needs the system's loader waits. Left to their import is what
    cannot be loaded, and a torch for GPUs, which looks for its libraries in more places.
    """
    libraries = [*_files_of("cv2", "cv2*.so")]
    if not _torch_is_for_gpus():
        libraries = [*_files_of("torch", "lib/libtorch_cpu.*"), *libraries]
    if libraries and os.name == "posix":
        Thread(target=_load, args=(libraries,), daemon=True).start()


def _torch_is_for_gpus() -> bool:
    return any(_files_of("torch", f"lib/libtorch_{kind}.*") for kind in ("cuda", "hip", "xpu"))


def _files_of(package: str, pattern: str) -> list[Path]:
    """None if it is imported already."""
    spec = None if package in sys.modules else find_spec(package)
    return [] if spec is None or spec.origin is None else sorted(Path(spec.origin).parent.glob(pattern))


def _load(libraries: Sequence[Path]) -> None:
    dlopen = ctypes.CDLL(None).dlopen  # `ctypes.CDLL(library)` would keep Python from going on
    dlopen.argtypes, dlopen.restype = (ctypes.c_char_p, ctypes.c_int), ctypes.c_void_p
    for library in libraries:
        dlopen(os.fsencode(library), os.RTLD_NOW)


def import_torch() -> None:
    """Import torch but for a fifth of it that no run needs: what shapes come out of tensors without data.

    Its compilers ask for that. Whoever does, or imports one more of torch's modules, gets it first. Until then
    `torch.Generator()` raises RuntimeError; `torch.default_generator.clone_state()` gives one all the same. A torch for
    GPUs, with which nobody has tried this, is imported whole, and so is another version.
    """
    if "torch" not in sys.modules and _torch_version().startswith(_KNOWN) and not _torch_is_for_gpus():
        sys.modules[_SHAPES] = _Postponed(_SHAPES)
        with _frames_without_modules():
            import_module("torch")
        sys.meta_path.insert(0, _BeforeMoreOfTorch())


@contextmanager
def _frames_without_modules() -> Iterator[None]:
    """Whoever asks `inspect` for a line of source, as torch does where it defines operations, gets just the line.

    To find the module too, it would resolve the paths of all modules: 0.04 s.
    """
    getmodule = inspect.getmodule

    def unless_frame(object: object, _filename: str | None = None) -> ModuleType | None:  # noqa: A002  # its own name
        return None if inspect.isframe(object) else getmodule(object, _filename)

    inspect.getmodule = unless_frame
    try:
        yield
    finally:
        inspect.getmodule = getmodule


def _torch_version() -> str:
    try:
        return version("torch")
    except PackageNotFoundError:  # there, but not by an installer
        return ""


class _Postponed(ModuleType):
    """Stands where a module will be, and becomes it when something in it is asked for."""

    def __getattr__(self, name: str) -> object:
        if name.startswith("__"):  # asked of every module, by `inspect` for instance
            raise AttributeError(name)
        return getattr(_present(), name)


class _BeforeMoreOfTorch:
    """A finder of modules that finds none, but has `_SHAPES` imported before any further module of torch."""

    def find_spec(self, name: str, _path: Sequence[str] | None, _target: ModuleType | None = None, /) -> None:
        if name.startswith("torch."):
            _present()


def _present() -> ModuleType:
    """`_SHAPES` itself."""
    if isinstance(sys.modules.get(_SHAPES), _Postponed):
        sys.modules.pop(_SHAPES, None)
        sys.meta_path[:] = [finder for finder in sys.meta_path if not isinstance(finder, _BeforeMoreOfTorch)]
    return import_module(_SHAPES)
