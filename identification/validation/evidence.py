"""What a verdict on an estimate is given on: its errors, where they come from, and its signs."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import scipy
from numpy.typing import NDArray

from identification.errors import IdentificationError
from identification.estimators.delay import DelayEstimate
from identification.estimators.least_squares import RepeatedEstimate
from identification.estimators.payload import Run, mass_difference
from identification.excitation.criteria import (
    coupling_index,
    coupling_index_max,
    information,
)
from identification.factor.factor import Estimate, Factor, total
from identification.factor.standard_gram import StandardGram, gravity_loads, solve, squared_errors
from identification.model.regressor import LINK_SYMBOLS
from identification.model.robot import RobotModel
from identification.signals.noise import noiseless_above
from identification.signals.samples import Samples
from identification.validation.causes import Causes, find_causes
from identification.validation.finding import Finding, Thresholds
from identification.validation.nominal_scale import InertiaRatio, NominalScale
from identification.validation.plausibility import Implausible, implausibilities
from identification.validation.position_jumps import PositionJump
from identification.validation.prediction import (
    PredictionError,
    over_all,
    prediction_error,
    residual,
    slow_error,
)
from identification.validation.residuals import ResidualChecks, check_residuals

Array = NDArray[np.float64]

_STANDARD: Final = 9.81  # m/s²
_PASSES: Final = 2


@dataclass(frozen=True, eq=False)
class GravityDirection:
    """The direction of gravity that fits the recordings best.

    An arm on a wall or a tilted base, described as upright, spoils every axis that gravity loads,
    and looks like many wrong torque constants at once.

    Attributes:
        declared: gravity of the model (3,) [m/s²].
        best: gravity that fits the training motion best, of the same size (3,) [m/s²].
        ratio: squared error on unseen motion under `best` over that under `declared`: the
            geometric mean over the joints that moved.
    """

    declared: Array
    best: Array
    ratio: float

    def off(self, ratio: float, degrees: float) -> bool:
        """Whether the declared direction is wrong: less error elsewhere, and not just beside it."""
        return self.ratio < ratio and float(np.degrees(self.angle)) > degrees

    @property
    def angle(self) -> float:
        """Between the two [rad]; zero where none is declared."""
        size = float(np.linalg.norm(self.declared) * np.linalg.norm(self.best))
        if size == 0.0:
            return 0.0
        return float(np.arccos(np.clip(self.declared @ self.best / size, -1.0, 1.0)))


def find_gravity(
    model: RobotModel, training: StandardGram, held_out: StandardGram
) -> GravityDirection:
    """Fit the training motion under all directions of gravity, and predict the held-out one.

    The best of six directions along the base's axes and the declared one is refined.
    """
    size = float(np.linalg.norm(model.gravity)) or _STANDARD
    starts = [model.gravity, *(size * sign * axis for axis in np.eye(3) for sign in (1.0, -1.0))]
    first = min(starts, key=lambda gravity: _misfit(training, gravity))
    if not np.any(first):
        return GravityDirection(model.gravity, model.gravity, 1.0)
    across = np.linalg.svd(first[None, :])[2][1:]

    def pulled(tilt: Array) -> Array:
        direction = first / size + tilt @ across
        return np.asarray(size * direction / np.linalg.norm(direction))

    found = scipy.optimize.minimize(
        lambda tilt: _misfit(training, pulled(tilt)),
        np.zeros(2),
        method="Nelder-Mead",
        options={
            "initial_simplex": [[0.0, 0.0], [0.2, 0.0], [0.0, 0.2]],
            "xatol": 1e-3,
            "fatol": 1e-3,
            "maxfev": 80,
        },
    )
    best = pulled(found.x)
    as_is, other = (_unseen(training, held_out, gravity) for gravity in (model.gravity, best))
    counts = held_out.rows > 0
    change = np.log(np.maximum(other, 1e-300)) - np.log(np.maximum(as_is, 1e-300))
    ratio = float(np.exp(change[counts].mean())) if counts.any() else 1.0
    return GravityDirection(model.gravity, best, ratio)


def _fitted(gram: Array, rows: Array) -> Array:
    """Parameters under one gravity, each joint weighted by its own residual."""
    errors = gram[:, -1, -1]
    values = np.zeros(gram.shape[1] - 1)
    for _ in range(_PASSES):
        weights = np.where(rows > 0, rows / np.maximum(errors, 1e-12 * gram[:, -1, -1] + 1e-300), 0)
        values = solve(gram, weights)
        errors = squared_errors(gram, values)
    return values


def _misfit(training: StandardGram, gravity: Array) -> float:
    """Twice the negative logarithm of the likelihood, noise variances concentrated out."""
    gram = training.under(gravity)
    errors = squared_errors(gram, _fitted(gram, training.rows))
    floor = 1e-12 * gram[:, -1, -1] + 1e-300
    return float(training.rows @ np.log(np.maximum(errors, floor)))


def _unseen(training: StandardGram, held_out: StandardGram, gravity: Array) -> Array:
    values = _fitted(training.under(gravity), training.rows)
    gram = held_out.under(gravity)
    return np.maximum(squared_errors(gram, values), 1e-12 * gram[:, -1, -1])


@dataclass(frozen=True, eq=False)
class Repeatability:
    """Residual of R repetitions of one motion, split in two.

    Attributes:
        noise: standard deviation between repetitions at equal times (n,) [N·m or N]: no model
            can predict it. NaN for a joint that never moves twice at the same time.
        systematic: root mean square of what all repetitions have in common (n,) [N·m or N]: what
            the model gets wrong. Zero where noise can explain it.
        repetitions: R.
    """

    noise: Array
    systematic: Array
    repetitions: int


def repeatability(
    model: RobotModel,
    values: Array,
    recordings: Iterable[Samples],
    bandwidth: float | None = None,
) -> Repeatability:
    """Split the residual of repetitions of one motion; samples are read once, one at a time.

    Times are compared to the nearest sampling interval since each recording's origin; on a
    controller's clock that is exact.

    Args:
        model: the robot.
        values: parameters (p,).
        recordings: two repetitions or more.
        bandwidth: of a low-pass on the residual [Hz]; None for none.

    Raises:
        IdentificationError: fewer than two repetitions, or no row that two of them share.
    """
    step, parts = 0.0, []
    for samples in recordings:
        step = step or float(np.median(np.diff(samples.motion.time)))
        index = np.rint((samples.motion.time - samples.origin) / step).astype(np.int64)
        rows, joints = np.nonzero(samples.usable & (index >= 0)[:, None])
        left = residual(model, values, samples, bandwidth)
        parts.append((index[rows], joints, left[rows, joints]))
    length = max((int(index.max(initial=-1)) for index, _, _ in parts), default=-1) + 1
    table = np.full((len(parts), length, model.n_joints), np.nan)
    for own, (index, joints, left) in zip(table, parts, strict=True):
        own[index, joints] = left
    count = np.count_nonzero(~np.isnan(table), axis=0)
    shared = count >= 2
    rows = np.count_nonzero(shared, axis=0)
    if len(parts) < 2 or not rows.any():
        raise IdentificationError(
            "what repeats cannot be distinguished from noise: it takes two repetitions in which"
            f" joints move at the same times, here are {len(parts)} with {rows.tolist()} common"
            " rows per joint"
        )
    mean = np.nansum(table, axis=0) / np.maximum(count, 1)
    spread = np.nansum((table - mean) ** 2, axis=0)
    divisor = np.where(rows > 0, rows, np.nan)  # of a joint without common rows nothing is known
    freedom = np.where(rows > 0, np.where(shared, count - 1.0, 0.0).sum(axis=0), np.nan)
    noise = np.where(shared, spread, 0.0).sum(axis=0) / freedom
    # The mean over repetitions still holds its share of the noise.
    common = np.where(shared, mean**2 - noise / np.maximum(count, 1), 0.0).sum(axis=0) / divisor
    return Repeatability(np.sqrt(noise), np.sqrt(np.maximum(common, 0.0)), len(parts))


# A joint's error is beyond that of the fit if its power is this many times larger.
_GROWN: Final = 4.0


@dataclass(frozen=True)
class CarriedLoad:
    """A body on the last link that the unseen motion asks for and the fitted one does not.

    Attributes:
        mass: how much more the arm carried there [kg].
        half_interval: of that, 95 % [kg]; infinite where nobody computed it, or nothing determines
            it.
        explained: share of the error on unseen motion, beyond that of the fit, that it explains.
        axes: number of joints whose error is far beyond that of the fit.
    """

    mass: float
    explained: float
    axes: int
    half_interval: float = np.inf


def weigh_load(
    model: RobotModel, training: Sequence[Samples], held_out: Sequence[Samples], found: CarriedLoad
) -> CarriedLoad:
    """The load with its interval: fitted again with friction that drifts between recordings."""
    try:
        runs = [
            Run.of(str(k), model, samples, None, loaded=loaded)
            for loaded, some in ((False, training), (True, held_out))
            for k, samples in enumerate(some)
        ]
        mass, _, high = mass_difference(model, runs)
    except IdentificationError:
        return found
    return replace(found, mass=mass, half_interval=high - mass) if np.isfinite(high) else found


def find_load(model: RobotModel, training: StandardGram, held_out: StandardGram) -> CarriedLoad:
    """Fit the training motion, and then ten more parameters of the last link to the unseen one."""
    seen, unseen = training.under(model.gravity), held_out.under(model.gravity)
    power = np.maximum(seen[:, -1, -1], 1e-300)
    values = solve(seen, training.rows / power)
    # The error of the fit in as many rows as were predicted.
    floor = 1e-12 * unseen[:, -1, -1] + 1e-300
    share = held_out.rows / np.maximum(training.rows, 1.0)
    usual = squared_errors(seen, values) * share
    weights = held_out.rows / np.maximum(usual, floor)
    before = squared_errors(unseen, values)
    last = model.layout.links[-1]
    n, k = len(unseen), len(last)
    # Of [last link | what the fit leaves over].
    gram = np.empty((n, k + 1, k + 1))
    gram[:, :k, :k] = unseen[:, last[:, None], last[None, :]]
    gram[:, :k, k] = unseen[:, last, -1] - unseen[:, last, :-1] @ values
    gram[:, k, :k] = gram[:, :k, k]
    gram[:, k, k] = before
    body = solve(gram, weights)
    after = squared_errors(gram, body)
    beyond = weights @ np.maximum(before - usual, 0.0)
    return CarriedLoad(
        mass=float(body[LINK_SYMBOLS.index("m")]),
        explained=float(weights @ (before - after) / beyond) if beyond > 0.0 else 0.0,
        axes=int(np.count_nonzero(before > _GROWN * np.maximum(usual, floor))),
    )


# Bandwidth in which a rigid arm makes its torque [Hz]; ripple and current noise lie above it,
# every error of sign, coupling or constant below.
SLOW: Final = 10.0
SIGMAS: Final = 3.0
_POSTURES: Final = 40
# A few recordings of each kind decide on gravity and load as well as all.
_MOST_RECORDINGS: Final = 3
_PLAUSIBLE: Final = Implausible((), ())


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What is known of the cell beside its model; None throughout where nothing is.

    Attributes:
        torque_limit: largest torque of each joint (n,) [N·m or N], NaN where unknown.
        saturated: share of each joint's samples at the limit of torque or current (n,).
        motor_from_joint: motor angle per joint angle (n, n).
        controller: error of the controller's own dynamic model on the unseen motion.
        delays: of the torque behind the position, as the recordings have them.
        nominal_scale: measured torque over that of the nominal inertias, axis by axis.
        jumps: steps of the measured positions that no arm makes.
        controller_inertia: the controller's own diagonal inertia over the model's.
        assumed_delay: what the fit took that delay to be, of all axes or of each (n,) [s].
        mended: what was wrong with the recordings and is made good in what was fitted.
    """

    torque_limit: Array | None = None
    saturated: Array | None = None
    motor_from_joint: Array | None = None
    controller: PredictionError | None = None
    delays: DelayEstimate | None = None
    assumed_delay: float | Array = 0.0
    nominal_scale: NominalScale | None = None
    jumps: tuple[PositionJump, ...] = ()
    controller_inertia: InertiaRatio | None = None
    mended: tuple[Finding, ...] = ()


