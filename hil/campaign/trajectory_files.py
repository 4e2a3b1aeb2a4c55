"""Designed motions as files for controllers that `hil` does not drive.

Tables (CSV), ROS 2's `trajectory_msgs/JointTrajectory` and, for arms of six turning joints,
URScript.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hil.cell import Cell
from hil.files import write_files
from identification.excitation import Excitation
from planner import Trajectory, to_csv

from .plan import CampaignPlan, plan_around

RATE: Final = 500.0  # Rate of the tables, Hz: the cycle of an e-Series controller
ROS_RATE: Final = 100.0  # Rate of the points that a trajectory controller interpolates, Hz
SCRIPT_RATE: Final = 125.0  # Rate of the set-points of a URScript program, Hz
UR_JOINTS: Final = 6


def write_trajectories(root: Path, cell: Cell, excitation: Excitation) -> tuple[str, ...]:
    """Write a designed motion and validation motions into a folder; return the file names.

    Raises:
        MotionRefusedError: the motion breaks a constraint of the cell.
        NoExcitationError: no validation motion satisfies the constraints.
        OutputError: the folder cannot be written to; nothing in it was changed.
    """
    files = trajectory_files(cell, plan_around(cell, excitation))
    write_files(root, files)
    return tuple(files)


def trajectory_files(cell: Cell, plan: CampaignPlan) -> dict[str, str]:
    """Return the texts of all motions of a plan by file name."""
    motions = {"excitation": plan.excitation.trajectory}
    motions |= {f"validation_{k:03d}": one.trajectory for k, one in enumerate(plan.validation)}
    scripted = len(cell.joint_names) == UR_JOINTS and bool(cell.model.chain.revolute.all())
    files = {}
    for name, motion in motions.items():
        files[f"{name}.csv"] = to_csv(motion, RATE, cell.joint_names)
        files[f"{name}.yaml"] = joint_trajectory(motion, cell.joint_names)
        if scripted:
            files[f"{name}.script"] = urscript(motion, name, cell.campaign.repetitions)
    return files


def joint_trajectory(motion: Trajectory, joint_names: tuple[str, ...]) -> str:
    """Return a motion as YAML of a `trajectory_msgs/msg/JointTrajectory`."""
    lines = ["header: {stamp: {sec: 0, nanosec: 0}, frame_id: ''}"]
    lines += [f"joint_names: {json.dumps(list(joint_names))}", "points:"]
    times = _times(motion, ROS_RATE)
    for time, q, qd, qdd in zip(times, *motion.sample(times), strict=True):
        seconds, nanoseconds = divmod(round(time * 1e9), 1_000_000_000)
        lines += [
            f"- positions: {json.dumps((q + 0.0).tolist())}",
            f"  velocities: {json.dumps((qd + 0.0).tolist())}",
            f"  accelerations: {json.dumps((qdd + 0.0).tolist())}",
            f"  time_from_start: {{sec: {seconds}, nanosec: {nanoseconds}}}",
        ]
    return "\n".join(lines) + "\n"


def urscript(motion: Trajectory, name: str, repetitions: int) -> str:
    """Return a URScript program that repeats a motion of six joints, at rest in between."""
    cycle, positions = 1.0 / SCRIPT_RATE, motion.sample(_times(motion, SCRIPT_RATE))[0]
    rows = [f"[{', '.join(f'{value:.9f}' for value in q)}]" for q in positions]
    lines = [
        f"def {name}():",
        f"  movej({rows[0]}, a=0.5, v=0.2)",
        "  repetition = 0",
        f"  while repetition < {repetitions}:",
        *(f"    servoj({row}, 0, 0, {cycle:g}, 0.03, 500)" for row in rows),
        "    stopj(5.0)",
        f"    movej({rows[0]}, a=0.5, v=0.2)",
        "    sleep(1.0)",
        "    repetition = repetition + 1",
        "  end",
        "end",
    ]
    return "\n".join(lines) + "\n"


def _times(motion: Trajectory, rate: float) -> NDArray[np.float64]:
    """Return times (m,) [s] from start to end; the last step may be shorter."""
    steps = np.arange(0.0, motion.duration - 0.5 / rate, 1.0 / rate)
    return np.append(steps, motion.duration)
