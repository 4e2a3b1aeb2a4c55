"""Output of commands that identify: verdict, table of joints, findings, and an exit status."""

from __future__ import annotations

import json as json_module
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import typer

from hil.base.exit_status import ExitStatus
from hil.base.one_screen import MAX_JOINT_ROWS, Paragraph, Part, columns, one_screen
from hil.base.progress import say
from hil.base.terminal_text import printable, typed
from hil.results.error_columns import RMS_MEANING, RMS_TITLE, error_columns, rms_error
from hil.results.results import JointJudgement, JudgementResult, Results
from identification.text import percentage
from identification.validation.purpose_messages import TITLES, figure, requirement

MAX_SHOWN: Final = 3
"""Findings, and next steps, on one screen."""
_MISSING: Final = "-"
_LEVELS: Final = {"wrong": "wrong", "doubtful": "doubtful", "information": "info", "good": "ok"}
LABEL_COLUMNS: Final = 10
"""Columns before a finding."""


def finish(
    results: Results,
    *,
    json: bool,
    quiet: bool = False,
    verbose: bool = False,
    written: tuple[Path, Path] | None = None,
    read: Sequence[Part] = (),
) -> None:
    """Print the verdict with everything behind it, or JSON; exit 5 if it is not good.

    Args:
        results: of the identification.
        json: print one JSON object.
        quiet: print the line of the verdict, and warnings to stderr.
        verbose: print everything, else one screen.
        written: folder and report.
        read: what was read of each recording.
    """
    if json:
        typer.echo(as_json(results, written))
    elif quiet:
        for warning in results.verdict.warnings:
            say(f"note: {warning}", err=True)
        say(results.verdict.line)
    elif verbose:
        for line in whole(results, written):
            say(line)
    else:
        for line in screen(results, written, read):
            typer.echo(printable(line))
    if not results.verdict.good:
        raise typer.Exit(ExitStatus.NEGATIVE_RESULT)


def as_json(results: Results, written: tuple[Path, Path] | None = None) -> str:
    """Return the verdict, its findings and the errors per joint as JSON.

    `written` are the folder and the report, which it names.
    """
    fields = results.model_dump(mode="json")
    keys = ("next_steps", "findings", "joints", "all_joints", "in_sample")
    document = fields["verdict"] | {key: fields["judgement"][key] for key in keys}
    document["undetermined"] = [
        parameter.name for parameter in results.parameters if parameter.undetermined
    ]
    document |= {key: fields[key] for key in ("delays", "fitted", "calibration", "exports")}
    if written is not None:
        document |= {"folder": str(written[0]), "report": str(written[1])}
    return json_module.dumps(document)


def screen(
    results: Results, written: tuple[Path, Path] | None = None, read: Sequence[Part] = ()
) -> list[str]:
    """Return one screen: verdict, recordings, table, findings, next steps, files."""
    judgement = results.judgement
    named = judgement.at(results.verdict.headline)
    open_findings = [
        finding
        for finding in judgement.worst_first
        if finding.level in ("wrong", "doubtful") and finding != named
    ]
    shown = open_findings[:MAX_SHOWN]
    steps = judgement.next_steps[:MAX_SHOWN]
    mentioned = {*shown, named}
    remarks = len([f for f in judgement.findings if f.level != "good" and f not in mentioned])
    remarks += len(results.remarks) + len(judgement.next_steps) - len(steps)
    table_lines = table(results)
    parts: list[Part] = [Paragraph(results.verdict.line), *read, ""]
    parts += table_lines if len(table_lines) <= MAX_JOINT_ROWS + 2 else _some_joints(results)
    parts.append("")
    parts += [Paragraph(f.words, _LEVELS[f.level].ljust(LABEL_COLUMNS), 3) for f in shown]
    parts += [Paragraph(step, "next".ljust(LABEL_COLUMNS), 3) for step in steps]
    parts += _files(results, written)
    if remarks:
        report = "" if written is None else f", or {written[1]}"
        parts.append(f"{remarks} more remark{'s' if remarks > 1 else ''}: -v{report}")
    elif written is not None:
        parts.append(f"{written[1]}: the report, for a browser")
    return one_screen(parts)


