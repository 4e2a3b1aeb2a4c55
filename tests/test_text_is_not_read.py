"""No text of ours is read back: what a sentence says is in a value from which it was made.

A name counts as that of a text, such as `reason` or `error.problem`, whatever its type. Where text
is foreign, written by people or other programs, its module is named below with the reason.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterable, Iterator, Mapping
from typing import Final

import pytest

from tests.house import ROOT, Sources, nodes_of

TEXTS: Final = re.compile(
    r"(\w+_)?(notes?|lines?|text|reasons?|messages?|warnings?|words|sentences?|problems?|remedy"
    r"|remedies|description|method|msg|stderr)"
)
"""Names of values that are text for people."""
SEARCHES: Final = frozenset(
    {"partition", "rpartition", "startswith", "endswith", "removeprefix", "removesuffix"}
    | {"find", "rfind", "index", "rindex", "count"}
)
"""Methods of a string that look into it; those that only rewrite it for output are not meant."""
PATTERNS: Final = frozenset({"search", "match", "fullmatch", "findall", "finditer", "split", "sub"})
FOREIGN: Final[Mapping[str, str]] = {
    "sim_fixtures.ur.controller": "--fault",
    "hil.archive.cdr": "definitions of ROS messages",
    "hil.archive.live": "addresses that the user writes",
    "hil.cell.schema": "addresses that the user writes",
    "hil.cli": "the docstrings of commands, and what typer says of pydantic",
    "hil.cli.arguments": "options",
    "hil.cli.imports": "options",
    "hil.cli.purpose_options": "quantities that the user writes",
    "hil.precision.requirements": "requirements that the user writes",
    "hil.importers.bags": "errors of rosbags",
    "hil.importers.column_map": "the first comment of a ready map",
    "hil.importers.date_stamps": "times of logs",
    "hil.importers.dh": "tables of parameters",
    "hil.importers.dialect": "cells of a table",
    "hil.importers.list_cells": "cells of a table",
    "hil.importers.log_text": "logs",
    "hil.importers.long_text": "logs",
    "hil.importers.matlab": "MATLAB scripts",
    "hil.importers.name_words": "names of channels",
    "hil.importers.stated_units": "units of logs",
    "hil.importers.text_table": "logs",
    "hil.importers.unit_products": "units of logs",
    "hil.new.cell_text": "URDFs",
    "hil.base.safe_input": "files",
    "hil.fleet.trend_limits": "limits that the user writes",
    "hil.fleet.naming": "patterns that the user writes, and names of files",
    "hil.control.simulator_on_link": "addresses that the user writes",
    "identification.excitation.collision_bodies": "errors of pinocchio",
    "identification.export.urdf": "URDFs",
    "sim_fixtures.ns16": "a URDF",
    "sim_fixtures.ur.program": "programs of clients",
}
"""Modules that read text of others."""
OURS: Final[Mapping[str, str]] = {
    "hil.control.errors": "an outcome that begins the reason is not said twice",
    "hil.control.simulator_process": "the last error that the simulated controller printed",
    "hil.report.numbers": "figures are typeset",
    "hil.campaign.screen": "the colour of a refusal, which begins with one word in capitals",
    "hil.base.one_screen": "where a command begins, whose lines a shell continues",
    "hil.base.terminal_text": "joints get their names in what the drivers say",
    "identification.export.parameter_files": "a comment is made safe for spreadsheets",
}
"""Modules that read text of ours: for its form, or until what they look for is a value."""


def last_name(node: ast.expr) -> str:
    """Return the last name of an expression: of `a.b[0].reason`, or of `str(error)`."""
    match node:
        case ast.Name(id=name) | ast.Attribute(attr=name):
            return name
        case ast.Subscript(value=value):
            return last_name(value)
        case ast.Call(func=ast.Name(id="str"), args=[ast.Name(id="error")]):
            return "message"
        case ast.Call(func=ast.Attribute(value=value, attr="lower" | "strip" | "lstrip")):
            return last_name(value)
    return ""


def is_text(node: ast.expr) -> bool:
    return TEXTS.fullmatch(last_name(node)) is not None


def is_phrase(node: ast.expr) -> bool:
    """Return whether an expression is a text, not a key: with a letter in it."""
    is_string = isinstance(node, ast.Constant) and isinstance(node.value, str)
    return isinstance(node, ast.JoinedStr) or is_string


def is_sentence(node: ast.expr) -> bool:
    """Return whether an expression is a text of several words."""
    return isinstance(node, ast.Constant) and " " in str(node.value).strip()


def readings(nodes: Iterable[ast.AST]) -> Iterator[int]:
    """Yield the lines of a module in which a text is read."""
    for node in nodes:
        match node:
            case ast.Call(func=ast.Attribute(value=value, attr=name)) if name in SEARCHES:
                if is_text(value) and node.args:
                    yield node.lineno
            case ast.Call(func=ast.Attribute(value=ast.Name(id=owner), attr=name)):
                is_pattern = owner == "re" or owner.isupper()
                if is_pattern and name in PATTERNS and any(map(is_text, node.args)):
                    yield node.lineno
            case ast.Compare(left=left, ops=[ast.In() | ast.NotIn()], comparators=[right]):
                if is_text(right) and (is_phrase(left) or last_name(left).isupper()):
                    yield node.lineno
            case ast.Compare(left=left, ops=[ast.Eq() | ast.NotEq()], comparators=[right]):
                sides = (left, right)
                if any(map(is_text, sides)) and any(map(is_sentence, sides)):
                    yield node.lineno


def test_no_module_reads_a_text_of_ours() -> None:
    found = {
        f"{name}:{line}"
        for name, path in Sources.read().files.items()
        if name not in FOREIGN and name not in OURS
        for line in readings(nodes_of(path))
    }
    assert not found


def test_every_exception_is_needed() -> None:
    reading = {name for name, path in Sources.read().files.items() if any(readings(nodes_of(path)))}
    assert {*FOREIGN, *OURS} <= reading


def test_no_page_reads_a_text_of_ours() -> None:
    found = [
        (path.name, line)
        for path in sorted((ROOT / "hil/report/templates").glob("*.j2"))
        for line in re.findall(
            r"\w+\.(?:startswith|endswith|partition|find)\([^)]*\)", path.read_text()
        )
    ]
    assert not found


@pytest.mark.parametrize(
    "source",
    [
        'next(line for line in lines if line.startswith("not used"))',
        'channels, _, meaning = line.partition(": ")',
        're.search(r"read as (\\w+)", note)',
        '"position" in row.reason',
        "ELEMENTS in message",
        'done.reason == "ended by the operator"',
        'problem, _, remedy = str(error).partition("; ")',
    ],
)
def test_what_counts_as_reading(source: str) -> None:
    assert list(readings(ast.walk(ast.parse(source))))


@pytest.mark.parametrize("source", ['"; ".join(lines)', "line.strip()", "joint in joints"])
def test_what_does_not(source: str) -> None:
    assert not list(readings(ast.walk(ast.parse(source))))
