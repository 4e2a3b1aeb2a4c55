"""The command line: a thin shell over the package.

Exit status: 0 done, 1 internal error or a result that cannot be written, 2 bad input, 3 refused as
unsafe, 4 controller fault, 5 done, but not good (a model, a PC that is not fit for the cycle,
archives of a batch that could not be used), 130 stopped by the operator.
"""

from __future__ import annotations

import sys

import typer
from rich.console import Console

from hil.errors import HilError
from identification import IdentificationError
from planner import PlannerError

from . import (
    archive,
    demo,
    design,
    doctor,
    gains,
    identify,
    imports,
    plan,
    record,
    reidentify,
    simulate,
)

app = typer.Typer(
    name="hil",
    help=(
        "Identify the dynamics of an industrial robot with its own controller in the loop.\n\n"
        "Start with `hil demo`: the whole way on a simulated COMAU NS 16, with a report."
    ),
    no_args_is_help=True,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
    add_completion=False,
)
app.command("demo")(demo.demo)
app.command("design")(design.design)
app.command("identify")(identify.identify)
app.command("reidentify")(reidentify.reidentify)
app.command("gains")(gains.gains)
app.command("plan")(plan.plan)
app.command("record")(record.record)
app.command("simulate")(simulate.simulate)
app.command("doctor")(doctor.doctor)
app.add_typer(imports.app, name="import")
app.add_typer(archive.app, name="archive")


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
    Console(stderr=True).print(
        f"[bold red]error:[/] {_escaped(text)}", highlight=False, soft_wrap=True
    )
    sys.exit(status)


def _escaped(text: str) -> str:
    return text.replace("[", "\\[")
