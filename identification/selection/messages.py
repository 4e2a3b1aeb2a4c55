"""Chosen settings, and the choice of essential parameters, in words."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from identification.model.messages import reversal_text, terms_text
from identification.selection.essential import Elimination
from identification.selection.settings import Candidate, Strength
from identification.text import number, percentage

_ROWS: Final = {
    "slow": "slow rows and reversals",
    "halts": "long halts of each joint",
    "rests": "rests of the whole arm",
    "none": "none",
    None: "by the friction law",
}


def candidate_words(candidates: Sequence[Candidate]) -> list[str]:
    """Return in what each candidate of a setting differs from others."""
    descriptions = [_described(candidate) for candidate in candidates]
    differ = [len(set(column)) > 1 for column in zip(*descriptions, strict=True)]
    return [
        ", ".join(part for part, apart in zip(parts, differ, strict=True) if apart)
        for parts in descriptions
    ]


def strength_words(strength: Strength) -> tuple[str, ...]:
    """Return the strength of a prior as phrases."""
    return (
        f"body prior weighted {strength.weight:g} times",
        "physically consistent" if strength.consistent else "physical consistency not required",
        "wide rotor prior" if strength.wide_rotors else "rotor prior as for links",
    )


def _described(candidate: Candidate) -> tuple[str, ...]:
    """Return a candidate property by property."""
    ripple = "no torque ripple"
    if candidate.ripple:
        ripple = f"torque ripple, {' and '.join(map(str, candidate.ripple))} per motor turn"
    low_pass = "no low-pass"
    if candidate.low_pass is not None:
        low_pass = f"low-pass of {number(candidate.low_pass)} Hz, {candidate.shape}"
    springs = ", ".join(candidate.springs)
    of_position = ", ".join(candidate.position_torques)
    return (
        f"{candidate.bandwidth:g} Hz",
        "measured velocity" if candidate.velocity == "measured" else "velocity from positions",
        terms_text(candidate.friction),
        reversal_text(candidate.tanh, candidate.presliding),
        ripple,
        f"torsion springs of {springs}" if springs else "no torsion spring",
        f"torque of the position of {of_position}" if of_position else "no torque of the position",
        _ROWS[candidate.excluded_rows],
        f"delay of {number(1e3 * candidate.delay)} ms",
        low_pass,
        *strength_words(candidate.strength),
    )


def cut_words(elimination: Elimination) -> str:
    """Return why the elimination ended where it did."""
    full = elimination.steps[0]
    chosen = elimination.chosen
    text = (
        f"{chosen.left} of {full.left} parameters are essential: their relative standard deviations"
        f" differ by a factor of {chosen.spread:.3g}"
    )
    if elimination.refused:
        refused = ", ".join(elimination.refused)
        text += f"; removing any of these would raise the error on held-out motion: {refused}"
    elif chosen.spread < elimination.rule.spread:
        text += f", less than {elimination.rule.spread:g}"
    return (
        f"{text}. Error on the motion used for the choice: {percentage(full.held_out, 2)} with all"
        f" parameters, {percentage(chosen.held_out, 2)} with these"
    )
