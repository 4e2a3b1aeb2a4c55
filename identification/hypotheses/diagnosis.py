"""How recordings of one arm differ from what was stated, asked in one place for every command.

In this order: whether the torque contains bodies and gravity, and whether the time scale fits the
motion; then signs, orders, coupled angles, zeros and scales of joints; finally, if a fit has errors
to explain, delay, friction that grows with load, drift of a joint, and load, scale and friction of
parts of the motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from identification.arrays import Array
from identification.estimators.prior import body_prior, nominal_ratio, posterior_values
from identification.factor.factor import Factor
from identification.hypotheses.column_search import find_columns, find_columns_of_unseen
from identification.hypotheses.explanation import ExplainedFit, Explanation
from identification.hypotheses.gravity_share import has_part_of_gravity
from identification.hypotheses.inertia_scale import InertiaScale, find_inertia_scale
from identification.hypotheses.joint_changes import Change, changed_samples
from identification.hypotheses.readings import Readings, Step
from identification.hypotheses.scores import (
    EXPLAINED_ERROR,
    ROWS_PER_FACT,
    SEPARATE_SIGMAS,
    SURE_SIGMAS,
    Comparison,
    Score,
    compare,
    fits_alike,
    is_backwards,
    score_of,
)
from identification.hypotheses.search import find_readings, find_zeros_and_scales
from identification.hypotheses.springs import may_have_springs, score_with_springs
from identification.hypotheses.torque_rate import is_rate
from identification.model.motion import Motion
from identification.model.nominal_masses import mass_fault
from identification.model.robot import RobotModel
from identification.signals.samples import Samples

UNEXPLAINED: Final = 0.5
"""Error of the torque, as a share of it, above which no masses of this arm explain it."""
ROWS: Final = 700
"""Rows of all recordings in which something other than stated is searched for."""
# error ratio of a torque without gravity that chance does not make
_WEIGHTLESS_ERROR_RATIO: Final = 0.7
MIN_ERROR_GROWTH: Final = 1.25
"""Error of unseen over the error of fitted motion from which something begins in it."""
_FREE_SHARE: Final = 30.0  # standard deviation over the masses, of bodies hardly believed
_MIN_ROWS: Final = 100  # that say something of bodies
# share of the nominal torque below which the bodies are not the arm's
_MIN_NOMINAL_SCALE: Final = 1.0 / 3.0
# torque of bodies over that of friction where there is none of bodies
_MIN_BODY_TORQUE_RATIO: Final = 0.5
# Error of a joint, of its torque, up to which its sign and order are as stated, and noise floors.
_SMALL_JOINT_ERROR: Final = 0.02
_NOISE_FLOOR_FACTOR: Final = 1.05


@dataclass(frozen=True, eq=False)
class RigidTorque:
    """Share of a torque that bodies cause.

    Attributes:
        scale: over that of the description's bodies; NaN where it has no masses, or of few rows.
        std: standard deviation of it.
        over_friction: ratio of the torque of fitted bodies to fitted friction, RMS (n,).
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
            self.error < EXPLAINED_ERROR
            and abs(self.scale) + SEPARATE_SIGMAS * self.std < _MIN_NOMINAL_SCALE
            and self.over_friction.max(initial=0.0) < _MIN_BODY_TORQUE_RATIO
        )


