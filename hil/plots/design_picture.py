"""A designed motion on one page: joints against limits, correlations, the front, the postures."""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import groupby
from types import MappingProxyType
from typing import Any, Final, Protocol

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from hil.arm import Arm
from hil.cell import AngleFrame, Cell
from hil.plots import style
from hil.plots.joints import draw_motion
from hil.plots.posture_strip import VIEWS, Strip, draw_strip
from hil.report.drawing import label
from hil.report.figures import shade_scale
from identification.excitation import correlation, coupling_index, coupling_index_max, information
from identification.excitation.constraints import sampled
from identification.excitation.excitation import Excitation
from identification.factor.factor import Factor
from identification.model.robot import RobotModel
from planner import Trajectory

Array = NDArray[np.float64]
Measures = tuple[float, float]
"""log10 det, I_c."""

_MARKERS = "DsP^vX"
_MARGIN = 0.09
_LEAST = (0.1, 2.0)
"""The page shows at least this share of I_c, and so many powers of ten of the determinant."""
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
        kinematic: names of those that satisfy joint limits only.
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
            wording = f"{label(name)} (kinematic)" if name in self.kinematic else label(name)
            look = {**_REFERENCE, "marker": _MARKERS[k % len(_MARKERS)]}
            found.append(_Mark(wording, measures, look, compared=True))
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
        far = (others < low - size) | (others > high + size)
        shown = np.concatenate((np.where(far, np.nan, others), [low, high]))
        low, high = np.nanmin(shown, axis=0), np.nanmax(shown, axis=0)
        room = _MARGIN * (high - low)
        return np.stack((low - room, high + room), axis=1)

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
            wording = f"{mark.text} ({mark.measures[0]:.1f}, {mark.measures[1]:.1f})"
            line.append(wording + (", beyond the edge" if self.is_beyond(mark) else ""))
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
    for mark in view.marks:
        look = {"linestyle": "none", "markeredgewidth": 1.0, "clip_on": False, **mark.look}
        # What has no room stands at the edge beyond which it is; the legend says so.
        at = np.clip(view.placed(mark), 0.0, 1.0)
        handles += axes.plot(*at, transform=axes.transAxes, **look)
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


_JOINT = re.compile(r"\d+")


def draw_correlation(axes: Axes, scale: Axes, matrix: Array, names: Sequence[str]) -> None:
    """Draw ``|psi_ij| / sqrt(psi_ii psi_jj)``, black for 1 and white for 0, in blocks of links.

    Args:
        axes: for the matrix.
        scale: for the shades.
        matrix: correlations of the parameters without friction (b, b); NaN where a motion leaves
            a parameter without excitation.
        names: of the parameters (b,).
    """
    b = len(names)
    known = bool(np.all(np.isfinite(matrix)))
    if known:
        axes.imshow(np.abs(matrix), cmap="gray_r", vmin=0.0, vmax=1.0, interpolation="none")
    else:
        axes.set_xlim(-0.5, b - 0.5)
        axes.set_ylim(b - 0.5, -0.5)
        axes.set_aspect("equal")
        axes.text(
            0.5,
            0.5,
            "no correlations:\nthis motion leaves a parameter\n(or a sum of some) unexcited",
            transform=axes.transAxes,
            ha="center",
            va="center",
            color=style.LIMIT,
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 5.0},
        )
    _blocks(axes, names)
    shade_scale(scale, style.INK, style.MUTED)


def blocks(names: Sequence[str]) -> list[tuple[str, int, int]]:
    """Return (label, first, one after the last) of neighbours that belong to the same joint."""
    found = []
    for joint, members in groupby(range(len(names)), key=lambda k: _joint(names[k])):
        indices = list(members)
        found.append((joint, indices[0], indices[-1] + 1))
    return found


def _joint(name: str) -> str:
    match = _JOINT.search(name)
    return "" if match is None else match.group()


