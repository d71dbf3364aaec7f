"""A command's arguments, and its help: tyro's, but that all of it fits the terminal and tells no default of nothing."""

import io
import re
import shutil
import sys
import textwrap
from collections.abc import Sequence
from contextlib import redirect_stdout
from dataclasses import replace
from types import UnionType
from typing import Annotated, Any, Union, get_args, get_origin

import tyro
from tyro.constructors import ConstructorRegistry, StructConstructorSpec, StructFieldSpec, StructTypeInfo

_STYLE = (tyro.conf.FlagCreatePairsOff, tyro.conf.DisallowNone, tyro.conf.PositionalMetavarFromFieldName)
_NOTHING = ("None", "False", "True", "", "''")
"""Defaults that say no more than that a flag was left out."""


def parsed(kind: Any, program: str, arguments: Sequence[str]) -> Any:
    """What the arguments make of a dataclass.

    Raises:
        SystemExit: if help was asked for, which is printed then, or if the arguments are wrong, which is said.
    """
    registry = ConstructorRegistry()
    registry.struct_rule(_Told())
    with redirect_stdout(_Folding(sys.stdout)):
        return tyro.cli(kind, prog=program, args=arguments, config=_STYLE, registry=registry)


class _Told:
    """tyro's own rule for a dataclass, with what it tells of each field put in order."""

    def __init__(self) -> None:
        self._asking = False

    def __call__(self, info: StructTypeInfo) -> StructConstructorSpec | None:
        if self._asking:
            return None  # so that tyro goes on to its own rules
        self._asking = True
        try:
            found = ConstructorRegistry.get_struct_spec(info)
        finally:
            self._asking = False
        if not isinstance(found, StructConstructorSpec):
            return None
        return replace(found, fields=tuple(_in_order(field) for field in found.fields))


def _in_order(field: StructFieldSpec) -> StructFieldSpec:
    """Its docstring as one paragraph, however it is broken in the source, and no default where that is nothing."""

    def told() -> str | None:
        text = field.helptext() if callable(field.helptext) else field.helptext
        return None if text is None else re.sub(r"\s*\n\s*", " ", text)

    typed: Any = Annotated[_plain(field.type), tyro.conf.arg(help_behavior_hint=_default)]
    return replace(field, helptext=told, type=typed)


def _plain(kind: Any) -> Any:
    """A type that tyro itself can hold a default against; for others it imports typeguard, a twentieth of the start."""
    if get_origin(kind) is Annotated:
        return Annotated[(_plain(kind.__origin__), *kind.__metadata__)]  # type: ignore[return-value]
    if get_origin(kind) is UnionType:
        return Union[get_args(kind)]  # noqa: UP007
    return dict if get_origin(kind) is dict else kind


def _default(value: str) -> str:
    return "" if value in _NOTHING else f"(default: {value})"


class _Folding(io.TextIOBase):
    """Another stream, where long lines of prose are folded to the terminal; what is in boxes, tyro folds itself."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream

    @property
    def encoding(self) -> Any:  # type: ignore[override]
        """Of the stream: tyro asks for it, to know which boxes it can draw."""
        return self._stream.encoding

    def isatty(self) -> bool:
        """Of the stream: tyro asks for it, to know whether there are colours."""
        return bool(self._stream.isatty())

    def flush(self) -> None:
        """Flush the stream."""
        self._stream.flush()

    def write(self, text: str) -> int:
        """Write folded text."""
        width = shutil.get_terminal_size().columns
        self._stream.write("\n".join(_folded(line, width) for line in text.split("\n")))
        return len(text)


def _folded(line: str, width: int) -> str:
    if len(line) <= width or "\x1b" in line:  # colours are in what tyro has folded
        return line
    indent = "  " if line.startswith("usage:") else ""
    return textwrap.fill(line, width, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)
