"""Campaigns of one arm, from their archives, and what changed from one to another."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hil.batch import run
from hil.batch.estimates import errors, relative_error
from hil.batch.factors import cell_in, opened
from hil.batch.types import ArchiveRef, Arm, Broken, LevelEstimate
from hil.batch.workers import Workers
from hil.cell import Cell
from hil.errors import InputError
from hil.identify.options import Options
from hil.progress import Reporter
from hil.results import Frozen
from identification import RobotModel

from .payload import Finding, Level, PayloadTrend, freedom_of, payload_findings, payload_trend
from .spread import Difference, Known, difference, holm, known
from .trend import (
    FALSE_ALARMS,
    FEWEST,
    LEAST_FRICTION,
    campaign_names,
    friction_in,
    friction_weights,
    short_names,
    typical_speed,
)

_TWO: Final = "name two campaigns or more of one arm"


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
    roots = [_folder(place) for place in places]
    refs: list[ArchiveRef] = []

    def check(found: Sequence[ArchiveRef]) -> None:
        _require_campaigns_of_one_arm(found)
        refs.extend(found)

    plan = run.Plan(Options(estimator="wls"))
    result = run.reidentify(roots, plan, workers, reporter, check=check)
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
    return Gathered(
        arm=result.arms[campaigns[0].arm],
        campaigns=tuple(campaigns),
        repetitions=tuple(
            tuple(
                rep
                for rep in result.repetitions
                if (rep.campaign, rep.setup) == (one.campaign, one.setup)
            )
            for one in campaigns
        ),
        dated=dated,
        broken=result.broken,
        simulated=refs[0].simulated,  # as all of one arm
    )


def _folder(place: str) -> str:
    if "://" in place or Path(place).name != "results.json":
        return place
    return str(Path(place).parent)


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
    here, there = one.file, other.file
    robots = (table.robot.model_dump(exclude={"payload"}) for table in (here, there))
    differ = [
        words
        for words, apart in (
            ("robot.urdf", one.urdf != other.urdf),
            ("[robot]", next(robots) != next(robots)),
            ("[drive_train]", here.drive_train != there.drive_train),
        )
        if apart
    ]
    if not differ:
        return "one of them is a simulation, or their controllers state other drives"
    return f"they differ in {' and '.join(differ)}"


Array = NDArray[np.float64]
Numbers = list[float | None]
"""Null for what is not known."""

CONFIDENCE: Final = 0.95
"""Of intervals, each by itself."""
OTHER_SPEED: Final = 1.2
"""Ratio of typical speeds from which two campaigns count as having moved differently."""
_SHARE: Final = FALSE_ALARMS / 2.0  # of comparisons, each for friction and for what it carries
_LEAST: Final = f"{100.0 * LEAST_FRICTION:g} %"


class CampaignCompared(Frozen):
    """One campaign: the last part of its folder with its day, and where it comes from."""

    name: str
    folder: str
    when: str | None
    repetitions: int
    stated: str
    """What its cell states, in words."""


class AxisChange(Frozen):
    """Friction of an axis, mean of both directions at one speed; lists follow the campaigns."""

    joint: str
    unit: str
    speed: float | None
    """That it is compared at; null if it does not depend on speed."""
    speed_unit: str
    friction: Numbers
    std: Numbers
    repetitions: list[Numbers]
    """Friction by each single repetition, campaign by campaign."""
    change: Numbers
    """Against the first campaign, as a share; the first's is null."""
    interval: list[Numbers | None]
    """Of the change, 95 %."""
    p_value: Numbers
    """Of no change, adjusted for all axes and campaigns."""
    changed: list[bool]
    """Which campaigns differ from the first by more than chance and enough to matter."""
    slight: list[bool]
    """Which differ by more than chance, and too little to count as a change."""
    smallest: Numbers
    """Detection limit, as a share."""


class PayloadChange(Frozen):
    """What the last link carries beside what is stated; lists follow the campaigns."""

    untested: str | None
    """Why there is no test."""
    changed: list[bool]
    other_inertia: list[bool]
    """Whether inertial parameters changed, but not as by a payload."""
    mass: Numbers
    """On top of the first campaign's, kg; null where it cannot be seen."""
    mass_std: Numbers
    p_value: Numbers
    effect: Numbers
    """RMS torque of the change, as a share of the torque error."""


class ParameterChange(Frozen):
    """One parameter; lists follow the campaigns."""

    name: str
    unit: str
    friction: bool
    value: Numbers
    std: Numbers
    change: Numbers
    """Against the first campaign."""
    change_std: Numbers
    p_value: Numbers
    changed: list[bool]
    """Which campaigns differ from the first by more than chance."""