def whole(results: Results, written: tuple[Path, Path] | None = None) -> list[str]:
    """Return everything: the table with its legend, purposes, every check, notes and files."""
    rows = table(results, everything=True)
    lines = [results.verdict.line, "", *rows, ""]
    legend = [(RMS_TITLE, RMS_MEANING)]
    legend += [(one.title, one.meaning) for one in error_columns(results.judgement, limits=True)]
    lines += [f"{title:10}  {meaning}" for title, meaning in legend]
    lines += ["", *purposes(results), ""]
    lines.append(f"{results.fitted.message}")
    if results.calibration is not None:
        lines.append(results.calibration.message)
    lines += sentences(results)
    lines += [part if isinstance(part, str) else part.text for part in _files(results, written)]
    if written is not None:
        lines.append(f"report: {written[1]}")
    return lines


def table(results: Results, *, everything: bool = False) -> list[str]:
    """Format one row per joint, and one of all: errors on unseen motion, with references."""
    judgement = results.judgement
    return _table(judgement.joints, judgement, everything=everything)


def _table(
    joints: Sequence[JointJudgement], judgement: JudgementResult, *, everything: bool = False
) -> list[str]:
    """Format some of the joints, and the row of all unless the arm has one joint."""
    overall = judgement.all_joints if len(judgement.joints) > 1 else None
    rows = [
        ["joint", *(joint.joint for joint in joints), "all"],
        [RMS_TITLE, *map(rms_error, joints), ""],
    ]
    for column in error_columns(judgement, limits=everything):
        show = _percent if column.is_share else _three_decimals
        of_all = getattr(overall, column.field, None) if column.of_all else None
        cells = [show(getattr(joint, column.field)) for joint in joints]
        rows.append([column.title, *cells, show(of_all) if column.of_all else ""])
    return columns([*zip(*(row if overall else row[:-1] for row in rows), strict=True)])


def _some_joints(results: Results) -> list[str]:
    """Return the table of the joints with the largest errors of an arm of many joints."""
    judgement = results.judgement
    worst = sorted(judgement.joints, key=lambda joint: -(joint.relative or 0.0))[:MAX_JOINT_ROWS]
    shown = [joint for joint in judgement.joints if joint in worst]
    lines = _table(shown, judgement)
    more = len(judgement.joints) - len(shown)
    return [*lines[:-1], f"{lines[-1]}   ({more} more joints, with smaller errors)"]


def purposes(results: Results) -> list[str]:
    """Return a row for each purpose: whether the model is good for it, its figure, the limit."""
    words = {True: "good", False: "not good", None: _MISSING}
    rows = [
        (
            TITLES[purpose.name],
            words[purpose.good],
            figure(purpose, results.joint_names),
            requirement(purpose),
        )
        for purpose in results.verdict.purposes
    ]
    return columns([("purpose", "", "figure", "good if"), *rows], left=4) if rows else []


def sentences(results: Results) -> list[str]:
    """Format the findings, from good to wrong and the most consequential last, and next steps."""
    judgement = results.judgement
    lines = [
        f"{_LEVELS[finding.level]}: {finding.words}" for finding in reversed(judgement.worst_first)
    ]
    lines += [f"note: {remark}" for remark in results.remarks]
    return lines + [f"next: {step}" for step in judgement.next_steps]


def _files(results: Results, written: tuple[Path, Path] | None) -> list[Part]:
    """Return what was written and what to do with it."""
    if written is None or results.exports is None:
        return []
    folder = written[0]
    model = next((name for name in results.exports.written if name.endswith(".urdf")), None)
    if model is None:
        return [f"results in {folder}; no model for simulators: see -v"]
    use = f"for pinocchio, MuJoCo, Gazebo; `hil export {typed(folder)} --to mjcf`"
    return [Paragraph(f"{folder / model}: {use}", complete=True)]


def _three_decimals(value: float | None) -> str:
    return _MISSING if value is None else f"{value:.3f}"


def _percent(share: float | None) -> str:
    if share is None or math.isnan(share):
        return _MISSING
    return f"{percentage(share, 2)}" if abs(share) < 0.1 else f"{percentage(share, 1)}"
