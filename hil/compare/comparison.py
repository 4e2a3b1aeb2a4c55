"""Campaigns of one arm, from their archives, and what changed from one to another."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, is_dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from hil.batch import run
from hil.batch.estimates import errors, relative_error
from hil.batch.factors import cell_in, opened
from hil.batch.types import ArchiveRef, Arm, Broken, LevelEstimate
from hil.batch.workers import Workers
from hil.cell import Cell
from hil.errors import InputError
from hil.identify.options import Options
from hil.progress import Reporter
from identification import RobotModel

from .payload import Finding, Level, PayloadTrend, freedom_of, payload_findings, payload_trend
from .spread import Tested, against_first, known
from .trend import (
    FALSE_ALARMS,
    LEAST_FRICTION,
    Axis,
    axes_of,
    campaign_names,
    friction_in,
    friction_weights,
    short_names,
)

Array = NDArray[np.float64]

_TWO: Final = "name two campaigns or more of one arm"
_OTHER_SPEED: Final = 1.2
"""Ratio of typical speeds from which two campaigns count as having moved differently."""
_SHARE: Final = FALSE_ALARMS / 2.0  # of comparisons, each for friction and for the payload
_LEAST: Final = f"{100.0 * LEAST_FRICTION:g} %"
_CAVEAT: Final = (
    "A few campaigns do not show how much this arm differs from day to day without anything having "
    "happened to it: a cold arm has tens of per cent more friction. Compare campaigns of an arm "
    "that was equally warm; `hil reidentify` judges each of many by the scatter of those before."
)


@dataclass(frozen=True, eq=False)
class Gathered:
    """Campaigns of one arm.

    Attributes:
        arm: whose they are.
        campaigns: in order of time; in the order given where not all have one.
        repetitions: of each campaign, in order.
        dated: whether the order is that of time.
        broken: what could not be used.
        simulated: whether no robot moved.
    """

    arm: Arm
    campaigns: tuple[LevelEstimate, ...]
    repetitions: tuple[tuple[LevelEstimate, ...], ...]
    dated: bool
    broken: tuple[Broken, ...]
    simulated: bool = False


@dataclass(frozen=True, eq=False)
class Comparison:
    """What changed over the c campaigns of one arm, the first being what others are compared with.

    Attributes:
        arm: its name.
        simulated: whether no robot moved.
        dated: whether campaigns are in order of time.
        changed: whether friction, payload or inertial parameters have.
        verdict: one line.
        findings: everything in sentences, what changed first; never empty.
        warnings: what a reader must know of the archives.
        campaigns: in order.
        names: of the campaigns, with their days if known.
        axes: of the arm.
        friction: of the axes, mean of both directions.
        repetitions: friction by each single repetition, campaign by campaign (m, n).
        payload: of the last link.
        parameters: names of the parameters, base parameters first.
        units: of the parameters.
        values: of the parameters, tested.
        prediction: ||e|| / ||tau|| of the model by row on the validation motions by column (c, c),
            NaN without one.
    """

    arm: str
    simulated: bool
    dated: bool
    changed: bool
    verdict: str
    findings: tuple[Finding, ...]
    warnings: tuple[str, ...]
    campaigns: tuple[LevelEstimate, ...]
    names: tuple[str, ...]
    axes: tuple[Axis, ...]
    friction: Tested
    repetitions: tuple[Array, ...]
    payload: PayloadTrend
    parameters: tuple[str, ...]
    units: tuple[str, ...]
    values: Tested
    prediction: Array

    @property
    def document(self) -> dict[str, Any]:
        """Everything for a script: lists, None for what is not known."""
        campaigns = [
            {"folder": one.campaign, "when": one.when or None, "stated": one.setup}
            for one in self.campaigns
        ]
        found: dict[str, Any] = _as_json(vars(self) | {"campaigns": campaigns})
        return found


def _as_json(value: Any) -> Any:
    if is_dataclass(value):
        value = vars(value)
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, dict):
        return {name: _as_json(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [_as_json(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def gather(places: Sequence[str], workers: Workers, reporter: Reporter) -> Gathered:
    """Identify the campaigns below some places, and check that they can be compared.

    By least squares, which draw no change towards anything.

    Args:
        places: campaign folders, or folders with campaigns below; the `results.json` of a campaign
            stands for its folder.
        workers: read the archives.
        reporter: of progress.

    Raises:
        InputError: there is one campaign only, or campaigns are of different arms.
    """
    roots = [str(Path(p).parent) if _is_results(p) else p for p in places]
    refs: list[ArchiveRef] = []

    def check(found: Sequence[ArchiveRef]) -> None:
        _require_campaigns_of_one_arm(found)
        refs.extend(found)

    result = run.reidentify(roots, Options(estimator="wls"), workers, reporter, check=check)
    campaigns = list(result.campaigns)
    if len(campaigns) < 2:
        why = "".join(f"; {one.path}: {one.reason}" for one in result.broken[:1])
        only = campaigns[0].campaign if campaigns else None
        raise InputError(only, f"is the only campaign that can be estimated{why}", remedy=_TWO)
    absolute = [_absolute(root) for root in roots]

    def named(one: LevelEstimate) -> tuple[int, str]:
        """Sorts campaigns as their places were named."""
        own = _absolute(one.campaign)
        found = [k for k, root in enumerate(absolute) if f"{own}/".startswith(f"{root}/")]
        return (found[0] if found else len(absolute), own)

    dated = all(one.when for one in campaigns)
    campaigns.sort(key=named)
    if dated:
        campaigns.sort(key=lambda one: one.when)
    own = {(one.campaign, one.setup): list[LevelEstimate]() for one in campaigns}
    for rep in result.repetitions:
        own.get((rep.campaign, rep.setup), []).append(rep)
    return Gathered(
        arm=result.arms[campaigns[0].arm],
        campaigns=tuple(campaigns),
        repetitions=tuple(tuple(one) for one in own.values()),
        dated=dated,
        broken=result.broken,
        simulated=refs[0].simulated,  # as all of one arm
    )


def _is_results(place: str) -> bool:
    return "://" not in place and Path(place).name == "results.json"


def _absolute(place: str) -> str:
    return place if "://" in place else Path(place).resolve().as_posix()


def _require_campaigns_of_one_arm(found: Sequence[ArchiveRef]) -> None:
    """Friction and mass of another arm are another arm's, and one campaign has nothing beside it.

    Raises:
        InputError: names two campaigns and what their arms differ in, or the only one.
    """
    of = {ref.key: ref for ref in found if ref.use == "excitation"}
    if not of:
        return  # and that is refused
    first = next(iter(of.values()))
    for one in of.values():
        if one.arm != first.arm:
            here, there = (Arm(ref.arm, _cell(ref)) for ref in (one, first))
            raise InputError(
                one.campaign,
                f"is of another arm ({here.name}) than {first.campaign} ({there.name}): "
                f"{apart(here.cell, there.cell)}",
                remedy="compare campaigns of one arm",
            )
    if len(of) < 2:
        raise InputError(first.campaign, "is the only campaign that was named", remedy=_TWO)


def _cell(ref: ArchiveRef) -> Cell:
    with opened(ref) as archive:
        return cell_in(archive)


def apart(one: Cell, other: Cell) -> str:
    """What two arms differ in, in words."""
    robots = [each.file.robot.model_dump(exclude={"payload"}) for each in (one, other)]
    differ = {
        "robot.urdf": one.urdf != other.urdf,
        "[robot]": robots[0] != robots[1],
        "[drive_train]": one.file.drive_train != other.file.drive_train,
    }
    words = " and ".join(name for name, differs in differ.items() if differs)
    if not words:
        return "one of them is a simulation, or their controllers state other drives"
    return f"they differ in {words}"


def compare_campaigns(gathered: Gathered) -> Comparison:
    """Compare the campaigns of one arm with the first of them."""
    model, campaigns = gathered.arm.cell.model, gathered.campaigns
    names = campaign_names(campaigns, days=gathered.dated)
    axes, payload = axes_of(model, campaigns), payload_trend(model, campaigns, _SHARE)
    weights = friction_weights(model, axes)
    repetitions = [
        np.array([friction_in(one, weights)[0] for one in own]).reshape(len(own), model.n_joints)
        for own in gathered.repetitions
    ]
    pooled = [friction_in(one, weights) for one in campaigns]
    size = np.abs(pooled[0][0])
    friction = against_first(_known(campaigns, pooled, repetitions), _SHARE, LEAST_FRICTION * size)
    single = [
        np.array([np.where(np.isfinite(one.std), one.values, np.nan) for one in own])
        for own in gathered.repetitions
    ]
    values = [(one.values, one.std) for one in campaigns]
    prediction = _prediction(campaigns)
    changed = [axes[j].joint for j in np.flatnonzero(friction.changed.any(axis=1))]
    slight = [axes[j].joint for j in np.flatnonzero(friction.slight.any(axis=1))]
    parts = [f"friction of {', '.join(changed)}"] if changed else []
    parts += ["payload"] if any(payload.changed) else []
    parts += ["inertial parameters"] if any(payload.other) else []
    verdict = f"Changed: {'; '.join(parts)}" if parts else "No significant change"
    if slight and not parts:
        verdict = f"No change of {_LEAST} or more; friction of {', '.join(slight)} differs by less"
    return Comparison(
        arm=gathered.arm.name,
        simulated=gathered.simulated,
        dated=gathered.dated,
        changed=bool(parts),
        verdict=verdict,
        findings=tuple(_findings(names, axes, friction, payload, prediction)),
        warnings=(*_warnings(model, gathered), _CAVEAT),
        campaigns=campaigns,
        names=tuple(names),
        axes=tuple(axes),
        friction=friction,
        repetitions=tuple(repetitions),
        payload=payload,
        parameters=model.parameter_names,
        units=model.units,
        values=against_first(_known(campaigns, values, single), FALSE_ALARMS),
        prediction=prediction,
    )


def _known(
    campaigns: Sequence[LevelEstimate],
    pooled: Sequence[tuple[Array, Array]],
    repetitions: Sequence[Array],
) -> Array:
    """Figures (k, c, 3): values and standard deviations (k,), single repetitions (m, k)."""
    freedom = [freedom_of(one) for one in campaigns]
    return np.array(
        [
            [
                known(value[k], std[k] ** 2, free, own[:, k])
                for (value, std), free, own in zip(pooled, freedom, repetitions, strict=True)
            ]
            for k in range(len(pooled[0][0]))
        ]
    )


def _prediction(campaigns: Sequence[LevelEstimate]) -> Array:
    found = np.full((len(campaigns), len(campaigns)), np.nan)
    for column, motion in enumerate(campaigns):
        for row, one in enumerate(campaigns):
            # What a model cannot know may be needed there.
            if motion.unseen is not None and np.isfinite(one.std).all():
                left, torque = errors(motion.unseen, one.values)
                found[row, column] = relative_error(left, torque, motion.unseen.samples)
    return found


def _warnings(model: RobotModel, gathered: Gathered) -> list[str]:
    """What a reader must know: lost archives, few repetitions, other motions."""
    campaigns = gathered.campaigns
    names = short_names([one.campaign for one in campaigns])
    lost = zip(short_names([one.path for one in gathered.broken]), gathered.broken, strict=True)
    found = [f"{name} could not be used: {one.reason}" for name, one in lost]
    single = [name for name, own in zip(names, gathered.repetitions, strict=True) if len(own) < 2]
    if single:
        found.append(
            f"{', '.join(single)}: one repetition, so what repetitions differ by is not known, and "
            "only noise is allowed for"
        )
    first = campaigns[0].speed_rms
    for name, one in zip(names[1:], campaigns[1:], strict=True):
        if first is None or one.speed_rms is None:
            continue
        with np.errstate(invalid="ignore", divide="ignore"):
            far = np.abs(np.log(one.speed_rms / first)) > math.log(_OTHER_SPEED)
        if far.any():
            fast = ", ".join(model.joint_names[j] for j in np.flatnonzero(far))
            found.append(
                f"{name} moved differently from {names[0]} (typical speed of {fast}): what the"
                " model leaves out can then look like a change"
            )
    each = zip(names, campaigns, strict=True)
    return found + [f"{name}: {warning}" for name, one in each for warning in one.warnings]


# Sentences


def _findings(
    names: list[str],
    axes: Sequence[Axis],
    friction: Tested,
    payload: PayloadTrend,
    prediction: Array,
) -> list[Finding]:
    """What changed first, then what did not, or by little, or is not known."""
    found = [
        _axis_finding(axes[j], friction, j, k, names)
        for j, k in np.argwhere(friction.changed | friction.slight).tolist()
    ]
    for one in payload_findings(payload, names):
        level: Level = "same" if one.level == "quiet" else "changed"
        found.append(Finding(level, one.words, one.next_step))
    same = []
    known_at_all = np.isfinite(friction.p_value).any(axis=1)
    differs = (friction.changed | friction.slight).any(axis=1)
    if quiet := np.flatnonzero(known_at_all & ~differs).tolist():
        limits = np.nanmax(friction.limit[quiet], axis=1) / np.abs(friction.value[quiet, 0])
        same.append(
            f"Friction of {', '.join(axes[j].joint for j in quiet)} has not changed significantly;"
            f" the detection limit is at most {100.0 * limits.max():.0f} %"
            f" ({axes[quiet[limits.argmax()]].joint})."
        )
    if unknown := np.flatnonzero(~known_at_all).tolist():
        same.append(f"Friction of {', '.join(axes[j].joint for j in unknown)} is not determined.")
    for k in range(1, len(names)):
        own, first = prediction[k, k], prediction[0, k]
        if np.isfinite(first) and own > 0.0:
            same.append(
                f"The model of {names[0]} predicts the validation motions of {names[k]} with"
                f" {first / own:.2g} times the error of that campaign's own model:"
                f" {100.0 * first:.2g} % against {100.0 * own:.2g} % of the torque."
            )
    if payload.untested:
        same.append(f"Whether it carries the same was not tested: {payload.untested}.")
    elif not any(payload.changed) and not any(payload.other):
        same.append("The payload has not changed significantly.")
    # Stable: "changed" comes first.
    return sorted(found + [Finding("same", words) for words in same], key=lambda one: one.level)


def _axis_finding(axis: Axis, friction: Tested, j: int, k: int, names: list[str]) -> Finding:
    """A difference of friction that is more than chance; less than a change where it is slight."""
    first, value = friction.value[j, [0, k]]
    change, low, high = 100.0 * friction.shares[j, k]
    words = (
        f"{axis.joint}: friction{axis.at} is {abs(change):.1f} %"
        f" {'higher' if change > 0.0 else 'lower'} in {names[k]} than in {names[0]},"
        f" {value:.3g} against {first:.3g} {axis.unit}"
        f" (95 %: {low:+.1f} to {high:+.1f} %)"
    )
    if friction.slight[j, k]:
        less = f"more than chance, and less than the {_LEAST} that count as a change"
        return Finding("same", f"{words}: {less}.")
    colder = "Check this axis' gear, brake and lubrication; was it colder?"
    warmer = "Was it warmer, or has gear or lubricant been changed?"
    return Finding("changed", f"{words}.", colder if change > 0.0 else warmer)
