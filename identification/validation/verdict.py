"""Is the result good? One sentence, the reasons where it is not, and what to do next."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np

from identification.validation.evidence import Evidence
from identification.validation.finding import Finding, Thresholds
from identification.validation.findings import CHECKS, Case

__all__ = ["Finding", "Thresholds", "Verdict", "judge"]

# What is smaller would be shown as nothing.
_SHOWN = 0.0005


@dataclass(frozen=True)
class Verdict:
    """Answer to "is the result good?".

    Attributes:
        good: whether the model may be used.
        line: one sentence: whether it predicts unseen motion well, and by how much.
        reasons: what is wrong, in words; empty if good.
        warnings: what is not as it should be, but too small or too uncertain to say no.
        strengths: what was checked and found in order.
        next_steps: what to do: first about what explains errors, then about the reasons. About
            other warnings only where there is no reason, since what is wrong makes warnings of its
            own; about mere errors only where nothing was found that explains them.
        findings: every check with its outcome.
    """

    good: bool
    line: str
    reasons: tuple[str, ...]
    warnings: tuple[str, ...] = ()
    strengths: tuple[str, ...] = ()
    next_steps: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()


def judge(
    joint_names: Sequence[str],
    evidence: Evidence,
    thresholds: Thresholds = Thresholds(),  # noqa: B008 - frozen
    *,
    tested_on: str = "unseen motion",
) -> Verdict:
    """Give the verdict.

    Args:
        joint_names: names of the n axes.
        evidence: see :func:`gather`.
        thresholds: what a good result keeps to.
        tested_on: what the held-out motion was, in words.
    """
    evidence = replace(evidence, tested_on=tested_on)
    case = Case(joint_names, evidence, thresholds)
    findings = tuple(chain.from_iterable(check(case) for check in CHECKS))
    wrong = [finding for finding in findings if finding.level == "wrong"]
    doubtful = [finding for finding in findings if finding.level == "doubtful"]
    measure = _measure(joint_names, evidence)
    if wrong:
        line = f"The model must not be relied on: {wrong[0].words}; {measure}."
    else:
        line = f"The model predicts {tested_on} well: {measure}."
    return Verdict(
        good=not wrong,
        line=line,
        reasons=tuple(finding.words for finding in wrong),
        warnings=tuple(finding.words for finding in doubtful),
        strengths=tuple(finding.words for finding in findings if finding.level == "good"),
        next_steps=_steps(wrong, doubtful),
        findings=findings,
    )


def _steps(wrong: list[Finding], doubtful: list[Finding]) -> tuple[str, ...]:
    """What to do, causes first."""
    causes = [finding for finding in (*wrong, *doubtful) if finding.role == "cause"]
    explained = any(finding.level == "wrong" for finding in causes) or bool(causes and not wrong)
    others = [
        finding
        for finding in (wrong or doubtful)
        if finding.role == "condition" or (finding.role == "symptom" and not explained)
    ]
    steps = dict.fromkeys(finding.next_step for finding in (*causes, *others))
    return tuple(step for step in steps if step)


def _measure(names: Sequence[str], evidence: Evidence) -> str:
    """How well unseen motion is predicted, in figures."""
    error = evidence.held_out
    if np.all(np.isnan(error.relative)):
        return "no torque error was measured"
    worst = int(np.nanargmax(error.relative))
    text = (
        f"{'in-sample ' if evidence.in_sample else ''}torque error {error.overall:.1%} over all"
        f" axes, {error.relative[worst]:.1%} at worst ({names[worst]})"
    )
    floor = evidence.floor
    if floor:
        text += f"; {error.overall / floor:.1f} times the noise floor of {floor:.1%}"
    systematic = evidence.systematic
    if systematic is not None and not np.all(np.isnan(systematic)):
        axis = int(np.nanargmax(systematic))
        if systematic[axis] >= _SHOWN:
            text += f"; beyond what noise explains {systematic[axis]:.1%} at worst ({names[axis]})"
    return text
