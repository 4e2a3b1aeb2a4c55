"""What became of an arm: its parameters, axes and payload from campaign to campaign.

`trends` is pure; `write_trend` makes the page of it. What counts as a change, and how often that
is said of an arm that has not changed, is in `docs/batch.md`.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hil.batch.axis_figures import friction_of, friction_weights
from hil.batch.chart import Drift, Limits, chart, drift
from hil.batch.payload_trend import LEAST_EFFECT, PayloadTrend, payload_trend
from hil.batch.types import BatchResult, Broken, LevelEstimate
from hil.timestamps import instant
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
FILE_NAME: Final = "trend.html"

_RULES = 3
_DAY = 86400.0


@dataclass(frozen=True, eq=False)
class Watched:
    """One figure of an axis over c campaigns.

    Attributes:
        values: (c,) [N·m, N]; NaN where there is none.
        stds: (c,); zero where only the scatter of the history is known.
        limits: of each campaign by those before, None while these are too few.
        departs: which campaigns are outside, and by enough to matter.
        levels: see :class:`hil.batch.chart.Chart`.
    """

    values: Array
    stds: Array
    limits: tuple[Limits | None, ...]
    departs: tuple[bool, ...]
    levels: tuple[int, ...]

    @property
    def settled(self) -> NDArray[np.bool_]:
        """Campaigns at the level that was reached last (c,)."""
        known = [level for level in self.levels if level >= 0]
        return np.asarray(np.array(self.levels) == (known[-1] if known else 0))


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
        drift: of the friction at the level reached last [unit per day, or per campaign]; None if
            it cannot be told.
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
class ArmTrend:
    """An arm over c campaigns.

    Attributes:
        name: of the arm.
        campaigns: folders, in order of time.
        when: of each, ISO 8601, "" where unknown.
        time: (c,) [days since the first]; number of the campaign where no time is known.
        dated: whether times are known. If not, campaigns are in the order of their names.
        setups: what the cells state that campaigns of one arm may differ in, in words.
        undated: folders of further campaigns, without a time, that are no part of the history.
        doubts: what a reader must know of the archives.
    """

    name: str
    campaigns: tuple[str, ...]
    when: tuple[str, ...]
    time: Array
    dated: bool
    axes: tuple[AxisTrend, ...]
    parameters: tuple[ParameterTrend, ...]
    payload: PayloadTrend
    setups: tuple[str, ...] = ()
    undated: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Trends:
    """All arms of a batch, and what was not used for it.

    Attributes:
        arms: by name.
        broken: what could not be used.
        estimator: by name.
        archives: that were fitted.
        skipped: what is not meant to be used.
    """

    arms: tuple[ArmTrend, ...]
    broken: tuple[Broken, ...]
    estimator: str
    archives: int
    skipped: tuple[Broken, ...] = ()


def write_trend(folder: Path, found: Trends) -> Path:
    """Write the trend report of a batch into a folder, and return its path."""
    # Figures need matplotlib, which is slow to import.
    from hil.report.trend import write_trend_report

    path = folder / FILE_NAME
    write_trend_report(path, found)
    return path


def trends(result: BatchResult) -> Trends:
    """Find what changed on every arm of a batch."""
    found = []
    for digest, arm in sorted(result.arms.items(), key=lambda item: item[1].name):
        campaigns = [one for one in result.campaigns if one.arm == digest]
        if campaigns:
            doubts = [text for one in result.pooled if one.arm == digest for text in one.doubts]
            trend = arm_trend(arm.name, arm.cell.model, campaigns)
            found.append(replace(trend, doubts=tuple(dict.fromkeys(doubts))))
    return Trends(
        tuple(found), result.broken, result.estimator, len(result.repetitions), result.skipped
    )


def arm_trend(name: str, model: RobotModel, campaigns: Sequence[LevelEstimate]) -> ArmTrend:
    """Find what changed on one arm from campaign to campaign, in any order.

    Campaigns without a time of recording are left out if others have one, since nobody knows where
    they belong. If none has, all are taken in the order of their folders' names.
    """
    ordered, time, dated = _in_time(campaigns)
    within = {id(one) for one in ordered}
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
        payload=payload_trend(model, ordered, FALSE_ALARMS / _RULES),
        setups=tuple(one.setup for one in ordered),
        undated=tuple(one.campaign for one in campaigns if id(one) not in within),
    )


def _in_time(
    campaigns: Sequence[LevelEstimate],
) -> tuple[list[LevelEstimate], Array, bool]:
    """Campaigns with a time, and their days; if none has one, all by name, and their numbers."""
    known = [(at.timestamp(), one) for one in campaigns if (at := instant(one.when)) is not None]
    if not known:
        named = sorted(campaigns, key=lambda one: _natural(one.campaign))
        return named, np.arange(1.0, len(named) + 1.0), False
    known.sort(key=lambda pair: (pair[0], pair[1].campaign))
    time = np.array([at for at, _ in known])
    return [one for _, one in known], (time - time[:1]) / _DAY, True


def _natural(name: str) -> list[tuple[int, str]]:
    """Names in the order that people count in: the ninth before the tenth."""
    parts = re.split(r"([0-9]+)", name)
    return [(int(part), "") if k % 2 else (0, part) for k, part in enumerate(parts)]


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
                drifts=_matters(slope, friction[:, j], FALSE_ALARMS / model.n_joints),
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
    judged = chart(values, stds, share, least=least)
    return Watched(values, stds, judged.limits, judged.departs, judged.levels)


def _error(values: Array, share: float) -> Watched:
    """A larger torque error is a fault, and a smaller one is none.

    In logarithms: residuals scatter by a share of their size.
    """
    with np.errstate(divide="ignore"):
        logarithm = np.where(values > 0.0, np.log(values), np.nan)
    nothing = np.zeros(len(values))
    judged = chart(logarithm, nothing, share, least=float(np.log1p(LEAST_ERROR)), rise_only=True)
    limits = tuple(
        None
        if band is None
        else Limits(float(np.exp(band.centre)), 0.0, float(np.exp(band.high)), band.history)
        for band in judged.limits
    )
    return Watched(values, nothing, limits, judged.departs, judged.levels)


def _drift(time: Array, friction: Watched) -> Drift | None:
    """Slope at one level: a step is no drift."""
    return drift(time, np.where(friction.settled, friction.values, np.nan))


def _matters(slope: Drift | None, values: Array, share: float) -> bool:
    if slope is None or not slope.p_value < share:
        return False
    return bool(abs(slope.slope) * slope.span >= LEAST_FRICTION * _size(values))


def _size(values: Array) -> float:
    known = np.abs(values[np.isfinite(values)])
    return float(np.median(known)) if len(known) else 0.0


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
