"""A pretend device, where there is no GPU: what runs on it would run on one, and what would wait there is counted.

Its tensors hold their values in a CPU tensor, say that they are on the device `elsewhere`, refuse to meet tensors of
the CPU (but for scalars, as on a GPU) and to become numpy arrays, and come back by `.cpu()` or `.to` alone. It takes
the place that torch keeps for a backend of one's own, so that it is there on every thread, autograd's included.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any

import torch
from torch.autograd import Function
from torch.utils._pytree import tree_leaves, tree_map
from torch.utils.backend_registration import _setup_privateuseone_for_python_backend

from tcgsplat.geometry.camera import Camera
from tcgsplat.render.cuda.launching import Kernels
from tcgsplat.render.protocol import Raster, Rasterizer, Splats
from tcgsplat.tensors import Pose

aten = torch.ops.aten
_setup_privateuseone_for_python_backend("elsewhere")
DEVICE = torch.device("elsewhere", 0)

_COUNTERS: list[Counter[str]] = []
_SIZED_BY_VALUES = {
    aten._local_scalar_dense: "a number was read",
    aten.nonzero: "nonzero",
    aten.masked_select: "rows were picked by a mask",
    aten.unique_consecutive: "unique",
    aten._unique2: "unique",
}
_COPIES = {aten.copy_, aten._to_copy}
_INDEXED = {aten.index, aten.index_put, aten.index_put_, aten._index_put_impl_}
_FACTORIES = (
    "empty.memory_format", "empty_strided", "arange", "arange.start", "arange.start_step", "eye", "eye.m", "linspace",
)  # fmt: skip


class Elsewhere(torch.Tensor):
    """A tensor on the pretend device."""

    values: torch.Tensor

    @staticmethod
    def __new__(cls, values: torch.Tensor) -> "Elsewhere":
        return torch.Tensor._make_wrapper_subclass(  # type: ignore[attr-defined, no-any-return]
            cls, values.size(), strides=values.stride(), storage_offset=values.storage_offset(), dtype=values.dtype,
            device=DEVICE,
        )  # fmt: skip

    def __init__(self, values: torch.Tensor) -> None:
        self.values = values.detach()

    def __repr__(self, **_: object) -> str:
        return f"Elsewhere({self.values})"

    __torch_function__ = torch._C._disabled_torch_function_impl

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _performed(func, args, dict(kwargs or {}))


def _performed(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """The operation on the values, its results elsewhere again; an error where a GPU would give one."""
    packet, tensors = func.overloadpacket, [x for x in tree_leaves((args, kwargs)) if isinstance(x, torch.Tensor)]
    here = [x for x in tensors if not isinstance(x, Elsewhere)]
    target = kwargs.get("device")
    comes_back = target is not None and torch.device(target).type != DEVICE.type
    if packet in _COPIES:
        comes_back = comes_back or (packet is aten.copy_ and not isinstance(args[0], Elsewhere))
        waited = here and not (kwargs.get("non_blocking") or (packet is aten.copy_ and args[2:] == (True,)))
        if comes_back or waited:
            _count("values were copied to the CPU" if comes_back else "values were copied from the CPU")
    elif packet in _INDEXED:
        indices = [index for index in args[1] if index is not None]
        if any(index.dtype == torch.bool for index in indices):
            _count("rows were picked by a mask")
        if any(not isinstance(index, Elsewhere) for index in indices):
            _count("values were copied from the CPU")
    elif any(x.dim() > 0 for x in here):
        raise RuntimeError(f"{func} was given tensors on {DEVICE} and on the CPU")
    if packet in _SIZED_BY_VALUES:
        _count(_SIZED_BY_VALUES[packet])

    given = {id(x.values): x for x in tensors if isinstance(x, Elsewhere)}  # what is changed in place stays itself
    args, kwargs = tree_map(lambda x: x.values if isinstance(x, Elsewhere) else x, (args, kwargs))
    kwargs = {name: value for name, value in kwargs.items() if name != "pin_memory"}
    if target is not None:
        kwargs["device"] = torch.device("cpu")

    def placed(result: object) -> object:
        if comes_back or not isinstance(result, torch.Tensor):
            return result
        return given[id(result)] if id(result) in given else Elsewhere(result)

    return tree_map(placed, _done(func, args, kwargs))


def _count(what: str) -> None:
    if _TAPES:
        raise RuntimeError(f"not permitted while a graph is recorded: {what}")
    for counter in _COUNTERS:
        counter[what] += 1


class _Tape:
    """What is done while a graph is recorded. To know its results' shapes it is done, and then undone."""

    def __init__(self) -> None:
        self._entries: list[tuple[Callable[..., Any], Any, Any, Any]] = []
        self._before: dict[int, tuple[torch.UntypedStorage, torch.UntypedStorage]] = {}

    def do(self, func: Callable[..., Any], args: Any, kwargs: Any) -> Any:
        for x in tree_leaves((args, kwargs)):
            if isinstance(x, torch.Tensor):
                memory = x.untyped_storage()
                self._before.setdefault(memory.data_ptr(), (memory, memory.clone()))
        result = func(*args, **kwargs)
        self._entries.append((func, args, kwargs, result))
        return result

    def undo(self) -> None:
        for memory, before in self._before.values():
            memory.copy_(before)

    def replay(self) -> None:
        for func, args, kwargs, result in self._entries:
            again = func(*args, **kwargs)
            for old, new in zip(tree_leaves(result), tree_leaves(again), strict=True):
                if isinstance(old, torch.Tensor) and old.data_ptr() != new.data_ptr():
                    old.copy_(new)


