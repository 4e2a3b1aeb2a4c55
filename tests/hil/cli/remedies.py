"""Errors of the command line, and commands that they name."""

from __future__ import annotations

from typer.testing import CliRunner, Result

from hil.cli import app


def typed(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(word) for word in arguments], env={"COLUMNS": "200"})


def message(result: Result) -> str:
    return f"{result.output} {result.exception}"
