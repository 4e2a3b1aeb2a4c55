"""Output of an identification without torque: one screen, or everything, and an exit status."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import typer

from hil.base.exit_status import ExitStatus
from hil.base.one_screen import Part, one_screen
from hil.base.progress import say
from hil.base.terminal_text import printable, typed
from hil.cli.arguments import print_json
from hil.results.servo_result import ServoResults
from hil.servo.messages import screen, whole


def finish_servo(
    results: ServoResults,
    *,
    json: bool,
    quiet: bool,
    verbose: bool,
    written: tuple[Path, Path],
    read: Sequence[Part] = (),
) -> None:
    """Print the verdict with what is behind it, or JSON; exit 5 if the model is not good.

    Args:
        results: of the identification.
        json: print JSON.
        quiet: print the line of the verdict, and warnings to stderr.
        verbose: print everything, else one screen.
        written: folder and report.
        read: what was read of each recording.
    """
    folder, report = written
    if json:
        document = results.model_dump(mode="json", exclude={"posterior"})
        print_json({**document, "folder": str(folder), "report": str(report)})
    elif quiet:
        for warning in results.verdict.warnings:
            say(f"note: {warning}", err=True)
        say(results.verdict.line)
    elif verbose:
        for line in [*whole(results), f"report: {report}"]:
            say(line)
    else:
        last = f"{report}: the motion over time, intervals; hil export {typed(folder)} --to mjcf"
        for line in one_screen([*screen(results, read), last]):
            typer.echo(printable(line))
    if not results.verdict.good:
        raise typer.Exit(ExitStatus.NEGATIVE_RESULT)
