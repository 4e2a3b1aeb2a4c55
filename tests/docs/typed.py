"""What stands in the shell blocks of a page, and what the command line makes of it."""

from __future__ import annotations

import re
import shlex
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import typer

from hil.cli import app

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").glob("*.md")])
SHELL = ("", "sh", "bash", "shell", "console")
PROGRAMS = {"hil", "make", "python", "pip", "sudo", "ip", "printf", "echo", "candump",
            "ssh", ".", "cp", "cd", "dask"}  # fmt: skip
_REDIRECTION = re.compile(r" > \S+$")
_BLOCK = re.compile(r"^( *)```([^\n]*)\n(.*?)^\1```$", re.MULTILINE | re.DOTALL)


def section(page: Path, heading: str) -> str:
    """The text under a heading of the second level, up to the next one."""
    text = page.read_text(encoding="utf-8")
    _, found, rest = text.partition(f"\n## {heading}\n")
    assert found, f"{page.name} has no section {heading!r}"
    return rest.partition("\n## ")[0]


def commands(page: Path, text: str | None = None) -> list[list[str]]:
    """The commands of a page, or of its text given, in order, without output and comments."""
    lines = []
    for _, language, block in _BLOCK.findall(text or page.read_text(encoding="utf-8")):
        if language in SHELL:
            lines += _of_block(page, block)
    return lines


def _of_block(page: Path, block: str) -> list[list[str]]:
    lines = [
        line.removeprefix("$ ")
        for line in re.sub(r"\\\n\s*", " ", block).splitlines()
        if line.strip() and not line.lstrip().startswith("#")
    ]
    first = [line.split()[0] in PROGRAMS for line in lines]
    if not any(first):
        return []  # output, or a file
    assert all(first), f"{page.name}: not only commands in one block: {lines}"
    return [shlex.split(_REDIRECTION.sub("", line), comments=True) for line in lines]


def command_of(typed: Sequence[str]) -> tuple[Any, list[str]]:
    """The command that words behind `hil` name, and the rest of them."""
    command: Any = typer.main.get_command(app)
    arguments = list(typed)
    while hasattr(command, "commands"):
        assert arguments and arguments[0] in command.commands, (
            f"hil {' '.join(typed)}: no such command"
        )
        command = command.commands[arguments.pop(0)]
    return command, arguments


def parse(typed: Sequence[str]) -> None:
    """Let the command line read words behind `hil`, and do nothing."""
    command, arguments = command_of(typed)
    command.make_context(command.name, arguments)


@cache
def options(command: Any = None) -> frozenset[str]:
    """Options of a command and of all below it; by default of the whole command line."""
    command = command or typer.main.get_command(app)
    below = getattr(command, "commands", {}).values()
    names = frozenset(
        option
        for parameter in command.params
        for option in (*parameter.opts, *parameter.secondary_opts)
    )
    return names.union(*map(options, below))