class Prediction(Frozen):
    """||e|| / ||tau|| of the model by row on the validation motion by column, null without one."""

    overall: list[Numbers]
    joints: list[list[Numbers]]
    """The same per joint, which is last."""


class Comparison(Frozen):
    """What changed over the campaigns of one arm, the first being what others are compared with."""

    arm: str
    joint_names: list[str]
    simulated: bool
    dated: bool
    """Whether campaigns are in order of time."""
    changed: bool
    friction_changed: bool
    friction_slight: bool
    """Whether friction of any axis differs, but by too little to count as a change."""
    load_changed: bool
    """Whether what the arm carries, or its inertial parameters, changed."""
    verdict: str
    findings: list[Finding]
    """Everything in sentences, what changed first; never empty."""
    caveat: str
    """What few campaigns cannot show."""
    warnings: list[str]
    campaigns: list[CampaignCompared]
    axes: list[AxisChange]
    payload: PayloadChange
    parameters: list[ParameterChange]
    prediction: Prediction


def compare_campaigns(gathered: Gathered) -> Comparison:
    """Compare the campaigns of one arm with the first of them."""
    model, campaigns = gathered.arm.cell.model, gathered.campaigns
    names = campaign_names(campaigns, days=gathered.dated)
    axes, payload = _axes(model, gathered), payload_trend(model, campaigns, _SHARE)
    prediction = _prediction(campaigns, model.n_joints)
    friction_changed = any(any(axis.changed) for axis in axes)
    load_changed = any(payload.changed) or any(payload.other)
    return Comparison(
        arm=gathered.arm.name,
        joint_names=list(model.joint_names),
        simulated=gathered.simulated,
        dated=gathered.dated,
        changed=friction_changed or load_changed,
        friction_changed=friction_changed,
        friction_slight=any(any(axis.slight) for axis in axes),
        load_changed=load_changed,
        verdict=_verdict(axes, payload),
        findings=_findings(names, axes, payload, prediction),
        caveat=_caveat(len(campaigns)),
        warnings=_warnings(model, gathered),
        campaigns=[
            CampaignCompared(
                name=name,
                folder=one.campaign,
                when=one.when or None,
                repetitions=one.repetitions,
                stated=one.setup,
            )
            for name, one in zip(names, campaigns, strict=True)
        ],
        axes=axes,
        payload=PayloadChange(
            untested=payload.untested or None,
            changed=list(payload.changed),
            other_inertia=list(payload.other),
            mass=_numbers(payload.mass),
            mass_std=_numbers(payload.mass_std),
            p_value=[None if one is None else one.p_value for one in payload.changes],
            effect=[None if one is None else one.effect for one in payload.changes],
        ),
        parameters=_parameters(model, gathered),
        prediction=prediction,
    )


def _axes(model: RobotModel, gathered: Gathered) -> list[AxisChange]:
    campaigns, n = gathered.campaigns, model.n_joints
    speed = typical_speed(model, campaigns)
    weights = friction_weights(model, speed)
    pooled = [friction_in(one, weights) for one in campaigns]
    single = [
        np.array([friction_in(one, weights)[0] for one in own]).reshape(len(own), n)
        for own in gathered.repetitions
    ]
    rows = [
        [
            known(value[j], std[j] ** 2, freedom_of(one), own[:, j])
            for one, (value, std), own in zip(campaigns, pooled, single, strict=True)
        ]
        for j in range(n)
    ]
    apart, adjusted = _differences(rows)
    tests = int(np.isfinite(adjusted).sum())
    found = []
    for j, joint in enumerate(model.joint_names):
        turns, size = bool(model.chain.revolute[j]), abs(rows[j][0].value)
        least = LEAST_FRICTION * size
        away = np.array([one.value for one in apart[j]])
        half = np.array([one.half(1.0 - CONFIDENCE) for one in apart[j]])
        # What Holm's procedure asks of the first of all tests.
        reach = np.array([one.half(_SHARE / max(1, tests)) for one in apart[j]])
        sure, large = adjusted[j] < _SHARE, np.abs(away) >= least
        with np.errstate(divide="ignore", invalid="ignore"):
            change, low, high = (_numbers(one / size) for one in (away, away - half, away + half))
        found.append(
            AxisChange(
                joint=joint,
                unit="N·m" if turns else "N",
                speed=_numbers(speed[j]),
                speed_unit="rad/s" if turns else "m/s",
                friction=_numbers([one.value for one in rows[j]]),
                std=_numbers([one.std for one in rows[j]]),
                repetitions=[_numbers(own[:, j]) for own in single],
                change=[None, *change],
                interval=[None, *([*ends] for ends in zip(low, high, strict=True))],
                p_value=[None, *_numbers(adjusted[j])],
                changed=[False, *(sure & large).tolist()],
                slight=[False, *(sure & ~large).tolist()],
                smallest=[None, *_numbers(np.maximum(reach, least) / (size or np.nan))],
            )
        )
    return found


