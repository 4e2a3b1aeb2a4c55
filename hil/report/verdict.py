"""What the verdict rests on, gathered for the page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from hil.report import numbers
from hil.report.figures.residuals import (
    autocorrelation_panels,
    friction_panels,
    position_panels,
    speed_panels,
)
from hil.report.validation import every_row_errors
from hil.results import JointJudgement, JudgementResult, Results

_ORDER = ("wrong", "doubtful", "information", "good")


@dataclass(frozen=True)
class JointRow:
    """One joint on unseen motion, every number already text."""

    joint: str
    rms: str
    relative: str
    every_row: str
    fitted: str
    explained: str
    limit: str
    nominal: str
    controller: str


def verdict_context(results: Results) -> dict[str, Any]:
    """What the template `judgement.html.j2` shows; `judgement` is None where nothing was kept."""
    judgement = results.judgement
    if judgement is None:
        return {"judgement": None}
    every_row = every_row_errors(results)
    return {
        "judgement": judgement,
        "judged_joints": [
            _row(joint, every)
            for joint, every in zip(
                judgement.joints, every_row or [""] * len(judgement.joints), strict=True
            )
        ],
        "has_every_row": bool(every_row),
        "has_fitted": not judgement.in_sample and _any(judgement.joints, "fitted_relative"),
        "has_limit": _any(judgement.joints, "share_of_limit"),
        "has_nominal": _any(judgement.joints, "nominal_relative"),
        "has_controller": _any(judgement.joints, "controller_relative"),
        "findings": _sorted(judgement),
        "has_steps": any(finding.next_step for finding in judgement.findings),
        "speed_panels": speed_panels(judgement),
        "position_panels": position_panels(judgement),
        "autocorrelation_panels": autocorrelation_panels(judgement),
        "friction_panels": friction_panels(judgement),
    }


def _any(joints: Sequence[JointJudgement], field: str) -> bool:
    return any(getattr(joint, field) is not None for joint in joints)


def _sorted(judgement: JudgementResult) -> list[Any]:
    """Findings with the worst first, otherwise in the order of the checks."""
    return sorted(judgement.findings, key=lambda finding: _ORDER.index(finding.level))


def _row(joint: JointJudgement, every_row: str) -> JointRow:
    return JointRow(
        joint=joint.joint,
        rms=f"{numbers.significant(joint.rms)} {joint.unit}",
        relative=numbers.percent(joint.relative),
        every_row=every_row,
        fitted=numbers.percent(joint.fitted_relative),
        explained=_explained(joint.explained),
        limit=numbers.percent(joint.share_of_limit),
        nominal=numbers.percent(joint.nominal_relative),
        controller=numbers.percent(joint.controller_relative),
    )


def _explained(share: float | None) -> str:
    """In per cent with its sign: below zero the mean torque would do better."""
    return numbers.MISSING if share is None else numbers.fixed(100.0 * share, 1)
