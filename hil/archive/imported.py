"""Imported recordings as archives in memory: what a file would contain, before one is written."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from hil.archive.header import DESCRIPTION, ArchiveHeader, ArchiveOutcome, checksum
from hil.archive.reader import Archive
from hil.archive.writer import ImportedSamples, described, require_storable, write_samples

COPIED_COMMANDS: Final = "copied_commands"
"""Entry of the header: the commands that the positions of a log copy bit for bit."""
ROW_COUNTER: Final = "row_counter"
"""Entry of the header: the unit in which a map reads a column of times that counts the rows."""
TORQUE_SIDE: Final = "torque_side"
"""Entry of the header: `UNDECIDED` where a log may have torques or currents of motors."""
UNDECIDED: Final = "undecided"
_OUTCOME: Final = "completed"
_DERIVED: Final = ("joint_names", "period", "format_version", "attachments", "kind")
"""Entries of the header that `write_samples` makes itself."""


def imported_archive(
    path: Path,
    samples: ImportedSamples,
    *,
    joint_names: Sequence[str],
    metadata: Mapping[str, str],
    attachments: Mapping[str, bytes],
    period: float | None = None,
) -> Archive:
    """Return the archive that :func:`write_samples` would write to a path, as it would be read.

    Args:
        path: of the file that may be written.
        samples: m samples of n joints.
        joint_names: in the order of the columns.
        metadata: entries of the header.
        attachments: content by file name.
        period: step [s] of a recording at a fixed rate.

    Raises:
        ArchiveWriteError: a stamp cannot be stored, or the metadata are invalid.
    """
    require_storable(path, samples)
    entries = described(
        path,
        joint_names=joint_names,
        metadata={**metadata, "kind": "imported"},
        period=period,
        attachments=attachments,
    )
    count = len(samples.stamp)
    outcome = {"outcome": _OUTCOME, "samples": str(count), "events": "0"}
    return Archive(
        path=path,
        header=ArchiveHeader.of(entries),
        outcome=ArchiveOutcome.of({**outcome, DESCRIPTION: checksum(entries)}),
        attachments=dict(sorted(attachments.items())),
        columns=_columns(samples),
        events=(),
        damage=None,
    )


def with_entry(archive: Archive, key: str, text: str) -> Archive:
    """Return an archive in memory with another entry of the header."""
    entries = {**archive.header.entries, key: text}
    record = {} if archive.outcome is None else archive.outcome.record
    outcome = ArchiveOutcome.of({**record, DESCRIPTION: checksum(entries)})
    return replace(archive, header=ArchiveHeader.of(entries), outcome=outcome)


def write_archive(archive: Archive, path: Path) -> Path:
    """Write an archive in memory to a file; see :func:`write_samples`."""
    columns = {field.name: archive.columns.get(field.name) for field in fields(ImportedSamples)}
    entries = archive.header.entries
    return write_samples(
        path,
        ImportedSamples(**columns),  # type: ignore[arg-type]
        joint_names=archive.joint_names,
        metadata={key: text for key, text in entries.items() if key not in _DERIVED},
        attachments=archive.attachments,
        period=archive.period,
    )


def _columns(samples: ImportedSamples) -> dict[str, NDArray[Any]]:
    """Return contiguous read-only columns of what was recorded, by name."""
    columns: dict[str, NDArray[Any]] = {"stamp": np.array(samples.stamp, dtype=np.int64)}
    for field in fields(ImportedSamples):
        values = getattr(samples, field.name)
        if field.name != "stamp" and values is not None:
            columns[field.name] = np.array(values, dtype=np.float64, order="C")
    for column in columns.values():
        column.flags.writeable = False
    return columns
