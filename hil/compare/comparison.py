"""What changed from one campaign of an arm to another: pure, from estimates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hil.batch.estimates import errors, relative_error
from hil.batch.types import LevelEstimate
from identification import RobotModel

from .gather import Gathered
from .payload import PayloadTrend, freedom_of, payload_trend
from .spread import Difference, Known, difference, holm, known
from .trend import (
    FALSE_ALARMS,
    LEAST_FRICTION,
    friction_in,
    friction_weights,
    short_names,
    typical_speed,
)

Array = NDArray[np.float64]

CONFIDENCE: Final = 0.95
"""Of intervals, each by itself."""
OTHER_SPEED: Final = 1.2
"""Ratio of typical speeds from which two campaigns count as having moved differently."""
_SHARE: Final = FALSE_ALARMS / 2.0  # of comparisons, each for friction and for what it carries


@dataclass(frozen=True, eq=False)
class AxisChange:
    """Friction of an axis in k campaigns, at one speed, mean of both directions.

    Attributes:
        joint: its name.
        unit: of the friction.
        speed: that it is compared at; NaN if it does not depend on speed.
        speed_unit: of the speed.
        known: of each campaign.
        repetitions: friction by each single repetition, campaign by campaign.
        differences: of each campaign against the first; the first's is None.
        p_values: adjusted for all axes and campaigns (k,); NaN of the first.
        changed: which campaigns differ from the first by more than chance and enough to matter.
        slight: which differ by more than chance, and too little to count as a change.
        smallest: detection limit (k,), as a share; NaN of the first.
    """

    joint: str
    unit: str
    speed: float
    speed_unit: str
    known: tuple[Known, ...]
    repetitions: tuple[Array, ...]
    differences: tuple[Difference | None, ...]
    p_values: Array
    changed: tuple[bool, ...]
    slight: tuple[bool, ...]
    smallest: Array

    def relative(self, k: int) -> tuple[float, float, float]:
        """Change of campaign k against the first as a share, and its 95 % interval."""
        one, size = self.differences[k], abs(self.known[0].value)
        assert one is not None
        half = one.half(1.0 - CONFIDENCE)
        return one.value / size, (one.value - half) / size, (one.value + half) / size


@dataclass(frozen=True, eq=False)
class ParameterChange:
    """One parameter in k campaigns; as :class:`AxisChange`."""

    name: str
    unit: str
    is_friction: bool
    known: tuple[Known, ...]
    differences: tuple[Difference | None, ...]
    p_values: Array

    def differs(self, k: int) -> bool:
        """Whether campaign k differs from the first by more than chance."""
        return bool(self.p_values[k] < FALSE_ALARMS)


@dataclass(frozen=True, eq=False)
class Prediction:
    """How the model of one campaign predicts the validation motions of another.

    Attributes:
        overall: ||e|| / ||tau|| over all joints (k, k): of the model by row, motion by column; NaN
            where a campaign has no validation motion.
        joints: the same per joint (k, k, n).
    """

    overall: Array
    joints: Array


@dataclass(frozen=True, eq=False)
class Comparison:
    """What changed over k campaigns of one arm, the first being what others are compared with.

    Attributes:
        arm: its name.
        joint_names: of the arm.
        campaigns: as they were estimated.
        dated: whether they are in order of time.
        simulated: whether no robot moved.
        axes: friction.
        parameters: one by one.
        payload: what the last link carries.
        prediction: of each other's motions.
        warnings: what a reader must know.
    """

    arm: str
    joint_names: tuple[str, ...]
    campaigns: tuple[LevelEstimate, ...]
    dated: bool
    simulated: bool
    axes: tuple[AxisChange, ...]
    parameters: tuple[ParameterChange, ...]
    payload: PayloadTrend
    prediction: Prediction
    warnings: tuple[str, ...]

    @property
    def changed(self) -> bool:
        """Whether anything has changed."""
        return self.friction_changed or self.load_changed

    @property
    def friction_changed(self) -> bool:
        """Whether friction of any axis is."""
        return any(any(axis.changed) for axis in self.axes)

    @property
    def friction_slight(self) -> bool:
        """Whether friction of any axis differs, but by too little to count as a change."""
        return any(any(axis.slight) for axis in self.axes)

    @property
    def load_changed(self) -> bool:
        """Whether what the arm carries, or its inertial parameters, are."""
        return any(self.payload.changed) or any(self.payload.other)


def compare_campaigns(gathered: Gathered) -> Comparison:
    """Compare the campaigns of one arm with the first of them."""
    model, campaigns = gathered.arm.cell.model, gathered.campaigns
    broken = tuple(
        f"{name} could not be used: {one.reason}"
        for name, one in zip(
            short_names([one.path for one in gathered.broken]), gathered.broken, strict=True
        )
    )
    called = short_names([one.campaign for one in campaigns])
    own = tuple(
        f"{name}: {warning}"
        for name, one in zip(called, campaigns, strict=True)
        for warning in one.warnings
    )
    return Comparison(
        arm=gathered.arm.name,
        joint_names=model.joint_names,
        campaigns=campaigns,
        dated=gathered.dated,
        simulated=gathered.simulated,
        axes=_axes(model, gathered),
        parameters=_parameters(model, gathered),
        payload=payload_trend(model, campaigns, _SHARE),
        prediction=_prediction(campaigns, model.n_joints),
        warnings=(*broken, *_few(gathered, called), *_other_motion(model, campaigns, called), *own),
    )


def _axes(model: RobotModel, gathered: Gathered) -> tuple[AxisChange, ...]:
    campaigns, repetitions = gathered.campaigns, gathered.repetitions
    speed = typical_speed(model, campaigns)
    weights = friction_weights(model, speed)
    pooled = [friction_in(one, weights) for one in campaigns]
    single = [_per_repetition(own, weights) for own in repetitions]
    rows = [
        tuple(
            known(
                value[j], std[j] ** 2 if np.isfinite(std[j]) else np.inf, freedom_of(one), rep[:, j]
            )
            for one, (value, std), rep in zip(campaigns, pooled, single, strict=True)
        )
        for j in range(model.n_joints)
    ]
    apart = [_differences(row) for row in rows]
    adjusted = holm(np.array([[np.nan if d is None else d.p_value for d in row] for row in apart]))
    tests = int(np.isfinite(adjusted).sum())
    found = []
    for j, joint in enumerate(model.joint_names):
        turns, size = bool(model.chain.revolute[j]), abs(rows[j][0].value)
        least = LEAST_FRICTION * size
        # What Holm's procedure asks of the first of all tests.
        reach = np.array(
            [np.nan if d is None else d.half(_SHARE / max(1, tests)) for d in apart[j]]
        )
        judged = [
            (d is not None and bool(p < _SHARE), d is not None and bool(abs(d.value) >= least))
            for d, p in zip(apart[j], adjusted[j], strict=True)
        ]
        found.append(
            AxisChange(
                joint=joint,
                unit="N·m" if turns else "N",
                speed=float(speed[j]),
                speed_unit="rad/s" if turns else "m/s",
                known=rows[j],
                repetitions=tuple(rep[:, j] for rep in single),
                differences=apart[j],
                p_values=adjusted[j],
                changed=tuple(sure and large for sure, large in judged),
                slight=tuple(sure and not large for sure, large in judged),
                smallest=np.maximum(reach, least) / (size or np.nan),
            )
        )
    return tuple(found)


def _parameters(model: RobotModel, gathered: Gathered) -> tuple[ParameterChange, ...]:
    campaigns = gathered.campaigns
    single = [np.array([one.values for one in own]) for own in gathered.repetitions]
    unknown = [np.array([~np.isfinite(one.std) for one in own]) for own in gathered.repetitions]
    single = [np.where(lost, np.nan, values) for values, lost in zip(single, unknown, strict=True)]
    rows = [
        tuple(
            known(float(one.values[k]), float(one.std[k]) ** 2, freedom_of(one), own[:, k])
            for one, own in zip(campaigns, single, strict=True)
        )
        for k in range(model.n_parameters)
    ]
    apart = [_differences(row) for row in rows]
    adjusted = holm(np.array([[np.nan if d is None else d.p_value for d in row] for row in apart]))
    return tuple(
        ParameterChange(
            name=model.parameter_names[k],
            unit=model.units[k],
            is_friction=k >= model.base.rank,
            known=rows[k],
            differences=apart[k],
            p_values=adjusted[k],
        )
        for k in range(model.n_parameters)
    )


def _differences(row: Sequence[Known]) -> tuple[Difference | None, ...]:
    return (None, *(difference(row[0], one) for one in row[1:]))


def _per_repetition(own: Sequence[LevelEstimate], weights: Array) -> Array:
    """Friction of each axis by each repetition (m, n)."""
    return np.array([friction_in(one, weights)[0] for one in own]).reshape(len(own), len(weights))


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
    return Prediction(overall, joints)


def _few(gathered: Gathered, called: Sequence[str]) -> list[str]:
    """Where single repetitions cannot say what repetitions differ by."""
    single = [name for name, own in zip(called, gathered.repetitions, strict=True) if len(own) < 2]
    if not single:
        return []
    return [
        f"{', '.join(single)}: one repetition, so what repetitions differ by is not known, and "
        "only noise is allowed for"
    ]


def _other_motion(
    model: RobotModel, campaigns: Sequence[LevelEstimate], called: Sequence[str]
) -> list[str]:
    first = campaigns[0].speed_rms
    found = []
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
    return found
