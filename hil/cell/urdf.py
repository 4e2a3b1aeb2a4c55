"""What a URDF says about the range and speed of its joints."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.model.urdf_text import urdf_tree

Array = NDArray[np.float64]


class UrdfLimits(NamedTuple):
    """Limits per joint (n,), rad, rad/s and N·m; infinite where the URDF states none."""

    lower: Array
    upper: Array
    velocity: Array
    effort: Array


def urdf_limits(urdf: str, joint_names: Sequence[str]) -> UrdfLimits:
    """Limits of these joints, in their order; a speed or effort of 0 counts as not stated.

    Only the robot's own joints: a transmission names joints of the same name again.
    """
    joints = {joint.get("name"): joint for joint in urdf_tree(urdf).findall("joint")}
    rows = []
    for name in joint_names:
        limit = joints[name].find("limit")
        stated = {} if limit is None else limit.attrib
        turns = joints[name].get("type") == "continuous" or limit is None
        rows.append(
            (
                -math.inf if turns else float(stated.get("lower", 0.0)),
                math.inf if turns else float(stated.get("upper", 0.0)),
                float(stated.get("velocity", 0.0)) or math.inf,
                float(stated.get("effort", 0.0)) or math.inf,
            )
        )
    lower, upper, velocity, effort = np.array(rows, dtype=np.float64).T
    return UrdfLimits(lower, upper, velocity, effort)
