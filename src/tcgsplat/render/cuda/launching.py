"""CUDA kernels without a compiler: their text goes to NVRTC, which comes with every CUDA build of torch.

What NVRTC makes is kept on disk. Both libraries are called through ctypes: six functions of NVRTC, eight of the driver,
whose C interfaces have stayed as they are since CUDA 8.
"""

import ctypes
import hashlib
import os
import re
import sys
import threading
from collections.abc import Mapping
from functools import cache
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from types import MappingProxyType
from typing import Any, Protocol, runtime_checkable

import torch

from tcgsplat.errors import BackendUnavailableError
from tcgsplat.render.availability import driver_library

THREADS = 256
"""Of a block, always."""
_SIZES = MappingProxyType({"float": ctypes.c_float, "int": ctypes.c_int, "long long": ctypes.c_longlong})
_ELEMENTS = MappingProxyType(
    {
        "float": torch.float32,
        "double": torch.float64,
        "int": torch.int32,
        "long long": torch.int64,
        "unsigned char": torch.bool,
    }
)
_FIELD = re.compile(r"(?:const )?(float|double|int|long long|unsigned char|[A-Z]\w*)(\*?) ([\w, ]+);")


def source(constants: Mapping[str, str], *paths: str) -> str:
    """The text of kernels: constants, then files of the package, one after the other."""
    defined = "".join(f"#define {name} {value}\n" for name, value in constants.items())
    return defined + "\n".join(files("tcgsplat").joinpath(path).read_text() for path in paths)


@runtime_checkable
class Kernels(Protocol):
    """Compiled kernels, by name."""

    def launch(self, name: str, blocks: int, arguments: Mapping[str, Any]) -> None:
        """Run a kernel on so many blocks of THREADS threads.

        Args:
            name: As in its text.
            blocks: At least 1.
            arguments: By the names of its struct: tensors for pointers, or None; numbers; mappings for structs in it.
        """
        ...


class Signatures:
    """What the kernels of a text take, read from its declarations."""

    def __init__(self, text: str) -> None:
        code = re.sub(r"//[^\n]*", "", text)
        self._bodies = dict(re.findall(r"struct (\w+) \{(.*?)\n\};", code, re.DOTALL))
        self.arguments = dict(re.findall(r"KERNEL\((\w+), (\w+)\) \{", code))
        """From kernel to the name of its struct."""
        for struct in self.arguments.values():
            self._structure(struct)  # made now, by one thread: another one's would be another class

    def filled(self, kernel: str, values: Mapping[str, Any]) -> ctypes.Structure:
        """The struct of a kernel, with these values; tensors must live until it has run.

        Raises:
            TypeError: for a value that is not of the declared kind.
        """
        return self._filled(self.arguments[kernel], values)

    def _filled(self, struct: str, values: Mapping[str, Any]) -> ctypes.Structure:
        fields = self._fields(struct)
        if set(values) != {name for name, _, _ in fields}:
            raise TypeError(f"{struct} has {[name for name, _, _ in fields]}, not {list(values)}")
        filled = self._structure(struct)()
        for name, kind, pointer in fields:
            value = values[name]
            if pointer and value is not None:
                if value.dtype != _ELEMENTS[kind] or not value.is_contiguous():
                    raise TypeError(f"{struct}.{name} is {value.dtype}, not {_ELEMENTS[kind]} side by side")
                value = value.data_ptr()
            elif not pointer and kind not in _SIZES:
                value = self._filled(kind, value)
            setattr(filled, name, value)
        return filled

    @cache  # noqa: B019  lives as long as the kernels do
    def _fields(self, struct: str) -> tuple[tuple[str, str, bool], ...]:
        declared = _FIELD.findall(self._bodies[struct])
        return tuple((name, kind, bool(star)) for kind, star, names in declared for name in names.split(", "))

    @cache  # noqa: B019
    def _structure(self, struct: str) -> type[ctypes.Structure]:
        fields = [
            (name, ctypes.c_void_p if pointer else _SIZES.get(kind) or self._structure(kind))
            for name, kind, pointer in self._fields(struct)
        ]
        return type(struct, (ctypes.Structure,), {"_fields_": fields})


