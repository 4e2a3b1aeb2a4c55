"""Whether an estimate is physically plausible: signs, consistent bodies, nominal masses.

- Signs of estimated parameters that are impossible, as far as they are significant.
- Effect of physical consistency on the torque error, and the parameters that prevent it.
- Ratio of each axis's measured torque to that of the nominal inertias: a torque constant or gear
  ratio wrong by a factor fits equally well, only independent knowledge shows it. Likewise the ratio
  of the controller's to the identified inertia.
- Steps of a measured position that an arm cannot make, such as lost encoder counts: a departure
  from the steps beside it that later steps do not reverse. Departures common to the other joints
  are errors of the clock and are subtracted first. Samples that the log repeats, or has late, are
  recognised by their place on the path of the motion.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.distributions import student_limit
from identification.estimators.consistent import ConsistentEstimate, consistent_estimate
from identification.estimators.prior import BodyPrior, nominal_deviations
from identification.factor.factor import Estimate, Factor
from identification.model.friction import COULOMB
from identification.model.pseudo_inertia import pseudo_inertia, reference_bodies
from identification.model.robot import RobotModel
from identification.signals.recording import GAP_STEPS, Recording
from identification.signals.samples import Samples
from identification.validation.finding import joined, little_torque

Array = NDArray[np.float64]

_SIGMAS: Final = 3.0  # standard deviations of a significant wrong sign or change
# Masses, rotor inertias, moments of inertia about an axis.
_NEVER_NEGATIVE: Final = re.compile(r"m\d+|I\d+(m|xx|yy|zz)")


class Implausible(NamedTuple):
    """Messages on wrong signs of an estimate."""

    impossible: tuple[str, ...]  # wrong signs with a torque above the prediction error
    doubtful: tuple[str, ...]  # wrong signs with a smaller torque
    added: tuple[str, ...] = ()  # friction that falls by a term that nobody stated


def implausibilities(
    model: RobotModel,
    estimate: Estimate,
    motion: Factor,
    error_rms: Array,
    *,
    speed: Array,
    added: Collection[str] = (),
) -> Implausible:
    """Return messages on what is physically impossible in an estimate.

    The torque of wrong signs on a `motion` is compared with the error of its prediction (n,), of
    which it must be a multiple on axes of little torque; friction is evaluated up to the highest
    speeds (n,). Terms of friction of `added` symbols were
    chosen, not stated: they follow the friction within the fitted speeds and are no reason against
    a model.
    """
    impossible: list[str] = []
    doubtful: list[str] = []
    chosen: list[str] = []
    torque_rms = np.sqrt(motion.gram[:, -1, -1] / np.maximum(motion.samples, 1))
    little = little_torque(torque_rms, ~model.chain.revolute)
    limit = np.where(little, _FAR_ABOVE, 1.0) * error_rms
    for message, part, by_added in _wrong_signs(model, estimate, speed, added):
        if by_added:
            chosen.append(message)
            continue
        part_values = np.where(part, estimate.values, 0.0)
        squares = np.einsum("i,jik,k->j", part_values, motion.gram[:, :-1, :-1], part_values)
        torque = np.sqrt(np.maximum(squares, 0.0) / np.maximum(motion.samples, 1))
        (impossible if np.any(torque > limit) else doubtful).append(message)
    return Implausible(tuple(impossible), tuple(doubtful), tuple(chosen))


def _is_negative(estimate: Estimate, direction: Array) -> bool:
    """Return whether direction · parameters is significantly below zero."""
    determined = np.isfinite(np.diag(estimate.covariance))
    if np.any(direction[~determined]):
        return False
    part = direction[determined]
    variance = float(part @ estimate.covariance[np.ix_(determined, determined)] @ part)
    return float(direction @ estimate.values) < -_SIGMAS * float(np.sqrt(variance))


def _wrong_signs(
    model: RobotModel, estimate: Estimate, speed: Array, added: Collection[str] = ()
) -> Iterator[tuple[str, NDArray[np.bool_], bool]]:
    """Yield messages on wrong signs, the parameters (p,) that cause them, and if by added terms."""
    values = estimate.values
    first = model.base.rank
    count = len(estimate.values)
    for joint, (name, law) in enumerate(zip(model.joint_names, model.friction.laws, strict=True)):
        top_speed = speed[joint : joint + 1]
        top, coulomb, stated = np.zeros((3, count))
        for k, (_, term, owner, motor, _) in enumerate(model.friction.terms, start=first):
            if owner == joint and not motor and term.is_friction:
                top[k] = term.column(top_speed, law.sign(top_speed))[0]
                coulomb[k] = term == COULOMB
                stated[k] = term.symbol not in added
        if _is_negative(estimate, coulomb):
            message = (
                f"Coulomb friction of {name} is negative ({coulomb @ values:.3g}): a torque or a"
                " direction has the wrong sign"
            )
            yield message, top != 0.0, False
        elif _is_negative(estimate, top - 0.5 * coulomb):
            by_added = not _is_negative(estimate, stated * top - 0.5 * coulomb)
            message = (
                f"friction of {name} is {top @ values:.3g} at its top speed of {speed[joint]:.3g},"
                f" less than half of its Coulomb friction {coulomb @ values:.3g}"
            )
            if by_added:
                message += ", by a friction term that was chosen by inner prediction"
            yield message, top != 0.0, by_added
    alone = {  # names of single parameters
        k: f"friction {term.name} of {'motor' if term.motor else 'joint'} {term.owner + 1}"
        for k, term in enumerate(model.friction.terms, start=first)
        if term.motor or term.term.of_load
    }
    for k, (name, row) in enumerate(zip(model.base.names, model.base.grouping, strict=True)):
        if np.count_nonzero(row) <= 1 and _NEVER_NEGATIVE.fullmatch(name):
            alone[k] = name
    for k, name in alone.items():
        direction = np.arange(count) == k
        if _is_negative(estimate, direction.astype(np.float64)):
            figures = f"{values[k]:.3g} ± {estimate.std[k]:.2g} {estimate.units[k]}"
            yield f"{name} is negative: {figures}", direction, False


class Dissipation(NamedTuple):
    """Friction of n joints at their top speed, negative if it drives the joint."""

    torque: Array  # (n,) [N·m or N]
    std: Array  # (n,), infinite if undetermined or without friction terms

    @property
    def known(self) -> NDArray[np.bool_]:
        """Whether the sign of each is significant (n,)."""
        return np.asarray(np.abs(self.torque) > _SIGMAS * self.std)

    @property
    def all_driving(self) -> NDArray[np.bool_]:
        """Joints with known friction (n,) if it drives all of them, most of the arm; else none."""
        determined = self.known
        most = np.count_nonzero(determined) >= max(2, 0.5 * len(determined))
        return determined & bool(most and np.all(self.torque[determined] < 0.0))

    @property
    def described(self) -> NDArray[np.object_]:
        """Torques with their standard deviations as text (n,)."""
        pairs = zip(self.torque, self.std, strict=True)
        return np.array([f"{torque:.3g} ± {2.0 * std:.2g}" for torque, std in pairs], dtype=object)


def dissipation_of(model: RobotModel, estimate: Estimate, speed: Array) -> Dissipation:
    """Return the friction of each joint at its highest speed (n,) [rad/s or m/s]."""
    first = model.base.rank
    count = len(estimate.values)
    torque = np.zeros(model.n_joints)
    std = np.full(model.n_joints, np.inf)
    determined = np.isfinite(np.diag(estimate.covariance))
    covariance = np.where(np.outer(determined, determined), estimate.covariance, 0.0)
    for joint, law in enumerate(model.friction.laws):
        top = np.zeros(count)
        top_speed = speed[joint : joint + 1]
        for k, (_, term, owner, motor, _) in enumerate(model.friction.terms, start=first):
            if owner == joint and not motor and term.is_friction:
                top[k] = term.column(top_speed, law.sign(top_speed))[0]
        torque[joint] = top @ estimate.values
        if top.any() and not np.any(top[~determined]):
            std[joint] = float(np.sqrt(top @ covariance @ top))
    return Dissipation(torque, std)


def inertia_matrices(model: RobotModel, values: Array, position: Array) -> Array:
    """Return inertia matrices (k, n, n) with rotors, of parameters (p,) at positions (k, n)."""
    still = np.zeros_like(position)
    static_torque = model.torque(values, position, still, still)
    columns = [
        model.torque(values, position, still, still + axis) - static_torque
        for axis in np.eye(model.n_joints)
    ]
    return np.stack(columns, axis=2)


# Smallest second moment of a link relative to the nominal body's at which a bound counts as active.
_EDGE: Final = 0.01
_SHOWN_BOUNDS: Final = 4
# Rise of the relative held-out torque error over all joints, and of one joint, that is noticeable,
# or means that no consistent parameters exist. NS 16 campaigns without a fault: below 0.0001 over
# all joints. With torque or position of one joint negated: at least 0.13 for joints 1 and 2; for
# wrist joints 0.004 to 0.02, but more than 0.5 of their own torque.
_COSTLY: Final = (0.001, 0.005)
_IMPOSSIBLE: Final = (0.02, 0.1)
_NEGATIVE: Final = {
    "I{}m": "rotor inertia",
    "f0_{}": "Coulomb friction",
    "f1_{}": "viscous friction",
}


ELEMENTS: Final = "a spring, a balancer or a hydraulic counterweight"
# Least torque of gravity, over the measured one, of an axis that gravity loads; below, friction and
# inertia dominate.
_LOADED: Final = 0.2
_POSTURES: Final = 50
_MOST_ROWS: Final = 5_000  # that are compared with the nominal torque
_FAR_ABOVE: Final = 4.0  # errors of an axis of little torque; its error is mostly friction
_ROWS_AT_ONCE: Final = 50_000  # that are searched for steps


@dataclass(frozen=True, eq=False)
class ConsistencyCheck:
    """Consistent estimate compared with the unconstrained one on held-out motion."""

    consistent: ConsistentEstimate
    held_out: float  # relative torque error on held-out motion
    unconstrained_held_out: float  # that of the unconstrained estimate
    held_out_rise: Array  # rise per joint (n,), NaN without rows or with little torque
    # smallest second moment of each link over the nominal body's in the same direction (n,), zero
    # at the bound
    room: Array
    moved: tuple[str, ...]  # parameters changed by more than three standard deviations
    # messages on impossible parameters of the unconstrained estimate, by rise of the joint's error
    bounds: tuple[str, ...]
    judged_on: str = "held-out"  # "held-out" or "in-sample"
    # the joint that gravity loads, if the rise of the error is mostly its own; else empty
    overloaded: str = ""

    @property
    def cost(self) -> float:
        """Rise of the relative torque error on held-out motion, over all joints."""
        return self.held_out - self.unconstrained_held_out

    @property
    def costly(self) -> bool:
        """Whether the consistent estimate predicts noticeably worse."""
        return self._beyond(*_COSTLY)

    @property
    def impossible(self) -> bool:
        """Whether no consistent estimate predicts the held-out motion well."""
        return self._beyond(*_IMPOSSIBLE)

    def _beyond(self, overall: float, axis: float) -> bool:
        worse_axis = self.cost > 0.0 and bool(np.any(self.held_out_rise > axis))
        return self.cost > overall or worse_axis

    @property
    def remedy(self) -> str:
        """What to check if no consistent parameters fit.

        A spring or balancer bears the weight on one axis, which no body can do; a wrong sign or
        coupling spoils several.
        """
        usual = "check signs, torque constants, coupling and URDF"
        if not (self.overloaded and self.costly):
            return usual
        return (
            f"describe {ELEMENTS} on {self.overloaded} as [[robot.elements]] of the cell file;"
            f" if it has none, {usual}"
        )

    @property
    def sentence(self) -> str:
        """Result as a sentence."""
        points = round(100.0 * self.cost, 2) + 0.0
        error = f"{self.judged_on} torque error {points:+.2f} points"
        if not self.costly:
            better = self.cost < -_COSTLY[0]
            return f"consistent parameters predict {'better' if better else 'as well'} ({error})"
        start = (
            "no physically consistent parameters fit the data"
            if self.impossible
            else "the parameters are not physically consistent, and the nearest consistent ones"
            " predict worse"
        )
        return f"{start} ({error}): {joined(self.bounds, _SHOWN_BOUNDS)}".removesuffix(": ")


def check_consistency(
    model: RobotModel,
    training: Factor,
    held_out: Factor,
    unconstrained: Estimate,
    *,
    weights: Array | None = None,
    prior: BodyPrior | None = None,
    design_effect: float = 1.0,
    in_sample: bool = False,
) -> ConsistencyCheck:
    """Compare the physically consistent estimate with an unconstrained one.

    Weights (n,) are by default the inverse residual variances of an ordinary fit; with `in_sample`
    the held-out motion is the training. Prior and `design_effect` as for
    :func:`identification.estimators.consistent.consistent_estimate`.

    Raises:
        IdentificationError: see :func:`identification.estimators.consistent.consistent_estimate`.
    """
    consistent = consistent_estimate(
        model, training, unconstrained, weights=weights, prior=prior, design_effect=design_effect
    )
    values = consistent.estimate.values
    free = unconstrained.values
    shift = np.abs(consistent.shift)
    links = model.layout.links
    rise = held_out.relative_errors(values) - held_out.relative_errors(free)
    torque = np.sqrt(held_out.gram[:, -1, -1] / np.maximum(held_out.samples, 1))
    rise[little_torque(torque, ~model.chain.revolute)] = np.nan
    # In axes in which the reference's pseudo-inertia is the unit matrix.
    frames = reference_bodies(model.nominal[links], model.chain.translation).frames
    inner = np.linalg.solve(frames, pseudo_inertia(consistent.standard[links]))
    inner = np.linalg.solve(frames, inner.transpose(0, 2, 1))
    room = np.asarray(np.linalg.eigvalsh(inner)[:, 0])
    bounds: list[str] = []
    single = np.count_nonzero(model.base.grouping, axis=1) == 1
    for joint in np.argsort(-np.nan_to_num(rise), kind="stable").tolist():
        name = model.joint_names[joint]
        for pattern, what in _NEGATIVE.items():
            if (parameter := pattern.format(joint + 1)) in unconstrained.names:
                k = unconstrained.names.index(parameter)
                alone = k >= model.base.rank or bool(single[k])
                if alone and free[k] < -_SIGMAS * unconstrained.std[k]:
                    bounds.append(f"{what} of {name} would be negative ({free[k]:.3g})")
        if room[joint] < _EDGE:
            bounds.append(f"the link of {name} would need a negative mass or moment of inertia")
    return ConsistencyCheck(
        consistent=consistent,
        held_out=held_out.relative_error(values),
        unconstrained_held_out=held_out.relative_error(free),
        held_out_rise=rise,
        room=room,
        moved=tuple(
            unconstrained.names[k] for k in np.argsort(-shift, kind="stable") if shift[k] > _SIGMAS
        ),
        bounds=tuple(bounds),
        judged_on="in-sample" if in_sample else "held-out",
        overloaded=_overloaded(model, training, held_out, values, free),
    )


def _overloaded(
    model: RobotModel, training: Factor, held_out: Factor, values: Array, free: Array
) -> str:
    """Return the joint that gravity loads and that most of the rise of the squared error is of."""
    rise = np.maximum(held_out.squared_errors(values) - held_out.squared_errors(free), 0.0)
    joint = int(rise.argmax())
    alone = rise[joint] > 0.5 * rise.sum() and _gravity_loaded(model, training, free)[joint]
    return model.joint_names[joint] if alone else ""


def _gravity_loaded(model: RobotModel, motion: Factor, values: Array) -> NDArray[np.bool_]:
    """Return the joints (n,) whose torque is largely weight, by parameters (p,)."""
    rng = np.random.default_rng(0)
    position = rng.uniform(-1.0, 1.0, (_POSTURES, model.n_joints))
    still = np.zeros_like(position)
    weight = model.torque(np.where(model.friction_columns, 0.0, values), position, still, still)
    measured = np.sqrt(motion.gram[:, -1, -1] / np.maximum(motion.samples, 1))
    return np.asarray(np.sqrt(np.mean(weight**2, axis=0)) > _LOADED * measured)


_BLOCKS: Final = 20  # parts of the recordings whose scatter gives the standard deviation
# Model error of friction laws relative to the friction (Bittencourt and Gunnarsson 2012).
_FRICTION_SHARE: Final = 0.03
_WIDEST: Final = 0.5  # relative tolerance for noise and friction above which a scale is unknown
# Weight of independent errors of links, where friction dominates the torque. On a simulated UR5
# with link errors up to 10 % all scales were within 7 %.
_LINKS_APART: Final = 0.05
_SURE: Final = 2.0  # standard deviations
_OTHER_UNIT: Final = 3.0


class NominalScale(NamedTuple):
    """Ratio of measured to nominal torque of n axes."""

    scale: Array  # (n,), NaN where the nominal torque is too small
    # half a 95 % interval with errors of nominal torque and friction law (n,); infinite likewise
    tolerance: Array

    @property
    def off(self) -> NDArray[np.bool_]:
        """Whether the scale of each axis differs significantly from 1 (n,)."""
        # A factor that may be zero does not determine the nominal torque.
        determined = np.abs(self.scale) > self.tolerance
        return determined & (np.abs(self.scale - 1.0) > self.tolerance)

    @property
    def common(self) -> float:
        """Factor common to most axes, such as a wrong unit or motor torques; 1 if there is none."""
        positive = np.isfinite(self.scale) & (self.scale > 0.0)
        if np.count_nonzero(positive) < 2:
            return 1.0
        logs = np.log(self.scale[positive])
        sure = np.abs(self.scale[positive] - 1.0) > self.tolerance[positive]
        alike = sure & (np.abs(logs) > np.log(_OTHER_UNIT)) & (logs * np.median(logs) > 0.0)
        most = np.count_nonzero(alike) > len(logs) / 2
        return float(np.exp(np.median(logs))) if most else 1.0

    @property
    def negated(self) -> bool:
        """Whether all known scales are negative, two of them or that of one joint significantly."""
        finite_scale = self.scale[np.isfinite(self.scale)]
        sure = np.count_nonzero(self.scale + self.tolerance < 0.0)
        return bool(sure >= min(2, len(self.scale)) and np.all(finite_scale < 0.0))

    def without(self, joints: Iterable[int]) -> NominalScale:
        """Return the scales with those of some axes unknown."""
        scale = self.scale.copy()
        scale[sorted(set(joints))] = np.nan
        return self._replace(scale=scale)


def nominal_scale(
    model: RobotModel,
    nominal: Array,
    runs: Sequence[Samples],
    *,
    rotors_known: bool = False,
    share: float | None = None,
) -> NominalScale:
    """Compare measured torque with that of nominal parameters (p,) per axis, without friction.

    `rotors_known`: the nominal parameters include rotor inertias; `share`: relative standard
    deviation of the nominal torque, by default that of bodies as uncertain as in
    :func:`identification.estimators.prior.body_prior`.
    """
    bodies = nominal_deviations(model) if share is None else np.zeros((model.base.rank, 0))
    if all(run.torque_bandwidth is None for run in runs):
        step = max(1, sum(len(run.torque) for run in runs) // _MOST_ROWS)
        runs = [run.thinned(step) for run in runs]
    scales = []
    regressors = [run.regressor(model) for run in runs]
    for joint in range(model.n_joints):
        columns = regressors[0].columns[joint]
        turning = [joint]
        inertial = columns < model.base.rank
        if model.coupling is not None:
            turns = model.coupling.motor_from_joint
            turning = sorted({joint, *np.flatnonzero((turns.T @ turns)[joint]).tolist()})
        tables = []
        torques = []
        deviations = []
        for run, (blocks, _) in zip(runs, regressors, strict=True):
            rows = run.usable[:, joint]
            block = blocks[joint]
            table = [block[:, inertial] @ nominal[columns[inertial]], block[:, ~inertial]]
            if not rotors_known:
                table.append(run.as_measured(joint, run.motion.acceleration[:, turning]))
            tables.append(np.column_stack(table)[rows])
            torques.append(run.torque[rows, joint])
            deviations.append((block[:, inertial] @ bodies[columns[inertial]])[rows])
        whole = (np.concatenate(parts) for parts in (tables, torques, deviations))
        scales.append(_scale(*whole, share=share or 0.0))
    return NominalScale(*np.array(scales).T)


def _scale(table: Array, torque: Array, deviations: Array, *, share: float) -> tuple[float, float]:
    """Return the coefficient of the first column and its tolerance; NaN if uncertain.

    The first column deviates by a share of itself and by each of `deviations`.
    """
    rigid = table[:, 0]
    others = table[:, 1:]
    if len(torque) < 10 * _BLOCKS or not rigid.any():
        return np.nan, np.inf
    size = np.linalg.norm(others, axis=0)
    basis, _ = np.linalg.qr(others[:, size > 0.0] / size[size > 0.0])
    # Part of the nominal torque that friction does not explain.
    alone = rigid - basis @ (basis.T @ rigid)
    power = float(alone @ alone)
    if not power > 1e-12 * float(rigid @ rigid):
        return np.nan, np.inf
    scale = float(alone @ torque) / power
    friction = basis @ (basis.T @ (torque - scale * rigid))
    left = np.array_split(alone * (torque - scale * rigid - friction), _BLOCKS)
    scatter = np.square([part.sum() for part in left]).sum()
    std = np.sqrt(scatter * _BLOCKS / (_BLOCKS - 1)) / power
    lost = float(rigid @ rigid) / power - 1.0
    misfit = _FRICTION_SHARE * np.linalg.norm(friction) / np.sqrt(power)
    bodies = float(np.linalg.norm(alone @ deviations)) / power
    of_torque = share**2 * (1.0 + _LINKS_APART * lost)
    model_error = _SURE * float(np.sqrt(of_torque + bodies**2 + misfit**2))
    noise = student_limit(0.025, _BLOCKS - 1) * std
    tolerance = noise + model_error
    # Tolerances scale with the unit of the torque. Uncertain bodies alone leave a scale known.
    unit = max(1.0, abs(scale))
    is_certain = noise + _SURE * misfit < _WIDEST * unit and tolerance < unit
    return (scale, float(tolerance)) if is_certain else (np.nan, np.inf)


class InertiaRatio(NamedTuple):
    """Ratio of the controller's to the identified inertia per joint, with rotors, joint side."""

    # median over postures (n,); NaN where the controller sends zero or the inertia is undetermined
    ratio: Array
    spread: Array  # standard deviation over postures (n,), NaN likewise