def _parameters(model: RobotModel, gathered: Gathered) -> list[ParameterChange]:
    single = [
        np.array([np.where(np.isfinite(one.std), one.values, np.nan) for one in own])
        for own in gathered.repetitions
    ]
    rows = [
        [
            known(float(one.values[k]), float(one.std[k]) ** 2, freedom_of(one), own[:, k])
            for one, own in zip(gathered.campaigns, single, strict=True)
        ]
        for k in range(model.n_parameters)
    ]
    apart, adjusted = _differences(rows)
    return [
        ParameterChange(
            name=model.parameter_names[k],
            unit=model.units[k],
            friction=k >= model.base.rank,
            value=_numbers([one.value for one in rows[k]]),
            std=_numbers([one.std for one in rows[k]]),
            change=[None, *_numbers([one.value for one in apart[k]])],
            change_std=[None, *_numbers([one.std for one in apart[k]])],
            p_value=[None, *_numbers(adjusted[k])],
            changed=[False, *(adjusted[k] < FALSE_ALARMS).tolist()],
        )
        for k in range(model.n_parameters)
    ]


def _differences(rows: Sequence[Sequence[Known]]) -> tuple[list[list[Difference]], Array]:
    """Differences of all others from the first campaign, and their adjusted p values."""
    apart = [[difference(row[0], one) for one in row[1:]] for row in rows]
    return apart, holm(np.array([[one.p_value for one in row] for row in apart]))


def _prediction(campaigns: Sequence[LevelEstimate], n_joints: int) -> Prediction:
    count = len(campaigns)
    overall = np.full((count, count), np.nan)
    joints = np.full((count, count, n_joints), np.nan)
    for column, motion in enumerate(campaigns):
        if motion.unseen is None:
            continue
        rows = motion.unseen.samples
        for row, one in enumerate(campaigns):
            if not np.isfinite(one.std).all():
                continue  # what it cannot know may be needed there
            left, torque = errors(motion.unseen, one.values)
            joints[row, column] = left / np.where(torque > 0.0, torque, np.nan)
            overall[row, column] = relative_error(left, torque, rows)
    return Prediction(overall=_numbers(overall), joints=_numbers(joints))


def _numbers(values: ArrayLike) -> Any:
    """A number, or nested lists of numbers (...), None for what is not finite."""
    numbers = np.asarray(values, dtype=np.float64)
    found = numbers.astype(object)
    found[~np.isfinite(numbers)] = None
    return found.tolist()


def _warnings(model: RobotModel, gathered: Gathered) -> list[str]:
    """What a reader must know: lost archives, few repetitions, other motions."""
    campaigns = gathered.campaigns
    called = short_names([one.campaign for one in campaigns])
    lost = zip(short_names([one.path for one in gathered.broken]), gathered.broken, strict=True)
    found = [f"{name} could not be used: {one.reason}" for name, one in lost]
    single = [name for name, own in zip(called, gathered.repetitions, strict=True) if len(own) < 2]
    if single:
        found.append(
            f"{', '.join(single)}: one repetition, so what repetitions differ by is not known, and "
            "only noise is allowed for"
        )
    first = campaigns[0].speed_rms
    for name, one in zip(called[1:], campaigns[1:], strict=True):
        if first is None or one.speed_rms is None:
            continue
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = np.exp(np.abs(np.log(one.speed_rms / first)))
        fast = [j for j, r in zip(model.joint_names, ratio, strict=True) if r > OTHER_SPEED]
        if fast:
            found.append(
                f"{name} moved differently from {called[0]} (typical speed of "
                f"{', '.join(fast)}): what the model leaves out can then look like a change"
            )
    each = zip(called, campaigns, strict=True)
    return found + [f"{name}: {warning}" for name, one in each for warning in one.warnings]


# Sentences


