"""The disk below a campaign: it fills up, breaks, takes half a write, and outlives its process."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

from hil.archive import writer
from hil.campaign import folder as campaign_folder
from hil.files import write_atomically
from tests.simulate.script import Mishap, Script


class Killed(BaseException):
    """The process is no more; what unwinds after this does nothing to the disk."""


class Disk:
    """Stands between what writes archives and manifests, and the files.

    Attributes:
        struck: lines that came to pass.
        failures: kinds of the failures since the last `begin`.
        torn: bytes that are missing at the end of an archive since its process died.
        refused: archives that a write to failed.
        dead: whether the process was killed.
    """

    def __init__(self, script: Script) -> None:
        self._mishaps = {
            what: {at: one for one in script.of(what) for at in _span(one)}
            for what in ("write", "save", "create")
        }
        self._count = dict.fromkeys(self._mishaps, 0)
        self._paths: dict[int, Path] = {}
        self._last: list[Path] = []
        self.struck: list[str] = []
        self.failures: list[str] = []
        self.torn: dict[str, int] = {}
        self.refused: set[str] = set()
        self.dead = False

    @property
    def most(self) -> int:
        """How often it can strike at all."""
        return sum(len(mishaps) for mishaps in self._mishaps.values())

    @property
    def done(self) -> dict[str, int]:
        """How often there was something to strike, by what it is: writes, saves, creates."""
        return {f"{what}s": count for what, count in self._count.items()}

    def begin(self) -> None:
        """A new process begins."""
        self.dead = False
        self.failures, self.torn, self.refused = [], {}, set()
        self._paths.clear()
        self._last.clear()

    def cut_power(self, keep: float, files: int) -> None:
        """Kill the process, and have a share left of the newest archives it wrote."""
        self.dead = True
        for path in self._last[-files:]:
            size = path.stat().st_size
            self._tear(path, size, round(keep * size))

    def _tear(self, path: Path, size: int, kept: int) -> None:
        os.truncate(path, kept)
        self.torn[path.name] = size - kept

    def _due(self, what: str) -> Mishap | None:
        self._count[what] += 1
        found = self._mishaps[what].get(self._count[what])
        if found is not None:
            self.struck.append(found.line)
            self.failures.append(found.kind)
        return found

    # What stands in for `os` below archives.

    def open(self, path: Any, flags: int, mode: int = 0o777) -> int:
        """Make an archive, or open a folder."""
        if flags & os.O_CREAT and self._due("create") is not None:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        descriptor = os.open(path, flags, mode)
        if flags & os.O_CREAT:
            self._paths[descriptor] = Path(path)
            self._last.append(Path(path))
        return descriptor

    def write(self, descriptor: int, data: Any) -> int:
        """Write as much as the disk takes."""
        if self.dead:
            return len(data)
        mishap = self._due("write")
        if mishap is None:
            return os.write(descriptor, data)
        if mishap.kind == "short-write":
            return os.write(descriptor, data[: max(1, round(mishap.value * len(data)))])
        part = data[: min(len(data) - 1, round(mishap.value * len(data)))]
        kept = os.write(descriptor, part) if len(part) else 0
        if mishap.kind == "kill-at-write":
            self.dead = True
            self.torn[self._paths[descriptor].name] = len(data) - kept
            raise Killed(mishap.line)
        self.refused.add(self._paths[descriptor].name)
        number = errno.EIO if mishap.kind == "disk-error" else errno.ENOSPC
        raise OSError(number, os.strerror(number))

    def __getattr__(self, name: str) -> Any:
        return getattr(os, name)

    # What stands in for `write_atomically` below manifests.

    def save(self, path: Path, content: str | bytes, save: Callable[..., None]) -> None:
        """Replace a file."""
        if self.dead:
            return
        mishap = self._due("save")
        if mishap is None:
            save(path, content)
            return
        if mishap.kind == "save-full":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        if mishap.word == "after":
            save(path, content)
        elif mishap.word == "left":
            half = content[: len(content) // 2]
            left = path.with_suffix(path.suffix + ".tmp")
            left.write_bytes(half.encode() if isinstance(half, str) else half)
        self.dead = True
        raise Killed(mishap.line)


def _span(mishap: Mishap) -> range:
    return range(mishap.at, mishap.at + mishap.count)


@contextmanager
def planted(disk: Disk) -> Iterator[None]:
    """Everything that this thread archives goes through `disk`."""
    with ExitStack() as undo:
        undo.enter_context(patch.object(writer, "os", disk))
        undo.enter_context(
            patch.object(
                campaign_folder,
                "write_atomically",
                lambda path, content: disk.save(path, content, write_atomically),
            )
        )
        yield