def inertia_ratio(
    model: RobotModel, values: Array, position: Array, theirs: Array
) -> InertiaRatio | None:
    """Compare a controller's diagonal inertia (m, n), joint side, with that of values (p,).

    At positions (m, n) [rad or m]; zero where not sent. None if there is nothing to compare.
    """
    if not np.any(theirs):
        return None
    ours = np.diagonal(inertia_matrices(model, values, position), axis1=1, axis2=2)
    comparable = (ours > 0.0) & (theirs > 0.0)
    ratio = np.where(comparable, theirs, np.nan) / np.where(comparable, ours, 1.0)
    whole = comparable.mean(axis=0) > 0.9
    median, spread = np.full((2, model.n_joints), np.nan)
    median[whole] = np.nanmedian(ratio[:, whole], axis=0)
    spread[whole] = np.nanstd(ratio[:, whole], axis=0)
    return InertiaRatio(median, spread)


_STANDS_OUT: Final = 15.0  # robust standard deviations of a jump
# The same relative to the frequent large departures (starts, stops, reversals).
_USUAL: Final = 20  # departures
_BEYOND_USUAL: Final = 3.0
# Acceleration within one step of the clock; robots reach a fifth of it.
_FASTEST: Final = 150.0  # rad/s² or m/s²
_BESIDE: Final = 4  # steps to either side
# Standard deviations by which other joints must move for a missing row to be visible.
_SHOWS: Final = 5.0
_MOVES: Final = 3.0  # multiples of the usual departure of a joint that moves
_OFTEN: Final = 3  # departures by a whole step that an encoder does not repeat by chance
_ON_PATH: Final = 0.25  # distance from the extrapolated path, as a share of the step
_WHOLE: Final = 0.15  # tolerance of departures by whole steps of the motion, as a share of a step
# Resolutions by which rounding moves a step: one at its ends, half of one in the speed beside it.
_ROUNDED: Final = 1.5
_NORMAL: Final = 1.4826  # standard deviation over median absolute value


