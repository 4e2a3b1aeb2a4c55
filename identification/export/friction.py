"""The identified friction as a curve, and as Python source without dependencies."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.model.friction import TANH, FrictionTerm
from identification.model.robot import RobotModel
from identification.signals.samples import Samples

Array = NDArray[np.float64]

SPEEDS: Final = 120
"""Points of a curve in each direction."""


class FrictionCurve(NamedTuple):
    """Friction of one joint, with offset, without presliding and coupled motors."""

    speed: Array  # (2 SPEEDS,) [rad/s or m/s], densest around zero
    torque: Array  # at these speeds (2 SPEEDS,) [N·m or N]


def friction_curve(
    model: RobotModel, values: Array, joint: int, low: float, high: float
) -> FrictionCurve:
    """Return the curve of a joint, from 0, for parameters (p,).

    Speeds reach from `low`, at most zero, to `high`, at least zero [rad/s or m/s].
    """
    law = model.friction.laws[joint]
    table = model.friction.table(values[model.friction_part])
    steps = np.linspace(0.0, 1.0, SPEEDS) ** 2
    steps[0] = 1e-6 * steps[1]  # both sides of the jump at zero
    speed = np.concatenate([low * steps[::-1], high * steps])
    columns = law.columns(speed, law.sign(speed))
    return FrictionCurve(speed, np.array([*table[joint].values()]) @ columns)


def friction_torque(model: RobotModel, values: Array, samples: Samples) -> Array:
    """Return measured minus predicted torque (m, n) of parameters (p,) without joint friction."""
    without = values.copy()
    without[model.friction_part] *= [term.motor for term in model.friction.terms]
    return samples.torque - samples.predicted_torque(model, without)


_FUNCTIONS = '''

def direction(v, linear):
    """Return the sign of a speed, or v / linear for speeds below `linear`."""
    if abs(v) < linear:
        return v / linear
    return 1.0 if v > 0 else -1.0 if v < 0 else 0.0


def friction(joint, v, smooth=0.0):
    """Return {formula} of a joint (0, 1, ...) at speed v, N·m or N.

    The sign is linear for speeds below `smooth` (rad/s or m/s), to avoid a jump at zero speed.
    """
    sign = direction(v, max(LINEAR[joint], smooth))
    return {summands}


def torques(speeds, smooth=0.0):
    """Return friction of all {n} joints at their speeds, coupled motors included."""
    result = [friction(joint, v, smooth) for joint, v in enumerate(speeds)]
    for motor, share in enumerate(MOTORS, len(JOINTS)):
        v = sum(s * speed for s, speed in zip(share, speeds))
        torque = friction(motor, v, smooth)
        result = [total + s * torque for total, s in zip(result, share)]
    return result
'''


def friction_source(model: RobotModel, coefficients: Array) -> str:
    """Return Python source of ``friction(joint, v)`` and, with coupled motors, ``torques(speeds)``.

    Raises:
        ShapeError: `coefficients` is not (k,), see `RobotModel.friction_part`.
    """
    friction, kinds = model.friction, model.friction.kinds
    laws, table = friction.all_laws, friction.table(coefficients)
    linear = np.array([law.standstill if law.zone == "linear" else 0.0 for law in laws])
    lines = [
        '"""Identified friction of a robot\'s joints. Source: hil."""',
        *(["", "from math import tanh"] if TANH in kinds else []),
        "",
        f"JOINTS = {_tuple(map(repr, model.joint_names))}",
        f"MOTORS = {_tuple(map(_numbers, friction.motor_speeds()))}  # speed per joint speed",
        "# Of the joints, then of these motors:",
        f"LINEAR = {_numbers(linear)}  # rad/s or m/s; the sign was fitted as linear below this",
    ]
    if any(" E " in kind.code for kind in kinds):
        lines.append(f"E = {math.e!r}")
    for kind in kinds:
        values, speeds, units = np.zeros(len(laws)), np.ones(len(laws)), set()
        for one in friction.terms:
            if one.term.label == kind.label:
                index = friction.place(one)
                values[index], speeds[index] = table[index][one.symbol], one.term.speed
                units.add(one.unit)
        name = kind.label.upper()
        lines.append(f"{name} = {_numbers(values)}  # {' or '.join(sorted(units))}")
        if kind.speed_symbol:
            lines.append(f"{name}_SPEED = {_numbers(speeds)}  # rad/s or m/s")
    summands = " + ".join(f"{kind.label.upper()}[joint]{kind.code}" for kind in kinds)
    functions = _FUNCTIONS.format(
        formula=_formula(kinds) or "0", summands=summands or "0.0", n=model.n_joints
    )
    return "\n".join(lines) + "\n" + functions


def _formula(kinds: Sequence[FrictionTerm]) -> str:
    return " + ".join(kind.formula for kind in kinds)


def _numbers(values: Array) -> str:
    return _tuple(
        repr(value) if math.isfinite(value) else f'float("{value}")' for value in values.tolist()
    )


def _tuple(items: Iterable[str]) -> str:
    texts = list(items)
    return "(" + ", ".join(texts) + ("," if len(texts) == 1 else "") + ")"
