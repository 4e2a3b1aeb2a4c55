"""Errors of the `hil` package.

```
HilError                   exit status 1
├── UnsafeError            3: a motion was refused before anything was sent
│   ├── MotionRefusedError      limits, current, collision, or too long
│   ├── NoExcitationError       every motion of a design would be refused
│   ├── NotRehearsedError       the plan did not pass its rehearsal
│   └── DryRunError             nobody has accepted the plan's slow dry run
├── ControllerFault        4: the controller, the link or the guard ended a motion
│   └── MotionFailedError       and what was recorded of it is archived
├── RepetitionsRejectedError   5: a motion failed its quality check again and again
├── OperatorStopError         130: a person stopped the work
├── OutputError            1: what was found cannot be written: disk full, no permission
└── InputError             2: something the user gave cannot be used: file, field, problem, remedy
                           (1 on the command line, where a disk refused: `DISK_REFUSES`)
    ├── ArchiveError       an archive that cannot be read or written
    │   ├── NotAnArchiveError       not ours: other format, empty, torn at its head
    │   ├── ArchiveVersionError     written by a newer version of the archive profile
    │   └── ArchiveWriteError       the file cannot be created or the disk refuses
    ├── CellError          the cell file
    ├── SettingsError      the settings of a design
    ├── CampaignFolderError     the campaign folder
    ├── WrongObjectError   an argument of another type than it has to be (a TypeError too)
    └── SourceError        a foreign recording (CSV, rosbag2) that cannot be imported
```
"""

from __future__ import annotations

import errno
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from types import MappingProxyType
from typing import ClassVar, Final, Self

from hil.terminal_text import printable

DISK_REFUSES: Final = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EROFS, errno.EFBIG})
"""Numbers of an OSError that nothing typed or given can mend: full, over quota, broken."""


class HilError(Exception):
    """Anything `hil` refuses to do; the message is a sentence for the person at the keyboard.

    Attributes:
        exit_code: exit status of the command line when this error ends it.
        figures: what a script receives beside the sentence, of work that was done until then.
    """

    exit_code: ClassVar[int] = 1
    figures: Mapping[str, object] = MappingProxyType({})

    def beside(self, figures: Mapping[str, object]) -> Self:
        """This error with figures."""
        self.figures = dict(figures)
        return self


class InputError(HilError):
    """Something given by the user that cannot be used.

    Attributes:
        path: the file to blame, None when it is not a file.
        field: the part of it (table and key, column, topic, record), "" for the whole.
        problem: what is wrong with it, with the value found.
        remedy: what would be right, "" when nothing can be advised.
    """

    exit_code: ClassVar[int] = 2

    def __init__(
        self,
        path: str | PathLike[str] | None,
        problem: str,
        *,
        field: str = "",
        remedy: str = "",
    ) -> None:
        self.path = None if path is None else Path(path)
        self.field = field
        self.problem = problem
        self.remedy = remedy
        place = [printable(str(part), keep="") for part in (self.path, field) if part]
        sentence = ": ".join([*place, problem])
        super().__init__(f"{sentence}; {remedy}" if remedy else sentence)


class ArchiveError(InputError):
    """An archive that cannot be read or written."""


class NotAnArchiveError(ArchiveError):
    """A file that is not an archive of ours, or was torn before it held anything."""


class ArchiveVersionError(ArchiveError):
    """An archive written with a profile version this software does not know."""


class ArchiveWriteError(ArchiveError):
    """An archive that cannot be created, or whose disk refuses to take more."""


class SourceError(InputError):
    """A foreign recording that cannot be imported."""


class OutputError(HilError):
    """A folder that does not take what was found; nothing in it was changed.

    Attributes:
        path: the folder.
        problem: what is wrong with it.
    """

    def __init__(self, path: Path, problem: str) -> None:
        self.path = path
        self.problem = problem
        super().__init__(
            f"{path}: {problem}; nothing there was changed: make room, or name another folder"
        )


class UnsafeError(HilError):
    """A motion that was refused before anything was sent."""

    exit_code: ClassVar[int] = 3


class OperatorStopError(HilError):
    """A person stopped the work; what was recorded is whole."""

    exit_code: ClassVar[int] = 130


class ControllerFault(HilError):  # noqa: N818 - the controller's own word
    """The controller, the link or the guard ended a motion."""

    exit_code: ClassVar[int] = 4
