"""Archives: one MCAP file per interval of motion, whole in itself and readable by other tools."""

from hil.archive.events import ArchivedEvent, Level
from hil.archive.imported import Samples, write_samples
from hil.archive.names import KINDS, ArchiveName
from hil.archive.reader import Archive, ArchiveDamage, open_archive
from hil.archive.recorder import ArchiveSpec, Recorder
from hil.archive.schema import CONTROLLERS_OWN, FORMAT_VERSION
from hil.archive.writer import ArchiveWriter

__all__ = [
    "CONTROLLERS_OWN",
    "Archive",
    "ArchiveDamage",
    "ArchiveName",
    "ArchiveSpec",
    "ArchiveWriter",
    "ArchivedEvent",
    "FORMAT_VERSION",
    "KINDS",
    "Level",
    "Recorder",
    "Samples",
    "open_archive",
    "write_samples",
]
