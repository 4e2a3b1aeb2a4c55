"""What stands above the page of a designed motion: what it is, and what was not looked at."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hil.plots import style
from hil.report.figures.svg import label
from identification.excitation.excitation import Excitation

_LETTERS = 180
"""In a line of small print across the page."""
_BARS = "the arm (bars from joint to joint: its shapes are not known here)"
_SMALL = style.SMALL + 0.5


@dataclass(frozen=True)
class Line:
    """One line of the heading, its size in points."""

    text: str
    size: float
    colour: str
    weight: str = "normal"


@dataclass(frozen=True)
class Remarks:
    """What has to be known beside the numbers.

    Attributes:
        unchecked: what the search did not look at.
        complete: whether the search came to its end.
        together: whether the criteria are those together with earlier archives.
        margins: how close the motion comes to its limits.
    """

    unchecked: Sequence[str] = ()
    complete: bool = True
    together: bool = False
    margins: str = ""


def heading(
    excitation: Excitation, title: str, remarks: Remarks, *, shapes: bool, outlined: bool
) -> list[Line]:
    """Return the lines above the page.

    Args:
        excitation: the motion.
        title: the first words.
        remarks: beside the numbers.
        shapes: whether the arm is drawn as it is.
        outlined: whether a view shows a box in front of or behind the arm.
    """
    lines = _numbers(excitation, title, together=remarks.together)
    if remarks.unchecked:
        missing = ", ".join(remarks.unchecked)
        lines += _red(f"NOT CHECKED: {missing}; not for a robot")
    if not remarks.complete:
        lines += _red("search stopped early: it may have missed better motions")
    lines += _small(remarks.margins, style.INK)
    legend = [
        "red dashes: limits",
        "grey lines: the postures numbered below",
        f"blue: all that {'the arm' if shapes else _BARS} sweeps",
        "brown: the way of its end to the next one",
    ]
    if outlined:
        legend.append("dashed boxes: in front of or behind the arm")
    return lines + _small("; ".join(legend), style.MUTED)


def number(value: float, digits: int) -> str:
    """Return a criterion as text; a motion that leaves a parameter unexcited has infinite ones."""
    return f"{value:.{digits}f}" if np.isfinite(value) else ("∞" if value > 0.0 else "−∞")


def _numbers(excitation: Excitation, title: str, *, together: bool) -> list[Line]:
    """The title, and the criteria: apart from it where they are not those of the motion alone."""
    criteria = excitation.criteria
    parts = [
        label(title),
        f"method {excitation.method}",
        f"{excitation.trajectory.duration:.2f} s",
    ]
    determinant, index = number(criteria.log10_det, 2), f"I_c {number(criteria.coupling_index, 1)}"
    if not together:
        parts += [f"log₁₀(det ΦᵀΦ / Nᵖ) {determinant}", index]
        return [Line(" · ".join(parts), style.TITLE, style.INK)]
    parts.append("together with earlier archives, weighted")
    return [
        Line(" · ".join(parts), style.TITLE, style.INK),
        Line(
            f"log₁₀ det {determinant} and {index} of all of it together: "
            "not comparable with those of a motion alone",
            style.TEXT,
            style.INK,
        ),
    ]


def _red(text: str) -> list[Line]:
    wrapped = textwrap.wrap(text, _LETTERS * 2 // 3)
    return [Line(line, style.TEXT + 1.0, style.LIMIT, "bold") for line in wrapped]


def _small(text: str, colour: str) -> list[Line]:
    printable = "".join(c if c.isprintable() else " " for c in text)
    return [Line(line, _SMALL, colour) for line in textwrap.wrap(printable, _LETTERS)]
