"""Reading of archives: of a truncated or damaged one all that is whole, also behind damage."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.cycle_records import cycle_dtype
from hil.archive import schema
from hil.archive.cdr import Rows
from hil.archive.header import (
    FORMAT_VERSION,
    METADATA,
    ArchiveHeader,
    ArchiveOutcome,
)
from hil.archive.scan import ALL_TIMES, Scan
from hil.archive.schema import ArchivedEvent
from hil.base.errors import ArchiveError, ArchiveVersionError, NotAnArchiveError
from hil.base.safe_input import open_file, parse_json, remedy_for_missing

_MAX_SHOWN_FAULTS = 5  # faults in one message


@dataclass(frozen=True, eq=False)
class Archive:
    """The content of an archive.

    Attributes:
        outcome: how the recording ended, None where missing.
        attachments: content by file name.
        columns: contiguous read-only arrays (m,) or (m, n) by name: the fields of the cycle
            message, or ``position``, ``velocity``, ``torque`` and ``motor_current`` of an imported
            recording where recorded; and ``stamp`` (m,), ns.
        events: in the order of writing.
        damage: what is wrong with the file and how much could be read; None if nothing.
    """

    path: Path
    header: ArchiveHeader
    outcome: ArchiveOutcome | None
    attachments: Mapping[str, bytes]
    columns: Mapping[str, NDArray[Any]]
    events: tuple[ArchivedEvent, ...]
    damage: str | None

    @property
    def complete(self) -> bool:
        """Whether the archive was closed, and all its content passed its checks."""
        return self.damage is None

    @property
    def missing(self) -> str | None:
        """Path and damage; None when the archive is complete."""
        return None if self.damage is None else f"{self.path}: {self.damage}"

    @property
    def kind(self) -> str:
        """Why the arm moved, one of `hil.archive.KINDS`."""
        return self.header.kind

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Joints in the order of the columns."""
        return self.header.joint_names

    @property
    def period(self) -> float | None:
        """Cycle time [s]; None for an imported recording without a fixed one."""
        return self.header.period

    @property
    def n_samples(self) -> int:
        """Number of samples."""
        return len(self.columns["stamp"])

    def recorded(self, *names: str) -> Mapping[str, NDArray[Any]]:
        """Return the columns; ArchiveError if one of these is missing, as in an import."""
        if missing := [name for name in names if name not in self.columns]:
            raise ArchiveError(
                self.path,
                f"is not a recording by hil: it has no column {missing[0]}",
                remedy="leave it out",
            )
        return self.columns

    def text(self, name: str) -> str:
        """Return an attachment as text; ArchiveError if it is missing, or not UTF-8."""
        if name not in self.attachments:
            raise ArchiveError(
                self.path,
                f"has no attachment {name}",
                remedy="import the recording again with a URDF or a cell file",
            )
        try:
            return self.attachments[name].decode()
        except UnicodeDecodeError as error:
            raise ArchiveError(
                self.path,
                f"is not UTF-8 text ({error.reason} at byte {error.start})",
                field=name,
                remedy="import the recording again with a URDF or a cell file in UTF-8",
            ) from error

    def table(self, name: str) -> dict[str, Any]:
        """Return an attachment that is a JSON object, empty if missing; else ArchiveError."""
        try:
            content = parse_json(self.attachments.get(name, b"{}"))
        except ValueError:
            content = None
        if not isinstance(content, dict):
            raise ArchiveError(
                self.path,
                "is not a JSON object",
                field=name,
                remedy="leave the archive out, or attach the file of another archive of its run",
            )
        return content

    def cycles(self) -> Rows:
        """Return the cycle records, of type `drivers.cycle_dtype`; ArchiveError if fields lack."""
        rows = np.zeros(self.n_samples, cycle_dtype(len(self.joint_names)))
        for name in rows.dtype.names or ():
            if name in self.columns:
                rows[name] = self.columns[name]
            else:
                raise ArchiveError(self.path, f"has no column {name}", field=schema.CYCLE)
        return rows


