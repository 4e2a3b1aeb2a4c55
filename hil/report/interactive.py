"""Charts as data that the script of a page draws with BokehJS.

The page has the script of the bokeh package and the values, no document of Bokeh's: that would take
a second and a half of imports. `templates/charts.js` builds the figures by the API of BokehJS.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from hil.base.arrays import Array
from hil.base.terminal_text import one_line
from hil.report.chart import Chart, Trace

_LIBRARY: Final = ("bokeh.min.js", "bokeh-api.min.js")
_MAX_CHART_VALUES: Final = 180_000
"""Values of all lines of a page, 480 kB."""
_MIN_LINE_POINTS = 400  # points of a line
_MAX_LINE_POINTS = 4000
_NAN_CODE: Final = -32768
"""Code of a value that is not finite."""


@cache
def library() -> tuple[Markup, ...]:
    """Return the scripts of BokehJS from the installed package, which is not imported.

    Empty without the package: the drawings of a page need no script.
    """
    spec = find_spec("bokeh")
    if spec is None or not spec.submodule_search_locations:
        return ()
    folder = Path(spec.submodule_search_locations[0]) / "server" / "static" / "js"
    # Nothing in a page may refer to a map that is not there.
    texts = (
        (folder / name).read_text("utf-8").split("//# sourceMappingURL")[0] for name in _LIBRARY
    )
    return tuple(Markup(text) for text in texts)


def chart_data(groups: Mapping[str, Sequence[Chart]], joints: Sequence[str]) -> Markup:
    """Return charts by group as JSON for a script element; `joints` are their names."""
    lines = [t for group in groups.values() for c in group for p in c.plots for t in p.traces]
    most = min(max(_MAX_CHART_VALUES // max(len(lines), 1), _MIN_LINE_POINTS), _MAX_LINE_POINTS)
    document = {
        "joints": [one_line(name) for name in joints],
        "groups": {
            name: [_chart(chart, most) for chart in group] for name, group in groups.items()
        },
    }
    text = json.dumps(document, separators=(",", ":"), ensure_ascii=True)
    # No text of an archive ends the element.
    for character in "<>&":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return Markup(text)


def _chart(chart: Chart, most: int) -> dict[str, Any]:
    return {
        "key": chart.caption.key,
        "label": one_line(f"{chart.caption.title}: {chart.caption.what}"),
        "joint": chart.joint,
        "foot": chart.foot,
        "log": chart.log,
        "own": not chart.shares_x,
        "x": encoded(_shared_x(chart.x, most)),
        "range": list(chart.x_limits),
        "plots": [
            {
                "heading": plot.heading,
                "height": plot.height,
                "traces": [_trace(trace, chart, most) for trace in plot.traces],
                "shaded": [[float(f"{end:.6g}") for end in ends] for ends in plot.shaded],
                "limits": list(plot.y_limits),
                "fixed": plot.limits is not None or plot.reach is not None,
                "origin": plot.origin,
                "band": plot.band,
            }
            for plot in chart.plots
        ],
    }


def _trace(trace: Trace, chart: Chart, most: int) -> dict[str, Any]:
    has_own_x = trace.x is not None
    values = trace.values if has_own_x else _extremes(trace.values, most)
    return {
        "name": trace.name,
        "colour": trace.colour.removeprefix("var(").removesuffix(")"),
        "width": trace.width,
        "dashed": trace.dashed,
        "dots": trace.dots,
        "loose": trace.loose,
        "x": encoded(np.asarray(trace.x)) if has_own_x else None,
        "y": encoded(_log10(values) if chart.log else values),
    }


def _log10(values: Array) -> Array:
    """Return logarithms, whose rounding is relative."""
    return np.log10(np.maximum(values, 1e-300))


def _edges(rows: int, most: int) -> NDArray[np.intp]:
    return np.linspace(0, rows, most // 2 + 1).astype(np.intp)


def _shared_x(x: Array, most: int) -> Array:
    """Return two places in each of `most` / 2 bins of more than `most` rows, or the rows' own."""
    if len(x) <= most:
        return x
    edges = _edges(len(x), most)
    starts = x[edges[:-1]]
    ends = x[edges[1:] - 1]
    return np.stack([0.75 * starts + 0.25 * ends, 0.25 * starts + 0.75 * ends], axis=1).ravel()


def _extremes(values: Array, most: int) -> Array:
    """Return minimum and maximum of each bin in the order in which they occur, see `_shared_x`."""
    if len(values) <= most:
        return values
    edges = _edges(len(values), most)
    rows = edges[:-1, None] + np.arange(int(np.max(np.diff(edges))))
    parts = values[np.minimum(rows, edges[1:, None] - 1)]
    first = parts.argmin(axis=1)
    last = parts.argmax(axis=1)
    order = np.sort(np.stack([first, last], axis=1), axis=1)
    return np.take_along_axis(parts, order, axis=1).ravel()


def encoded(values: Array) -> dict[str, Any]:
    """Return values (m,) as 16-bit codes in base64 with step and offset; rounded to 1/65534."""
    finite = np.isfinite(values)
    low = float(values[finite].min()) if finite.any() else 0.0
    high = float(values[finite].max()) if finite.any() else 0.0
    middle = 0.5 * (low + high)
    step = (high - low) / 65534.0 or 1.0
    codes = np.full(len(values), _NAN_CODE, "<i2")
    codes[finite] = np.clip(np.rint((values[finite] - middle) / step), -32767, 32767)
    return {
        "codes": base64.b64encode(codes.tobytes()).decode("ascii"),
        "step": step,
        "middle": middle,
    }
