"""A run ends with a complete campaign, or with an error of `docs/campaign.md` and its remedy.

Any other end of a run is a defect.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from hil.errors import HilError
from planner import FourierSeries, PiecewiseCubic
from tests.simulate.observed import Life, Observed

from .archived import Archived, read
from .folders import WANTED, manifest_of
from .wire import Array

ALLOWED_ERRORS: Final = frozenset(
    (
        "ControllerError",  # the drive is off, or the init packet does not match the cell
        "MotionFailedError",  # the guard, the link or a stop ended a motion
        "MotionRefusedError",  # the path from the present position is not free: jog the arm
        "RepetitionsRejectedError",  # contact, slip, or a changed arm
        "DryRunError",  # the dry run is not accepted
        "AgainstGravityError",  # a torque is not accepted
        "OperatorStopError",  # stopped by the operator
        "ArchiveWriteError",  # the disk is full or broken
        "CampaignFolderError",  # the folder cannot be written
        "OutputError",  # results cannot be written
    )
)
"""Errors that may end a run."""
_DEATHS: Final = ("Killed", "KeyboardInterrupt")
_OFF_PATH: Final = 1e-4
"""Largest difference between set-point and plan [rad] (`hil.campaign.quality`)."""


def resume(observed: Observed) -> Iterator[str]:
    """Check the law of this module."""
    for number, life in enumerate(observed.runs, 1):
        yield from _ended(number, life)
    whole = _whole(observed)
    counts = (1, observed.cell.campaign.repetitions, len(observed.plan.validation))
    wanted = ((kind, i) for kind, n in zip(WANTED, counts, strict=True) for i in range(n))
    missing = [f"{kind} {index}" for kind, index in wanted if (kind, index) not in whole]
    if observed.complete and missing:
        yield f"the last run reports a complete campaign, and {', '.join(missing)} are missing"
    if not observed.complete and not missing:
        yield f"nothing is missing, and the last run ended {observed.ended}"
    for (kind, index), archived in whole.items():
        motion = _motion(observed, kind, index)
        if motion is not None:
            problem = _played(archived, motion, observed.cell.period)
            if problem:
                yield f"{archived.path.name} counts, and {problem}"


def _ended(number: int, life: Life) -> Iterator[str]:
    error = life.error
    if error is None:
        if life.result is None:
            yield f"life {number} ended without a result and without an error"
        return
    name = type(error).__name__
    if name in _DEATHS:
        return
    if not isinstance(error, HilError) or name not in ALLOWED_ERRORS:
        yield f"life {number} ended with {name}: {error}"


def _whole(observed: Observed) -> dict[tuple[str, int], Archived]:
    """Return the completed archives by kind and index."""
    completed = {}
    for entry in manifest_of(observed)[1]:
        if entry.outcome == "completed" and entry.unchanged and entry.motion[0] in WANTED:
            completed[entry.motion] = read(observed.folder / "archives" / entry.name)
    return completed


def _motion(observed: Observed, kind: str, index: int) -> PiecewiseCubic | FourierSeries | None:
    if kind == "excitation":
        return observed.plan.excitation.trajectory
    return observed.plan.validation[index].trajectory if kind == "validation" else None


def _played(
    archived: Archived, motion: PiecewiseCubic | FourierSeries, period: float
) -> str | None:
    """Return why a recording is not that of the complete motion at full speed, or None."""
    if archived.ended != "completed":
        return f"it ended {archived.ended!r}"
    q: Array = archived.cycles["commanded_position"]
    # Set-points that were not accepted were sent again with their velocity.
    waits = (np.diff(q, axis=0, prepend=np.nan) == 0.0).all(axis=1)
    waits &= (archived.cycles["commanded_velocity"] != 0.0).any(axis=1)
    q = q[np.isfinite(q).all(axis=1) & ~waits]
    count = int(np.ceil(motion.duration / period)) + 1
    times: Array = np.arange(count, dtype=np.float64) * period
    planned = motion.sample(times)[0]
    moves = np.flatnonzero((np.diff(q, axis=0) != 0.0).any(axis=1))
    if not moves.size:
        return "nothing moves in it"
    # The first steps of a motion may be below the resolution.
    for first in range(max(0, int(moves[0]) - 5), int(moves[0]) + 1):
        part = q[first : first + len(planned)]
        off = np.abs(part - planned[: len(part)]).max()
        if len(part) >= len(planned) - 1 and off <= _OFF_PATH:
            return None
    return "it is not the motion as it was planned"
