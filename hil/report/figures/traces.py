"""The samples behind a panel, in the page, for whoever zooms into it.

A figure is drawn with as many points as a screen shows; closer up a reader wants the samples. They
go into the page as 16 bit numbers on an even grid of time, one string per line.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hil.report.figures.palette import CSS_VARIABLES

Array = NDArray[np.float64]

MOST_POINTS: Final = 3000
"""Of a line; more than three times what a panel shows at once."""
_STEPS: Final = 65534
_NOTHING: Final = 65535
"""Stands where nothing was recorded."""


@dataclass(frozen=True, eq=False)
class Trace:
    """One line.

    Attributes:
        values: (m,); NaN where nothing was recorded.
        colour: of the palette.
        width: of the line [px].
        name: what it is, in a word.
    """

    values: Array
    colour: str
    width: float
    name: str


@dataclass(frozen=True, eq=False)
class Plot:
    """Axes of a panel with time to the right.

    Attributes:
        box: left, top, width and height in the panel [px].
        heading: what stands above: the quantity and its unit.
        traces: its lines, the lowest first.
        limits: values at which dashed lines are drawn.
        shaded: stretches of time [s] that are shaded, from the first instant on.
    """

    box: tuple[float, float, float, float]
    heading: str
    traces: Sequence[Trace]
    limits: Sequence[float] = ()
    shaded: Sequence[tuple[float, float]] = ()


def traces_text(time: Array, plots: Sequence[Plot], *, points: int = MOST_POINTS) -> str:
    """Plots over time (m,) [s] from zero as the page's script reads them: JSON.

    Lines are resampled evenly, to at most `points`; "" where there is nothing to zoom into.
    """
    if time.size < 2 or not time[-1] > time[0]:
        return ""
    grid = np.linspace(time[0], time[-1], min(points, time.size))
    even = [
        replace(
            plot,
            traces=[replace(one, values=np.interp(grid, time, one.values)) for one in plot.traces],
        )
        for plot in plots
    ]
    return even_traces_text(0.0, float(time[-1] - time[0]), even)


def even_traces_text(
    begin: float, length: float, plots: Sequence[Plot], marks: Sequence[float] = ()
) -> str:
    """Plots whose lines are evenly sampled in time already, from the first instant to the last.

    Args:
        begin: what the first instant is called [s].
        length: time from the first to the last [s].
        plots: them.
        marks: instants at which upright lines are drawn [s], named like `begin`.
    """
    content = {
        "begin": round(begin, 6),
        "end": round(length, 6),
        "marks": [round(time - begin, 6) for time in marks],
        "plots": [
            {
                "box": plot.box,
                "heading": plot.heading,
                "limits": [float(f"{limit:.7g}") for limit in plot.limits],
                "shaded": [[round(start, 4), round(stop, 4)] for start, stop in plot.shaded],
                "lines": [_line(one.values, one) for one in plot.traces],
            }
            for plot in plots
        ],
    }
    return json.dumps(content, separators=(",", ":"), ensure_ascii=False)


def _line(values: Array, trace: Trace) -> dict[str, str | float]:
    there = np.isfinite(values)
    known = values[there]
    low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 0.0)
    step = (high - low) / _STEPS or 1.0
    counts = np.full(values.shape, _NOTHING, dtype="<u2")
    counts[there] = np.rint((known - low) / step)
    return {
        "name": trace.name,
        "colour": CSS_VARIABLES[trace.colour],
        "width": trace.width,
        "low": float(f"{low:.7g}"),
        "step": float(f"{step:.7g}"),
        "data": base64.b64encode(counts.tobytes()).decode("ascii"),
    }
