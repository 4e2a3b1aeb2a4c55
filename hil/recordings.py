"""From archive files to what identification reads."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.events import AnswersLost
from hil.archive import Archive, open_archive
from hil.errors import ArchiveError
from identification.signals.recording import Recording

Array = NDArray[np.float64]

_ALWAYS = ("cycle", "gap", "position")
_CHANNELS = {
    "torque": ("torque",),
    "motor_current": ("target_current", "motor_current"),
    "commanded_position": ("commanded_position", "target_position"),
    "velocity": ("velocity",),
}
"""Columns of an archive that a recording takes, by what they become there."""


def open_recording(
    path: str | PathLike[str],
    *,
    channels: Collection[str] | None = None,
    start: float | None = None,
    stop: float | None = None,
) -> Recording:
    """Read an archive as a recording.

    Works on archives of this package and on imported ones. An archive that was cut off gives what
    is whole of it; the recording's provenance then has an entry ``missing`` that says what is not.
    The recording is as it was made: `Recording.checked` decides whether it can be identified from.

    Only what is wanted is decoded, chunk by chunk, and of a range of times only the chunks it lies
    in are read where the index of the file is whole.

    Args:
        path: the archive.
        channels: of ``velocity``, ``torque``, ``motor_current`` and ``commanded_position`` those
            that are wanted beside the position; None for all that were recorded.
        start: first instant wanted [s], on the archive's clock; the recording's own time begins at
            zero all the same.
        stop: end of the time wanted [s]; what happened then is left out.

    Raises:
        ArchiveError: the file is no archive, cannot be read, or holds no sample (of that time).
        ValueError: a channel that recordings do not have.
    """
    wanted = _CHANNELS.keys() if channels is None else set(channels)
    unknown = sorted(wanted - _CHANNELS.keys())
    if unknown:
        raise ValueError(f"recordings have no {unknown[0]!r}; they have {', '.join(_CHANNELS)}")
    fields = [*_ALWAYS, *(column for name in wanted for column in _CHANNELS[name])]
    archive = open_archive(path, fields=fields, start=start, stop=stop)
    if start is None and stop is None:
        return recording_of(archive)
    part = f"{'its beginning' if start is None else f'{start:g} s'} to "
    part += "its end" if stop is None else f"{stop:g} s"
    if not archive.n_samples and archive.complete:
        raise ArchiveError(
            Path(path), f"holds no sample from {part}", remedy="name a time within the recording"
        )
    recording = recording_of(archive)
    return replace(recording, provenance={**recording.provenance, "part": part})


def recording_of(archive: Archive) -> Recording:
    """The recording in an opened archive; see `open_recording`.

    Its time begins at zero and is counted in the controller's cycles (samples, where an imported
    recording has a fixed rate), not in times of arrival.

    Raises:
        ArchiveError: the archive holds no sample.
    """
    columns = archive.columns
    if not archive.n_samples or "position" not in columns:
        problem = f"holds no sample{f' ({archive.damage})' if archive.damage else ''}"
        remedy = "record it again"
        raise ArchiveError(archive.path, problem, remedy=remedy)
    imported, own = archive.kind == "imported", archive.header.by_controller_program
    provenance = {"archive": archive.path.name, **archive.header.entries}
    for key, value in (archive.outcome.entries if archive.outcome else {}).items():
        provenance[key if key == "outcome" else f"outcome.{key}"] = value
    if archive.missing is not None:
        provenance["missing"] = archive.missing
    return Recording(
        time=_time(archive),
        position=columns["position"],
        joint_names=archive.joint_names,
        torque=_known(columns.get("torque")),
        # A controller's own velocity is the slope of its positions.
        velocity=_known(columns.get("velocity")) if imported else None,
        motor_current=columns.get("target_current", columns.get("motor_current")),
        # By the PC, or by the controller's own program.
        commanded_position=columns.get("target_position" if own else "commanded_position"),
        gap_before=_gaps(archive),
        held_joints=archive.header.held_joints,
        provenance=provenance,
    )


def _time(archive: Archive) -> Array:
    """Seconds since the first sample."""
    columns, period = archive.columns, archive.period
    if "cycle" in columns:
        if period is None:
            problem = "has cycles but no period, so that their times are not known"
            remedy = "copy it again from where it was recorded; something changed it"
            raise ArchiveError(archive.path, problem, field="period", remedy=remedy)
        cycles = columns["cycle"]
        return np.asarray((cycles - cycles[0]) * period)
    elapsed = np.asarray((columns["stamp"] - columns["stamp"][0]) * 1e-9)
    return elapsed if period is None else np.asarray(np.rint(elapsed / period) * period)


def _gaps(archive: Archive) -> NDArray[np.bool_] | None:
    """Where motion is not smooth: cycles lost by the link or not archived, answers not accepted.

    Of several such answers within 0.1 s the first and the last are known.
    """
    if "cycle" not in archive.columns:
        return None
    skipped = np.diff(archive.columns["cycle"], prepend=archive.columns["cycle"][0] - 1) > 1
    gaps = np.asarray(skipped | (archive.columns["gap"] > 0))
    if archive.period is not None:
        unaccepted = [event.time for event in archive.events if event.name == AnswersLost.__name__]
        cycles = np.rint(np.array(unaccepted) / archive.period)
        gaps |= np.isin(archive.columns["cycle"], cycles)
    return gaps


def _known(torque: Array | None) -> Array | None:
    """None where the recording has no torque at all."""
    return None if torque is None or np.isnan(torque).all() else torque
