"""What code of a controller needs of an identified arm: constants in tables, joint by joint."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array, Indices
from identification.export.exported_arm import ExportedArm
from identification.model.elements import (
    Anchors,
    Coefficient,
    ExtensionSpring,
    GasCylinder,
    PeriodicTorque,
    PlacedElement,
    TorsionSpring,
)
from identification.model.kinematics import skew
from identification.model.known_payload import Payload
from identification.model.robot import RobotModel

ELEMENT_KINDS: Final = ("TORSION_SPRING", "EXTENSION_SPRING", "GAS_CYLINDER", "TORQUE_RIPPLE")
"""Names of the kinds of a :class:`PassiveElement`."""
ELEMENT_SIZE: Final = 8
"""Numbers of a passive element."""

FRICTION_COLUMNS: Final = (
    "FRICTION_COULOMB",
    "FRICTION_TANH",
    "TANH_SPEED",
    "FRICTION_VISCOUS",
    "FRICTION_ASYMMETRIC",
    "FRICTION_QUADRATIC",
    "FRICTION_CUBIC",
    "FRICTION_STRIBECK",
    "STRIBECK_SPEED",
    "FRICTION_LOAD",
    "FRICTION_OFFSET",
)
"""Numbers of the friction of a joint or motor, in the order of `ControlTables.friction`."""

_COLUMN_OF_LABEL: Final = {
    "Coulomb": "FRICTION_COULOMB",
    "tanh": "FRICTION_TANH",
    "viscous": "FRICTION_VISCOUS",
    "asymmetric": "FRICTION_ASYMMETRIC",
    "quadratic": "FRICTION_QUADRATIC",
    "cubic": "FRICTION_CUBIC",
    "Stribeck": "FRICTION_STRIBECK",
    "load": "FRICTION_LOAD",
    "offset": "FRICTION_OFFSET",
}


@dataclass(frozen=True, eq=False)
class PassiveElement:
    """A spring, balancer or order of a torque ripple."""

    kind: str  #: of `ELEMENT_KINDS`
    joint: int  #: that it acts on, from 0
    turns: Array  #: derivative of its angle with respect to each joint angle (n,)
    numbers: Array  #: as `engine.c` reads them (8,)


@dataclass(frozen=True, eq=False)
class ControlTables:
    """Constants of an arm of n joints, k of whose motors turn several joints.

    The rotation of joint i in its parent's axes at an angle q is
    ``turn_fixed + cos(q) turn_cos + sin(q) turn_sin``, its origin ``origin + q slide``.
    """

    joint_names: tuple[str, ...]
    revolute: NDArray[np.bool_]  # (n,)
    parent: Indices  # -1 for the base (n,)
    turn_fixed: Array  # (n, 3, 3)
    turn_cos: Array  # (n, 3, 3)
    turn_sin: Array  # (n, 3, 3)
    origin: Array  # (n, 3) [m]
    slide: Array  # (n, 3), zero for revolute joints
    axis: Array  # in the joint's own frame (n, 3)
    body: Array  # of :data:`identification.model.link_wrenches.LINK_SYMBOLS` (n, 10)
    rotor: Array  # inertia of the rotors in joint coordinates (n, n)
    # inertia of the rotors that the load of the gears contains: of those that the motion cannot
    # separate from the bodies (n, n)
    load_rotor: Array
    friction: Array  # of joints, then of coupled motors (n + k, 11), columns `FRICTION_COLUMNS`
    presliding: Array  # displacement over which dry friction reverses, 0 for a jump (n + k,)
    linear_zone: Array  # speed below which dry friction is linear, 0 for a jump (n + k,)
    motor_turns: Array  # speed of each coupled motor by that of each joint (k, n)
    elements: tuple[PassiveElement, ...]
    gravity: Array  # in base axes (3,) [m/s²]
    payload_frame: str  # in which a payload is stated
    payload_joint: int  # that carries it
    payload_rotation: Array  # axes of that frame in the joint's (3, 3)
    payload_origin: Array  # (3,) [m]
    payload: Array  # parameters of the stated payload in the frame of its joint (10,)
    payload_body: Payload  # as stated, without mass if there is none

    @property
    def n_joints(self) -> int:
        """Number n of joints."""
        return len(self.joint_names)

    @property
    def n_axes(self) -> int:
        """Joints and coupled motors, n + k."""
        return len(self.friction)

    @property
    def has_load(self) -> bool:
        """Whether friction grows with the torque that a gear transmits."""
        return bool(self.friction[:, FRICTION_COLUMNS.index("FRICTION_LOAD")].any())


def control_tables(arm: ExportedArm) -> ControlTables:
    """Return the tables of an identified arm.

    Raises:
        ModelError: the frame of its payload is not a moving link.
    """
    model = arm.model
    chain = model.chain
    across = np.array([np.outer(axis, axis) for axis in chain.axis])
    turning = chain.revolute[:, None, None]
    fixed = chain.rotation @ np.where(turning, across, 0.0)
    sliding = np.einsum("nij,nj->ni", chain.rotation, chain.axis)
    frame_name = None if model.payload is None else model.payload.frame
    frame = chain.frame(frame_name)
    carried = np.zeros(10) if model.payload is None else model.payload.carried_by(chain)[1]
    laws = model.friction.all_laws
    return ControlTables(
        joint_names=model.joint_names,
        revolute=chain.revolute,
        parent=chain.parents,
        turn_fixed=fixed,
        turn_cos=chain.rotation - fixed,
        turn_sin=chain.rotation @ np.where(turning, np.array([*map(skew, chain.axis)]), 0.0),
        origin=chain.translation,
        slide=np.where(chain.revolute[:, None], 0.0, sliding),
        axis=chain.axis,
        body=arm.standard[model.layout.links],
        rotor=arm.rotors,
        load_rotor=arm.rotors - _separate_rotors(model, arm.values),
        friction=_friction(model, arm.values),
        presliding=np.array([law.presliding for law in laws]),
        linear_zone=np.array([law.standstill if law.zone == "linear" else 0.0 for law in laws]),
        motor_turns=model.friction.motor_speeds(),
        elements=tuple(_elements(model, arm.values)),
        gravity=model.gravity,
        payload_frame=frame_name or f"joint {model.joint_names[chain.last_joint]}",
        payload_joint=frame.joint,
        payload_rotation=frame.rotation,
        payload_origin=frame.translation,
        payload=carried,
        payload_body=model.payload or Payload(0.0, (0.0, 0.0, 0.0)),
    )


def _separate_rotors(model: RobotModel, values: Array) -> Array:
    """Return the rotor matrix (n, n) of rotors that are base parameters by themselves.

    These do not load a gear, see :meth:`RobotModel.gear_torque`.
    """
    standard = np.zeros(model.layout.size)
    drives = [*model.layout.rotors, *model.layout.couplings]
    for pivot, value in zip(model.base.pivots, values, strict=False):
        if pivot in drives:
            standard[pivot] = value
    return model.layout.rotor_matrix(standard)


def _friction(model: RobotModel, values: Array) -> Array:
    """Return the coefficients of joints and coupled motors (n + k, 11)."""
    friction = model.friction
    table = np.zeros((len(friction.all_laws), len(FRICTION_COLUMNS)))
    for k, law in enumerate(friction.all_laws):
        table[k, FRICTION_COLUMNS.index("TANH_SPEED")] = law.tanh or 1.0
        table[k, FRICTION_COLUMNS.index("STRIBECK_SPEED")] = law.stribeck or 1.0
    for joint_term, value in zip(friction.terms, values[model.friction_part], strict=True):
        k = joint_term.owner
        if joint_term.motor:
            k = model.n_joints + friction.motors.index(joint_term.owner)
        table[k, FRICTION_COLUMNS.index(_COLUMN_OF_LABEL[joint_term.term.label])] = value
    return table


def _elements(model: RobotModel, values: Array) -> Iterator[PassiveElement]:
    identified = values[model.element_part]
    for placed in model.elements.placed:
        estimates = iter(identified[placed.part].tolist())
        coefficients = [
            next(estimates) if coefficient.identified else _stated(coefficient)
            for coefficient in placed.element.coefficients
        ]
        for kind, numbers in _numbers(placed, coefficients):
            padded = np.zeros(ELEMENT_SIZE)
            padded[: len(numbers)] = numbers
            yield PassiveElement(kind, placed.joint, np.array(placed.turns), padded)


def _stated(coefficient: Coefficient) -> float:
    return coefficient.value or 0.0


def _numbers(placed: PlacedElement, coefficients: list[float]) -> Iterator[tuple[str, list[float]]]:
    """Yield kind and numbers of an element; of a periodic torque for each order."""

    def between(anchors: Anchors) -> list[float]:
        return [anchors.base, anchors.link, anchors.angle]

    match placed.element:
        case TorsionSpring(rest=rest):
            yield "TORSION_SPRING", [coefficients[0], rest]
        case ExtensionSpring(anchors=anchors, free_length=free):
            yield "EXTENSION_SPRING", [*between(anchors), free, *coefficients]
        case GasCylinder() as gas:
            # stroke is length minus c[3], times c[6]: a gas spring is compressed as it shortens
            sense = 1.0 if gas.pulls else -1.0
            force = gas.area * gas.pressure * gas.volume
            numbers = [gas.length, force, gas.volume, sense * gas.area, sense * coefficients[0]]
            yield "GAS_CYLINDER", [*between(gas.anchors), *numbers]
        case PeriodicTorque(orders=orders):
            pairs = zip(coefficients[::2], coefficients[1::2], strict=True)
            for order, (cosine, sine) in zip(orders, pairs, strict=True):
                yield "TORQUE_RIPPLE", [cosine, sine, float(order)]
        case other:
            raise TypeError(f"{type(other).__name__} has no code for a controller")
