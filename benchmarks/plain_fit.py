"""Ordinary fits of an arm's dynamics by pinocchio, numpy and scipy, independent of `hil`.

Positions, and velocities where they were measured, go through a zero-phase Butterworth filter;
derivatives are differences. The model is pinocchio's standard parameters with rotor inertia,
Coulomb and viscous friction and an offset for each joint. Every row is fitted.

- `fit`: least squares of minimum norm. Each joint is weighted by the inverse variance of its own
  residual, iterated.
- `fit_friction`: the URDF's masses as they are; rotor inertia, friction and offset by least squares
  for each joint alone.
- `fit_friction_and_scale`: likewise, and the scale of each joint's torque.
- `fit_with_prior`: the most probable parameters of a Gaussian prior about the URDF's, at one
  cut-off. Where the motion determines a parameter, this is `fit`.

Run with ``python -m benchmarks.plain_fit LOG.npz ROBOT.urdf [--share 0.7]`` for `fit` alone, on the
first part of arrays `time`, `position`, `torque` and perhaps `velocity`; it prints cut-off and
errors on both parts.

The cut-off of the first two is the one with which the first 70 % of what is fitted predict the rest
of it best. The latter two have no meaning, or another prior, where the masses of a URDF are
placeholders (`has_masses`).
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import pinocchio as pin
import scipy.signal
from numpy.typing import NDArray

Array = NDArray[np.float64]

CUTOFFS: Final = (2.0, 3.0, 5.0, 8.0, 12.0, 20.0, 30.0, 40.0)  # Hz
INNER_SHARE: Final = 0.7
_ROUNDS: Final = 10  # of reweighting
_RANK: Final = 1e-10  # of the largest singular value; what is smaller is rounding

PRIOR_CUTOFF: Final = 10.0  # Hz; a rigid arm hardly moves faster
LIKELIHOOD_SHARE: Final = 0.02
"""Share of the rows that count against the prior: neighbours are correlated, the model is wrong."""
BODY_SHARE: Final = 0.3
"""Standard deviation of a mass over the URDF's, and so of first moment and inertia."""
UNKNOWN_MASS: Final = 3.0  # kg, standard deviation of a mass that the URDF does not know
_LEAST_LENGTH: Final = 0.1  # of the longest link, for bodies whose centre the URDF puts on the axis
_POSTURES: Final = 50  # over which the inertia outboard of a joint is averaged


class Measured(NamedTuple):
    """m rows of n joints in pinocchio's order: time [s], position, velocity, torque (SI units)."""

    time: Array
    position: Array
    velocity: Array | None
    torque: Array

    def rows(self, wanted: slice) -> Measured:
        """Some of the rows."""
        velocity = None if self.velocity is None else self.velocity[wanted]
        return Measured(self.time[wanted], self.position[wanted], velocity, self.torque[wanted])


@dataclass(frozen=True, eq=False)
class PlainFit:
    """Cut-off [Hz] and parameters: ten per link, then rotors, Coulomb, viscous, offset (14 n,).

    Perhaps followed by the scales of the torques of the bodies (n,).
    """

    robot: Any
    cutoff: float
    parameters: Array

    def predicted_torque(self, measured: Measured) -> Array:
        """Torque (m, n) [N·m or N] of a motion, of which the torque is not looked at."""
        return torque_of(regressor(self.robot, measured, self.cutoff), self.parameters)


def robot_from_urdf(
    urdf: str, gravity: Sequence[float] = (0.0, 0.0, -9.81), locked: Mapping[str, float] = {}
) -> Any:
    """Pinocchio's model, joints in `locked` held at their position [rad or m]."""
    whole = pin.buildModelFromXML(urdf)
    held = np.zeros(whole.nv)
    for name, position in locked.items():
        held[whole.joints[whole.getJointId(name)].idx_v] = position
    posture = pin.integrate(whole, pin.neutral(whole), held)
    robot = pin.buildReducedModel(whole, [whole.getJointId(name) for name in locked], posture)
    robot.gravity.linear = np.array(gravity)
    return robot


def fit(robot: Any, measured: Measured) -> PlainFit:
    """Choose the cut-off on the fitted part alone, then fit all of it."""
    return _best_cutoff(robot, measured, solve)


def fit_friction(robot: Any, measured: Measured) -> PlainFit:
    """Keep the URDF's bodies; fit rotor inertia, friction and offset of each joint.

    Raises:
        ValueError: the URDF has no masses.
    """
    bodies = known_bodies(robot)

    def friction(table: Array, torque: Array) -> Array:
        return solve_friction(bodies, table, torque)

    return _best_cutoff(robot, measured, friction)