class Compiled:
    """Kernels on a GPU."""

    def __init__(self, text: str, device: torch.device) -> None:
        """Compile, or take what was compiled before.

        Args:
            text: Of all kernels, as C++.
            device: A GPU that torch sees.

        Raises:
            BackendUnavailableError: if NVRTC is not to be found or refuses, or the driver does.
        """
        self._signatures, self._device = Signatures(text), device
        major, minor = torch.cuda.get_device_capability(device)
        architecture = f"sm_{major}{minor}"
        binary = _compiled(text, architecture)
        torch.cuda.current_stream(device).synchronize()  # from here on there is a context
        self._driver = driver_library()  # torch has it already
        self._context, self._module = ctypes.c_void_p(), ctypes.c_void_p()
        self._call("cuDevicePrimaryCtxRetain", ctypes.byref(self._context), ctypes.c_int(device.index or 0))
        self._call("cuCtxSetCurrent", self._context)
        if self._driver.cuModuleLoadData(ctypes.byref(self._module), binary):  # what was kept may be damaged
            binary = _compiled(text, architecture, again=True)
            self._call("cuModuleLoadData", ctypes.byref(self._module), binary)
        self._functions: dict[str, ctypes.c_void_p] = {}
        for name in self._signatures.arguments:
            function = ctypes.c_void_p()
            self._call("cuModuleGetFunction", ctypes.byref(function), self._module, name.encode())
            self._functions[name] = function

    def launch(self, name: str, blocks: int, arguments: Mapping[str, Any]) -> None:
        """See `Kernels`; on the current stream, without waiting.

        Raises:
            TypeError: for arguments that are not the declared ones, or not on this GPU.
            BackendUnavailableError: if the driver refuses.
        """
        elsewhere = [key for key, value in arguments.items() if getattr(value, "device", self._device) != self._device]
        if elsewhere:
            raise TypeError(f"{name}: {elsewhere} must be on {self._device}")
        filled = self._signatures.filled(name, arguments)
        pointers = (ctypes.c_void_p * 1)(ctypes.addressof(filled))
        stream = ctypes.c_void_p(torch.cuda.current_stream(self._device).cuda_stream)
        self._call("cuCtxSetCurrent", self._context)  # each thread has its own
        self._call("cuLaunchKernel", self._functions[name], blocks, 1, 1, THREADS, 1, 1, 0, stream, pointers, None)

    def _call(self, function: str, *arguments: Any) -> None:
        status = getattr(self._driver, function)(*arguments)
        if status:
            text = ctypes.c_char_p()
            self._driver.cuGetErrorString(status, ctypes.byref(text))
            said = (text.value or b"unknown error").decode()
            raise BackendUnavailableError(f"the CUDA driver refuses {function}: {said}; `tcgsplat doctor` tells more")


def _compiled(text: str, architecture: str, *, again: bool = False) -> bytes:
    """The kernels as machine code, from the cache if they are there; or compiled again, and kept in their place."""
    nvrtc = nvrtc_library()
    version = (ctypes.c_int(), ctypes.c_int())
    nvrtc.nvrtcVersion(*map(ctypes.byref, version))
    key = f"{version[0].value}.{version[1].value} {_options(architecture)} {text}"
    kept = _cache_folder() / f"kernels-{hashlib.sha256(key.encode()).hexdigest()[:16]}.cubin"
    if kept.is_file() and not again:
        return kept.read_bytes()
    binary = compiled(nvrtc, text, architecture)
    try:
        kept.parent.mkdir(parents=True, exist_ok=True)
        unfinished = kept.with_suffix(f".{os.getpid()}.{threading.get_ident()}")
        unfinished.write_bytes(binary)
        unfinished.replace(kept)
    except OSError:  # then it is compiled again the next time
        pass
    return binary


def _options(architecture: str) -> list[str]:
    return [f"--gpu-architecture={architecture}", "--use_fast_math", "--std=c++17"]


def compiled(nvrtc: ctypes.CDLL, text: str, architecture: str) -> bytes:
    """Machine code of a text by NVRTC; needs no GPU.

    Raises:
        BackendUnavailableError: with what NVRTC says, if it refuses.
    """
    options = _options(architecture)
    program, size = ctypes.c_void_p(), ctypes.c_size_t()
    nvrtc.nvrtcCreateProgram(ctypes.byref(program), text.encode(), b"tcgsplat.cu", 0, None, None)
    array = (ctypes.c_char_p * len(options))(*[option.encode() for option in options])
    try:
        if nvrtc.nvrtcCompileProgram(program, len(options), array):
            nvrtc.nvrtcGetProgramLogSize(program, ctypes.byref(size))
            log = ctypes.create_string_buffer(size.value)
            nvrtc.nvrtcGetProgramLog(program, log)
            said = log.value.decode().splitlines()
            first = next((line for line in said if "error" in line), "it does not say why")
            raise BackendUnavailableError(
                f"NVRTC does not compile the kernels for {architecture}: {first}; a torch that is built for a newer "
                "CUDA knows newer GPUs"
            )
        nvrtc.nvrtcGetCUBINSize(program, ctypes.byref(size))
        binary = ctypes.create_string_buffer(size.value)
        nvrtc.nvrtcGetCUBIN(program, binary)
        return binary.raw
    finally:
        nvrtc.nvrtcDestroyProgram(ctypes.byref(program))


def nvrtc_library() -> ctypes.CDLL:
    """NVRTC, where torch's wheels or a CUDA toolkit have put it.

    Raises:
        BackendUnavailableError: if there is none.
    """
    names = _nvrtc_names()
    for name in names:
        try:
            return ctypes.CDLL(name)
        except OSError:
            continue
    raise BackendUnavailableError(
        f"NVRTC, CUDA's run-time compiler, is not to be found as any of {', '.join(names)}; `tcgsplat doctor` tells "
        "more"
    )


def _nvrtc_names() -> list[str]:
    pattern = "nvrtc64_*.dll" if sys.platform == "win32" else "libnvrtc.so*"
    specs = (find_spec("nvidia"), find_spec("torch"))
    roots = [Path(place) for spec in specs if spec for place in spec.submodule_search_locations or ()]
    found = [
        path for root in roots for folder in ("*/lib", "*/bin", "lib") for path in root.glob(f"{folder}/{pattern}")
    ]
    major = (torch.version.cuda or "").split(".")[0]
    of_torch = sorted(
        (str(path) for path in found if "alt" not in path.name), key=lambda name: f".so.{major}" not in name
    )
    return [*of_torch, f"libnvrtc.so.{major}", "libnvrtc.so", "/usr/local/cuda/lib64/libnvrtc.so"]


def _cache_folder() -> Path:
    root = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(root) / "tcgsplat"
