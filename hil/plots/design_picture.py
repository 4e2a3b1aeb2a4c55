"""A designed motion on one page: joints against limits, correlations, the front, the postures."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from types import MappingProxyType
from typing import Any, Final, NamedTuple, Protocol

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
from identification.excitation import (
    CRITERIA,
    correlation,
    coupling_index,
    coupling_index_max,
    information,
)
from identification.excitation.constraints import sampled
from identification.excitation.excitation import Excitation
from identification.factor.factor import Factor
from identification.model.robot import RobotModel
from planner import Trajectory

Array = NDArray[np.float64]
Measures = tuple[float, ...]
"""log10 det, I_c."""

POSTURES: Final = 7
_PERIOD: Final = 0.001
"""s between samples of the correlations; the criteria are those of the same rate."""
_MARGIN: Final = 0.09
_LEAST: Final = (0.1, 2.0)
"""The page shows at least this share of I_c, and so many powers of ten of the determinant."""
_ARROW: Final = 0.05
"""Share of the axes; shorter paths from the point that a motion grew from get no arrow."""
_LETTERS, _LEGEND_LETTERS = 180, 56
"""In a line of small print across the page, and in one of the legend."""
_BARS: Final = "the arm (bars from joint to joint: its shapes are not known here)"
_MARKERS: Final = "DsP^vX"
_CHOSEN: Final = {"marker": "*", "markersize": 13.0, "markerfacecolor": style.LIMIT, "zorder": 4.0}
_GREW: Final = {"marker": "o", "markersize": 7.5, "markeredgecolor": style.LIMIT, "zorder": 3.5}
_OTHER: Final = {"markersize": 6.0, "markeredgecolor": style.INK, "zorder": 3.0}
_NO_REFERENCES: Final[Mapping[str, Measures]] = MappingProxyType({})
# inch
_WIDTH, _ROW, _FRONT, _LEGEND_LINE = 11.8, 1.05, 2.9, 0.145
_CELL, _SMALLEST, _LARGEST = 0.1, 2.6, 4.0
_TITLE_AT, _HEAD_LINE, _HEAD_FOOT = 0.36, 0.23, 0.3


class FrontPoints(Protocol):
    """The front of a search: its k motions' measures."""

    def measure(self, name: str) -> Array:
        """One of `CRITERIA` (k,)."""
        ...


class Mark(NamedTuple):
    """One motion: what the legend says of it, its I_c and log10 det, and how it is drawn."""

    text: str
    at: Array
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
    def line(self) -> Array:
        """Points of the front to join, by rising I_c (k, 2); none if there is only one."""
        if self.front is None or len(self.front.measure("coupling_index")) < 2:
            return np.empty((0, 2))
        points = np.column_stack(
            [self.front.measure(name) for name in ("coupling_index", "log10_det")]
        )
        return points[np.argsort(points[:, 0], kind="stable")]

    @property
    def marks(self) -> list[Mark]:
        """Single motions; one that leaves a parameter unexcited has no place on the page."""
        polished = self.front is not None and not self.on_front
        found = [("chosen, polished" if polished else "chosen", self.chosen, _CHOSEN, False)]
        if self.knee is not None:
            found.append(("grew from", self.knee, _GREW, False))
        for k, (name, measures) in enumerate(self.references.items()):
            kind = " (kinematic)" if name in self.kinematic else ""
            look = {**_OTHER, "marker": _MARKERS[k % len(_MARKERS)]}
            found.append((label(name) + kind, measures, look, True))
        marks = (
            Mark(f"{text} ({at[0]:.1f}, {at[1]:.1f})", np.array(at[::-1]), look, compared)
            for text, at, look, compared in found
        )
        return [mark for mark in marks if np.all(np.isfinite(mark.at))]

    @property
    def window(self) -> Array:
        """From where to where I_c and log10 det are shown (2, 2), NaN without a motion.

        References widen it by no more than the front's own size, so that they do not flatten it.
        """
        alone = not len(self.line)
        own = [mark.at for mark in self.marks if alone or not mark.compared]
        points = np.concatenate((np.reshape(own, (-1, 2)), self.line))
        if not len(points):
            return np.full((2, 2), np.nan)
        low, high = points.min(axis=0), points.max(axis=0)
        size = np.maximum(high - low, (_LEAST[0] * max(abs(high[0]), 1.0), _LEAST[1]))
        middle = (low + high) / 2.0
        low, high = middle - size / 2.0, middle + size / 2.0
        others = np.reshape([mark.at for mark in self.marks if mark.compared], (-1, 2))
        far = (others < low - size) | (others > high + size)
        shown = np.concatenate((np.where(far, np.nan, others), [low, high]))
        low, high = np.nanmin(shown, axis=0), np.nanmax(shown, axis=0)
        room = _MARGIN * (high - low)
        return np.stack((low - room, high + room), axis=1)

    def placed(self, mark: Mark) -> Array:
        """Return where a mark is, from 0 to 1 across and up the page if it has room there (2,)."""
        low, high = self.window.T
        return np.asarray((mark.at - low) / (high - low), dtype=np.float64)


