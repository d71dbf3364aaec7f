"""All settings of a run, composed of each stage's own; text in TOML, in and out.

A setting has a dotted path, `mapper.seeding.opacity`: its place in `SlamConfig`, in a TOML file, and as a flag of the
command line.
"""

import ast
import difflib
import inspect
import json
import math
import sys
import textwrap
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import cache
from typing import Any, Literal, get_args, get_origin, get_type_hints

from tcgsplat.confidence.state import ConfidenceConfig
from tcgsplat.errors import ConfigError
from tcgsplat.loop.settings import LoopConfig
from tcgsplat.mapping.schedule import ScheduleConfig
from tcgsplat.mapping.settings import MapperConfig
from tcgsplat.tracking.settings import TrackerConfig

Value = bool | int | float | str | tuple[bool | int | float | str, ...]
"""What a setting can be."""


@dataclass(frozen=True)
class SlamConfig:
    """Everything that a run's result depends on, besides its input."""

    tracker: TrackerConfig = field(default_factory=TrackerConfig)
    mapper: MapperConfig = field(default_factory=MapperConfig)
    schedule: ScheduleConfig = field(default_factory=ScheduleConfig)
    confidence: ConfidenceConfig = field(default_factory=lambda: ConfidenceConfig().for_updates_of(40))
    """The defaults of `ConfidenceConfig` on the scale of the default mapper: its ten steps an update, with centres
    moving three times as fast, take a Gaussian at rest as far as forty of the base system's. [ours]"""
    loop: LoopConfig = field(default_factory=LoopConfig)
    seed: int = 0
    """Of the one random generator. [base: TUM and ScanNet] (base: 1 on Replica)"""

    def __post_init__(self) -> None:
        if not 0 <= self.seed < 2**63:
            raise ConfigError(f"seed is {self.seed!r}; it must be from 0 to {2**63 - 1}")


def settings(config: SlamConfig) -> dict[str, Value]:
    """Every value by its dotted path, in the order of the fields."""
    return {path: getattr(owner, name) for path, owner, name in _leaves(config)}


def described(config: SlamConfig) -> dict[str, str]:
    """What every setting is: the docstring of its field by dotted path, on one line.

    A field without one, and without a mark of its origin such as `[paper]`, has that of its class.
    """
    texts = {}
    for path, owner, name in _leaves(config):
        text = _field_docs(owner.__class__).get(name, "")
        if "[" not in text:
            text = f"{text} {inspect.getdoc(type(owner)) or ''}"
        texts[path] = " ".join(text.split())
    return texts


def with_settings(config: SlamConfig, values: Mapping[str, object]) -> SlamConfig:
    """The same settings with some of them changed.

    Args:
        config: What holds where nothing else is said.
        values: New values by dotted path; a whole number will do for a real one, a list for a tuple.

    Raises:
        ConfigError: if there is no such setting, or its value has the wrong type or cannot be right.
    """
    known = settings(config)
    for path in values:
        if path not in known:
            raise ConfigError(_unknown(path, known))
    changed: SlamConfig = _replaced(config, "", values)
    return changed


def from_toml(text: str, base: SlamConfig | None = None) -> SlamConfig:
    """Settings from TOML; what the text leaves out is taken from `base`, by default `SlamConfig()`.

    Raises:
        ConfigError: if the text is not TOML, names an unknown setting, or gives one a value that cannot be right.
    """
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"the settings are not TOML: {error}") from error
    return with_settings(base or SlamConfig(), dict(_flattened(table)))


def to_toml(config: SlamConfig) -> str:
    """All settings as TOML, each under a comment with its meaning; `from_toml` reads back the very same ones."""
    return "\n".join(_lines(config, "")) + "\n"


