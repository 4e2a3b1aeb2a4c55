"""A posture to begin in, where nobody names one."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations, product
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hil.cell import Cell, CellError
from hil.cell.text import replaced_value
from hil.motion_checks import collision_checker
from hil.reading import text_of
from identification.excitation.constraints import clearance
from planner.toml_text import toml_value

from .cell_text import NewCell

Array = NDArray[np.float64]

_TURNED: Final = 3
"""Joints away from their home at most."""


def with_clear_home(text: str, new: NewCell, path: Path) -> str:
    """The text of a cell file with a home that is clear of floor, walls and the arm itself.

    The posture that stands there, or the first clear one of those with one, two or three joints a
    right angle away from it. Where none is clear, or the URDF has no shapes, it stays.
    """
    urdf = new.urdf if new.urdf is not None else text_of(new.urdf_path)
    cell = Cell.from_texts(text, urdf, path)
    try:
        checker = collision_checker(cell)
    except CellError:
        return text
    limits = cell.joint_limits
    for posture in _postures(cell.home):
        inside = (posture > limits.lower) & (posture < limits.upper)
        if inside.all() and clearance(checker, posture[None]) is None:
            shown = [round(float(angle), 3) + 0.0 for angle in np.degrees(posture)]
            return replaced_value(text, "campaign", "home_deg", toml_value(shown))
    return text


def _postures(home: Array) -> Iterator[Array]:
    for count in range(_TURNED + 1):
        for joints in combinations(range(len(home)), count):
            for turns in product((-0.5 * np.pi, 0.5 * np.pi), repeat=count):
                posture = home.copy()
                posture[list(joints)] += turns
                yield posture
