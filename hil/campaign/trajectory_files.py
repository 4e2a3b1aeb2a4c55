"""Designed motions as files for controllers that `hil` does not drive.

Tables (CSV), ROS 2's `trajectory_msgs/JointTrajectory` and, for arms of six turning joints,
URScript; and a player of the tables for a Universal Robots arm by ur_rtde.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hil.cell import Cell
from hil.files import write_files
from hil.motion_checks import MotionChecks
from identification.excitation import Excitation
from planner import Trajectory, to_csv

from .plan import CampaignPlan, plan_around

Array = NDArray[np.float64]

PLAYER: Final = "play_ur.py"
RATE: Final = 500.0  # Rate of the tables, Hz: the cycle of an e-Series controller
ROS_RATE: Final = 100.0  # Rate of the points that a trajectory controller interpolates, Hz
SCRIPT_RATE: Final = 125.0  # Rate of the set-points of a URScript program, Hz
UR_JOINTS: Final = 6

_PLAYER: Final = '''\
"""Play a motion on a Universal Robots arm and log it: play_ur.py HOST MOTION.csv LOG.csv"""
import sys
from pathlib import Path
from rtde_control import RTDEControlInterface
from rtde_receive import RTDEReceiveInterface
host, motion, log = sys.argv[1:]
lines = Path(motion).read_text().splitlines()[1:]
rows = [[float(x) for x in line.split(",")] for line in lines]
cycle = rows[1][0] - rows[0][0]
control, receive = RTDEControlInterface(host, 1 / cycle), RTDEReceiveInterface(host, 1 / cycle)
control.moveJ(rows[0][1::3], 0.2, 0.2)  # slowly to the start: keep a hand on the stop
receive.startFileRecording(log, ["timestamp", "actual_q", "actual_current", "target_moment"])
for row in rows:
    start = control.initPeriod()
    control.servoJ(row[1::3], 0, 0, cycle, 0.03, 500)
    control.waitPeriod(start)
control.servoStop()
receive.stopFileRecording()
'''


def write_trajectories(root: Path, cell: Cell, excitation: Excitation) -> tuple[str, ...]:
    """Write a designed motion and validation motions into a folder; return the file names.

    Raises:
        MotionRefusedError: the motion breaks a constraint of the cell.
        NoExcitationError: no validation motion satisfies the constraints.
        OutputError: the folder cannot be written to; nothing in it was changed.
    """
    plan = plan_around(cell, excitation, MotionChecks.of(cell))
    files = trajectory_files(cell, plan)
    write_files(root, files)
    return tuple(files)


def trajectory_files(cell: Cell, plan: CampaignPlan) -> dict[str, str]:
    """Return the texts of all motions of a plan and of the player by file name."""
    motions = {"excitation": plan.excitation.trajectory}
    for number, motion in enumerate(plan.validation):
        motions[f"validation_{number:03d}"] = motion.trajectory
    scripted = len(cell.joint_names) == UR_JOINTS and bool(cell.model.chain.revolute.all())
    files = {}
    for name, trajectory in motions.items():
        files[f"{name}.csv"] = to_csv(trajectory, RATE, cell.joint_names)
        files[f"{name}.yaml"] = joint_trajectory(trajectory, cell.joint_names)
        if scripted:
            files[f"{name}.script"] = urscript(trajectory, name, cell.campaign.repetitions)
    if scripted:
        files[PLAYER] = _PLAYER
    return files


def joint_trajectory(trajectory: Trajectory, joint_names: tuple[str, ...]) -> str:
    """Return a motion as YAML of a `trajectory_msgs/msg/JointTrajectory`."""

    def points() -> Iterator[str]:
        time = _times(trajectory, ROS_RATE)
        for t, *motion in zip(time, *trajectory.sample(time), strict=True):
            nanoseconds = round(t * 1e9)
            for mark, key, values in zip(
                "-  ", ("positions", "velocities", "accelerations"), motion, strict=True
            ):
                yield f"{mark} {key}: {json.dumps((values + 0.0).tolist())}"
            seconds, rest = divmod(nanoseconds, 1_000_000_000)
            yield f"  time_from_start: {{sec: {seconds}, nanosec: {rest}}}"

    head = ["header: {stamp: {sec: 0, nanosec: 0}, frame_id: ''}"]
    head += [f"joint_names: {json.dumps(list(joint_names))}", "points:"]
    return "\n".join([*head, *points()]) + "\n"


def urscript(trajectory: Trajectory, name: str, repetitions: int) -> str:
    """Return a URScript program that repeats a motion of six joints, at rest in between."""
    cycle = 1.0 / SCRIPT_RATE
    positions = trajectory.sample(_times(trajectory, SCRIPT_RATE))[0]
    lines = [
        f"def {name}():",
        f"  movej({_list(positions[0])}, a=0.5, v=0.2)",
        "  repetition = 0",
        f"  while repetition < {repetitions}:",
        *(f"    servoj({_list(q)}, 0, 0, {cycle:g}, 0.03, 500)" for q in positions),
        "    stopj(5.0)",
        f"    movej({_list(positions[0])}, a=0.5, v=0.2)",
        "    sleep(1.0)",
        "    repetition = repetition + 1",
        "  end",
        "end",
    ]
    return "\n".join(lines) + "\n"


def _times(trajectory: Trajectory, rate: float) -> Array:
    """Return times (m,) [s] from start to end; the last step may be shorter."""
    steps = np.arange(0.0, trajectory.duration, 1.0 / rate)
    return np.append(steps[: -1 if trajectory.duration - steps[-1] < 0.5 / rate else None],
                     trajectory.duration)  # fmt: skip


def _list(values: Array) -> str:
    return "[" + ", ".join(f"{value:.9f}" for value in values) + "]"