def _blocks(axes: Axes, names: Sequence[str]) -> None:
    found = blocks(names)
    for _, first, _ in found[1:]:
        for line in (axes.axhline, axes.axvline):
            line(first - 0.5, color=style.POSITION, linewidth=0.7)
    middles = [(first + last - 1) / 2.0 for _, first, last in found]
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_ticks(middles, [label for label, _, _ in found], color=style.INK)
    axes.tick_params(length=0.0, pad=3.0)
    axes.set_xlabel("parameters by joint, friction left out")
    for spine in axes.spines.values():
        spine.set_color(style.MUTED)


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


POSTURES: Final = 7
_PERIOD = 0.001
"""s between samples of the correlations; the criteria are those of the same rate."""
_NO_REFERENCES: Mapping[str, Measures] = MappingProxyType({})

# All in inches.
_WIDTH = 11.8
_LEFT, _RIGHT = 0.78, 0.2
_TITLE_AT, _BETWEEN_LINES, _HEAD = 0.36, 0.23, 0.53
_GAP, _FOOT = 0.92, 0.5
_ROW, _BETWEEN_ROWS, _BETWEEN_COLUMNS = 0.98, 0.1, 0.56
_AXIS, _SHADES = 0.78, 0.5
_CELL, _SMALLEST, _LARGEST = 0.1, 2.6, 4.0
_FRONT, _ABOVE_FRONT = 2.3, 0.62
_BETWEEN_VIEWS, _BETWEEN_POSTURES = 0.1, 0.07


def draw_design(
    excitation: Excitation,
    cell: Cell,
    *,
    front: FrontPoints | None = None,
    chosen: int | None = None,
    knee: Measures | None = None,
    references: Mapping[str, Measures] = _NO_REFERENCES,
    kinematic: Collection[str] = (),
    unchecked: Sequence[str] = (),
    complete: bool = True,
    together: bool = False,
    margins: str = "",
    title: str = "",
) -> Figure:
    """Draw a designed motion, so that a person sees what the robot is going to do.

    Args:
        excitation: the motion, and how good it is.
        cell: where it is going to run.
        front: what the search found beside it.
        chosen: index of this motion on the front, None where it is not one of its points.
        knee: (log10 det, I_c) of the point of the front that it grew from, if it did.
        references: (log10 det, I_c) of other motions to compare with, by name.
        kinematic: names of references that satisfy joint limits only.
        unchecked: what the search did not look at ("floor", "the arm itself", ...).
        complete: whether the search came to its end.
        together: whether all measures, but those of the matrix, add earlier archives, weighted.
        margins: how close the motion comes to its limits, in words.
        title: stands above the page; the cell's name if empty.
    """
    strip, arm = _strip(excitation.trajectory, cell)
    remarks = Remarks(unchecked, complete, together, margins)
    lines = heading(
        excitation,
        title or cell.name,
        remarks,
        shapes=arm.has_shapes,
        outlined=strip.has_outlines,
    )
    view = None
    if front is not None or references:
        measures = _chosen(excitation, front, chosen)
        view = FrontView(front, measures, chosen is not None, knee, references, kinematic, together)
    with style.page():
        return _page(excitation.trajectory, cell, strip, lines, view)


def _strip(trajectory: Trajectory, cell: Cell) -> tuple[Strip, Arm]:
    arm = Arm.from_urdf(cell.urdf)
    return Strip.of(arm, trajectory, cell.workspace, POSTURES), arm


