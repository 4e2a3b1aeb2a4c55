"""Archives: one MCAP file per interval of motion, whole in itself and readable by other tools."""

from hil.archive.events import ArchivedEvent, Level
from hil.archive.imported import Samples, write_samples
from hil.archive.names import KINDS, ArchiveName
from hil.archive.reader import Archive, ArchiveDamage, open_archive
from hil.archive.schema import FORMAT_VERSION
from hil.archive.writer import ArchiveWriter

__all__ = [
    "Archive",
    "ArchiveDamage",
    "ArchiveName",
    "ArchiveWriter",
    "ArchivedEvent",
    "FORMAT_VERSION",
    "KINDS",
    "Level",
    "Samples",
    "open_archive",
    "write_samples",
]
