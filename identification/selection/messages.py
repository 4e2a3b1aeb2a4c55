"""The choice of essential parameters in words."""

from __future__ import annotations

from identification.selection.essential import Elimination
from identification.text import percentage


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
        text += f"; removing these raises the error on held-out motion: {refused}"
    elif chosen.spread < elimination.rule.spread:
        text += f", less than {elimination.rule.spread:g}"
    return (
        f"{text}. Error on the motion used for the choice: {percentage(full.held_out, 2)} with all"
        f" parameters, {percentage(chosen.held_out, 2)} with these"
    )
