"""The front of a search: what more information costs in coupling."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from hil.plots import style
from hil.report.figures.svg import label

Array = NDArray[np.float64]
Measures = tuple[float, float]
"""log10 det, I_c."""

_MARKERS = "DsP^vX"
_MARGIN = 0.09
_LEAST = (0.1, 2.0)
"""The page shows at least this share of I_c, and so many powers of ten of the determinant."""
_INSET, _QUEUE, _TO_EDGE = 0.05, 0.12, 11.0
"""Of marks beyond an edge: share of the axes to it and to the next mark; the arrow [pt]."""
_ROOM = 0.2
"""Share of the front's size that is left free for them."""
_ARROW = 15.0
"""pt; shorter ways from the point that a motion grew from get no arrow."""
_LETTER, _KEY, _LINE = 0.062, 0.36, 0.145
"""inch: a letter of the legend, the room for its marker, a line of it."""
_CHOSEN = {
    "marker": "*",
    "markersize": 13.0,
    "markerfacecolor": style.LIMIT,
    "markeredgecolor": "white",
    "zorder": 4.0,
}
_GREW = {
    "marker": "o",
    "markersize": 7.5,
    "markerfacecolor": "none",
    "markeredgecolor": style.LIMIT,
    "zorder": 3.5,
}
_REFERENCE = {
    "markersize": 6.0,
    "markerfacecolor": "white",
    "markeredgecolor": style.INK,
    "zorder": 3.0,
}


class FrontPoints(Protocol):
    """The front of a search: its k motions' measures."""

    @property
    def log10_det(self) -> Array:
        """Information (k,)."""
        ...

    @property
    def coupling_index(self) -> Array:
        """I_c (k,)."""
        ...


@dataclass(frozen=True)
class _Mark:
    """One motion: what the legend says of it, its measures, and how it is drawn."""

    text: str
    measures: Measures
    look: Mapping[str, Any]
    compared: bool = False


@dataclass(frozen=True, eq=False)
class FrontView:
    """What the picture of a front shows.

    Attributes:
        front: the front, if there is one.
        chosen: (log10 det, I_c) of the motion that was chosen.
        on_front: whether it is one of the front's points.
        knee: (log10 det, I_c) of the point that it grew from, if it did.
        references: (log10 det, I_c) of others by name.
        kinematic: names of those that kept joint limits only.
        together: whether earlier archives are part of all measures.
    """

    front: FrontPoints | None
    chosen: Measures
    on_front: bool = True
    knee: Measures | None = None
    references: Mapping[str, Measures] = field(default_factory=dict)
    kinematic: Collection[str] = ()
    together: bool = False

    @property
    def has_line(self) -> bool:
        """Whether there is more than one point to join."""
        return self.front is not None and len(self.front.coupling_index) > 1

    @cached_property
    def marks(self) -> list[_Mark]:
        """Single motions; one that leaves a parameter unexcited has no place on the page."""
        polished = self.front is not None and not self.on_front
        found = [_Mark("chosen, polished" if polished else "chosen", self.chosen, _CHOSEN)]
        if self.knee is not None:
            found.append(_Mark("grew from", self.knee, _GREW))
        for k, (name, measures) in enumerate(self.references.items()):
            told = f"{label(name)} (kinematic)" if name in self.kinematic else label(name)
            look = {**_REFERENCE, "marker": _MARKERS[k % len(_MARKERS)]}
            found.append(_Mark(told, measures, look, compared=True))
        return [mark for mark in found if np.all(np.isfinite(mark.measures))]

    @cached_property
    def window(self) -> Array:
        """Return from where to where I_c and log10 det are shown (2, 2), NaN without a motion.

        References widen it by no more than the front's own size, so that they do not flatten it.
        """
        own = [m.measures[::-1] for m in self.marks if not m.compared or not self.has_line]
        points = np.array(own, dtype=np.float64).reshape(-1, 2)
        if self.front is not None and self.has_line:
            line = np.column_stack((self.front.coupling_index, self.front.log10_det))
            points = np.concatenate((points, line))
        if not len(points):
            return np.full((2, 2), np.nan)
        low, high = points.min(axis=0), points.max(axis=0)
        size = np.maximum(high - low, (_LEAST[0] * max(abs(high[0]), 1.0), _LEAST[1]))
        middle = (low + high) / 2.0
        low, high = middle - size / 2.0, middle + size / 2.0
        others = np.array([m.measures[::-1] for m in self.marks if m.compared]).reshape(-1, 2)
        below, above = others < low - size, others > high + size
        shown = np.concatenate((np.where(below | above, np.nan, others), [low, high]))
        low, high = np.nanmin(shown, axis=0), np.nanmax(shown, axis=0)
        room = np.where([below.any(axis=0), above.any(axis=0)], _ROOM, _MARGIN) * (high - low)
        return np.stack((low - room[0], high + room[1]), axis=1)

    def placed(self, mark: _Mark) -> Array:
        """Return where a mark is, from 0 to 1 across and up the page if it has room there (2,)."""
        low, high = self.window.T
        return np.asarray((np.array(mark.measures[::-1]) - low) / (high - low), dtype=np.float64)

    def is_beyond(self, mark: _Mark) -> bool:
        """Whether a mark lies beyond the edge."""
        place = self.placed(mark)
        return bool(np.any((place < 0.0) | (place > 1.0)))

    def texts(self, width: float) -> tuple[list[str], int]:
        """Return what the legend says of the line and the marks, and in how many columns.

        Args:
            width: of the axes [inch].
        """
        line = []
        if self.front is not None and self.has_line:
            line.append(f"front, {len(self.front.coupling_index)} motions")
        for mark in self.marks:
            told = f"{mark.text} ({mark.measures[0]:.1f}, {mark.measures[1]:.1f})"
            line.append(told + (", beyond the edge" if self.is_beyond(mark) else ""))
        wide = _KEY + _LETTER * max(map(len, line), default=0)
        columns = 2 if wide <= width / 2.0 else 1
        letters = int((width / columns - _KEY) / _LETTER)
        return ["\n".join(textwrap.wrap(text, letters)) for text in line], columns

    def legend_height(self, width: float) -> float:
        """Return the height [inch] of the legend above axes of a width [inch]."""
        texts, columns = self.texts(width)
        lines = [text.count("\n") + 1 for text in texts]
        rows = math.ceil(len(lines) / columns)
        per_column = [sum(lines[k * rows : (k + 1) * rows]) for k in range(columns)]
        return _LINE * max(per_column, default=0) + (0.1 if lines else 0.0)


