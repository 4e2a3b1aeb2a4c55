"""Archives: one MCAP file per interval of motion, complete in itself, readable by other tools."""

from hil.archive.header import (
    CONTROLLER_PROGRAM,
    FORMAT_VERSION,
    KINDS,
    ArchiveHeader,
    ArchiveName,
    ArchiveOutcome,
    Findings,
)
from hil.archive.imported import imported_archive, write_archive
from hil.archive.reader import Archive, open_archive, opened, place_of
from hil.archive.recorder import ArchiveSpec, Recorder
from hil.archive.schema import ArchivedEvent, Level
from hil.archive.writer import ArchiveWriter, ImportedSamples, write_samples

__all__ = [
    "CONTROLLER_PROGRAM",
    "FORMAT_VERSION",
    "KINDS",
    "Archive",
    "ArchiveHeader",
    "ArchiveName",
    "ArchiveOutcome",
    "ArchiveSpec",
    "ArchiveWriter",
    "ArchivedEvent",
    "Findings",
    "Level",
    "Recorder",
    "ImportedSamples",
    "imported_archive",
    "open_archive",
    "opened",
    "place_of",
    "write_archive",
    "write_samples",
]
