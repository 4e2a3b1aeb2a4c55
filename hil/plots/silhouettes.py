"""Outlines of convex bodies seen from far away, and of what they sweep."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

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
