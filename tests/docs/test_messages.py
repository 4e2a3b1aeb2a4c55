"""What messages tell a user to type exists: commands, options, entries of the files."""

from __future__ import annotations

import ast
import re
import shlex
from collections.abc import Iterator

from pydantic import BaseModel

from hil.cell.schema import CellFile
from hil.design.settings import DesignSettings
from hil.importers.column_map import ColumnMap
from tests.docs.sources import COMMAND, MODULES, OPTION, messages
from tests.docs.typed import command_of, options
from tests.house import nodes_of

ENTRIES = (
    re.compile(r"\[(?P<table>[a-z_]+)\] (?P<key>[a-z_]{3,})\b(?= =|,|;|$|\)|:)"),
    re.compile(r"\b(?P<key>[a-z]+(?:_[a-z]+)*)`? (?:of|in|under) \[(?P<table>[a-z_]+)\]"),
)
OTHER_WORDS = {"and", "both", "factor", "listed", "parameters", "place", "stated", "that"}


PATH = re.compile(r"root|path|folder|campaign|output|location|source|file")


def keys(model: type[BaseModel], table: str = "") -> Iterator[tuple[str, str]]:
    """Tables of a file and their entries."""
    for key, described in model.model_fields.items():
        yield table, key
        for kind in re.findall(r"[\w.]+", str(described.annotation)):
            inner = TABLES.get(kind.rpartition(".")[2])
            if inner is not None:
                yield from keys(inner, key)


def subclasses(model: type[BaseModel]) -> Iterator[type[BaseModel]]:
    for below in model.__subclasses__():
        yield below
        yield from subclasses(below)


TABLES = {model.__name__: model for model in subclasses(BaseModel) if "hil." in model.__module__}


def test_every_option_is_one() -> None:
    wrong = [
        f"{place}: {name}"
        for place, text in messages()
        for name in OPTION.findall(text)
        if name not in options()
    ]
    assert not wrong, "\n".join(wrong)


def test_every_command_has_the_options_beside_it() -> None:
    wrong = []
    commands = [(place, line) for place, text in messages() for line in COMMAND.findall(text)]
    assert len(commands) > 30
    for place, line in commands:
        command, _ = command_of(shlex.split(line.replace("'", ""))[1:])
        unknown = {*OPTION.findall(line)} - options(command)
        wrong += [f"{place}: {name}" for name in unknown]
    assert not wrong, "\n".join(wrong)


def test_every_entry_is_one_of_a_file() -> None:
    existing = {entry for model in (ColumnMap, CellFile, DesignSettings) for entry in keys(model)}
    entries = [
        (place, match["table"], match["key"])
        for place, text in messages()
        for pattern in ENTRIES
        for match in pattern.finditer(text)
        if match["key"] not in OTHER_WORDS
    ]
    assert len(entries) > 30
    wrong = [f"{place}: [{table}] {key}" for place, table, key in entries
             if (table, key) not in existing]  # fmt: skip
    assert not wrong, "\n".join(wrong)


def test_paths_in_commands_are_quoted() -> None:
    """A command with a path of the user is typed as it is printed."""
    wrong = []
    for module in MODULES:
        for text in nodes_of(module):
            if isinstance(text, ast.JoinedStr):
                line = "".join(
                    str(part.value)
                    if isinstance(part, ast.Constant)
                    else "{" + ast.unparse(getattr(part, "value", part)) + "}"
                    for part in text.values
                )
                for command in re.findall(r"\bhil [a-z][a-z -]* (?:[^`;]*)", line):
                    fields = re.findall(r"{([^{}]*)}", command)
                    bare = [
                        field for field in fields if PATH.search(field) and "typed(" not in field
                    ]
                    wrong += [f"{module.name}:{text.lineno}: {field}" for field in bare]
    assert not wrong, "\n".join(wrong)