@dataclass(frozen=True, eq=False)
class TorqueDiagnosis:
    """What recordings are.

    Attributes:
        weightless: error of a torque without gravity, compared with one with it; None if the model
            has none.
        keeps_gravity: whether a part of gravity is left in a torque that fits better without.
        is_balanced: whether springs of the joints explain such a torque as well.
        rigid: how much of the torque is that of bodies, with gravity or without, as fits better.
        readings: signs, orders, zeros and scales other than stated; None where there is no gravity
            or no body in the torque.
        explanations: changes that explain errors of a fit, the signs and orders of which nothing
            fits alike first; None where that was not asked.
        begun: changes that begin within unseen recordings.
        is_backwards: whether the rows run backwards in time.
        inertia: by how much more inertia there is for the weight than described; None where it is
            as described.
        is_rate: whether it is the rate of a torque.
        error: of the torque predicted from other parts, as a share of it, with all that was found.
        unseen_error: the same of an unseen torque by itself, where a fit does not predict it; None
            where it does.
    """

    weightless: Comparison | None
    rigid: RigidTorque
    readings: Readings | None = None
    explanations: tuple[Explanation, ...] | None = None
    begun: tuple[Explanation, ...] = ()
    is_backwards: bool = False
    inertia: InertiaScale | None = None
    is_rate: bool = False
    error: float = 0.0
    unseen_error: float | None = None
    keeps_gravity: bool = False
    is_balanced: bool = False

    @property
    def time(self) -> float | None:
        """Recorded times over true ones, where that explains the torque; else None."""
        return None if self.inertia is None else self.inertia.time

    @property
    def is_otherwise(self) -> bool:
        """Whether the torque, or its times, are other than stated as a whole."""
        is_weightless = self.is_weightless or self.is_partly_weightless
        return self.rigid.is_nothing or is_weightless or self.is_rate or self.time is not None

    @property
    def is_complete(self) -> bool:
        """Whether all that recordings are throughout was asked."""
        return self.is_otherwise or self.readings is not None

    @property
    def is_unexplained(self) -> bool:
        """Whether no masses, and nothing that was found, explain the torque."""
        return not self.is_otherwise and self.error > UNEXPLAINED

    @property
    def is_unseen_unexplained(self) -> bool:
        """Whether no masses explain an unseen torque, judged alone."""
        return self.unseen_error is not None and self.unseen_error > UNEXPLAINED

    @property
    def is_weightless(self) -> bool:
        """Whether gravity was removed from the torque."""
        return self._has_little_weight and not self.keeps_gravity

    @property
    def is_partly_weightless(self) -> bool:
        """Whether most of gravity was removed, by a model that does not fit the arm."""
        return self._has_little_weight and self.keeps_gravity

    @property
    def _has_little_weight(self) -> bool:
        """Whether the torque fits an arm without gravity, and no other times or springs do."""
        if self.time is not None or self.is_balanced:
            return False
        found = self.weightless
        return (
            found is not None
            and found.ratio < _WEIGHTLESS_ERROR_RATIO
            and found.sigmas < -SURE_SIGMAS
        )

    @property
    def steps(self) -> tuple[Step, ...]:
        """What is other than stated throughout."""
        return () if self.readings is None else self.readings.steps

    @property
    def zeros(self) -> tuple[Step, ...]:
        """The zeros that are other than stated."""
        return tuple(step for step in self.steps if step.change.meaning == "zero")

    @property
    def has_clear_zeros(self) -> bool:
        """Whether a zero is clearly other than stated, and nothing explains the torque better."""
        if self.readings is None or not self.readings.adequacy.is_enough:
            return False
        return any(step.is_clear and not step.alike for step in self.zeros)

    @property
    def discrete(self) -> tuple[Step, ...]:
        """The signs, orders and coupled angles that are other than stated."""
        return tuple(step for step in self.steps if step.change.is_discrete)


def diagnose(
    model: RobotModel,
    recordings: Sequence[Samples],
    fitted: ExplainedFit | None = None,
    unseen: Sequence[Samples] = (),
    *,
    known: TorqueDiagnosis | None = None,
    noise: Array | None = None,
) -> TorqueDiagnosis:
    """Ask what prepared recordings of one arm are, and what explains the errors of their fit.

    Args:
        model: of the arm.
        recordings: prepared.
        fitted: a fit of them; None asks only for what they are throughout.
        unseen: recordings that it predicts worse, in which something may begin.
        known: what they are throughout, where that was asked before.
        noise: standard deviation of each joint's torque noise (n,), by default that of the fit.
    """
    found = known
    if found is None:
        rows = few_rows(recordings)
        score = score_of(model, rows)
        found = torque_of(model, recordings, rows, score)
        if noise is None and fitted is not None:
            noise = fitted.noise
        found = with_readings(found, model, rows, score, noise)
    if fitted is None or found.is_otherwise:
        return found
    found = replace(found, explanations=_explained(model, recordings, fitted, found))
    if unseen and not found.explanations:
        begun = find_columns_of_unseen(model, recordings, unseen, fitted)
        found = replace(found, begun=begun)
    return found


