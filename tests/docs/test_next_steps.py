"""Commands that findings recommend exist."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer

from hil.cli import app
from tests.docs.typed import ROOT

MODULES = sorted((ROOT / "identification" / "validation" / "findings").glob("[a-z]*.py"))
_COMMAND = re.compile(r"`hil ([^`]+)`")


def sentences(module: Path) -> Iterator[str]:
    """The strings of a module; a figure in one of them is an X."""
    for node in ast.walk(ast.parse(module.read_text(encoding="utf-8"))):
        if isinstance(node, ast.JoinedStr):
            parts = [part.value if isinstance(part, ast.Constant) else "X" for part in node.values]
            yield "".join(map(str, parts))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value


def unknown(words: list[str]) -> list[str]:
    """What no command line of `hil` has: a command, or options of one."""
    command: Any = typer.main.get_command(app)
    while hasattr(command, "commands"):
        if not words or words[0] not in command.commands:
            return words[:1]
        command = command.commands[words.pop(0)]
    options = {option for parameter in command.params for option in parameter.opts}
    return [word for word in words if word.startswith("-") and word not in options]


@pytest.mark.parametrize("module", MODULES, ids=lambda module: module.stem)
class TestRecommendedCommands:
    """Words of findings, in backquotes where they name a command."""

    def test_commands_and_options_exist(self, module: Path) -> None:
        named = [found for text in sentences(module) for found in _COMMAND.findall(text)]
        assert {name: unknown(name.split()) for name in named} == {name: [] for name in named}

    def test_options_are_named_with_their_command(self, module: Path) -> None:
        loose = [text for text in sentences(module) if re.search(r"--\w", _COMMAND.sub("", text))]
        assert not loose
