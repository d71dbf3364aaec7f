"""What is true of a recording is for those who judge, never for what is judged."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[2] / "src" / "tcgsplat"
MAY_KNOW = ("cli", "datasets/synthetic", "evaluation")


def knows_of_truth(source: str) -> bool:
    """Whether a module imports `datasets.truth`, in whichever way, or names its folders."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import) and any("datasets.truth" in alias.name for alias in node.names):
            return True
        if isinstance(node, ast.ImportFrom) and node.module:
            named = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
            if any(name.endswith("datasets.truth") or ".datasets.truth." in name for name in named):
                return True
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value in ("truth", "free"):
            return True
    return False


@pytest.mark.parametrize(
    ("source", "known"),
    [
        ("from tcgsplat.datasets.truth import Truth", True),
        ("from tcgsplat.datasets import truth", True),
        ("import tcgsplat.datasets.truth as t", True),
        ("path = root / 'truth' / name", True),
        ("from tcgsplat.datasets import open_sequence", False),
    ],
)
def test_the_search_finds_it(source: str, known: bool) -> None:
    assert knows_of_truth(source) is known


def test_only_evaluation_and_who_makes_it_know_the_truth() -> None:
    files = {str(path.relative_to(PACKAGE)): path.read_text(encoding="utf-8") for path in PACKAGE.rglob("*.py")}
    knowing = {name for name, source in files.items() if knows_of_truth(source)}
    assert {name for name in knowing if not name.startswith(MAY_KNOW)} == {"datasets/truth.py"}