def torque_of(
    model: RobotModel, recordings: Sequence[Samples], rows: Samples, score: Score
) -> TorqueDiagnosis:
    """Return whether bodies and gravity are in a torque, and its times and rows in order.

    Args:
        model: of the arm.
        recordings: prepared.
        rows: some of them.
        score: of these rows.
    """
    read = model
    weightless = None
    keeps_gravity = is_balanced = False
    if np.any(model.gravity):
        without = model.under_gravity((0.0, 0.0, 0.0))
        score_without = score_of(without, rows)
        weightless = compare(score_without, score, model)
        springs = None
        if weightless.ratio < 1.0:
            springs = score_with_springs(model, rows, may_have_springs(model, rows))
        is_balanced = springs is not None and fits_alike(springs, score_without, model)
        if weightless.ratio < 1.0 and not is_balanced:
            read = without
            keeps_gravity = has_part_of_gravity(model, rows, score_without)
    backwards = is_backwards(model, rows, score)
    rigid = rigid_torque(read, rows)
    found = TorqueDiagnosis(
        weightless,
        rigid,
        is_backwards=backwards,
        error=score.overall,
        keeps_gravity=keeps_gravity,
        is_balanced=is_balanced,
    )
    if found.rigid.is_nothing:
        return found
    if is_rate(model, recordings[0], score, ROWS):
        return replace(found, is_rate=True)
    if score.overall > _SMALL_JOINT_ERROR:
        found = replace(found, inertia=find_inertia_scale(model, rows, score, rigid.scale))
    return found


def with_readings(
    found: TorqueDiagnosis,
    model: RobotModel,
    rows: Samples,
    score: Score,
    noise: Array | None = None,
) -> TorqueDiagnosis:
    """Return what recordings are, with the joints that are other than stated.

    Signs and orders are searched for where the arm does not predict the rows, zeros and scales in
    any case.

    Args:
        found: that the torque is of the arm, as a whole.
        model: of the arm.
        rows: some of the recordings.
        score: of these rows.
        noise: standard deviation of each joint's torque noise (n,); None if unknown.
    """
    if found.is_otherwise:
        return found
    if _is_predicted(score, rows, noise):
        readings = find_zeros_and_scales(model, rows)
    else:
        readings = find_readings(model, rows, unit_is_open=False, with_nearest=False)
    error = unexplained_share(readings.model, readings.samples, readings.score)
    return replace(found, readings=readings, error=error)


def unexplained_share(model: RobotModel, rows: Samples, score: Score) -> float:
    """Return the error of a torque, as a share of it, that no masses and rotors explain.

    A short log, such as one in which each joint moves once, may predict none of its parts from the
    others. Masses that fit all of it explain it nevertheless.

    Args:
        model: of the arm.
        rows: of the recording.
        score: of these rows, by what is believed of the arm.
    """
    error = score.overall
    if error <= UNEXPLAINED:
        return error
    factor = Factor.of(model, rows)
    prior = body_prior(model, factor, _FREE_SHARE, wide_rotors=True).gaussian
    fitted = _relative_error(factor, posterior_values(factor, prior, ROWS_PER_FACT)[0])
    if fitted <= EXPLAINED_ERROR:
        return fitted
    free = score_of(model, rows, score.columns, wide_rotors=True, share=_FREE_SHARE)
    return min(error, free.overall)


def _is_predicted(score: Score, samples: Samples, noise: Array | None) -> bool:
    """Return whether the arm predicts all joints as well as no wrong sign or order lets it."""
    rows = samples.usable.sum(axis=0)
    floor = np.zeros(len(rows)) if noise is None else np.nan_to_num(noise)
    small = np.maximum(
        _NOISE_FLOOR_FACTOR * floor * np.sqrt(rows), _SMALL_JOINT_ERROR * np.sqrt(score.torque)
    )
    is_small = np.sqrt(score.squares.sum(axis=0)) <= small
    return bool(is_small.all()) and not score.driven.any()


