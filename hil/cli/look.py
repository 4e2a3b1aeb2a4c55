"""`hil look`: show what a recording contains and what it can determine."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from itertools import zip_longest
from pathlib import Path
from textwrap import shorten, wrap
from typing import Annotated, Final

import typer

from hil.base.exit_status import ExitStatus
from hil.base.files import write_output
from hil.base.one_screen import SCREEN_COLUMNS, SCREEN_LINES, Paragraph, Part, one_screen
from hil.base.progress import say
from hil.base.terminal_text import printable, typed
from hil.cli.arguments import JsonOption, VerboseOption, print_json, with_options
from hil.cli.imports import Described, Reading
from hil.importers.conclusions import Certainty
from hil.look import Look, ParameterGroup, Row, TiedReading, look_at
from hil.look.corrected_map import with_entries
from hil.look.messages import (
    as_json,
    choice_text,
    fit_alike,
    gravity_option,
    row_text,
    setting_text,
)
from hil.look.readings import Fact
from identification.text import joined, percentage


@with_options(Described, "arm", but=("friction", "standstill_speed"))
@with_options(Reading, "reading", but=("outside_limits",))
def look(
    recording: Annotated[Path, typer.Argument(help="Log or bag.")],
    output: Annotated[Path | None, typer.Option("--output", "-o", metavar="MAP")] = None,
    *,
    arm: Described,
    reading: Reading,
    verbose: VerboseOption = False,
    json: JsonOption = False,
) -> None:
    """Show what each channel of a recording means, how certain that is, and what can be identified.

    Names, units and the slope of the positions decide some of it; with --urdf the torque decides
    the rest: side, sign, order and zero of the joints, gravity, mounting, delay and low-pass.
    Where two explanations fit equally well, both are shown with their errors; on a terminal you
    choose, otherwise the lines to choose from are printed for the map, and the exit status is 2.

    **Example:** `hil look log.csv --urdf arm.urdf`

    Options:
        output: Write the column map with what is certain, for `hil identify --map`.
    """
    result = look_at(recording, arm.robot if arm.is_given else None, reading.options)
    asks = sys.stdin.isatty() and sys.stdout.isatty() and not json
    if json:
        print_json(as_json(result))
    else:
        for line in whole(result) if verbose else screen(result):
            typer.echo(printable(line))
    text = result.map_text
    is_open = False
    for choices in result.questions:
        chosen = _ask(choices) if asks else None
        if chosen is None:
            is_open = True
        elif text is not None and chosen.entries:
            text = with_entries(text, chosen.entries)
    text = text if text is not None else result.bag_text
    if output is not None and text is None:
        say(f"note: {output} is not written: an archive needs no map", err=True)
    if output is not None and text is not None:
        write_output(output, text)
        if not json:
            say(f"wrote {output}{', without what is undetermined: add a line' if is_open else ''}")
    if is_open:
        raise typer.Exit(ExitStatus.BAD_INPUT)


def whole(result: Look) -> list[str]:
    """Return everything: rows with their reasons, what would decide them, and the counts."""
    lines = table(result.rows)
    if result.groups:
        lines += ["", "the recording determines (parameters):", *groups_table(result.groups)]
    for choices in result.questions:
        asked = question(choices, of_archive=result.is_of_archive)
        lines += ["", *(f"{part.label}{part.text}" for part in asked)]
    return [*lines, *_options(result)]


def screen(result: Look) -> list[str]:
    """Return one screen: what is unusual, one line for all that is as the URDF says, next steps."""
    parts: list[Part] = []
    if result.groups:
        parts += ["", *determined(result.groups)]
    deciding = sorted(
        (row for row in result.rows if row.has_step), key=lambda row: not row.is_fault
    )
    named = dict.fromkeys((row.aspect, row_text(row).decide) for row in deciding)
    steps = [Paragraph(decide, f"next  {aspect}: ", 2) for aspect, decide in named]
    questions = [
        part
        for choices in result.questions
        for part in question(choices, of_archive=result.is_of_archive)
    ]
    room = SCREEN_LINES - len(summary(result.rows, 0)) - _lines_of(parts)
    steps = [] if questions else steps[: max(1, min(_MAX_STEPS, room - len(_options(result)) - 1))]
    parts += ["", *questions, *steps, *_options(result), "all reasons and rows: -v"]
    return one_screen([*summary(result.rows, SCREEN_LINES - _lines_of(parts)), *parts])


def _lines_of(parts: Sequence[Part]) -> int:
    """Return the lines of parts that are not empty, each as long as it is."""
    return sum(part.whole if isinstance(part, Paragraph) else bool(part) for part in parts)


def question(choices: Sequence[TiedReading], *, of_archive: bool) -> list[Paragraph]:
    """Return a question about explanations that fit equally well, with the setting of each."""
    line = "import its log again with one line in the map:"
    line = line if of_archive else "choose one line for the map:"
    question = f"{choices[0].aspect}: {fit_alike(choices)}; {line}"
    parts = [Paragraph(question)]
    for number, choice in enumerate(choices, 1):
        error = "" if choice.error is None else f" (error {percentage(choice.error, 2)})"
        reading = choice_text(choice)
        setting = setting_text(choice.setting)
        parts.append(Paragraph(f"{setting or reading}{error}", f"  {number}  "))
        if setting:
            parts.append(Paragraph(reading, "     "))
    return parts


def _options(result: Look) -> list[str]:
    if result.gravity is None:
        return []
    stated = gravity_option(result.gravity)
    return [f"hil identify {typed(result.source)} --urdf ARM.urdf {stated}"]


def _ask(choices: Sequence[TiedReading]) -> TiedReading | None:
    """Ask which explanation is right; None if that is not known."""
    numbers = "1 or 2" if len(choices) == 2 else f"1 to {len(choices)}"
    answer = typer.prompt(f"{choices[0].aspect}: {numbers}, or 0 if unknown", type=int, default=0)
    return choices[answer - 1] if 1 <= answer <= len(choices) else None


def table(rows: Sequence[Row]) -> list[str]:
    """Return the rows as lines, and below each what would decide it."""
    width = max((len(row.aspect) for row in rows), default=0)
    indent = " " * (width + _CERTAINTY_COLUMNS + 4)
    lines = []
    for row in rows:
        text = row_text(row)
        lines.append(f"{row.aspect:{width}}  {row.certainty:{_CERTAINTY_COLUMNS}}  {text.reading}")
        lines.append(f"{indent}{text.reason}")
        if text.decide and row.is_fault:
            lines.append(f"{indent}to do: {text.decide}")
        elif text.decide and row.certainty is not Certainty.CERTAIN:
            lines.append(f"{indent}to decide: {text.decide}")
    return lines


_CERTAINTY_COLUMNS: Final = max(map(len, Certainty))
_MEANING_COLUMNS: Final = 42  # columns
_MAX_CELL_LINES: Final = 4
_MAX_STEPS: Final = 3
_MAX_JOINT_NAMES: Final = 3  # of joints
_EXPECTED_FACTS: Final = frozenset(
    {
        Fact.EVERY_JOINT_MOVES,
        Fact.CONTINUOUS,
        Fact.WITHIN_LIMITS,
        Fact.ORDER_OF_URDF,
        Fact.SIGNS_OF_URDF,
        Fact.UNIT_AS_READ,
        Fact.ZERO_OF_URDF,
        Fact.UNCOUPLED,
        Fact.WITH_GRAVITY,
        Fact.STATED_MOUNTING,
        Fact.JOINT_SIDE,
        Fact.JOINT_TORQUE,
        Fact.NO_DELAY,
        Fact.NO_LOW_PASS,
    }
)


def summary(rows: Sequence[Row], most: int = SCREEN_LINES) -> list[str]:
    """Return the table of rows on at most `most` lines, with one for all that agree with the URDF.

    Long cells take a second line as far as there is room, of uncertain rows first.
    """
    usual = [row for row in rows if _is_usual(row)]
    shown = [row for row in rows if row not in usual]
    width = max(len("channel"), *(len(row.aspect) for row in shown), 0)
    head = _table_line(width, "channel", "meaning", "certainty", "evidence")
    evidence_columns = SCREEN_COLUMNS - len(head) + len("evidence")
    agreeing = [
        f"{', '.join(names)} ({certainty})"
        for certainty in Certainty
        if (names := [row.aspect for row in usual if row.certainty is certainty])
    ]
    last = wrap(f"as the URDF says: {'; '.join(agreeing)}", SCREEN_COLUMNS) if agreeing else []
    texts = [row_text(row) for row in shown]
    cells = [
        (_cell(text.reading, _MEANING_COLUMNS), _cell(text.evidence, evidence_columns))
        for text in texts
    ]
    spare = most - 1 - len(shown) - len(last)
    by_need = sorted(range(len(shown)), key=lambda k: -[*Certainty].index(shown[k].certainty))
    for k in by_need:
        more = max(map(len, cells[k])) - 1
        if more > max(spare, 0):
            meaning = shorten(texts[k].reading, _MEANING_COLUMNS, placeholder=" ...")
            cells[k] = [meaning], [shorten(texts[k].evidence, evidence_columns, placeholder=" ...")]
        else:
            spare -= more
    lines = [head]
    for row, (meanings, reasons) in zip(shown, cells, strict=True):
        lines += [
            _table_line(width, *line)
            for line in zip_longest([row.aspect], meanings, [row.certainty], reasons, fillvalue="")
        ]
    return [*lines, *last]


def _is_usual(row: Row) -> bool:
    """Return whether a row agrees with the URDF, or has nothing that speaks against it."""
    is_expected = isinstance(row.reading, Fact) and row.reading in _EXPECTED_FACTS
    return is_expected or row.is_unsupported


def _cell(text: str, columns: int) -> list[str]:
    """Return the lines of a cell of the table."""
    return wrap(text, columns, max_lines=_MAX_CELL_LINES, placeholder=" ...")


def _table_line(width: int, aspect: str, meaning: str, certainty: str, evidence: str) -> str:
    cells = f"{aspect:{width}}  {meaning:{_MEANING_COLUMNS}}  {certainty:{_CERTAINTY_COLUMNS}}"
    return f"{cells}  {evidence}".rstrip()


def determined(groups: Sequence[ParameterGroup]) -> list[Paragraph]:
    """Return three lines: what the recording determines well, weakly, and not."""
    numbers = {
        "well": [group.identifiable for group in groups],
        "weakly": [group.weak for group in groups],
        "not": [group.missing for group in groups],
    }
    lines: list[Paragraph] = []
    for title, counts in numbers.items():
        parts = []
        for quantity, name in (("friction", "friction"), ("body", "bodies")):
            alike = [k for k, group in enumerate(groups) if group.quantity == quantity]
            total = sum(column[k] for column in numbers.values() for k in alike)
            names = [groups[k].body for k in alike if counts[k]]
            joints = "all joints" if len(names) == len(alike) else joined(names, _MAX_JOINT_NAMES)
            if names:
                parts.append(f"{name} {sum(counts[k] for k in alike)} of {total} ({joints})")
        label = "determines" if not lines else ""
        lines.append(Paragraph("; ".join(parts) or "nothing", f"{label:10}  {title:6}  "))
    return lines


def groups_table(groups: Sequence[ParameterGroup]) -> list[str]:
    """Return one line per body or joint."""
    width = max(len(group.body) for group in groups)
    lines = [f"{'joint'.ljust(width)}  of        identifiable  weak  not"]
    lines += [
        f"{group.body.ljust(width)}  {group.quantity.ljust(8)}  "
        f"{group.identifiable:12d}  {group.weak:4d}  {group.missing:3d}"
        for group in groups
    ]
    return lines
