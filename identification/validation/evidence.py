"""Evidence for a verdict: errors of an estimate, their possible causes, and its signs."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.estimators.delay import DelayEstimate
from identification.estimators.friction_form import FormUncertainty
from identification.estimators.least_squares import RepeatedEstimate
from identification.factor.columns import standard_factor
from identification.factor.estimate import Estimate
from identification.factor.factor import Factor, total_factor
from identification.hypotheses.carried_load import MIN_LOAD_EXPLAINED, CarriedLoad, find_load
from identification.hypotheses.diagnosis import (
    MIN_ERROR_GROWTH,
    UNEXPLAINED,
    TorqueDiagnosis,
    diagnose,
    few_rows,
    unexplained_share,
)
from identification.hypotheses.explanation import ExplainedFit, Explanation
from identification.hypotheses.gravity_direction import GravityDirection, find_gravity
from identification.hypotheses.scores import score_of
from identification.hypotheses.sizes import ScorePrior
from identification.hypotheses.unseen_changes import (
    UnseenChange,
    beyond_constants,
    find_changes,
)
from identification.model.robot import RobotModel
from identification.signals.play import ToAndFro
from identification.signals.position_steps import PositionJump
from identification.signals.samples import Samples
from identification.validation.consistency import ConsistencyCheck
from identification.validation.controller_inertia import InertiaRatio
from identification.validation.finding import Finding, Thresholds
from identification.validation.nominal_friction import with_fitted_friction
from identification.validation.nominal_scale import NominalScale
from identification.validation.physical_signs import (
    Implausible,
    TopSpeedFriction,
    dissipation_of,
    implausibilities,
)
from identification.validation.prediction import (
    SLOW_BANDWIDTH,
    PredictionError,
    noise_floor,
    pooled_error,
    prediction_error,
    residual,
    slow_error,
)
from identification.validation.residuals import ResidualChecks, check_residuals

# Share of the rows in the rarer direction of motion below which friction and offset of a joint are
# one column: with it their correlation is 0.98.
_MIN_REVERSE_SHARE: Final = 0.01
_MAX_RECORDINGS: Final = 3  # enough recordings to determine gravity and load
_PLAUSIBLE: Final = Implausible((), ())


def repetition_noise(
    model: RobotModel, values: Array, recordings: Iterable[Samples], bandwidth: float | None = None
) -> Array:
    """Return the standard deviation of the residual between repetitions (n,) [N·m or N].

    It is compared at equal times, rounded to the sampling interval; NaN for a joint that never
    moves at the same time twice.

    Args:
        model: of the arm.
        values: parameters (p,).
        recordings: repetitions of one motion.
        bandwidth: of a low-pass of the residual [Hz].
    """
    step = 0.0
    parts = []
    for samples in recordings:
        step = step or float(np.median(np.diff(samples.motion.time)))
        index = np.rint((samples.motion.time - samples.origin) / step).astype(np.int64)
        rows, joints = np.nonzero(samples.usable & (index >= 0)[:, None])
        error = residual(model, values, samples, bandwidth)
        parts.append((index[rows], joints, error[rows, joints]))
    length = max((int(index.max(initial=-1)) for index, _, _ in parts), default=-1) + 1
    table = np.full((len(parts), length, model.n_joints), np.nan)
    for repetition_row, (index, joints, error) in zip(table, parts, strict=True):
        repetition_row[index, joints] = error
    count = np.count_nonzero(~np.isnan(table), axis=0)
    shared = count >= 2
    mean = np.nansum(table, axis=0) / np.maximum(count, 1)
    spread = np.where(shared, np.nansum((table - mean) ** 2, axis=0), 0.0).sum(axis=0)
    freedom = np.where(shared, count - 1.0, 0.0).sum(axis=0)
    return np.asarray(np.sqrt(spread / np.where(freedom > 0.0, freedom, np.nan)))


@dataclass(frozen=True, eq=False)
class CellContext:
    """Data on the cell in addition to its model; None where unknown."""

    torque_limit: Array | None = None  # of each joint (n,) [N·m or N], NaN where unknown
    saturated: Array | None = None  # share of samples at the limit of torque or current (n,)
    motor_from_joint: Array | None = None  # motor angle per joint angle (n, n)
    controller: PredictionError | None = None  # error of its dynamic model on the unseen motion
    delays: DelayEstimate | None = None  # of the recorded torque relative to the position
    assumed_delay: float = 0.0  # in the fit [s]
    nominal_scale: NominalScale | None = None  # ratio of measured to nominal inertial torque
    jumps: tuple[PositionJump, ...] = ()  # impossible steps of measured positions
    play: tuple[ToAndFro, ...] = ()  # steps of positions to and fro where the load reverses
    controller_inertia: InertiaRatio | None = None  # its diagonal inertia over the identified one
    corrections: tuple[Finding, ...] = ()  # faults of recordings that were corrected
    #: whether the positions are commands, which the arm follows late
    commanded_positions: bool = False
    added_friction: tuple[str, ...] = ()  # symbols of friction terms that were chosen, not stated
    scale_std: Array | None = None  # relative uncertainty of each joint's torque scale (n,)


@dataclass(frozen=True, eq=False)
class Evidence:
    """Input of a verdict; None is what was not measured or tested."""

    estimate: Estimate  #: the result
    held_out: PredictionError  #: error on motion that was not fitted
    training: PredictionError  #: error on the fitted motion
    #: error on unseen motion below 10 Hz beyond noise and temperature-dependent friction, as a
    #: share of the torque (n,); NaN for a joint that was not tested, None without repetitions
    systematic: Array | None = None
    systematic_without_friction: Array | None = None  #: the same without any change of friction
    #: largest relative change of friction on an unseen motion (n,); None likewise
    friction_change: Array | None = None
    #: torque noise (n,) [N·m or N]: residual above the bandwidth of the motion, and differences
    #: between repetitions
    noise_floor: Array | None = None
    #: largest torque difference of a repetition's estimate to the pooled one, as a share of the
    #: torque (n,); None without repetitions
    disagreement: Array | None = None
    #: deviation of the predicted unseen torque by the covariance, as a share of the torque over
    #: all axes; None if parameters are undetermined, or nothing was held out
    open_share: float | None = None
    #: joints whose torque or friction on unseen motion differs from the fitted motion
    changes: tuple[UnseenChange, ...] = ()
    #: joints that moved in one direction only on the fitted motion (n,); None if not tested
    one_way: NDArray[np.bool_] | None = None
    #: what the fitted recordings are, and what explains their errors; None if not asked
    diagnosis: TorqueDiagnosis | None = None
    gravity: GravityDirection | None = None  #: the direction of gravity that fits best
    load: CarriedLoad | None = None  #: body on the last link in unseen motion only
    #: error of the nominal (CAD) model on the same unseen motion
    nominal: PredictionError | None = None
    #: the same with the friction of the fitted motion
    nominal_with_friction: PredictionError | None = None
    implausible: Implausible = _PLAUSIBLE  #: physically impossible signs of the estimate
    consistency: ConsistencyCheck | None = None  #: with the nearest consistent parameters
    dissipation: TopSpeedFriction | None = None  #: friction of each joint at its top speed
    residuals: ResidualChecks | None = None  #: patterns of the residual
    form: FormUncertainty | None = None  #: whether the friction law of a joint lacks a term
    context: CellContext = CellContext()  #: data on the cell
    prismatic: tuple[int, ...] = ()  #: indices of the joints that slide
    moved: Array | None = None  #: time in which each joint moved in unseen motion (n,) [s]
    #: whether nothing was held out, so that all errors are on fitted motion
    in_sample: bool = False

    def revolute(self, joint: int) -> bool:
        """Return whether a joint is revolute, with torque in N·m, else N."""
        return joint not in self.prismatic

    @property
    def unfitted(self) -> NDArray[np.bool_]:
        """Joints with rows of held-out motion only (n,)."""
        return np.asarray((self.training.rows == 0) & (self.held_out.rows > 0))

    @property
    def explanations(self) -> tuple[Explanation, ...] | None:
        """Changes that explain the errors of the fit; None if not searched for."""
        return None if self.diagnosis is None else self.diagnosis.explanations

    @property
    def floor(self) -> float | None:
        """Noise floor over all axes as a share of the held-out torque; None if not measured."""
        if self.noise_floor is None:
            return None
        power = float(self.held_out.torque_squared.sum())
        noise = float((np.nan_to_num(self.noise_floor) ** 2 * self.held_out.rows).sum())
        return float(np.sqrt(noise / power)) if power > 0.0 else None

    @property
    def noise_relative(self) -> Array | None:
        """Noise floor of each joint as a share of its held-out torque (n,); None: not measured."""
        if self.noise_floor is None:
            return None
        torque = self.held_out.torque_rms
        return np.where(
            torque > 0.0, self.noise_floor / np.where(torque > 0.0, torque, 1.0), np.nan
        )

    def allowed(self, limits: Thresholds) -> float:
        """Return the error over all axes, as a share of the torque, up to which a model is good."""
        return max(limits.overall, limits.noise * (self.floor or 0.0))


def _implausible(
    model: RobotModel,
    estimate: Estimate,
    unseen: Factor,
    error: PredictionError,
    speed: Array,
    context: CellContext,
) -> Implausible:
    added = context.added_friction
    return implausibilities(model, estimate, unseen, error.rms, speed=speed, added=added)


def _gravity_and_load(
    model: RobotModel, training: Sequence[Samples], held_out: Sequence[Samples]
) -> tuple[GravityDirection, CarriedLoad]:
    """Fit gravity and a carried load by sums that are large, and not needed afterwards."""
    training = training[:_MAX_RECORDINGS]
    held_out = held_out[:_MAX_RECORDINGS]
    sums = [standard_factor(model, some) for some in (training, held_out)]
    return find_gravity(model, *sums), find_load(model, training, held_out, *sums)


def gather(
    model: RobotModel,
    result: RepeatedEstimate,
    training: Sequence[Samples],
    held_out: Sequence[Samples],
    *,
    same_motion: bool = True,
    nominal: Array | None = None,
    context: CellContext = CellContext(),
    in_sample: bool = False,
    names: Sequence[str] = (),
    unseen: Factor | None = None,
    prior: ScorePrior | None = None,
    known: TorqueDiagnosis | None = None,
) -> Evidence:
    """Collect the evidence for a verdict; every recording is read a few times.

    Args:
        model: of the arm.
        result: estimates from all recordings and from each.
        training: recordings that were fitted, in the order of the result.
        held_out: recordings of unseen motion.
        same_motion: whether the training repeats one motion; noise is measured then.
        nominal: parameters (p,).
        context: data on the cell.
        in_sample: whether the held-out motions are the training.
        names: of the training.
        unseen: sum of the factors of the held-out motions, if known.
        prior: of the arm.
        known: what the training is throughout, where that was asked before.
    """
    pooled, values = result.pooled, result.pooled.values
    unseen = total_factor(model, held_out) if unseen is None else unseen
    gravity, load = _gravity_and_load(model, training, held_out)
    noise = _noise(model, result, training) if same_motion else None
    floor = noise_floor(model, values, training[:_MAX_RECORDINGS], noise)
    error, fitted = (_error(model, values, runs) for runs in (held_out, training))
    slow = None if noise is None else _slow_errors(model, result, held_out, error, unseen, noise)
    speed = np.max([np.abs(run.motion.velocity).max(axis=0) for run in held_out], axis=0)
    others, motors = (() if in_sample else held_out), context.motor_from_joint
    moved = _total_time_moved(training) >= Thresholds().moved
    fit = ExplainedFit(values, floor, names, prior, context.scale_std)
    changes = find_changes(model, pooled, training, others, unseen, moved) if others else ()
    is_worse = (
        error.overall > MIN_ERROR_GROWTH * fitted.overall
        and load.explained < MIN_LOAD_EXPLAINED
        and not changes
    )
    diagnosis = diagnose(model, training, fit, others if is_worse else (), known=known)
    return Evidence(
        estimate=pooled,
        held_out=error,
        training=fitted,
        systematic=None if slow is None else slow.beyond_noise,
        systematic_without_friction=None if slow is None else slow.without_friction,
        friction_change=None if slow is None else np.where(moved, slow.friction_change, 0.0),
        noise_floor=floor,
        open_share=None if in_sample else _open_share(pooled, unseen),
        disagreement=None if noise is None else _disagreement(result),
        changes=beyond_constants(changes, diagnosis.explanations or ()),
        one_way=_one_way(training),
        diagnosis=_with_unseen(diagnosis, model, others, error.overall),
        gravity=gravity,
        load=load,
        nominal=None if nominal is None else _error(model, nominal, held_out),
        nominal_with_friction=_with_friction(model, nominal, result.factor, held_out),
        implausible=_implausible(model, pooled, unseen, error, speed, context),
        dissipation=dissipation_of(model, pooled, speed),
        residuals=check_residuals(
            model, values, training, others, same_motion=same_motion, motor_from_joint=motors
        ),
        context=context,
        in_sample=in_sample,
        prismatic=tuple(np.flatnonzero(~model.chain.revolute).tolist()),
        moved=_total_time_moved(held_out),
    )


def _with_unseen(
    found: TorqueDiagnosis, model: RobotModel, unseen: Sequence[Samples], error: float
) -> TorqueDiagnosis:
    """Return a diagnosis, with a separate one of unseen recordings if a fit is far off."""
    if not unseen or error < UNEXPLAINED:
        return found
    rows = few_rows(unseen)
    return replace(found, unseen_error=unexplained_share(model, rows, score_of(model, rows)))


def _with_friction(
    model: RobotModel, nominal: Array | None, factor: Factor, held_out: Sequence[Samples]
) -> PredictionError | None:
    """Return the error of nominal parameters (p,) with fitted friction, None without them."""
    if nominal is None:
        return None
    return _error(model, with_fitted_friction(model, nominal, factor), held_out)


def _noise(
    model: RobotModel, result: RepeatedEstimate, training: Sequence[Samples]
) -> Array | None:
    """Return the noise (n,) between repetitions of one motion; None of a single one."""
    if len(result.values) < 2:
        return None
    return repetition_noise(model, result.pooled.values, training, SLOW_BANDWIDTH)


def _total_time_moved(runs: Sequence[Samples]) -> Array:
    return np.asarray(np.sum([*map(_time_moved, runs)], axis=0))


def _time_moved(run: Samples) -> Array:
    """Return the time in which each joint moves in a recording (n,) [s]."""
    steps = np.diff(run.motion.time)
    step = float(np.median(steps)) if steps.size else 0.0
    return np.asarray(step * np.count_nonzero(run.usable, axis=0))


def _error(model: RobotModel, values: Array, recordings: Sequence[Samples]) -> PredictionError:
    return pooled_error(prediction_error(model, values, recordings))


class _SlowErrors(NamedTuple):
    """Errors on held-out motion below 10 Hz, see :class:`Evidence`."""

    beyond_noise: Array  # (n,)
    without_friction: Array  # (n,)
    friction_change: Array  # (n,)


def _slow_errors(
    model: RobotModel,
    result: RepeatedEstimate,
    held_out: Sequence[Samples],
    error: PredictionError,
    unseen: Factor,
    noise: Array,
) -> _SlowErrors:
    """Return the slow part of an error, as a share of the torque, beyond the noise (n,)."""
    values = result.pooled.values
    slow = [slow_error(model, values, run, SLOW_BANDWIDTH) for run in held_out]
    changes = np.array([run.friction_change for run in slow])
    largest = np.abs(changes).argmax(axis=0)[None]
    # Two standard deviations of the estimate are no error.
    explained = noise**2 + (2.0 * _estimation_noise(result, unseen)) ** 2
    tested = error.rows > 0

    def beyond_noise(errors: Iterable[PredictionError]) -> Array:
        excess = np.sqrt(np.maximum(pooled_error(errors).rms ** 2 - explained, 0.0))
        return np.where(tested, excess / np.where(tested, error.torque_rms, 1.0), np.nan)

    return _SlowErrors(
        beyond_noise(run.error for run in slow),
        beyond_noise(run.apart for run in slow),
        np.take_along_axis(changes, largest, axis=0)[0],
    )


def _one_way(recordings: Sequence[Samples]) -> NDArray[np.bool_]:
    """Return which joints moved in one direction only (n,)."""
    velocities = [np.where(run.usable, run.motion.velocity, 0.0) for run in recordings]
    directions = [
        [np.count_nonzero(sign * v > 0.0, axis=0) for v in velocities] for sign in (1.0, -1.0)
    ]
    forwards, backwards = np.array(directions).sum(axis=1)
    fewer = np.minimum(forwards, backwards)
    moved = forwards + backwards
    return np.asarray((moved > 0) & (fewer < _MIN_REVERSE_SHARE * moved))


def _disagreement(result: RepeatedEstimate) -> Array:
    """Return the largest torque difference of repetitions to the pooled estimate (n,)."""
    gram = result.factor.gram
    differences = result.values - result.pooled.values
    torque = np.einsum("ri,jik,rk->rj", differences, gram[:, :-1, :-1], differences)
    share = np.maximum(torque, 0.0) / np.maximum(gram[:, -1, -1], 1e-300)
    return np.asarray(np.sqrt(share.max(axis=0)))


def _open_share(estimate: Estimate, unseen: Factor) -> float | None:
    """Return the deviation of predicted torque by the covariance, over the torque, of all axes."""
    torque = float(unseen.gram[:, -1, -1].sum())
    if not torque or not np.all(np.isfinite(estimate.covariance)):
        return None
    columns = unseen.gram[:, :-1, :-1].sum(axis=0)
    return float(np.sqrt(max(0.0, np.vdot(columns, estimate.covariance) / torque)))


def _estimation_noise(result: RepeatedEstimate, held_out: Factor) -> Array:
    """Return the standard deviation (n,) of predicted torque by scatter of the estimates."""
    differences = result.values - result.mean
    count = len(differences)
    torque = np.einsum("ri,jik,rk->j", differences, held_out.gram[:, :-1, :-1], differences)
    variance = torque / (count * (count - 1)) / np.maximum(held_out.samples, 1)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))