_TAPES: list[_Tape] = []


def _done(func: Callable[..., Any], args: Any, kwargs: Any) -> Any:
    return _TAPES[-1].do(func, args, kwargs) if _TAPES else func(*args, **kwargs)


class Recording:
    """A `Recorder` for the pretend device, which is as strict as a graph: only what was launched is launched again, on
    the same memory, whatever Python knows by then; and nothing may be waited for.
    """

    def __init__(self) -> None:
        self.count = 0

    def aside(self) -> AbstractContextManager[None]:
        return nullcontext()

    def recorded(self, step: Callable[[], None]) -> Callable[[], None]:
        self.count += 1
        tape = _Tape()
        _TAPES.append(tape)
        try:
            step()
        finally:
            _TAPES.pop()
            tape.undo()
        return tape.replay

    def forget(self) -> None:
        pass


class DistantKernels:
    """Kernels of the CPU for tensors of the pretend device."""

    def __init__(self, kernels: Kernels) -> None:
        self._kernels = kernels

    def launch(self, name: str, blocks: int, arguments: Mapping[str, Any]) -> None:
        def here(x: object) -> object:
            return x.values if isinstance(x, Elsewhere) else x

        assert not any(isinstance(x, torch.Tensor) and not isinstance(x, Elsewhere) for x in arguments.values())
        _done(self._kernels.launch, (name, blocks, {key: here(x) for key, x in arguments.items()}), {})


@contextmanager
def counted_waits() -> Iterator[Counter[str]]:
    """Counts what a GPU would have been waited for inside, on any thread, by what it was."""
    counter: Counter[str] = Counter()
    _COUNTERS.append(counter)
    try:
        yield counter
    finally:
        _COUNTERS.remove(counter)


def _registered() -> torch.library.Library:
    """What makes tensors of nothing, and what `torch.tensor` brings them by."""
    library = torch.library.Library("aten", "IMPL")

    def factory(name: str) -> Callable[..., torch.Tensor]:
        packet, _, overload = name.partition(".")
        func = getattr(getattr(aten, packet), overload or "default")

        def made(*args: Any, device: object = None, pin_memory: object = None, **kwargs: Any) -> torch.Tensor:
            return Elsewhere(_done(func, args, {**kwargs, "device": "cpu"}))

        return made

    def brought(source: torch.Tensor, target: torch.Tensor, non_blocking: bool = False) -> torch.Tensor:
        assert isinstance(target, Elsewhere) and not isinstance(source, Elsewhere)
        if not non_blocking or _TAPES:
            _count("values were copied from the CPU")
        target.values.copy_(source)
        return target

    for name in _FACTORIES:
        library.impl(name, factory(name), "PrivateUse1")
    library.impl("_copy_from", brought, "PrivateUse1")
    return library


_LIBRARY = _registered()


class _Here(Function):
    """Values as a kernel of the device sees them; nobody waits for that."""

    @staticmethod
    def forward(_: Any, x: torch.Tensor) -> torch.Tensor:
        return x.values.clone() if isinstance(x, Elsewhere) else x.clone()

    @staticmethod
    def backward(_: Any, gradient: torch.Tensor) -> torch.Tensor:
        return Elsewhere(gradient)


class _There(Function):
    """What a kernel leaves on the device."""

    @staticmethod
    def forward(_: Any, x: torch.Tensor) -> torch.Tensor:
        return Elsewhere(x.clone())

    @staticmethod
    def backward(_: Any, gradient: torch.Tensor) -> torch.Tensor:
        assert isinstance(gradient, Elsewhere)
        return gradient.values


def _seen(x: torch.Tensor) -> torch.Tensor:
    return _Here.apply(x) if isinstance(x, Elsewhere) else x  # type: ignore[no-any-return, no-untyped-call]


class Distant:
    """A rasterizer of the pretend device: another one's kernels on the values, and the device's refusals."""

    name = "distant"

    def __init__(self, rasterizer: Rasterizer) -> None:
        self.device = DEVICE
        self._rasterizer = rasterizer

    def reserved(self) -> AbstractContextManager[None]:
        return self._rasterizer.reserved()

    def __call__(self, splats: Splats, camera: Camera, T_cam_map: Pose) -> Raster:
        tables = (splats.means, splats.quats, splats.scales, splats.opacities, splats.features)
        assert all(isinstance(table, Elsewhere) for table in tables), "splats must be on the rasterizer's device"
        raster = self._rasterizer(Splats(*(_seen(table) for table in tables)), camera, _seen(T_cam_map))
        images = (raster.features, raster.depth, raster.plane_depth, raster.alpha)
        features, depth, plane, alpha = (_There.apply(image) for image in images)  # type: ignore[no-untyped-call]
        return Raster(features, depth, plane, alpha, Elsewhere(raster.visible))


class Near:
    """The same rasterizer on the CPU, under a name for which there are no faster paths."""

    name = "near"

    def __init__(self, rasterizer: Rasterizer) -> None:
        self.device = rasterizer.device
        self.reserved = rasterizer.reserved
        self._rasterizer = rasterizer

    def __call__(self, splats: Splats, camera: Camera, T_cam_map: Pose) -> Raster:
        return self._rasterizer(splats, camera, T_cam_map)
