"""Work for the workers of a batch: no archives, but all their woes. Their processes import it."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

from hil.batch.workers import ArchiveTask
from hil.errors import ArchiveError


def number(k: int) -> int:
    return k


def slow_number(k: int) -> int:
    time.sleep(0.1)
    return k


def marked(path: str) -> None:
    """Leaves a file behind that says it was begun."""
    Path(path).touch()
    time.sleep(0.1)


def absent(k: int) -> None:
    raise ArchiveError(f"{k}.mcap", "cannot be read: No such file or directory")


def faulty(_: int) -> None:
    return [][0]


def crash(_: int) -> None:
    os.kill(os.getpid(), signal.SIGSEGV)


def hang(_: int) -> None:
    time.sleep(600.0)


def kill_worker(_: int) -> None:
    """Kill the worker, as the kernel does where memory runs out."""
    os.kill(os.getppid(), signal.SIGKILL)
    time.sleep(600.0)


def task(function, argument) -> ArchiveTask:
    return ArchiveTask(f"{function.__name__}-{argument}.mcap", function, (argument,))
