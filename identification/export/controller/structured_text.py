"""An arm as structured text of IEC 61131-3: function blocks of `engine.st` with its constants."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from importlib.resources import files
from typing import Final

import numpy as np

from identification.arrays import Array
from identification.export.controller.tables import (
    ELEMENT_KINDS,
    ELEMENT_SIZE,
    FRICTION_COLUMNS,
    ControlTables,
)

_PAYLOAD_INPUTS: Final = """\
gravity : ARRAY [1..3] OF LREAL := ARM_GRAVITY_VECTOR; (* base axes [m/s2] *)
    payload_mass : LREAL := ARM_PAYLOAD_MASS; (* [kg] *)
    payload_centre : ARRAY [1..3] OF LREAL := ARM_PAYLOAD_CENTRE; (* in the payload frame [m] *)
    payload_inertia : ARRAY [1..6] OF LREAL := ARM_PAYLOAD_INERTIA; (* xx xy xz yy yz zz *)"""
_NUMBERS_PER_LINE: Final = 5  # numbers of a table
_BLOCKS: Final = ("DYNAMICS", "FRICTION", "TORQUE", "GRAVITY", "MASS_MATRIX", "OBSERVER")
_FRICTION_NAMES: Final = {
    "FRICTION_COULOMB": "coulomb",
    "FRICTION_TANH": "smooth",
    "TANH_SPEED": "smooth_speed",
    "FRICTION_VISCOUS": "viscous",
    "FRICTION_ASYMMETRIC": "asymmetric",
    "FRICTION_QUADRATIC": "quadratic",
    "FRICTION_CUBIC": "cubic",
    "FRICTION_STRIBECK": "stribeck",
    "STRIBECK_SPEED": "stribeck_speed",
    "FRICTION_LOAD": "load_share",
    "FRICTION_OFFSET": "offset",
}


def structured_text(tables: ControlTables, name: str, remarks: Sequence[str]) -> str:
    """Return function blocks whose names begin with `name`, in upper case.

    Args:
        tables: constants of the arm.
        name: an identifier.
        remarks: origin and verdict, in the comment at the top.
    """
    code = files(__package__).joinpath("engine.st").read_text(encoding="utf-8")
    code = code.replace("(*TABLES dynamics*)", "\n    ".join(_dynamics(tables)))
    code = code.replace("(*TABLES friction*)", "\n    ".join(_friction(tables)))
    code = code.replace("(*PAYLOAD INPUTS*)", _PAYLOAD_INPUTS)
    payload = tables.payload_body
    constants = {
        "ARM_JOINTS": str(tables.n_joints),
        "ARM_AXES": str(tables.n_axes),
        "ARM_GRAVITY_VECTOR": _list(tables.gravity.tolist()),
        "ARM_PAYLOAD_MASS": _number(payload.mass),
        "ARM_PAYLOAD_CENTRE": _list(payload.centre),
        "ARM_PAYLOAD_INERTIA": _list(payload.inertia),
    }
    for constant, value in constants.items():
        code = re.sub(rf"\b{constant}\b", value, code)
    code = re.sub(rf"\bARM_(?={'|'.join(_BLOCKS)})", f"{name.upper()}_", code)
    return "\n".join([*_comment(tables, remarks), "", code])


def _comment(tables: ControlTables, remarks: Sequence[str]) -> Iterator[str]:
    joints = ", ".join(
        f"{k} {joint}{'' if turns else ' (prismatic)'}"
        for k, (joint, turns) in enumerate(
            zip(tables.joint_names, tables.revolute, strict=True), start=1
        )
    )
    yield "(*"
    yield f"   Joints: {joints}."
    yield "   SI units: rad, m, s, kg, N. Angles follow the robot description;"
    yield f"   a payload is stated in the frame of {tables.payload_frame}."
    yield ""
    for remark in remarks:
        yield f"   {' '.join(remark.replace('*)', '* )').replace('(*', '( *').split())}"
    yield "*)"


def _dynamics(tables: ControlTables) -> Iterator[str]:
    def flat(matrices: Array) -> Array:
        return matrices.reshape(len(matrices), -1)

    yield _integers("parent", (tables.parent + 1).tolist(), "joint that carries each; 0: base")
    yield _integers("revolute", tables.revolute.astype(int).tolist(), "0: prismatic")
    yield _reals("turn_fixed", flat(tables.turn_fixed), "axes of a joint in its parent's, by rows")
    yield _reals("turn_cos", flat(tables.turn_cos), "times cos(q)")
    yield _reals("turn_sin", flat(tables.turn_sin), "times sin(q)")
    yield _reals("origin", tables.origin, "of a joint in its parent's frame")
    yield _reals("slide", tables.slide, "zero for revolute joints")
    yield _reals("joint_axis", tables.axis, "in the joint's own frame")
    yield _reals("body", tables.body, "Ixx Ixy Ixz Iyy Iyz Izz about the origin, m c, m")
    yield _reals("rotor", tables.rotor, "inertia on the side of the joints")
    yield _reals("load_rotor", tables.load_rotor, "of rotors that the bodies contain")
    yield f"payload_joint : DINT := {tables.payload_joint + 1};"
    yield _reals("payload_rotation", tables.payload_rotation, "axes of the payload frame")
    yield _reals("payload_origin", tables.payload_origin, "its origin in the joint's frame")
    elements = tables.elements
    yield f"elements : DINT := {len(elements)};"
    # an array has one entry at least
    kinds = [ELEMENT_KINDS.index(element.kind) + 1 for element in elements] or [0]
    yield _integers("element_kind", kinds, "1 torsion, 2 extension, 3 gas, 4 ripple")
    joints = [element.joint + 1 for element in elements] or [1]
    yield _integers("element_joint", joints, "that each acts on")
    turns = np.array([element.turns for element in elements] or [np.zeros(tables.n_joints)])
    yield _reals("element_turns", turns, "derivative of its angle with respect to each joint angle")
    numbers = np.array([element.numbers for element in elements] or [np.zeros(ELEMENT_SIZE)])
    yield _reals("element_value", numbers, "")


def _friction(tables: ControlTables) -> Iterator[str]:
    turns = np.vstack([np.eye(tables.n_joints), tables.motor_turns])
    yield _reals("axis_turns", turns, "of joints, then of coupled motors, by turns of the joints")
    yield _reals("presliding", tables.presliding, "displacement over which dry friction reverses")
    yield _reals("linear_zone", tables.linear_zone, "speed below which dry friction is linear")
    for column, values in zip(FRICTION_COLUMNS, tables.friction.T, strict=True):
        yield _reals(_FRICTION_NAMES[column], values, "")


def _number(value: float) -> str:
    """Return a literal: a point, and an exponent in upper case."""
    digits, _, exponent = str(value + 0.0).partition("e")  # as few as are read back as it was
    digits = digits if "." in digits else f"{digits}.0"
    return f"{digits}E{exponent}" if exponent else digits


def _list(values: Sequence[float]) -> str:
    return f"[{', '.join(map(_number, values))}]"


def _integers(name: str, values: Sequence[int], note: str) -> str:
    entries = ", ".join(map(str, values))
    return f"{name} : ARRAY [1..{len(values)}] OF DINT := [{entries}]; (* {note} *)"


def _reals(name: str, values: Array, note: str) -> str:
    bounds = ", ".join(f"1..{size}" for size in values.shape)
    numbers = [_number(value) for value in values.ravel().tolist()]
    width = values.shape[-1] if values.ndim > 1 else _NUMBERS_PER_LINE
    rows = [", ".join(numbers[k : k + width]) for k in range(0, len(numbers), width)]
    lines = ",\n        ".join(rows)
    comment = f" (* {note} *)" if note else ""
    return f"{name} : ARRAY [{bounds}] OF LREAL := [\n        {lines}];{comment}"
