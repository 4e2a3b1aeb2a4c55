"""Archives: one MCAP file per interval of motion, whole in itself and readable by other tools."""

from hil.archive.events import ArchivedEvent, Level
from hil.archive.header import (
    CONTROLLERS_OWN,
    FORMAT_VERSION,
    KINDS,
    ArchiveHeader,
    ArchiveName,
    ArchiveOutcome,
    Findings,
)
from hil.archive.reader import Archive, ArchiveDamage, open_archive
from hil.archive.recorder import ArchiveSpec, Recorder
from hil.archive.writer import ArchiveWriter, Samples, write_samples

__all__ = [
    "CONTROLLERS_OWN",
    "Archive",
    "ArchiveHeader",
    "ArchiveOutcome",
    "ArchiveDamage",
    "ArchiveName",
    "ArchiveSpec",
    "ArchiveWriter",
    "ArchivedEvent",
    "FORMAT_VERSION",
    "Findings",
    "KINDS",
    "Level",
    "Recorder",
    "Samples",
    "open_archive",
    "write_samples",
]
