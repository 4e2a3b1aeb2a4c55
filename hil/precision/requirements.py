"""Requirements for the precision of an identification, as typed: `parameters 5%, torque 2`.

Intervals are in units of the torque of the arm, unless `absolute` follows: then they have the
uncertainty of the torque's scale as well, as the mass of a payload always has.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from typing import Final, Literal

from hil.base.errors import InputError
from identification.model.robot import RobotModel

Kind = Literal["parameters", "parameter", "friction", "torque", "mass"]

MIN_CONSECUTIVE_MET: Final = 2
"""Repetitions after which a requirement must be met one after the other: one interval alone can be
narrow by chance, the more often one looks (Simons 1968 adds observations after the first look)."""
FORMS: Final = (
    "parameters 5 %",
    "PARAMETER 5 %",
    "friction 5 %",
    "friction of JOINT 5 %",
    "torque 2",
    "torque of JOINT 2",
    "parameters 5 % absolute",
    "mass of payload 1 %",
    "mass of payload 0.05",
)
"""What can be required; torque in N·m (N of a prismatic joint), mass in kg."""
_FIGURE: Final = re.compile(
    r"(?P<name>\D.*?)\s+(?P<value>[-+]?[0-9.]+(?:[eE][-+]?\d+)?)\s*(?P<unit>%|N·m|Nm|N m|N|kg)?"
    r"(?P<absolute>\s+absolute)?"
)
_ABSOLUTE: Final = {"torque": ("N·m", "Nm", "N m", "N"), "mass": ("kg",)}
_OF_JOINT: Final = re.compile(r"(friction|torque)(?:\s+of\s+(.+))?")
_FIELD: Final = "--precision"
_SIMILARITY_CUTOFF: Final = 0.7  # of difflib; 1 are equal names


@dataclass(frozen=True)
class Requirement:
    """Half of a 95 % interval that is wanted.

    Attributes:
        kind: of the quantity.
        name: of the parameter or joint; "" for all.
        value: half of the interval: a fraction if `relative`, else N·m, N or kg.
        relative: whether it is relative to the quantity.
        absolute: whether the interval has the uncertainty of the torque's scale, which is no error
            in units of the torque of this arm.
    """

    kind: Kind
    name: str
    value: float
    relative: bool
    absolute: bool = False

    def __str__(self) -> str:
        subject = {
            "parameters": "parameters",
            "parameter": self.name,
            "mass": "mass of payload",
        }.get(self.kind, self.kind + (f" of {self.name}" if self.name else ""))
        # The mass of a payload is nothing else.
        suffix = " absolute" if self.absolute and self.kind != "mass" else ""
        return f"{subject} {self.shown(self.value)}{suffix}"

    def shown(self, value: float) -> str:
        """Return a half width of an interval as text, such as "5 %" or "2 N·m"."""
        if self.relative:
            return f"{100.0 * value:.3g} %"
        return f"{value:.3g} {'kg' if self.kind == 'mass' else 'N·m'}"


def requirements_from(texts: Sequence[str]) -> tuple[Requirement, ...]:
    """Return the requirements in texts such as ``parameters 5%, torque 2``.

    Raises:
        InputError: a requirement is not one of `FORMS`, or is given twice.
    """
    parts = [part.strip() for text in texts for part in text.split(",")]
    requirements = tuple(_requirement(part) for part in parts)
    for k, requirement in enumerate(requirements):
        if replace(requirement, value=0.0, relative=False) in {
            replace(other, value=0.0, relative=False) for other in requirements[:k]
        }:
            raise InputError(
                None, f"{parts[k]!r} is required twice", field=_FIELD, remedy="give it once"
            )
    return requirements


def _requirement(text: str) -> Requirement:
    matched = _FIGURE.fullmatch(text)
    if matched is None:
        problem = f"{text!r} is not a quantity with a number"
        raise InputError(None, problem, field=_FIELD, remedy=_known())
    name = matched["name"]
    relative = matched["unit"] == "%"
    try:
        value = float(matched["value"]) / (100.0 if relative else 1.0)
    except ValueError:
        value = -1.0
    if not 0.0 < value < float("inf"):
        problem = f"{text!r} has no precision above zero"
        raise InputError(None, problem, field=_FIELD, remedy="half of a 95 % interval, such as 5 %")
    kind, subject = _kind(" ".join(name.split()), text)
    units = ("%", *_ABSOLUTE.get(kind, ())) if kind != "torque" else _ABSOLUTE[kind]
    unit = units[-1] if kind in _ABSOLUTE else "none"  # a figure without unit is in N·m or kg
    if (matched["unit"] or unit) not in units:
        given = f"the unit {matched['unit']}" if matched["unit"] else "no per cent"
        remedy = f"write {name} 2, in N·m" if kind == "torque" else f"write {name} 5 %"
        if kind == "parameter":  # which may be no parameter at all
            remedy += f"; {_known()}"
        raise InputError(None, f"{text!r} has {given}", field=_FIELD, remedy=remedy)
    is_absolute = kind == "mass" or matched["absolute"] is not None
    return Requirement(kind, subject, value, relative, is_absolute)


def _kind(name: str, text: str) -> tuple[Kind, str]:
    if name in ("parameters", "mass of payload"):
        return ("parameters" if name == "parameters" else "mass"), ""
    matched = _OF_JOINT.fullmatch(name)
    if matched is not None:
        return ("friction" if matched[1] == "friction" else "torque"), matched[2] or ""
    if " " in name or not name:
        raise InputError(
            None, f"{text!r} is not a known requirement", field=_FIELD, remedy=_known()
        )
    return "parameter", name


def _known() -> str:
    return f"write one or several of: {', '.join(FORMS)}"


def _names(name: str, known: Sequence[str], what: str) -> str:
    """Return which joints or parameters there are, only similar ones if there are such."""
    spelling = {each.lower(): each for each in known}
    similar = get_close_matches(name.lower(), spelling, n=4, cutoff=_SIMILARITY_CUTOFF)
    if similar:
        return f"similar are {', '.join(spelling[each] for each in similar)}"
    forms = f"{_known()}; " if what == "parameter" else ""
    return f"{forms}its {what}s are {', '.join(known)}"


def require_known(requirements: Sequence[Requirement], model: RobotModel) -> None:
    """Require the joints and parameters of requirements (InputError)."""
    for requirement in requirements:
        joints = requirement.kind in ("friction", "torque")
        names = model.joint_names if joints else model.parameter_names
        if requirement.name and requirement.name not in names:
            what = "joint" if joints else "parameter"
            raise InputError(
                None,
                f"{str(requirement)!r} names no {what} of this arm",
                field=_FIELD,
                remedy=_names(requirement.name, names, what),
            )
        if requirement.kind == "friction" and not model.friction_columns.any():
            problem = f"{str(requirement)!r}: the cell has no friction terms"
            raise InputError(None, problem, field=_FIELD, remedy="state them in [robot.friction]")
