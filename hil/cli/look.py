"""`hil look`: what a recording contains, and what it can determine."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from hil.base.files import write_output
from hil.base.progress import say
from hil.base.terminal_text import printable
from hil.cli.arguments import JsonOption, print_json, with_options
from hil.cli.imports import Described, Reading
from hil.importers.conclusions import Certainty
from hil.look import Choice, Group, Look, Row, look_at
from hil.look.maps import with_entries
from hil.look.messages import (
    as_json,
    choice_text,
    fit_alike,
    gravity_option,
    row_text,
    setting_text,
)
from identification.text import percentage

IN_DOUBT = 2
"""Exit status of a recording with two readings that fit alike."""


@with_options(Described, "arm", but=("friction", "standstill"))
@with_options(Reading, "reading", but=("outside_limits",))
def look(
    recording: Annotated[Path, typer.Argument(help="Log or bag.")],
    output: Annotated[Path | None, typer.Option("--output", "-o", metavar="MAP")] = None,
    *,
    arm: Described,
    reading: Reading,
    json: JsonOption = False,
) -> None:
    """Say what each channel of a recording is, how sure that is, and what it can determine.

    Names and units say a part, the slope of the positions another, and with --urdf the torque:
    side, sign, order and zero of the joints, gravity, mounting, delay and low-pass. Where two
    readings fit alike, both are shown with their errors; on a terminal one is asked for, else the
    lines to choose from are printed, to be added to the map, and the exit status is 2.

    **Example:** `hil look log.csv --urdf arm.urdf`

    Options:
        output: Write the column map with the sure conclusions, for `hil identify --map`.
    """
    result = look_at(recording, arm.robot if arm.is_given else None, reading.options)
    asks = sys.stdin.isatty() and sys.stdout.isatty() and not json
    if json:
        print_json(as_json(result))
    else:
        _print(result)
    text = result.map_text
    is_open = False
    for choices in result.questions:
        chosen = _ask(choices) if asks else None
        if chosen is None:
            is_open = True
        elif text is not None and chosen.entries:
            text = with_entries(text, chosen.entries)
    if output is not None and text is None:
        say(f"note: {output} is not written: a bag has no columns to map", err=True)
    if output is not None and text is not None:
        write_output(output, text)
        if not json:
            say(f"wrote {output}{', without what is open: add a line' if is_open else ''}")
    if is_open:
        raise typer.Exit(IN_DOUBT)


def _print(result: Look) -> None:
    for line in table(result.rows):
        typer.echo(printable(line))
    if result.groups:
        typer.echo("\nthe recording determines (parameters):")
        for line in groups_table(result.groups):
            typer.echo(printable(line))
    for choices in result.questions:
        doubt = fit_alike(choices)
        typer.echo(f"\n{choices[0].aspect}: {doubt}; choose one line for the map:")
        for number, choice in enumerate(choices, 1):
            error = "" if choice.error is None else f" (error {percentage(choice.error, 2)})"
            reading = choice_text(choice)
            typer.echo(printable(f"  {number}  {setting_text(choice.setting) or reading}"))
            typer.echo(printable(f"     {reading}{error}"))
    if result.gravity is not None:
        say(f"for `hil identify`: {gravity_option(result.gravity)}")


def _ask(choices: Sequence[Choice]) -> Choice | None:
    """Ask which reading is right; None if that is not known."""
    numbers = "1 or 2" if len(choices) == 2 else f"1 to {len(choices)}"
    answer = typer.prompt(f"{choices[0].aspect}: {numbers}, or 0 if unknown", type=int, default=0)
    return choices[answer - 1] if 1 <= answer <= len(choices) else None


def table(rows: Sequence[Row]) -> list[str]:
    """Return the rows as lines, and below each what would decide it."""
    width = max((len(row.aspect) for row in rows), default=0)
    lines = []
    for row in rows:
        text = row_text(row)
        lines.append(f"{row.aspect.ljust(width)}  {row.certainty.ljust(6)}  {text.reading}")
        lines.append(f"{' ' * width}          {text.reason}")
        if text.decide and row.certainty is not Certainty.CERTAIN:
            lines.append(f"{' ' * width}          to decide: {text.decide}")
    return lines


def groups_table(groups: Sequence[Group]) -> list[str]:
    """Return one line per body or joint."""
    width = max(len(group.body) for group in groups)
    lines = [f"{'joint'.ljust(width)}  of        identifiable  weak  not"]
    lines += [
        f"{group.body.ljust(width)}  {group.quantity.ljust(8)}  "
        f"{group.identifiable:12d}  {group.weak:4d}  {group.missing:3d}"
        for group in groups
    ]
    return lines
