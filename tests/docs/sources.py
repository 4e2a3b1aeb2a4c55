"""Texts of the product's modules."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from tests.docs.typed import ROOT
from tests.house import PACKAGES, nodes_of

MODULES = [path for name in PACKAGES for path in sorted((ROOT / name).rglob("*.py"))]


def docstrings(module: Path) -> set[ast.AST]:
    """Texts that are statements of their own."""
    return {node.value for node in nodes_of(module) if isinstance(node, ast.Expr)}


FIELD = "FIELD"
OPTION = re.compile(r"(?<![\w-])--[a-z][a-z-]+")
COMMAND = re.compile(r"(?:`|[Rr]un )(hil [a-z][^`;]*)")
NOT_OF_HIL = (
    "hil/report/",
    "hil/study/page.py",
    "hil/fleet/trend_page.py",
    "hil/cli/suggestions.py",
    "hil/doctor/messages.py",
)
"""Variables of a style sheet, misspelt options, commands of the system."""


@cache
def messages() -> tuple[tuple[str, str], ...]:
    return tuple(_messages())


def _messages() -> Iterator[tuple[str, str]]:
    """Place and text of each string that is no docstring; each field of an f-string is FIELD."""
    for module in MODULES:
        name = str(module.relative_to(ROOT))
        if name.startswith(NOT_OF_HIL):
            continue
        inner = docstrings(module)
        for text in (node for node in nodes_of(module) if isinstance(node, ast.JoinedStr)):
            inner |= {node for node in ast.walk(text) if node is not text}
            parts = [
                part.value if isinstance(part, ast.Constant) else FIELD for part in text.values
            ]
            yield f"{name}:{text.lineno}", "".join(map(str, parts))
        for node in nodes_of(module):
            is_text = isinstance(node, ast.Constant) and isinstance(node.value, str)
            if is_text and node not in inner:
                yield f"{name}:{node.lineno}", re.sub(r"{[^{}]*}", FIELD, node.value)
