"""Work on archives in child processes, and sums that have the same bits whoever adds them.

An archive that crashes or hangs its process costs itself. Linear algebra has one thread there, so
the bits do not depend on how many tasks are done at once.
"""

from __future__ import annotations

import operator
import os
import signal
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final, Generic, Self, TypeVar

from hil.errors import HilError
from planner.errors import PlannerCrashed, PlanningTimedOut
from planner.worker import WorkerProcess, stream_in_children

from .types import Broken, CacheError

T = TypeVar("T")
T_co = TypeVar("T_co", covariant=True)
Done = Callable[[int], None]

TIMEOUT: Final = 300.0
"""Longest time for one bundle of archives [s]."""
FAN_IN: Final = 8
"""Terms of each sum of the tree: few enough to be held at once, many enough to send little."""
_START: Final = 60.0
"""s that a new process may take to import what it needs, on a busy machine."""


@dataclass(frozen=True, eq=False)
class ArchiveTask(Generic[T_co]):
    """Work on archives.

    Attributes:
        path: file or URL, by which the task is named where it fails.
        function: importable where it runs.
        arguments: of the function; they travel with each task, so they should be small.
        size: how many times the longest time for one task it may take, at most `FAN_IN`.
    """

    path: str
    function: Callable[..., T_co]
    arguments: tuple[Any, ...]
    size: int = 1


class WorkerSoftwareError(HilError):
    """A worker that runs other software than the one who asked it."""


def plus(one: Any, other: Any) -> Any:
    """The sum of two terms, each of which may be None, which is nothing."""
    return one if other is None else other if one is None else operator.add(one, other)


class TreeSum(Generic[T]):
    """The sum of terms that come in their order: runs of `FAN_IN`, then runs of their sums.

    Floating-point addition is not associative; in a tree each run can be added wherever its terms
    are. At each time one sum per level of the tree is held.
    """

    def __init__(self, terms: Iterable[T | None] = ()) -> None:
        self._levels: list[tuple[int, T | None]] = []  # terms so far, and their sum
        for term in terms:
            self.add(term)

    def add(self, term: T | None, level: int = 0) -> None:
        """Add the next term, which is not changed; None is nothing, and has its place.

        Args:
            term: of the level.
            level: 0, or 1 for the sum of a run: of `FAN_IN` terms, or of the last ones.
        """
        while level >= len(self._levels):
            self._levels.append((0, None))
        count, total = self._levels[level]
        total = plus(total, term)
        self._levels[level] = (count + 1, total)
        if count + 1 == FAN_IN:
            self._levels[level] = (0, None)
            self.add(total, level + 1)

    def result(self) -> T | None:
        """The sum of all terms, None if there was none; nothing can be added afterwards."""
        for level, (count, _) in enumerate(self._levels):
            if level == len(self._levels) - 1 and count == 1:
                break
            if count:
                total = self._levels[level][1]
                self._levels[level] = (0, None)
                self.add(total, level + 1)
        return self._levels[-1][1] if self._levels else None


class Workers(ABC):
    """Who does the work on archives.

    Attributes:
        near: whether files they write can be read here under the same names.
        count: how many tasks are done at once.
    """

    near: bool
    count: int

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:  # noqa: B027
        """End or leave those who work, if they are others than this process."""

    @abstractmethod
    def results(
        self, tasks: Sequence[ArchiveTask[T]], done: Done | None = None
    ) -> Iterator[T | Broken]:
        """What comes of tasks, in their order; later ones are worked on meanwhile.

        A task that fails, ends its process or takes too long has a `Broken` in its place.

        Args:
            tasks: the work.
            done: called with a number of tasks whenever so many more are finished.
        """


class LocalWorkers(Workers):
    """Child processes of this one; they are started when there is something to do.

    Args:
        count: how many; by default one for each core this process may use.
        timeout: longest time for one task of size 1 [s].
    """

    near = True

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
    ) -> Iterator[T | Broken]:
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
            self._idle.append(WorkerProcess(timeout=FAN_IN * self._timeout + _START))
            self._children += self._idle
        return self._idle.pop()

    def _named(self, task: ArchiveTask[Any], result: Any) -> Any:
        if isinstance(result, PlanningTimedOut):
            return Broken(task.path, f"took longer than {task.size * self._timeout:g} s")
        if isinstance(result, PlannerCrashed):
            status = result.status
            end = f"signal {-status}" if status < 0 else f"status {status}"
            return Broken(task.path, f"ended its process, twice, with {end}")
        return result


def _run_tasks(tasks: Sequence[ArchiveTask[T]], timeout: float) -> list[T | Broken]:
    """In a child: what comes of each task; one that takes too long ends the process."""
    found = []
    for task in tasks:
        # From here: what a new process takes to import is no fault of the archive.
        # `planner.worker` switches the alarm off when this returns.
        signal.setitimer(signal.ITIMER_REAL, task.size * timeout)
        found.append(run_task(task))
    return found


def run_task(task: ArchiveTask[T]) -> T | Broken:
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
        return Broken(task.path, str(error))
    except Exception as error:  # a fault of ours: it costs this archive, not the batch
        return Broken(task.path, f"{type(error).__name__}: {error}")