@dataclass(frozen=True)
class PositionJump:
    """One impossible step of a position."""

    recording: str
    joint: str
    time: float  # of the sample after the step [s], since the recording began
    size: float  # [rad or m], without the motion


class PositionSteps(NamedTuple):
    """Lasting steps of the measured positions of a recording that the motion does not have."""

    jumps: tuple[PositionJump, ...]  # of a position, by joint and time
    logged: tuple[PositionJump, ...]  # of the log: samples repeated or late, rows missing


def position_jumps(recording: Recording, name: str = "the recording") -> list[PositionJump]:
    """Return lasting steps of the measured positions of a named recording, by joint and time."""
    return list(position_steps(recording, name).jumps)


def position_steps(recording: Recording, name: str = "the recording") -> PositionSteps:
    """Return lasting steps of the positions of a named recording, apart from those of its log."""
    jumps: list[PositionJump] = []
    logged: list[PositionJump] = []
    rounded = _ROUNDED * np.array([_resolution(column) for column in recording.position.T])
    for parts in _pieces(recording):
        steps = _steps_of(recording, parts, name, rounded)
        jumps += steps.jumps
        logged += steps.logged
    return PositionSteps(tuple(jumps), tuple(logged))


def _pieces(recording: Recording) -> Iterator[list[slice]]:
    """Yield stretches without a gap, together some `_ROWS_AT_ONCE` rows, with the row before."""
    parts: list[slice] = []
    for segment in recording.segments():
        for start in range(segment.start, segment.stop, _ROWS_AT_ONCE):
            stop = min(start + _ROWS_AT_ONCE, segment.stop)
            first = max(segment.start, start - 1)
            if stop - first <= 2 * _BESIDE + 2:
                continue
            parts.append(slice(first, stop))
            if sum(part.stop - part.start for part in parts) >= _ROWS_AT_ONCE:
                yield parts
                parts = []
    if parts:
        yield parts


