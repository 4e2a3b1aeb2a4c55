"""Views of the swept volume and of postures of a motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.patches import Rectangle
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from hil.arm import Arm, reach
from hil.plots import style
from identification.excitation import Workspace
from planner import Trajectory

Array = NDArray[np.float64]


class View(NamedTuple):
    """An orthographic view."""

    name: str
    axes: tuple[int, int]  # base axes to the right and upwards


SIDE, TOP = View("side", (0, 2)), View("top", (0, 1))
VIEWS: Final = (SIDE, TOP)
_SWEPT, _SWEPT_EDGE = "#dfe8f1", "#8fa9c4"
_BASE, _ARM, _ARM_EDGE = "#8a8a8a", "#4b5763", "#ffffff"
_PATH = style.ACCELERATION
_SOLID, _HATCH = "#ede7d9", "#a09270"
_DIRECTIONS: Final = 48
"""Corners of an outline; the error for a circle is at most 0.2 % of its radius."""
_STEP, _LONGEST = 0.03, 1500
"""Sampling period of the swept volume, s, and largest number of samples."""
_ROOM: Final = 0.06
_NEAR: Final = 0.2  # Obstacles within this fraction of the swept volume's size are drawn
_GRID: Final = 500  # Grid points across a view
_FLATTEST: Final = 0.5  # Smallest range of an axis relative to the largest


def outlines(points: Array) -> Array:
    """Return the points of sets (m, v, 2) farthest in k directions, anticlockwise: (m, k, 2)."""
    angle = np.linspace(0.0, 2.0 * np.pi, _DIRECTIONS, endpoint=False)
    farthest = np.argmax(points @ np.stack((np.cos(angle), np.sin(angle))), axis=1)
    return np.take_along_axis(points, farthest[:, :, None], axis=1)


def covered(bodies: Sequence[Array], window: Array, columns: int) -> Array:
    """Rasterise the area that bodies (m, v, 2) sweep: 1 inside, (rows, columns), lowest first.

    `window` (2, 2) has the ends of the grid, horizontally and vertically; the spacing is that of
    `columns`.
    """
    low, high = window.T
    pitch = (high[0] - low[0]) / (columns - 1)
    rows = round(float((high[1] - low[1]) / pitch)) + 1
    image = Image.new("L", (columns, rows))
    draw = ImageDraw.Draw(image)
    for points in bodies:
        polygons = outlines(np.concatenate((points[:-1], points[1:]), axis=1))
        for corners in np.rint((polygons - low) / pitch).reshape(len(polygons), -1).tolist():
            draw.polygon(corners, fill=1)
    return np.asarray(image, dtype=np.float64)


@dataclass(frozen=True, eq=False)
class Strip:
    """Data common to the views of a motion."""

    postures: Array  #: times of the postures (k,) [s]
    corners: Sequence[Array]  #: of each body at the times of the sweep, (m, v, 3) each [m]
    stand: Sequence[Array]  #: of each body at the postures, (k, v, 3) each [m]
    bones: Array  #: lines from joint to joint at the postures, (k, b, 2, 3) [m]
    #: time (m,) [s] and position (m, 3) [m] of the end effector
    time: Array
    path: Array
    joints: Sequence[int]  #: the joint that moves each body, -1 for the base
    workspace: Workspace  #: obstacles

    @classmethod
    def of(cls, arm: Arm, trajectory: Trajectory, workspace: Workspace, count: int) -> Strip:
        """Sample a motion, and `count` of its postures at equal intervals."""
        postures = np.linspace(0.0, trajectory.duration, count, endpoint=False)
        steps = int(np.clip(np.ceil(trajectory.duration / _STEP), 1, _LONGEST))
        time = np.linspace(0.0, trajectory.duration, steps + 1)
        q, shown = trajectory.sample(time)[0], trajectory.sample(postures)[0]
        joints = [solid.joint for solid in arm.solids]
        corners, stand, bones = arm.corners(q), arm.corners(shown), arm.bones(shown)
        return cls(postures, corners, stand, bones, time, arm.tips(q), joints, workspace)

    @cached_property
    def extents(self) -> Array:
        """Displayed range of each base axis with floor and near obstacles (3, 2) [m]."""
        low, high = reach(self.corners)
        if self.workspace.floor is not None:
            low[2], high[2] = min(low[2], self.workspace.floor), max(high[2], self.workspace.floor)
        near = _NEAR * np.max(high - low)
        least, most = low - near, high + near
        for box in self.workspace.boxes:
            lower, upper = np.array(box.lower), np.array(box.upper)
            if np.all((lower < most) & (upper > least)):
                low = np.minimum(low, np.maximum(lower, least))
                high = np.maximum(high, np.minimum(upper, most))
        longest = max(float(np.max(high - low)), 1e-3)
        size = (1.0 + 2.0 * _ROOM) * np.maximum(high - low, _FLATTEST * longest)
        return np.stack(((low + high - size) / 2.0, (low + high + size) / 2.0), axis=1)

    def shape(self, view: View) -> float:
        """Return height over width of a view."""
        across, up = np.ptp(self.extents, axis=1)[list(view.axes)]
        return float(up / across)


def draw_strip(rows: Sequence[Sequence[Axes]], strip: Strip) -> None:
    """Draw one row of axes per view, with one axes per posture."""
    for row, view in zip(rows, VIEWS, strict=True):
        window = strip.extents[list(view.axes)]
        sweep = covered([corners[..., view.axes] for corners in strip.corners], window, _GRID)
        extent = tuple(window.ravel().tolist())
        for k, axes in enumerate(row):
            axes.set_aspect("equal")
            axes.set_xlim(*window[0])
            axes.set_ylim(*window[1])
            _surroundings(axes, strip.workspace, view)
            axes.contourf(sweep, levels=[0.5, 1.5], colors=[_SWEPT], extent=extent, zorder=1.0)
            axes.contour(
                sweep, levels=[0.5], colors=[_SWEPT_EDGE], linewidths=0.6, extent=extent, zorder=1.1
            )
            _arm(axes, strip, k, view)
            axes.locator_params(nbins=4)
            axes.tick_params(labelleft=k == 0, labelbottom=view is TOP, length=2.0, pad=2.0)
            for spine in axes.spines.values():
                spine.set_color(style.RULE)
            across, up = ("xyz"[axis] for axis in view.axes)
            axes.set_ylabel("" if k else f"{view.name} view: {up} [m]")
            axes.set_xlabel(f"{across} [m]" if view is TOP else "")
    for k, (axes, time) in enumerate(zip(rows[0], strip.postures, strict=True), 1):
        axes.set_title(f"{k}", loc="left", fontweight="bold", color=style.INK, pad=4.0)
        axes.set_title(f"{time:.2f} s", loc="center", color=style.MUTED, pad=4.0)


def _arm(axes: Axes, strip: Strip, k: int, view: View) -> None:
    """Draw one posture, nearest body last, and the end effector path to the next posture."""
    # Bars close gaps between bodies.
    bones = list(strip.bones[k][..., view.axes])
    axes.add_collection(LineCollection(bones, colors=_ARM, linewidths=1.2, zorder=1.9))
    # Views are from above, and along positive y.
    depth, towards = (2, 1.0) if view is TOP else (1, -1.0)
    order = np.argsort([towards * body[k, :, depth].mean() for body in strip.stand], kind="stable")
    shapes = [outlines(strip.stand[b][k : k + 1, :, view.axes])[0] for b in order]
    colours = [_BASE if strip.joints[b] < 0 else _ARM for b in order]
    look: dict[str, Any] = {"facecolors": colours, "edgecolors": _ARM_EDGE, "linewidths": 0.45}
    axes.add_collection(PolyCollection(shapes, **look, zorder=2.0))
    start, stop = np.searchsorted(strip.time, [*strip.postures, np.inf])[k : k + 2]
    path = strip.path[start : stop + 1, view.axes]
    axes.plot(*path.T, color=_PATH, linewidth=1.3, zorder=3.0)
    axes.plot(*path[:1].T, marker="o", markersize=3.2, color=_PATH, zorder=3.0)


def _surroundings(axes: Axes, workspace: Workspace, view: View) -> None:
    """Draw the obstacles."""
    boxes = [
        [[corner[k] for k in view.axes] for corner in (box.lower, box.upper)]
        for box in workspace.boxes
    ]
    if view is SIDE and workspace.floor is not None:
        (left, right), bottom = axes.get_xlim(), axes.get_ylim()[0]
        boxes.append([[left, bottom], [right, workspace.floor]])
        axes.axhline(workspace.floor, color=style.INK, linewidth=1.0, zorder=1.6)
    for low, high in boxes:
        size = np.subtract(high, low)
        look: dict[str, Any] = {"facecolor": _SOLID, "edgecolor": _HATCH, "hatch": "////"}
        axes.add_patch(Rectangle((low[0], low[1]), *size, zorder=0.5, **look))
