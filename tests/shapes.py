"""Annotations of the package checked at run time: array shapes by jaxtyping, everything else by beartype."""

import ast
import dataclasses
import functools
import re
import sys
import typing
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from pathlib import Path
from types import CodeType
from typing import Any, NoReturn

from beartype import BeartypeConf, beartype
from jaxtyping import AbstractArray, jaxtyped

SOURCE = Path(__file__).parents[1] / "src"
IMPORTS_NUMBA = re.compile(
    r"^(from|import) (numba|llvmlite|tcgsplat\.render\.numba_cpu\.compilation import (inner|kernel)\b)", re.MULTILINE
)
LIKE_A_TYPE_CHECKER = BeartypeConf(is_pep484_tower=True)  # an int may stand for a float, as for mypy


def checked(thing: Any) -> Any:
    """A function, or a dataclass's constructor, with its annotations enforced.

    Settings are left to their own checks, which give better reasons.
    """
    if isinstance(thing, type):
        if dataclasses.is_dataclass(thing) and not thing.__name__.endswith("Config"):
            thing.__init__ = checked(thing.__init__)  # type: ignore[misc]
        return thing
    enforced = beartype(conf=LIKE_A_TYPE_CHECKER)(thing)
    hints = thing.__annotations__.values()
    if not any(has_shape(hint) for hint in hints):
        return enforced
    if any("{" in str(hint) for hint in hints):  # dimensions that are arguments: all of them must be looked at
        return jaxtyped(enforced, typechecker=None)

    @functools.wraps(thing)
    def with_dimensions(*arguments: Any, **named: Any) -> Any:
        with jaxtyped("context"):  # in which a dimension's name means one number
            return enforced(*arguments, **named)

    return with_dimensions


def has_shape(hint: Any) -> bool:
    """Whether an annotation is of an array, or has one in it; one in quotes may."""
    if isinstance(hint, str) or (isinstance(hint, type) and issubclass(hint, AbstractArray)):
        return True
    return any(has_shape(part) for part in (hint if isinstance(hint, list) else typing.get_args(hint)))


def checkable_modules() -> list[str]:
    """All modules but those with numba kernels, which must not be wrapped; a package's name would include them."""
    return [
        ".".join(file.relative_to(SOURCE).with_suffix("").parts)
        for file in sorted(SOURCE.rglob("*.py"))
        if file.name != "__init__.py" and not IMPORTS_NUMBA.search(file.read_text(encoding="utf-8"))
    ]


def decorator() -> ast.expr:
    return ast.parse("__import__('shapes').checked", mode="eval").body


class Decorating(SourceFileLoader):
    """Loads a module as if every function and class in it were decorated by `checked`; keeps no bytecode of that."""

    def source_to_code(self, data: Any, path: Any, *, _optimize: int = -1) -> CodeType:  # type: ignore[override]
        tree = ast.parse(data)
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                node.decorator_list.append(decorator())  # next to the function, whose annotations others may hide
            elif isinstance(node, ast.ClassDef):
                node.decorator_list.insert(0, decorator())  # once it is a dataclass
        return compile(ast.fix_missing_locations(tree), path, "exec", dont_inherit=True, optimize=_optimize)

    def path_stats(self, path: Any) -> NoReturn:  # noqa: ARG002
        raise OSError("its bytecode is not that of its source")


class Finder(MetaPathFinder):
    """Finds the modules that are to be checked."""

    def __init__(self, modules: list[str]) -> None:
        self.modules = frozenset(modules)

    def find_spec(self, fullname: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        spec = PathFinder.find_spec(fullname, path, target) if fullname in self.modules else None
        if spec is not None and spec.origin is not None:
            spec.loader = Decorating(fullname, spec.origin)
        return spec


def check_from_now_on() -> None:
    """Check every module of the package that is imported later."""
    sys.meta_path.insert(0, Finder(checkable_modules()))
