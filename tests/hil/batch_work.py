"""Workers for tests: in this process, or with archives and tasks that end theirs."""

from __future__ import annotations

import os
import signal
import time
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

    def __init__(self, *deadly):
        super().__init__(1)
        self.deadly = deadly
        self.tasks: list[ArchiveTask[Any]] = []

    def results(self, tasks, done=None):
        for task in tasks:
            self.tasks.append(task)
            if done is not None:
                done(1)
            deadly = any(ref.name in self.deadly for ref in _refs(task.arguments[0]))
            yield Unused(task.path, "ended its process") if deadly else run_task(task)


def _refs(argument):
    if isinstance(argument, ArchiveRef):
        yield argument
    elif not isinstance(argument, str):
        for one in argument:
            yield from _refs(one)


def number(k):
    return k


def absent(k):
    raise ArchiveError(f"{k}.mcap", "cannot be read: No such file or directory")


def faulty(_):
    return [][0]


def crash(_):
    os.kill(os.getpid(), signal.SIGSEGV)


def once(path):
    """End the process the first time."""
    if not Path(path).exists():
        Path(path).touch()
        os._exit(3)
    return "again"


def hang(_):
    time.sleep(600.0)


def task(function, argument):
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


def check_failures(tasks, found, failing, others=None):
    for k, one in enumerate(found):
        if k in failing:
            assert isinstance(one, Unused)
            assert (one.path, failing[k] in one.reason) == (tasks[k].path, True), one
        else:
            assert one == (others or {}).get(k, k)
