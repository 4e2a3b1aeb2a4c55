"""The command line: a thin shell over the package.

Exit status: 0 done, 1 internal error or a result that cannot be written, 2 bad input, 3 refused as
unsafe, 4 controller fault, 5 done, but not good (a model, a PC that is not fit for the cycle,
archives of a batch that could not be used), 130 stopped by the operator.
"""

from __future__ import annotations

import os
import sys
from typing import Any

import typer
from rich.console import Console
from typer.core import TyperGroup

from hil.errors import HilError
from identification import IdentificationError
from planner import PlannerError

from .lazy import LazyCommands

COMMANDS = LazyCommands(
    (
        "demo",
        "design",
        "rehearse",
        "status",
        "report",
        "identify",
        "reidentify",
        "compare",
        "gains",
        "plan",
        "plot",
        "new",
        "move",
        "run",
        "record",
        "simulate",
        "study",
        "doctor",
        "import",
        "archive",
    ),
    **{"import": "imports"},
)


class Group(TyperGroup):
    """The commands of `COMMANDS`."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**{**settings, "commands": COMMANDS})


app = typer.Typer(
    name="hil",
    cls=Group,
    callback=lambda: None,
    help=(
        "Identify the dynamics of an industrial robot with its own controller in the loop.\n\n"
        "Start with `hil demo`: the whole way on a simulated COMAU NS 16, with a report."
    ),
    no_args_is_help=True,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
    add_completion=False,
)


def main() -> None:
    """Run the command line; known errors become one sentence and an exit status."""
    try:
        app(standalone_mode=True)
    except HilError as error:
        _fail(str(error), error.exit_code)
    except (IdentificationError, PlannerError) as error:
        _fail(str(error), 2)
    except KeyboardInterrupt:
        _fail("interrupted", 130)


def _fail(text: str, status: int) -> None:
    try:
        Console(stderr=True).print(
            f"[bold red]error:[/] {_escaped(text)}", highlight=False, soft_wrap=True
        )
    except OSError:  # the terminal is gone; the status still counts
        nowhere = os.open(os.devnull, os.O_WRONLY)
        for stream in (1, 2):
            os.dup2(nowhere, stream)
    sys.exit(status)


def _escaped(text: str) -> str:
    return text.replace("[", "\\[")
