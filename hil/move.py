"""One straight way to a posture: planned from where the arm stands, checked, sent, archived."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.events import MotionEnded
from hil.campaign.errors import MotionRefusedError
from hil.campaign.intervals import Interval, player_of, way
from hil.campaign.motion_link import MotionLink, active_checks
from hil.campaign.operator import MotionWatch, Stop, unwatched_motion
from hil.campaign.plan import moves_to_dict
from hil.cell import AngleFrame, Cell
from hil.errors import InputError
from hil.motion_checks import MotionChecks
from hil.recording import archive_spec, kind_entry, origin_of
from planner import FourierSeries, PiecewiseCubic

Array = NDArray[np.float64]

_ROUND: Final = 0.1
"""deg; via points drawn at random are as round as those a person teaches."""
THERE = 1e-4
"""rad; an arm that is so near to a posture is there."""


@dataclass(frozen=True, eq=False)
class Way:
    """A way that passed every check.

    Attributes:
        start: (n,) rad, where the arm stood when it was planned.
        target: (n,) rad.
        interval: the motion, and what it was planned from.
        speed: fraction of the joints' speeds.
        checks: that it passed.
    """

    start: Array
    target: Array
    interval: Interval
    speed: float
    checks: MotionChecks

    @property
    def trajectory(self) -> PiecewiseCubic | FourierSeries:
        """The motion."""
        return self.interval.trajectory

    @property
    def duration(self) -> float:
        """How long it takes at full speed [s]."""
        return self.trajectory.duration

    @property
    def not_checked(self) -> str:
        """What the check of contacts leaves out, in words; "" for nothing."""
        return self.checks.not_checked or ""


def random_via_points(cell: Cell, frame: AngleFrame, count: int, seed: int) -> Array:
    """The home posture, or the middle of the limits, and points within the limits (1 + m, n) [rad].

    Args:
        cell: whose limits.
        frame: angles in which they are round.
        count: points m.
        seed: the same gives the same points.
    """
    limits = cell.joint_limits
    ends = np.sort([frame.shown(limits.lower), frame.shown(limits.upper)], axis=0)
    shares = np.random.default_rng(seed).random((count, limits.n_joints))
    shown = ends[0] + shares * (ends[1] - ends[0])
    shown = np.clip(np.round(shown / _ROUND) * _ROUND, *ends)
    home = cell.home if cell.file.campaign is not None else (limits.lower + limits.upper) / 2.0
    return np.vstack((home, frame.urdf(shown)))


def posture(cell: Cell, text: str, excitation_start: Array | None = None) -> Array:
    """The posture (n,) [rad, URDF angles] that a word or a list of degrees names.

    Args:
        cell: whose arm.
        text: "home"; "start": where the excitation begins, home without one; or degrees in the
            frame of the cell's [limits], apart by commas or blanks.
        excitation_start: (n,) rad, of a campaign.

    Raises:
        InputError: it names no posture.
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
            f"{text!r} is no posture",
            field="--to",
            remedy=f"give start, home, or {n} angles in degrees apart by commas",
        )
    return AngleFrame.of(cell).urdf(degrees)


def turned(cell: Cell, start: Array, joint: str, degrees: float) -> Array:
    """`start` (n,) [rad] with one joint further by `degrees` of the frame of [limits].

    Args:
        cell: whose arm.
        start: where it stands.
        joint: its name, or its number from 1.
        degrees: how far.

    Raises:
        InputError: there is no such joint.
    """
    target = start.copy()
    index = joint_index(cell, joint, "--joint")
    target[index] += np.radians(degrees) * AngleFrame.of(cell).sign[index]
    return target


def joint_index(cell: Cell, joint: str, field: str) -> int:
    """Index, from 0, of a joint given by its name, or its number from 1.

    Raises:
        InputError: there is no such joint.
    """
    names = cell.joint_names
    numbers = {str(number): index for index, number in enumerate(range(1, len(names) + 1))}
    index = numbers.get(joint, names.index(joint) if joint in names else None)
    if index is None:
        raise InputError(
            None,
            f"{joint!r} is no joint",
            field=field,
            remedy=f"name one of {', '.join(names)}",
        )
    return index


def axis_alone(cell: Cell, joint: str | None) -> int:
    """Number, from 1, of the axis that moves a joint by itself.

    Raises:
        InputError: no joint is named, or a wrist coupling turns further motors with it.
    """
    if joint is None:
        raise InputError(
            None, "which axis is open?", field="--only-axis", remedy="give --joint and --by"
        )
    index = joint_index(cell, joint, "--joint")
    motors = np.flatnonzero(cell.drive_train.motor_from_joint[:, index]) + 1
    if motors.tolist() != [index + 1]:
        raise InputError(
            None,
            f"joint {index + 1} moves by the motors of axes {', '.join(map(str, motors))}",
            field="--only-axis",
            remedy="move another joint first, or open all axes",
        )
    return index + 1


def straight_way(
    cell: Cell,
    start: Array,
    target: Array,
    *,
    speed: float | None = None,
    checks: MotionChecks | None = None,
) -> Way:
    """Plan the straight way in joint space between two postures, and check it.

    Args:
        cell: limits, workspace and nominal model.
        start: (n,) rad.
        target: (n,) rad.
        speed: fraction of the joints' speeds; the cell's `approach_speed` if left out.
        checks: the cell's if left out; `active_checks` has those with a connected controller's
            own limits, which `send` asks for again.

    Raises:
        MotionRefusedError: it breaks a limit, touches something or needs too much current.
        PlannerError: the solver crashed, or found no way.
    """
    checks = checks or MotionChecks.of(cell)
    speed = cell.campaign.approach_speed if speed is None else speed
    planned = way(cell, start, target, speed)
    _require(checks, planned.trajectory)
    return Way(start, target, planned, speed, checks)


def send(
    planned: Way,
    cell: Cell,
    link: MotionLink,
    path: Path,
    *,
    stop: Stop,
    watch: MotionWatch = unwatched_motion,
    durable: bool = True,
) -> MotionEnded:
    """Run a way on a connected link and archive every cycle of it.

    Args:
        planned: what passed its checks.
        cell: travels in the archive.
        link: connected.
        path: of the archive, which must not exist.
        stop: brings the arm to rest on the way.
        watch: sees the motion, and may slow and hold it.
        durable: wait at each flush until the disk has the data.

    Raises:
        MotionRefusedError: the controller announces a current limit below the cell's, and the way
            needs more.
        ControllerFault: it was not accepted (nothing moved), or the link broke.
        ArchiveWriteError: the archive cannot be written; the arm was stopped.
    """
    checks = active_checks(cell, link.connection, planned.checks)
    if checks is not planned.checks:
        _require(checks, planned.trajectory)
    spec = archive_spec(
        cell,
        path,
        {**kind_entry(path, "move"), **origin_of(cell, only_simulated=link.only_simulated)},
        {"trajectory": planned.trajectory.to_dict(), **moves_to_dict(planned.interval.moves)},
        durable=durable,
    )
    return link.run(player_of(cell, planned.trajectory), spec, stop, watch=watch)


def _require(checks: MotionChecks, trajectory: PiecewiseCubic | FourierSeries) -> None:
    if (problem := checks.refusal(trajectory)) is not None:
        remedy = "go slower or by way of another posture, or jog the arm"
        raise MotionRefusedError("the way", problem, remedy)
