"""Whether anything can be concluded from an imported recording, or identified from it."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from hil.archive import Archive
from hil.base.arrays import Array
from hil.base.errors import SourceError
from hil.importers.plausibility import command_size
from hil.importers.stamps import MIN_SECONDS
from identification.signals.poses import poses_without_motion
from identification.text import duration_text

_COPIED: Final = 0.999  # of the rows
_COPIED_LATER: Final = 0.98  # of the rows in which commands change
_MOST_SAMPLES_LATER: Final = 3
_FARTHEST: Final = 10.0  # factor between the travels of joints and of their commands


def require_motion(archive: Archive, recording: Path) -> None:
    """Check that a recording has a motion, and torques that vary if it has any.

    Raises:
        SourceError: it is shorter than a second, no joint moves, it has poses at rest alone, or all
            torques are constant.
    """
    columns = archive.columns
    stamp = columns["stamp"]
    duration = float(stamp[-1] - stamp[0]) * 1e-9
    if duration < MIN_SECONDS:
        samples = f"{len(stamp)} {'sample' if len(stamp) == 1 else 'samples'}"
        problem = f"has {samples} in {duration_text(duration)}, too few to identify from"
        remedy = "record a motion of all joints, of 10 s or more"
        raise SourceError(recording, problem, remedy=remedy)
    position = np.asarray(columns["position"])
    if "torque" in columns and (poses := poses_without_motion(position)) is not None:
        problem = (
            f"has {poses} poses at rest but not the motion between them: friction at rest may have"
            " any value within its Coulomb torque, so that gravity cannot be separated from it, and"
            " nothing shows inertia"
        )
        remedy = "record the moves between the poses as well; the rests may stay in the recording"
        raise SourceError(recording, problem, remedy=remedy)
    if not np.ptp(position, axis=0).any():
        problem = "no joint moves: every position is constant"
        remedy = "check which channels hold the measured positions (--columns 'position=NAME{}')"
        raise SourceError(recording, problem, field="position", remedy=remedy)
    if "torque" not in columns:
        return
    torque = np.asarray(columns["torque"])
    if not np.ptp(torque, axis=0).any():
        values = ", ".join(f"{value:g}" for value in torque[0])
        problem = f"the torque of each joint is constant ({values})"
        remedy = "check which channels hold the measured torque (--columns 'torque=NAME{}')"
        raise SourceError(recording, problem, field="torque", remedy=remedy)


def has_servo(archive: Archive) -> bool:
    """Return whether an archive has commanded positions, and neither torques nor currents."""
    columns = archive.columns
    currents = {"target_current", "motor_current"}
    return "commanded_position" in columns and not columns.keys() & {"torque", *currents}


def require_commands(archive: Archive, recording: Path, *, fitted: bool) -> None:
    """Check that the recording has the commands and measured positions of a servo.

    Args:
        archive: of a recording.
        recording: from which it was read.
        fitted: whether its servo is to be found, not only predicted.

    Raises:
        SourceError: positions are the commands themselves, or move farther by a factor of ten or
            less far; or no command changes in what is fitted.
    """
    position, commanded = (
        np.asarray(archive.columns[name], np.float64) for name in ("position", "commanded_position")
    )
    known = np.isfinite(commanded).all(axis=1)
    position, commanded = position[known], commanded[known]
    field = "commanded_position"
    if not len(commanded):
        problem = "has no part in which the commanded positions are known"
        remedy = "record the commanded positions, or name them (--columns)"
        raise SourceError(recording, problem, field=field, remedy=remedy)
    if fitted and not np.ptp(commanded, axis=0).any():
        problem = "no command changes, so that no servo can be identified"
        remedy = "record motion from commands, or name their channels (--columns)"
        raise SourceError(recording, problem, field=field, remedy=remedy)
    if np.ptp(position, axis=0).any() and np.mean((position == commanded).all(axis=1)) >= _COPIED:
        problem = "the positions equal the commands bit for bit: they were not measured"
        remedy = "record or name measured positions (--columns 'position=NAME{}')"
        raise SourceError(recording, problem, field="position", remedy=remedy)
    if (later := _samples_later(position, commanded)) is not None:
        samples = "the next sample" if later == 1 else f"{later} samples later"
        problem = (
            f"the commands are the positions of {samples}, bit for bit: they were copied, not"
            " commanded"
        )
        remedy = "record the commands themselves (of LeRobot: what was sent to the motors)"
        raise SourceError(recording, problem, field=field, remedy=remedy)
    size = command_size(position, commanded)
    if fitted and size is not None and not 1.0 / _FARTHEST < size < _FARTHEST:
        problem = f"the commands move {size:.3g} times as far as the positions"
        remedy = "check channels and units of both (--columns, or a map with units: --map)"
        raise SourceError(recording, problem, field=field, remedy=remedy)


def _samples_later(position: Array, commanded: Array) -> int | None:
    """Return how many samples later the positions (m, n) are the commands; None: they never are.

    As in data sets whose actions were made of the states.
    """
    for later in range(1, _MOST_SAMPLES_LATER + 1):
        before, after = commanded[:-later], position[later:]
        moving = np.append(False, (np.diff(before, axis=0) != 0.0).any(axis=1))
        if moving.any() and np.mean((before == after).all(axis=1)[moving]) >= _COPIED_LATER:
            return later
    return None


def require_torque(archive: Archive, recording: Path) -> None:
    """Check that a recording has joint torques, or commanded positions in their place.

    Raises:
        SourceError: it has motor currents only, or not even these.
    """
    columns = archive.columns
    if "torque" in columns:
        return
    if has_servo(archive):
        return
    if "motor_current" not in columns:
        problem = "has neither joint torques nor motor currents"
        remedy = "record them, or the commanded positions, from which servo and friction follow"
        raise SourceError(recording, problem, field="torque", remedy=remedy)
    problem = "has motor currents and no joint torque"
    remedy = (
        "`hil import log` writes its column map: add [drive] torque_constant = [...] (N·m/A, "
        "gears included, one for each joint) and give it with --map; or measure the constants "
        "(`hil torque-constants`)"
    )
    raise SourceError(recording, problem, field="torque", remedy=remedy)
