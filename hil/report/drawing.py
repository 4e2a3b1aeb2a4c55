"""Panels of the pages as SVG, in the font and colours of the style sheet.

A report has some forty plots of lines, dots and bands. A general plotting library takes a tenth of
a second for each, and half a second to load; these are written as text directly.
"""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Final, Literal

import numpy as np
from markupsafe import Markup, escape

from hil.base.arrays import Array
from hil.report.chart import Caption, Chart, joined, label, one_line, padded, thinned

INK, MUTED, GRID, BAND, FIRST, SECOND, WIDE = (
    f"var(--{name})" for name in ("ink", "muted", "grid", "band", "first", "second", "wide")
)
"""Variables of the style sheet (light, dark, print); `WIDE` is a light colour for a broad line
below another one."""

TICK_SIZE = 10.5
TEXT_SIZE = 11.0
# of a panel, px
_WIDTH = 370.0
_LEFT = 46.0
_RIGHT = 10.0
_TOP = 20.0
_BOTTOM = 40.0
_GAP: Final = 24.0  # between plots above each other, px
_TICK = 3.0  # length, px
_PAD = 6.5  # distance of text, px
_THIN = 0.8  # width of thin lines, px
_FOOT: Final = 32.0  # from the axis down to the base line of its quantity, px
_FEWEST_FOR_A_BOX: Final = 5  # values
_BINS: Final = 300  # of a line over time, which has up to two points in each, some one per px
_FEWEST_TICKS: Final = 3  # of y: a printed chart has no pointer that reads it
_STEPS: Final = (1.0, 2.0, 5.0, 10.0)  # of round ticks, times a power of ten
_MOST_DIGITS: Final = 1e6  # Ticks from here on have an exponent


@dataclass(frozen=True)
class Panel:
    """One drawing with the title above it and a note beside the title."""

    title: str
    note: str
    svg: Markup
    key: str = ""  #: of its caption
    joint: int | None = None  #: number of the joint of a chart, from 0


def round_ticks(
    low: float, high: float, most: int, fewest: int = 0
) -> tuple[list[float], list[str]]:
    """Return the round values from `low` to `high`, at most `most` intervals, with their texts."""
    size = (high - low) / most
    decade = 10.0 ** math.floor(math.log10(size))
    steps = [0.1 * s * decade for s in _STEPS[:-1]] + [s * decade for s in _STEPS]
    wide = [k for k, step in enumerate(steps) if step >= size * (1.0 - 1e-9)]
    at = wide[0] if wide else len(steps) - 1
    first, last = _multiples(low, high, steps[at])
    while last - first + 1 < fewest and at > 0:
        at = at - 1
        first, last = _multiples(low, high, steps[at])
    step = steps[at]
    ticks = [k * step for k in range(first, last + 1)]
    place = math.floor(math.log10(step) + 1e-9)
    if max(abs(low), abs(high)) < _MOST_DIGITS and place >= -6:
        texts = [f"{tick:.{max(0, -place)}f}" for tick in ticks]
    else:
        digits = [math.floor(math.log10(abs(tick))) - place if tick else 0 for tick in ticks]
        texts = [f"{tick:.{max(0, d)}e}" for tick, d in zip(ticks, digits, strict=True)]
    return ticks, [text.replace("-", "−") for text in texts]


def _multiples(low: float, high: float, step: float) -> tuple[int, int]:
    """Return the first and the last multiple of a step between two ends."""
    return math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)