def _verdict(axes: Sequence[AxisChange], payload: PayloadTrend) -> str:
    """One line."""
    changed = [axis.joint for axis in axes if any(axis.changed)]
    slight = [axis.joint for axis in axes if any(axis.slight)]
    parts = [f"friction of {_joined(changed)}"] if changed else []
    parts += ["what the arm carries"] if any(payload.changed) else []
    parts += ["inertial parameters"] if any(payload.other) else []
    if parts:
        return f"Changed: {_joined(parts)}"
    if slight:
        return f"No change of {_LEAST} or more; friction of {_joined(slight)} differs by less"
    return "No significant change"


def _caveat(count: int) -> str:
    text = (
        f"{count} campaigns do not show how much this arm differs from day to day without "
        "anything having happened to it: a cold arm has tens of per cent more friction. Compare "
        "campaigns of an arm that was equally warm."
    )
    if count > FEWEST:
        text += " `hil reidentify` on the same folders judges each by the scatter of those before."
    return text


def _findings(
    names: list[str], axes: Sequence[AxisChange], payload: PayloadTrend, prediction: Prediction
) -> list[Finding]:
    """What changed first, then what did not, or by little, or is not known."""
    found = [_axis_finding(axis, k, names) for axis in axes for k in range(1, len(names))]
    for one in payload_findings(payload, names):
        level: Level = "same" if one.level == "quiet" else "changed"
        found.append(Finding(level, one.words, one.next_step))
    same = [*_unchanged(axes), *_predictions(prediction, names)]
    if payload.untested:
        same.append(f"Whether it carries the same was not tested: {payload.untested}.")
    elif not any(payload.changed) and not any(payload.other):
        same.append("The payload has not changed significantly.")
    every = [one for one in found if one is not None] + [Finding("same", words) for words in same]
    return sorted(every, key=lambda one: one.level)  # stable: "changed" comes first


def _axis_finding(axis: AxisChange, k: int, names: list[str]) -> Finding | None:
    """A difference of friction that is more than chance; less than a change where it is slight."""
    change, interval = axis.change[k], axis.interval[k]
    if not (axis.changed[k] or axis.slight[k]) or change is None or interval is None:
        return None
    low, high = (f"{100.0 * (end or 0.0):+.1f}" for end in interval)
    at = "" if axis.speed is None else f" at {axis.speed:.2g} {axis.speed_unit}"
    words = (
        f"{axis.joint}: friction{at} is {100.0 * abs(change):.{0 if axis.changed[k] else 1}f} % "
        f"{'higher' if change > 0.0 else 'lower'} in {names[k]} than in {names[0]}, "
        f"{axis.friction[k]:.3g} against {axis.friction[0]:.3g} {axis.unit} "
        f"(95 %: {low} to {high} %)"
    )
    if axis.slight[k]:
        less = f"more than chance, and less than the {_LEAST} that count as a change"
        return Finding("same", f"{words}: {less}.")
    step = "Check this axis' gear, brake and lubrication; was it colder?"
    if change < 0.0:
        step = "Was it warmer, or has gear or lubricant been changed?"
    return Finding("changed", f"{words}.", step)


def _unchanged(axes: Sequence[AxisChange]) -> list[str]:
    same = [axis for axis in axes if not any(axis.changed) and not any(axis.slight)]
    limits = {
        axis.joint: max((one for one in axis.smallest if one is not None), default=math.nan)
        for axis in same
        if any(p is not None for p in axis.p_value)
    }
    silent = [axis.joint for axis in same if axis.joint not in limits]
    sentences = []
    if limits:
        worst = max(limits, key=lambda joint: limits[joint])
        sentences.append(
            f"Friction of {_joined([*limits])} has not changed significantly; the detection limit"
            f" is {100.0 * limits[worst]:.0f} %"
            + (f" (of {worst}, the least well known)." if len(limits) > 1 else ".")
        )
    if silent:
        sentences.append(f"Friction of {_joined(silent)} is not determined.")
    return sentences


def _predictions(prediction: Prediction, names: list[str]) -> list[str]:
    """How the first model does on the motions of the others, beside their own models."""
    sentences = []
    for k in range(1, len(names)):
        own, first = prediction.overall[k][k], prediction.overall[0][k]
        if first is None or not own:
            continue
        sentences.append(
            f"The model of {names[0]} predicts the validation motions of {names[k]} with"
            f" {first / own:.2g} times the error of that campaign's own model:"
            f" {100.0 * first:.2g} % against {100.0 * own:.2g} % of the torque."
        )
    return sentences


def _joined(words: list[str]) -> str:
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)
