"""An arm as a header and a source of C99: constants in tables, and the functions of `engine.c`."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from importlib.resources import files
from typing import Final, Literal, NamedTuple

import numpy as np

from identification.arrays import Array
from identification.export.controller.tables import (
    ELEMENT_KINDS,
    FRICTION_COLUMNS,
    ControlTables,
)

Precision = Literal["double", "single"]

_REALS: Final = {"double": np.float64, "single": np.float32}
_FUNCTIONS: Final = ("sin", "cos", "sqrt", "exp", "tanh", "fabs")
_MACROS: Final = ("ARM_SIN", "ARM_COS", "ARM_SQRT", "ARM_EXP", "ARM_TANH", "ARM_ABS")
_WIDTH: Final = 100  # of the comment at the top


class CSource(NamedTuple):
    """Header and source of an arm."""

    header: str
    source: str


def c_source(
    tables: ControlTables, name: str, remarks: Sequence[str], precision: Precision = "double"
) -> CSource:
    """Return header and source whose names begin with `name`.

    Args:
        tables: constants of the arm.
        name: of the files and the prefix of their functions, an identifier of C.
        remarks: origin and verdict, in the comment at the top of the header.
        precision: of all numbers.
    """
    header = "".join(
        [
            *(f"{line}\n" for line in _comment(tables, remarks, precision)),
            "\n",
            _engine("engine.h").replace(
                "#define ARM_H\n",
                "#define ARM_H\n\n" + _definitions(tables, precision),
                1,
            ),
        ]
    )
    source = "".join(
        [
            f"/* Constants of {_plain(name)}, and the code that reads them; see {name}.h. */\n\n",
            f'#include "{name}.h"\n\n#include <math.h>\n\n',
            *(
                f"#define {macro} {function}{'f' if precision == 'single' else ''}\n"
                for macro, function in zip(_MACROS, _FUNCTIONS, strict=True)
            ),
            *_constants(tables, precision),
            "\n",
            _engine("engine.c"),
        ]
    )
    return CSource(_renamed(header, name), _renamed(source, name))


def _engine(name: str) -> str:
    return files(__package__).joinpath(name).read_text(encoding="utf-8")


def _renamed(text: str, name: str) -> str:
    """Return a text of C with the prefix of its names replaced."""
    text = re.sub(r"\barm_(?=[a-z])", f"{name}_", text)
    return re.sub(r"\bARM_(?=[A-Z])", f"{name.upper()}_", text)


def _plain(text: str) -> str:
    """Return a text that ends no comment of C."""
    return " ".join(text.replace("*/", "* /").split())


def _comment(tables: ControlTables, remarks: Sequence[str], precision: Precision) -> Iterator[str]:
    yield "/*"
    joints = [
        f"{k} {name}{'' if revolute else ' (prismatic)'}"
        for k, (name, revolute) in enumerate(zip(tables.joint_names, tables.revolute, strict=True))
    ]
    yield from _folded(f"Joints: {', '.join(joints)}.")
    yield from _folded(
        "Units: rad, m, s, kg, N m, N. Angles and their signs are those of the robot description;"
        f" a payload is stated in the frame of {tables.payload_frame}. Numbers are of {precision}"
        " precision."
    )
    numbers = ", ".join(f"{x:g}" for x in tables.gravity)
    yield from _folded(f"Gravity in the axes of the base: {numbers} m/s2.")
    yield " *"
    for remark in remarks:
        yield from _folded(_plain(remark))
    yield " */"


def _folded(text: str) -> Iterator[str]:
    line = " *"
    for word in text.split():
        if len(line) + 1 + len(word) > _WIDTH:
            yield line
            line = " *  "
        line += f" {word}"
    yield line


def _definitions(tables: ControlTables, precision: Precision) -> str:
    return (
        f"typedef {'float' if precision == 'single' else 'double'} arm_real;\n\n"
        f"#define ARM_JOINTS {tables.n_joints}\n"
        f"#define ARM_AXES {tables.n_axes} /* joints, and motors that turn several joints */\n"
    )


def _constants(tables: ControlTables, precision: Precision) -> Iterator[str]:
    """Yield the definitions of all tables."""
    suffix = "f" if precision == "single" else ""

    def number(value: float) -> str:
        text = str(_REALS[precision](value + 0.0))  # as few digits as are read back as it was
        return (text if re.search(r"[.e]", text) else f"{text}.0") + suffix

    def reals(name: str, values: Array, note: str) -> str:
        rows = np.reshape(values, (-1, values.shape[-1] if values.ndim > 1 else values.size))
        lines = ",\n".join("    " + ", ".join(map(number, row)) for row in rows.tolist())
        return f"\n/* {note} */\nstatic const arm_real {name}[{values.size}] = {{\n{lines}}};\n"

    def integers(name: str, values: Sequence[int], note: str) -> str:
        listed = ", ".join(map(str, values))
        return f"\n/* {note} */\nstatic const int {name}[{len(values)}] = {{{listed}}};\n"

    def flat(matrices: Array) -> Array:
        return matrices.reshape(len(matrices), -1)

    yield f"\n#define ARM_GRAVITY {{{', '.join(map(number, tables.gravity.tolist()))}}}\n"
    yield f"#define ARM_PAYLOAD {{{', '.join(map(number, tables.payload.tolist()))}}}\n"
    yield f"#define ARM_ELEMENTS {len(tables.elements)}\n"
    yield f"#define PAYLOAD_JOINT {tables.payload_joint}\n"
    yield f"#define FRICTION_HAS_LOAD {int(tables.has_load)}\n"
    yield f"#define FRICTION_SIZE {len(FRICTION_COLUMNS)}\n"
    yield f"enum {{ {', '.join(FRICTION_COLUMNS)} }};\n"
    yield integers("parent", tables.parent.tolist(), "Joint that carries each joint, -1: the base.")
    yield integers("revolute", tables.revolute.astype(int).tolist(), "0: prismatic.")
    yield reals(
        "turn_fixed",
        flat(tables.turn_fixed),
        "Axes of joint i in its parent's: turn_fixed + cos(q) turn_cos + sin(q) turn_sin.",
    )
    yield reals("turn_cos", flat(tables.turn_cos), "by rows")
    yield reals("turn_sin", flat(tables.turn_sin), "by rows")
    yield reals(
        "origin", tables.origin, "Origin of joint i in its parent's frame: origin + q slide."
    )
    yield reals("slide", tables.slide, "Zero for revolute joints.")
    yield reals("axis", tables.axis, "Axis of each joint in its own frame.")
    yield reals(
        "body",
        tables.body,
        "Ixx Ixy Ixz Iyy Iyz Izz about the joint's origin, m cx, m cy, m cz, m.",
    )
    yield reals("rotor", tables.rotor, "Inertia of the rotors, on the side of the joints.")
    if tables.has_load:
        yield reals("load_rotor", tables.load_rotor, "Of rotors that the bodies contain.")
    yield reals("friction", tables.friction, "Columns FRICTION_..., joints, then coupled motors.")
    yield reals("presliding", tables.presliding, "Displacement over which dry friction reverses.")
    yield reals("linear_zone", tables.linear_zone, "Speed below which dry friction is linear.")
    if tables.n_axes > tables.n_joints:
        yield reals(
            "motor_turns", tables.motor_turns, "Speed of each coupled motor by the joints'."
        )
    yield reals("payload_rotation", tables.payload_rotation, "Axes of the payload frame.")
    yield reals("payload_origin", tables.payload_origin, "Its origin in the joint's frame.")
    if tables.elements:
        kinds = [ELEMENT_KINDS.index(element.kind) for element in tables.elements]
        yield f"\nenum {{ {', '.join(ELEMENT_KINDS)} }};\n"
        yield integers("element_kind", kinds, "Springs, balancers, orders of ripple.")
        joints = [element.joint for element in tables.elements]
        yield integers("element_joint", joints, "Joint that each acts on.")
        turns = np.array([element.turns for element in tables.elements])
        yield reals("element_turns", turns, "Derivative of its angle by that of each joint.")
        numbers = np.array([element.numbers for element in tables.elements])
        yield reals("element_value", numbers, "As add_elements reads them.")
