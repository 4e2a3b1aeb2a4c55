"""Friction laws and described masses in words."""

from __future__ import annotations

from collections.abc import Iterable

from identification.model.friction import FrictionLaw, FrictionTerm
from identification.model.nominal_masses import MassFault


def law_text(law: FrictionLaw) -> str:
    """Return the terms of a law."""
    return terms_text((term.label, _speed(term)) for term in law.terms)


def terms_text(terms: Iterable[tuple[str, float | None]]) -> str:
    """Return friction terms by label and speed [rad/s], None for terms without one."""
    joined = ", ".join(
        label if speed is None else f"{label} ({speed:g} rad/s)" for label, speed in terms
    )
    return joined or "no friction"


def reversal_text(tanh: float | None, presliding: float | None) -> str:
    """Return how dry friction reverses: by a speed [rad/s], over a displacement [rad], at once."""
    if tanh is not None:
        return f"tanh(v / {tanh:g} rad/s)"
    return f"presliding over {presliding:g} rad" if presliding else "sgn(v)"


def law_option(law: FrictionLaw) -> str:
    """Return the terms of a law as an entry of `hil identify --friction`."""
    return ",".join(
        term.label.lower() if (speed := _speed(term)) is None else f"{term.label.lower()}={speed:g}"
        for term in law.terms
    )


def mass_fault_words(fault: MassFault) -> str:
    """Return why the masses of a description are not the arm's."""
    return {
        MassFault.NONE: "the description has no masses",
        MassFault.EQUAL: "all bodies of the description have the same mass",
        MassFault.UNRELATED: "the torque is unrelated to the masses of the description",
    }[fault]


def _speed(term: FrictionTerm) -> float | None:
    return term.speed if term.speed_symbol else None
