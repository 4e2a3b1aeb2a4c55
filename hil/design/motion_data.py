"""A designed motion as plain data: its moves, from which it is planned again, or its sines."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from identification.excitation import Excitation
from planner import FourierSeries, JointLimits, PiecewiseCubic, PlanFile, in_child

from .toml_text import Angles

_ANGLES = ("lower", "upper", "velocity", "acceleration", "jerk")


def motion_data(
    excitation: Excitation, joint_names: Sequence[str], limits: JointLimits
) -> dict[str, Any]:
    """Return the table `plan` (as a plan file has it, without the motion) or `sines`."""
    trajectory = excitation.trajectory
    if isinstance(trajectory, FourierSeries):
        data = {"joints": list(joint_names)} | trajectory.to_dict()
        for name in ("offset", "amplitude"):
            data[name] = Angles(data[name])
        return {"sines": data}
    moves, points = excitation.moves, excitation.via_points
    if moves is None or points is None:
        raise ValueError("a motion in pieces without its moves cannot be written down")
    plan = PlanFile(tuple(joint_names), points[0], moves, limits=limits).to_dict()
    plan["start"] = Angles(plan["start"])
    plan["limits"] = {name: Angles(plan["limits"][name]) for name in _ANGLES}
    plan["moves"] = [{**move, "target": Angles(move["target"])} for move in plan["moves"]]
    return {"plan": plan}


def motion_from_data(data: Mapping[str, Any], fly: float | None) -> dict[str, Any]:
    """Return the trajectory, and what it was planned from, as arguments of an `Excitation`.

    Args:
        data: the whole file, which holds one of the two tables.
        fly: how far corners are rounded, as the settings say.

    Raises:
        KeyError, TypeError, ValueError, PlannerError: the data are no motion.
    """
    if "sines" in data:
        sines = {name: value for name, value in data["sines"].items() if name != "joints"}
        return {"trajectory": FourierSeries.from_dict(sines)}
    file = PlanFile.from_dict(data["plan"])
    speed = file.moves[0].joint_speed
    if fly is None or speed is None:
        raise ValueError("the moves lack fly or speed")
    points = np.array([file.start, *(move.target for move in file.moves)])
    planned = in_child(file.plan)  # the solver can take its process with it
    return {
        "trajectory": planned.trajectory,
        "via_points": points,
        "speed": np.broadcast_to(np.asarray(speed, dtype=np.float64), points[0].shape).copy(),
        "fly": fly,
    }


def joints_of(data: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the joints that a motion is for."""
    return tuple(data["sines" if "sines" in data else "plan"]["joints"])


def motion_digest(trajectory: PiecewiseCubic | FourierSeries) -> str:
    """Return what two motions share only if they are the same to the last bit."""
    return hashlib.sha256(json.dumps(trajectory.to_dict()).encode()).hexdigest()
