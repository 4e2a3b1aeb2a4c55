"""Descriptions of arms with given axes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

_DIRECTIONS: Final = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


def jointed_arm(axes: str, links: str | None = None) -> str:
    """A URDF with joints a1, a2, ... and bodies that are slightly out of the plane of the arm.

    Args:
        axes: of the joints, such as ``zyyx``.
        links: direction of each link at zero, by default upwards.
    """
    links = links or "z" * len(axes)
    parts = [_body("base", 5.0, (0.0, 0.0, 0.05), (0.2, 0.2, 0.1))]
    origin = np.array([0.0, 0.0, 0.1])
    for k, (axis, link) in enumerate(zip(axes, links, strict=True)):
        along = np.array(_DIRECTIONS[link])
        length, mass = 0.4 * 0.8**k, 6.0 * 0.6**k
        centre = 0.45 * length * along + [0.01, 0.015 * (-1.0) ** (k + 1), 0.012]
        size = 0.08 + (length - 0.02) * along
        parts += [
            _body(f"l{k + 1}", mass, centre, size),
            f'<joint name="a{k + 1}" type="revolute">'
            f'<parent link="{f"l{k}" if k else "base"}"/><child link="l{k + 1}"/>'
            f'<origin xyz="{_words(origin)}"/><axis xyz="{_words(_DIRECTIONS[axis])}"/>'
            '<limit lower="-2.6" upper="2.6" effort="500" velocity="4"/></joint>',
        ]
        origin = length * along
    return f'<robot name="arm">{"".join(parts)}</robot>'


def _body(name: str, mass: float, centre: Sequence[float], size: Sequence[float]) -> str:
    x, y, z = mass * np.square(size) / 12.0
    return (
        f'<link name="{name}"><inertial><origin xyz="{_words(centre)}"/><mass value="{mass}"/>'
        f'<inertia ixx="{y + z}" iyy="{x + z}" izz="{x + y}" ixy="0" ixz="0" iyz="0"/>'
        "</inertial></link>"
    )


def _words(numbers: Sequence[float]) -> str:
    return " ".join(f"{number:g}" for number in numbers)
