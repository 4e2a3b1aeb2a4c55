"""Conversion of archives to recordings, which identification reads."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from os import PathLike

import numpy as np
from numpy.typing import NDArray

from hil.archive import Archive, open_archive
from hil.archive.header import REPLIES_LOST
from hil.base.arrays import Array
from hil.base.errors import ArchiveError
from identification.signals.angle_wraps import (
    unwrapped,
)
from identification.signals.recording import (
    Recording,
)

_ALWAYS = ("cycle", "gap", "position")
_CHANNELS = {
    "torque": ("torque",),
    "motor_current": ("target_current", "motor_current"),
    "commanded_position": ("commanded_position", "target_position"),
    "velocity": ("velocity",),
}
"""Columns of an archive by channel of a recording."""


def open_recording(
    path: str | PathLike[str],
    *,
    channels: Collection[str] | None = None,
    start: float | None = None,
    stop: float | None = None,
) -> Recording:
    """Read an archive, recorded or imported, as a recording that is not yet checked.

    A truncated archive gives its intact part; the provenance then has an entry ``missing``. Only
    the wanted columns are decoded, and the chunks of the wanted times where the index is intact.

    Args:
        path: the archive.
        channels: wanted besides the position: ``velocity``, ``torque``, ``motor_current`` and
            ``commanded_position``; None for all that were recorded.
        start: first time wanted [s], on the archive's clock; time in the recording begins at zero.
        stop: end of the times wanted [s], exclusive.

    Raises:
        ArchiveError: the file is not an archive, cannot be read, or has no sample (in this time).
        KeyError: an unknown channel.
    """
    wanted = _CHANNELS if channels is None else channels
    fields = [*_ALWAYS, *(column for name in wanted for column in _CHANNELS[name])]
    recording = recording_of(open_archive(path, fields=fields, start=start, stop=stop))
    if start is None and stop is None:
        return recording
    part = f"{'begin' if start is None else start} to {'end' if stop is None else stop} [s]"
    return replace(recording, provenance={**recording.provenance, "part": part})


def recording_of(archive: Archive) -> Recording:
    """Return the recording of an opened archive, time from zero; ArchiveError without a sample.

    Time is counted in cycles of the controller (in samples of an imported recording at a fixed
    rate), not in times of arrival. Angles that wrap are unwrapped.
    """
    columns = archive.columns
    if not archive.n_samples or "position" not in columns:
        problem = f"has no sample{f' ({archive.damage})' if archive.damage else ''}"
        remedy = "record it again, or give a time within the recording"
        raise ArchiveError(archive.path, problem, remedy=remedy)
    imported = archive.kind == "imported"
    by_program = archive.header.by_controller_program
    provenance = {"archive": archive.path.name, **archive.header.entries}
    for key, value in (archive.outcome.entries if archive.outcome else {}).items():
        provenance[key if key == "outcome" else f"outcome.{key}"] = value
    if archive.missing is not None:
        provenance["missing"] = archive.missing
    recording = Recording(
        time=_time(archive),
        position=columns["position"],
        joint_names=archive.joint_names,
        torque=_known(columns.get("torque")),
        # The velocity of a controller is the derivative of its positions.
        velocity=_known(columns.get("velocity")) if imported else None,
        motor_current=columns.get("target_current", columns.get("motor_current")),
        # Commanded by the PC, or by a program of the controller.
        commanded_position=columns.get("target_position" if by_program else "commanded_position"),
        gap_before=_gaps(archive),
        held_joints=archive.header.held_joints,
        provenance=provenance,
    )
    return unwrapped(recording)


def _time(archive: Archive) -> Array:
    """Return seconds since the first sample."""
    columns = archive.columns
    period = archive.period
    if "cycle" in columns:
        if period is None:
            problem = "has cycles but no period, so their times are unknown"
            remedy = "copy it again from its source: it was changed"
            raise ArchiveError(archive.path, problem, field="period", remedy=remedy)
        cycles = columns["cycle"]
        return np.asarray((cycles - cycles[0]) * period)
    elapsed = np.asarray((columns["stamp"] - columns["stamp"][0]) * 1e-9)
    return elapsed if period is None else np.asarray(np.rint(elapsed / period) * period)


def _gaps(archive: Archive) -> NDArray[np.bool_] | None:
    """Return where motion may jump: lost cycles, replies not accepted (first and last in 0.1 s)."""
    if "cycle" not in archive.columns:
        return None
    skipped = np.diff(archive.columns["cycle"], prepend=archive.columns["cycle"][0] - 1) > 1
    gaps = np.asarray(skipped | (archive.columns["gap"] > 0))
    if archive.period is not None:
        unaccepted = [event.time for event in archive.events if event.name == REPLIES_LOST]
        cycles = np.rint(np.array(unaccepted) / archive.period)
        gaps |= np.isin(archive.columns["cycle"], cycles)
    return gaps


def _known(torque: Array | None) -> Array | None:
    """Return None where all values are NaN."""
    return None if torque is None or np.isnan(torque).all() else torque
