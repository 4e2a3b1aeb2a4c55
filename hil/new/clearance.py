"""Home posture of a new cell file, clear of the floor and of the arm itself."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations, product
from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification.excitation import CollisionChecker, CollisionModelError, Workspace
from planner import JointLimits

from .known import ASSUMED, Known

Array = NDArray[np.float64]

_TURNED: Final = 3
"""Most joints turned away from the assumed home posture."""


def clear_home(urdf: str, known: Known, mesh_folders: Sequence[str]) -> Known:
    """Return the first clear posture with up to three joints turned by 90° from the home posture.

    Where none is clear of the floor, no floor is assumed. Notes report this, and pairs that are not
    checked or with less than the margin. Nothing is returned if shapes are missing or unreadable.
    """
    limits = _limits(known)
    postures = np.array([*_turned(np.radians(known.values["campaign.home_deg"]), limits)])
    notes = ["no posture tried is a home posture without contact: correct campaign.home_deg"]
    values: dict[str, object] = {}
    for floor in (known.values["workspace.floor"], None):
        workspace = Workspace(floor=floor, margin=known.values["workspace.margin"])
        try:
            checker = CollisionChecker(urdf, workspace, limits, mesh_folders)
        except CollisionModelError:
            return Known()
        clear = np.flatnonzero(checker.clear(postures))
        if len(clear) > 0:
            home = np.degrees(postures[clear[0]]).tolist()
            values["campaign.home_deg"] = [round(angle, 3) + 0.0 for angle in home]
            notes = [] if checker.exceptions is None else [checker.exceptions]
            if floor is None:
                values["workspace.floor"] = "none"
                notes.append("no posture tried is clear of a floor at 0 m: no floor is assumed")
            break
    return Known.of_origin(ASSUMED, values, notes)


def _limits(known: Known) -> JointLimits:
    """Return the limits of position; others do not matter."""
    lower, upper = (np.radians(known.values[f"limits.{end}_deg"]) for end in ("lower", "upper"))
    return JointLimits(lower, upper, *np.ones((3, len(lower))))


def _turned(home: Array, limits: JointLimits) -> Iterator[Array]:
    """Yield the home posture, and those with joints turned by 90° within the limits."""
    for n in range(_TURNED + 1):
        for joints in combinations(range(len(home)), n):
            for turns in product((-0.5 * np.pi, 0.5 * np.pi), repeat=n):
                posture = home.copy()
                posture[[*joints]] += turns
                if np.all((posture > limits.lower) & (posture < limits.upper)):
                    yield posture