def draw_front(axes: Axes, view: FrontView, width: float) -> None:
    """Draw the front, the chosen motion, and named ones to compare with; a legend above them.

    Args:
        axes: where.
        view: what.
        width: of the axes [inch].
    """
    texts, columns = view.texts(width)
    if np.all(np.isfinite(view.window)):
        axes.set_xlim(*view.window[0])
        axes.set_ylim(*view.window[1])
    handles = [_line(axes, view.front)] if view.front is not None and view.has_line else []
    beyond = 0
    for mark in view.marks:
        look = {"linestyle": "none", "markeredgewidth": 1.0, "clip_on": False, **mark.look}
        if view.is_beyond(mark):
            handles += _at_edge(axes, view.placed(mark), beyond, look)
            beyond += 1
        else:
            handles += axes.plot(mark.measures[1], mark.measures[0], **look)
    _growth(axes, view)
    axes.xaxis.set_major_locator(MaxNLocator(7, steps=[1, 2, 5, 10], min_n_ticks=3))
    axes.yaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10], min_n_ticks=3))
    _name(axes, together=view.together)
    if handles:
        axes.legend(
            handles,
            texts,
            loc="lower left",
            bbox_to_anchor=(0.0, 1.02),
            ncols=columns,
            borderaxespad=0.0,
            borderpad=0.0,
            labelspacing=0.35,
            columnspacing=1.2,
            frameon=False,
            fontsize=style.SMALL,
        )
    style.bare(axes)


def _name(axes: Axes, *, together: bool) -> None:
    across, up = "coupling index I_c (less is better)", "log₁₀(det ΦᵀΦ / Nᵖ) (more is better)"
    if together:
        across += "\ntogether with earlier archives, weighted"
        up = "log₁₀ det (more is better)\ntogether, weighted"
    axes.set_xlabel(across)
    axes.set_ylabel(up)


def _line(axes: Axes, front: FrontPoints) -> Any:
    order = np.argsort(front.coupling_index, kind="stable")
    (line,) = axes.plot(
        front.coupling_index[order],
        front.log10_det[order],
        drawstyle="steps-post",  # what is had at most for a coupling index up to that
        color=style.POSITION,
        linewidth=1.0,
        marker="o",
        markersize=3.4,
        label=f"front, {len(order)} motions",
        clip_on=False,
    )
    return line


def _at_edge(axes: Axes, place: Array, number: int, look: Mapping[str, Any]) -> list[Any]:
    """Draw a mark that has no room inside the edge, with an arrow to where it is.

    Args:
        axes: where.
        place: of the mark as a share of the axes (2,).
        number: how many marks are at an edge already: each stands farther from it.
        look: of the mark.
    """
    away = np.where(place > 1.0, 1.0, np.where(place < 0.0, -1.0, 0.0))
    # In a corner all arrows point the same way: side by side, none hits the next mark.
    queue = np.array([0.0, 1.0]) if np.all(away) else np.ones(2)
    inset = _INSET + _QUEUE * number * queue
    at = np.where(away == 0.0, place, 0.5 + (0.5 - inset) * away)
    axes.annotate(
        "",
        (float(at[0]), float(at[1])),
        xycoords="axes fraction",
        xytext=tuple(_TO_EDGE * away),
        textcoords="offset points",
        arrowprops={"arrowstyle": "<|-,head_width=0.18,head_length=0.35", "color": style.INK},
        zorder=2.9,
    )
    return axes.plot(*at, transform=axes.transAxes, **look)


def _growth(axes: Axes, view: FrontView) -> None:
    """Draw an arrow from the point that the chosen motion grew from."""
    if view.knee is None or not np.all(np.isfinite((view.knee, view.chosen))):
        return
    begin, end = view.knee[::-1], view.chosen[::-1]
    way = np.ptp(axes.transData.transform([begin, end]), axis=0)
    if np.hypot(*way) * 72.0 / axes.figure.dpi < _ARROW:
        return
    axes.annotate(
        "",
        end,
        begin,
        arrowprops={
            "arrowstyle": "-|>,head_width=0.18,head_length=0.35",
            "color": style.LIMIT,
            "linewidth": 0.8,
            "shrinkA": 4.0,
            "shrinkB": 5.0,
        },
        zorder=3.6,
    )
