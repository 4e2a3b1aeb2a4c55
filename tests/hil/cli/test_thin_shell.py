"""The command line computes, decodes and connects nothing itself."""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[3]
SHELL = sorted((ROOT / "hil" / "cli").glob("*.py"))
OURS = ("hil", "drivers", "planner", "identification", "sim_fixtures")
ALGEBRA = ("numpy", "scipy", "pinocchio", "coal", "ruckig", "pymoo", "cma", "cvxpy", "clarabel",
           "matplotlib", "mcap", "zstandard", "lz4", "isal", "rosbags", "can", "serial", "pydantic",
           "jinja2", "foxglove")  # fmt: skip
WIRE = ("socket", "struct", "multiprocessing", "ctypes", "mmap")
OF_NUMPY = {"array", "asarray", "isfinite", "degrees", "max", "abs", "argmax", "float64"}
"""Functions of numpy for output: no estimation, solution, sampling or integration."""
LOOPS = (ast.For, ast.While, ast.ListComp, ast.SetComp, ast.GeneratorExp, ast.DictComp)
MATHS = (ast.Mult, ast.MatMult, ast.Pow, ast.Div, ast.FloorDiv)


def imported(nodes: Iterable[ast.AST]) -> Iterator[str]:
    """Yield the full names of all imports of a module."""
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from (f"{'.' * node.level}{node.module or ''}.{a.name}" for a in node.names)


def violations(source: str) -> list[str]:
    """Return operations that a module of the command line must not contain."""
    tree = ast.parse(source)
    operations = []
    for name in imported(ast.walk(tree)):
        top = name.lstrip(".").split(".")[0]
        if top in WIRE or (top in ALGEBRA and not name.startswith("numpy")):
            operations.append(f"imports {name}")
        if top in OURS and any(part.startswith("_") for part in name.split(".")):
            operations.append(f"imports {name}, which is private")
    operations += [
        f"calls numpy.{node.attr}"
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute)
        and isinstance(node.value, ast.Name)
        and node.value.id == "np"
        and node.attr not in OF_NUMPY
    ]
    loops = (node for node in ast.walk(tree) if isinstance(node, LOOPS))
    return operations + [f"computes {what} in a loop" for loop in loops for what in computed(loop)]


def computed(loop: ast.AST) -> Iterator[str]:
    """Yield products and quotients of two variables; changes of units are allowed."""
    for node in ast.walk(loop):
        if isinstance(node, ast.BinOp) and isinstance(node.op, MATHS):
            sides = (node.left, node.right)
            if not any(isinstance(side, ast.Constant | ast.List) for side in sides):
                yield ast.unparse(node)


FIGURES = {
    "torque_constants.py": {"computes gains.interval_factor * std in a loop"},
    "plan.py": {"computes getattr(extrema, q) / getattr(plan.limits, q) in a loop"},
}
"""Exceptions: values computed for output only."""


@pytest.mark.parametrize("path", SHELL, ids=lambda path: path.stem)
def test_a_command_computes_decodes_and_connects_nothing_itself(path: Path) -> None:
    assert set(violations(path.read_text("utf-8"))) == FIGURES.get(path.name, set())


@pytest.mark.parametrize(
    "source",
    [
        "import scipy.optimize",
        "from mcap.reader import make_reader",
        "import socket",
        "from hil.batch.graph import _Estimates",
        "import numpy as np\nx = np.linalg.lstsq(a, b)",
        "total = [weight * error for weight, error in pairs]",
        "def f():\n    for k in range(n):\n        torque += regressor[k] @ values",
    ],
)
def test_violations_are_detected(source: str) -> None:
    assert violations(source)


def test_no_other_module_imports_the_command_line() -> None:
    for package in OURS:
        for path in (ROOT / package).rglob("*.py"):
            if path in SHELL or path == ROOT / "hil" / "__main__.py":
                continue
            text = path.read_text("utf-8")
            if "typer" not in text and "cli" not in text:  # the others need not be parsed
                continue
            names = list(imported(ast.walk(ast.parse(text))))
            assert not [n for n in names if n.startswith(("hil.cli", "typer", ".cli"))], path
