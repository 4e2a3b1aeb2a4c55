"""Results of rounds in a file of JSON lines, each on the disk before the next one is begun."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any, Final

NEEDED: Final = ("round", "broken", "seconds", "processor")
"""What every result has, however its round ended; a line without is of another kind of journal."""


def read(path: Path) -> dict[int, dict[str, Any]]:
    """Results by round; a last line that was not ended is torn, and left out.

    Raises:
        ValueError: it cannot be read, or a line is no result.
    """
    if not path.exists():
        return {}
    results: dict[int, dict[str, Any]] = {}
    try:
        lines = path.read_text("utf-8", "replace").splitlines(keepends=True)
    except OSError as error:
        raise ValueError(f"{path} cannot be read: {error.strerror}") from error
    if lines and not lines[-1].endswith("\n"):
        lines.pop()
    for place, line in enumerate(lines):
        try:
            result = json.loads(line)
            if missing := [name for name in NEEDED if name not in result]:
                raise KeyError(*missing)
            results[int(result["round"])] = result
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{path}, line {place + 1} is no result of a round") from error
    return results


def append(path: Path, result: dict[str, Any]) -> None:
    """Add a result; it is on the disk when this returns."""
    line = (json.dumps(result) + "\n").encode()
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        end = _end_of_whole_lines(descriptor)
        os.ftruncate(descriptor, end)
        os.pwrite(descriptor, line, end)
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _end_of_whole_lines(descriptor: int) -> int:
    """Where the next line begins: behind the last whole one."""
    size = os.fstat(descriptor).st_size
    tail = os.pread(descriptor, 1 << 20, max(0, size - (1 << 20)))
    return size - len(tail) + tail.rfind(b"\n") + 1
