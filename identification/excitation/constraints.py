"""Constraints of a motion: joint limits, duration, clearance, torque and motor current."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np

from identification.arrays import Array
from identification.excitation.collision import CollisionChecker, Proximity
from identification.excitation.violation import (
    CloseBodies,
    JointQuantity,
    LoadedDrive,
    UsableShare,
    Violation,
    WholeMotion,
)
from identification.model.motion import Motion
from identification.model.robot import RobotModel
from planner.errors import NotSmooth
from planner.fourier import FourierSeries
from planner.limits import JointLimits, position_rounding
from planner.piecewise_cubic import Extrema, PiecewiseCubic, Trajectory, check_rest

# Checks sample both ends of a motion, criteria the middles of the steps: at rest at an end
# sgn(qd) is 0 or, after rounding, ±1. From 1 to 8 ms log det of random motions of the NS 16 changes
# by 0.002 without bias with midpoints, by 0.02 with ends.
SAMPLE_PERIOD: Final = 0.008
"""Sample period of checks and criteria, s; the tip of a fast arm moves some 4 cm in it."""

# Relative to a period; a duration of a whole number of periods and less gets no further sample.
_PERIOD_ROUNDING: Final = 1e-9


def sampled(trajectory: Trajectory, period: float = SAMPLE_PERIOD) -> Motion:
    """Sample a motion at the ends of equal steps of at most `period` [s]."""
    time = np.linspace(0.0, trajectory.duration, _steps(trajectory, period) + 1)
    return Motion(time, *trajectory.sample(time))


def midpoints(trajectory: Trajectory, period: float = SAMPLE_PERIOD) -> Motion:
    """Sample a motion in the middle of N equal steps of at most `period` [s] (N of eq. 9)."""
    steps = _steps(trajectory, period)
    time = (np.arange(steps, dtype=np.float64) + 0.5) * (trajectory.duration / steps)
    return Motion(time, *trajectory.sample(time))


def _steps(trajectory: Trajectory, period: float) -> int:
    return max(1, math.ceil(trajectory.duration / period - _PERIOD_ROUNDING))


_RATES = ("velocity", "acceleration", "jerk")


def limit_violations(
    trajectory: PiecewiseCubic | FourierSeries, limits: JointLimits, motion: Motion
) -> list[Violation]:
    """Return the largest violation of each quantity and joint.

    Its time is the time of a sample of the motion; samples include both ends.
    """
    return _beyond_limits(trajectory.extrema(), limits, motion)


def rest_violations(
    trajectory: PiecewiseCubic | FourierSeries, limits: JointLimits
) -> list[Violation]:
    """Return the largest rate at the start or end of a motion, if it is not zero."""
    try:
        check_rest(trajectory, limits)
    except NotSmooth as jump:
        end: Literal["start", "end"] = "end" if jump.time > 0.0 else "start"
        bare = isinstance(trajectory, FourierSeries) and trajectory.ramp == 0.0
        return [
            Violation(
                "joint limit",
                JointQuantity(jump.quantity, jump.joint, end),
                jump.jump,
                0.0,
                jump.time,
                scale=float(getattr(limits, jump.quantity)[jump.joint]),
                remedy="set a ramp" if bare else "rest at both ends",
            )
        ]
    return []


def _beyond_limits(extrema: Extrema, limits: JointLimits, motion: Motion) -> list[Violation]:
    rounding = position_rounding(limits)
    span = limits.upper - limits.lower
    # Quantity, extremum, bound, sign of an excess, tolerance, scale.
    rows = [
        ("position", extrema.lower, limits.lower, -1.0, rounding, span),
        ("position", extrema.upper, limits.upper, 1.0, rounding, span),
    ]
    for name in _RATES:
        bound = getattr(limits, name)
        rows.append((name, getattr(extrema, name), bound, 1.0, 0.0 * bound, bound))
    violations = []
    for quantity, value, bound, sign, tolerance, scale in rows:
        broken = np.flatnonzero(~(sign * value <= sign * bound + tolerance)).tolist()  # NaN as well
        for joint in broken:
            if quantity == "position":
                size = sign * motion.position
            else:
                size = _rates(motion)[_RATES.index(quantity)]
            k = int(np.argmax(size[:, joint]))
            violations.append(
                Violation(
                    "joint limit",
                    JointQuantity(quantity, joint),
                    float(value[joint]),
                    float(bound[joint]),
                    float(motion.time[k]),
                    tuple(motion.position[k].tolist()),
                    scale=float(scale[joint]),
                )
            )
    return violations


def _rates(motion: Motion) -> tuple[Array, Array, Array]:
    """Return |qd|, |qdd| at the samples and the mean |jerk| between them."""
    jerk = np.diff(motion.acceleration, axis=0) / np.diff(motion.time)[:, None]
    return np.abs(motion.velocity), np.abs(motion.acceleration), np.abs(jerk)


@dataclass(frozen=True, eq=False)
class CurrentModel:
    """Predicts joint torques and motor currents of a motion from nominal parameters.

    Joint torque and motor current: ``tau = motor_from_joint^T (torque_constant * current)``.
    """

    model: RobotModel  #: the robot
    values: Array  #: (p,) its nominal parameters
    motor_from_joint: Array  #: (n, n) motor rad per joint rad; gears and coupling
    torque_constant: Array  #: (n,) on the motor side [N·m/A]
    current_limit: Array  #: (n,) largest |current| of each motor [A]
    uncertainty: float = 0.0  #: fraction by which torques may exceed the nominal ones
    torque_limit: Array | None = None  #: (n,) largest |torque| of each joint [N·m], if any
    usable: float = 1.0  #: fraction of the current limits that a motion may use

    def torque(self, motion: Motion) -> Array:
        """Return the largest expected joint torques (m, n) [N·m], payload included."""
        nominal = self.model.torque(self.values, motion) + self.model.load_torque(motion)
        return (1.0 + self.uncertainty) * nominal

    def current(self, torque: Array) -> Array:
        """Return the motor currents (m, n) [A] for joint torques (m, n) [N·m]."""
        motor_torque = np.linalg.solve(self.motor_from_joint.T, torque.T).T
        return np.asarray(motor_torque / self.torque_constant, dtype=np.float64)

    def loads(self, motion: Motion) -> Array:
        """Return |current|, then |torque|, as fractions of what a motion may use (m, n or 2 n)."""
        torque = self.torque(motion)
        loads = np.abs(self.current(torque)) / (self.usable * self.current_limit)
        if self.torque_limit is None:
            return np.asarray(loads)
        return np.column_stack((loads, np.abs(torque) / self.torque_limit))

    def check(self, motion: Motion) -> list[Violation]:
        """Return the largest violation of each joint and motor in the samples."""
        torque = self.torque(motion)
        joints = self.model.joint_names
        usable = self.usable * self.current_limit
        violations = _beyond("current", joints, self.current(torque), usable, motion)
        if self.usable < 1.0:
            share = UsableShare(self.usable)
            violations = [replace(violation, remedy=share) for violation in violations]
        if self.torque_limit is not None:
            violations += _beyond("torque", joints, torque, self.torque_limit, motion)
        return violations


def _beyond(
    kind: Literal["current", "torque"],
    joints: tuple[str, ...],
    values: Array,
    bounds: Array,
    motion: Motion,
) -> list[Violation]:
    violations = []
    magnitude = np.abs(values)
    for j, k in enumerate(np.argmax(magnitude, axis=0)):
        if not magnitude[k, j] <= bounds[j]:  # NaN as well
            posture = tuple(motion.position[k].tolist())
            time = float(motion.time[k])
            most = float(magnitude[k, j]), float(bounds[j])
            drive = LoadedDrive(j, joints[j], is_motor=kind == "current")
            violations.append(Violation(kind, drive, *most, time, posture))
    return violations


@dataclass(frozen=True, eq=False)
class Constraints:
    """Constraints of a motion; all are evaluated, so that sums of excesses are comparable."""

    limits: JointLimits  #: joint limits at every instant
    min_duration: float = 0.0  #: of the motion [s]
    max_duration: float = 20.0  #: of the motion [s]
    checker: CollisionChecker | None = None  #: floor, walls, boxes and arm; None: not checked
    currents: CurrentModel | None = None  #: torques and currents; None: not checked
    #: whether a motion must begin and end at rest, which sines without a ramp do not
    at_rest: bool = True

    def violations(
        self, trajectory: PiecewiseCubic | FourierSeries, motion: Motion
    ) -> tuple[Violation, ...]:
        """Return the worst violation of each kind and subject, and the deepest contact.

        `motion` are its samples, both ends included. Joint limits and contacts are checked between
        them too; contacts only every 8 ms if a joint limit is broken, not at all if not finite.

        Raises:
            ShapeError: samples of another arm.
        """
        violations = rest_violations(trajectory, self.limits) if self.at_rest else []
        beyond = limit_violations(trajectory, self.limits, motion)
        violations += beyond
        duration = trajectory.duration
        bound = min(max(duration, self.min_duration), self.max_duration)
        if bound != duration:
            violations.append(Violation("duration", WholeMotion(), duration, bound, None))
        if beyond and not motion.finite:
            return tuple(violations)
        if self.checker is not None:
            # With rates beyond the limits, the bounds between samples are too wide to be of use.
            contact = self.checker.deepest_along(trajectory, between=not beyond)
            violations += [] if contact is None else [_collision(self.checker, contact)]
        if self.currents is not None:
            violations += self.currents.check(motion)
        return tuple(violations)


def check_motion(
    trajectory: PiecewiseCubic | FourierSeries,
    limits: JointLimits,
    *,
    checker: CollisionChecker | None = None,
    currents: CurrentModel | None = None,
    period: float = SAMPLE_PERIOD,
) -> tuple[Violation, ...]:
    """Return the violations of a motion of any duration, none if it may be sent.

    Limits, rest at both ends and contacts are checked over all time.

    Args:
        trajectory: the motion.
        limits: of the joints.
        checker: of collisions; none are checked without it.
        currents: of the motors; likewise.
        period: at which torques and currents are checked [s].
    """
    constraints = Constraints(limits, max_duration=np.inf, checker=checker, currents=currents)
    return constraints.violations(trajectory, sampled(trajectory, period))


def clearance(checker: CollisionChecker, q: Array) -> Violation | None:
    """Return the deepest contact in postures (m, n), if there is one."""
    contact = checker.deepest_contact(q)
    return None if contact is None else _collision(checker, contact)


def _collision(checker: CollisionChecker, contact: Proximity) -> Violation:
    return Violation(
        "collision",
        CloseBodies(contact.first, contact.second),
        contact.distance,
        contact.required,
        contact.time,
        contact.posture,
        scale=checker.arm_length,
    )
