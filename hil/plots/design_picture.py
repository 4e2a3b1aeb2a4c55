"""Picture of a designed motion: joints and limits, correlations, front."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterator, Sequence
from itertools import groupby
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hil.cell import AngleFrame, Cell
from hil.design.messages import criteria_text
from hil.plots.plan_picture import draw_motion
from hil.report import picture_style as style
from hil.report.chart import label
from identification.excitation import (
    CRITERIA,
    RESCORE_PERIOD,
    Design,
    Objective,
    correlation,
    coupling_index,
    coupling_index_max,
    midpoints,
)
from identification.model.robot import RobotModel
from planner import Trajectory

_WHITE: Final[dict[str, Any]] = {"linestyle": "none", "markerfacecolor": "white"}
# inch
_FIGURE_WIDTH = 11.8
_ROW_HEIGHT = 1.05
_FRONT_HEIGHT = 2.9
_LEGEND_LINE_HEIGHT = 0.22
_CELL_SIZE = 0.1
_MIN_MATRIX_SIDE = 2.6
_MAX_MATRIX_SIDE = 4.0
_TITLE_OFFSET = 0.36
_HEAD_LINE_HEIGHT = 0.23
_HEAD_FOOT_HEIGHT = 0.3
_LINE_LENGTH: Final = 1300.0  # Characters of a line times its font size in points


def draw_front(axes: Axes, design: Design) -> None:
    """Draw the front and the chosen motion, with a legend."""
    front = design.front
    chosen = design.chosen
    upward, rightward = front.criteria
    over = CRITERIA[upward]
    beside = CRITERIA[rightward]
    origin = front.measure(upward)[design.origin], front.measure(rightward)[design.origin]
    x, y = front.measure(rightward), front.measure(upward)
    # A required precision is a third criterion: its front is no line over the other two.
    is_line = bool(np.all(np.diff(over.sense * y[np.argsort(-beside.sense * x)]) >= 0.0))
    axes.plot(
        x, y, drawstyle="steps-post", linestyle="-" if is_line else "none",
        color=style.POSITION, linewidth=1.0, marker="o", markersize=3.4,
        label=f"front, {len(front)} motion{'s' * (len(front) > 1)}",
    )  # fmt: skip

    def mark(name: str, measures: Sequence[float], **look: Any) -> None:
        y, x = measures
        figures = f"({y:.{over.decimals}f}, {x:.{beside.decimals}f})"
        axes.plot(x, y, label=f"{label(name)} {figures}", **look)

    star = {"linestyle": "none", "marker": "*", "markersize": 13.0, "color": style.LIMIT}
    if chosen is None:
        criteria = design.excitation.criteria
        improved = getattr(criteria, upward), getattr(criteria, rightward)
        mark("chosen, improved", improved, **star, zorder=4.0)
        mark("grew from", origin, **_WHITE, marker="o", markeredgecolor=style.LIMIT)
    else:  # at the sample period of the front
        mark("chosen", origin, **star, zorder=4.0)
    axes.set_xlabel(f"{beside.title} ({beside.better})")
    axes.set_ylabel(f"{over.title} ({over.better})")
    axes.legend(
        loc="lower left", bbox_to_anchor=(0.0, 1.02), frameon=False, borderaxespad=0.0,
        borderpad=0.0, labelspacing=0.35, fontsize=style.SMALL_FONT_SIZE,
    )  # fmt: skip


def draw_correlation(axes: Axes, trajectory: Trajectory, model: RobotModel) -> None:
    """Draw ``|psi_ij| / sqrt(psi_ii psi_jj)`` of the base parameters, 0 white, 1 black."""
    gram = Objective(model).information(midpoints(trajectory, RESCORE_PERIOD))
    names = model.base.names
    p = model.n_parameters
    matrix = np.abs(correlation(gram)[: len(names), : len(names)])
    axes.imshow(matrix, cmap="gray_r", vmin=0.0, vmax=1.0, interpolation="none")
    middles = []
    joints = []
    first = 0
    for joint, members in groupby(names, key=lambda name: re.findall(r"\d+", name)[0]):
        last = first + len(list(members))
        if first:
            axes.axhline(first - 0.5, color=style.POSITION, linewidth=0.7)
            axes.axvline(first - 0.5, color=style.POSITION, linewidth=0.7)
        middles.append((first + last - 1) / 2.0)
        joints.append(joint)
        first = last
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_ticks(middles, joints, color=style.INK)
    axes.tick_params(length=0.0, pad=3.0)
    axes.grid(False)
    axes.set_xlabel("parameters by joint, without friction")
    axes.set_title(
        f"|correlation| from this motion alone,\n0 white, 1 black; all {p} parameters:\n"
        f"I_c {coupling_index(gram):.1f} of {coupling_index_max(p):.0f}",
        loc="left",
        color=style.MUTED,
        pad=5.0,
    )


def _heading(
    design: Design, cell: Cell, unchecked: Sequence[str]
) -> Iterator[tuple[str, float, str]]:
    """Yield the lines of the heading with size in points and colour."""
    excitation = design.excitation
    figures = criteria_text(excitation.criteria.measures)
    duration = f"{excitation.trajectory.duration:.2f} s"
    parts = (label(cell.name), f"method {excitation.method}", duration, figures)
    for text, size, colour in (
        (" · ".join(parts), style.TITLE_FONT_SIZE, style.INK),
        (
            f"NOT CHECKED: {', '.join(unchecked)}; not for a robot" if unchecked else "",
            style.FONT_SIZE + 1.0,
            style.LIMIT,
        ),
        (
            "" if design.complete else "search interrupted: better motions may exist",
            style.FONT_SIZE + 1.0,
            style.LIMIT,
        ),
        ("red dashes: limits", style.SMALL_FONT_SIZE, style.MUTED),
    ):
        for line in textwrap.wrap(text, int(_LINE_LENGTH / size)):
            yield line, size, colour


def draw_design(design: Design, cell: Cell, unchecked: Sequence[str] = ()) -> Figure:
    """Draw a designed motion for a cell, and what was not checked ("floor", "walls", ...)."""
    model = cell.model
    trajectory = design.excitation.trajectory
    lines = list(_heading(design, cell, unchecked))
    side = float(np.clip(_CELL_SIZE * model.base.rank, _MIN_MATRIX_SIDE, _MAX_MATRIX_SIDE))
    beside = _FRONT_HEIGHT + 3 * _LEGEND_LINE_HEIGHT
    head = _TITLE_OFFSET + _HEAD_LINE_HEIGHT * (len(lines) - 1) + _HEAD_FOOT_HEIGHT
    upper = max(_ROW_HEIGHT * model.n_joints + 0.6, side + 1.0 + beside)
    height = head + upper
    with style.page():
        figure = Figure(figsize=(_FIGURE_WIDTH, height), layout="constrained")
        parts: Any = figure.subfigures(2, 1, height_ratios=(head, upper))
        top = parts[1]
        left, right = top.subfigures(1, 2, width_ratios=(_FIGURE_WIDTH - side - 1.7, side + 1.7))
        rows = left.subplots(model.n_joints, 2, squeeze=False).tolist()
        frame = AngleFrame.of(cell)
        draw_motion(rows, trajectory, cell.joint_limits, cell.joint_names, frame)
        left.align_ylabels()
        matrix, below = right.subplots(2, 1, height_ratios=(side + 0.6, beside))
        draw_correlation(matrix, trajectory, model)
        draw_front(below, design)
        for k, (text, size, colour) in enumerate(lines):
            at = 1.0 - (_TITLE_OFFSET + k * _HEAD_LINE_HEIGHT) / height
            weight = "bold" if colour == style.LIMIT else "normal"
            figure.text(0.07, at, text, fontsize=size, color=colour, fontweight=weight)
        figure.draw_without_rendering()
        figure.set_layout_engine("none")
        # The layout solver is not reproducible to the last digit.
        for part in (top, left, right):
            part.bbox_relative.set_points(np.round(part.bbox_relative.get_points(), 4))
        for axes in figure.axes:
            axes.set_position(np.round(axes.get_position(original=True).bounds, 4).tolist())
    return figure
