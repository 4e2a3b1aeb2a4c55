"""Limits of the joints of an arm, as its URDF states them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from identification.arrays import Array
from identification.model.urdf_text import urdf_tree

_MIN_ABSENT_LIMIT: Final = 1e4  # some URDFs have larger figures for "none"


class JointRanges(NamedTuple):
    """Limits of joints (n,): rad or m, per second, and N·m or N; infinite if unknown."""

    lower: Array
    upper: Array
    velocity: Array
    effort: Array


def urdf_limits(urdf: str, joint_names: Sequence[str]) -> JointRanges:
    """Read the limits of joints.

    A range is not stated where it is absent or empty: lower and upper both 0, or exchanged. A speed
    or effort is not stated where it is absent, 0, negative, or above 1e4.
    """
    joints = {joint.get("name"): joint for joint in urdf_tree(urdf).findall("joint")}
    rows = []
    for name in joint_names:
        limit = joints[name].find("limit")
        stated = {} if limit is None else limit.attrib
        turns = joints[name].get("type") == "continuous"
        lower, upper, velocity, effort = (
            float(stated.get(key, 0.0)) for key in ("lower", "upper", "velocity", "effort")
        )
        if turns or not lower < upper:
            lower = -math.inf
            upper = math.inf
        rows.append((lower, upper, _stated(velocity), _stated(effort)))
    return JointRanges(*np.array(rows, dtype=np.float64).reshape(-1, 4).T)


def _stated(figure: float) -> float:
    """Return a limit of speed or effort, infinite if the figure is none."""
    return figure if 0.0 < figure < _MIN_ABSENT_LIMIT else math.inf
