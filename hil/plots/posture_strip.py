"""What the robot is going to do: the room that it sweeps, and its postures one after the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from hil.arm import Arm, reach
from hil.plots import style
from identification.excitation import Workspace
from planner import Trajectory

Array = NDArray[np.float64]

_DIRECTIONS = 48
"""Corners of an outline; a circle's is seen too small by 0.2 % of its radius at most."""


class Projection(NamedTuple):
    """An orthographic view.

    Attributes:
        name: of the view.
        across: index of the base axis that points to the right.
        up: index of the base axis that points up on the paper.
    """

    name: str
    across: int
    up: int

    @property
    def axes(self) -> tuple[int, int]:
        """Both indices."""
        return self.across, self.up

    @property
    def depth(self) -> int:
        """Index of the axis along which one looks."""
        return 3 - self.across - self.up

    @property
    def labels(self) -> tuple[str, str]:
        """Names of the axes, with unit."""
        return f"{'xyz'[self.across]} [m]", f"{'xyz'[self.up]} [m]"


SIDE, TOP = Projection("side", 0, 2), Projection("top", 0, 1)


def outlines(points: Array) -> Array:
    """Return the convex outline of each set of points (m, v, 2), anticlockwise: (m, k, 2).

    Corners are the points farthest in k directions; where one of them is farthest in several, it
    is repeated.
    """
    angle = np.linspace(0.0, 2.0 * np.pi, _DIRECTIONS, endpoint=False)
    directions = np.stack((np.cos(angle), np.sin(angle)))
    farthest = np.argmax(points @ directions, axis=1)
    return np.take_along_axis(points, farthest[:, :, None], axis=1)


def swept(points: Array) -> Array:
    """Return outlines (m - 1, k, 2) of a body's points (m, v, 2) from each sample to the next."""
    return outlines(np.concatenate((points[:-1], points[1:]), axis=1))


def covered(polygons: Array, window: Array, columns: int) -> Array:
    """Return which points of a grid lie in any of the polygons (m, k, 2), 1 or 0.

    Args:
        polygons: their corners.
        window: from where to where the grid reaches, across and up (2, 2).
        columns: points of the grid across; those up are as far apart.

    Returns:
        (rows, columns), the lowest row first.
    """
    low, high = window.T
    pitch = (high[0] - low[0]) / (columns - 1)
    rows = round(float((high[1] - low[1]) / pitch)) + 1
    image = Image.new("L", (columns, rows))
    draw = ImageDraw.Draw(image)
    for corners in np.rint((polygons - low) / pitch).reshape(len(polygons), -1).tolist():
        draw.polygon(corners, fill=1)
    return np.asarray(image, dtype=np.float64)


VIEWS = (SIDE, TOP)
_SWEPT, _SWEPT_EDGE = "#dfe8f1", "#8fa9c4"
_BASE, _ARM, _ARM_EDGE = "#8a8a8a", "#4b5763", "#ffffff"
_PATH = style.ACCELERATION
_SOLID, _HATCH = "#ede7d9", "#a09270"
_STEP = 0.03
"""s between two looks at the arm for what it sweeps."""
_LONGEST = 1500
_ROOM = 0.06
_SHORT = 0.08
"""Ways shorter than this share of the view get no arrow head."""
_NEAR = 0.2
"""Obstacles that are nearer than this share of the swept room's size are shown."""
_GRID = 500
"""Points of the grid across a view, as many as a printer's dots."""
_HIGHEST, _FLATTEST = 1.3, 0.5


