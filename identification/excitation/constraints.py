"""What a motion must keep before it is sent: joint limits, clearance, torque and motor current."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from identification.errors import ShapeError
from identification.excitation.collision import CollisionChecker
from identification.model import RobotModel
from identification.motion import Motion
from planner import JointLimits, LimitExceeded, PiecewiseCubic, check_limits

Array = NDArray[np.float64]
Kind = Literal["planning", "joint limit", "duration", "collision", "torque", "current"]

SAMPLE_PERIOD = 0.008
"""s; motions are looked at this often. A fast arm's tip moves some 4 cm meanwhile."""

_UNITS: dict[Kind, str] = {
    "planning": "",
    "joint limit": "",
    "duration": " s",
    "collision": " m",
    "torque": " N·m",
    "current": " A",
}


@dataclass(frozen=True)
class Violation:
    """One constraint that a motion breaks, at its worst instant.

    Attributes:
        kind: which constraint.
        subject: joint, motor ("motor of joint_3"), or the pair that comes too close.
        value: what it reaches (a distance for a collision), SI.
        bound: what it may reach at most (for a collision and a too short motion: at least), SI.
        time: when [s]; None on a way that has no times yet.
        posture: joint positions there [rad]; empty where they play no part.
    """

    kind: Kind
    subject: str
    value: float
    bound: float
    time: float | None
    posture: tuple[float, ...] = ()

    @property
    def excess(self) -> float:
        """How far beyond the bound (> 0), as a share of it; absolute where the bound is zero."""
        return abs(self.value - self.bound) / (abs(self.bound) or 1.0)

    def __str__(self) -> str:
        unit = _UNITS[self.kind]
        text = (
            f"{self.kind} of {self.subject}: {self.value:.4g}{unit}, bound {self.bound:.4g}{unit}"
        )
        if self.time is not None:
            text += f", at {self.time:.3f} s"
        if self.posture:
            text += f", joints at ({', '.join(f'{q:.3f}' for q in self.posture)}) rad"
        return text


@dataclass(frozen=True)
class MotionCheck:
    """What checking a motion found; an empty list means that it may be sent."""

    violations: tuple[Violation, ...]

    @property
    def ok(self) -> bool:
        """Whether every constraint is kept."""
        return not self.violations


@dataclass(frozen=True, eq=False)
class CurrentModel:
    """Predicts joint torques and motor currents of a motion from nominal parameters.

    Torque of the joints and current of the motors belong together as
    ``tau = motor_from_joint^T (torque_constant * current)``.

    Attributes:
        model: the robot.
        values: (p,) its nominal parameters.
        motor_from_joint: (n, n) motor rad per joint rad; gears and coupling.
        torque_constant: (n,) on the motor side [N·m/A].
        current_limit: (n,) largest |current| of each motor [A].
        uncertainty: share by which the real torques may be larger than the nominal ones.
        torque_limit: (n,) largest |torque| of each joint [N·m], where one is set besides.

    Raises:
        ShapeError: an array does not belong to the model's number of joints or parameters.
    """

    model: RobotModel
    values: Array
    motor_from_joint: Array
    torque_constant: Array
    current_limit: Array
    uncertainty: float = 0.0
    torque_limit: Array | None = None

    def __post_init__(self) -> None:
        n = self.model.n_joints
        for name, shape in (
            ("values", (self.model.n_parameters,)),
            ("motor_from_joint", (n, n)),
            ("torque_constant", (n,)),
            ("current_limit", (n,)),
            ("torque_limit", (n,)),
        ):
            array = getattr(self, name)
            if array is not None and np.shape(array) != shape:
                raise ShapeError(name, np.shape(array), str(shape))

    def torque(self, motion: Motion) -> Array:
        """Return the joint torques (m, n) [N·m] that a motion needs at most."""
        nominal = self.model.torque(
            self.values, motion.position, motion.velocity, motion.acceleration
        )
        return (1.0 + self.uncertainty) * nominal

    def current(self, torque: Array) -> Array:
        """Return the motor currents (m, n) [A] that make joint torques (m, n) [N·m]."""
        motor_torque = np.linalg.solve(self.motor_from_joint.T, torque.T).T
        return np.asarray(motor_torque / self.torque_constant, dtype=np.float64)

    def check(self, motion: Motion) -> list[Violation]:
        """Return for each joint and motor its largest excess, if there is any."""
        torque = self.torque(motion)
        joints = self.model.joint_names
        motors = tuple(f"motor of {name}" for name in joints)
        found = _beyond("current", motors, self.current(torque), self.current_limit, motion)
        if self.torque_limit is not None:
            found += _beyond("torque", joints, torque, self.torque_limit, motion)
        return found


def check_motion(
    trajectory: PiecewiseCubic,
    limits: JointLimits,
    *,
    checker: CollisionChecker | None = None,
    currents: CurrentModel | None = None,
    period: float = SAMPLE_PERIOD,
) -> MotionCheck:
    """Check a whole motion: limits analytically, all else every `period` [s]."""
    found: list[Violation] = []
    try:
        check_limits(trajectory, limits)
    except LimitExceeded as excess:
        subject = f"{excess.quantity} of joint {excess.joint}"
        found.append(Violation("joint limit", subject, excess.value, excess.bound, None))
    motion = sampled(trajectory, period)
    if checker is not None:
        contact = clearance(checker, motion.position, motion.time)
        found += [contact] if contact is not None else []
    if currents is not None:
        found += currents.check(motion)
    return MotionCheck(tuple(found))


def sampled(trajectory: PiecewiseCubic, period: float) -> Motion:
    """Return a motion every `period` [s], both ends included."""
    steps = int(np.ceil(trajectory.duration / period))
    time = np.minimum(np.arange(steps + 1) * period, trajectory.duration)
    return Motion(time, *trajectory.sample(time))


def clearance(checker: CollisionChecker, q: Array, time: Array | None = None) -> Violation | None:
    """Return the first contact along postures (m, n) at times (m,), if there is one."""
    contact = checker.first_contact(q)
    if contact is None:
        return None
    return Violation(
        "collision",
        f"{contact.first} and {contact.second}",
        contact.distance,
        checker.workspace.margin,
        None if time is None else float(time[contact.sample]),
        tuple(q[contact.sample].tolist()),
    )


def _beyond(
    kind: Kind, subjects: tuple[str, ...], values: Array, bounds: Array, motion: Motion
) -> list[Violation]:
    found = []
    for j, worst in enumerate(np.argmax(np.abs(values), axis=0).tolist()):
        value = float(abs(values[worst, j]))
        if not value <= bounds[j]:  # NaN is beyond every bound
            posture = tuple(motion.position[worst].tolist())
            time = float(motion.time[worst])
            found.append(Violation(kind, subjects[j], value, float(bounds[j]), time, posture))
    return found
