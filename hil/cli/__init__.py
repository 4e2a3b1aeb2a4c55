"""The command line: a thin shell over the package.

Exit status: 0 done, 1 internal error or a disk that is full or refuses to be written, 2 bad input,
3 refused as unsafe, 4 controller fault, 5 done, but not good (a model, a PC that is not fit for
the cycle, archives of a batch that could not be used), 130 stopped by the operator. With `--json`
stdout is one JSON object, also where the command fails (`hil.cli.failing`).
"""

from __future__ import annotations

import os
import sys
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.text import Text
from typer.core import TyperGroup

from hil.errors import DISK_REFUSES, HilError, OperatorStopError
from hil.terminal_text import printable
from hil.version import software
from identification import IdentificationError
from planner import PlannerError

from .failing import INTERNAL, asks_for_json, errors_as_json, exit_code_of
from .lazy import LazyCommands, without_flag_types

COMMANDS = LazyCommands(
    (
        "demo",
        "design",
        "rehearse",
        "status",
        "report",
        "replay",
        "identify",
        "reidentify",
        "compare",
        "export",
        "gains",
        "payload",
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

_JSON = "hil.cli.json"


class Group(TyperGroup):
    """The commands of `COMMANDS`."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**{**settings, "commands": COMMANDS})
        without_flag_types(self)

    def make_context(self, info_name: str | None, args: list[str], *more: Any, **extra: Any) -> Any:
        """The context of one call, which knows whether JSON is asked for."""
        asked = asks_for_json(args)
        with errors_as_json(asked):
            context = super().make_context(info_name, args, *more, **extra)
        context.meta[_JSON] = asked
        return context

    def invoke(self, ctx: Any) -> Any:
        """Run the command; where it fails, say so in the form that was asked for."""
        with errors_as_json(ctx.meta.get(_JSON, False)):
            return super().invoke(ctx)


def _tell_versions(asked: bool) -> None:
    if asked:
        hil, *others = (f"{name} {number}" for name, number in software().items())
        typer.echo(f"{hil} ({', '.join(others)})")
        raise typer.Exit


_VERSION = typer.Option(
    "--version",
    callback=_tell_versions,
    is_eager=True,
    help="Tell the versions of hil and of what its numbers depend on.",
)


def _before_any_command(version: Annotated[bool, _VERSION] = False) -> None:
    """Nothing: the option alone ends the program."""


app = typer.Typer(
    name="hil",
    cls=Group,
    callback=_before_any_command,
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
    except (HilError, IdentificationError, PlannerError) as error:
        _fail(str(error), exit_code_of(error), stopped=isinstance(error, OperatorStopError))
    except OSError as error:
        if error.errno not in DISK_REFUSES:
            raise
        file = f"{error.filename}: " if error.filename else ""
        _fail(f"{file}cannot be written ({error.strerror}); make room", INTERNAL)
    except KeyboardInterrupt:
        _fail("interrupted", 130, stopped=True)


def _fail(text: str, status: int, *, stopped: bool = False) -> None:
    """End with one sentence; what a person stopped is no error."""
    word = ("stopped:", "bold yellow") if stopped else ("error:", "bold red")
    console = Console(stderr=True)
    try:
        line = Text.assemble(word, " ", printable(text))
        console.print(line, highlight=False, soft_wrap=not console.is_terminal)
    except OSError:  # the terminal is gone; the status still counts
        nowhere = os.open(os.devnull, os.O_WRONLY)
        for stream in (1, 2):
            os.dup2(nowhere, stream)
    sys.exit(status)
