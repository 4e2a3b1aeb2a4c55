"""Columns of the table of errors by joint, named alike on the terminal and in the report."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

from hil.results.results import JointJudgement, JudgementResult
from identification.text import number

Field = Literal[
    "share_of_limit",
    "relative",
    "fitted_relative",
    "noise_relative",
    "nominal_relative",
    "controller_relative",
    "explained",
]
RMS_TITLE: Final = "RMS error"
RMS_MEANING: Final = "root mean square of measured minus predicted torque, in motion"


@dataclass(frozen=True)
class ErrorColumn:
    """A column of the table: a field of :class:`JointJudgement`, and of the row of all joints."""

    field: Field
    title: str
    meaning: str
    of_all: bool = True  #: whether :class:`OverallJudgement` has it
    is_share: bool = True  #: a relative error, in per cent; else a plain number


def rms_error(joint: JointJudgement) -> str:
    """Return the RMS error with its unit."""
    return f"{number(joint.rms)} {joint.unit}" if joint.has_moved else "-"


def error_columns(judgement: JudgementResult, *, limits: bool = False) -> list[ErrorColumn]:
    """Return the columns that any joint has a value for; `limits` adds the shares of limits."""
    error = "rms error over rms torque of a moving joint"
    columns = [
        ErrorColumn("share_of_limit", "of limit", f"{RMS_TITLE} over torque limit", of_all=False),
        ErrorColumn("relative", "fitted", f"{error}, on fitted motion: nothing was held out")
        if judgement.in_sample
        else ErrorColumn("relative", "in motion", f"{error}, on held-out motion"),
        ErrorColumn("fitted_relative", "fitted", "the same on the fitted motion"),
        ErrorColumn(
            "noise_relative",
            "noise",
            "error that noise alone would cause, from its fast part and the scatter of repetitions",
        ),
        ErrorColumn("nominal_relative", "nominal", judgement.nominal or "the nominal model"),
        ErrorColumn("controller_relative", "controller", "the controller's own dynamic model"),
        ErrorColumn(
            "explained", "R²", "explained share of torque variance", of_all=False, is_share=False
        ),
    ]
    if judgement.in_sample:
        del columns[2]
    return [
        column
        for column in columns
        if judgement.any_joint(column.field) and (limits or column.field != "share_of_limit")
    ]
