"""The identified friction in words, and as Python source that needs no other package."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from identification.model.friction import FrictionLaw, Kind, Tanh
from identification.model.robot import RobotModel

Array = NDArray[np.float64]


def friction_in_words(model: RobotModel, coefficients: Array) -> str:
    """Return the friction law and its coefficients (k,) as text, a line per joint.

    Raises:
        ShapeError: `coefficients` is not (k,), see `RobotModel.friction_part`.
    """
    friction = model.friction
    table = friction.table(coefficients)
    if not friction.terms:
        return "The joints have no friction.\n"
    kinds = friction.kinds
    # The third term of different joints may be of two kinds.
    shared = [one.symbol for one, other in combinations(kinds, 2) if one.symbol == other.symbol]
    lines = []
    if kinds:
        lines += [
            f"Torque that friction takes at the speed v of a joint: {_formula(kinds)}",
            "with " + _joined([kind.words for kind in kinds]) + ".",
            *_standstill_lines(model),
            "",
        ]
    for joint, (name, law) in enumerate(zip(model.joint_names, friction.laws, strict=True)):
        revolute = bool(model.chain.revolute[joint])
        values = _values(law, table[joint], revolute)
        for term in law.terms:
            if term.symbol in shared:
                values.append(f"{term.symbol} with {term.basis}")
            if term.speed_symbol:
                speed = f"{term.speed:g} {'rad/s' if revolute else 'm/s'}"
                values.append(f"{term.speed_symbol} = {speed}")
        lines.append(f"{_line(name)}: " + (", ".join(values) or "no friction"))
    if any(law.asymmetric and law.coulomb for law in friction.laws):
        lines.append(
            "Coulomb friction is f0 + fo forwards and f0 - fo backwards: its asymmetry cannot be"
            " distinguished from the zero error of a sensor."
        )
    lines += _motor_lines(model, table[model.n_joints :])
    return "\n".join(lines) + "\n"


def friction_source(model: RobotModel, coefficients: Array) -> str:
    """Return Python source of ``friction(joint, v)`` and ``torques(speeds)``; no other package.

    `friction` is the joint's own law as :meth:`RobotModel.torque` has it, `torques` that of all
    joints, with what motors that turn with several of them take. Both take a speed below which
    the sign is made linear, for simulations that must not jump at zero speed.

    Raises:
        ShapeError: `coefficients` is not (k,), see `RobotModel.friction_part`.
    """
    friction, n = model.friction, model.n_joints
    laws, table = friction.all_laws, friction.table(coefficients)
    linear = [repr(float(law.standstill) if law.zone == "linear" else 0.0) for law in laws]
    lines = [
        '"""Identified friction of a robot\'s joints. Source: hil."""',
        "",
        f"JOINTS = {_tuple(repr(name) for name in model.joint_names)}",
        f"MOTORS = {_tuple(map(_numbers, friction.motor_speeds()))}  # speed per joint speed",
        "# Of the joints, then of these motors:",
        f"LINEAR = {_tuple(linear)}  # rad/s or m/s: slower, the sign was fitted as linear",
    ]
    kinds = friction.kinds
    if Tanh in kinds:
        lines[1:1] = ["", "from math import tanh"]
    if any(" E " in kind.code for kind in kinds):
        lines.append(f"E = {math.e!r}")
    for kind in kinds:
        values, speeds, units = np.zeros(len(laws)), np.ones(len(laws)), set()
        for one in friction.terms:
            if isinstance(one.term, kind):
                place = friction.place(one)
                values[place], speeds[place] = table[place][one.symbol], one.term.speed
                units.add(one.unit)
        name = kind.label.upper()
        lines.append(f"{name} = {_numbers(values)}  # {' or '.join(sorted(units))}")
        if kind.speed_symbol:
            lines.append(f"{name}_SPEED = {_numbers(speeds)}  # rad/s or m/s")
    lines += [
        "",
        "",
        "def direction(v, linear):",
        '    """Return the sign of a speed; slower than `linear`, v / linear."""',
        "    if abs(v) < linear:",
        "        return v / linear",
        "    return 1.0 if v > 0 else -1.0 if v < 0 else 0.0",
        "",
        "",
        "def friction(joint, v, smooth=0.0):",
        f'    """Return {_formula(kinds) or "0"} of a joint (0, 1, ...) at speed v, N·m or N.',
        "",
        "    Slower than `smooth` (rad/s or m/s) the sign is linear: no jump at zero speed.",
        '    """',
    ]
    if any("sign" in kind.code for kind in kinds):
        lines.append("    sign = direction(v, max(LINEAR[joint], smooth))")
    summands = [f"{kind.label.upper()}[joint]{kind.code}" for kind in kinds]
    lines.append("    return " + (" + ".join(summands) or "0.0"))
    lines += [
        "",
        "",
        "def torques(speeds, smooth=0.0):",
        f'    """Return friction of all {n} joints at their speeds, coupled motors included."""',
        "    result = [friction(joint, v, smooth) for joint, v in enumerate(speeds)]",
        "    for motor, share in enumerate(MOTORS, len(JOINTS)):",
        "        v = sum(s * speed for s, speed in zip(share, speeds))",
        "        torque = friction(motor, v, smooth)",
        "        result = [total + s * torque for total, s in zip(result, share)]",
        "    return result",
    ]
    return "\n".join(lines) + "\n"


