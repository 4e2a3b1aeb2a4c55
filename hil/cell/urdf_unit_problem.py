"""What a URDF in units other than SI is refused with, before anything is concluded from it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, NamedTuple

from identification.errors import ModelError
from identification.model.urdf_unit_check import Quantity, WrongUnit, wrong_units
from identification.text import enumerated

_PLURAL: Final[Mapping[Quantity, str]] = {
    "mass": "masses",
    "length": "lengths of joints (origin of <joint>)",
    "centre of mass": "centres of mass (origin of <inertial>)",
    "inertia": "inertias",
}
_SI: Final[Mapping[Quantity, str]] = {
    "mass": "kg",
    "length": "m",
    "centre of mass": "m",
    "inertia": "kg·m²",
}
_FIELDS: Final[Mapping[Quantity, str]] = {
    "mass": "inertial/mass",
    "length": "origin",
    "centre of mass": "inertial/origin",
    "inertia": "inertial/inertia",
}


class UnitProblem(NamedTuple):
    """What is wrong with the units of a description, where, and what to do."""

    problem: str
    field: str
    remedy: str


def unit_problem(urdf: str) -> UnitProblem | None:
    """Return which quantities of a URDF are not in SI units; None if all are."""
    try:
        wrong = wrong_units(urdf)
    except ModelError:
        return None  # the model says what is wrong
    if not wrong:
        return None
    found = enumerated([f"{_PLURAL[each.quantity]} in {each.unit}" for each in wrong])
    places = "; ".join(f"{_place(each)} is {each.value:.6g} {_SI[each.quantity]}" for each in wrong)
    steps = enumerated(
        [
            f"{_PLURAL[each.quantity]} in {_SI[each.quantity]} (multiply by {each.factor:g})"
            for each in wrong
        ]
    )
    problem = f"has {found}: in SI units no arm has such values ({places})"
    return UnitProblem(problem, _place(wrong[0]), f"write {steps}")


def _place(wrong: WrongUnit) -> str:
    kind, name = wrong.element
    return f"{kind} {name}: {_FIELDS[wrong.quantity]}"
