"""What became of an arm: its parameters, axes and payload from campaign to campaign.

`trends` is pure; `write_trend` makes the page of it. What counts as a change, and how often that
is said of an arm that has not changed, is in `docs/batch.md`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.stats import t as student

from hil.batch import payload_change
from hil.batch.axis_figures import friction_of, friction_weights
from hil.batch.chart import Drift, Limits, chart, drift
from hil.batch.payload_change import PAYLOAD_LIKE, Change, Projection
from hil.batch.types import BatchResult, Broken, LevelEstimate
from identification import RobotModel

Array = NDArray[np.float64]

FALSE_ALARMS: Final = 0.01
"""Share of campaigns of an unchanged arm of which any one of three rules says something: friction
of an axis, torque error of an axis, payload. Each has a third, shared equally among the axes.
The test for drift, which is made once for the whole history, has as much, shared likewise."""

LEAST_FRICTION: Final = 0.05
"""A change of friction by less than this share is not told, however certain."""
LEAST_ERROR: Final = 0.10
"""The same of the torque error."""
LEAST_EFFECT: Final = 0.10
"""A change of payload is told if its RMS torque is at least this share of the torque residual."""

FILE_NAME: Final = "trend.html"

_RULES = 3
_DAY = 86400.0
_NORMAL = float(student.ppf(0.975, 1e6))


@dataclass(frozen=True, eq=False)
class Watched:
    """One figure of an axis over c campaigns.

    Attributes:
        values: (c,) [N·m, N]; NaN where there is none.
        stds: (c,); zero where only the scatter of the history is known.
        limits: of each campaign by those before, None while these are too few.
        departs: which campaigns are outside, and by enough to matter.
    """

    values: Array
    stds: Array
    limits: tuple[Limits | None, ...]
    departs: tuple[bool, ...]


@dataclass(frozen=True, eq=False)
class AxisTrend:
    """An axis.

    Attributes:
        joint: its name.
        unit: of friction and torque error.
        speed: at which friction is compared; NaN if it has none that depends on speed.
        speed_unit: its unit.
        friction: mean of both directions.
        error: standard deviation of what the model leaves of the torque.
        drift: of the friction [unit per day, or per campaign]; None if it cannot be told.
        drifts: whether that is more than chance, and enough to matter.
    """

    joint: str
    unit: str
    speed: float
    speed_unit: str
    friction: Watched
    error: Watched
    drift: Drift | None
    drifts: bool


@dataclass(frozen=True, eq=False)
class ParameterTrend:
    """A parameter over c campaigns.

    Attributes:
        values: (c,).
        half: half of the 95 % interval (c,); infinite where the data do not determine it.
    """

    name: str
    unit: str
    is_friction: bool
    values: Array
    half: Array


@dataclass(frozen=True, eq=False)
class PayloadTrend:
    """What the last link carries beside what it carried in the first campaign.

    Attributes:
        changes: of each campaign against those before it since the last change; None of the first.
        changed: which campaigns differ in what the last link carries.
        other: which differ in their inertial parameters, but not as a payload would.
        mass: on top of the first campaign's [kg] (c,); NaN where it cannot be seen.
        mass_std: (c,).
        untested: why there is no test; "" if there is.
    """

    changes: tuple[Change | None, ...]
    changed: tuple[bool, ...]
    other: tuple[bool, ...]
    mass: Array
    mass_std: Array
    untested: str = ""


@dataclass(frozen=True, eq=False)
class ArmTrend:
    """An arm over c campaigns.

    Attributes:
        name: of the arm.
        campaigns: folders, in order of time.
        when: of each, ISO 8601, "" where unknown.
        time: (c,) [days since the first]; number of the campaign where not all times are known.
        dated: whether all times are known.
    """

    name: str
    campaigns: tuple[str, ...]
    when: tuple[str, ...]
    time: Array
    dated: bool
    axes: tuple[AxisTrend, ...]
    parameters: tuple[ParameterTrend, ...]
    payload: PayloadTrend


@dataclass(frozen=True, eq=False)
class Trends:
    """All arms of a batch, and what could not be read for it."""

    arms: tuple[ArmTrend, ...]
    broken: tuple[Broken, ...]
    estimator: str
    archives: int


def write_trend(folder: Path, result: BatchResult) -> Path:
    """Write the trend report of a batch into a folder, and return its path."""
    # Figures need matplotlib, which is slow to import.
    from hil.report.trend import write_trend_report

    path = folder / FILE_NAME
    write_trend_report(path, trends(result))
    return path


def trends(result: BatchResult) -> Trends:
    """Find what changed on every arm of a batch."""
    found = []
    for digest, arm in sorted(result.arms.items(), key=lambda item: item[1].name):
        campaigns = [one for one in result.campaigns if one.arm == digest]
        if campaigns:
            found.append(arm_trend(arm.name, arm.cell.model, campaigns))
    return Trends(tuple(found), result.broken, result.estimator, len(result.repetitions))


def arm_trend(name: str, model: RobotModel, campaigns: Sequence[LevelEstimate]) -> ArmTrend:
    """Find what changed on one arm from campaign to campaign, in any order."""
    ordered, time, dated = _in_time(campaigns)
    return ArmTrend(
        name=name,
        campaigns=tuple(one.campaign for one in ordered),
        when=tuple(one.when for one in ordered),
        time=time,
        dated=dated,
        axes=_axes(model, ordered, time),
        parameters=tuple(
            ParameterTrend(
                name=model.parameter_names[k],
                unit=model.units[k],
                is_friction=k >= model.base.rank,
                values=np.array([one.values[k] for one in ordered]),
                half=np.array([one.interval_factor * one.std[k] for one in ordered]),
            )
            for k in range(model.n_parameters)
        ),
        payload=_payload(model, ordered),
    )


def _in_time(
    campaigns: Sequence[LevelEstimate],
) -> tuple[list[LevelEstimate], Array, bool]:
    """Campaigns by time if every one has it, else as they come, with days or numbers."""
    instants = [_instant(one.when) for one in campaigns]
    known = [at for at in instants if at is not None]
    if len(known) < len(instants):
        return list(campaigns), np.arange(1.0, len(campaigns) + 1.0), False
    order = sorted(range(len(known)), key=lambda k: (known[k], campaigns[k].campaign))
    time = np.array([known[k] for k in order])
    return [campaigns[k] for k in order], (time - time[:1]) / _DAY, True


def _instant(when: str) -> float | None:
    try:
        at = datetime.fromisoformat(when)
    except ValueError:
        return None
    return (at if at.tzinfo else at.replace(tzinfo=UTC)).timestamp()


def _axes(
    model: RobotModel, campaigns: Sequence[LevelEstimate], time: Array
) -> tuple[AxisTrend, ...]:
    speed = _reference_speed(model, campaigns)
    weights = friction_weights(model, speed)
    friction, stds = (
        np.array(columns)
        for columns in zip(*(_friction_of(one, weights) for one in campaigns), strict=True)
    )
    error = np.array([one.noise_std for one in campaigns])
    share = FALSE_ALARMS / _RULES / model.n_joints
    found = []
    for j, joint in enumerate(model.joint_names):
        turns = bool(model.chain.revolute[j])
        friction_watch = _friction(friction[:, j], stds[:, j], share)
        slope = _drift(time, friction_watch)
        found.append(
            AxisTrend(
                joint=joint,
                unit="N·m" if turns else "N",
                speed=float(speed[j]),
                speed_unit="rad/s" if turns else "m/s",
                friction=friction_watch,
                error=_error(error[:, j], share),
                drift=slope,
                drifts=_matters(slope, time, friction[:, j], FALSE_ALARMS / model.n_joints),
            )
        )
    return tuple(found)


def _friction_of(level: LevelEstimate, weights: Array) -> tuple[Array, Array]:
    covariance = np.diag(level.std**2) if level.covariance is None else level.covariance
    return friction_of(level.values, covariance, weights)


def _reference_speed(model: RobotModel, campaigns: Sequence[LevelEstimate]) -> Array:
    """One speed per axis (n,) for the whole history: the median of what the campaigns had."""
    speeds = [one.speed_rms for one in campaigns if one.speed_rms is not None]
    found = np.full(model.n_joints, np.nan)
    for j in range(model.n_joints):
        known = [float(row[j]) for row in speeds if np.isfinite(row[j])]
        if known:
            found[j] = np.median(known)
    return found


def _friction(values: Array, stds: Array, share: float) -> Watched:
    least = LEAST_FRICTION * _size(values)
    return Watched(values, stds, *chart(values, stds, share, least=least))


def _error(values: Array, share: float) -> Watched:
    """A larger torque error is a fault, and a smaller one is none.

    In logarithms: residuals scatter by a share of their size.
    """
    with np.errstate(divide="ignore"):
        logarithm = np.where(values > 0.0, np.log(values), np.nan)
    nothing = np.zeros(len(values))
    bands, departs = chart(
        logarithm, nothing, share, least=float(np.log1p(LEAST_ERROR)), rise_only=True
    )
    limits = tuple(
        None
        if band is None
        else Limits(float(np.exp(band.centre)), 0.0, float(np.exp(band.high)), band.history)
        for band in bands
    )
    return Watched(values, nothing, limits, departs)


def _drift(time: Array, friction: Watched) -> Drift | None:
    """Slope without the campaigns that departed: a step is no drift."""
    return drift(time, np.where(friction.departs, np.nan, friction.values))


def _matters(slope: Drift | None, time: Array, values: Array, share: float) -> bool:
    if slope is None or not slope.p_value < share:
        return False
    return bool(abs(slope.slope) * np.ptp(time) >= LEAST_FRICTION * _size(values))


def _size(values: Array) -> float:
    known = np.abs(values[np.isfinite(values)])
    return float(np.median(known)) if len(known) else 0.0


def _payload(model: RobotModel, campaigns: Sequence[LevelEstimate]) -> PayloadTrend:
    onto = _projection(model, campaigns)
    if isinstance(onto, str):
        return _no_payload(len(campaigns), onto)
    states = [
        payload_change.state(onto, one.values, _finite(one.covariance), _freedom(one))
        for one in campaigns
    ]
    scatter = payload_change.own_scatter(onto, states)
    changes: list[Change | None] = [None]
    changed, other = [False], [False]
    since = [states[0]]
    for state in states[1:]:
        change = payload_change.compare(onto, payload_change.pooled(since), state, scatter)
        different = (
            change is not None
            and change.p_value < FALSE_ALARMS / _RULES
            and change.effect >= LEAST_EFFECT
        )
        like = change is not None and change.share >= PAYLOAD_LIKE
        since = [state] if different else [*since, state]
        changes.append(change)
        changed.append(different and like)
        other.append(different and not like)
    if len(changes) > 1 and not any(changes):
        return _no_payload(len(campaigns), "the campaigns are too short to be compared jointly")
    beside = [payload_change.compare(onto, states[0], state, scatter) for state in states[1:]]
    return PayloadTrend(
        changes=tuple(changes),
        changed=tuple(changed),
        other=tuple(other),
        mass=np.array([0.0, *(np.nan if one is None else one.mass for one in beside)]),
        mass_std=np.array([0.0, *(np.nan if one is None else one.mass_std for one in beside)]),
    )


def _projection(model: RobotModel, campaigns: Sequence[LevelEstimate]) -> Projection | str:
    """The projection onto a payload, or why there is none."""
    if len(campaigns) < 2:
        return "there is one campaign and nothing to compare it with"
    information = [one.information for one in campaigns if one.information is not None]
    if len(information) < len(campaigns) or any(one.covariance is None for one in campaigns):
        return "the estimator gives no information matrix to compare with"
    known = np.all([np.isfinite(one.std) for one in campaigns], axis=0)
    rows = sum(int(one.samples.sum()) for one in campaigns)
    onto = payload_change.projection(model, known, np.sum(information, axis=0), rows)
    return "nothing that is known of this arm depends on what it carries" if onto is None else onto


def _no_payload(count: int, why: str) -> PayloadTrend:
    no, unknown = (False,) * count, np.full(count, np.nan)
    return PayloadTrend((None,) * count, no, no, unknown, unknown, why)


def _finite(covariance: Array | None) -> Array:
    assert covariance is not None
    return np.where(np.isfinite(covariance), covariance, 0.0)


def _freedom(level: LevelEstimate) -> float:
    """Degrees of freedom of the covariance, from the Student factor of its intervals."""
    factor = level.interval_factor
    if factor <= _NORMAL:
        return 1e6
    return float(brentq(lambda freedom: student.ppf(0.975, freedom) - factor, 0.5, 1.1e6))


__all__ = [
    "FALSE_ALARMS",
    "LEAST_EFFECT",
    "LEAST_ERROR",
    "LEAST_FRICTION",
    "ArmTrend",
    "AxisTrend",
    "ParameterTrend",
    "PayloadTrend",
    "Trends",
    "Watched",
    "arm_trend",
    "trends",
    "write_trend",
]
