"""From a matplotlib figure to SVG that may stand inside a page, many times over.

matplotlib writes a document: sizes in points, its own fonts, fixed colours, names that repeat from
figure to figure. Inside a page the size comes from the layout, the font from the page and the
colours from the style sheet (light, dark, print), and every id must be the only one.
"""

from __future__ import annotations

import base64
import io
import json
import re
import threading
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Final

import matplotlib as mpl
import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hil.report.figures.canvas import CSS_VARIABLES

_SVG = "http://www.w3.org/2000/svg"
_XLINK = "http://www.w3.org/1999/xlink"
_LONG_DECIMAL = re.compile(r"-?\d+\.\d{3,}")
_FONT_FAMILY = re.compile(r"font-family:[^;]*;?\s*")
_REFERENCE = re.compile(r"url\(#([^)]+)\)")
_LABEL_LENGTH = 28


_settings = threading.RLock()


@dataclass(frozen=True)
class Panel:
    """One drawing: `title` stands above it, `note` beside the title."""

    title: str
    note: str
    svg: Markup
    width: float
    """Width [px] at which its letters have their intended size."""


@contextmanager
def drawing() -> Iterator[None]:
    """Draw inside this: matplotlib's own defaults, whatever the caller's settings are.

    The settings of matplotlib belong to the process, hence one figure at a time.
    """
    with _settings, warnings.catch_warnings(), mpl.rc_context():
        # Letters are left to the page's fonts; that DejaVu lacks one does not matter.
        warnings.filterwarnings("ignore", message=r"Glyph \d+")
        mpl.rcdefaults()
        mpl.rcParams.update(
            {"svg.fonttype": "none", "svg.hashsalt": "hil", "text.parse_math": False}
        )
        yield


def label(text: str) -> str:
    """A name fit for a figure: one line, printable, not too long."""
    line = "".join(c if c.isprintable() else " " for c in text).strip()
    return line if len(line) <= _LABEL_LENGTH else line[: _LABEL_LENGTH - 1] + "…"


def to_panel(
    figure: Figure, *, key: str, title: str, note: str, alt: str, traces: str = ""
) -> Panel:
    """`figure` as SVG; `key` makes its ids unique in the page, `alt` says what it shows.

    With `traces` (see :mod:`hil.report.figures.svg`) a reader can zoom into it.
    """
    root = ET.fromstring(_document(figure))
    _drop_document_parts(root)
    _rename_ids(root, key)
    for element in root.iter():
        _restyle(element)
    width, height = figure.get_size_inches() * 72.0
    root.attrib.clear()
    root.set("viewBox", f"0 0 {width:g} {height:g}")
    root.set("role", "img")
    root.set("aria-label", " ".join("".join(c if c.isprintable() else " " for c in alt).split()))
    if traces:
        root.set("data-traces", traces)
    return Panel(title=title, note=note, svg=Markup(_serialised(root)), width=width)


def _document(figure: Figure) -> str:
    out = io.BytesIO()
    metadata = dict.fromkeys(("Date", "Creator", "Format", "Type"))
    figure.savefig(out, format="svg", metadata=metadata)
    return out.getvalue().decode("utf-8")


def _serialised(root: ET.Element) -> str:
    ET.register_namespace("", _SVG)
    ET.register_namespace("xlink", _XLINK)
    return ET.tostring(root, encoding="unicode")


def _drop_document_parts(root: ET.Element) -> None:
    """Remove style rules (they would hold for the whole page) and layout white space."""
    for parent in list(root.iter()):
        for child in list(parent):
            if child.tag in (f"{{{_SVG}}}style", f"{{{_SVG}}}metadata"):
                parent.remove(child)
        if parent.tag != f"{{{_SVG}}}text" and not (parent.text or "").strip():
            parent.text = None
        parent.tail = None


def _rename_ids(root: ET.Element, key: str) -> None:
    """Keep only ids that something refers to, numbered in order of appearance."""
    references: set[str] = set()
    for element in root.iter():
        references.add(element.get(f"{{{_XLINK}}}href", "").removeprefix("#"))
        for value in element.attrib.values():
            references.update(_REFERENCE.findall(value))
    present = [i for e in root.iter() if (i := e.get("id")) is not None and i in references]
    names = {old: f"{key}-{k}" for k, old in enumerate(present)}
    for element in root.iter():
        _rename_in(element, names)


def _rename_in(element: ET.Element, names: dict[str, str]) -> None:
    for attribute, value in list(element.attrib.items()):
        if attribute == "id":
            if value in names:
                element.set("id", names[value])
            else:
                del element.attrib["id"]
        elif attribute == f"{{{_XLINK}}}href" and value.startswith("#"):
            del element.attrib[attribute]
            element.set("href", f"#{names[value[1:]]}")
        elif "url(#" in value:
            element.set(attribute, _REFERENCE.sub(lambda m: f"url(#{names[m[1]]})", value))


def _restyle(element: ET.Element) -> None:
    """Page fonts, page colours, and no more decimals than a screen has."""
    style = element.get("style")
    if style:
        style = _FONT_FAMILY.sub("", style)
        for sentinel, variable in CSS_VARIABLES.items():
            style = style.replace(sentinel, variable)
        element.set("style", style)
    for attribute in ("d", "x", "y"):
        value = element.get(attribute)
        if value:
            short = _LONG_DECIMAL.sub(lambda m: f"{float(m[0]):.2f}", value)
            element.set(attribute, " ".join(short.split()))
    if re.fullmatch(r"rotate\(-?0 .*\)", element.get("transform", "")):
        del element.attrib["transform"]


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
        dashed: so that two of a colour's lightness differ in print.
    """

    values: Array
    colour: str
    width: float
    name: str
    dashed: bool = False


@dataclass(frozen=True, eq=False)
class Plot:
    """Axes of a panel with time to the right.

    Attributes:
        box: left, top, width and height in the panel [px].
        heading: what stands above: the quantity and its unit.
        traces: its lines, the lowest first.
        limits: values at which dashed lines are drawn.
        shaded: stretches of time [s] that are shaded, from the first instant on.
        reach: largest value of a range about zero; the range of the lines if None.
    """

    box: tuple[float, float, float, float]
    heading: str
    traces: Sequence[Trace]
    limits: Sequence[float] = ()
    shaded: Sequence[tuple[float, float]] = ()
    reach: float | None = None


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