def draw_front(axes: Axes, view: FrontView) -> None:
    """Draw the front, the chosen motion, and named ones to compare with; a legend above them."""
    line, handles = view.line, list[Any]()
    if np.all(np.isfinite(view.window)):
        axes.set_xlim(*view.window[0])
        axes.set_ylim(*view.window[1])
    if len(line):
        handles += axes.plot(
            *line.T,
            drawstyle="steps-post",  # what is had at most for a coupling index up to that
            color=style.POSITION,
            linewidth=1.0,
            marker="o",
            markersize=3.4,
            label=f"front, {len(line)} motions",
            clip_on=False,
        )
    for mark in view.marks:
        # What has no room stands at the edge beyond which it is; the legend says so.
        place = view.placed(mark)
        at = np.clip(place, 0.0, 1.0)
        text = mark.text if np.array_equal(at, place) else f"{mark.text}, beyond the edge"
        look = {"markerfacecolor": "white", "markeredgecolor": "white", **mark.look}
        handles += axes.plot(
            *at, transform=axes.transAxes, label="\n".join(textwrap.wrap(text, _LEGEND_LETTERS)),
            linestyle="none", clip_on=False, **look,
        )  # fmt: skip
    _growth(axes, view)
    for axis, steps in ((axes.xaxis, 7), (axes.yaxis, 6)):
        axis.set_major_locator(MaxNLocator(steps, steps=[1, 2, 5, 10], min_n_ticks=3))
    across, up = "coupling index I_c (less is better)", "log₁₀(det ΦᵀΦ / Nᵖ) (more is better)"
    if view.together:
        across += "\ntogether with earlier archives, weighted"
        up = "log₁₀ det (more is better)\ntogether, weighted"
    axes.set_xlabel(across)
    axes.set_ylabel(up)
    if handles:
        axes.legend(
            handles=handles, loc="lower left", bbox_to_anchor=(0.0, 1.02), frameon=False,
            borderaxespad=0.0, borderpad=0.0, labelspacing=0.35, fontsize=style.SMALL,
        )  # fmt: skip
    style.bare(axes)


def _growth(axes: Axes, view: FrontView) -> None:
    """Draw an arrow from the point that the chosen motion grew from."""
    if view.knee is None or not np.all(np.isfinite((view.knee, view.chosen))):
        return
    begin, end = ((index, size) for size, index in (view.knee, view.chosen))
    if np.hypot(*(np.subtract(end, begin) / np.ptp(view.window, axis=1))) < _ARROW:
        return
    arrow = {"arrowstyle": "-|>,head_width=0.18,head_length=0.35", "color": style.LIMIT}
    more = {"linewidth": 0.8, "shrinkA": 4.0, "shrinkB": 5.0}
    axes.annotate("", end, begin, arrowprops={**arrow, **more}, zorder=3.6)


_JOINT = re.compile(r"\d+")