def value_text(value: Value) -> str:
    """A value as TOML has it."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, tuple):
        return "[" + ", ".join(map(value_text, value)) + "]"
    return repr(value)  # the shortest digits that read back as the same float; inf is TOML's word too


def _leaves(node: Any, prefix: str = "") -> Iterator[tuple[str, Any, str]]:
    """Dotted path, owner and field name of every value."""
    for f in fields(node):
        value = getattr(node, f.name)
        if is_dataclass(value):
            yield from _leaves(value, f"{prefix}{f.name}.")
        else:
            yield f"{prefix}{f.name}", node, f.name


@cache
def _classes(module: str) -> dict[str, ast.ClassDef]:
    """Sources of a module's classes, by name: `inspect.getsource` of each would read the module several times over."""
    source = inspect.getsource(sys.modules[module])
    return {node.name: node for node in ast.parse(source).body if isinstance(node, ast.ClassDef)}


@cache
def _field_docs(owner: type) -> dict[str, str]:
    """Docstrings that follow the fields of a dataclass, by field."""
    definition = _classes(owner.__module__)[owner.__name__]
    docs = {}
    for statement, following in zip(definition.body, definition.body[1:], strict=False):
        if isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name):
            match following:
                case ast.Expr(value=ast.Constant(value=str(text))):
                    docs[statement.target.id] = text
    return docs


def _lines(node: Any, prefix: str) -> Iterator[str]:
    """A table's own values first, as TOML wants it, then its tables."""
    docs = _field_docs(node.__class__)
    for f in fields(node):
        value = getattr(node, f.name)
        if not is_dataclass(value):
            yield from textwrap.wrap(docs.get(f.name, ""), 120, initial_indent="# ", subsequent_indent="# ")
            yield f"{f.name} = {value_text(value)}"
    for f in fields(node):
        value = getattr(node, f.name)
        if is_dataclass(value):
            yield f"\n[{prefix}{f.name}]"
            yield from _lines(value, f"{prefix}{f.name}.")


def _flattened(table: Mapping[str, object], prefix: str = "") -> Iterator[tuple[str, object]]:
    for name, value in table.items():
        if isinstance(value, dict):
            yield from _flattened(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def _unknown(path: str, known: Mapping[str, Value]) -> str:
    inside = [other for other in known if other.startswith(f"{path}.")]
    if inside:
        return f"{path} is a table of settings; set one of them, such as {inside[0]}"
    same_name = [other for other in known if other.rpartition(".")[2] == path.rpartition(".")[2]]
    near = difflib.get_close_matches(path, known, n=1) or same_name
    return f"there is no setting {path}; " + (
        f"did you mean {near[0]}?" if near else "`tcgsplat presets default` lists them all"
    )


def _replaced(node: Any, prefix: str, values: Mapping[str, object]) -> Any:
    hints = get_type_hints(type(node))
    changes: dict[str, Any] = {}
    for f in fields(node):
        path, value = f"{prefix}{f.name}", getattr(node, f.name)
        if is_dataclass(value):
            changes[f.name] = _replaced(value, f"{path}.", values)
        elif path in values:
            changes[f.name] = _typed(path, values[path], hints[f.name])
    return replace(node, **changes)


def _typed(path: str, value: object, kind: Any) -> Value:
    """The value as the field's type has it."""
    match value:
        case bool() if kind is bool:
            return value
        case int() | float() if kind is float and not isinstance(value, bool) and not math.isnan(value):
            return float(value)
        case int() if kind is int and not isinstance(value, bool):
            return value
        case str() if kind is str or (get_origin(kind) is Literal and value in get_args(kind)):
            return value
        case list() | tuple() if get_origin(kind) is tuple:
            return tuple(_typed(path, item, get_args(kind)[0]) for item in value)  # type: ignore[misc]
    shown = value_text(value) if isinstance(value, bool | int | float | str) else str(value)
    raise ConfigError(f"{path} is {shown}; it must be {_expected(kind)}")


def _expected(kind: Any) -> str:
    if get_origin(kind) is Literal:
        return " or ".join(map(value_text, get_args(kind)))
    if get_origin(kind) is tuple:
        return f"a list, each item {_expected(get_args(kind)[0])}"
    return {bool: "true or false", int: "a whole number", float: "a number", str: "text in quotes"}[kind]
