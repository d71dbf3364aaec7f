"""Rules of the house that a parser can check; the import layers are lint-imports' and run in `make test`."""

import ast
import tomllib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[2] / "src" / "tcgsplat"
FILES = sorted(PACKAGE.rglob("*.py"))
IMMUTABLE = {"Mapping", "tuple", "frozenset", "Final"}


def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def violations(search: Callable[[ast.Module], Iterable[ast.AST]], *, exempt: tuple[str, ...] = ()) -> list[str]:
    """Where in the package, but for the exempt folders, a search finds something."""
    return [
        f"{path.relative_to(PACKAGE)}:{node.lineno}"  # type: ignore[attr-defined]
        for path in FILES
        if path.relative_to(PACKAGE).parts[0] not in exempt
        for node in search(tree(path))
    ]


def calls(module: ast.Module, *names: str) -> list[ast.Call]:
    return [node for node in ast.walk(module) if isinstance(node, ast.Call) and ast.unparse(node.func) in names]


def imports(module: ast.Module, *names: str) -> list[ast.AST]:
    plain = [n for n in ast.walk(module) if isinstance(n, ast.Import) and {a.name for a in n.names} & set(names)]
    return [*plain, *(n for n in ast.walk(module) if isinstance(n, ast.ImportFrom) and n.module in names)]


def statements(module: ast.Module) -> Iterator[ast.stmt]:
    """What runs when a module is imported, inside `if` and `try` too, but not inside functions and classes."""
    waiting: list[ast.AST] = list(module.body)
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.stmt) and not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield node
            waiting += list(ast.iter_child_nodes(node))


def mutable_state(module: ast.Module) -> list[ast.AST]:
    """Module-level names bound to a list, dict, set or object of ours, unless a type says that nobody writes there."""
    found: list[ast.AST] = []
    for statement in statements(module):
        if isinstance(statement, ast.Assign):
            names, annotation = [ast.unparse(target) for target in statement.targets], ""
        elif isinstance(statement, ast.AnnAssign):
            names, annotation = [ast.unparse(statement.target)], ast.unparse(statement.annotation)
        else:
            continue
        value = statement.value
        displays = ast.List | ast.Dict | ast.Set | ast.ListComp | ast.DictComp | ast.SetComp
        holders = {"list", "dict", "set", "defaultdict", "deque", "Counter", "OrderedDict", "bytearray"}
        holds = isinstance(value, displays) or (
            isinstance(value, ast.Call) and ast.unparse(value.func).split(".")[-1] in holders
        )
        constant = all(name.strip("_").isupper() for name in names) and annotation.split("[")[0] in IMMUTABLE
        if holds and not constant and names != ["__all__"]:
            found.append(statement)
    return found


@pytest.mark.parametrize(
    ("source", "caught"),
    [
        ("cache = {}", True),
        ("NAMES = ['a']", True),
        ("NAMES: Mapping[str, int] = {}", False),
        ("names: Mapping[str, int] = {}", True),
        ("NAMES = ('a', 'b')", False),
        ("SEEN = set()", True),
        ("if True:\n    _seen = [1]", True),
        ("TABLE: Final = {1: 2}", False),
        ("__all__ = ['a']", False),
        ("def f():\n    x = []", False),
        ("class A:\n    x: list = []", False),
    ],
)
def test_the_search_for_mutable_state_finds_it(source: str, caught: bool) -> None:
    assert bool(mutable_state(ast.parse(source))) is caught


def test_modules_keep_no_state() -> None:
    assert violations(mutable_state) == []
    assert violations(lambda module: [n for n in ast.walk(module) if isinstance(n, ast.Global)]) == []


def test_only_the_command_line_prints() -> None:
    written = ("print", "sys.stdout.write", "sys.stderr.write")
    assert violations(lambda module: calls(module, *written), exempt=("cli",)) == []


def test_only_rasterizers_and_the_command_line_name_a_device() -> None:
    def named(module: ast.Module) -> list[ast.AST]:
        texts = [n for n in ast.walk(module) if isinstance(n, ast.Constant) and isinstance(n.value, str)]
        literals = [n for n in texts if n.value in ("cpu", "cuda", "mps") or n.value.startswith("cuda:")]
        return [*literals, *calls(module, "torch.device")]

    assert violations(named, exempt=("cli", "render")) == []


def test_randomness_comes_from_generators_that_are_passed_in() -> None:
    torch_draws = [f"torch.{name}" for name in ("rand", "randn", "randint", "randperm", "rand_like", "multinomial")]
    good = ("np.random.default_rng", "np.random.Generator", "np.random.PCG64", "np.random.Philox")

    def loose(module: ast.Module) -> list[ast.AST]:
        drawn = [n for n in calls(module, *torch_draws) if "generator" not in {k.arg for k in n.keywords}]
        legacy = [
            n for n in ast.walk(module) if isinstance(n, ast.Call) and ast.unparse(n.func).startswith("np.random.")
        ]
        seeded = calls(module, "torch.manual_seed")
        return [*drawn, *(n for n in legacy if ast.unparse(n.func) not in good), *seeded, *imports(module, "random")]

    assert violations(loose) == []


def test_nothing_is_pickled() -> None:
    def pickled(module: ast.Module) -> list[ast.AST]:
        loads = [n for n in calls(module, "np.load", "numpy.load") if "allow_pickle=False" not in ast.unparse(n)]
        loads += [n for n in calls(module, "torch.load") if "weights_only=True" not in ast.unparse(n)]
        picklers = imports(module, "pickle", "dill", "joblib")
        harmful = [n for n in picklers if ast.unparse(n) != "from pickle import UnpicklingError"]
        return [*loads, *calls(module, "torch.save"), *harmful]

    assert violations(pickled) == []


def test_the_online_system_does_not_know_of_ground_truth() -> None:
    def named(module: ast.Module) -> list[ast.AST]:
        return [n for n in ast.walk(module) if isinstance(n, ast.Attribute) and n.attr == "ground_truth"]

    assert violations(named, exempt=("cli", "datasets", "evaluation", "storage")) == []


def test_annotations_are_not_deferred() -> None:
    """`from __future__ import annotations` turns shapes into strings that nobody checks."""
    assert violations(lambda module: imports(module, "__future__")) == []


def test_only_numba_kernels_go_unchecked_for_types() -> None:
    """mypy's `ignore_errors` covers what numba types; whoever adds a module there answers for it here."""
    settings = tomllib.loads((PACKAGE.parents[1] / "pyproject.toml").read_text(encoding="utf-8"))
    ignored = {name for o in settings["tool"]["mypy"]["overrides"] if o.get("ignore_errors") for name in o["module"]}
    of_kernels = ("numba", "tcgsplat.render.numba_cpu.compilation")
    with_numba = {
        ".".join(("tcgsplat", *path.relative_to(PACKAGE).with_suffix("").parts))
        for path in FILES
        if any(
            n for n in ast.walk(tree(path)) if isinstance(n, ast.ImportFrom) and (n.module or "").startswith(of_kernels)
        )
    }
    assert ignored <= with_numba
