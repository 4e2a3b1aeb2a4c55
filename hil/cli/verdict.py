"""Output of commands that identify: a table, findings, the verdict and an exit status."""

from __future__ import annotations

import json as json_module
import math
from collections.abc import Callable
from pathlib import Path
from typing import Final

import typer

from hil.base.progress import say
from hil.results.results import JointJudgement, Results
from identification.text import percentage

NOT_GOOD = 5
"""Exit status of a command whose model is not good."""

_MISSING: Final = "-"
_LEVELS: Final = {"wrong": "WRONG", "doubtful": "warning", "information": "info", "good": "ok"}


def finish(
    results: Results,
    *,
    json: bool,
    quiet: bool = False,
    written: tuple[Path, Path] | None = None,
) -> None:
    """Print table, findings and verdict, or JSON; exit 5 if it is not good.

    With `quiet`, warnings go to stderr. `written` are folder and report, which the last line or
    the JSON names.
    """
    if json:
        typer.echo(as_json(results, written))
    else:
        lines = sentences(results, quiet=quiet)
        if not quiet:
            if results.calibration is not None:
                lines.insert(0, results.calibration.message)
            lines.insert(0, results.fitted.message)
            for line in table(results):
                typer.echo(line)
        for line in lines:
            say(line, err=quiet)
        say(results.verdict.line)
    if written is not None and not (quiet or json):
        say(f"results: {written[0]}, report: {written[1]}")
    if not results.verdict.good:
        raise typer.Exit(NOT_GOOD)


def as_json(results: Results, written: tuple[Path, Path] | None = None) -> str:
    """Return the verdict, its findings and the errors per joint as JSON.

    `written` are the folder and the report, which it names.
    """
    fields = results.model_dump(mode="json")
    keys = ("next_steps", "findings", "joints", "in_sample")
    document = fields["verdict"] | {key: fields["judgement"][key] for key in keys}
    document["undetermined"] = [
        parameter.name for parameter in results.parameters if parameter.undetermined
    ]
    document |= {key: fields[key] for key in ("delays", "fitted", "calibration", "exports")}
    if written is not None:
        document |= {"folder": str(written[0]), "report": str(written[1])}
    return json_module.dumps(document)


def table(results: Results) -> list[str]:
    """Format one row per joint: errors on held-out motion, with references."""
    joints = results.judgement.joints
    in_sample = results.judgement.in_sample
    columns: list[tuple[str, Callable[[JointJudgement], str]]] = [
        ("joint", lambda joint: joint.joint),
        ("RMS error", lambda joint: f"{joint.rms:.3g} {joint.unit}"),
        ("in-sample" if in_sample else "relative", lambda joint: _percent(joint.relative)),
        ("fitted", lambda joint: _MISSING if in_sample else _percent(joint.fitted_relative)),
        ("of limit", lambda joint: _percent(joint.share_of_limit)),
        ("R²", lambda joint: _percent(joint.explained)),
        ("nominal", lambda joint: _percent(joint.nominal_relative)),
        ("controller", lambda joint: _percent(joint.controller_relative)),
    ]
    cells = [[title, *(text(joint) for joint in joints)] for title, text in columns]
    shown = [column for column in cells if set(column[1:]) != {_MISSING}]
    padded = [
        [cell.ljust(width) if column is shown[0] else cell.rjust(width) for cell in column]
        for column in shown
        for width in [max(map(len, column))]
    ]
    return ["  ".join(row).rstrip() for row in zip(*padded, strict=True)]


def sentences(results: Results, *, quiet: bool = False) -> list[str]:
    """Format the findings, from good to wrong and the most consequential last, and next steps."""
    judgement = results.judgement
    if quiet:
        return [f"note: {warning}" for warning in results.verdict.warnings]
    lines = [
        f"{_LEVELS[finding.level]}: {finding.words}" for finding in reversed(judgement.worst_first)
    ]
    lines += [f"note: {remark}" for remark in results.remarks]
    return lines + [f"next: {step}" for step in judgement.next_steps]


def _percent(share: float | None) -> str:
    if share is None or math.isnan(share):
        return _MISSING
    return f"{percentage(share, 2)}" if abs(share) < 0.1 else f"{percentage(share, 1)}"
