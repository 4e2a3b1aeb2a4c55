"""What stands around a robot."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from identification.excitation.errors import WorkspaceError

Array = NDArray[np.float64]
Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Wall:
    """A plane with free space on one side: points x with ``normal · x >= offset``.

    Attributes:
        normal: direction into the free space, base axes; any length but zero.
        offset: for a normal of length 1, the plane's distance from the base's origin along it [m].
    """

    normal: Vector
    offset: float

    def __post_init__(self) -> None:
        if not np.all(np.isfinite([*self.normal, self.offset])) or not any(self.normal):
            raise WorkspaceError(
                f"wall with normal {self.normal} and offset {self.offset}: both must be finite, "
                "the normal not zero"
            )


@dataclass(frozen=True)
class Box:
    """A solid box with edges along the base axes, from corner `lower` to corner `upper` [m]."""

    lower: Vector
    upper: Vector

    def __post_init__(self) -> None:
        corners = np.array([self.lower, self.upper])
        if not np.all(np.isfinite(corners)) or not np.all(corners[0] < corners[1]):
            raise WorkspaceError(
                f"box from {self.lower} to {self.upper} m: every lower edge must be below the upper"
            )


@dataclass(frozen=True)
class Workspace:
    """Obstacles in the base frame of the URDF, and the distance to keep from them.

    Attributes:
        floor: height of the floor [m]; None where there is none.
        walls: planes.
        boxes: solid boxes.
        margin: least distance [m] between the arm and anything, itself included.
    """

    floor: float | None = 0.0
    walls: tuple[Wall, ...] = ()
    boxes: tuple[Box, ...] = ()
    margin: float = 0.05

    def __post_init__(self) -> None:
        if self.floor is not None and not np.isfinite(self.floor):
            raise WorkspaceError(f"floor at {self.floor} m: it must be a finite height or None")
        if not (np.isfinite(self.margin) and self.margin >= 0.0):
            raise WorkspaceError(f"margin of {self.margin} m: it must be finite, 0 or more")