@dataclass
class Axes:
    """One plot of a panel: shapes are collected in units of the data, and written at the end."""

    left: float  #: edge in the panel [px]
    top: float
    width: float
    height: float
    heading: str = ""  #: quantity and unit of the vertical axis
    foot: str = ""  #: those of the horizontal one
    x_limits: tuple[float, float] | None = None  #: the range of the values with a margin if None
    y_limits: tuple[float, float] | None = None
    x_ticks: int = 5  #: at most so many intervals; none if 0
    y_ticks: int = 4
    x_labelled: bool = True
    x_names: Sequence[tuple[float, str]] = ()  #: names at places instead of round ticks
    y_names: Sequence[tuple[float, str]] = ()
    grid: Literal["both", "y"] = "both"
    _shapes: list[tuple[str, Array, Array, str]] = field(default_factory=list)

    def line(
        self, x: Array, y: Array, colour: str, width: float, *, dashed: bool = False, ends: str = ""
    ) -> None:
        """Draw a line through points (m,), interrupted at NaN."""
        dash = ";stroke-dasharray:4 3" if dashed else ";stroke-linecap:square"
        style = f"fill:none;stroke:{colour};stroke-width:{width:g}{ends or dash}"
        self._shapes.append(("line", np.asarray(x), np.asarray(y), style))

    def segments(self, x: Array, y: Array, colour: str, width: float) -> None:
        """Draw lines that are not connected, (m, 2) each."""
        apart = np.full((len(x), 1), np.nan)
        across = np.hstack([x, apart]).ravel()
        up = np.hstack([y, apart]).ravel()
        self.line(across, up, colour, width, ends=";stroke-linecap:butt")

    def dots(self, x: Array, y: Array, colour: str, size: float, *, opacity: float = 1.0) -> None:
        """Draw dots at points (m,), of a diameter in px."""
        style = f"fill:none;stroke:{colour};stroke-width:{size:g};stroke-linecap:round"
        style += f";stroke-opacity:{opacity:g}" if opacity < 1.0 else ""
        self._shapes.append(("dots", np.asarray(x), np.asarray(y), style))

    def bands(self, x: Array, y: Array, colour: str, outline: str = "") -> None:
        """Fill rectangles, (m, 2) each; infinite ends are those of the plot."""
        style = f"fill:{colour}" + (f";stroke:{outline};stroke-width:1" if outline else "")
        self._shapes.append(("bands", np.asarray(x), np.asarray(y), style))

    def svg(self, clip: str) -> str:
        """Return the plot; `clip` is the id of its clipping path."""
        visible = [shape for shape in self._shapes if shape[0] != "bands" or "stroke" in shape[3]]
        low, high = self.x_limits or padded(joined(shape[1] for shape in visible))
        bottom, top = self.y_limits or padded(joined(shape[2] for shape in visible))
        right = self.left + self.width
        foot = self.top + self.height

        def across(x: Array) -> Array:
            share = (np.asarray(x, np.float64) - low) / (high - low)
            return np.asarray(self.left + self.width * np.clip(share, -3.0, 4.0))

        def up(y: Array) -> Array:
            share = (np.asarray(y, np.float64) - bottom) / (top - bottom)
            return np.asarray(foot - self.height * np.clip(share, -3.0, 4.0))

        names = self.x_names or list(zip(*round_ticks(low, high, self.x_ticks), strict=True))
        x_at = across(np.array([place for place, _ in names])).tolist()
        heights = self.y_names or list(
            zip(*round_ticks(bottom, top, self.y_ticks, _FEWEST_TICKS), strict=True)
        )
        y_at = up(np.array([place for place, _ in heights])).tolist()
        rules = [f"M{self.left:g} {y:.1f}H{right:g}" for y in y_at]
        rules += [f"M{x:.1f} {self.top:g}V{foot:g}" for x in x_at if self.grid == "both"]
        frame = [f"M{self.left:g} {self.top:g}V{foot:g}H{right:g}"]
        frame += [f"M{self.left:g} {y:.1f}h{-_TICK:g}" for y in y_at]
        frame += [f"M{x:.1f} {foot:g}v{_TICK:g}" for x in x_at if not self.x_names]
        area = f'x="{self.left:g}" y="{self.top:g}" width="{self.width:g}" height="{self.height:g}"'
        thin = f"fill:none;stroke-width:{_THIN:g};stroke:"
        parts = [f'<clipPath id="{clip}"><rect {area}/></clipPath><g clip-path="url(#{clip})">']
        shapes = [_path(kind, across(x), up(y), style) for kind, x, y, style in self._shapes]
        below = [kind == "bands" and "stroke" not in style for kind, *_, style in self._shapes]
        parts += [shape for shape, first in zip(shapes, below, strict=True) if first]
        parts.append(f'<path d="{"".join(rules)}" style="{thin}{GRID}"/>')
        parts += [shape for shape, first in zip(shapes, below, strict=True) if not first]
        parts.append(f'</g><path d="{"".join(frame)}" style="{thin}{MUTED}"/>')
        parts += [
            _text(text, self.left - _PAD, y + 0.38 * TICK_SIZE, INK, TICK_SIZE, "end")
            for y, (_, text) in zip(y_at, heights, strict=True)
        ]
        if self.x_labelled:
            parts += [
                _text(line, x, foot + _PAD + (k + 0.76) * 1.2 * TICK_SIZE, INK, TICK_SIZE, "middle")
                for x, (_, text) in zip(x_at, names, strict=True)
                for k, line in enumerate(text.split("\n"))
            ]
        parts.append(_text(self.heading, self.left, self.top - 5.0, MUTED, TEXT_SIZE, "start"))
        middle = self.left + 0.5 * self.width
        parts.append(_text(self.foot, middle, foot + _FOOT, MUTED, TEXT_SIZE, "middle"))
        return "".join(parts)


