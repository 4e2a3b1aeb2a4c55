"""`hil archive`: inspect, check and repair archives."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Final

import typer

from hil.archive.check import ArchiveCheck, Overview, archive_files, check_archive, read_overview
from hil.archive.repair import repair as repair_archive
from hil.base.errors import ArchiveError, InputError
from hil.base.exit_status import ExitStatus
from hil.base.one_screen import SCREEN_LINES, brief
from hil.base.terminal_text import printable, typed
from hil.cli import exit_code_of
from hil.cli.arguments import JsonOption, VerboseOption, print_json

app = typer.Typer(help="Inspect, check and repair archives.", no_args_is_help=True)


Files = Annotated[
    list[Path], typer.Argument(help="Archives, or folders of them.", show_default=False)
]


@app.command("info")
def info(files: Files, as_json: JsonOption = False, verbose: VerboseOption = False) -> None:
    """Print the content of archives: motion, joints, channels, sizes, attachments."""
    failed = 0
    for path in archive_files(files):
        try:
            overview = read_overview(path)
        except ArchiveError as error:
            failed = exit_code_of(error)
            _print_error(path, error, as_json=as_json)
            continue
        lines = [printable(line, keep="") for line in _info_lines(overview)]
        shown = lines if verbose else brief(lines)
        if overview.damage:  # the command is never cut
            remedy = f"  to repair it: hil archive repair {typed(overview.path)}"
            shown = [*(shown if verbose else shown[: SCREEN_LINES - 1]), remedy]
        typer.echo(json.dumps(overview.to_dict()) if as_json else _shown(shown))
    raise typer.Exit(failed)


@app.command("check")
def check(files: Files, as_json: JsonOption = False) -> None:
    """Check whether a whole file can be used, by the same rules as reading and repair.

    Exit status: 0 all conform, 5 at least one does not, 2 at least one is not an archive.
    """
    status = 0
    for path in archive_files(files):
        try:
            result = check_archive(path)
        except ArchiveError as error:
            status = ExitStatus.BAD_INPUT
            _print_error(path, error, as_json=as_json)
            continue
        if not result.conforms and not status:
            status = ExitStatus.NEGATIVE_RESULT
        typer.echo(json.dumps(_check_dict(result)) if as_json else _shown(_check_lines(result)))
    raise typer.Exit(status)


@app.command("repair")
def repair(
    file: Path,
    output: Annotated[Path | None, typer.Option("--output", "-o")] = None,
    in_place: bool = False,
    as_json: Annotated[bool, typer.Option("--json")] = False,
) -> None:
    """Rewrite a truncated or damaged archive so that every reader accepts it.

    Exit status: 0 nothing lost, 3 some data lost, 1 nothing could be recovered.

    Options:
        file: The archive.
        output: File to write. Default: FILE_repaired.mcap.
        in_place: Replace the archive if the repair succeeds.
        as_json: Print one JSON object with recovered and lost data.
    """
    if in_place and output is not None:
        raise InputError(None, "contradicts --output", field="--in-place", remedy="give one")
    try:
        done = repair_archive(file, output, in_place=in_place)
    except ArchiveError as error:
        _print_error(file, error, as_json=as_json)
        raise typer.Exit(ExitStatus.FAILED) from error
    if as_json:
        print_json(
            {
                "file": str(done.path),
                "output": None if done.output is None else str(done.output),
                "whole": done.intact,
                "losses": list(done.losses),
                "samples": done.samples,
                "samples_lost": done.samples_lost,
            }
        )
        raise typer.Exit(ExitStatus.RECORDS_LOST if done.losses else 0)
    for loss in done.losses:
        typer.echo(_shown([f"lost: {loss}"]), err=True)
    if done.output is None:
        typer.echo(_shown([f"{file}: complete, nothing to repair"]))
    else:
        lost = {0: ", none lost", None: ", unknown number lost"}
        end = lost.get(done.samples_lost, f", {done.samples_lost} lost")
        typer.echo(_shown([f"wrote {done.output}: {done.samples} samples{end}"]))
    raise typer.Exit(ExitStatus.RECORDS_LOST if done.losses else 0)


def _print_error(path: Path, error: ArchiveError, *, as_json: bool) -> None:
    if as_json:
        print_json({"file": str(path), "archive": False, "error": str(error)})
    else:
        typer.echo(_shown([f"error: {error}"]), err=True)


def _shown(lines: Sequence[str]) -> str:
    """Join lines without control characters of untrusted texts."""
    return "\n".join(printable(line, keep="") for line in lines)


def _check_lines(result: ArchiveCheck) -> list[str]:
    verdict = "conforms to" if result.conforms else "does not conform to"
    lines = [f"{result.path}: {verdict} profile {result.version}, {result.samples} samples"]
    lines += [f"  {fault}" for fault in result.faults]
    if not result.conforms:
        lines.append(f"  to repair it: hil archive repair {typed(result.path)}")
    return lines


def _check_dict(result: ArchiveCheck) -> dict[str, Any]:
    entries = asdict(result)
    return {"file": str(entries.pop("path")), "archive": True, "keeps": result.conforms, **entries}


_UNITS: Final[Mapping[str, str | Mapping[str, str]]] = {
    "duration": "s",
    "period": "s",
    "size": "bytes",
    "per_minute": "bytes/min",
    "attachments": "bytes",
    "channels": "messages",
    "metadata": {
        "clock_origin_ns": "ns",
        "dropped_rows": "rows",
        "motor_from_joint": "motor turns per joint turn",
        "outcome.samples": "samples",
        "outcome.events": "events",
        "outcome.records_lost": "cycles",
        "outcome.events_lost": "events",
        "outcome.late_answers": "packets",
        "outcome.late_packets": "packets",
        "outcome.answers_not_taken": "replies",
        "outcome.lost_packets": "packets",
        "outcome.repaired.samples_lost": "samples",
    },
}
"""Units of the entries of an overview: of a row, or by the name of a table's row."""


def _info_lines(overview: Overview) -> list[str]:
    """Return the entries of the overview with their units, tables row by row."""
    lines = [str(overview.path)]
    entries = overview.to_dict()
    if overview.damage:  # first, as one screen may not have room for all
        entries = {"damage": entries.pop("damage"), **entries}
    for key, value in entries.items():
        if key in ("file", "archive"):
            continue
        unit = _UNITS.get(key, "")
        rows = value.items() if isinstance(value, dict) else value
        if isinstance(value, dict) or (isinstance(value, tuple) and key != "joint_names"):
            lines.append("  events (s)" if key == "events" else f"  {key}")
            for first, *others in rows:
                of_row = unit if isinstance(unit, str) else unit.get(first, "")
                shown = "  ".join(map(_cell, others))
                lines.append(f"    {_cell(first):<26} {shown}{of_row and f' {of_row}'}")
        else:
            shown = _cell(value)
            lines.append(f"  {key:<12} {shown}{f' {unit}' if value and unit else ''}")
    return lines


def _cell(value: object) -> str:
    if isinstance(value, tuple):
        return ", ".join(map(str, value))
    if isinstance(value, float):
        return f"{value:.6g}"
    return "none" if value in (None, "") else str(value)