def open_archive(
    path: str | PathLike[str],
    *,
    fields: Collection[str] | None = None,
    start: float | None = None,
    stop: float | None = None,
) -> Archive:
    """Read an archive.

    Of a damaged file all that is whole is read, and `Archive.damage` states what is missing. Where
    only some times are wanted and the index of the file is intact, other chunks are not read, nor
    is their damage detected.

    Args:
        path: the file.
        fields: columns wanted, None for all.
        start: first time wanted [s], on the clock of ``stamp`` and of the events.
        stop: end of the times wanted [s], exclusive.

    Raises:
        NotAnArchiveError: another kind of file, or one truncated before its header.
        ArchiveVersionError: written by a newer version of the profile.
        ArchiveError: the file cannot be read.
    """
    times = (
        ALL_TIMES[0] if start is None else round(start * 1e9),
        ALL_TIMES[1] if stop is None else round(stop * 1e9),
    )
    return scan_archive(path, fields=fields, times=times)[0]


def opened(archive: Path | Archive) -> Archive:
    """Return an archive, read unless it is in memory; errors as `open_archive`."""
    return archive if isinstance(archive, Archive) else open_archive(archive)


def place_of(archive: Path | Archive) -> Path:
    """Return the path of an archive; for one in memory, of the file that may be written."""
    return archive.path if isinstance(archive, Archive) else archive


def scan_archive(path: str | PathLike[str], **options: Any) -> tuple[Archive, Scan]:
    """Scan an archive with the options of `Scan`; errors as `open_archive`."""
    path = Path(path)
    scan = scan_file(path, **options)
    if scan.header is None:
        raise _unreadable(path, scan)
    columns = scan.columns
    archive = Archive(
        path=path,
        header=scan.header,
        outcome=scan.outcome,
        attachments=scan.attachments,
        columns=columns,
        events=tuple(scan.events),
        damage=_describe(scan, len(columns["stamp"])),
    )
    return archive, scan


def _describe(scan: Scan, read: int) -> str | None:
    """Return a sentence about the damage, with the number of samples that were read."""
    faults = scan.faults
    if not faults:
        return None
    return "; ".join([*faults[:_MAX_SHOWN_FAULTS], f"{read} samples could be read"])


def scan_file(path: Path, **options: Any) -> Scan:
    """Scan any file, with the options of `Scan`; ArchiveError if it cannot be read."""
    try:
        with open_file(path) as stream:
            return Scan(stream, **options)
    except OSError as error:
        remedy = "check whether it was moved or removed, and whether it can be copied"
        if isinstance(error, IsADirectoryError):
            remedy = "give an archive in it (*.mcap)"
        elif isinstance(error, FileNotFoundError):
            remedy = remedy_for_missing(path, "check whether it was moved or removed")
        raise ArchiveError(path, f"cannot be read: {error.strerror}", remedy=remedy) from error
    except MemoryError as error:
        raise ArchiveError(
            path, "does not fit into memory", remedy="read a part of its time, or fewer columns"
        ) from error


def _unreadable(path: Path, scan: Scan) -> ArchiveError:
    """Return the error of a file without a valid header."""
    if scan.header_error is not None:
        field, problem = next(iter(scan.header_error.problems.items()))
        remedy = f"correct the program that wrote its metadata record {METADATA!r}"
        return ArchiveError(path, problem, field=field, remedy=remedy)
    if scan.metadata is not None:
        version = scan.metadata.get("format_version")
        return ArchiveVersionError(
            path,
            f"is of profile version {version}; this software reads version {FORMAT_VERSION}",
            remedy="install a newer hil",
        )
    remedy = "import it (`hil import log FILE --urdf ARM.urdf`), or give a file that hil recorded"
    if not scan.damages:
        problem = f"is an MCAP file, but not an archive: it has no {METADATA!r} metadata record"
    elif 0 in scan.damages:
        problem = "is not an MCAP file"
    else:
        problem = f"is truncated before its first data: {scan.faults[0]}"
        remedy = "give another copy of it, or leave it out"
    return NotAnArchiveError(path, problem, remedy=remedy)
