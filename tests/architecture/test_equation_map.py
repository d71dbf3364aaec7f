"""Paper and code are one to one: equations 4 to 25 are functions of one file, in the paper's order."""

import ast
import re
from pathlib import Path

from tcgsplat.confidence import equations

SOURCE = Path(equations.__file__).read_text(encoding="utf-8")
NUMBER = re.compile(r"\(Eq\. (\d+)\)")
NAMES = {
    4: "decay",
    5: "mean_change",
    6: "scale_change",
    7: "rotation_change",
    8: "self_distance",
    9: "residual_map",
    10: "observation_quality",
    11: "relative_stability",
    12: "feedback",
    13: "apply_feedback",
    14: "first_excitation",
    15: "update_baseline",
    16: "calibrate_age",
    17: "composite",
    18: "tracking_weight",
    19: "tracking_loss",
    20: "mapping_weight",
    21: "mapping_loss",
    22: "abnormal_change",
    23: "stability_loss",
    24: "step_scale",
    25: "rerank_score",
}


def functions() -> list[ast.FunctionDef]:
    return [node for node in ast.parse(SOURCE).body if isinstance(node, ast.FunctionDef)]


def test_every_equation_number_stands_exactly_once_and_in_order() -> None:
    assert [int(n) for n in NUMBER.findall(SOURCE)] == list(range(4, 26))


def test_each_number_stands_in_the_docstring_of_its_function() -> None:
    found = {
        int(number): function.name
        for function in functions()
        for number in NUMBER.findall(ast.get_docstring(function) or "")
    }
    assert found == NAMES


def test_equations_are_pure_functions_of_tensors_and_numbers() -> None:
    """No settings object, no device, no generator and no state can come in, and hyper-parameters come by name."""
    for function in functions():
        for argument in function.args.args:
            assert argument.annotation is not None
            assert ast.unparse(argument.annotation) not in {"float", "int"}, (function.name, argument.arg)
        for argument in function.args.kwonlyargs:
            assert argument.annotation is not None
            numbers = {"float", "float | Float[Tensor, '']", "Literal['mean', 'sum']"}  # a device may hold a number
            assert ast.unparse(argument.annotation) in numbers, (
                function.name,
                argument.arg,
            )


def test_equations_know_only_tensors_and_geometry() -> None:
    imported = {node.module for node in ast.walk(ast.parse(SOURCE)) if isinstance(node, ast.ImportFrom)}
    assert {module for module in imported if module.startswith("tcgsplat")} == {"tcgsplat.geometry", "tcgsplat.tensors"}
