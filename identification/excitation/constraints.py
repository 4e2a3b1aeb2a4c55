"""What a motion must keep: joint limits, duration, clearance, torque and motor current."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification.excitation.collision.checker import CollisionChecker, Contact
from identification.excitation.joint_limits import limit_violations, rest_violations
from identification.excitation.violation import Kind, Violation
from identification.model.motion import Motion
from identification.model.robot import RobotModel
from planner import FourierSeries, JointLimits, PiecewiseCubic, Trajectory

# Checks want both ends of a motion, criteria the middles of the steps: a joint that rests at an end
# has sgn(qd) = 0 there, or, after rounding, ±1 without moving, and weighs the more the fewer the
# samples. Judged at 8 instead of 1 ms, log det of random motions of the NS 16 changes by 0.002 with
# middles (and not to one side), by 0.02 with ends.
SAMPLE_PERIOD: Final = 0.008
"""s; motions are looked at this often. A fast arm's tip moves some 4 cm meanwhile."""

# A duration that is a whole number of periods but for its rounding gets no further sample.
_ROUNDING: Final = 1e-9


def sampled(trajectory: Trajectory, period: float = SAMPLE_PERIOD) -> Motion:
    """Return a motion at the ends of equal steps of at most `period` [s], both ends included."""
    time = np.linspace(0.0, trajectory.duration, _steps(trajectory, period) + 1)
    return Motion(time, *trajectory.sample(time))


def midpoints(trajectory: Trajectory, period: float = SAMPLE_PERIOD) -> Motion:
    """Return a motion in the middle of equal steps of at most `period` [s], neither end included.

    Their number is the N of the criteria.
    """
    steps = _steps(trajectory, period)
    time = (np.arange(steps, dtype=np.float64) + 0.5) * (trajectory.duration / steps)
    return Motion(time, *trajectory.sample(time))


def _steps(trajectory: Trajectory, period: float) -> int:
    return max(1, math.ceil(trajectory.duration / period - _ROUNDING))


Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class CurrentModel:
    """Predicts joint torques and motor currents of a motion from nominal parameters.

    Torque of the joints and current of the motors belong together as
    ``tau = motor_from_joint^T (torque_constant * current)``.
    """

    model: RobotModel  #: the robot
    values: Array  #: (p,) its nominal parameters
    motor_from_joint: Array  #: (n, n) motor rad per joint rad; gears and coupling
    torque_constant: Array  #: (n,) on the motor side [N·m/A]
    current_limit: Array  #: (n,) largest |current| of each motor [A]
    uncertainty: float = 0.0  #: share by which the real torques may be larger than the nominal ones
    #: (n,) largest |torque| of each joint [N·m], where one is set besides
    torque_limit: Array | None = None
    usable: float = 1.0  #: share of the current limits that a motion may use

    def torque(self, motion: Motion) -> Array:
        """Return the joint torques (m, n) [N·m] that a motion needs at most, payload included."""
        q, qd, qdd = motion[1:4]
        nominal = self.model.torque(self.values, q, qd, qdd) + self.model.load_torque(q, qd, qdd)
        return (1.0 + self.uncertainty) * nominal

    def current(self, torque: Array) -> Array:
        """Return the motor currents (m, n) [A] that make joint torques (m, n) [N·m]."""
        motor_torque = np.linalg.solve(self.motor_from_joint.T, torque.T).T
        return np.asarray(motor_torque / self.torque_constant, dtype=np.float64)

    def check(self, motion: Motion) -> list[Violation]:
        """Return for each joint and motor its largest excess in the samples, if there is any."""
        torque = self.torque(motion)
        joints = self.model.joint_names
        motors = tuple(f"motor of {name}" for name in joints)
        usable = self.usable * self.current_limit
        found = _beyond("current", motors, self.current(torque), usable, motion)
        if self.usable < 1.0:
            wanted = f"{self.usable:.0%} of the motor's limit may be used"
            found = [replace(violation, remedy=wanted) for violation in found]
        if self.torque_limit is not None:
            found += _beyond("torque", joints, torque, self.torque_limit, motion)
        return found


