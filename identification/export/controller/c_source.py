"""An arm as a header and a source of C99: constants in tables, and the functions of `engine.c`."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from importlib.resources import files
from typing import Final, Literal, NamedTuple, Protocol

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
_COLUMNS: Final = ",\n    ".join(FRICTION_COLUMNS)
_COMMENT_COLUMNS: Final = 100  # of the comment at the top


class Threshold(Protocol):
    """A threshold of contacts, as `identification.purposes` finds it."""

    @property
    def period(self) -> float:
        """Time in which motion without contact exceeds it once [s]."""

    @property
    def torque(self) -> Sequence[float]:
        """Of each joint (n,) [N·m or N]."""

    @property
    def low(self) -> Sequence[float]:
        """Lower ends of its 95 % interval (n,)."""

    @property
    def high(self) -> Sequence[float]:
        """Upper ends (n,)."""

    @property
    def force(self) -> float:
        """Force at the flange that exceeds it in 95 % of directions [N]; infinite if none does."""

    @property
    def mass(self) -> float:
        """At the flange, whose weight exceeds it [kg]; infinite where none does."""


class CSource(NamedTuple):
    """Header and source of an arm."""

    header: str
    source: str


def c_source(
    tables: ControlTables,
    name: str,
    remarks: Sequence[str],
    precision: Precision = "double",
    thresholds: Sequence[Threshold] = (),
) -> CSource:
    """Return header and source whose names begin with `name`.

    Args:
        tables: constants of the arm.
        name: of the files and the prefix of their functions, an identifier of C.
        remarks: origin and verdict, in the comment at the top of the header.
        precision: of all numbers.
        thresholds: of the torque from outside, which motion without contact exceeds rarely.
    """
    header = "".join(
        [
            *(f"{line}\n" for line in _comment(tables, remarks, precision)),
            "\n",
            _engine("engine.h").replace(
                "#define ARM_H\n",
                "#define ARM_H\n\n" + _definitions(tables, precision, len(thresholds)),
                1,
            ),
        ]
    )
    source = "".join(
        [
            f"/* Constants of an arm, and the code that reads them; see {name}.h. */\n\n",
            f'#include "{name}.h"\n\n#include <math.h>\n\n',
            *(
                f"#define {macro} {function}{'f' if precision == 'single' else ''}\n"
                for macro, function in zip(_MACROS, _FUNCTIONS, strict=True)
            ),
            *_constants(tables, precision),
            *_thresholds(thresholds, precision),
            "\n",
            _engine("engine.c"),
        ]
    )
    return CSource(_renamed(header, name), _renamed(source, name))


def _engine(name: str) -> str:
    return files(__package__).joinpath(name).read_text(encoding="utf-8")


def _renamed(code: str, name: str) -> str:
    """Return code of C with the prefix of its names replaced."""
    code = re.sub(r"\barm_(?=[a-z])", f"{name}_", code)
    return re.sub(r"\bARM_(?=[A-Z])", f"{name.upper()}_", code)


def _uncommented(text: str) -> str:
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
        "SI units: rad, m, s, kg, N. Angles and their signs follow the robot description;"
        f" a payload is stated in the frame of {tables.payload_frame}. Numbers are of {precision}"
        " precision."
    )
    numbers = ", ".join(f"{x:g}" for x in tables.gravity)
    yield from _folded(f"Gravity in the axes of the base: {numbers} m/s2.")
    yield " *"
    for remark in remarks:
        yield from _folded(_uncommented(remark))
    yield " */"


def _folded(text: str) -> Iterator[str]:
    line = " *"
    for word in text.split():
        if len(line) + 1 + len(word) > _COMMENT_COLUMNS:
            yield line
            line = " *  "
        line += f" {word}"
    yield line


def _definitions(tables: ControlTables, precision: Precision, thresholds: int) -> str:
    return (
        f"typedef {'float' if precision == 'single' else 'double'} arm_real;\n\n"
        f"#define ARM_JOINTS {tables.n_joints}\n"
        f"#define ARM_AXES {tables.n_axes} /* joints, and motors that turn several joints */\n"
        f"#define ARM_THRESHOLDS {thresholds}\n"
    )


def _thresholds(thresholds: Sequence[Threshold], precision: Precision) -> Iterator[str]:
    """Yield the tables that the header declares, if there is a threshold."""
    if not thresholds:
        return
    write = _Writer(precision)
    periods = write.initial(np.array([each.period for each in thresholds]))
    yield f"\nconst arm_real arm_threshold_period[{len(thresholds)}] = {periods};\n"
    for name, values in (
        ("force", [each.force for each in thresholds]),
        ("mass", [each.mass for each in thresholds]),
    ):
        yield (
            f"const arm_real arm_threshold_{name}[{len(thresholds)}] = "
            f"{write.initial(np.array(values))};\n"
        )
    for name, levels in (
        ("threshold", [each.torque for each in thresholds]),
        ("threshold_low", [each.low for each in thresholds]),
        ("threshold_high", [each.high for each in thresholds]),
    ):
        rows = ",\n".join(f"    {write.initial(np.array(level))}" for level in levels)
        yield f"const arm_real arm_{name}[{len(thresholds)}][ARM_JOINTS] = {{\n{rows}}};\n"


class _Writer:
    """Definitions of constants in C, of one precision."""

    def __init__(self, precision: Precision) -> None:
        self._real = _REALS[precision]
        self._suffix = "f" if precision == "single" else ""

    def number(self, value: float) -> str:
        """Return a literal with as few digits as are read back as it was."""
        if np.isinf(value):
            return "(arm_real)HUGE_VAL"
        digits = str(self._real(value + 0.0))
        return (digits if re.search(r"[.e]", digits) else f"{digits}.0") + self._suffix

    def initial(self, values: Array) -> str:
        """Return values in braces, on one line."""
        return f"{{{', '.join(map(self.number, values.tolist()))}}}"

    def reals(self, name: str, values: Array, note: str) -> str:
        """Return a table, a row a line."""
        flat = values.reshape(len(values), -1) if values.ndim > 1 else values[None, :]
        lines = ",\n".join("    " + ", ".join(map(self.number, row)) for row in flat.tolist())
        return f"\n/* {note} */\nstatic const arm_real {name}[{values.size}] = {{\n{lines}}};\n"

    def integers(self, name: str, values: Sequence[int], note: str) -> str:
        """Return a table of integers on one line."""
        entries = ", ".join(map(str, values))
        return f"\n/* {note} */\nstatic const int {name}[{len(values)}] = {{{entries}}};\n"


def _constants(tables: ControlTables, precision: Precision) -> Iterator[str]:
    """Yield the definitions of all tables."""
    write = _Writer(precision)
    yield f"\n#define ARM_GRAVITY {write.initial(tables.gravity)}\n"
    yield f"#define ARM_PAYLOAD {write.initial(tables.payload)}\n"
    yield f"#define ARM_ELEMENTS {len(tables.elements)}\n"
    yield f"#define PAYLOAD_JOINT {tables.payload_joint}\n"
    yield f"#define FRICTION_HAS_LOAD {int(tables.has_load)}\n"
    yield f"#define FRICTION_SIZE {len(FRICTION_COLUMNS)}\n"
    yield f"enum {{\n    {_COLUMNS}\n}};\n"
    yield from _geometry(tables, write)
    bodies = "Ixx Ixy Ixz Iyy Iyz Izz about the joint's origin, m cx, m cy, m cz, m."
    yield write.reals("body", tables.body, bodies)
    yield write.reals("rotor", tables.rotor, "Inertia of the rotors, on the side of the joints.")
    if tables.has_load:
        yield write.reals("load_rotor", tables.load_rotor, "Of rotors that the bodies contain.")
    yield write.reals("friction", tables.friction, "Columns FRICTION_..., joints, then motors.")
    travel = "Displacement over which dry friction reverses."
    yield write.reals("presliding", tables.presliding, travel)
    yield write.reals("linear_zone", tables.linear_zone, "Speed below which it is linear.")
    if tables.n_axes > tables.n_joints:
        yield write.reals(
            "motor_turns", tables.motor_turns, "Of each coupled motor by the joints'."
        )
    if tables.elements:
        yield from _elements(tables, write)


def _geometry(tables: ControlTables, write: _Writer) -> Iterator[str]:
    carrier = "Joint that carries each joint, -1: the base."
    yield write.integers("parent", tables.parent.tolist(), carrier)
    yield write.integers("revolute", tables.revolute.astype(int).tolist(), "0: prismatic.")
    axes = (
        "Axes of a joint in its parent's, by rows: turn_fixed + cos(q) turn_cos + sin(q) turn_sin."
    )
    yield write.reals("turn_fixed", tables.turn_fixed, axes)
    yield write.reals("turn_cos", tables.turn_cos, "Times cos(q).")
    yield write.reals("turn_sin", tables.turn_sin, "Times sin(q).")
    yield write.reals(
        "origin", tables.origin, "Of a joint in its parent's frame: origin + q slide."
    )
    yield write.reals("slide", tables.slide, "Zero for revolute joints.")
    yield write.reals("axis", tables.axis, "Axis of each joint in its own frame.")
    yield write.reals("payload_rotation", tables.payload_rotation, "Axes of the payload frame.")
    yield write.reals("payload_origin", tables.payload_origin, "Its origin in the joint's frame.")


def _elements(tables: ControlTables, write: _Writer) -> Iterator[str]:
    elements = tables.elements
    kinds = [ELEMENT_KINDS.index(element.kind) for element in elements]
    yield f"\nenum {{ {', '.join(ELEMENT_KINDS)} }};\n"
    yield write.integers("element_kind", kinds, "Springs, balancers, orders of ripple.")
    yield write.integers("element_joint", [e.joint for e in elements], "Joint each acts on.")
    turns = np.array([element.turns for element in elements])
    yield write.reals(
        "element_turns", turns, "Derivative of its angle with respect to the angle of each joint."
    )
    numbers = np.array([element.numbers for element in elements])
    yield write.reals("element_value", numbers, "As add_elements reads them.")
