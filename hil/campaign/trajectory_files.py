"""Designed motions as files for controllers that `hil` does not drive.

Tables (CSV), ROS 2's `trajectory_msgs/JointTrajectory` and, for arms of six turning joints,
URScript. Tables and ROS 2 files have a slow variant, `NAME_slow`; a URScript program has a variable
for its speed, is slow at first, and asks before it moves.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from hil.base.arrays import Array
from hil.base.files import write_files
from hil.base.version import software
from hil.cell import Cell
from identification.excitation import Excitation
from identification.text import percentage
from planner import Trajectory, to_csv

from .plan import CampaignPlan, plan_around

TABLE_RATE: Final = 500.0  # Rate of the tables, Hz: the cycle of an e-Series controller
ROS_RATE: Final = 100.0  # Rate of the points that a trajectory controller interpolates, Hz
SCRIPT_RATE: Final = 125.0  # Rate of the set-points of a URScript program, Hz
UR_JOINTS: Final = 6
SLOW_SPEED_SHARE: Final = 0.2  # Speed of the slow variants, as a share of that of the motion
# Least speed of a URScript program, as a share of that of the motion
MIN_SCRIPT_SPEED: Final = 0.01
README: Final = "README.txt"
WARNING: Final = (
    "The arm will move. Only checked by the model: limits, torques, floor, walls, self-collision.",
    "Run the slow motion first, at the start posture, with a hand at the emergency stop.",
)


@dataclass(frozen=True)
class SlowedMotion:
    """A motion on the same path with its time stretched; `speed` is a share of its own speed."""

    motion: Trajectory
    speed: float

    @property
    def duration(self) -> float:
        """Duration [s]."""
        return self.motion.duration / self.speed

    @property
    def n_joints(self) -> int:
        """Number of joints."""
        return self.motion.n_joints

    def sample(self, time: ArrayLike) -> tuple[Array, Array, Array]:
        """Return positions, velocities and accelerations (m, n) at times (m,) [s]."""
        q, qd, qdd = self.motion.sample(
            np.minimum(np.asarray(time) * self.speed, self.motion.duration)
        )
        return q, self.speed * qd, self.speed**2 * qdd


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
    motions |= {
        f"validation_{k:03d}": validation.trajectory for k, validation in enumerate(plan.validation)
    }
    scripted = len(cell.joint_names) == UR_JOINTS and bool(cell.model.chain.revolute.all())
    files = {}
    described = []
    for name, motion in motions.items():
        slowed = SlowedMotion(motion, SLOW_SPEED_SHARE)
        for variant, moves in ((name, motion), (f"{name}_slow", slowed)):
            header = header_of(cell.name, variant, moves)
            described += [*header, ""]
            files[f"{variant}.csv"] = to_csv(moves, TABLE_RATE, cell.joint_names)
            files[f"{variant}.yaml"] = joint_trajectory(moves, cell.joint_names, header)
        if scripted:
            header = header_of(cell.name, name, motion)
            files[f"{name}.script"] = urscript(motion, name, cell.campaign.repetitions, header)
    files[README] = "\n".join([*described, *WARNING]) + "\n"
    return files


def header_of(arm: str, name: str, motion: Trajectory) -> tuple[str, ...]:
    """Return arm, duration and origin of a motion, one line each."""
    versions = software()
    at = f" at {percentage(motion.speed)} of the speed" if isinstance(motion, SlowedMotion) else ""
    return (
        f"{name}: a motion for {' '.join(arm.split())}",
        f"duration: {motion.duration:.2f} s{at}",
        f"made by: hil {versions['hil']}",
    )


def joint_trajectory(
    motion: Trajectory, joint_names: tuple[str, ...], header: Sequence[str]
) -> str:
    """Return a motion as YAML of a `trajectory_msgs/msg/JointTrajectory`."""
    lines = [f"# {line}" for line in (*header, *WARNING)]
    lines += ["header: {stamp: {sec: 0, nanosec: 0}, frame_id: ''}"]
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


def urscript(motion: Trajectory, name: str, repetitions: int, header: Sequence[str]) -> str:
    """Return a URScript program that repeats a motion of six joints, at rest in between.

    A slow motion has as many set-points per second as a fast one: each is `speed` of the way
    between two positions of the motion further than the one before.

    Args:
        motion: that is repeated.
        name: of the program.
        repetitions: of the motion.
        header: lines of a comment.
    """
    cycle = 1.0 / SCRIPT_RATE
    positions = motion.sample(_times(motion, SCRIPT_RATE))[0]
    rows = [f"[{', '.join(f'{value:.9f}' for value in q)}]" for q in positions]
    between = ", ".join(f"start[{j}] + share * (goal[{j}] - start[{j}])" for j in range(UR_JOINTS))
    at_start = [f"global start = {rows[0]}", "global share = speed"]
    valid = f"speed is {MIN_SCRIPT_SPEED:g} to 1"
    seconds = f"{motion.duration:.1f} s at full speed"
    question = f"{name}, {repetitions} times, {seconds}; speed and repetitions are set at the top"
    popup = f'"The arm will move: {question}. Continue?", "{name}", True, False, blocking=True'
    lines = [
        *(f"# {line}" for line in (*header, *WARNING)),
        "# speed scales time: 1.0 is the full speed of the motion. Raise it after a slow run.",
        f"def {name}():",
        f"  global speed = {SLOW_SPEED_SHARE:g}",
        f"  repetitions = {repetitions}",
        f"  if speed < {MIN_SCRIPT_SPEED:g} or speed > 1.0:",
        f'    popup("{valid}", "{name}", False, True, blocking=True)',
        "    halt",
        "  end",
        f"  popup({popup})",
        *(f"  {line}" for line in at_start),
        "  def move_on(goal):",
        "    while share <= 1.000001:",
        f"      servoj([{between}], 0, 0, {cycle:g}, 0.03, 500)",
        "      global share = share + speed",
        "    end",
        "    global share = share - 1.0",
        "    global start = goal",
        "  end",
        f"  movej({rows[0]}, a=0.5, v=0.2)",
        "  repetition = 0",
        "  while repetition < repetitions:",
        *(f"    move_on({row})" for row in rows),
        "    stopj(5.0)",
        f"    movej({rows[0]}, a=0.5, v=0.2)",
        *(f"    {line}" for line in at_start),
        "    sleep(1.0)",
        "    repetition = repetition + 1",
        "  end",
        "end",
    ]
    return "\n".join(lines) + "\n"


def _times(motion: Trajectory, rate: float) -> Array:
    """Return times (m,) [s] from start to end; the last step may be shorter."""
    steps = np.arange(0.0, motion.duration - 0.5 / rate, 1.0 / rate)
    return np.append(steps, motion.duration)
