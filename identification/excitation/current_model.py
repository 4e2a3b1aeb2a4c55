"""Joint torques and motor currents that a motion needs by the nominal model."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from identification.errors import ShapeError
from identification.excitation.violation import Kind, Violation
from identification.model import RobotModel
from identification.motion import Motion

Array = NDArray[np.float64]


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
        usable: share of the current limits that a motion may use.

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
    usable: float = 1.0

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
    worst = np.argmax(size, axis=0)
    largest = size[worst, np.arange(len(worst))]
    for j in np.flatnonzero(~(largest <= bounds)).tolist():  # NaN is beyond every bound
        k = int(worst[j])
        posture = tuple(motion.position[k].tolist())
        time = float(motion.time[k])
        found.append(
            Violation(kind, subjects[j], float(largest[j]), float(bounds[j]), time, posture)
        )
    return found
