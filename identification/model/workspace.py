"""Obstacles around an arm."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from identification.errors import WorkspaceError

Vector = tuple[float, float, float]


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
    """Obstacles in the base frame of the URDF, and the clearance."""

    floor: float | None = 0.0  #: height of the floor [m]; None: no floor
    boxes: tuple[Box, ...] = ()  #: solid boxes
    margin: float = 0.05  #: least distance [m] between the arm and anything, itself included