@dataclass(frozen=True, eq=False)
class Strip:
    """Everything that the views of a strip share.

    Attributes:
        postures: times of the postures (k,) [s].
        corners: of each body at the times of the sweep, (m, v, 3) each [m].
        stand: of each body at the postures, (k, v, 3) each [m].
        bones: lines from joint to joint at the postures, (k, b, 2, 3) [m].
        time, path: when (m,) [s] and where (m, 3) [m] the arm's end is.
        joints: the joint that moves each body, -1 for the base.
        workspace: what stands around.
    """

    postures: Array
    corners: Sequence[Array]
    stand: Sequence[Array]
    bones: Array
    time: Array
    path: Array
    joints: Sequence[int]
    workspace: Workspace

    @classmethod
    def of(cls, arm: Arm, trajectory: Trajectory, workspace: Workspace, count: int) -> Strip:
        """Look at a motion, and at `count` of its postures, equally far apart in time."""
        postures = posture_times(trajectory, count)
        steps = int(np.clip(np.ceil(trajectory.duration / _STEP), 1, _LONGEST))
        time = np.linspace(0.0, trajectory.duration, steps + 1)
        q, shown = trajectory.sample(time)[0], trajectory.sample(postures)[0]
        return cls(
            postures,
            arm.corners(q),
            arm.corners(shown),
            arm.bones(shown),
            time,
            arm.tips(q),
            [solid.joint for solid in arm.solids],
            workspace,
        )

    @cached_property
    def extents(self) -> Array:
        """Return from where to where each base axis is shown, the floor included (3, 2) [m].

        What is across is the same in both views; neither gets much higher or flatter than wide.
        """
        low, high = reach(self.corners)
        if self.workspace.floor is not None:
            low[2], high[2] = min(low[2], self.workspace.floor), max(high[2], self.workspace.floor)
        low, high = self._with_obstacles(low, high)
        size = (1.0 + 2.0 * _ROOM) * np.maximum(high - low, 1e-3)
        size[0] = max(size[0], size.max() / _HIGHEST)
        size[1:] = np.maximum(size[1:], _FLATTEST * size[0])
        return np.stack(((low + high - size) / 2.0, (low + high + size) / 2.0), axis=1)

    def _with_obstacles(self, low: Array, high: Array) -> tuple[Array, Array]:
        """Return the room from `low` to `high` (3,), widened to show what stands close to it."""
        near = _NEAR * np.max(high - low)
        least, most = low.copy(), high.copy()
        for box in self.workspace.boxes:
            lower, upper = np.array(box.lower), np.array(box.upper)
            if np.all((lower < high + near) & (upper > low - near)):
                least = np.minimum(least, np.maximum(lower, low - near))
                most = np.maximum(most, np.minimum(upper, high + near))
        return least, most

    @cached_property
    def sweeps(self) -> tuple[Array, ...]:
        """Return where each of VIEWS is swept, on a grid (rows, _GRID)."""
        return tuple(
            covered(
                np.concatenate([swept(corners[..., view.axes]) for corners in self.corners]),
                self.extents[list(view.axes)],
                _GRID,
            )
            for view in VIEWS
        )

    def shape(self, view: Projection) -> float:
        """Return height over width of a view."""
        size = np.ptp(self.extents, axis=1)
        return float(size[view.up] / size[view.across])


def posture_times(trajectory: Trajectory, count: int) -> Array:
    """Return `count` times [s] equally far apart, the end left out where it is the beginning."""
    ends, _, _ = trajectory.sample(np.array([0.0, trajectory.duration]))
    closed = bool(np.allclose(ends[0], ends[1], atol=1e-9))
    return np.linspace(0.0, trajectory.duration, count, endpoint=not closed)


def draw_strip(rows: Sequence[Sequence[Axes]], strip: Strip) -> None:
    """Draw one row of axes per view, one of its axes per posture."""
    for row, view, sweep in zip(rows, VIEWS, strip.sweeps, strict=True):
        for k, axes in enumerate(row):
            axes.set_aspect("equal")
            axes.set_xlim(*strip.extents[view.across])
            axes.set_ylim(*strip.extents[view.up])
            _surroundings(axes, strip.workspace, view)
            _room(axes, sweep)
            _path(axes, strip, k, view)
            _bones(axes, strip.bones[k][..., view.axes])
            _arm(axes, strip, k, view)
            _dress(axes, view, first=k == 0)
    for k, (axes, time) in enumerate(zip(rows[0], strip.postures, strict=True), 1):
        axes.set_title(f"{k}", loc="left", fontweight="bold", color=style.INK, pad=4.0)
        axes.set_title(f"{time:.2f} s", loc="center", color=style.MUTED, pad=4.0)


def _room(axes: Axes, sweep: Array) -> None:
    extent = (*axes.get_xlim(), *axes.get_ylim())
    axes.contourf(sweep, levels=[0.5, 1.5], colors=[_SWEPT], extent=extent, zorder=1.0)
    axes.contour(
        sweep, levels=[0.5], colors=[_SWEPT_EDGE], linewidths=0.6, extent=extent, zorder=1.1
    )