def fit_friction_and_scale(robot: Any, measured: Measured) -> PlainFit:
    """Keep the URDF's bodies; fit the scale of each joint's torque, rotor, friction and offset.

    Raises:
        ValueError: the URDF has no masses.
    """
    bodies = known_bodies(robot)

    def scaled(table: Array, torque: Array) -> Array:
        n = torque.shape[1]
        parameters = np.concatenate([bodies, np.ones(n)])
        rigid = table @ bodies
        for joint in range(n):
            own = 10 * n + joint + n * np.arange(4)
            columns = np.column_stack([table[:, joint, own], rigid[:, joint]])
            places = np.append(own, 14 * n + joint)
            parameters[places] = np.linalg.lstsq(columns, torque[:, joint], rcond=_RANK)[0]
        return parameters

    return _best_cutoff(robot, measured, scaled)


def fit_with_prior(
    robot: Any,
    measured: Measured,
    cutoff: float = PRIOR_CUTOFF,
    likelihood_share: float = LIKELIHOOD_SHARE,
) -> PlainFit:
    """Fit all rows at a cut-off [Hz], held by `body_prior`."""
    table = regressor(robot, measured, cutoff)
    prior = body_prior(robot, measured)
    parameters = solve_with_prior(table, measured.torque, prior, likelihood_share)
    return PlainFit(robot, cutoff, parameters)


def _best_cutoff(
    robot: Any, measured: Measured, solved: Callable[[Array, Array], Array]
) -> PlainFit:
    cut = round(INNER_SHARE * len(measured.time))
    rate = 1.0 / np.median(np.diff(measured.time))
    tables = {f: regressor(robot, measured, f) for f in CUTOFFS if f < 0.45 * rate}

    def inner_error(cutoff: float) -> float:
        parameters = solved(tables[cutoff][:cut], measured.torque[:cut])
        return relative_error(measured.torque[cut:], torque_of(tables[cutoff][cut:], parameters))

    best = min(tables, key=inner_error)
    return PlainFit(robot, best, solved(tables[best], measured.torque))


def torque_of(table: Array, parameters: Array) -> Array:
    """Torque (m, n) of a regressor (m, n, 14 n) and parameters as in `PlainFit`."""
    n = table.shape[1]
    bodies = table[..., : 10 * n] @ parameters[: 10 * n]
    drives = table[..., 10 * n :] @ parameters[10 * n : 14 * n]
    scale = parameters[14 * n :] if len(parameters) > 14 * n else 1.0
    return np.asarray(scale * bodies + drives)


def has_masses(robot: Any) -> bool:
    """Whether the URDF knows its bodies: masses that all are equal, or zero, are placeholders."""
    moving = np.array([inertia.mass for inertia in robot.inertias])
    fixed = np.array([frame.inertia.mass for frame in robot.frames])
    # Pinocchio has added a fixed body to that of its joint, and keeps it at its frame, too.
    np.subtract.at(moving, [frame.parentJoint for frame in robot.frames], fixed)
    masses = np.concatenate([moving, fixed])
    masses = masses[masses > 1e-6 * masses.max(initial=0.0)]
    return len(masses) == 1 or (len(masses) > 1 and not np.allclose(masses, masses[0], rtol=1e-6))


def body_parameters(robot: Any) -> Array:
    """The URDF's bodies (14 n,), without rotors, friction and offsets."""
    bodies = [inertia.toDynamicParameters() for inertia in robot.inertias[1:]]
    return np.concatenate([*bodies, np.zeros(4 * robot.nv)])


def known_bodies(robot: Any) -> Array:
    """Return the URDF's bodies as `body_parameters`.

    Raises:
        ValueError: the URDF has no masses.
    """
    if not has_masses(robot):
        raise ValueError("the masses of this URDF are placeholders: all bodies have the same")
    return body_parameters(robot)


def nominal(robot: Any) -> PlainFit:
    """Return the URDF's model as it is: no friction, and nothing fitted."""
    return PlainFit(robot, PRIOR_CUTOFF, body_parameters(robot))


class Prior(NamedTuple):
    """Mean and standard deviation (14 n,) of independent Gaussian parameters; 0: not varied."""

    mean: Array
    deviation: Array


