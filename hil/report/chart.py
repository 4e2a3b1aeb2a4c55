"""Charts, described once: plots of lines and dots over one quantity, boxes, and matrices.

:mod:`hil.report.chart_picture` draws them with matplotlib, for picture files and for pages without
their script; :mod:`hil.report.interactive` gives charts to BokehJS, which draws them in a page.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from hil.base.arrays import Array
from hil.base.terminal_text import one_line

INK, MUTED, BAND, FIRST, SECOND, WIDE = (
    f"var(--{name})" for name in ("ink", "muted", "band", "first", "second", "wide")
)
"""Variables of the style sheet (light, dark, print); `WIDE` is a light colour for a broad line
below another one."""
_MARGIN_SHARE: Final = 0.05  # free on both sides of the values, as a share of their range
_MAX_LABEL_LENGTH: Final = 28


class Caption(NamedTuple):
    """Texts of a panel: `key` makes its ids unique in the page, `what` is the description."""

    key: str
    title: str
    note: str
    what: str


def label(text: str) -> str:
    """Shorten a name to one printable line."""
    line = one_line(text)
    return line if len(line) <= _MAX_LABEL_LENGTH else line[: _MAX_LABEL_LENGTH - 1] + "…"


def thinned(time: Array, values: Array, bins: int = 500) -> tuple[Array, Array]:
    """Return minimum and maximum of each of `bins` equal intervals, (m,) -> (<= 2 bins + 2,)."""
    if time.size <= 2 * bins:
        return time, values
    edges = np.linspace(0, time.size, bins + 1).astype(np.intp)
    starts = edges[:-1, None]
    ends = edges[1:, None]
    # Rows of equal length: the last sample of an interval is repeated.
    rows = np.minimum(starts + np.arange(int(np.max(ends - starts))), ends - 1)
    parts = values[rows]
    starts = edges[:-1]
    extremes = [starts + parts.argmin(axis=1), starts + parts.argmax(axis=1)]
    chosen = np.unique(np.concatenate([[0, time.size - 1], *extremes]))
    return time[chosen], values[chosen]


def padded(values: Array) -> tuple[float, float]:
    """Return the range of the finite values with a margin; it is never empty."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return 0.0, 1.0
    low = float(finite.min())
    high = float(finite.max())
    # Neighbouring floats have no ticks between them.
    if not high - low > 1e-9 * max(abs(low), abs(high)):
        margin = 0.05 * abs(low) or 1.0
        return low - margin, high + margin
    margin = _MARGIN_SHARE * (high - low)
    return low - margin, high + margin


def joined(arrays: Iterable[Array]) -> Array:
    """Return the values of arrays in one (m,)."""
    return np.concatenate([np.empty(0), *(np.asarray(a, np.float64).ravel() for a in arrays)])


@dataclass(frozen=True, eq=False)
class Trace:
    """One line of a plot, or a set of dots."""

    values: Array  #: (m,)
    colour: str  #: of the palette
    width: float  #: of the line, or diameter of a dot [px]
    dashed: bool = False
    name: str = ""  #: in the legend, and next to its value
    x: Array | None = None  #: (m,) if not that of the chart
    dots: bool = False
    #: may leave the plot: a poor model's error is much larger than a good one's
    loose: bool = False

    def over(self, x: Array) -> Trace:
        """Return the line over other values of x (m,)."""
        return replace(self, x=x)


@dataclass(frozen=True, eq=False)
class Plot:
    """Axes of a chart."""

    height: float  #: [px]
    heading: str  #: quantity and unit
    traces: Sequence[Trace]  #: its lines, the lowest first
    #: shaded intervals of x
    shaded: Sequence[tuple[float, float]] = ()
    shade: str = "not in motion"  #: what these are, in a legend
    #: largest value of a range about zero; the range of the lines if None
    reach: float | None = None
    limits: tuple[float, float] | None = None  #: the range, if neither
    origin: bool = False  #: whether lines are drawn through x = 0 and y = 0
    band: tuple[float, float] | None = None  #: shaded interval of y
    names: Sequence[tuple[float, str]] = ()  #: of places on the vertical axis, in place of ticks

    @property
    def y_limits(self) -> tuple[float, float]:
        """Range of the vertical axis: of the lines; a loose one at most doubles it."""
        if self.reach is not None:
            return -self.reach, self.reach
        if self.limits is not None:
            return self.limits
        low, high = padded(joined(t.values for t in self.traces if not t.loose))
        span = high - low
        loose = joined(t.values for t in self.traces if t.loose)
        if not np.isfinite(loose).any():
            return low, high
        least, most = padded(loose)
        return min(low, max(least, low - span)), max(high, min(most, high + span))