def _explained(
    model: RobotModel, recordings: Sequence[Samples], fitted: ExplainedFit, found: TorqueDiagnosis
) -> tuple[Explanation, ...]:
    """Return what explains the errors of a fit, other than changes throughout the recordings."""
    certain = [step for step in found.steps if step.sure]
    discrete = [step for step in certain if step.change.is_discrete]
    undone: list[Change] = [step.change for step in certain if step.change.meaning != "scale"]
    for change in undone:
        recordings = [changed_samples(model, samples, change) for samples in recordings]
    if undone:
        factor = sum((Factor.of(model, samples) for samples in recordings), Factor.zero(model))
        prior = body_prior(model, factor).gaussian
        fitted = replace(fitted, values=posterior_values(factor, prior, ROWS_PER_FACT)[0])
    return (
        *(Explanation(step.change, step.ratio) for step in discrete),
        *find_columns(model, recordings, fitted),
    )


def explain_errors(
    model: RobotModel, samples: Samples, scale_std: Array
) -> tuple[Explanation, ...]:
    """Return what explains the errors of a fit of one recording, by itself.

    If nothing certain does, what begins in its last part, where a fit of the rest predicts that
    worse: the time is resolved more finely there.

    Args:
        model: of the arm.
        samples: of the recording, prepared.
        scale_std: relative standard deviation of each joint's torque scale (n,).
    """
    fitted, _ = _fit(model, samples, scale_std)
    found = find_columns(model, [samples], fitted)
    if found and all(each.is_certain for each in found):
        return found
    seen, unseen = samples.to_fit_and_predict()
    fitted, error = _fit(model, seen, scale_std)
    if not _relative_error(Factor.of(model, unseen), fitted.values) > MIN_ERROR_GROWTH * error:
        return found
    passed = float(unseen.motion.time[0] - samples.motion.time[0])
    begun = find_columns_of_unseen(model, [seen], [unseen], fitted)
    if found and not any(each.is_certain for each in begun):
        return found
    return tuple(_later(each, passed) for each in begun)


def _fit(model: RobotModel, samples: Samples, scale_std: Array) -> tuple[ExplainedFit, float]:
    """Return a fit of a recording, and its error as a share of the torque."""
    factor = Factor.of(model, samples)
    values, _ = posterior_values(factor, body_prior(model, factor).gaussian, ROWS_PER_FACT)
    return ExplainedFit(values, scale_std=scale_std), _relative_error(factor, values)


def _relative_error(factor: Factor, values: Array) -> float:
    power = max(float(factor.gram[:, -1, -1].sum()), np.finfo(np.float64).tiny)
    return float(np.sqrt(factor.squared_errors(values).sum() / power))


def _later(found: Explanation, passed: float) -> Explanation:
    """Return what was found in a part of a recording, of which some time had passed [s]."""
    part = found.change.part
    assert part is not None  # which begins in it
    stop = None if part.stop is None else part.stop + passed
    part = part._replace(start=part.start + passed, stop=stop)
    return found._replace(change=found.change._replace(part=part))


def rigid_torque(model: RobotModel, samples: Samples) -> RigidTorque:
    """Return the share of the torque that bodies cause."""
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
    error = _relative_error(factor, values)
    is_little = samples.usable.any(axis=1).sum() < _MIN_ROWS or not powers[1].any()
    if mass_fault(model) is not None or is_little:
        return RigidTorque(np.nan, np.inf, over, error)
    return RigidTorque(*nominal_ratio(model, factor), over, error)


def few_rows(recordings: Sequence[Samples]) -> Samples:
    """Return some rows of all recordings, one after the other."""
    rows = sum(len(samples.torque) for samples in recordings)
    some = [samples.thinned(max(1, rows // ROWS)) for samples in recordings]
    if len(some) == 1:
        return some[0]
    return replace(
        some[0],
        motion=Motion.joined([samples.motion for samples in some]),
        torque=np.concatenate([samples.torque for samples in some]),
        usable=np.concatenate([samples.usable for samples in some]),
        mask=None,
    )
