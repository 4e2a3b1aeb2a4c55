"""Slips of a measured position within a motion, by its archive.

A slip of less than the following-error threshold passes the controller and the guard, and every
later motion of the joint is off by it. The positions show it, or the velocities recorded with them
contradict it.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from hil.archive import Archive, open_archive
from hil.archive.header import REJECTED, REPLIES_LOST
from hil.archive.recording_of_archive import recording_of
from hil.archive.repair import amend_outcome
from hil.base.arrays import Array
from hil.base.errors import ArchiveError
from identification.signals.position_steps import PositionJump, position_jumps
from identification.signals.recording import Recording

from .errors import SlippedError
from .messages import slip_words

CHECKED_OUTCOMES: Final = ("completed", "stopped")
"""Outcomes of motions whose measured positions are checked; the others are failures already."""
LOSS_MARGIN_SECONDS: Final = 0.2  # s around a lost packet or reply in which a jump is no slip
NEIGHBOUR_CYCLES: Final = 3  # cycles on either side of a jump whose velocities may explain it
_FIELDS: Final = ("cycle", "gap", "position", "velocity")


def slip_of(path: Path) -> PositionJump | None:
    """Return the largest slip of a measured position in an archive, or None.

    Raises:
        ArchiveError: it cannot be read.
    """
    try:
        archive = open_archive(path, fields=_FIELDS)
        recording = recording_of(archive)
    except ArchiveError:
        if path.exists() and not open_archive(path, fields=()).n_samples:
            return None  # nothing was recorded
        raise
    found = position_jumps(recording)
    velocity = archive.columns.get("velocity")
    if velocity is not None and archive.period is not None:
        position = recording.position
        driven = _travel(velocity, recording.time)
        jumps = position_jumps(replace(recording, position=position - driven))
        names = recording.joint_names
        found += [jump for jump in jumps if not _frozen(recording.time, position, names, jump)]
        found = [jump for jump in found if not _within_velocities(recording, velocity, jump)]
    disturbed = _disturbed(archive, recording)
    found = [
        jump for jump in found if not (np.abs(disturbed - jump.time) < LOSS_MARGIN_SECONDS).any()
    ]
    return max(found, key=lambda jump: abs(jump.size), default=None)


def require_no_slip(motion: str, path: Path) -> None:
    """Reject the archive of a motion in which a measured position slipped.

    Raises:
        SlippedError: it did.
        ArchiveError: the archive cannot be read, or changed.
    """
    if (slip := slip_of(path)) is not None:
        amend_outcome(path, REJECTED, slip_words(slip))
        raise SlippedError(motion, slip, path.name)


def _disturbed(archive: Archive, recording: Recording) -> Array:
    """Return when packets or replies were lost (k,) [s since the first sample].

    The controller's target then jumps, and the arm after it.
    """
    gaps = recording.gap_before
    times = recording.time[:0] if gaps is None else recording.time[gaps]
    lost = np.array([event.time for event in archive.events if event.name == REPLIES_LOST])
    cycles = archive.columns.get("cycle")
    if cycles is None or archive.period is None or not len(lost):
        return times
    return np.concatenate([times, lost - cycles[0] * archive.period])


def _travel(velocity: Array, time: Array) -> Array:
    """Return how far the joints moved by their velocities (m, n) since the first sample."""
    mean = 0.5 * (velocity[1:] + velocity[:-1])
    steps = np.where(np.isfinite(mean), mean, 0.0) * np.diff(time)[:, None]
    return np.concatenate([np.zeros_like(velocity[:1]), np.cumsum(steps, axis=0)])


def _within_velocities(recording: Recording, velocity: Array, jump: PositionJump) -> bool:
    """Return whether the travel around a jump lies between what its velocities allow.

    So it does where a joint stops at once, as one that is stuck does, or where a drive saturates
    for a few cycles: the mean of two velocities, by which :func:`_travel` goes, is not that of the
    step between them.
    """
    row = int(np.searchsorted(recording.time, recording.time[0] + jump.time))
    joint = recording.joint_names.index(jump.joint)
    rows = slice(max(row - 1 - NEIGHBOUR_CYCLES, 0), row + 1 + NEIGHBOUR_CYCLES)
    position = recording.position[rows, joint]
    ends = np.stack([velocity[rows, joint][:-1], velocity[rows, joint][1:]])
    steps = ends * np.diff(recording.time[rows])
    travel = position[-1] - position[0]
    tolerance = 0.1 * abs(jump.size)
    least, largest = steps.min(axis=0).sum(), steps.max(axis=0).sum()
    return bool(least - tolerance <= travel <= largest + tolerance)


def _frozen(time: Array, position: Array, names: tuple[str, ...], jump: PositionJump) -> bool:
    """Return whether a jump ends a position that was repeated instead of measured."""
    row = int(np.searchsorted(time, time[0] + jump.time))
    column = position[:, names.index(jump.joint)]
    return row < 2 or bool(column[row - 1] == column[row - 2])