@dataclass(frozen=True)
class CouplingIndex:
    """How far the estimates of the parameters move together (paper, eq. 5).

    Attributes:
        index: I_c of the fitted rows, infinite where they leave a parameter undetermined.
        largest: I_c,max of as many parameters.
    """

    index: float
    largest: float


@dataclass(frozen=True, eq=False)
class Evidence:
    """What a verdict is given on.

    Attributes:
        estimate: the result.
        held_out: its error on motion that was not used for fitting.
        training: its error on the motion it was fitted to.
        held_out_slow: as `held_out`, with the error low-passed and apart from a change of
            friction; None where there are no repetitions to tell noise from error.
        held_out_apart: the same apart from all change of friction, not only from what warm gears
            excuse; None likewise.
        friction_change: share by which friction was higher on an unseen motion than estimated,
            of all motions the one with the largest change, per joint (n,); None likewise.
        slow: what repeats and what does not of the low-passed residual; None likewise.
        noise_floor: what no model can predict of the torque (n,) [N·m or N]: the residual above
            the band of the motion, and what differs between repetitions; None if not measured.
        estimation_noise: standard deviation of the predicted torque on the unseen motion because
            the parameters come from noisy data, from the scatter over the repetitions (n,)
            [N·m or N]; None likewise.
        disagreement: of the repetitions' own estimates with the pooled one, the worst of them,
            as a share of each axis's torque (n,); None without repetitions.
        causes: faults that explain errors of the fit, None if they were not looked for.
        gravity: the direction of gravity that fits best, None if it was not looked for.
        load: a body that the arm seems to carry on unseen motion only, None likewise.
        loaded: joints that gravity can load (n,), None if that was not looked at.
        nominal: error of the nominal (CAD) model on the same unseen motion, None without one.
        implausible: what is physically impossible about the estimate.
        residuals: what is left over, looked at from all sides; None if it was not.
        coupling: of the parameters' estimates; None if it was not computed.
        surroundings: limits, saturation and the controller's own model.
        prismatic: indices of the joints that slide.
        tested_on: what the unseen motion was, in words.
        in_sample: whether nothing was held out, so that all errors are those of the fit.
    """

    estimate: Estimate
    held_out: PredictionError
    training: PredictionError
    held_out_slow: PredictionError | None = None
    held_out_apart: PredictionError | None = None
    friction_change: Array | None = None
    slow: Repeatability | None = None
    noise_floor: Array | None = None
    estimation_noise: Array | None = None
    disagreement: Array | None = None
    causes: Causes | None = None
    gravity: GravityDirection | None = None
    load: CarriedLoad | None = None
    loaded: NDArray[np.bool_] | None = None
    nominal: PredictionError | None = None
    implausible: Implausible = _PLAUSIBLE
    residuals: ResidualChecks | None = None
    coupling: CouplingIndex | None = None
    surroundings: Surroundings = Surroundings()
    prismatic: tuple[int, ...] = ()
    tested_on: str = "unseen motion"
    in_sample: bool = False

    def revolute(self, joint: int) -> bool:
        """Whether a joint turns; its torque is in N·m then, else in N."""
        return joint not in self.prismatic

    @property
    def systematic(self) -> Array | None:
        """Slow error on unseen motion that no noise explains, as a share of the torque (n,).

        Explained are the torque noise and, up to two standard deviations, what it has done to
        the parameters. NaN for a joint that was not tested.
        """
        return self._beyond_noise(self.held_out_slow)

    def spoilt_by_friction(self, limit: float) -> NDArray[np.bool_]:
        """Joints (n,) whose systematic error is beyond a limit, and only by change of friction."""
        share = self.systematic
        if share is None:
            return np.zeros(len(self.held_out.rows), dtype=np.bool_)
        return np.asarray((np.nan_to_num(share) > limit) & ~self.beyond_friction(limit))

    def beyond_friction(self, limit: float) -> NDArray[np.bool_]:
        """Joints (n,) whose systematic error is beyond a limit whatever friction did."""
        share = self._beyond_noise(self.held_out_apart)
        if share is None:
            share = self.systematic
        if share is None:
            return np.zeros(len(self.held_out.rows), dtype=np.bool_)
        return np.asarray(np.nan_to_num(share) > limit)

    def _beyond_noise(self, slow_error: PredictionError | None) -> Array | None:
        if slow_error is None or self.slow is None or self.estimation_noise is None:
            return None
        explained = self.slow.noise**2 + (2.0 * self.estimation_noise) ** 2
        excess = np.maximum(slow_error.rms**2 - explained, 0.0)
        tested = self.held_out.rows > 0
        return np.where(
            tested,
            np.sqrt(excess) / np.where(tested, self.held_out.torque_rms, 1),
            np.nan,
        )

    @property
    def floor(self) -> float | None:
        """Noise floor over all axes, as a share of the held-out torque; None if not measured."""
        if self.noise_floor is None:
            return None
        error = self.held_out
        power = float(error.torque_squared.sum())
        noise = float((np.nan_to_num(self.noise_floor) ** 2 * error.rows).sum())
        return float(np.sqrt(noise / power)) if power > 0.0 else None

    @property
    def share_of_limit(self) -> Array | None:
        """RMS error on unseen motion over the joint's torque limit (n,); None without limits."""
        limit = self.surroundings.torque_limit
        return None if limit is None else np.asarray(self.held_out.rms / limit)