def body_prior(robot: Any, measured: Measured) -> Prior:
    """Return what is known of an arm before its torque is fitted.

    A mass varies by `BODY_SHARE` of the URDF's, a first moment by that times the body's length, an
    inertia by that times its square; masses that are not known are `UNKNOWN_MASS` about zero. Rotor
    inertia varies as much as the inertia of all links outboard, friction at the speeds of this
    motion by the scatter of its torque, the offset by twice that.
    """
    n = robot.nv
    data = robot.createData()
    neutral = pin.neutral(robot)
    mass = np.array([inertia.mass for inertia in robot.inertias[1:]])
    bodies = body_parameters(robot)
    scale = 1.0
    mass_deviation = BODY_SHARE * mass
    if not has_masses(robot):
        bodies = np.zeros(14 * n)
        mass_deviation = np.full(n, UNKNOWN_MASS)
        scale = UNKNOWN_MASS / mass.mean() if mass.any() else 0.0
    powers = np.repeat([0, 1, 2], [1, 3, 6])
    body_deviation = mass_deviation[:, None] * body_lengths(robot)[:, None] ** powers

    postures = measured.position[:: max(1, len(measured.position) // _POSTURES)]
    outboard = np.mean(
        [np.diag(pin.crba(robot, data, pin.integrate(robot, neutral, q))) for q in postures], axis=0
    )
    scatter = measured.torque.std(axis=0)
    velocity = measured.velocity
    if velocity is None:
        velocity = np.gradient(measured.position, measured.time, axis=0)
    # The friction of a joint that stands has no effect: any speed serves that is not zero.
    speed = np.sqrt(np.mean(velocity**2, axis=0))
    viscous = scatter / np.maximum(speed, 1e-3 * (speed.max() or 1.0))
    deviation = [body_deviation.ravel(), scale * outboard, scatter, viscous, 2.0 * scatter]
    return Prior(bodies, np.concatenate(deviation))


def body_lengths(robot: Any) -> Array:
    """Distance (n,) [m] from each joint to the next, or to its body's centre if that is farther."""
    length = np.array([np.linalg.norm(inertia.lever) for inertia in robot.inertias[1:]])
    for joint in range(1, robot.njoints):
        inboard = robot.parents[joint] - 1
        if inboard >= 0:
            way = np.linalg.norm(robot.jointPlacements[joint].translation)
            length[inboard] = max(length[inboard], way)
    return np.asarray(np.maximum(length, _LEAST_LENGTH * length.max()))


def regressor(robot: Any, measured: Measured, cutoff: float) -> Array:
    """Regressor (m, n, 14 n) of the filtered motion, columns as in `PlainFit`."""
    position, velocity, acceleration = filtered_motion(measured, cutoff)
    (m, n) = position.shape
    data = robot.createData()
    neutral = pin.neutral(robot)
    table = np.zeros((m, n, 14 * n))
    for row, q, qd, qdd in zip(table, position, velocity, acceleration, strict=True):
        posture = pin.integrate(robot, neutral, q)
        row[:, : 10 * n] = pin.computeJointTorqueRegressor(robot, data, posture, qd, qdd)
    joint = np.arange(n)
    friction = (acceleration, np.sign(velocity), velocity, np.ones((m, n)))
    for block, columns in enumerate(friction, 10):
        table[:, joint, block * n + joint] = columns
    return table


def filtered_motion(measured: Measured, cutoff: float) -> tuple[Array, Array, Array]:
    """Position, velocity and acceleration (m, n)."""
    position = low_passed(measured.time, measured.position, cutoff)
    velocity = np.gradient(position, measured.time, axis=0)
    if measured.velocity is not None:
        velocity = low_passed(measured.time, measured.velocity, cutoff)
    return position, velocity, np.gradient(velocity, measured.time, axis=0)


def low_passed(time: Array, values: Array, cutoff: float) -> Array:
    """Values (m, n) through a Butterworth filter of order 4, forth and back.

    Unchanged if the log is too slow to hold anything above the cut-off.
    """
    rate = 1.0 / np.median(np.diff(time))
    if cutoff >= 0.5 * rate:
        return values
    sections = scipy.signal.butter(4, cutoff, fs=rate, output="sos")
    padding = min(len(time) - 1, round(rate / cutoff))
    return np.asarray(scipy.signal.sosfiltfilt(sections, values, axis=0, padlen=padding))


def causally_low_passed(time: Array, values: Array, cutoff: float) -> Array:
    """Values (m, n) through a Butterworth filter of order 2, initially at rest, as in a drive."""
    rate = 1.0 / float(np.median(np.diff(time)))
    sections = scipy.signal.butter(2, cutoff, fs=rate, output="sos")
    start = scipy.signal.sosfilt_zi(sections)[:, :, None] * values[0]
    return np.asarray(scipy.signal.sosfilt(sections, values, axis=0, zi=start)[0])


def solve(table: Array, torque: Array) -> Array:
    """Weighted least squares (14 n,) of minimum norm; a joint's weight is that of its residual."""
    factors = _joint_factors(table, torque)
    least = 1e-9 * float(np.linalg.norm(torque)) or 1.0
    scale: Array = np.ones(torque.shape[1])
    for _ in range(_ROUNDS):
        rows = np.vstack([factor / s for factor, s in zip(factors, scale, strict=True)])
        parameters: Array = np.asarray(np.linalg.lstsq(rows[:, :-1], rows[:, -1], rcond=_RANK)[0])
        scale = np.maximum(_residuals(factors, parameters), least)
    return parameters


def solve_friction(bodies: Array, table: Array, torque: Array) -> Array:
    """Least squares (14 n,) over the last four parameters of each joint, the bodies given."""
    n = torque.shape[1]
    parameters: Array = bodies.copy()
    left = torque - table @ bodies
    for joint in range(n):
        columns = 10 * n + joint + n * np.arange(4)
        parameters[columns] = np.linalg.lstsq(
            table[:, joint, columns], left[:, joint], rcond=_RANK
        )[0]
    return parameters


def solve_with_prior(
    table: Array, torque: Array, prior: Prior, likelihood_share: float = LIKELIHOOD_SHARE
) -> Array:
    """Most probable parameters (14 n,); a joint's noise is that of its residual, iterated."""
    factors = _joint_factors(table, torque)
    least = 1e-9 * float(np.linalg.norm(torque)) or 1.0
    parameters: Array = prior.mean
    noise = np.maximum(torque.std(axis=0), least)
    for _ in range(_ROUNDS):
        weighted = [factor / s for factor, s in zip(factors, noise, strict=True)]
        rows = np.sqrt(likelihood_share) * np.vstack(weighted)
        # In units of the prior's deviations, in which the prior is the unit matrix.
        scaled = np.vstack([rows[:, :-1] * prior.deviation, np.eye(len(prior.mean))])
        right = rows[:, -1] - rows[:, :-1] @ prior.mean
        right = np.concatenate([right, np.zeros(len(prior.mean))])
        parameters = prior.mean + prior.deviation * np.linalg.lstsq(scaled, right, rcond=None)[0]
        noise = np.maximum(_residuals(factors, parameters) / np.sqrt(len(torque)), least)
    return np.asarray(parameters)


def _joint_factors(table: Array, torque: Array) -> list[Array]:
    """One triangular factor of regressor and torque per joint: all that an iteration needs."""
    joints = range(torque.shape[1])
    return [np.linalg.qr(np.column_stack([table[:, j], torque[:, j]])).R for j in joints]


def _residuals(factors: Sequence[Array], parameters: Array) -> Array:
    """Norm of the residual (n,) of each joint."""
    return np.array([np.linalg.norm(factor @ np.append(parameters, -1.0)) for factor in factors])


def relative_error(torque: Array, predicted: Array) -> float:
    """||tau - tau_hat|| / ||tau|| over all joints and rows."""
    return float(np.linalg.norm(torque - predicted) / np.linalg.norm(torque))


def main(arguments: Sequence[str] | None = None) -> None:
    """Fit the first part of a log and predict the rest; print a line of JSON."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("log", type=Path)
    parser.add_argument("urdf", type=Path)
    parser.add_argument("--share", type=float, default=INNER_SHARE, help="of the rows, fitted")
    options = parser.parse_args(arguments)
    with np.load(options.log) as arrays:
        whole = Measured(
            arrays["time"], arrays["position"], arrays.get("velocity"), arrays["torque"]
        )
    cut = round(options.share * len(whole.time))
    first = whole.rows(slice(0, cut))
    last = whole.rows(slice(cut, None))
    fitted = fit(robot_from_urdf(options.urdf.read_text(encoding="utf-8")), first)
    errors = {
        name: relative_error(part.torque, fitted.predicted_torque(part))
        for name, part in (("fitted", first), ("predicted", last))
    }
    print(json.dumps({"cutoff": fitted.cutoff, **errors}))


if __name__ == "__main__":
    main()