@dataclass(frozen=True, eq=False)
class Chart:
    """Plots over the same quantity, one above the other."""

    caption: Caption
    x: Array  #: (m,)
    plots: Sequence[Plot]
    foot: str = "time [s]"  #: quantity and unit of x
    joint: int | None = None  #: number of the joint, from 0
    log: bool = False  #: whether both axes are logarithmic
    ticks: Sequence[float] = ()  #: of x, in place of round ones
    tick_names: Sequence[str] = ()  #: their texts, if not the numbers themselves
    x_range: tuple[float, float] | None = None  #: of the horizontal axis, if not that of the lines
    shares_x: bool = True  #: whether a page moves the axes of a figure's charts together

    @property
    def x_limits(self) -> tuple[float, float]:
        """Range of the horizontal axis."""
        if self.x_range is not None:
            return self.x_range
        if any(trace.x is not None for plot in self.plots for trace in plot.traces):
            return padded(joined(t.x for p in self.plots for t in p.traces if t.x is not None))
        return float(self.x[0]), max(float(self.x[-1]), float(self.x[0]) + 1e-9)


@dataclass(frozen=True, eq=False)
class Boxes:
    """Columns of values: dots, with a box of quartiles and median for five and more."""

    caption: Caption
    columns: Sequence[Array]  #: values (m,) of each
    colours: Sequence[str]  #: of the palette
    heading: str  #: quantity and unit of the values
    names: Sequence[str]  #: of the columns


@dataclass(frozen=True, eq=False)
class Matrix:
    """Absolute correlations between pairs, white for 0 and black for 1."""

    caption: Caption
    values: Array  #: (n, n), 0 to 1
    names: Sequence[str]  #: of rows and columns


def correlations(values: Array, names: Sequence[str], key: str, title: str) -> Matrix:
    """Return the matrix of a normalised covariance.

    Args:
        values: (n, n).
        names: of the rows.
        key: of the figure.
        title: of the figure.
    """
    n = len(names)
    absolute = np.abs(values)
    note = f"{int(np.sum(np.triu(absolute, 1) > 0.9))} of {n * (n - 1) // 2} pairs above 0.9"
    what = f"absolute correlation between {n} base parameters, white for 0 and black for 1"
    return Matrix(Caption(key, title, note, what), absolute, names)


def error_bars(at: Array, ends: Array, colour: str, width: float) -> Trace:
    """Return vertical lines.

    Args:
        at: their places (m,).
        ends: of each (m, 2).
        colour: of the lines.
        width: of the lines.
    """
    gap = np.full((len(at), 1), np.nan)
    places = np.column_stack([at, at, gap[:, 0]]).ravel()
    return Trace(np.hstack([ends, gap]).ravel(), colour, width, x=places)


def rule(y: float, x_limits: tuple[float, float]) -> Trace:
    """Return a thin line at a height, across the whole plot."""
    return Trace(np.full(2, y), MUTED, 0.9, x=np.array(x_limits))


class Legend(NamedTuple):
    """Colour and width of the lines of a chart, by the key and the text of their legend."""

    key: str
    text: str
    colour: str
    width: float
    dashed: bool = False

    def trace(self, values: Array, *, loose: bool = False, width: float = 0.0) -> Trace:
        """Return the line of these values."""
        return Trace(
            values, f"var({self.colour})", width or self.width, self.dashed, self.key, loose=loose
        )
