"""A small reader of structured text (IEC 61131-3): what function blocks compute, in Python.

One statement a line: assignments, FOR, IF, calls of function blocks with named inputs.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

_COMMENT = re.compile(r"\(\*.*?\*\)", re.DOTALL)
_BLOCK = re.compile(r"FUNCTION_BLOCK (\w+)\n(.*?)END_FUNCTION_BLOCK", re.DOTALL)
_VARIABLES = re.compile(r"^VAR(_INPUT|_OUTPUT| CONSTANT|)\n(.*?)^END_VAR\n", re.DOTALL | re.M)
_DECLARATION = re.compile(r"(\w+)\s*:\s*([^;:]+?)\s*(?::=\s*([^;]+))?;", re.DOTALL)
_ARRAY = re.compile(r"ARRAY \[(.+)\] OF (LREAL|DINT)\Z")
_CALL = re.compile(r"(\w+)\((\w+ := .*)\);\Z")
_FUNCTIONS = {
    "COS": math.cos, "SIN": math.sin, "SQRT": math.sqrt, "EXP": math.exp, "ABS": abs,
}  # fmt: skip
_OPERATORS = {"AND": "and", "OR": "or", "NOT": "not", "TRUE": "True", "FALSE": "False"}


class Table:
    """An array with stated bounds; an index outside them is an error."""

    def __init__(self, bounds: Sequence[tuple[int, int]], values: Sequence[float] = ()) -> None:
        self.bounds = bounds
        shape = [high - low + 1 for low, high in bounds]
        self.values = np.zeros(shape) if not len(values) else np.reshape(values, shape).copy()

    def _at(self, index: int | tuple[int, ...]) -> tuple[int, ...]:
        indices = index if isinstance(index, tuple) else (index,)
        assert len(indices) == len(self.bounds)
        for k, (low, high) in zip(indices, self.bounds, strict=True):
            assert low <= k <= high, f"index {k} outside {low}..{high}"
        return tuple(k - low for k, (low, _) in zip(indices, self.bounds, strict=True))

    def __getitem__(self, index: int | tuple[int, ...]) -> float:
        return float(self.values[self._at(index)])

    def __setitem__(self, index: int | tuple[int, ...], value: float) -> None:
        self.values[self._at(index)] = value


class Block:
    """An instance of a function block: call it with inputs, then read its variables."""

    def __init__(self, name: str, blocks: dict[str, str]) -> None:
        body = blocks[name]
        self._inputs: set[str] = set()
        self._names: dict[str, Any] = dict(_FUNCTIONS) | {"_copy": _copy}
        for kind, declarations in _VARIABLES.findall(body):
            for variable, of_type, value in _DECLARATION.findall(declarations):
                self._names[variable] = _initial(of_type, value, blocks)
                if kind == "_INPUT":
                    self._inputs.add(variable)
        self._program: Callable[..., Any] = compile(  # type: ignore[assignment]
            _python(_VARIABLES.sub("", body)), name, "exec"
        )

    def __call__(self, **inputs: Any) -> None:
        assert inputs.keys() <= self._inputs
        for name, value in inputs.items():
            present = self._names[name]
            if isinstance(present, Table):
                given = value.values if isinstance(value, Table) else np.asarray(value)
                assert given.shape == present.values.shape
                present.values[...] = given
            else:
                self._names[name] = value
        exec(self._program, self._names)  # type: ignore[arg-type]

    def __getattr__(self, name: str) -> Any:
        return self._names[name]


def blocks_of(text: str) -> dict[str, str]:
    """The function blocks of a text by name, without comments."""
    plain = _COMMENT.sub("", text)
    assert "(*" not in plain and "*)" not in plain
    found = dict(_BLOCK.findall(plain))
    rest = _BLOCK.sub("", plain)
    assert not rest.strip(), rest
    return found


def _copy(block: Block, **inputs: Any) -> None:
    block(**inputs)


def _initial(of_type: str, value: str, blocks: dict[str, str]) -> Any:
    if of_type in blocks:
        return Block(of_type, blocks)
    array = _ARRAY.match(of_type)
    if array is None:
        literal = {"TRUE": "True", "FALSE": "False"}.get(value, value)
        return eval(literal) if value else {"DINT": 0, "LREAL": 0.0, "BOOL": False}[of_type]
    ends = [bound.split("..") for bound in array[1].split(",")]
    bounds = [(int(low), int(high)) for low, high in ends]
    numbers = [float(number) for number in value.strip("[] \n").split(",")] if value else []
    if array[2] == "DINT":
        table = Table(bounds, numbers)
        table.values = table.values.astype(int)
        table.__class__ = IntegerTable
        return table
    for number in value.strip("[] \n").split(",") if value else []:
        assert "." in number, f"{number} is no literal of LREAL"
    return Table(bounds, numbers)


class IntegerTable(Table):
    """An array of DINT."""

    def __getitem__(self, index: int | tuple[int, ...]) -> int:  # type: ignore[override]
        return int(self.values[self._at(index)])


def _python(body: str) -> str:
    """Python of the statements."""
    lines = []
    depth = 0
    for raw in body.splitlines():
        line = raw.strip()
        if not line:
            continue
        if line in ("END_FOR;", "END_IF;"):
            depth -= 1
            continue
        indent = "    " * (depth - (line.startswith("ELS")))
        lines.append(indent + _statement(line))
        if line.startswith(("FOR ", "IF ")):
            depth += 1
    assert depth == 0
    return "\n".join(lines)


def _statement(line: str) -> str:
    if loop := re.fullmatch(r"FOR (\w+) := (.+) TO (.+?)( BY -1)? DO", line):
        variable, first, last, down = loop.groups()
        step, end = ("-1", f"({last}) - 1") if down else ("1", f"({last}) + 1")
        return f"for {variable} in range({first}, {end}, {step}):"
    if condition := re.fullmatch(r"(IF|ELSIF) (.+) THEN", line):
        word = "if" if condition[1] == "IF" else "elif"
        return f"{word} {_expression(condition[2], compares=True)}:"
    if line == "ELSE":
        return "else:"
    if call := _CALL.match(line):
        return f"_copy({call[1]}, {_expression(call[2].replace(':=', '='))})"
    assert line.endswith(";") and line.count(":=") == 1, line
    target, value = line[:-1].split(" := ")
    return f"{target} = {_expression(value)}"


def _expression(text: str, *, compares: bool = False) -> str:
    for word, operator in _OPERATORS.items():
        text = re.sub(rf"\b{word}\b", operator, text)
    if compares:
        text = re.sub(r"(?<![<>])=", "==", text)
    assert "^" not in text and "%" not in text
    return text
