"""Errors of the `hil` package.

```
HilError                   exit status 1
├── UnsafeError            3: a motion was refused before anything was sent
│   ├── MotionRefusedError      limits, current, collision, or too long
│   ├── NoExcitationError       every motion of a design would be refused
│   ├── NotRehearsedError       the plan did not pass its rehearsal
│   ├── DryRunError             the slow dry run of the plan was not accepted
│   └── MountingError           a payload has to be mounted or removed, without confirmation
├── ExecutionError         4: a motion did not begin, or ended otherwise than planned
│   ├── ControllerError         the controller or the link was not ready, or failed
│   └── MotionFailedError       stopped, refused by this PC, or lost; with its archive
├── RepetitionsRejectedError   5: a motion failed its quality check repeatedly
├── OperatorStopError         130: stopped by the operator
├── OutputError            1: results cannot be written: disk full, no permission
└── InputError             2: invalid input of the user: file, field, problem, remedy
                           (1 on the command line for errors of a disk: `DISK_ERRNOS`)
    ├── ArchiveError       an archive that cannot be read or written
    │   ├── NotAnArchiveError       another format, empty, or truncated in its header
    │   ├── ArchiveVersionError     written by a newer version of the archive profile
    │   └── ArchiveWriteError       the file cannot be created or written
    ├── CellError          the cell file
    ├── SettingsError      the settings of a design
    ├── CampaignFolderError     the campaign folder
    └── SourceError        a foreign recording (CSV, rosbag2) that cannot be imported
        └── RefusedRecordingError  5: a recording that was read, and from which nothing follows
```
"""

from __future__ import annotations

import errno
from collections.abc import Iterable, Mapping
from os import PathLike
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar, Final, Self

from hil.base.exit_status import ExitStatus
from hil.base.terminal_text import printable

DISK_ERRNOS: Final = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EROFS, errno.EFBIG})
"""Numbers of an OSError that are not caused by input: disk full, over quota, failed."""


class HilError(Exception):
    """Base class of the errors of `hil`; the message is for the operator.

    `exit_code` is the exit status; `figures` are JSON data about the work done before.
    """

    exit_code: ClassVar[int] = ExitStatus.FAILED
    figures: Mapping[str, object] = MappingProxyType({})

    def __reduce__(self) -> tuple[Any, ...]:
        """Return the parts of a pickle: the constructors have other arguments than the message."""
        return _restored, (type(self), self.args, vars(self))

    def beside(self, figures: Mapping[str, object]) -> Self:
        """Return this error with figures."""
        self.figures = dict(figures)
        return self


def _restored(kind: type[HilError], args: tuple[Any, ...], state: dict[str, Any]) -> HilError:
    error = kind.__new__(kind)
    error.args = args
    vars(error).update(state)
    return error


class InputError(HilError):
    """Invalid input of the user.

    Args:
        path: file with the input; None if it is in no file.
        problem: what is wrong, as a clause.
        field: field or option; "" for the whole file.
        remedy: what to do.
    """

    exit_code: ClassVar[int] = ExitStatus.BAD_INPUT

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
        shown = path if isinstance(path, str) and "://" in path else self.path  # a URL as it is
        super().__init__(self._message(shown))

    def message_next_to(self, path: str) -> str:
        """Return the message for a reader who sees `path`: without it if this error is about it."""
        return self._message(None) if self.path == Path(path) else str(self)

    def _message(self, shown: str | Path | None) -> str:
        place = [printable(str(part), keep="") for part in (shown, self.field) if part]
        sentence = ": ".join([*place, self.problem])
        return f"{sentence}; {self.remedy}" if self.remedy else sentence


class ArchiveError(InputError):
    """An archive that cannot be read or written."""


class NotAnArchiveError(ArchiveError):
    """A file that is not an archive of `hil`, or is truncated in its header."""


class ArchiveVersionError(ArchiveError):
    """An archive of an unknown profile version."""


class ArchiveWriteError(ArchiveError):
    """An archive that cannot be created or written."""


class CampaignFolderError(InputError):
    """A campaign folder that cannot be used."""

    def __init__(self, folder: Path, problem: str, remedy: str) -> None:
        super().__init__(folder, problem, remedy=remedy)


class SourceError(InputError):
    """A foreign recording that cannot be imported."""


class RefusedRecordingError(SourceError):
    """A recording that was read, and from which nothing follows.

    The exit status states the verdict on its archive: the result is negative.
    """

    exit_code: ClassVar[int] = ExitStatus.NEGATIVE_RESULT


class UndecidedError(SourceError):
    """A recording of which an option has to decide how it is read.

    Attributes:
        aspect: what is open.
    """

    def __init__(self, path: Path, problem: str, *, field: str, remedy: str, aspect: str) -> None:
        super().__init__(path, problem, field=field, remedy=remedy)
        self.aspect = aspect


class UnrecordedJointError(SourceError):
    """A foreign recording without a joint of its robot.

    Attributes:
        count: how many joints were recorded.
        joints: those that the recording names, as in the URDF.
        channels: names of the channels, which may say a side of the robot.
    """

    def __init__(
        self,
        path: Path,
        problem: str,
        *,
        field: str,
        remedy: str,
        count: int,
        joints: Iterable[str] = (),
        channels: Iterable[str] = (),
    ) -> None:
        super().__init__(path, problem, field=field, remedy=remedy)
        self.count = count
        self.joints = tuple(joints)
        self.channels = tuple(channels)


class OutputError(HilError):
    """A folder that cannot be written to; nothing in it was changed."""

    def __init__(self, path: Path, problem: str) -> None:
        self.path = path
        self.problem = problem
        super().__init__(
            f"{path}: {problem}; nothing there was changed: make room, or use another folder"
        )


class UnsafeError(HilError):
    """A motion that was refused before anything was sent."""

    exit_code: ClassVar[int] = ExitStatus.REFUSED


class OperatorStopError(HilError):
    """Stopped by the operator; everything recorded is archived."""

    exit_code: ClassVar[int] = ExitStatus.STOPPED


class ExecutionError(HilError):
    """A motion did not begin, or ended otherwise than planned, whoever ended it."""

    exit_code: ClassVar[int] = ExitStatus.CONTROLLER_FAULT


class ControllerError(ExecutionError):
    """The controller, or the link to it, was not ready or failed."""
