"""Whether anything can be concluded from an imported recording, or identified from it."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from hil.archive import Archive
from hil.base.errors import SourceError

_SHORTEST: Final = 1.0  # s


def require_motion(archive: Archive, recording: Path) -> None:
    """Check that a recording has a motion, and torques that vary if it has any.

    Raises:
        SourceError: it is shorter than a second, no joint moves, or all torques are constant.
    """
    columns = archive.columns
    stamp = columns["stamp"]
    duration = float(stamp[-1] - stamp[0]) * 1e-9
    if duration < _SHORTEST:
        samples = f"{len(stamp)} {'sample' if len(stamp) == 1 else 'samples'}"
        problem = f"has {samples} in {duration:.3g} s, too few to identify from"
        remedy = "record a motion of all joints, of 10 s or more"
        raise SourceError(recording, problem, remedy=remedy)
    if not np.ptp(np.asarray(columns["position"]), axis=0).any():
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
