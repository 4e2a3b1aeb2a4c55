"""The identified friction as curve, as text, and as Python source without dependencies."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.model.friction import TANH, FrictionLaw, FrictionTerm
from identification.model.robot import RobotModel
from identification.signals.samples import Samples

Array = NDArray[np.float64]

# Texts about speeds below standstill.
_ZONES = {
    "exclude": "Below the standstill speed nothing was fitted: static friction can have any value"
    " up to the Coulomb friction, in both directions.",
    "linear": "Below the standstill speed of a linear zone sgn(v) is v / standstill, as fitted.",
}


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


def friction_text(model: RobotModel, coefficients: Array) -> str:
    """Return the friction law and its coefficients (k,) as text, a line per joint.

    Raises:
        ShapeError: `coefficients` is not (k,), see `RobotModel.friction_part`.
    """
    friction, n = model.friction, model.n_joints
    table, kinds = friction.table(coefficients), friction.kinds
    if not friction.terms:
        return "The joints have no friction.\n"
    names = model.joint_names
    lines = [
        f"Friction torque at the speed v of a joint: {_formula(kinds)}",
        f"with {_joined([kind.description for kind in kinds])}.",
        *(text for zone, text in _ZONES.items() if zone in {law.zone for law in friction.laws}),
        "",
    ]
    for name, law, row, revolute in zip(
        names, friction.laws, table, friction.revolute, strict=False
    ):
        unit = "rad/s" if revolute else "m/s"
        values = _values(law, row, revolute)
        values += [f"{t.speed_symbol} = {t.speed:g} {unit}" for t in law.terms if t.speed_symbol]
        zone = " (linear zone)" if law.zone == "linear" else ""
        lines.append(
            f"{name}: {', '.join(values) or 'no friction'}; "
            f"standstill below {law.standstill:g} {unit}{zone}"
        )
    for motor, row, share in zip(friction.motors, table[n:], friction.motor_speeds(), strict=True):
        speed_sum = " + ".join(
            ("" if share[j] == 1.0 else f"{share[j]:.5g} ") + f"v({names[j]})"
            for j in np.flatnonzero(share)
        )
        numbers = _values(friction.laws[motor], row, friction.revolute[motor])
        lines.append(
            f"motor {motor + 1}, at v = {speed_sum}: {', '.join(numbers)}; this torque times its"
            " factor acts on each of these joints"
        )
    return "\n".join(lines) + "\n"


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


def _values(law: FrictionLaw, coefficients: Mapping[str, float], revolute: bool) -> list[str]:
    """Return the given coefficients with their units."""
    return [
        f"{term.symbol} = {coefficients[term.symbol]:.5g} {term.unit(revolute=revolute)}"
        for term in law.terms
        if term.symbol in coefficients
    ]


def _formula(kinds: Sequence[FrictionTerm]) -> str:
    return " + ".join(kind.formula for kind in kinds)


def _joined(parts: list[str]) -> str:
    return ", ".join(parts[:-1]) + " and " + parts[-1] if len(parts) > 1 else parts[0]


def _numbers(values: Array) -> str:
    return _tuple(
        repr(value) if math.isfinite(value) else f'float("{value}")' for value in values.tolist()
    )


def _tuple(items: Iterable[str]) -> str:
    texts = list(items)
    return "(" + ", ".join(texts) + ("," if len(texts) == 1 else "") + ")"