def _steps_of(
    recording: Recording, parts: Sequence[slice], name: str, rounded: Array
) -> PositionSteps:
    """Return the lasting steps within stretches of a recording, larger than by rounding (n,)."""
    time = recording.time
    position = recording.position
    pieces = [_departures(time[part], position[part]) for part in parts]
    departure, speed, change = map(np.concatenate, zip(*pieces, strict=True))
    steps = np.concatenate([np.diff(time[part]) for part in parts])[:, None]
    after = np.concatenate([np.arange(part.start + 1, part.stop) for part in parts])
    departure, shown = _without_clock(departure, speed, steps)
    size = np.abs(departure)
    spread = _NORMAL * np.median(size, axis=0)
    usual = np.partition(size, -_USUAL, axis=0)[-_USUAL] if len(size) > 10 * _USUAL else 0.0
    least = np.maximum(np.maximum(_STANDS_OUT * spread, _BEYOND_USUAL * usual), _FASTEST * steps**2)
    least = np.maximum(least, rounded)
    # Missing or repeated rows cause departures by whole steps of the motion, also beside a gap.
    motion_step = speed * np.median(steps)
    count = np.clip(
        np.rint(departure / np.where(motion_step == 0.0, np.inf, motion_step)), -1.0, GAP_STEPS
    )
    apart = np.abs(departure - count * motion_step)
    whole = apart < np.maximum(least, _WHOLE * np.abs(motion_step))
    suspect = (size - 0.5 * change > least) & (shown | ~whole)
    lasting = np.zeros_like(suspect)
    for joint, k in np.argwhere(suspect.T):
        around = departure[max(0, k - _BESIDE) : k + _BESIDE + 1, joint]
        # Otherwise the steps beside it reverse it.
        lasting[k, joint] = np.abs(around.sum()) > 0.5 * size[k, joint]
    by_whole_steps = (count != 0.0) & (apart < _WHOLE * np.abs(motion_step))
    often = np.count_nonzero(lasting & by_whole_steps) >= _OFTEN
    moving = np.abs(motion_step) > _MOVES * spread
    together = np.count_nonzero(_nearby(lasting) & moving, axis=1)
    every = (together >= 2) & (together > 0.5 * np.count_nonzero(moving, axis=1))
    jumps: list[PositionJump] = []
    logged: list[PositionJump] = []
    for joint, k in np.argwhere(lasting.T):
        row = int(after[k])
        jump = float(departure[k, joint])
        position_jump = PositionJump(
            name, recording.joint_names[joint], float(time[row] - time[0]), jump
        )
        by_log = every[k] or (by_whole_steps[k, joint] and often)
        tolerance = _ON_PATH * abs(jump) + float(rounded[joint])
        by_log |= _on_path(time, position[:, joint], row, tolerance)
        (logged if by_log else jumps).append(position_jump)
    return PositionSteps(tuple(jumps), tuple(logged))


