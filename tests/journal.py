"""Results of long commands in a file of JSON lines, from which the same command resumes.

A line is added by one call. A process that is killed leaves complete lines and at most one
truncated one at the end, which reading skips and adding removes.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar

Entry = TypeVar("Entry")


class JournalError(ValueError):
    """A file that cannot be read, or written, or is no journal of this command; one sentence."""


def entries(path: Path, entry: Callable[[Any], Entry], what: str) -> list[Entry]:
    """Return the complete lines by `entry`, none without a file; `what` describes a line.

    Raises:
        JournalError: it cannot be read, or a line is no such entry.
    """
    try:
        content = path.read_bytes() if path.exists() else b""
    except OSError as error:
        raise JournalError(f"{path} cannot be read: {error}; name another --journal") from error
    complete = []
    for number, line in enumerate(content[: _whole(content)].splitlines(), 1):
        try:
            complete.append(entry(json.loads(line)))
        except (AttributeError, LookupError, TypeError, ValueError) as error:
            reason = f"{path}, line {number} is no {what}; name another --journal"
            raise JournalError(reason) from error
    return complete


def rounds(path: Path | None, *needed: str) -> dict[int, dict[str, Any]]:
    """Return the lines by `round`; each has the facts `needed`."""

    def result(entry: Any) -> tuple[int, dict[str, Any]]:
        if missing := [name for name in needed if name not in entry]:
            raise KeyError(*missing)
        return int(entry["round"]), entry

    return {} if path is None else dict(entries(path, result, "result of a round"))


class Journal:
    """A journal to which lines are added; none with path None.

    `sync_every` is the time between two waits for the disk, s; 0 waits after each line.
    JournalError: it cannot be written.
    """

    def __init__(self, path: Path | None, sync_every: float = 0.0) -> None:
        self._every = sync_every
        self._synced = time.monotonic()
        self._descriptor = -1
        if path is None:
            return
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            flags = os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC
            self._descriptor = os.open(path, flags, 0o644)
            os.ftruncate(self._descriptor, _whole(path.read_bytes()))
        except OSError as error:
            reason = f"{path} cannot be written: {error.strerror}; name another --journal"
            raise JournalError(reason) from error

    def add(self, **facts: Any) -> None:
        """Add a line."""
        if self._descriptor < 0:
            return
        os.write(self._descriptor, json.dumps(facts, separators=(",", ":")).encode() + b"\n")
        if time.monotonic() - self._synced >= self._every:
            os.fsync(self._descriptor)
            self._synced = time.monotonic()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._descriptor >= 0:
            os.fsync(self._descriptor)
            os.close(self._descriptor)


def _whole(content: bytes) -> int:
    """Return the number of bytes of complete lines."""
    return content.rfind(b"\n") + 1