def draw_correlation(axes: Axes, matrix: Array, names: Sequence[str]) -> None:
    """Draw ``|psi_ij| / sqrt(psi_ii psi_jj)``, black for 1 and white for 0, in blocks of links.

    Args:
        axes: for the matrix; the shades are beside it.
        matrix: correlations of the parameters without friction (b, b); NaN where a motion leaves
            a parameter without excitation.
        names: of the parameters (b,).
    """
    b = len(names)
    if np.all(np.isfinite(matrix)):
        axes.imshow(np.abs(matrix), cmap="gray_r", vmin=0.0, vmax=1.0, interpolation="none")
    else:
        axes.set_xlim(-0.5, b - 0.5)
        axes.set_ylim(b - 0.5, -0.5)
        axes.set_aspect("equal")
        text = "no correlations:\nthis motion leaves a parameter\n(or a sum of some) unexcited"
        axes.text(
            0.5, 0.5, text, transform=axes.transAxes, ha="center", va="center", color=style.LIMIT,
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 5.0},
        )  # fmt: skip
    found = blocks(names)
    for _, first, _ in found[1:]:
        for line in (axes.axhline, axes.axvline):
            line(first - 0.5, color=style.POSITION, linewidth=0.7)
    middles = [(first + last - 1) / 2.0 for _, first, last in found]
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_ticks(middles, [joint for joint, _, _ in found], color=style.INK)
    axes.tick_params(length=0.0, pad=3.0)
    axes.set_xlabel("parameters by joint, friction left out")
    for spine in axes.spines.values():
        spine.set_color(style.MUTED)
    shade_scale(axes.inset_axes((1.03, 0.5, 0.04, 0.5)), style.INK, style.MUTED)


def blocks(names: Sequence[str]) -> list[tuple[str, int, int]]:
    """Return (label, first, one after the last) of neighbours that belong to the same joint."""

    def joint(k: int) -> str:
        match = _JOINT.search(names[k])
        return "" if match is None else match.group()

    groups = ((key, list(members)) for key, members in groupby(range(len(names)), key=joint))
    return [(key, members[0], members[-1] + 1) for key, members in groups]


class Line(NamedTuple):
    """One line of the heading, its size in points."""

    text: str
    size: float
    colour: str
    weight: str = "normal"


def number(value: float, digits: int) -> str:
    """Return a criterion as text; a motion that leaves a parameter unexcited has infinite ones."""
    return f"{value:.{digits}f}" if np.isfinite(value) else ("∞" if value > 0.0 else "−∞")