def _path(kind: str, x: Array, y: Array, style: str) -> str:
    """Return a shape with its points in px."""
    if kind == "bands":
        corners = zip(x.tolist(), y.tolist(), strict=True)
        d = "".join(
            f"M{left:.1f} {foot:.1f}H{right:.1f}V{top:.1f}H{left:.1f}z"
            for (left, right), (foot, top) in corners
        )
        return f'<path d="{d}" style="{style}"/>'
    there = np.isfinite(x) & np.isfinite(y)
    places = np.round(np.stack([x, y], axis=1)[there], 1)
    if kind == "dots":
        d = "".join(f"M{across} {up}h0" for across, up in places.tolist())
    else:
        # A line starts again behind a gap; its points need no letter.
        starts = there & np.concatenate([[True], ~there])[:-1]
        lines = np.split(places, np.flatnonzero(starts[there])[1:]) if len(places) else []
        d = "".join(
            f"M{line[0, 0]} {line[0, 1]}"
            + (f"L{' '.join(map(str, line[1:].ravel().tolist()))}" if len(line) > 1 else "h0")
            for line in lines
        )
    return f'<path d="{d}" style="{style}"/>'


def _text(text: str, x: float, y: float, colour: str, size: float, anchor: str) -> str:
    if not text:
        return ""
    style = f"font-size:{size:g}px;text-anchor:{anchor};fill:{colour}"
    return f'<text x="{x:.1f}" y="{y:.1f}" style="{style}">{escape(one_line(text))}</text>'


def to_panel(width: float, height: float, content: str, caption: Caption) -> Panel:
    """Return SVG content of a size in px as a panel with its text alternative."""
    note = f"; {caption.note}" if caption.note else ""
    alt = escape(one_line(f"{caption.title}: {caption.what}{note}."))
    size = f'viewBox="0 0 {width:g} {height:g}" style="max-width: {1.3 * width:.0f}px"'
    svg = f'<svg {size} role="img" aria-label="{alt}">{content}</svg>'
    return Panel(caption.title, caption.note, Markup(svg), caption.key)


def panel(plots: Sequence[Axes], caption: Caption, width: float = _WIDTH) -> Panel:
    """Return plots as one panel; its height is that of the lowest plot and the text below it."""
    height = max(axes.top + axes.height for axes in plots) + _BOTTOM
    content = "".join(axes.svg(f"{caption.key}-{k}") for k, axes in enumerate(plots))
    return to_panel(width, height, content, caption)


