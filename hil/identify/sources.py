"""Archives as identification needs them: whose they are, what is fitted, what is predicted."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.archive import Archive, open_archive
from hil.cell import Cell
from hil.errors import ArchiveError, InputError
from hil.recordings import recording_of
from identification.preprocessing import standstill_variance
from identification.recording import Recording

Array = NDArray[np.float64]

FLOAT32_STEP = 2.0**-24
"""Relative rounding step of a position on the wire, as a share of its size."""


@dataclass(frozen=True, eq=False)
class Source:
    """One archive: its recording and where the planned motion begins in it.

    Attributes:
        name: file name.
        recording: joints in the order of the model.
        origin: time of the first set-point [s].
    """

    name: str
    recording: Recording
    origin: float


@dataclass(frozen=True, eq=False)
class Sources:
    """All archives of one identification.

    Attributes:
        cell: from the attachments of the first archive.
        metadata: of the first archive.
        plan: of the first archive; None where none was attached.
        training: what is fitted; repetitions of one motion.
        held_out: what is predicted and never fitted.
        noise_variance: of the positions (n,) [rad²]; None where no standstill was recorded.
        doubts: what a reader must know about the archives.
    """

    cell: Cell
    metadata: dict[str, str]
    plan: dict[str, Any] | None
    training: tuple[Source, ...]
    held_out: tuple[Source, ...]
    noise_variance: Array | None
    doubts: tuple[str, ...]

    def with_doubt(self, doubt: str) -> Sources:
        """These sources with one more thing a reader must know."""
        return replace(self, doubts=(*self.doubts, doubt))


def cell_of(archive: Archive) -> Cell:
    """The cell that travels inside an archive.

    Raises:
        ArchiveError: the archive carries no cell or no URDF.
    """
    try:
        text, urdf = archive.attachments["cell.toml"], archive.attachments["robot.urdf"]
    except KeyError as error:
        raise ArchiveError(
            archive.path,
            f"carries no {error.args[0]}",
            remedy="import the recording again with a URDF or a cell file",
        ) from error
    return Cell.from_texts(text.decode(), urdf.decode(), archive.path)


def gather_sources(paths: Sequence[Path], split: float) -> Sources:
    """Open archives and sort them into what is fitted and what is predicted.

    Excitations are fitted and validation runs predicted. Where there is no validation run, the
    last part of a single recording, or the last of several, is held out.

    Raises:
        InputError: there is nothing to fit, or nothing left to predict.
        ArchiveError: an archive cannot be read.
    """
    archives = [open_archive(path) for path in paths]
    by_kind: dict[str, list[Archive]] = {}
    for archive in archives:
        by_kind.setdefault(archive.kind, []).append(archive)
    fitted = by_kind.get("excitation", []) + by_kind.get("imported", [])
    if not fitted:
        raise InputError(
            paths[0] if paths else None,
            "there is no excitation and no imported recording among the archives",
            remedy="name archives of kind excitation or imported",
        )
    cell = cell_of(fitted[0])
    training = [_source(archive, cell) for archive in fitted]
    held_out = [_source(archive, cell) for archive in by_kind.get("validation", [])]
    doubts = [archive.missing for archive in archives if archive.missing is not None]
    if not held_out:
        training, held_out, doubt = _split(training, split)
        doubts.append(doubt)
    rest = by_kind.get("standstill", [])
    plan = fitted[0].attachments.get("plan.json")
    return Sources(
        cell=cell,
        metadata=dict(fitted[0].metadata),
        plan=None if plan is None else json.loads(plan),
        training=tuple(training),
        held_out=tuple(held_out),
        noise_variance=_noise_variance(cell, rest[0]) if rest else None,
        doubts=tuple(doubts),
    )


def _source(archive: Archive, cell: Cell) -> Source:
    recording = recording_of(archive).checked(cell.joint_names)
    origin = 0.0
    if recording.commanded_position is not None:
        commanded = np.flatnonzero(~np.isnan(recording.commanded_position).any(axis=1))
        origin = float(recording.time[commanded[0]]) if commanded.size else 0.0
    return Source(archive.path.name, recording, origin)


def _split(sources: list[Source], share: float) -> tuple[list[Source], list[Source], str]:
    if len(sources) > 1:
        return (
            sources[:-1],
            sources[-1:],
            f"no validation run: the last recording, {sources[-1].name}, was held out instead",
        )
    whole = sources[0]
    cut = round(share * whole.recording.n_samples)
    first = Source(f"{whole.name} (first part)", whole.recording.between(0, cut), whole.origin)
    time = float(whole.recording.time[min(cut, whole.recording.n_samples - 1)])
    last = Source(
        f"{whole.name} (last part)",
        whole.recording.between(cut, whole.recording.n_samples),
        time,
    )
    doubt = (
        f"a temporal split: the first {share:.0%} of one recording were fitted, the rest of the "
        "same motion was predicted; other motions would be a harder test"
    )
    return [first], [last], doubt


def _noise_variance(cell: Cell, rest: Archive) -> Array:
    """Variance of the measured positions at standstill, at least that of their resolution (n,).

    An arm that rests may show the same count for seconds; rounding to a count is noise all the
    same, uniform over the step.
    """
    recording = recording_of(rest)
    commanded = recording.commanded_position
    still = (
        np.ones(recording.n_samples, dtype=bool)
        if commanded is None
        else ~np.isnan(commanded).any(axis=1)
    )
    measured = standstill_variance(recording.time[still], recording.position[still])
    drives = cell.drive_train
    revolutions = drives.motor_revolutions(recording.position[still]).reshape(-1, len(measured))
    step = np.maximum(
        1.0 / cell.drive_table.encoder_counts_per_revolution,
        2.0 * FLOAT32_STEP * np.abs(revolutions).max(axis=0),
    )
    joint_step = np.abs(np.linalg.inv(drives.motor_from_joint)) * (2.0 * np.pi * step)
    resolution = (joint_step**2).sum(axis=1) / 12.0
    return np.asarray(np.maximum(measured, resolution))