def _heading(
    excitation: Excitation,
    title: str,
    unchecked: Sequence[str],
    margins: str,
    *,
    complete: bool,
    together: bool,
    shapes: bool,
) -> list[Line]:
    """The lines above the page: criteria, what was not looked at, and what the colours mean."""
    criteria = excitation.criteria
    determinant, index = number(criteria.log10_det, 2), f"I_c {number(criteria.coupling_index, 1)}"
    method, duration = f"method {excitation.method}", f"{excitation.trajectory.duration:.2f} s"
    alone = [f"log₁₀(det ΦᵀΦ / Nᵖ) {determinant}", index]
    parts = ["together with earlier archives, weighted"] if together else alone
    lines = [Line(" · ".join([label(title), method, duration, *parts]), style.TITLE, style.INK)]
    if together:
        text = (
            f"log₁₀ det {determinant} and {index} of all of it together: "
            "not comparable with those of a motion alone"
        )
        lines.append(Line(text, style.TEXT, style.INK))
    missing = ", ".join(unchecked)
    red = [f"NOT CHECKED: {missing}; not for a robot"] if unchecked else []
    red += [] if complete else ["search stopped early: it may have missed better motions"]
    for text in red:
        wrapped = textwrap.wrap(text, _LETTERS * 2 // 3)
        lines += [Line(line, style.TEXT + 1.0, style.LIMIT, "bold") for line in wrapped]
    legend = (
        "red dashes: limits; grey lines: the postures numbered below; blue: all that "
        f"{'the arm' if shapes else _BARS} sweeps; brown: the path of its end to the next one"
    )
    for text, colour in ((margins, style.INK), (legend, style.MUTED)):
        printable = "".join(c if c.isprintable() else " " for c in text)
        wrapped = textwrap.wrap(printable, _LETTERS)
        lines += [Line(line, style.SMALL + 0.5, colour) for line in wrapped]
    return lines


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
    arm, model, trajectory = Arm.from_urdf(cell.urdf), cell.model, excitation.trajectory
    strip = Strip.of(arm, trajectory, cell.workspace, POSTURES)
    lines = _heading(
        excitation,
        title or cell.name,
        unchecked,
        margins,
        complete=complete,
        together=together,
        shapes=arm.has_shapes,
    )
    view = None
    if front is not None or references:
        criteria = excitation.criteria
        measures = criteria.measures
        if front is not None and chosen is not None:  # those by which it lies on the front
            measures = tuple(float(front.measure(name)[chosen]) for name in CRITERIA)
        view = FrontView(front, measures, chosen is not None, knee, references, kinematic, together)
    side = float(np.clip(_CELL * len(model.base.names), _SMALLEST, _LARGEST))
    beside = 0.0 if view is None else _FRONT + _LEGEND_LINE * (1.5 * len(view.marks) + 1)
    head = _TITLE_AT + _HEAD_LINE * (len(lines) - 1) + _HEAD_FOOT
    upper = max(_ROW * model.n_joints + 0.6, side + 1.0 + beside)
    shapes = [strip.shape(one) for one in VIEWS]
    lower = 0.9 + sum(shapes) * (_WIDTH - 1.2) / POSTURES
    height = head + upper + lower
    with style.page():
        figure = Figure(figsize=(_WIDTH, height), layout="constrained")
        parts: Any = figure.subfigures(3, 1, height_ratios=(head, upper, lower))
        _, top, bottom = parts
        left, right = top.subfigures(1, 2, width_ratios=(_WIDTH - side - 1.7, side + 1.7))
        rows = left.subplots(model.n_joints, 2, squeeze=False).tolist()
        frame = AngleFrame.of(cell)
        draw_motion(rows, trajectory, cell.joint_limits, cell.joint_names, frame, strip.postures)
        left.align_ylabels()
        if view is None:
            _correlations(right.subplots(), trajectory, model)
        else:
            matrix, below = right.subplots(2, 1, height_ratios=(side + 0.6, beside))
            _correlations(matrix, trajectory, model)
            draw_front(below, view)
        draw_strip(bottom.subplots(2, POSTURES, height_ratios=shapes).tolist(), strip)
        for k, line in enumerate(lines):
            at = 1.0 - (_TITLE_AT + k * _HEAD_LINE) / height
            figure.text(
                0.07, at, line.text, fontsize=line.size, color=line.colour, fontweight=line.weight
            )
        figure.draw_without_rendering()
        figure.set_layout_engine("none")
        # The solver's last digits differ from one time to the next.
        for part in (top, bottom, left, right):
            part.bbox_relative.set_points(np.round(part.bbox_relative.get_points(), 4))
        for axes in figure.axes:
            axes.set_position(np.round(axes.get_position(original=True).bounds, 4).tolist())
    return figure


def _correlations(axes: Axes, trajectory: Trajectory, model: RobotModel) -> None:
    motion = sampled(trajectory, _PERIOD)
    unknown = np.zeros_like(motion.position)  # torque plays no part in the excitation
    gram = information(Factor.from_samples(model, motion, unknown))
    b, p = len(model.base.names), model.n_parameters
    draw_correlation(axes, correlation(gram)[:b, :b], model.base.names)
    axes.set_title(
        f"|correlation| from this motion alone\nall {p} parameters: I_c "
        f"{number(coupling_index(gram), 1)} of {coupling_index_max(p):.0f}",
        loc="left",
        color=style.MUTED,
        pad=5.0,
    )