def single(height: float, heading: str, foot: str, *, x_ticks: int = 5) -> Axes:
    """Return the axes of a panel with one plot; height in px, margins included."""
    inner = height - _TOP - _BOTTOM
    return Axes(_LEFT, _TOP, _WIDTH - _LEFT - _RIGHT, inner, heading, foot, x_ticks=x_ticks)


def chart_panel(chart: Chart, bins: int = _BINS) -> Panel:
    """Draw a chart; a line has at most two points in each of the `bins` of its x."""
    panels = list[Axes]()
    top = _TOP
    scale = _log10 if chart.log else np.asarray
    low, high = (float(scale(np.array(end))) for end in chart.x_limits)
    x_names = [(float(scale(np.array(tick))), f"{tick:g}") for tick in chart.ticks]
    if chart.log and not x_names:
        x_names = _decades(low, high)
    for k, plot in enumerate(chart.plots):
        last = k == len(chart.plots) - 1
        bottom, upper = (float(scale(np.array(end))) for end in plot.y_limits)
        axes = Axes(
            _LEFT, top, _WIDTH - _LEFT - _RIGHT, plot.height, plot.heading,
            chart.foot if last else "", x_limits=(low, high), x_ticks=6, x_labelled=last,
            y_limits=(bottom, upper), x_names=x_names,
            y_names=_decades(bottom, upper) if chart.log else (),
        )  # fmt: skip
        if plot.shaded:
            infinite = np.full((len(plot.shaded), 1), np.inf)
            axes.bands(np.array(plot.shaded), np.hstack([-infinite, infinite]), BAND)
        if plot.origin:
            endless = np.array([-np.inf, np.inf])
            axes.segments(
                np.array([endless, [0.0, 0.0]]), np.array([[0.0, 0.0], endless]), MUTED, 0.8
            )
        for trace in plot.traces:
            x = scale(chart.x if trace.x is None else trace.x)
            values = scale(trace.values)
            if trace.dots:
                axes.dots(x, values, trace.colour, trace.width)
            else:
                # A line with its own places may be several, with gaps between them.
                points = thinned(x, values, bins) if trace.x is None else (x, values)
                axes.line(*points, trace.colour, trace.width, dashed=trace.dashed)
        panels.append(axes)
        top += plot.height + _GAP
    return replace(panel(panels, chart.caption), joint=chart.joint)


def _log10(values: Array) -> Array:
    with np.errstate(divide="ignore", invalid="ignore"):
        logarithm = np.log10(values)
    return np.where(np.isfinite(logarithm), logarithm, np.nan)


