"""Workers for tests: in this process, or with archives and tasks that end theirs."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Final

from hil.batch.discovery import ArchiveRef
from hil.batch.workers import ArchiveTask, Unused, Workers, run_task
from hil.errors import ArchiveError

NOTHING_OPEN: Final = (
    *("--bandwidth", "40", "--velocity", "position", "--friction", "coulomb,viscous"),
    *("--standstill", "slow", "--delay", "stated", "--estimator", "wls"),
)
"""Options of `hil reidentify` that leave nothing to be chosen of a controller's archives."""


class Here(Workers):
    """Workers in this process; `deadly` archives, by name, are as if they ended theirs."""

    def __init__(self, *deadly: str, local: bool = True) -> None:
        super().__init__(ThreadPoolExecutor(1))
        self.deadly, self.local = deadly, local
        self.tasks: list[ArchiveTask[Any]] = []

    def results(
        self, tasks: Sequence[ArchiveTask[Any]], done: Callable[[int], None] | None = None
    ) -> Iterator[Any]:
        for task in tasks:
            self.tasks.append(task)
            if done is not None:
                done(1)
            deadly = any(ref.name in self.deadly for ref in _refs(task.arguments[0]))
            yield Unused(task.path, "ended its process") if deadly else run_task(task)


def _refs(argument: Any) -> Iterator[ArchiveRef]:
    if isinstance(argument, ArchiveRef):
        yield argument
    elif not isinstance(argument, str):
        for one in argument:
            yield from _refs(one)


def number(k: int) -> int:
    return k


def marked(path: str) -> None:
    """Create a file when it begins."""
    Path(path).touch()
    time.sleep(0.1)


def absent(k: int) -> None:
    raise ArchiveError(f"{k}.mcap", "cannot be read: No such file or directory")


def faulty(_: int) -> None:
    return [][0]


def crash(_: int) -> None:
    os.kill(os.getpid(), signal.SIGSEGV)


def once(path: str) -> str:
    """End the process the first time."""
    if not Path(path).exists():
        Path(path).touch()
        os._exit(3)
    return "again"


def hang(_: int) -> None:
    time.sleep(600.0)


def task(function, argument) -> ArchiveTask:
    return ArchiveTask(f"{function.__name__}-{argument}.mcap", function, (argument,))


def tasks_with_failures(count, **more):
    """Return tasks of which some fail, and the number and reason of those."""
    reasons = {
        "crash": "ended its process, twice",
        "absent": "No such file",
        "faulty": "IndexError",
    }
    places = {"crash": 2, "absent": 4, "faulty": 7} | more
    tasks = [task(number, k) for k in range(count)]
    for name, k in places.items():
        tasks[k] = task(globals()[name], k)
    return tasks, {k: reasons.get(name, "took too long") for name, k in places.items()}


def check_failures(tasks, found, failing, others=None) -> None:
    for k, one in enumerate(found):
        if k in failing:
            assert isinstance(one, Unused)
            assert (one.path, failing[k] in one.reason) == (tasks[k].path, True), one
        else:
            assert one == (others or {}).get(k, k)
