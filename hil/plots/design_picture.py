"""Picture of a designed motion: joints and limits, correlations, front, postures."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Mapping, Sequence
from itertools import groupby
from types import MappingProxyType
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from hil.arm import Arm
from hil.cell import AngleFrame, Cell
from hil.plots import style
from hil.plots.plan_picture import draw_motion
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
from identification.excitation.searches.scores import Front
from identification.factor.factor import Factor
from identification.model.robot import RobotModel
from planner import Trajectory

Array = NDArray[np.float64]
Measures = tuple[float, ...]  #: log10 det, I_c

POSTURES: Final = 7
_PERIOD: Final = 0.001
"""Sampling period of the correlations, s."""
GREW: Final = "grew from"
_LETTERS: Final = 180  # Characters of a line of small text
_BARS: Final = "the arm (bars from joint to joint, as its shapes are unknown)"
_MARKERS: Final = "DsP^vX"
_WHITE: Final[dict[str, Any]] = {"markerfacecolor": "white", "markeredgecolor": style.LIMIT}
_CHOSEN: Final[dict[str, Any]] = {
    "marker": "*",
    "markersize": 13.0,
    "color": style.LIMIT,
    "zorder": 4.0,
}
_GREW: Final = _WHITE | {"marker": "o", "markersize": 7.5, "zorder": 3.5}
_OTHER: Final = _WHITE | {"markersize": 6.0, "markeredgecolor": style.INK, "zorder": 3.0}
_NO_REFERENCES: Final[Mapping[str, Measures]] = MappingProxyType({})
# inch
_WIDTH, _ROW, _FRONT, _LEGEND_LINE = 11.8, 1.05, 2.9, 0.145
_CELL, _SMALLEST, _LARGEST = 0.1, 2.6, 4.0
_TITLE_AT, _HEAD_LINE, _HEAD_FOOT = 0.36, 0.23, 0.3


def draw_front(
    axes: Axes, front: Front | None, marks: Mapping[str, Measures], *, together: bool
) -> None:
    """Draw the front and single motions with a legend; `marks` (log10 det, I_c), chosen first.

    References outside the range of the front are only in the legend. With `together` all values
    include earlier archives.
    """
    if front is not None and len(front) > 1:
        points = np.column_stack([front.measure(name) for name in ("coupling_index", "log10_det")])
        line = points[np.argsort(points[:, 0], kind="stable")]
        # Best log det up to each coupling index.
        axes.plot(
            *line.T, drawstyle="steps-post", color=style.POSITION, linewidth=1.0, marker="o",
            markersize=3.4, label=f"front, {len(line)} motions",
        )  # fmt: skip
    for k, (name, (size, index)) in enumerate(marks.items()):
        look = _CHOSEN if k == 0 else _OTHER | {"marker": _MARKERS[k % len(_MARKERS)]}
        if name == GREW:
            look = _GREW
        elif k > 0 and front is not None:
            axes.set_xlim(axes.get_xlim())
            axes.set_ylim(axes.get_ylim())
        if np.isfinite([size, index]).all():
            text = f"{label(name)} ({size:.1f}, {index:.1f})"
            axes.plot(index, size, linestyle="none", label=text, **look)
    for axis, steps in ((axes.xaxis, 7), (axes.yaxis, 6)):
        axis.set_major_locator(MaxNLocator(steps, steps=[1, 2, 5, 10], min_n_ticks=3))
    across, up = "coupling index I_c (lower is better)", "log₁₀(det ΦᵀΦ / Nᵖ) (higher is better)"
    if together:
        across += "\nincluding earlier archives, weighted"
        up = "log₁₀ det (higher is better)\nincluding earlier archives"
    axes.set_xlabel(across)
    axes.set_ylabel(up)
    handles, _ = axes.get_legend_handles_labels()
    if handles:
        axes.legend(
            handles=handles, loc="lower left", bbox_to_anchor=(0.0, 1.02), frameon=False,
            borderaxespad=0.0, borderpad=0.0, labelspacing=0.35, fontsize=style.SMALL,
        )  # fmt: skip
    style.bare(axes)


_JOINT = re.compile(r"\d+")


def draw_correlation(axes: Axes, matrix: Array, names: Sequence[str]) -> None:
    """Draw ``|psi_ij| / sqrt(psi_ii psi_jj)`` (b, b) by joint, 0 white, 1 black."""
    b = len(names)
    if np.all(np.isfinite(matrix)):
        axes.imshow(np.abs(matrix), cmap="gray_r", vmin=0.0, vmax=1.0, interpolation="none")
    else:
        axes.set_xlim(-0.5, b - 0.5)
        axes.set_ylim(b - 0.5, -0.5)
        axes.set_aspect("equal")
        text = (
            "no correlations:\nthis motion does not excite a parameter\n(or a combination of some)"
        )
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
    axes.set_xlabel("parameters by joint, without friction")
    for spine in axes.spines.values():
        spine.set_color(style.MUTED)
    shade_scale(axes.inset_axes((1.03, 0.5, 0.04, 0.5)), style.INK, style.MUTED)


def blocks(names: Sequence[str]) -> list[tuple[str, int, int]]:
    """Return (label, start, stop) of adjacent parameters of the same joint."""

    def joint(k: int) -> str:
        match = _JOINT.search(names[k])
        return "" if match is None else match.group()

    groups = ((key, list(members)) for key, members in groupby(range(len(names)), key=joint))
    return [(key, members[0], members[-1] + 1) for key, members in groups]


def number(value: float, digits: int) -> str:
    """Format a criterion, which is infinite if a parameter is not excited."""
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
) -> list[tuple[str, float, str]]:
    """Return the heading lines with size in points and colour: criteria, what was not checked."""
    criteria = excitation.criteria
    determinant, index = number(criteria.log10_det, 2), f"I_c {number(criteria.coupling_index, 1)}"
    method, duration = f"method {excitation.method}", f"{excitation.trajectory.duration:.2f} s"
    parts = [f"log₁₀(det ΦᵀΦ / Nᵖ) {determinant}", index]
    note = ""
    if together:
        parts = ["including earlier archives, weighted"]
        note = (
            f"log₁₀ det {determinant} and {index} including earlier archives: "
            "not comparable with those of a single motion"
        )
    legend = (
        "red dashes: limits; grey lines: postures numbered below; blue: volume swept by "
        f"{'the arm' if shapes else _BARS}; brown: path of the end effector to the next posture"
    )
    missing = f"NOT CHECKED: {', '.join(unchecked)}; not for a robot" if unchecked else ""
    early = "" if complete else "search interrupted: better motions may exist"
    small = style.SMALL + 0.5
    lines = [
        (" · ".join([label(title), method, duration, *parts]), style.TITLE, style.INK, _LETTERS),
        (note, style.TEXT, style.INK, _LETTERS),
        (missing, style.TEXT + 1.0, style.LIMIT, _LETTERS * 2 // 3),
        (early, style.TEXT + 1.0, style.LIMIT, _LETTERS),
        ("".join(c if c.isprintable() else " " for c in margins), small, style.INK, _LETTERS),
        (legend, small, style.MUTED, _LETTERS),
    ]
    return [
        (part, size, colour)
        for text, size, colour, most in lines
        for part in textwrap.wrap(text, most)
    ]


def draw_design(
    excitation: Excitation,
    cell: Cell,
    *,
    front: Front | None = None,
    chosen: int | None = None,
    knee: Measures | None = None,
    references: Mapping[str, Measures] = _NO_REFERENCES,
    unchecked: Sequence[str] = (),
    complete: bool = True,
    together: bool = False,
    margins: str = "",
    title: str = "",
) -> Figure:
    """Draw a designed motion.

    Args:
        excitation: the motion with its criteria, which with `together` include earlier archives.
        cell: the cell to run it on.
        front: Pareto front of the search; `chosen` is the index of this motion on it.
        chosen: None if the motion is not on the front.
        knee: (log10 det, I_c) of the point of the front that it was polished from.
        references: (log10 det, I_c) of other motions to compare with, by name.
        unchecked: what the search did not check ("floor", "the arm itself", ...).
        complete: whether the search was completed.
        together: see `excitation`.
        margins: text on the distance to the limits.
        title: title of the page. Default: name of the cell.
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
    marks: dict[str, Measures] = {}
    if front is not None or references:
        polished = ", polished" if front is not None and chosen is None else ""
        marks["chosen" + polished] = excitation.criteria.measures
        if front is not None and chosen is not None:  # at the sample period of the front
            marks["chosen"] = tuple(float(front.measure(name)[chosen]) for name in CRITERIA)
        marks |= {} if knee is None else {GREW: knee}
        marks |= references
    side = float(np.clip(_CELL * len(model.base.names), _SMALLEST, _LARGEST))
    beside = _FRONT + _LEGEND_LINE * (1.5 * len(marks) + 1) if marks else 0.0
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
        if not marks:
            _correlations(right.subplots(), trajectory, model)
        else:
            matrix, below = right.subplots(2, 1, height_ratios=(side + 0.6, beside))
            _correlations(matrix, trajectory, model)
            draw_front(below, front, marks, together=together)
        draw_strip(bottom.subplots(2, POSTURES, height_ratios=shapes).tolist(), strip)
        for k, (text, size, colour) in enumerate(lines):
            at = 1.0 - (_TITLE_AT + k * _HEAD_LINE) / height
            weight = "bold" if colour == style.LIMIT else "normal"
            figure.text(0.07, at, text, fontsize=size, color=colour, fontweight=weight)
        figure.draw_without_rendering()
        figure.set_layout_engine("none")
        # The layout solver is not reproducible to the last digit.
        for part in (top, bottom, left, right):
            part.bbox_relative.set_points(np.round(part.bbox_relative.get_points(), 4))
        for axes in figure.axes:
            axes.set_position(np.round(axes.get_position(original=True).bounds, 4).tolist())
    return figure


def _correlations(axes: Axes, trajectory: Trajectory, model: RobotModel) -> None:
    motion = sampled(trajectory, _PERIOD)
    unknown = np.zeros_like(motion.position)  # the criteria do not depend on torque
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