def _arm(axes: Axes, strip: Strip, k: int, view: Projection) -> None:
    """Draw the bodies of one posture, the nearest to the eye last."""
    towards = 1.0 if view.up == 1 else -1.0  # from above, and from where y is smallest
    bodies = sorted(
        range(len(strip.stand)), key=lambda b: towards * strip.stand[b][k, :, view.depth].mean()
    )
    shapes = [outlines(strip.stand[b][k : k + 1, :, view.axes])[0] for b in bodies]
    colours = [_BASE if strip.joints[b] < 0 else _ARM for b in bodies]
    axes.add_collection(
        PolyCollection(
            shapes, facecolors=colours, edgecolors=_ARM_EDGE, linewidths=0.45, zorder=2.0
        )
    )


def _bones(axes: Axes, bones: Array) -> None:
    """Join bodies between which there is a gap."""
    axes.add_collection(LineCollection(list(bones), colors=_ARM, linewidths=1.2, zorder=1.9))


def _path(axes: Axes, strip: Strip, k: int, view: Projection) -> None:
    """Draw where the arm's end goes from one posture to the next, with an arrow head."""
    begin = strip.postures[k]
    end = strip.postures[k + 1] if k + 1 < len(strip.postures) else strip.time[-1]
    way = strip.path[(strip.time >= begin) & (strip.time <= end)][:, view.axes]
    if len(way) < 2:
        return
    axes.plot(*way.T, color=_PATH, linewidth=1.3, zorder=3.0)
    axes.plot(*way[0], marker="o", markersize=3.2, color=_PATH, zorder=3.0)
    gone = np.linalg.norm(np.diff(way, axis=0), axis=1)
    if gone.sum() > _SHORT * np.ptp(axes.get_xlim()):
        before = way[np.searchsorted(np.cumsum(gone), 0.97 * gone.sum())]
        axes.annotate(
            "",
            way[-1],
            before,
            arrowprops={"arrowstyle": "-|>,head_width=0.22,head_length=0.4", "color": _PATH},
            zorder=3.1,
        )


def _surroundings(axes: Axes, workspace: Workspace, view: Projection) -> None:
    """Draw obstacles below what the arm sweeps, and their outlines above it: both are seen."""
    left, right = axes.get_xlim()
    bottom, _ = axes.get_ylim()
    if view.up == 2 and workspace.floor is not None:
        _solid(axes, (left, bottom), (right, workspace.floor))
        axes.axhline(workspace.floor, color=style.INK, linewidth=1.0, zorder=1.6)
    for box in workspace.boxes:
        low, high = ((corner[view.across], corner[view.up]) for corner in (box.lower, box.upper))
        _solid(axes, low, high)
    for wall in workspace.walls:
        length = float(np.linalg.norm(wall.normal))
        across, up = wall.normal[view.across] / length, wall.normal[view.up] / length
        if np.hypot(across, up) > 1.0 - 1e-9:  # others are not seen from their edge
            foot = (across * wall.offset, up * wall.offset)
            axes.axline(foot, (foot[0] - up, foot[1] + across), color=style.INK, zorder=1.6)


def _solid(axes: Axes, low: tuple[float, float], high: tuple[float, float]) -> None:
    size = (high[0] - low[0], high[1] - low[1])
    axes.add_patch(
        Rectangle(
            low, *size, facecolor=_SOLID, edgecolor=_HATCH, hatch="////", linewidth=0.0, zorder=0.5
        )
    )
    axes.add_patch(Rectangle(low, *size, fill=False, edgecolor=_HATCH, linewidth=0.9, zorder=1.5))


def _dress(axes: Axes, view: Projection, *, first: bool) -> None:
    axes.xaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10]))
    axes.yaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
    axes.tick_params(labelleft=first, labelbottom=view is VIEWS[-1], length=2.0, pad=2.0)
    for spine in axes.spines.values():
        spine.set_color(style.RULE)
    if first:
        axes.set_ylabel(f"{view.name} view: {view.labels[1]}")
    if view is VIEWS[-1]:
        axes.set_xlabel(view.labels[0])
