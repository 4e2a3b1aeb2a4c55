"""Cylinders and spheres that stand for the links of the NS 16, to look at and to check collisions.

Invented from the data sheet's outline. The colliding shapes are slimmer than the visible ones, so
that links that are not neighbours stay clear of each other in every working posture.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Axis = Literal["x", "y", "z"]


@dataclass(frozen=True)
class Cylinder:
    """Cylinder along an axis of its link frame, between two coordinates on that axis [m]."""

    axis: Axis
    start: float
    end: float
    radius: float
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    collides: bool = True
    visible: bool = True


@dataclass(frozen=True)
class Sphere:
    """Sphere around the origin of its link frame [m]."""

    radius: float
    collides: bool = True
    visible: bool = True


Shape = Cylinder | Sphere

RGBA: dict[str, str] = {
    "orange": "0.93 0.36 0.08 1",
    "grey": "0.30 0.32 0.34 1",
    "steel": "0.70 0.72 0.74 1",
}

COLOURS: dict[str, str] = {
    "base_link": "grey",
    "link_1": "orange",
    "link_2": "orange",
    "link_3": "orange",
    "link_4": "orange",
    "link_5": "grey",
    "link_6": "steel",
}

SHAPES: dict[str, tuple[Shape, ...]] = {
    "base_link": (Cylinder("z", 0.0, 0.34, 0.20),),
    # y1 points down: the column below the shoulder, then the hub of joint 2.
    "link_1": (
        Cylinder("y", -0.06, 0.24, 0.15),
        Cylinder("x", 0.0, 0.30, 0.09),
        Cylinder("z", -0.13, 0.13, 0.11, offset=(0.300, 0.0, 0.0)),
    ),
    # The upper arm stands beside the plane of the forearm, which folds past it.
    "link_2": (
        Cylinder("z", 0.12, 0.26, 0.10),
        Cylinder("x", 0.0, 0.70, 0.07, offset=(0.0, 0.0, 0.19)),
        Cylinder("z", 0.09, 0.26, 0.09, offset=(0.700, 0.0, 0.0)),
    ),
    # The forearm leaves the elbow along -z3; its motors stand behind the elbow.
    "link_3": (
        Cylinder("y", -0.09, 0.08, 0.08),
        Cylinder("x", 0.0, 0.185, 0.07),
        Cylinder("z", -0.22, 0.16, 0.085, offset=(0.185, 0.0, 0.0)),
    ),
    "link_4": (
        Cylinder("y", 0.24, 0.47, 0.05, visible=False),
        Cylinder("y", 0.22, 0.58, 0.06, collides=False),
    ),
    "link_5": (Sphere(0.06),),
    "link_6": (
        Cylinder("z", 0.07, 0.135, 0.04),
        Cylinder("z", 0.0, 0.07, 0.03, collides=False),
    ),
}
