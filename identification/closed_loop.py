"""Motion of an identified arm under a servo that follows the recorded command.

The instruments of IDIM-IV in their original form (Janot, Vandanjon and Gautier 2014): direct
dynamics with the current estimate, closed by the controller of the real arm. The result has no
measurement noise, and the following errors of the real servo. It need not be exact, so steps are
linearly implicit: stable for every stiff gain and for Coulomb friction at standstill.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from identification.errors import IdentificationError, ShapeError
from identification.instrument_motion import Instruments
from identification.kinematics import FROM_PINOCCHIO, Chain
from identification.model import RobotModel
from identification.motion import Motion

Array = NDArray[np.float64]

LONGEST_STEP: Final = 2e-3  # s
_NARROWEST_STANDSTILL: Final = 1e-3  # rad/s or m/s
_MASS: Final = 9  # of the ten parameters of a link
# Pinocchio divides first moments by masses: they are kept as near to the nominal as torques allow.
_RELUCTANCE: Final = 1e3


@dataclass(frozen=True, eq=False)
class JointServo:
    """Position and velocity control of n joints, joint side.

    Torque: position (q_c - q) + velocity (qd_c - qd), and with `feedforward` the torque that the
    model needs for the command.

    Attributes:
        position: gain (n,) [N·m/rad or N/m].
        velocity: gain (n,) [N·m·s/rad or N·s/m].
        feedforward: whether the controller adds its model of the dynamics.
    """

    position: Array
    velocity: Array
    feedforward: bool = False

    def __post_init__(self) -> None:
        for name in ("position", "velocity"):
            gain = getattr(self, name)
            if not (np.all(np.isfinite(gain)) and np.all(gain > 0.0)):
                raise ValueError(f"servo gain {name} is {gain}, must be positive")


def simulated_motion(
    model: RobotModel, values: Array, servo: JointServo, command: Motion
) -> Instruments:
    """Simulate the arm following a command, from rest on it.

    Args:
        model: the robot.
        values: its parameters (p,), an earlier estimate.
        servo: of all joints.
        command: what it follows, without gaps, in the rows the result is to have: see
            :func:`identification.instrument_motion.planned_motion`, without lag.

    Raises:
        ShapeError: arrays of other shapes than the model's.
        IdentificationError: the parameters give some posture no positive mass matrix: nothing
            can be simulated with them.
    """
    if np.shape(servo.position) != (model.n_joints,) or np.shape(servo.velocity) != (
        model.n_joints,
    ):
        raise ShapeError("servo gains", np.shape(servo.position), f"({model.n_joints},)")
    arm = _arm(model, values)
    friction = _Friction.of(model, values)
    ahead = np.zeros(command.position.shape)
    if servo.feedforward:
        ahead = model.torque(values, *command[1:])
    q, qd = _run(arm, friction, servo, command, ahead)
    qdd = np.gradient(qd, command.time, axis=0)
    return Instruments(
        Motion(command.time, q, qd, qdd),
        np.ones(q.shape, dtype=np.bool_),
        np.full(model.n_joints, np.nan),
        "the closed loop, simulated with an earlier estimate",
    )


def _run(
    arm: pin.Model, friction: _Friction, servo: JointServo, command: Motion, ahead: Array
) -> tuple[Array, Array]:
    """Positions and velocities (m, n) at the instants of the command."""
    data = arm.createData()
    positions, velocities = np.empty_like(command.position), np.empty_like(command.position)
    q, qd = command.position[0].copy(), command.velocity[0].copy()
    positions[0], velocities[0] = q, qd
    for k in range(1, len(command.time)):
        span = float(command.time[k] - command.time[k - 1])
        count = max(1, int(np.ceil(span / LONGEST_STEP)))
        h = span / count
        for i in range(count):
            share = (i + 1) / count
            wanted = _between(command.position, k, share)
            speed = _between(command.velocity, k, share)
            torque = _between(ahead, k, share) - friction.torque(qd)
            torque += servo.position * (wanted - q - h * qd) + servo.velocity * (speed - qd)
            mass = pin.crba(arm, data, q)
            torque -= pin.nonLinearEffects(arm, data, q, qd)
            stiff = servo.velocity + friction.slope(qd) + h * servo.position
            matrix = np.triu(mass) + np.triu(mass, 1).T
            matrix[np.diag_indices_from(matrix)] += h * stiff
            try:
                factor = np.linalg.cholesky(matrix)
            except np.linalg.LinAlgError:
                raise IdentificationError(
                    f"the parameters have no positive mass matrix at {q.round(3).tolist()}: a"
                    " motion cannot be simulated with them; use the planned motion"
                ) from None
            qd = qd + h * np.linalg.solve(factor.T, np.linalg.solve(factor, torque))
            q = q + h * qd
        positions[k], velocities[k] = q, qd
    return positions, velocities


def _between(rows: Array, k: int, share: float) -> Array:
    return np.asarray((1.0 - share) * rows[k - 1] + share * rows[k])


@dataclass(frozen=True, eq=False)
class _Friction:
    """Friction of all joints, sign made linear below standstill speed so that it can stick."""

    coulomb: Array
    viscous: Array
    third: Array
    offset: Array
    exponent: int
    standstill: float

    @classmethod
    def of(cls, model: RobotModel, values: Array) -> _Friction:
        n, law = model.n_joints, model.friction
        place = {name: k for k, name in enumerate(model.parameter_names)}

        def coefficients(symbol: str) -> Array:
            names = [f"{symbol}_{joint}" for joint in range(1, n + 1)]
            return np.array([values[place[name]] if name in place else 0.0 for name in names])

        return cls(
            coulomb=coefficients("f0"),
            viscous=coefficients("f1"),
            third=coefficients("f2"),
            offset=coefficients("fo"),
            exponent=3 if law.third == "cubic" else 2,
            standstill=max(law.standstill, _NARROWEST_STANDSTILL),
        )

    def torque(self, qd: Array) -> Array:
        size = np.abs(qd) ** (self.exponent - 1)
        sign = np.clip(qd / self.standstill, -1.0, 1.0)
        return np.asarray(
            self.coulomb * sign + (self.viscous + self.third * size) * qd + self.offset
        )

    def slope(self, qd: Array) -> Array:
        """Derivative with speed, never negative."""
        size = self.exponent * np.abs(qd) ** (self.exponent - 1)
        sticking = np.abs(qd) < self.standstill
        slope = self.viscous + self.third * size + sticking * self.coulomb / self.standstill
        return np.asarray(np.maximum(slope, 0.0))


def _arm(model: RobotModel, values: Array) -> pin.Model:
    """Pinocchio model with these base parameters: any bodies with the same torques will do."""
    standard, rotors = standard_parameters(model, values)
    arm = _skeleton(model.chain)
    arm.gravity.linear = model.gravity
    for joint, link in enumerate(standard):
        if not link[_MASS] > 0.0:
            raise IdentificationError(
                f"the parameters leave link {joint + 1} no positive mass: a motion cannot be"
                " simulated with them; use the planned motion"
            )
        pinocchio_order = np.empty(len(FROM_PINOCCHIO))
        pinocchio_order[list(FROM_PINOCCHIO)] = link
        arm.inertias[joint + 1] = pin.Inertia.FromDynamicParameters(pinocchio_order)
    arm.armature = rotors
    return arm


def standard_parameters(model: RobotModel, values: Array) -> tuple[Array, Array]:
    """Standard parameters with given base parameters (p,), as near to the nominal as need be.

    They are equivalent to the base parameters, not physical: rotors may hold what belongs to
    links.

    Returns:
        Of the links (n, 10), about the joint frames, and of the rotors (n,).
    """
    nominal = model.nominal.reshape(model.n_joints, -1).copy()
    nominal[:, _MASS] = np.where(nominal[:, _MASS] > 0.0, nominal[:, _MASS], 1.0)
    freedom = np.ones_like(nominal)
    freedom[:, _MASS] = 1.0 / _RELUCTANCE
    grouping, scale = model.base.grouping, freedom.ravel()
    missing = values[: model.base.rank] - grouping @ nominal.ravel()
    step = scale * np.linalg.lstsq(grouping * scale, missing, rcond=None)[0]
    standard = (nominal.ravel() + step).reshape(model.n_joints, -1)
    links = standard[:, : _MASS + 1]
    rotors = standard[:, _MASS + 1] if model.rotor_inertia else np.zeros(model.n_joints)
    return links, rotors


def _skeleton(chain: Chain) -> pin.Model:
    """Geometry of the chain, without bodies."""
    arm = pin.Model()
    for joint in range(chain.n_joints):
        kind = (
            pin.JointModelRevoluteUnaligned
            if chain.revolute[joint]
            else pin.JointModelPrismaticUnaligned
        )
        placement = pin.SE3(chain.rotation[joint], chain.translation[joint])
        parent = int(chain.parents[joint]) + 1
        arm.addJoint(parent, kind(chain.axis[joint]), placement, chain.joint_names[joint])
    return arm
