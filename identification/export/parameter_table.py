"""Identified parameters as a table: meaning, body and joint, and how well each is known."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, NamedTuple

from identification.errors import IdentificationError
from identification.estimators.torque_scale import absolute
from identification.factor.estimate import Estimate, Known
from identification.model.elements import PeriodicTorque
from identification.model.link_wrenches import LINK_SYMBOLS
from identification.model.robot import RobotModel

_OF_LINK: Final = {
    **{f"I{axis * 2}": f"moment of inertia about {axis}" for axis in "xyz"},
    **{f"I{axes}": f"element {axes} of the inertia tensor" for axes in ("xy", "xz", "yz")},
    **{f"mc{axis}": f"mass times centre of mass along {axis}" for axis in "xyz"},
    "m": "mass",
}
_OF_ELEMENT: Final = {
    "spring": "stiffness of the spring",
    "preload": "preload of the spring",
    "balancer": "factor of the torque of the balancer",
    "gas_spring": "factor of the torque of the gas spring",
    "ripple": "torque ripple",
    "position": "position-dependent torque",
}


@dataclass(frozen=True)
class ParameterRow:
    """One parameter, in the unit of its row.

    Attributes:
        name: such as `I3zz`.
        meaning: in words; for a base parameter the meaning of its first summand.
        body: link of the description, empty of what is no property of a body.
        joint: that moves the body, or has the friction.
        estimate: in units of the torque of this arm, as `low`, `high` and `std`.
        low: lower end of the 95 % interval; -inf if the motion does not determine it.
        high: upper end.
        unit: SI.
        known: whether the standard deviation is at most a tenth of the estimate, or half of it.
        std: standard deviation.
        absolute_std: the same, with the uncertainty of the scale of the torque.
        expression: in parameters of the bodies.
    """

    name: str
    meaning: str
    body: str
    joint: str
    estimate: float
    low: float
    high: float
    unit: str
    known: Known
    std: float
    absolute_std: float
    expression: str


class Meaning(NamedTuple):
    """Meaning of a parameter, with its body and joint."""

    words: str
    body: str
    joint: str


def parameter_table(model: RobotModel, estimate: Estimate) -> list[ParameterRow]:
    """Return a row for each of the p parameters.

    Raises:
        IdentificationError: the estimate is of other parameters.
    """
    if estimate.names != model.parameter_names:
        raise IdentificationError("the estimate is not of the model's parameters")
    numbers = estimate.values.tolist(), estimate.std.tolist(), absolute(estimate).std.tolist()
    factor = estimate.interval_factor
    return [
        ParameterRow(
            name,
            meaning=meaning.words,
            body=meaning.body,
            joint=meaning.joint,
            estimate=value,
            low=value - factor * std,
            high=value + factor * std,
            unit=unit,
            known=known,
            std=std,
            absolute_std=absolute_std,
            expression=expression,
        )
        for name, meaning, value, std, absolute_std, unit, known, expression in zip(
            estimate.names,
            meanings(model),
            *numbers,
            estimate.units,
            estimate.known,
            model.expressions(),
            strict=True,
        )
    ]


def meanings(model: RobotModel) -> tuple[Meaning, ...]:
    """Return what each of the p parameters is."""
    return (*_of_bodies(model), *_of_friction(model), *_of_elements(model))


def _of_bodies(model: RobotModel) -> Iterator[Meaning]:
    layout = model.layout
    first = model.n_joints * layout.width
    for pivot, formula in zip(model.base.pivots.tolist(), model.base.expressions(), strict=True):
        others = " and what moves like it" if " " in formula else ""
        if pivot >= first:
            names = [model.joint_names[joint] for joint in layout.pairs[pivot - first]]
            yield Meaning("inertia of coupled motors between the joints", "", " and ".join(names))
            continue
        joint, symbol = divmod(pivot, layout.width)
        words = "inertia of the rotor at the joint"
        if symbol < len(LINK_SYMBOLS):
            words = _OF_LINK[LINK_SYMBOLS[symbol]]
        yield Meaning(words + others, model.chain.link(joint), model.joint_names[joint])


def _of_friction(model: RobotModel) -> Iterator[Meaning]:
    for term in model.friction.terms:
        of = " of the motor" if term.motor else ""
        yield Meaning(term.term.description + of, "", model.joint_names[term.owner])


def _of_elements(model: RobotModel) -> Iterator[Meaning]:
    for placed in model.elements.placed:
        for symbol in placed.element.symbols:
            words = next(text for kind, text in _OF_ELEMENT.items() if symbol.startswith(kind))
            is_periodic = isinstance(placed.element, PeriodicTorque)
            order = symbol.rpartition("_")[2] if is_periodic else ""
            joint = model.joint_names[placed.joint]
            yield Meaning(f"{words} {order}".rstrip(), "", joint)
