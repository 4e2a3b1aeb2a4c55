"""What the torque of prepared recordings says of their meaning, asked once for every use.

Whether there is gravity in it, whether there are bodies in it at all, and whether the zeros of
joints are other than those of the arm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from identification.arrays import Array
from identification.estimators.prior import body_prior, nominal_ratio, posterior_values
from identification.factor.factor import Factor
from identification.hypotheses.scores import ROWS_PER_FACT, Comparison, compare, score_of
from identification.hypotheses.search import (
    EXPLAINED,
    SEPARATE,
    Readings,
    Step,
    find_zeros_and_scales,
)
from identification.model.motion import Motion
from identification.model.nominal_masses import without_masses
from identification.model.robot import RobotModel
from identification.signals.samples import Samples

_ROWS: Final = 700
_WEIGHTLESS: Final = 0.7  # error ratio of a torque without gravity that chance does not make
_SURE: Final = 4.5  # standard errors of it
_FEWEST_ROWS: Final = 100  # that say something of bodies
_NO_ARM: Final = 1.0 / 3.0  # of the nominal torque, below which bodies are not those of the arm
_NO_BODY: Final = 0.5  # torque of bodies over that of friction where there is none of bodies


@dataclass(frozen=True, eq=False)
class RigidTorque:
    """How much of a torque is that of bodies.

    Attributes:
        scale: over that of the description's bodies; NaN where it has no masses, or of few rows.
        std: standard deviation of it.
        over_friction: torque of fitted bodies over that of fitted friction, RMS (n,).
        error: of that fit, as a share of the torque over all joints.
    """

    scale: float
    std: float
    over_friction: Array
    error: float

    @property
    def is_nothing(self) -> bool:
        """Whether it is friction, which explains it, and next to nothing of bodies.

        Torque of the motors, before the gears, is small as well, but has the arm's share of bodies.
        """
        if not np.isfinite(self.scale):
            return False
        return bool(
            self.error < EXPLAINED
            and abs(self.scale) + SEPARATE * self.std < _NO_ARM
            and self.over_friction.max(initial=0.0) < _NO_BODY
        )


@dataclass(frozen=True, eq=False)
class TorqueDiagnosis:
    """What recordings are.

    Attributes:
        weightless: error of a torque without gravity, compared with one with it; None if the model
            has none.
        rigid: how much of the torque is that of bodies, with gravity or without, as fits better.
        readings: zeros and scales other than stated; None where there is no gravity or no body in
            the torque.
    """

    weightless: Comparison | None
    rigid: RigidTorque
    readings: Readings | None

    @property
    def is_weightless(self) -> bool:
        """Whether gravity was removed from the torque."""
        found = self.weightless
        return found is not None and found.ratio < _WEIGHTLESS and found.sigmas < -_SURE

    @property
    def zeros(self) -> tuple[Step, ...]:
        """The zeros that are other than stated."""
        steps = () if self.readings is None else self.readings.steps
        return tuple(step for step in steps if step.change.meaning == "zero")


def diagnose(model: RobotModel, recordings: Sequence[Samples]) -> TorqueDiagnosis:
    """Ask what prepared recordings of one arm are, by some hundred rows of them."""
    samples = _few_rows(recordings)
    read = model
    weightless = None
    if np.any(model.gravity):
        without = model.under_gravity((0.0, 0.0, 0.0))
        weightless = compare(score_of(without, samples), score_of(model, samples), model)
        if weightless.ratio < 1.0:
            read = without
    found = TorqueDiagnosis(weightless, rigid_torque(read, samples), None)
    if found.rigid.is_nothing or found.is_weightless:
        return found
    return replace(found, readings=find_zeros_and_scales(model, samples))


def rigid_torque(model: RobotModel, samples: Samples) -> RigidTorque:
    """Return how much of the torque is that of bodies."""
    factor = Factor.of(model, samples)
    values, _ = posterior_values(factor, body_prior(model, factor).gaussian, ROWS_PER_FACT)
    friction = model.friction_columns
    powers = []
    for part in (np.where(friction, 0.0, values), np.where(friction, values, 0.0)):
        gram = factor.gram[:, :-1, :-1]
        powers.append(np.maximum(np.einsum("i,jik,k->j", part, gram, part), 0.0))
    rigid, other = np.sqrt(powers)
    over = np.where(rigid > 0.0, rigid / np.where(other > 0.0, other, np.inf), 0.0)
    over = np.where((other == 0.0) & (rigid > 0.0), np.inf, over)
    power = max(float(factor.gram[:, -1, -1].sum()), np.finfo(np.float64).tiny)
    error = float(np.sqrt(factor.squared_errors(values).sum() / power))
    is_little = samples.usable.any(axis=1).sum() < _FEWEST_ROWS or not powers[1].any()
    if without_masses(model) or is_little:
        return RigidTorque(np.nan, np.inf, over, error)
    return RigidTorque(*nominal_ratio(model, factor), over, error)


def _few_rows(recordings: Sequence[Samples]) -> Samples:
    """Return some rows of all recordings, one after the other."""
    rows = sum(len(samples.torque) for samples in recordings)
    some = [samples.thinned(max(1, rows // _ROWS)) for samples in recordings]
    if len(some) == 1:
        return some[0]
    return replace(
        some[0],
        motion=Motion.joined([samples.motion for samples in some]),
        torque=np.concatenate([samples.torque for samples in some]),
        usable=np.concatenate([samples.usable for samples in some]),
        mask=None,
    )
