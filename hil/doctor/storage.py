"""The place of the archives: room, and how long a write takes to be safe."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hil.archive.process import STALL_LIMIT

from .check import Check, Status

BYTES_PER_CYCLE = 400
"""Archived bytes per cycle of six axes, generously."""
_SLOW, _TOO_SLOW = 0.1 * STALL_LIMIT, 0.5 * STALL_LIMIT
"""s of one write."""
_MOVE = "# or put the campaign folder on another, local disk"


@dataclass(frozen=True)
class DiskTrial:
    """What came of writing to the place of the archives.

    Attributes:
        folder: where it was tried.
        free: bytes.
        seconds: of each write, empty if writing failed.
        error: why it failed.
    """

    folder: str
    free: int
    seconds: tuple[float, ...] = ()
    error: str = ""

    @classmethod
    def from_mapping(cls, given: Mapping[str, Any]) -> DiskTrial:
        """From the probe's answer."""
        return cls(
            folder=str(given.get("folder", "")),
            free=int(given.get("free", 0)),
            seconds=tuple(float(each) for each in given.get("seconds", ())),
            error=str(given.get("error", "")),
        )


def disk_checks(place: Path, trial: DiskTrial | None) -> list[Check]:
    """Room and write time; None stands for a disk that gave no answer in time."""
    if trial is None:
        why = f"a motion is stopped if the disk keeps the archive waiting for {STALL_LIMIT:g} s"
        look = (f"df -h {place}", _MOVE)
        return [Check("disk", Status.BAD, f"no answer from the disk of {place}", why, look)]
    return [_room(trial), _write_time(trial)]


def _room(trial: DiskTrial) -> Check:
    hours = trial.free / (BYTES_PER_CYCLE * 3_600_000)
    return Check(
        "disk space",
        Status.OK if hours >= 2 else Status.WARN if hours >= 0.5 else Status.BAD,
        f"{trial.free / 1e9:.1f} GB free at {trial.folder}: {hours:.1f} h of recording at 1 ms",
        "a full disk ends the motion: the arm is stopped, what was archived stays whole",
        () if hours >= 2 else (f"du -xh {trial.folder} | sort -h | tail",),
    )


def _write_time(trial: DiskTrial) -> Check:
    name = "disk write"
    why = f"a motion is stopped if the disk keeps the archive waiting for {STALL_LIMIT:g} s"
    if not trial.seconds:
        found = f"cannot write to {trial.folder}: {trial.error or 'no figures'}"
        return Check(name, Status.BAD, found, why, (f"ls -ld {trial.folder}; id", _MOVE))
    worst, middle = max(trial.seconds), sorted(trial.seconds)[len(trial.seconds) // 2]
    found = f"64 KiB are safe after {1e3 * middle:.1f} ms, {1e3 * worst:.1f} ms at worst"
    status = Status.OK if worst < _SLOW else Status.WARN if worst < _TOO_SLOW else Status.BAD
    return Check(name, status, found, why, () if status is Status.OK else (_MOVE,))