def _nearby(marked: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return where a row or one beside it is marked (m, n)."""
    padded = np.pad(marked, ((1, 1), (0, 0)))
    return np.asarray(padded[:-2] | padded[1:-1] | padded[2:])


def _resolution(position: Array) -> float:
    """Return the smallest step of a position (m,), zero if it never moves."""
    steps = np.abs(np.diff(position))
    return float(np.min(steps, where=steps > 0.0, initial=np.inf)) if steps.any() else 0.0


def _on_path(time: Array, position: Array, row: int, tolerance: float) -> bool:
    """Return whether a step to a row of a position (m,) begins or ends a frozen value, on its path.

    A sample that repeats the one before it exactly, while the joint moves, was not measured anew.
    """
    if position[row] == position[row - 1]:
        return True
    first = row - 1
    while first > 0 and position[first - 1] == position[first]:
        first -= 1
    if first == row - 1 or first < _BESIDE or row + _BESIDE >= len(time):
        return False
    before = (position[first] - position[first - _BESIDE]) / (time[first] - time[first - _BESIDE])
    behind = (position[row + _BESIDE] - position[row]) / (time[row + _BESIDE] - time[row])
    expected = position[first] + 0.5 * (before + behind) * (time[row] - time[first])
    return bool(abs(position[row] - expected) < tolerance)


def _departures(time: Array, position: Array) -> tuple[Array, Array, Array]:
    """Return how much each step departs from the speed beside it (m - 1, n), and that speed."""
    steps = np.diff(time)[:, None]
    speed = np.diff(position, axis=0) / steps
    padded = np.pad(speed, ((_BESIDE, _BESIDE), (0, 0)), mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * _BESIDE + 1, axis=0)
    # One joint at a time, since the windows are copied.
    sides = slice(None, _BESIDE), slice(_BESIDE + 1, None)
    before, after = (
        np.column_stack([np.median(joint[:, side], axis=-1) for joint in windows.swapaxes(0, 1)])
        for side in sides
    )
    # The mean of both sides' medians follows a steady acceleration and ignores single jumps.
    usual = 0.5 * (before + after)
    return (speed - usual) * steps, usual, np.abs(after - before) * steps


def _without_clock(departure: Array, speed: Array, steps: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Subtract the time error shown by the other joints from departures (m, n)."""
    # Departures of zero, at rest, do not measure noise.
    size = np.abs(departure)
    noise = np.array(
        [
            _NORMAL * np.median(some) if (some := column[column > 0.0]).size else np.inf
            for column in size.T
        ]
    )
    off = departure / noise
    rate = speed / noise
    weight = (rate**2).sum(axis=1, keepdims=True) - rate**2
    # Time error of the other joints, regularised by one step.
    error = ((rate * off).sum(axis=1, keepdims=True) - rate * off) / (weight + steps**-2)
    without = departure - speed * error
    less = np.where(np.abs(without) < size, without, departure)
    return less, weight * steps**2 > _SHOWS**2
