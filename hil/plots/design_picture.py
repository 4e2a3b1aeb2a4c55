"""A designed motion on one page: joints against limits, correlations, the front, the postures."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hil.arm import Arm
from hil.cell import Cell
from hil.plots import style
from hil.plots.design_correlation import draw_correlation
from hil.plots.design_front import FrontPoints, draw_front
from hil.plots.design_joints import draw_motion
from hil.plots.frame import AngleFrame
from hil.plots.posture_strip import VIEWS, Strip, draw_strip
from hil.report.figures.svg import label
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
_BARS = "the arm (bars from joint to joint: its shapes are not known here)"
_NO_REFERENCES: Mapping[str, tuple[float, float]] = MappingProxyType({})

# All in inches.
_WIDTH = 11.8
_LEFT, _RIGHT = 0.78, 0.2
_HEAD, _GAP, _FOOT = 1.12, 0.92, 0.5
_ROW, _BETWEEN_ROWS, _BETWEEN_COLUMNS = 0.98, 0.1, 0.56
_AXIS, _SHADES = 0.78, 0.5
_CELL, _SMALLEST, _LARGEST = 0.1, 2.6, 4.0
_FRONT, _ABOVE_FRONT = 2.3, 0.85
_BETWEEN_VIEWS, _BETWEEN_POSTURES = 0.1, 0.07


def draw_design(
    excitation: Excitation,
    cell: Cell,
    *,
    front: FrontPoints | None = None,
    chosen: int | None = None,
    references: Mapping[str, tuple[float, float]] = _NO_REFERENCES,
    title: str = "",
) -> Figure:
    """Draw a designed motion, so that a person sees what the robot is going to do.

    Args:
        excitation: the motion, and how good it is.
        cell: where it is going to run.
        front: what the search found beside it.
        chosen: index of this motion on the front, None where it is not one of its points.
        references: (log10 det, I_c) of other motions to compare with, by name.
        title: stands above the page; the cell's name if empty.
    """
    trajectory, model = excitation.trajectory, cell.model
    arm = Arm.from_urdf(cell.urdf)
    strip = Strip.of(arm, trajectory, cell.workspace, POSTURES)
    side = float(np.clip(_CELL * len(model.base.names), _SMALLEST, _LARGEST))
    with_front = front is not None or bool(references)
    beside = side + (_ABOVE_FRONT + _FRONT if with_front else 0.0)
    upper = max(_ROW * model.n_joints, beside)
    width = (_WIDTH - _LEFT - _RIGHT + _BETWEEN_POSTURES) / POSTURES - _BETWEEN_POSTURES
    views = [width * strip.shape(view) for view in VIEWS]
    height = _HEAD + upper + _GAP + sum(views) + _BETWEEN_VIEWS * (len(views) - 1) + _FOOT
    with style.page():
        sheet = _Sheet(height)
        matrix = _WIDTH - _RIGHT - _SHADES - side
        rows = sheet.rows((_LEFT, _HEAD, matrix - _AXIS - _LEFT, upper), model.n_joints)
        frame = AngleFrame.of(cell)
        draw_motion(rows, trajectory, cell.joint_limits, cell.joint_names, frame, strip.postures)
        axes = sheet.axes(matrix, _HEAD, side, side)
        shades = sheet.axes(matrix + side + 0.1, _HEAD, 0.13, min(side, 1.6))
        _correlations(axes, shades, trajectory, model)
        if with_front:
            at = sheet.axes(matrix, _HEAD + upper - _FRONT, side + _SHADES, _FRONT)
            draw_front(at, front, _chosen(excitation, front, chosen), references)
        draw_strip(sheet.strip(_HEAD + upper + _GAP, width, views), strip)
        _headings(sheet, excitation, title or cell.name, arm)
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

    def text(self, left: float, top: float, text: str, **options: Any) -> None:
        self.figure.text(left / _WIDTH, 1.0 - top / self.height, text, **options)


def _correlations(axes: Axes, shades: Axes, trajectory: Trajectory, model: RobotModel) -> None:
    motion = sampled(trajectory, _PERIOD)
    unknown = np.zeros_like(motion.position)  # torque plays no part in the excitation
    gram = information(Factor.from_samples(model, motion, unknown))
    b = len(model.base.names)
    draw_correlation(axes, shades, correlation(gram)[:b, :b], model.base.names)
    p = model.n_parameters
    index = _number(coupling_index(gram), 1)
    axes.set_title(
        f"|correlation| from this motion alone\n"
        f"all {p} parameters: I_c {index} of {coupling_index_max(p):.0f}",
        loc="left",
        color=style.MUTED,
        pad=5.0,
    )


def _chosen(
    excitation: Excitation, front: FrontPoints | None, chosen: int | None
) -> tuple[float, float]:
    """Return the measures of the motion, those by which it lies on the front if it does."""
    if front is None or chosen is None:
        return excitation.criteria.log10_det, excitation.criteria.coupling_index
    return float(front.log10_det[chosen]), float(front.coupling_index[chosen])


def _headings(sheet: _Sheet, excitation: Excitation, title: str, arm: Arm) -> None:
    criteria = excitation.criteria
    parts = [
        label(title),
        f"method {excitation.method}",
        f"{excitation.trajectory.duration:.2f} s",
        f"log₁₀(det ΦᵀΦ / Nᵖ) {_number(criteria.log10_det, 2)}",
        f"I_c {_number(criteria.coupling_index, 1)}",
    ]
    sheet.text(_LEFT, 0.36, " · ".join(parts), fontsize=style.TITLE, color=style.INK)
    sheet.text(
        _LEFT,
        0.6,
        "red dashes: limits; grey lines: the postures numbered below; "
        f"blue: all that {'the arm' if arm.has_shapes else _BARS} sweeps; "
        "brown: the way of its end to the next posture",
        fontsize=style.SMALL + 0.5,
        color=style.MUTED,
    )


def _number(value: float, digits: int) -> str:
    """Return a criterion as text; a motion that leaves a parameter unexcited has infinite ones."""
    return f"{value:.{digits}f}" if np.isfinite(value) else ("∞" if value > 0.0 else "−∞")
