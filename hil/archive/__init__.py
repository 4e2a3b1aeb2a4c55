"""Archives: one MCAP file per interval of motion, complete in itself, readable by other tools.

Names are imported on first use.
"""

from typing import TYPE_CHECKING

from hil.base.first_use import on_first_use

if TYPE_CHECKING:
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

if not TYPE_CHECKING:
    __getattr__, __dir__ = on_first_use(
        __name__,
        {
            "hil.archive.header": (
                "CONTROLLER_PROGRAM",
                "FORMAT_VERSION",
                "KINDS",
                "ArchiveHeader",
                "ArchiveName",
                "ArchiveOutcome",
                "Findings",
            ),
            "hil.archive.imported": (
                "imported_archive",
                "write_archive",
            ),
            "hil.archive.reader": (
                "Archive",
                "open_archive",
                "opened",
                "place_of",
            ),
            "hil.archive.recorder": (
                "ArchiveSpec",
                "Recorder",
            ),
            "hil.archive.schema": (
                "ArchivedEvent",
                "Level",
            ),
            "hil.archive.writer": (
                "ArchiveWriter",
                "ImportedSamples",
                "write_samples",
            ),
        },
    )
