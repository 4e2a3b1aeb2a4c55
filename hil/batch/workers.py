"""Work on archives in child processes.

An archive that crashes or hangs its process costs itself. Linear algebra has one thread there, so
the bits do not depend on how many tasks are done at once.
"""

from __future__ import annotations

import os
import signal
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final, Generic, Self, TypeVar

from hil.errors import HilError
from planner.errors import PlannerCrashed, PlanningTimedOut
from planner.worker import WorkerProcess, stream_in_children

from .types import CacheError, Unused

T = TypeVar("T")
T_co = TypeVar("T_co", covariant=True)
Done = Callable[[int], None]

TIMEOUT: Final = 300.0
"""Longest time for one bundle of archives [s]."""
_START: Final = 60.0
"""s that a new process may take to import what it needs, on a busy machine."""


@dataclass(frozen=True, eq=False)
class ArchiveTask(Generic[T_co]):
    """Work on archives."""

    path: str  #: file or URL, by which the task is named where it fails
    function: Callable[..., T_co]  #: importable where it runs
    #: of the function; they travel with each task, so they should be small
    arguments: tuple[Any, ...]


class WorkerSoftwareError(HilError):
    """A worker that runs other software than the one who asked it."""


class Workers(ABC):
    """Who does the work on archives."""

    local: bool  #: whether files they write can be read here under the same names
    count: int  #: how many tasks are done at once

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:  # noqa: B027
        """End or leave those who work, if they are others than this process."""

    @abstractmethod
    def results(
        self, tasks: Sequence[ArchiveTask[T]], done: Done | None = None
    ) -> Iterator[T | Unused]:
        """What comes of tasks, in their order; later ones are worked on meanwhile.

        A task that fails, ends its process or takes too long has a `Unused` in its place.

        `done` is called with a number of tasks whenever so many more are finished.
        """


class LocalWorkers(Workers):
    """Child processes of this one; they are started when there is something to do.

    By default one for each core that this process may use; a task may last for `timeout` [s].
    """

    local = True

    def __init__(self, count: int | None = None, *, timeout: float = TIMEOUT) -> None:
        self.count = count or len(os.sched_getaffinity(0))
        self._timeout = timeout
        self._children: list[WorkerProcess] = []
        self._idle: list[WorkerProcess] = []

    def close(self) -> None:
        """End the processes."""
        self._idle.clear()
        while self._children:
            self._children.pop().close()

    def results(
        self, tasks: Sequence[ArchiveTask[T]], done: Done | None = None
    ) -> Iterator[T | Unused]:
        """See :class:`Workers`.

        Raises:
            PlannerNotStarted: no child process can be started.
            CacheError: the cache cannot be written.
        """
        children = [self._child() for _ in range(min(self.count, len(tasks)))]
        found = stream_in_children(
            children,
            _run_tasks,
            ([k] for k in range(len(tasks))),
            lambda chunk: ([tasks[k] for k in chunk], self._timeout),
            done=done,
        )
        early: dict[int, Any] = {}
        try:
            for k, task in enumerate(tasks):
                while k not in early:
                    other, result = next(found)
                    early[other] = result
                yield self._named(task, early.pop(k))
        finally:
            found.close()
            self._idle += [child for child in children if child in self._children]

    def _child(self) -> WorkerProcess:
        if not self._idle:
            self._idle.append(WorkerProcess(timeout=self._timeout + _START))
            self._children += self._idle
        return self._idle.pop()

    def _named(self, task: ArchiveTask[Any], result: Any) -> Any:
        if isinstance(result, PlanningTimedOut):
            return Unused(task.path, f"took longer than {self._timeout:g} s")
        if isinstance(result, PlannerCrashed):
            status = result.status
            end = f"signal {-status}" if status < 0 else f"status {status}"
            return Unused(task.path, f"ended its process, twice, with {end}")
        return result


def _run_tasks(tasks: Sequence[ArchiveTask[T]], timeout: float) -> list[T | Unused]:
    """In a child: what comes of each task; one that takes too long ends the process."""
    found = []
    for task in tasks:
        # From here: what a new process takes to import is no fault of the archive.
        # `planner.worker` switches the alarm off when this returns.
        signal.setitimer(signal.ITIMER_REAL, timeout)
        found.append(run_task(task))
    return found


def run_task(task: ArchiveTask[T]) -> T | Unused:
    """What comes of a task, or why nothing does.

    Raises:
        CacheError: the cache cannot be written; the next task would meet it as well.
        WorkerSoftwareError: other software runs here.
    """
    try:
        return task.function(*task.arguments)
    except (CacheError, WorkerSoftwareError):
        raise
    except HilError as error:
        return Unused(task.path, str(error))
    except Exception as error:  # a fault of ours: it costs this archive, not the batch
        return Unused(task.path, f"{type(error).__name__}: {error}")