def _beyond(
    kind: Kind, subjects: tuple[str, ...], values: Array, bounds: Array, motion: Motion
) -> list[Violation]:
    found = []
    size = np.abs(values)
    for j, k in enumerate(np.argmax(size, axis=0)):
        if not size[k, j] <= bounds[j]:  # NaN is beyond every bound
            posture, time = tuple(motion.position[k].tolist()), float(motion.time[k])
            most = float(size[k, j]), float(bounds[j])
            found.append(Violation(kind, subjects[j], *most, time, posture))
    return found


@dataclass(frozen=True)
class MotionCheck:
    """What checking a motion found; an empty list means that it may be sent."""

    violations: tuple[Violation, ...]

    @property
    def ok(self) -> bool:
        """Whether every constraint is satisfied."""
        return not self.violations


@dataclass(frozen=True, eq=False)
class Constraints:
    """What a motion must keep.

    Everything is looked at whatever else is broken: only then do the excesses of two motions
    compare, and a motion that is mended in one respect is not found broken in another.
    """

    limits: JointLimits  #: joint limits, respected at every instant
    min_duration: float = 0.0  #: of the motion [s]
    max_duration: float = 20.0  #: of the motion [s]
    #: floor, walls, boxes and the arm itself; None to look at none of them
    checker: CollisionChecker | None = None
    #: nominal torques and currents with their uncertainty; None to look at neither
    currents: CurrentModel | None = None
    #: whether a motion must begin and end at rest. A bare series of sines does not: it can be
    #: designed and looked at, and cannot be run
    at_rest: bool = True

    def violations(
        self, trajectory: PiecewiseCubic | FourierSeries, motion: Motion
    ) -> tuple[Violation, ...]:
        """Return what a motion breaks: of each kind and subject the worst, of contacts the deepest.

        Joint limits and contacts are looked at between the samples (both ends included) too, the
        rest at them; contacts of a motion that breaks a joint limit at its samples only, and a
        motion so violent that its samples are no finite numbers for joint limits alone.

        Raises:
            ShapeError: samples of another arm.
        """
        found = rest_violations(trajectory, self.limits) if self.at_rest else []
        beyond = limit_violations(trajectory, self.limits, motion)
        found += beyond
        duration = trajectory.duration
        bound = min(max(duration, self.min_duration), self.max_duration)
        if bound != duration:
            found.append(Violation("duration", "the motion", duration, bound, None))
        if beyond and not all(np.all(np.isfinite(column)) for column in motion[:4]):
            return tuple(found)
        if self.checker is not None:
            # Rates beyond all limits leave everything open between samples, at any price.
            contact = self.checker.deepest_along(trajectory, motion, between=not beyond)
            found += [] if contact is None else [_collision(self.checker, contact)]
        if self.currents is not None:
            found += self.currents.check(motion)
        return tuple(found)


def check_motion(
    trajectory: PiecewiseCubic | FourierSeries,
    limits: JointLimits,
    *,
    checker: CollisionChecker | None = None,
    currents: CurrentModel | None = None,
    period: float = SAMPLE_PERIOD,
) -> MotionCheck:
    """Check a whole motion, of whatever duration, before it is sent.

    Limits, rest at both ends and contacts are looked at over all time, torques and currents every
    `period` [s].
    """
    constraints = Constraints(limits, max_duration=np.inf, checker=checker, currents=currents)
    return MotionCheck(constraints.violations(trajectory, sampled(trajectory, period)))


def clearance(checker: CollisionChecker, q: Array, time: Array | None = None) -> Violation | None:
    """Return the deepest contact in postures (m, n), reached at times (m,), if there is one."""
    contact = checker.deepest_contact(q, time)
    return None if contact is None else _collision(checker, contact)


def _collision(checker: CollisionChecker, contact: Contact) -> Violation:
    return Violation(
        "collision",
        f"{contact.first} and {contact.second}",
        contact.distance,
        checker.workspace.margin,
        contact.time,
        contact.posture,
        scale=checker.arm_length,
    )
