"""The command line, called."""

from __future__ import annotations

from typing import Any

from typer.testing import CliRunner

from hil.cli import app


def hil(*arguments: object) -> Any:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])
