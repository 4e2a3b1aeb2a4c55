"""Straight motion in joint space to a posture: planned, checked, executed and archived."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from drivers.events import MotionEnded
from hil.base.arrays import Array
from hil.base.errors import InputError
from hil.cell import AngleFrame, Cell
from hil.control.connection import active_checks
from hil.control.errors import MotionRefusedError
from hil.control.link import MotionLink
from hil.control.messages import refusal_words
from hil.control.motion_checks import MotionChecks
from hil.control.motion_watch import MotionWatch, Stop, unwatched_motion
from hil.control.motions import CampaignMotion, moves_to_dict, player_of, straight_move
from hil.control.record import archive_spec, kind_entry, origin_of
from hil.control.slips import CHECKED_OUTCOMES, require_no_slip
from planner import FourierSeries, PiecewiseCubic

_VIA_POINT_RESOLUTION: Final = 0.1
"""Resolution of random via points, deg."""
POSTURE_TOLERANCE = 1e-4
"""Distance below which an arm is at a posture, rad."""


@dataclass(frozen=True, eq=False)
class CheckedMove:
    """A straight motion that passed all `checks`, from `start` to `target` (n,) [rad]."""

    start: Array
    target: Array
    motion: CampaignMotion
    speed: float
    checks: MotionChecks

    @property
    def duration(self) -> float:
        """Duration at full speed [s]."""
        return self.motion.trajectory.duration


def random_via_points(cell: Cell, frame: AngleFrame, count: int, seed: int) -> Array:
    """Return home (or mid-range) and random points in the limits (1 + m, n) [rad].

    Args:
        cell: of the arm.
        frame: of the angles.
        count: of the random points.
        seed: of these.
    """
    limits = cell.joint_limits
    ends = np.sort([frame.shown(limits.lower), frame.shown(limits.upper)], axis=0)
    shares = np.random.default_rng(seed).random((count, limits.n_joints))
    shown = ends[0] + shares * (ends[1] - ends[0])
    shown = np.clip(np.round(shown / _VIA_POINT_RESOLUTION) * _VIA_POINT_RESOLUTION, *ends)
    home = cell.home if cell.file.campaign is not None else (limits.lower + limits.upper) / 2.0
    return np.vstack((home, frame.urdf(shown)))


def posture(cell: Cell, text: str, excitation_start: Array | None = None) -> Array:
    """Parse a posture (n,) [rad, URDF angles], else raise InputError.

    It is "home", "start" (of the excitation, (n,) rad, or home), or degrees in the frame of the
    cell's [limits], separated by commas or blanks.
    """
    if text == "home" or (text == "start" and excitation_start is None):
        return cell.home
    if text == "start" and excitation_start is not None:
        return excitation_start
    parts = text.replace(",", " ").split()
    try:
        degrees = np.array([float(part) for part in parts])
    except ValueError:
        degrees = np.array([])
    n = len(cell.joint_names)
    if len(degrees) != n or not np.isfinite(degrees).all():
        raise InputError(
            None,
            f"{text!r} is not a posture",
            field="--to",
            remedy=f"give start, home, or {n} angles in degrees separated by commas",
        )
    return AngleFrame.of(cell).urdf(degrees)


def turned(cell: Cell, start: Array, joint: str, degrees: float) -> Array:
    """Return a posture (n,) [rad] with one joint turned.

    Args:
        cell: of the arm.
        start: posture (n,) [rad].
        joint: its name.
        degrees: by which it turns, in the frame of [limits].
    """
    target = start.copy()
    index = joint_index(cell, joint, "--joint")
    target[index] += np.radians(degrees) * AngleFrame.of(cell).sign[index]
    return target


def joint_index(cell: Cell, joint: str, field: str) -> int:
    """Return the index of a joint given by name, or by number from 1; else InputError."""
    names = cell.joint_names
    numbers = {str(number): index for index, number in enumerate(range(1, len(names) + 1))}
    index = numbers.get(joint, names.index(joint) if joint in names else None)
    if index is None:
        raise InputError(
            None,
            f"{joint!r} is not a joint",
            field=field,
            remedy=f"use one of {', '.join(names)}",
        )
    return index


def axis_alone(cell: Cell, joint: str | None) -> int:
    """Return the number, from 1, of the only axis that moves a joint; else InputError."""
    if joint is None:
        raise InputError(None, "needs a joint", field="--only-axis", remedy="give --joint and --by")
    index = joint_index(cell, joint, "--joint")
    motors = np.flatnonzero(cell.drive_train.motor_from_joint[:, index]) + 1
    if motors.tolist() != [index + 1]:
        raise InputError(
            None,
            f"{cell.joint_names[index]} is moved by the motors of axes "
            f"{', '.join(map(str, motors))}",
            field="--only-axis",
            remedy="move another joint first, or open all axes",
        )
    return index + 1


def plan_move(
    cell: Cell,
    start: Array,
    target: Array,
    *,
    speed: float | None = None,
    checks: MotionChecks | None = None,
) -> CheckedMove:
    """Plan and check a straight motion in joint space between two postures.

    Args:
        cell: of the arm.
        start: posture (n,) [rad].
        target: posture (n,) [rad].
        speed: fraction of the joints' speeds, by default the cell's `approach_speed`.
        checks: by default the cell's; `send` applies those with the limits of the connected
            controller again.

    Raises:
        MotionRefusedError: it violates a limit, collides or needs too much current.
        PlannerError: the solver crashed, or found no motion.
    """
    checks = checks or MotionChecks.of(cell)
    speed = cell.campaign.approach_speed if speed is None else speed
    planned = straight_move(cell, start, target, speed)
    _require(checks, planned.trajectory)
    return CheckedMove(start, target, planned, speed, checks)


def send(
    planned: CheckedMove,
    cell: Cell,
    link: MotionLink,
    path: Path,
    *,
    stop: Stop,
    watch: MotionWatch = unwatched_motion,
    durable: bool = True,
) -> MotionEnded:
    """Execute a motion on a connected link and archive every cycle.

    Args:
        planned: the motion.
        cell: of the arm.
        link: to the controller.
        path: of the new archive.
        stop: stops the arm on its path.
        watch: shows the motion, and may slow and hold it.
        durable: each flush waits for the disk.

    Raises:
        MotionRefusedError: the motion needs more current than the controller's limit.
        ControllerError: it was not accepted (nothing moved), or the link failed.
        ArchiveWriteError: the archive cannot be written; the arm was stopped.
        SlippedError: a measured position slipped.
    """
    checks = active_checks(cell, link.connection, planned.checks)
    if checks is not planned.checks:
        _require(checks, planned.motion.trajectory)
    spec = archive_spec(
        cell,
        path,
        {**kind_entry(path, "move"), **origin_of(cell, only_simulated=link.only_simulated)},
        {
            "trajectory": planned.motion.trajectory.to_dict(),
            **moves_to_dict(planned.motion.moves),
        },
        durable=durable,
    )
    ended = link.run(player_of(cell, planned.motion.trajectory), spec, stop, watch=watch)
    if ended.outcome in CHECKED_OUTCOMES and path.exists():
        require_no_slip("the motion", path)
    return ended


def _require(checks: MotionChecks, trajectory: PiecewiseCubic | FourierSeries) -> None:
    if (refusal := checks.refusal(trajectory)) is not None:
        problem = refusal_words(refusal, checks.frame)
        remedy = "reduce the speed, move via another posture, or jog the arm"
        raise MotionRefusedError("the motion", problem, remedy)