def _page(
    trajectory: Trajectory, cell: Cell, strip: Strip, lines: list[Line], front: FrontView | None
) -> Figure:
    """Place everything from top to bottom."""
    model = cell.model
    side = float(np.clip(_CELL * len(model.base.names), _SMALLEST, _LARGEST))
    head = _TITLE_AT + _BETWEEN_LINES * (len(lines) - 1) + _HEAD
    beside = side
    if front is not None:
        beside += _ABOVE_FRONT + front.legend_height(side + _SHADES) + _FRONT
    upper = max(_ROW * model.n_joints, beside)
    gap = _GAP + (_BETWEEN_LINES if front is not None and front.together else 0.0)
    width = (_WIDTH - _LEFT - _RIGHT + _BETWEEN_POSTURES) / POSTURES - _BETWEEN_POSTURES
    views = [width * strip.shape(view) for view in VIEWS]
    sheet = _Sheet(head + upper + gap + sum(views) + _BETWEEN_VIEWS * (len(views) - 1) + _FOOT)
    matrix = _WIDTH - _RIGHT - _SHADES - side
    rows = sheet.rows((_LEFT, head, matrix - _AXIS - _LEFT, upper), model.n_joints)
    limits, frame = cell.joint_limits, AngleFrame.of(cell)
    draw_motion(rows, trajectory, limits, cell.joint_names, frame, strip.postures)
    axes = sheet.axes(matrix, head, side, side)
    shades = sheet.axes(matrix + side + 0.1, head, 0.13, min(side, 1.6))
    _correlations(axes, shades, trajectory, model)
    if front is not None:
        at = sheet.axes(matrix, head + upper - _FRONT, side + _SHADES, _FRONT)
        draw_front(at, front, side + _SHADES)
    draw_strip(sheet.strip(head + upper + gap, width, views), strip)
    sheet.head(lines)
    return sheet.figure


class _Sheet:
    """A page on which axes are placed in inches from its upper left corner."""

    def __init__(self, height: float) -> None:
        self.height = height
        self.figure = Figure(figsize=(_WIDTH, height))

    def axes(self, left: float, top: float, width: float, height: float) -> Axes:
        bottom = self.height - top - height
        return self.figure.add_axes(
            (left / _WIDTH, bottom / self.height, width / _WIDTH, height / self.height)
        )

    def rows(self, place: tuple[float, float, float, float], count: int) -> list[list[Axes]]:
        """Two axes in each of so many rows at (left, top, width, height)."""
        left, top, width, height = place
        wide = (width - _BETWEEN_COLUMNS) / 2.0
        high = (height + _BETWEEN_ROWS) / count - _BETWEEN_ROWS
        return [
            [
                self.axes(
                    left + column * (wide + _BETWEEN_COLUMNS),
                    top + row * (high + _BETWEEN_ROWS),
                    wide,
                    high,
                )
                for column in range(2)
            ]
            for row in range(count)
        ]

    def strip(self, top: float, width: float, heights: list[float]) -> list[list[Axes]]:
        """One row of postures per view."""
        rows = []
        for height in heights:
            rows.append(
                [
                    self.axes(_LEFT + k * (width + _BETWEEN_POSTURES), top, width, height)
                    for k in range(POSTURES)
                ]
            )
            top += height + _BETWEEN_VIEWS
        return rows

    def head(self, lines: list[Line]) -> None:
        """Write lines above everything else."""
        for k, line in enumerate(lines):
            self.figure.text(
                _LEFT / _WIDTH,
                1.0 - (_TITLE_AT + k * _BETWEEN_LINES) / self.height,
                line.text,
                fontsize=line.size,
                color=line.colour,
                fontweight=line.weight,
            )


def _correlations(axes: Axes, shades: Axes, trajectory: Trajectory, model: RobotModel) -> None:
    motion = sampled(trajectory, _PERIOD)
    unknown = np.zeros_like(motion.position)  # torque plays no part in the excitation
    gram = information(Factor.from_samples(model, motion, unknown))
    b = len(model.base.names)
    draw_correlation(axes, shades, correlation(gram)[:b, :b], model.base.names)
    p = model.n_parameters
    index = number(coupling_index(gram), 1)
    axes.set_title(
        f"|correlation| from this motion alone\n"
        f"all {p} parameters: I_c {index} of {coupling_index_max(p):.0f}",
        loc="left",
        color=style.MUTED,
        pad=5.0,
    )


def _chosen(excitation: Excitation, front: FrontPoints | None, chosen: int | None) -> Measures:
    """Return the measures of the motion, those by which it lies on the front if it does."""
    if front is None or chosen is None:
        return excitation.criteria.log10_det, excitation.criteria.coupling_index
    return float(front.log10_det[chosen]), float(front.coupling_index[chosen])
