r"""Torque of one state after the other, by recursive Newton-Euler (pinocchio).

A :class:`RegressorPlan` is made for thousands of samples at once; of a single one its preparation
takes a hundred times as long as the arithmetic. Base parameters :math:`\pi_b` fix the torque, not
the bodies: any standard parameters :math:`\pi` with :math:`G \pi = \pi_b` give it; those closest
to the bodies of the description are taken.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import pinocchio as pin

from identification.arrays import Array
from identification.errors import ModelError
from identification.model.elements import PeriodicTorque
from identification.model.friction import FrictionLaw
from identification.model.kinematics import PINOCCHIO_ORDER
from identification.model.link_wrenches import LINK_SYMBOLS, MASS_INDEX
from identification.model.robot import RobotModel

_MIN_MASS: Final = 1e-3  # kg: pinocchio needs the centre of mass, mc / m
_PARAMETER_ROUNDING: Final = 1e-9  # relative to the largest base parameter


class SingleStateTorque:
    """Inverse dynamics of an arm with given parameters, one state at a time.

    Args:
        model: of n joints.
        values: of its p parameters.

    Raises:
        ModelError: no bodies with a mass have these parameters.
    """

    def __init__(self, model: RobotModel, values: Array) -> None:
        self.shape = (model.n_joints,)
        self._model = model
        self._values = values
        layout = model.layout
        drives = np.isin(model.base.pivots, [*layout.rotors, *layout.couplings])
        base = values[: model.base.rank]
        rotors = np.zeros(layout.size)
        rotors[model.base.pivots[drives]] = base[drives]
        self._rotors = layout.rotor_matrix(rotors)
        self._pinocchio = _pinocchio_model(model, _bodies(model, np.where(drives, 0.0, base)))
        self._data = self._pinocchio.createData()
        self._laws = _laws(model, values)
        self._motors = bool(model.friction.motors)
        self._elements = [
            (
                placed,
                values[model.element_part][placed.part],
                isinstance(placed.element, PeriodicTorque),
            )
            for placed in model.elements.placed
        ]

    def __reduce__(self) -> tuple[object, ...]:
        return SingleStateTorque, (self._model, self._values)

    def __call__(self, q: Array, v: Array, a: Array) -> Array:
        """Return the torque (n,) [N·m, N] at float64 arrays (n,), with payload and springs."""
        carried = pin.rnea(self._pinocchio, self._data, q, v, a)
        ripple: Array | float = 0.0
        for placed, values, is_ripple in self._elements:
            row = q[None, :]
            found = placed.columns(row)[0] @ values + placed.known_torque(row)[0]
            part = np.zeros(len(q))
            part[placed.joint] = found
            if is_ripple:
                ripple = ripple + part
            else:
                carried = carried + part
        torque = carried + self._rotors @ a + ripple
        for joints, law, coefficients in self._laws:
            speed = v[joints]
            columns = law.columns(speed, law.sign(speed), carried[joints])
            torque[joints] += np.einsum("kn,kn->n", coefficients, columns)
        return np.asarray(torque + self._motor_friction(v) if self._motors else torque)

    def _motor_friction(self, v: Array) -> Array:
        """Return the friction of coupled motors at the joints (n,)."""
        friction = self._model.friction
        torque = np.zeros(len(v))
        coefficients = self._values[self._model.friction_part]
        for motor, share in zip(friction.motors, friction.motor_speeds(), strict=True):
            speed = np.asarray(share @ v)
            sign = friction.laws[motor].sign(speed)
            for term, value in zip(friction.terms, coefficients, strict=True):
                if term.motor and term.owner == motor:
                    torque += share * value * term.term.column(speed, sign)
        return torque


def _laws(model: RobotModel, values: Array) -> list[tuple[Array | slice, FrictionLaw, Array]]:
    """Return each friction law with its joints and their coefficients (k, joints)."""
    friction = model.friction
    table = friction.table(values[model.friction_part])
    parts: list[tuple[Array | slice, FrictionLaw, Array]] = []
    for law in dict.fromkeys(friction.laws):
        joints = [j for j, other in enumerate(friction.laws) if other == law]
        if law.terms:
            coefficients = np.array([[table[j][s] for j in joints] for s in law.symbols])
            every = len(joints) == model.n_joints
            parts.append((slice(None) if every else np.array(joints), law, coefficients))
    return parts


def _bodies(model: RobotModel, base: Array) -> Array:
    """Return inertial parameters (n, 10) with these base parameters (b,), near the description's.

    Masses are the description's where the torque does not depend on them otherwise.

    Raises:
        ModelError: there are none with positive masses.
    """
    links = model.layout.links
    grouping = model.base.grouping[:, links.ravel()]
    bodies = model.nominal[links]
    bodies[:, MASS_INDEX] = np.where(bodies[:, MASS_INDEX] < _MIN_MASS, 1.0, bodies[:, MASS_INDEX])
    is_mass = np.arange(bodies.size) % len(LINK_SYMBOLS) == MASS_INDEX
    most = _PARAMETER_ROUNDING * max(1.0, np.abs(base).max(initial=0.0))
    for free in (~is_mass, np.ones_like(is_mass)):
        missing = base - grouping @ bodies.ravel()
        change, *_ = np.linalg.lstsq(grouping[:, free], missing, rcond=None)
        if np.abs(grouping[:, free] @ change - missing).max(initial=0.0) < most:
            bodies.reshape(-1)[free] += change
            if np.all(bodies[:, MASS_INDEX] > _MIN_MASS):
                return bodies
            break
    raise ModelError("no bodies with positive masses have these parameters")


def _pinocchio_model(model: RobotModel, bodies: Array) -> pin.Model:
    """Return pinocchio's model of the chain with these bodies (n, 10) and the known payload."""
    chain = model.chain
    made = pin.Model()
    made.gravity.linear = model.gravity
    payload = None if model.payload is None else model.payload.carried_by(chain)
    for j, name in enumerate(chain.joint_names):
        kind = (
            pin.JointModelRevoluteUnaligned
            if chain.revolute[j]
            else pin.JointModelPrismaticUnaligned
        )
        pose = pin.SE3(chain.rotation[j], chain.translation[j])
        index = made.addJoint(int(chain.parents[j]) + 1, kind(chain.axis[j]), pose, name)
        parameters = bodies[j]
        if payload is not None and payload[0] == j:
            parameters = parameters + payload[1]
        ordered = np.empty(len(parameters))
        ordered[list(PINOCCHIO_ORDER)] = parameters
        made.appendBodyToJoint(
            index, pin.Inertia.FromDynamicParameters(ordered), pin.SE3.Identity()
        )
    return made
