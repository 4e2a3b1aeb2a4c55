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
from identification.estimators.instrumental import Instruments
from identification.model.elements import JointElements
from identification.model.friction import FrictionTerm
from identification.model.kinematics import FROM_PINOCCHIO, Chain
from identification.model.motion import Motion
from identification.model.robot import RobotModel

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
            :func:`identification.estimators.instrumental.planned_motion`, without lag.

    Raises:
        ShapeError: arrays of other shapes than the model's.
        IdentificationError: the parameters give some posture no positive mass matrix: nothing
            can be simulated with them.
    """
    if np.shape(servo.position) != (model.n_joints,) or np.shape(servo.velocity) != (
        model.n_joints,
    ):
        raise ShapeError("servo gains", np.shape(servo.position), f"({model.n_joints},)")
    arm, coupled = _arm(model, values)
    friction = _Friction.of(model, values)
    ahead = np.zeros(command.position.shape)
    if servo.feedforward:
        ahead = model.torque(values, *command[1:]) + model.load_torque(*command[1:4])
    elements = _Elements.of(model, values)
    q, qd = _run(arm, coupled, friction, elements, servo, command, ahead)
    qdd = np.gradient(qd, command.time, axis=0)
    return Instruments(
        Motion(command.time, q, qd, qdd),
        np.ones(q.shape, dtype=np.bool_),
        np.full(model.n_joints, np.nan),
        "the closed loop, simulated with an earlier estimate",
    )


def _run(
    arm: pin.Model,
    coupled: Array,
    friction: _Friction,
    elements: _Elements,
    servo: JointServo,
    command: Motion,
    ahead: Array,
) -> tuple[Array, Array]:
    """Positions and velocities (m, n) at the instants of the command.

    `coupled` (n, n) is what the rotors add to the mass matrix off its diagonal.
    """
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
            torque -= elements.torque(q)
            torque += servo.position * (wanted - q - h * qd) + servo.velocity * (speed - qd)
            mass = pin.crba(arm, data, q)
            torque -= pin.nonLinearEffects(arm, data, q, qd)
            matrix = np.triu(mass) + np.triu(mass, 1).T + coupled + h * friction.slope(qd)
            matrix[np.diag_indices_from(matrix)] += h * (servo.velocity + h * servo.position)
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
    """Friction of joints and coupled motors, sign made linear below standstill so that it sticks.

    Attributes:
        speeds: speed of each of the a joints and motors per joint speed (a, n).
        terms: with their coefficients (a,), zero where there is no such term.
        standstill: speeds (a,).
    """

    speeds: Array
    terms: tuple[tuple[FrictionTerm, Array], ...]
    standstill: Array

    @classmethod
    def of(cls, model: RobotModel, values: Array) -> _Friction:
        """Take the friction out of parameters (p,)."""
        friction = model.friction
        speeds = np.concatenate([np.eye(model.n_joints), friction.motor_speeds()])
        coefficients: dict[FrictionTerm, Array] = {}
        for one, value in zip(friction.terms, values[model.friction_part], strict=True):
            row = coefficients.setdefault(one.term, np.zeros(len(speeds)))
            row[friction.place(one)] = value
        slow = [law.standstill for law in friction.all_laws]
        standstill = np.maximum(slow, _NARROWEST_STANDSTILL)
        return cls(speeds, tuple(coefficients.items()), standstill)

    def torque(self, qd: Array) -> Array:
        """Torque (n,) at joint speeds (n,)."""
        v = self.speeds @ qd
        direction = np.clip(v / self.standstill, -1.0, 1.0)
        torque = np.zeros_like(v)
        for term, coefficients in self.terms:
            torque += coefficients * term.column(v, direction)
        return np.asarray(self.speeds.T @ torque)

    def slope(self, qd: Array) -> Array:
        """Derivative with joint speeds (n, n), of each joint or motor never negative."""
        v = self.speeds @ qd
        sticking = (np.abs(v) < self.standstill) / self.standstill
        slope = np.zeros_like(v)
        for term, coefficients in self.terms:
            slope += coefficients * term.slope(v, sticking)
        return np.asarray((self.speeds.T * np.maximum(slope, 0.0)) @ self.speeds)


@dataclass(frozen=True, eq=False)
class _Elements:
    """Springs and balancers with the values (e,) of those that are identified."""

    elements: JointElements
    values: Array

    @classmethod
    def of(cls, model: RobotModel, values: Array) -> _Elements:
        """Take their parameters out of all (p,)."""
        return cls(model.elements, values[model.element_part])

    def torque(self, q: Array) -> Array:
        """Torque (n,) that the drives hold at a position (n,)."""
        if not self.elements.placed:
            return np.zeros(len(q))
        row = q[None]
        return np.asarray((self.elements.torque(self.values, row) + self.elements.known(row))[0])


def _arm(model: RobotModel, values: Array) -> tuple[pin.Model, Array]:
    """Pinocchio model with these base parameters: any bodies with the same torques will do.

    Beside it what the rotors add to the mass matrix off its diagonal (n, n), for which pinocchio
    has no place.
    """
    standard, rotors = standard_parameters(model, values)
    arm = _skeleton(model.chain)
    arm.gravity.linear = model.gravity
    if model.payload is not None:
        carrier, carried = model.payload.carried_by(model.chain)
        standard[carrier] += carried
    for joint, link in enumerate(standard):
        if not link[_MASS] > 0.0:
            raise IdentificationError(
                f"the parameters leave link {joint + 1} no positive mass: a motion cannot be"
                " simulated with them; use the planned motion"
            )
        pinocchio_order = np.empty(len(FROM_PINOCCHIO))
        pinocchio_order[list(FROM_PINOCCHIO)] = link
        arm.inertias[joint + 1] = pin.Inertia.FromDynamicParameters(pinocchio_order)
    arm.armature = np.diag(rotors).copy()
    return arm, rotors - np.diag(np.diag(rotors))


def standard_parameters(model: RobotModel, values: Array) -> tuple[Array, Array]:
    """Standard parameters with given base parameters (p,), as near to the nominal as need be.

    They are equivalent to the base parameters, not physical: rotors may hold what belongs to
    links.

    Returns:
        Of the links (n, 10), about the joint frames, and the rotors' inertia matrix (n, n).
    """
    nominal, masses = model.nominal, model.layout.links[:, _MASS]
    nominal[masses] = np.where(nominal[masses] > 0.0, nominal[masses], 1.0)
    freedom = np.ones_like(nominal)
    freedom[masses] = 1.0 / _RELUCTANCE
    grouping = model.base.grouping
    missing = values[: model.base.rank] - grouping @ nominal
    standard = nominal + freedom * np.linalg.lstsq(grouping * freedom, missing, rcond=None)[0]
    return standard[model.layout.links], model.layout.rotor_matrix(standard)


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