def gather(
    model: RobotModel,
    result: RepeatedEstimate,
    training: Sequence[Samples],
    held_out: Sequence[Samples],
    *,
    same_motion: bool = True,
    nominal: Array | None = None,
    surroundings: Surroundings = Surroundings(),
    in_sample: bool = False,
    names: Sequence[str] = (),
) -> Evidence:
    """Collect the evidence for a verdict; every recording is read a few times.

    Args:
        model: the robot.
        result: from the training recordings.
        training: as many recordings as the result has.
        same_motion: whether these are repetitions of one motion; only then can what repeats be
            distinguished from noise.
        held_out: motions that were not used for fitting.
        nominal: parameters (p,) of the nominal model.
        surroundings: what is known of the cell beside its model.
        in_sample: whether the held-out motions are those of the training after all.
        names: of the training recordings.

    Raises:
        IdentificationError: nothing was held out.
    """
    if not held_out:
        raise IdentificationError("there is no motion left that was not used for fitting")
    values = result.pooled.values
    repeated = same_motion and len(result.repetitions) > 1
    velocity = np.concatenate([run.motion.velocity for run in held_out])
    position = np.concatenate([run.motion.position for run in held_out])
    unseen = total([Factor.of(model, run) for run in held_out])
    error = over_all(prediction_error(model, values, held_out))
    grams = [StandardGram.of(model, some[:_MOST_RECORDINGS]) for some in (training, held_out)]
    carried = find_load(model, *grams)
    if carried.explained > Thresholds().load:
        few, unseen_few = training[:_MOST_RECORDINGS], held_out[:_MOST_RECORDINGS]
        carried = weigh_load(model, few, unseen_few, carried)
    steady = repeatability(model, values, training, SLOW) if repeated else None
    slow_errors = [slow_error(model, values, run, SLOW) for run in held_out if repeated]
    change = None  # of each joint the largest
    if slow_errors:
        changes = np.array([one.friction_change for one in slow_errors])
        change = np.take_along_axis(changes, np.abs(changes).argmax(axis=0)[None], axis=0)[0]
    gram = information(result.factor)
    postures = position[:: max(1, len(position) // _POSTURES)]
    return Evidence(
        estimate=result.pooled,
        held_out=error,
        training=over_all(prediction_error(model, values, training)),
        held_out_slow=over_all(one.error for one in slow_errors) if repeated else None,
        held_out_apart=over_all(one.apart for one in slow_errors) if repeated else None,
        friction_change=change,
        slow=steady,
        noise_floor=_noise_floor(model, values, training[:_MOST_RECORDINGS], SLOW, steady),
        estimation_noise=_estimation_noise(result, unseen) if repeated else None,
        disagreement=_disagreement(result) if repeated else None,
        causes=find_causes(model, training, values, names),
        gravity=find_gravity(model, *grams),
        load=carried,
        loaded=gravity_loads(model, postures),
        nominal=None if nominal is None else over_all(prediction_error(model, nominal, held_out)),
        implausible=implausibilities(
            model,
            result.pooled,
            unseen,
            error.rms,
            position=postures,
            speed=np.abs(velocity).max(axis=0),
        ),
        residuals=check_residuals(
            model,
            values,
            training,
            () if in_sample else held_out,
            same_motion=same_motion,
            motor_from_joint=surroundings.motor_from_joint,
        ),
        coupling=CouplingIndex(float(coupling_index(gram)), coupling_index_max(len(gram))),
        surroundings=surroundings,
        in_sample=in_sample,
        prismatic=tuple(np.flatnonzero(~model.chain.revolute).tolist()),
    )


def _noise_floor(
    model: RobotModel,
    values: Array,
    recordings: Sequence[Samples],
    bandwidth: float,
    steady: Repeatability | None,
) -> Array | None:
    """Standard deviation of the noise of each joint's torque (n,), NaN of one without rows.

    White noise of the power that the residual has above the bandwidth, and what differs between
    repetitions below it. None where a low-pass has left no noise to measure.
    """
    first = recordings[0]
    if steady is None and noiseless_above(first.motion.time, first.torque, first.segments):
        return None
    squares, rows = np.zeros((2, model.n_joints))
    for samples in recordings:
        fast = residual(model, values, samples) - residual(model, values, samples, bandwidth)
        nyquist = 0.5 / float(np.median(np.diff(samples.motion.time)))
        share = max(1.0 - bandwidth / nyquist, 0.5)  # of white noise that is above
        squares += np.where(samples.usable, fast**2, 0.0).sum(axis=0) / share
        rows += np.count_nonzero(samples.usable, axis=0)
    white = squares / np.where(rows > 0.0, rows, np.nan)
    return np.sqrt(white if steady is None else white + np.nan_to_num(steady.noise) ** 2)


def _disagreement(result: RepeatedEstimate) -> Array:
    gram = result.factor.gram
    differences = np.array([one.values for one in result.repetitions]) - result.pooled.values
    torque = np.einsum("ri,jik,rk->rj", differences, gram[:, :-1, :-1], differences)
    share = np.maximum(torque, 0.0) / np.maximum(gram[:, -1, -1], 1e-300)
    return np.asarray(np.sqrt(share.max(axis=0)))


def _estimation_noise(result: RepeatedEstimate, held_out: Factor) -> Array:
    """Standard deviation of the pooled estimate's predictions, by the scatter of R estimates."""
    repetitions = len(result.repetitions)
    values = np.array([one.values for one in result.repetitions])
    differences = values - values.mean(axis=0)
    torque = np.einsum("ri,jik,rk->j", differences, held_out.gram[:, :-1, :-1], differences)
    variance = torque / (repetitions * (repetitions - 1)) / np.maximum(held_out.samples, 1)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))
