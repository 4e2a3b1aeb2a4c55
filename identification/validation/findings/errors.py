"""How large the error on unseen motion is, and beside what: limits, training, other models."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from identification.validation.evidence import Evidence
from identification.validation.findings.finding import Finding, Level, joined
from identification.validation.thresholds import Thresholds

# What was fitted well and is predicted badly has no wrong sign, which would spoil both.
_NOT_COVERED = "fit a longer or richer motion: what was fitted does not cover what was predicted"


def untested(names: Sequence[str], evidence: Evidence, limit: Thresholds) -> Iterator[Finding]:
    """What was not predicted has no error, which must not pass for a small one."""
    if evidence.in_sample:
        yield Finding(
            "tested",
            "wrong",
            "everything was fitted and nothing held out: all errors are in-sample, and no unseen"
            " motion tells whether the model predicts",
            "run `hil identify --predict ARCHIVE` with a recording that is not fitted, without"
            " `hil identify --in-sample`",
        )
    rows = evidence.held_out.rows
    still = [name for axis, name in enumerate(names) if rows[axis] < limit.rows]
    if still:
        yield Finding(
            "tested",
            "wrong",
            f"{joined(still)} moved in fewer than {limit.rows} samples of"
            f" {evidence.tested_on}, which tests nothing",
            f"record an unseen motion in which {joined(still)} moves; if it is meant to stand"
            " still, lock it (locked under [robot] in the cell file, or `hil import log --held"
            " JOINT`)",
        )
    silent = (rows > 0) & (evidence.held_out.torque_squared == 0.0)
    if silent.any():
        without = joined([name for name, zero in zip(names, silent, strict=True) if zero])
        yield Finding(
            "tested",
            "wrong",
            f"the torque of {without} is zero throughout {evidence.tested_on}: there is nothing to"
            " compare with",
            f"record the torque of {without}, to more digits if it was rounded away",
        )


def size(names: Sequence[str], evidence: Evidence, limit: Thresholds) -> Iterator[Finding]:
    """The relative error, over all axes and on each."""
    error = evidence.held_out
    if error.overall > limit.overall:
        yield Finding(
            "error on unseen motion",
            "wrong",
            f"the torque error on {evidence.tested_on} is {error.overall:.1%} over all axes, more"
            f" than {limit.overall:.0%}",
            _NOT_COVERED
            if error.overall > limit.generalisation * evidence.training.overall
            else "check gear ratios, signs, torque constants and the delay between torque and"
            " position",
            "symptom",
        )
    large = error.relative > limit.axis
    covered = ~(error.relative > limit.generalisation * evidence.training.relative)
    blamed = joined([name for axis, name in enumerate(names) if large[axis] and covered[axis]])
    for axis, name in enumerate(names):
        if large[axis]:
            yield Finding(
                "error on unseen motion",
                "wrong",
                f"the torque error of {name} on {evidence.tested_on} is {error.relative[axis]:.0%},"
                f" more than {limit.axis:.0%}",
                f"check sign, gear ratio and torque constant of {blamed}, and whether the torque"
                " there is more than noise"
                if covered[axis]
                else _NOT_COVERED,
                "symptom",
            )


def unexplained(_: Sequence[str], evidence: Evidence, limit: Thresholds) -> Iterator[Finding]:
    """An error far above the noise of the recordings for which no cause was found."""
    error, floor, causes = evidence.held_out.overall, evidence.floor, evidence.causes
    if floor is None or causes is None or causes.found:
        return
    if error > limit.unexplained and error > limit.multiple * floor:
        best = causes.best
        least = "" if best is None else f" (the best of them leaves {best.ratio:.0%} of it)"
        yield Finding(
            "unexplained error",
            "wrong",
            f"the torque error on {evidence.tested_on} is {error:.1%},"
            f" {error / floor:.1f} times the noise floor of {floor:.1%}, and none of the faults"
            " that were tried explains it: delay, torque constants, signs and order of joints,"
            f" payload, changes between parts of what was fitted{least}",
            "look at what the model leaves out: the friction curves of the report, elasticity,"
            " springs or balancers ([[robot.elements]] of the cell file), temperature",
            "symptom",
        )


def explained(names: Sequence[str], evidence: Evidence, limit: Thresholds) -> Iterator[Finding]:
    """Whether the model beats the mean torque of each axis."""
    error = evidence.held_out
    share = error.explained
    if np.all(np.isnan(share)):
        return
    still = joined([n for axis, n in enumerate(names) if share[axis] < limit.little_explained])
    faster = f"move {still} faster and further, so that its torque stands out of noise"
    for axis, name in enumerate(names):
        if share[axis] <= limit.explained:
            yield Finding(
                "variance explained (R²)",
                "wrong",
                f"on {name} the model is no better than a constant, the mean of its torque",
                _NOT_COVERED
                if error.relative[axis] > limit.generalisation * evidence.training.relative[axis]
                else faster,
                "symptom",
            )
        elif share[axis] < limit.little_explained:
            yield Finding(
                "variance explained (R²)",
                "doubtful",
                f"the model explains only {share[axis]:.0%} of what varies in the torque of {name}",
                faster,
                "symptom",
            )
    worst = int(np.nanargmin(share))
    if share[worst] >= limit.little_explained:
        yield Finding(
            "variance explained (R²)",
            "good",
            f"the model explains {_at_least(share[worst])} of what varies in the torque of each"
            f" axis (least: {names[worst]})",
        )


def _at_least(share: float) -> str:
    return "more than 99.9%" if share > 0.999 else f"{share:.1%} or more"


def growth(names: Sequence[str], evidence: Evidence, limit: Thresholds) -> Iterator[Finding]:
    """An error that is much larger on unseen motion than where it was fitted."""
    unseen, seen = evidence.held_out.relative, evidence.training.relative
    times = unseen / np.maximum(seen, 1e-12)
    grown = times > limit.generalisation
    large = unseen > 0.5 * limit.axis
    levels: tuple[tuple[Level, NDArray[np.bool_]], ...] = (
        ("wrong", grown & large),
        ("doubtful", grown & ~large),
    )
    for level, axes in levels:
        each = ", ".join(
            f"of {names[j]} {times[j]:.1f} times to {unseen[j]:.1%}"
            for j in np.flatnonzero(axes).tolist()
        )
        if each:
            yield Finding(
                "generalisation",
                level,
                f"the torque error grows from the training motion to {evidence.tested_on}: {each}",
                _NOT_COVERED,
                "symptom",
            )


def nominal(names: Sequence[str], evidence: Evidence, limit: Thresholds) -> Iterator[Finding]:
    """Against the maker's figures."""
    if evidence.nominal is None:
        return
    ours, theirs = evidence.held_out, evidence.nominal
    if ours.overall > theirs.overall + limit.nominal:
        yield Finding(
            "against the nominal model",
            "wrong",
            f"the nominal model predicts better: {theirs.overall:.1%} against {ours.overall:.1%}",
            "use the nominal model, or fit a longer and richer motion",
            "symptom",
        )
        return
    text = f"the nominal model misses by {theirs.overall:.1%} where this one misses by "
    text += f"{ours.overall:.1%}"
    if not np.all(np.isnan(theirs.relative)):
        worst = int(np.nanargmax(theirs.relative))
        text += f"; it is worst on {names[worst]} ({theirs.relative[worst]:.0%})"
    yield Finding("against the nominal model", "good", text)


def controller(_: Sequence[str], evidence: Evidence, limit: Thresholds) -> Iterator[Finding]:
    """Against the dynamic model inside the controller, where it sent what that says."""
    theirs = evidence.surroundings.controller
    if theirs is None:
        return
    ours = evidence.held_out.overall
    if ours > theirs.overall + limit.nominal:
        yield Finding(
            "against the controller's model",
            "doubtful",
            f"the controller's own dynamic model predicts better: {theirs.overall:.1%} against"
            f" {ours:.1%}",
            "fit a longer and richer motion before replacing what the controller has",
            "symptom",
        )
    else:
        yield Finding(
            "against the controller's model",
            "good",
            f"the controller's own dynamic model misses by {theirs.overall:.1%} where this one"
            f" misses by {ours:.1%}",
        )
