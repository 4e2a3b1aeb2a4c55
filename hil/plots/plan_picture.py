"""A plan on one page: every joint against its limits, and one corner at several percentages."""

from __future__ import annotations

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from hil.cell import AngleFrame
from hil.errors import InputError
from hil.files import write_atomically
from hil.plots import style
from hil.plots.corner import draw_corner, flown_corners, sharpest_corner
from hil.plots.joints import draw_joints
from planner.moves import MotionPlan

FORMATS = (".png", ".svg", ".pdf")
_WIDTH, _ROW, _CORNER = 11.0, 1.25, 3.0
_TOP, _BOTTOM, _GAP = 0.95, 0.55, 0.95
_DOTS_PER_INCH = 110


def draw_plan(
    plan: MotionPlan,
    joint_names: Sequence[str],
    frame: AngleFrame,
    *,
    title: str = "",
    corner: int | None = None,
) -> Figure:
    """Draw a plan.

    Args:
        plan: What to draw.
        joint_names: One name per joint.
        frame: Which angles to show.
        title: Stands above the page.
        corner: Target (from 0) to draw the corner of; the sharpest if None.
    """
    corner = sharpest_corner(plan) if corner is None else corner
    n = len(joint_names)
    below = 0.0 if corner is None else _CORNER + _GAP
    height = _TOP + n * _ROW + below + _BOTTOM
    with style.page():
        figure = Figure(figsize=(_WIDTH, height))
        grid = figure.add_gridspec(
            n,
            3,
            left=0.08,
            right=0.985,
            top=1.0 - _TOP / height,
            bottom=(below + _BOTTOM) / height,
            hspace=0.16,
            wspace=0.2,
        )
        rows = [[figure.add_subplot(grid[j, k]) for k in range(3)] for j in range(n)]
        draw_joints(rows, plan, joint_names, frame)
        if corner is not None:
            lower = figure.add_gridspec(
                1, 2, left=0.08, right=0.76, top=(_BOTTOM + _CORNER) / height,
                bottom=_BOTTOM / height, wspace=0.22,
            )  # fmt: skip
            path, speed = (figure.add_subplot(lower[0, k]) for k in range(2))
            draw_corner(path, speed, flown_corners(plan, corner), joint_names, frame)
        figure.text(
            0.08, 1.0 - 0.3 / height, _headline(plan, title), fontsize=style.TITLE, color=style.INK
        )
        figure.text(
            0.08,
            1.0 - 0.52 / height,
            "red dashes: limits; shaded: corners; line at each numbered target: solid flown by as "
            "asked, dashed less than asked, dotted stop; circles: targets",
            fontsize=style.SMALL + 0.5,
            color=style.MUTED,
        )
    return figure


def check_format(path: Path) -> None:
    """Refuse a name that tells no format in which pictures are written.

    Raises:
        InputError: it does not.
    """
    if path.suffix.lower() not in FORMATS:
        raise InputError(
            path, f"{path.suffix!r} is no format for pictures", remedy=f"use {', '.join(FORMATS)}"
        )


def save(figure: Figure, path: Path) -> None:
    """Write a picture in the format of its name, the whole of it or nothing.

    Raises:
        InputError: the format is unknown, or the file cannot be written.
    """
    check_format(path)
    metadata = {"Date": None} if path.suffix.lower() == ".svg" else {}
    try:
        with style.page():
            content = BytesIO()
            kind = path.suffix.lower().removeprefix(".")
            figure.savefig(content, format=kind, dpi=_DOTS_PER_INCH, metadata=metadata)
        write_atomically(path, content.getvalue())
    except OSError as error:
        raise InputError(path, f"cannot be written ({error.strerror})") from error


def _headline(plan: MotionPlan, title: str) -> str:
    duration, stopping = plan.duration, plan.duration_with_stops
    share = f" ({duration / stopping:.1%} of the time with stops)" if stopping > 0.0 else ""
    count = np.unique([target.how for target in plan.targets[:-1]], return_counts=True)
    passed = ", ".join(f"{number} {how}" for how, number in zip(*count, strict=True))
    parts = [title, f"{duration:.3f} s{share}", passed]
    return " · ".join(part for part in parts if part)
