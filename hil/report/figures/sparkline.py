"""Very small plots, drawn without matplotlib: a page has one for every parameter."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from markupsafe import Markup, escape
from numpy.typing import NDArray

from hil.report import numbers

Array = NDArray[np.float64]

_WIDTH, _HEIGHT, _LEFT, _RIGHT, _TOP, _BOTTOM = 200.0, 84.0, 8.0, 8.0, 8.0, 18.0
_TEXT: Final = 10.5


def sparkline(
    at: Array, values: Array, half: Array, *, colour: str, ends: Sequence[str], alt: str
) -> Markup:
    """Points with bars as inline SVG, their median, and both ends in words.

    Args:
        at: horizontal place (c,), rising.
        values: (c,), NaN where there is none; one at least is finite.
        half: half length of the bars (c,).
        colour: variable of the style sheet.
        ends: what stands below the first and the last place.
        alt: what it shows.
    """
    known = np.isfinite(values)
    low, high = float((values - half)[known].min()), float((values + half)[known].max())
    if not high > low:
        low, high = low - 0.5, high + 0.5
    span = float(at[-1] - at[0]) or 1.0
    inner, tall = _WIDTH - _LEFT - _RIGHT, _HEIGHT - _TOP - _BOTTOM
    x = _LEFT + inner * ((at - at[0]) / span if at[-1] > at[0] else np.full(len(at), 0.5))
    y, top, bottom = (
        _TOP + tall * (high - line) / (high - low)
        for line in (values, values + half, values - half)
    )
    bars = "".join(f"M{x[k]:.1f} {top[k]:.1f}V{bottom[k]:.1f}" for k in np.flatnonzero(known))
    dots = "".join(
        f'<circle cx="{x[k]:.1f}" cy="{y[k]:.1f}" r="2.4"/>' for k in np.flatnonzero(known)
    )
    middle = float(np.median(values[known]))
    level = _TOP + tall * (high - middle) / (high - low)
    words = "".join(
        f'<text x="{place:g}" y="{_HEIGHT - 4:g}" text-anchor="{anchor}" font-size="{_TEXT}"'
        f' style="fill:var(--muted)">{escape(text)}</text>'
        for place, anchor, text in ((_LEFT, "start", ends[0]), (_WIDTH - _RIGHT, "end", ends[-1]))
    )
    reach = f"{numbers.significant(low)} and {numbers.significant(high)}"
    described = f"{alt} Intervals lie within {reach}."
    median = f"M{_LEFT:g} {level:.1f}H{_WIDTH - _RIGHT:g}"
    return Markup(
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH:g} {_HEIGHT:g}" role="img"'
        f' aria-label="{escape(described)}">'
        f'<path d="{median}" style="stroke:var(--line);fill:none"/>'
        f'<path d="{bars}" style="stroke:var({colour});stroke-width:1.1;fill:none"/>'
        f'<g style="fill:var({colour})">{dots}</g>{words}</svg>'
    )
