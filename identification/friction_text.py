"""The identified friction in words, and as Python source that needs no other package."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.errors import IdentificationError, ShapeError
from identification.friction import FrictionLaw
from identification.model import RobotModel

Array = NDArray[np.float64]


class _Term(NamedTuple):
    name: str  # of the tuple of coefficients in the source
    formula: str  # for people; v is the joint's speed
    code: str  # v: speed, sign: of the speed, linear at standstill
    words: str


_TERMS: Final = {
    "f0": _Term("COULOMB", "f0 sgn(v)", "COULOMB[joint] * sign", "Coulomb (dry) friction f0"),
    "f1": _Term("VISCOUS", "f1 v", "VISCOUS[joint] * v", "viscous friction f1"),
    "fo": _Term("OFFSET", "fo", "OFFSET[joint]", "a constant offset fo"),
}
_THIRD: Final = {
    "quadratic": _Term(
        "THIRD", "f2 sgn(v) v²", "THIRD[joint] * v * abs(v)", "a term f2 with the speed squared"
    ),
    "cubic": _Term(
        "THIRD", "f2 v³", "THIRD[joint] * v**3", "a term f2 with the third power of the speed"
    ),
}


def friction_in_words(model: RobotModel, coefficients: Array) -> str:
    """Return the friction law and its coefficients (k,) as plain text, a line per joint.

    Raises:
        ShapeError: `coefficients` is not (k,), as in the last `model.parameter_names`.
        IdentificationError: the law has a term that has no words.
    """
    table = _table(model, coefficients)
    if not table:
        return "The joints have no friction.\n"
    terms = [_term(model.friction, symbol) for symbol in table]
    lines = [
        f"Torque that friction takes at the speed v of a joint: {_formula(terms)}",
        "with " + _joined([term.words for term in terms]) + ".",
        "sgn(v) is 1 forwards, -1 backwards. Slower than "
        f"{model.friction.standstill:g} rad/s (m/s) nothing was fitted: there sticking friction",
        "can take any value up to the Coulomb friction, to either side.",
        "",
    ]
    for joint, name in enumerate(model.joint_names):
        revolute = bool(model.chain.revolute[joint])
        values = (
            f"{symbol} = {row[joint]:.5g} {model.friction.unit(symbol, revolute=revolute)}"
            for symbol, row in table.items()
        )
        lines.append(f"{name}: " + ", ".join(values))
    return "\n".join(lines) + "\n"


def friction_source(model: RobotModel, coefficients: Array) -> str:
    """Return Python source of ``friction(joint, v)`` with coefficients (k,); it imports nothing.

    It is the model's law, but for speeds below standstill, at which nothing was fitted: there
    the sign is made linear, so that a simulation does not jump at zero speed.

    Raises:
        ShapeError: `coefficients` is not (k,), as in the last `model.parameter_names`.
        IdentificationError: the law has a term that has no words.
    """
    table = _table(model, coefficients)
    terms = [_term(model.friction, symbol) for symbol in table]
    lines = [
        '"""Identified friction of a robot\'s joints. Source: hil."""',
        "",
        f"JOINTS = {_tuple([repr(name) for name in model.joint_names])}",
        f"STANDSTILL = {model.friction.standstill!r}  # rad/s or m/s: slower was not fitted",
    ]
    for (symbol, row), term in zip(table.items(), terms, strict=True):
        units = {model.friction.unit(symbol, revolute=bool(r)) for r in model.chain.revolute}
        values = _tuple([repr(float(value)) for value in row])
        lines.append(f"{term.name} = {values}  # {' or '.join(sorted(units))}")
    lines += [
        "",
        "",
        "def friction(joint, v):",
        f'    """Return {_formula(terms) or "0"} of a joint (0, 1, ...) at speed v, N·m or N."""',
    ]
    if "f0" in table:
        lines += [
            "    if abs(v) < STANDSTILL:",
            "        sign = v / STANDSTILL",
            "    else:",
            "        sign = (v > 0) - (v < 0)",
        ]
    lines.append("    return " + (" + ".join(term.code for term in terms) or "0.0"))
    return "\n".join(lines) + "\n"


def _table(model: RobotModel, coefficients: Array) -> dict[str, Array]:
    """Return coefficients by symbol, each (n,)."""
    symbols, n = model.friction.symbols, model.n_joints
    if np.shape(coefficients) != (len(symbols) * n,):
        raise ShapeError("coefficients", np.shape(coefficients), f"({len(symbols) * n},)")
    rows = np.asarray(coefficients, dtype=np.float64).reshape(len(symbols), n)
    return dict(zip(symbols, rows, strict=True))


def _term(law: FrictionLaw, symbol: str) -> _Term:
    if symbol == "f2" and law.third is not None:
        return _THIRD[law.third]
    if symbol not in _TERMS:
        raise IdentificationError(f"the friction term {symbol!r} has no words yet")
    return _TERMS[symbol]


def _formula(terms: list[_Term]) -> str:
    return " + ".join(term.formula for term in terms)


def _joined(parts: list[str]) -> str:
    return ", ".join(parts[:-1]) + " and " + parts[-1] if len(parts) > 1 else parts[0]


def _tuple(items: list[str]) -> str:
    return "(" + ", ".join(items) + ("," if len(items) == 1 else "") + ")"