def _standstill_lines(model: RobotModel) -> list[str]:
    """Say what holds below standstill, for joints left out there and for those made linear."""
    lines = ["sgn(v) is 1 forwards, -1 backwards."]
    for zone, words in (
        (
            "exclude",
            "nothing was fitted: there sticking friction can take any value up to the Coulomb"
            " friction, to either side.",
        ),
        ("linear", "sgn(v) is v / standstill, as fitted."),
    ):
        named = {
            name: law.standstill
            for name, law in zip(model.joint_names, model.friction.laws, strict=True)
            if law.zone == zone and law.symbols
        }
        for speed in sorted(set(named.values())):
            alike = [_line(name) for name, own in named.items() if own == speed]
            whose = "" if len(alike) == model.n_joints else f" {_joined(alike)}:"
            lines.append(f"Slower than {speed:g} rad/s (m/s){whose} {words}")
    return lines


def _values(law: FrictionLaw, coefficients: Mapping[str, float], revolute: bool) -> list[str]:
    """Return the coefficients that are given, with their units."""
    return [
        f"{term.symbol} = {coefficients[term.symbol]:.5g} {term.unit(revolute=revolute)}"
        for term in law.terms
        if term.symbol in coefficients
    ]


def _motor_lines(model: RobotModel, table: Sequence[Mapping[str, float]]) -> list[str]:
    lines, friction = [], model.friction
    for motor, values, share in zip(friction.motors, table, friction.motor_speeds(), strict=True):
        turning = " + ".join(
            ("" if share[j] == 1.0 else f"{share[j]:.5g} ") + f"v({_line(model.joint_names[j])})"
            for j in np.flatnonzero(share)
        )
        numbers = _values(friction.laws[motor], values, friction.revolute[motor])
        lines.append(
            f"motor {motor + 1}, at v = {turning}: {', '.join(numbers)}; each of these joints feels"
            " that torque times its factor"
        )
    return lines


def _formula(kinds: Sequence[Kind]) -> str:
    return " + ".join(kind.formula() for kind in kinds)


def _line(name: str) -> str:
    """Return a name without line ends and control characters."""
    return "".join(c if c.isprintable() else " " for c in name)


def _joined(parts: list[str]) -> str:
    return ", ".join(parts[:-1]) + " and " + parts[-1] if len(parts) > 1 else parts[0]


def _number(value: float) -> str:
    return repr(float(value)) if math.isfinite(value) else f'float("{float(value)}")'


def _numbers(values: Array) -> str:
    return _tuple(_number(value) for value in values)


def _tuple(items: Iterable[str]) -> str:
    texts = list(items)
    return "(" + ", ".join(texts) + ("," if len(texts) == 1 else "") + ")"