def _decades(low: float, high: float) -> list[tuple[float, str]]:
    """Return the powers of ten in a range of logarithms, at most six, with their texts.

    If there are fewer than two: their multiples, or the middle of a range without any.
    """
    first = math.ceil(low)
    last = math.floor(high)
    step = max(1, -(-(last - first + 1) // 6))
    places = [float(k) for k in range(first, last + 1, step)]
    if len(places) < 2:
        multiples = [k + math.log10(m) for k in range(first - 1, last + 1) for m in (1.0, 2.0, 5.0)]
        places = [place for place in multiples if low <= place <= high] or [0.5 * (low + high)]
    return [(place, f"{10.0**place:.3g}") for place in places]


def box_panel(
    caption: Caption,
    columns: Sequence[Array],
    colours: Sequence[str],
    heading: str,
    labels: Sequence[str],
) -> Panel:
    """Draw columns of values (m,) as dots with a box: quartiles, median, 1.5 box heights."""
    lines = 1 + max(text.count("\n") for text in labels)
    width = 110.0 + 40.0 * len(columns)
    bottom = 12.0 + 13.0 * lines
    # A scale that shows every value and does not exaggerate small changes.
    every = np.concatenate(columns)
    middle = float(np.median(every))
    low = min(float(every.min()), 0.9 * middle)
    high = max(float(every.max()), 1.1 * middle)
    limits = max(0.0, low - 0.06 * (high - low)), high + 0.06 * (high - low) or 1.0
    axes = Axes(
        _LEFT, _TOP, width - _LEFT - _RIGHT, 206.0 - _TOP, heading, y_limits=limits, y_ticks=5,
        x_limits=(0.4, len(columns) + 0.6), x_names=list(enumerate(labels, 1)), grid="y",
    )  # fmt: skip
    for k, (values, colour) in enumerate(zip(columns, colours, strict=True), 1):
        if values.size >= _FEWEST_FOR_A_BOX:
            first, median, third = np.percentile(values, (25.0, 50.0, 75.0)).tolist()
            reach = 1.5 * (third - first)
            inside = values[(values >= first - reach) & (values <= third + reach)]
            ends = min(float(inside.min()), first), max(float(inside.max()), third)
            axes.bands(np.array([[k - 0.3, k + 0.3]]), np.array([[first, third]]), BAND, MUTED)
            whiskers = [[k, k], [k, k], [k - 0.15, k + 0.15], [k - 0.15, k + 0.15]]
            levels = [[ends[0], first], [third, ends[1]], [ends[0]] * 2, [ends[1]] * 2]
            axes.segments(np.array(whiskers), np.array(levels), MUTED, 1.0)
            axes.segments(np.array([[k - 0.3, k + 0.3]]), np.array([[median] * 2]), INK, 2.2)
        # Horizontal offsets by the golden ratio separate neighbouring values.
        rank = np.argsort(np.argsort(values, kind="stable"), kind="stable")
        side = k + 0.34 * ((rank * 0.6180339887498949) % 1.0 - 0.5)
        axes.dots(np.asarray(side, np.float64), values, colour, 4.0, opacity=0.85)
    content = axes.svg(f"{caption.key}-0")
    return to_panel(width, 206.0 + bottom, content, caption)


_LABELS: Final = 84.0  # px
_SIDE: Final = 560.0  # px
_SMALLEST_CELL = 11.0  # px
_LARGEST_CELL = 26.0  # px


def matrix_panel(matrix: Array, labels: Sequence[str], key: str, title: str) -> Panel:
    """Draw |ρ| of a normalised matrix (n, n), 0 white, 1 black, one label for each row."""
    from PIL import Image  # only pages with a matrix need it

    n = len(labels)
    matrix = np.abs(matrix)
    note = f"{int(np.sum(np.triu(matrix, 1) > 0.9))} of {n * (n - 1) // 2} pairs above 0.9"
    what = f"absolute correlation between {n} base parameters, white for 0 and black for 1"
    cell = min(max(_SIDE / n, _SMALLEST_CELL), _LARGEST_CELL)
    side = n * cell
    size = min(TICK_SIZE, 0.76 * cell)
    grey = np.round(255.0 * (1.0 - np.clip(np.nan_to_num(matrix), 0.0, 1.0))).astype(np.uint8)
    png = io.BytesIO()
    Image.fromarray(np.repeat(grey[:, :, None], 3, axis=2)).save(png, "png")
    data = base64.b64encode(png.getvalue()).decode("ascii")
    area = f'x="{_LABELS:g}" y="{_LABELS:g}" width="{side:g}" height="{side:g}"'
    parts = [
        f'<image {area} preserveAspectRatio="none" style="image-rendering:pixelated"'
        f' href="data:image/png;base64,{data}"/>',
        f'<rect {area} style="fill:none;stroke:{MUTED};stroke-width:{_THIN:g}"/>',
    ]
    for k, text in enumerate(labels):
        at = _LABELS + (k + 0.5) * cell + 0.36 * size
        name = label(text)
        parts.append(_text(name, _LABELS - 4.0, at, INK, size, "end"))
        upward = _text(name, 0.0, 0.0, INK, size, "start")
        parts.append(
            f'<g transform="translate({at:.1f} {_LABELS - 4.0:g}) rotate(-90)">{upward}</g>'
        )
    whole = _LABELS + side + 6.0
    return to_panel(whole, whole, "".join(parts), Caption(key, title, note, what))
