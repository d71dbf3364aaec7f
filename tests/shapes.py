"""Annotations of the package checked at run time: array shapes by jaxtyping, everything else by beartype."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jaxtyping
from beartype import BeartypeConf, beartype

SOURCE = Path(__file__).parents[1] / "src"
IMPORTS_NUMBA = re.compile(r"^(from|import) (numba|llvmlite)", re.MULTILINE)
LIKE_A_TYPE_CHECKER = BeartypeConf(is_pep484_tower=True)  # an int may stand for a float, as for mypy


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function with its annotations enforced; settings are left to their own checks, which give better reasons."""
    if function.__qualname__.endswith("Config.__init__"):
        return function
    return beartype(conf=LIKE_A_TYPE_CHECKER)(function)


def checkable_modules() -> list[str]:
    """All modules but those with numba kernels, which must not be wrapped; a package's name would include them."""
    return [
        ".".join(file.relative_to(SOURCE).with_suffix("").parts)
        for file in sorted(SOURCE.rglob("*.py"))
        if file.name != "__init__.py" and not IMPORTS_NUMBA.search(file.read_text(encoding="utf-8"))
    ]


def check_from_now_on() -> None:
    """Check every module of the package that is imported later."""
    jaxtyping.install_import_hook(checkable_modules(), "shapes.checked")
