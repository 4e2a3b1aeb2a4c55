"""A designed motion on one page: joints against limits, correlations, the front, the postures."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from types import MappingProxyType
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hil.arm import Arm
from hil.cell import AngleFrame, Cell
from hil.plots import style
from hil.plots.design_correlation import draw_correlation
from hil.plots.design_front import FrontPoints, FrontView, Measures, draw_front
from hil.plots.design_heading import Line, Remarks, heading, number
from hil.plots.design_joints import draw_motion
from hil.plots.posture_strip import VIEWS, Strip, draw_strip
from identification.excitation import correlation, coupling_index, coupling_index_max, information
from identification.excitation.excitation import Excitation
from identification.excitation.sampling import sampled
from identification.factor import Factor
from identification.model import RobotModel
from planner import Trajectory

Array = NDArray[np.float64]

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
        kinematic: names of references that kept joint limits only.
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
