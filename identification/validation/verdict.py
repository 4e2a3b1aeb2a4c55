"""Verdict on an identification: all findings in order, messages and next steps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from identification.text import percentage
from identification.validation.evidence import Evidence
from identification.validation.finding import TestedOn, Thresholds
from identification.validation.finding_messages import (
    ARM,
    IMPOSSIBLE,
    UNTESTED,
    Naming,
    WordedFinding,
    worded,
)
from identification.validation.findings.table import find
from identification.validation.purpose import Purpose, PurposeName, good_for
from identification.validation.purpose_messages import purposes_in_a_sentence


@dataclass(frozen=True)
class Verdict:
    """Whether a model may be used, with findings and next steps."""

    good: bool  #: whether the model may be used, for the requested purposes if there are any
    line: str  #: what it is good for, or what is wrong; without purposes the error
    reasons: tuple[str, ...]  #: messages of wrong findings; empty if good
    warnings: tuple[str, ...] = ()  #: messages of doubtful findings
    #: of causes, then of the other wrong findings, or of doubtful ones if none is wrong; of
    #: symptoms only if no cause was found
    next_steps: tuple[str, ...] = ()
    findings: tuple[WordedFinding, ...] = ()  #: every check with its outcome
    purposes: tuple[Purpose, ...] = ()  #: what the model is good for; empty if not examined
    headline: int | None = None  #: index in `findings` of the one that the line names


def judge(
    joint_names: Sequence[str],
    evidence: Evidence,
    thresholds: Thresholds = Thresholds(),  # noqa: B008 - frozen
    *,
    tested_on: TestedOn = TestedOn.UNSEEN,
    purposes: Sequence[Purpose] = (),
    asked: Sequence[PurposeName] = (),
) -> Verdict:
    """Return the verdict on axes of these names.

    Args:
        joint_names: of the axes.
        evidence: errors of the estimate and their possible causes.
        thresholds: limits of the checks.
        tested_on: what the held-out motion is.
        purposes: what the model is good for.
        asked: purposes that decide; by default the error on unseen motion and every check does.
    """
    naming = Naming(tuple(joint_names), tested_on)
    findings = [worded(finding, naming) for finding in find(evidence, thresholds)]
    wrong = [finding for finding in findings if finding.level == "wrong"]
    doubtful = [finding for finding in findings if finding.level == "doubtful"]
    measure = _measure(naming.joints, evidence)
    # A doubtful parameter that was requested is a reservation.
    reserve = "; ".join(finding.reservation for finding in findings if finding.reservation)
    but = f", but {reserve}" if reserve else ""
    line = f"The model predicts {tested_on} well{but}: {measure}."
    fault = _fault_of(findings)
    named = fault or (wrong[0] if wrong and not asked else None)
    good = not wrong
    if asked:
        good = fault is None and good_for(purposes, asked)
    if named is not None and (fault is not None or not purposes):
        error = "" if purposes else f"; {measure}"
        is_near = evidence.held_out.overall <= evidence.allowed(thresholds)
        other = _of_no_arm(tested_on, fault, evidence) if is_near else ""
        line = f"The model must not be relied on: {other}{named.words}{error}."
    elif purposes:
        line = purposes_in_a_sentence(purposes, naming.joints, asked, only=bool(wrong))
        if named is not None:
            line = f"Not good: {named.words}. {line}"
        if tested_on is not TestedOn.UNSEEN:
            line += f" Judged on {tested_on}."
        if reserve and not wrong:
            line += f" {reserve[0].upper()}{reserve[1:]}."
    return Verdict(
        good=good,
        line=line,
        reasons=tuple(finding.words for finding in wrong),
        warnings=tuple(finding.words for finding in doubtful),
        next_steps=_next_steps(wrong, doubtful),
        findings=tuple(findings),
        purposes=tuple(purposes),
        headline=None if named is None else findings.index(named),
    )


def _next_steps(
    wrong: Sequence[WordedFinding], doubtful: Sequence[WordedFinding]
) -> tuple[str, ...]:
    causes = [finding for finding in (*wrong, *doubtful) if finding.role == "cause"]
    explained = bool(causes) and (not wrong or causes[0].level == "wrong")
    roles = ("condition",) if explained else ("condition", "symptom")
    others = [finding for finding in wrong or doubtful if finding.role in roles]
    steps = dict.fromkeys(finding.next_step for finding in (*causes, *others))
    return tuple(step for step in steps if step)


def _fault_of(findings: Sequence[WordedFinding]) -> WordedFinding | None:
    """Return the first wrong finding for which a model is good for no purpose."""
    return next(
        (
            finding
            for finding in findings
            if finding.level == "wrong"
            and (finding.role == "cause" or finding.check in (UNTESTED, IMPOSSIBLE))
        ),
        None,
    )


def _of_no_arm(tested_on: TestedOn, fault: WordedFinding | None, evidence: Evidence) -> str:
    """Return the clause on a model that predicts, but is no arm or another one; else ""."""
    if fault is None or fault.check not in (ARM, IMPOSSIBLE):
        return ""
    share = percentage(evidence.held_out.overall, 1)
    return f"it predicts {tested_on} to {share} of the torque, but is not the arm of the URDF: "


def _measure(names: Sequence[str], evidence: Evidence) -> str:
    """Errors on held-out motion, as the end of the verdict's sentence."""
    error = evidence.held_out
    if np.all(np.isnan(error.relative)):
        return "no torque error was measured"
    worst = int(np.nanargmax(error.relative))
    text = (
        f"{'in-sample ' if evidence.in_sample else ''}torque error {percentage(error.overall, 1)} "
        f"over all axes, {percentage(error.relative[worst], 1)} at worst ({names[worst]})"
    )
    if floor := evidence.floor:
        times = error.overall / floor
        # The floor is an estimate, from the fast part of the residual.
        ratio = f"{times:.1f} times the" if times >= 1.05 else "within the estimated"
        text += f"; {ratio} noise floor of {percentage(floor, 1)}"
    return text
