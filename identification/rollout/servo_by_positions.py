r"""Servo, friction and rotor inertias from commanded and measured positions alone.

Without a torque the bodies have to be given. Of each joint and for each delay d of the command

.. math:: q_c(t-d) - q = (\tau_{bodies}(q, \dot q, \ddot q) + I_m \ddot q
    + f_0 \,\mathrm{sign}(\dot q) + f_1 \dot q
    - k_d (\dot q_c(t-d) - \dot q)) / k_p + const

is linear in five numbers, none of which is negative. What disturbs a joint is in its position, and
by the servo in all columns, but not in the command: delayed commands, their directions and the
torque of the bodies along them are instruments. There is a constant for every `CONSTANT_SECONDS`,
for the integral action of a servo. The delay is that of least error of all joints; as a later
command resembles more viscous friction, standard deviations are those with an unknown delay of each
joint.

Bodies of which all masses are larger by a factor have gains, friction and rotor inertias that are
larger by it, and the same motion: positions determine no factor.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Final, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from identification.arrays import Array
from identification.export.exported_arm import ExportedArm
from identification.export.simulators import rigid_torque
from identification.model.motion import Motion
from identification.rollout.servo_by_torque import (
    CONSTANT_SECONDS,
    MAX_SERVO_DELAY,
    NoServoError,
    PositionServo,
    UndeterminedGainError,
    best_delay,
    command_of,
    without_means,
)
from identification.rollout.windows import Stretch

NAMES: Final = ("kp", "kd", "Im", "f0", "f1")
"""Parameters of a joint: gains, rotor inertia, dry and viscous friction."""
_INSTRUMENT_LAGS: Final = (0.0, 0.01, 0.02, 0.03, 0.04)  # s of the commands that are instruments
_DETERMINED_SIGMAS: Final = 2.0  # standard deviations that a determined parameter is larger than


class EncoderFit(NamedTuple):
    """Servo and drives of an arm with given bodies."""

    arm: ExportedArm  #: with friction and rotor inertias
    servo: PositionServo
    values: Array  #: `NAMES` of each joint (n, 5)
    deviations: Array  #: their standard deviations (n, 5), infinite where nothing is determined
    delay_deviation: float  #: standard deviation of the delay [s]

    @property
    def determined(self) -> NDArray[np.bool_]:
        """Whether a parameter differs from zero by more than its interval (n, 5)."""
        return np.asarray(self.values > _DETERMINED_SIGMAS * self.deviations)


def fit_servo(arm: ExportedArm, stretches: Sequence[Stretch], step: float) -> EncoderFit:
    """Fit servo, friction and rotor inertias of an arm whose bodies are given.

    Its friction law has to have `f0` and `f1`; other terms are set to zero.

    Raises:
        UndeterminedGainError: a joint hardly moves, or does not follow its command.
        NoServoError: motors are coupled, there is no commanded position, or no stretch is long
            enough.
    """
    model = arm.model
    if not model.layout.rotor_inertia or model.layout.pairs:
        raise NoServoError("the model has coupled motors or no rotor inertias")
    bare = replace(arm, standard=_without_rotors(arm))
    joints = _joints_of(bare, stretches, step)

    def error(delay: float) -> float:
        return sum(joint.at(delay).error for joint in joints)

    delay = best_delay(error)
    fits = [joint.at(delay) for joint in joints]
    values = np.array([fit.values for fit in fits])
    deviations = np.array(
        [
            joint.deviations(delay, fit) if fit.values[0] > 0.0 else np.full(len(NAMES), np.inf)
            for joint, fit in zip(joints, fits, strict=True)
        ]
    )
    stiffness = values[:, 0] - _DETERMINED_SIGMAS * deviations[:, 0]
    if not (stiffness > 0.0).all():
        name = model.joint_names[int(np.argmin(stiffness))]
        raise UndeterminedGainError(
            f"the gain of {name} is not determined: it hardly moves, or does not follow its"
            " commanded position"
        )
    return EncoderFit(
        _with_drives(bare, values),
        PositionServo(values[:, 0], values[:, 1], delay),
        values,
        deviations,
        sum(joint.delay_variance(delay) ** -1.0 for joint in joints) ** -0.5,
    )


class _Fit(NamedTuple):
    """Parameters of a joint at a delay."""

    coefficients: Array  # of the columns (5,); the first is 1 / kp
    values: Array  # `NAMES` (5,), zeros without 1 / kp
    error: float  # sum of the squares that instruments show, over their scatter


@dataclass(frozen=True, eq=False)
class _Joint:
    """Equations of a joint: m rows in blocks, each without its mean."""

    blocks: int
    instruments: Array  # an orthonormal base of their space (m, k)
    fixed: Array  # torque of the bodies, acceleration, direction and speed (m, 4)
    #: at a delay: error, its negative rate, rate and acceleration of the command (m, 4)
    servo: Callable[[float], Array]

    def at(self, delay: float) -> _Fit:
        """Fit the parameters at a delay."""
        columns, error = self._equations(delay)
        length = _lengths(columns)
        projected = self.instruments.T @ (columns / length)
        scaled = scipy.optimize.lsq_linear(
            projected, self.instruments.T @ error, bounds=(0.0, np.inf)
        ).x
        shown = self.instruments.T @ error - projected @ scaled
        scatter = float(np.mean((error - columns @ (scaled / length)) ** 2))
        coefficients = scaled / length
        compliance = coefficients[0]
        values = np.zeros(len(NAMES))
        if compliance > 0.0:
            values = coefficients / compliance
            values[0] = 1.0 / compliance
        return _Fit(coefficients, values, float(shown @ shown) / max(scatter, 1e-300))

    def delay_variance(self, delay: float) -> float:
        """Return the variance of the delay by this joint alone [s²]."""
        return float(self._covariance(delay, self.at(delay))[-1, -1])

    def deviations(self, delay: float, fit: _Fit) -> Array:
        """Return the standard deviations of `NAMES` (5,)."""
        compliance = fit.coefficients[0]
        covariance = self._covariance(delay, fit)[:-1, :-1]
        slopes = np.diag(np.full(len(NAMES), 1.0 / compliance))
        slopes[:, 0] = -fit.values / compliance
        return np.sqrt(np.diag(slopes @ covariance @ slopes.T))

    def _equations(self, delay: float) -> tuple[Array, Array]:
        """Return the columns (m, 5) and the error (m,)."""
        error, slip, *_ = self.servo(delay).T
        torque, *others = self.fixed.T
        return np.column_stack([torque, slip, *others]), error

    def _with_delay(self, delay: float, fit: _Fit) -> tuple[Array, Array]:
        """Return the columns with a later command (m, 6), and the error (m,)."""
        columns, error = self._equations(delay)
        _, _, rate, acceleration = self.servo(delay).T
        return np.column_stack([columns, rate + fit.coefficients[1] * acceleration]), error

    def _covariance(self, delay: float, fit: _Fit) -> Array:
        """Return the covariance of coefficients and delay (6, 6), by sums over the blocks."""
        every, error = self._with_delay(delay, fit)
        length = _lengths(every)
        shown = self.instruments @ (self.instruments.T @ (every / length))
        residual = (error - every[:, :-1] @ fit.coefficients).reshape(self.blocks, -1)
        parts = shown.reshape(self.blocks, -1, len(length))
        sums = np.einsum("brc,br->bc", parts, residual)
        inverse = np.linalg.pinv(shown.T @ shown, hermitian=True, rcond=1e-12)
        freedom = self.blocks / max(self.blocks - len(length), 1)
        return np.asarray(freedom * inverse @ (sums.T @ sums) @ inverse / np.outer(length, length))


def _column(of_all: Callable[[float], Array], joint: int, delay: float) -> Array:
    return of_all(delay)[:, :, joint]


def _lengths(columns: Array) -> Array:
    length = np.linalg.norm(columns, axis=0)
    length[length == 0.0] = 1.0
    return np.asarray(length)


def _joints_of(arm: ExportedArm, stretches: Sequence[Stretch], step: float) -> list[_Joint]:
    """Return the equations of each joint of an arm without rotors."""
    rows = round(CONSTANT_SECONDS / step)
    count = arm.model.n_joints
    # The same rows for every delay: those whose command is known.
    with_command = slice(round(MAX_SERVO_DELAY / step) + 1, -1)

    def stacked(columns_of: Callable[[Stretch], Sequence[Array]]) -> Array:
        """Return columns (m, c, n) in blocks without means."""
        blocks = list[Array]()
        for stretch in stretches:
            columns = np.stack(columns_of(stretch), axis=1)[with_command]
            blocks += without_means(columns, rows)
        if not blocks:
            raise NoServoError(f"no stretch lasts {CONSTANT_SECONDS:g} s")
        return np.concatenate(blocks).reshape(len(blocks) * rows, -1, count)

    def servo(delay: float) -> Array:
        def columns(stretch: Stretch) -> list[Array]:
            position, _ = command_of(stretch, delay)
            rate = np.gradient(position, step, axis=0)
            motion = stretch.motion
            acceleration = np.gradient(rate, step, axis=0)
            return [position - motion.position, motion.velocity - rate, rate, acceleration]

        return stacked(columns)

    def commanded(stretch: Stretch) -> list[Array]:
        columns = []
        for lag in _INSTRUMENT_LAGS:
            position, _ = command_of(stretch, lag)
            velocity = np.gradient(position, step, axis=0)
            acceleration = np.gradient(velocity, step, axis=0)
            motion = Motion(stretch.motion.time, position, velocity, acceleration)
            columns += [rigid_torque(arm, motion), np.sign(velocity), position]
        return columns

    def measured(stretch: Stretch) -> list[Array]:
        motion = stretch.motion
        direction = np.sign(motion.velocity)
        return [rigid_torque(arm, motion), motion.acceleration, direction, motion.velocity]

    instruments = stacked(commanded)
    fixed = stacked(measured)
    at = lru_cache(maxsize=1)(servo)
    return [
        _Joint(
            len(fixed) // rows,
            scipy.linalg.orth(instruments[:, :, j] / _lengths(instruments[:, :, j])),
            fixed[:, :, j],
            partial(_column, at, j),
        )
        for j in range(count)
    ]


def _without_rotors(arm: ExportedArm) -> Array:
    standard = arm.standard.copy()
    standard[arm.model.layout.rotors] = 0.0
    return standard


def _with_drives(arm: ExportedArm, values: Array) -> ExportedArm:
    """Return an arm with rotor inertias and friction of each joint."""
    model = arm.model
    standard = arm.standard.copy()
    standard[model.layout.rotors] = values[:, NAMES.index("Im")]
    parameters = np.zeros(model.n_parameters)
    parameters[: model.base.rank] = model.base.grouping @ standard
    parameters[model.friction_part] = [
        values[term.owner, NAMES.index(term.symbol)] if term.symbol in NAMES else 0.0
        for term in model.friction.terms
    ]
    return replace(arm, standard=standard, values=parameters, load=None)
