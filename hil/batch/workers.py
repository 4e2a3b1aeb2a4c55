"""Who does the work on archives, and in which order its results are added up.

Floating-point addition is not associative, so where terms are added decides about the last bits.
Here each sum is a tree over the terms in their order, of which every part can be added wherever
its terms are: one process and a hundred machines give the same bits.

Archives are worked on in child processes: one that crashes or hangs costs itself, linear algebra
has one thread, and so the bits do not depend on how many tasks are done at once.
"""

from __future__ import annotations

import operator
import os
import signal
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final, Generic, NamedTuple, Self, TypeVar

from hil.errors import HilError
from planner.errors import PlannerCrashed, PlanningTimedOut
from planner.worker import WorkerProcess, stream_in_children

from .types import Broken, CacheError

T = TypeVar("T")
S = TypeVar("S")
Done = Callable[[int], None]

TIMEOUT: Final = 300.0
"""Longest time for one task [s]."""
FAN_IN: Final = 8
"""Terms of each sum of the tree: few enough to be held at once, many enough to send little."""
_START: Final = 60.0
"""s that a new process may take to import what it needs, on a busy machine."""
_TOGETHER: Final = 512
"""Tasks without a sum that are given out as a group: few enough to be held at once."""


class Part(NamedTuple, Generic[T, S]):
    """What came of an archive: what is added up (None for nothing), and what else is known."""

    total: T | None
    note: S


@dataclass(frozen=True, eq=False)
class ArchiveTask(Generic[T, S]):
    """Work on one archive.

    Attributes:
        path: file or URL, by which it is named where it fails.
        function: returns its part; importable where it runs.
        arguments: of the function; they travel with each task, so they should be small.
    """

    path: str
    function: Callable[..., Part[T, S] | Broken]
    arguments: tuple[Any, ...]


@dataclass(frozen=True, eq=False)
class Summed(Generic[T, S]):
    """What came of several archives.

    Attributes:
        total: sum of the parts that are there; None where there is none.
        notes: of each archive in order, or why there is none.
    """

    total: T | None
    notes: tuple[S | Broken, ...]


class WorkerSoftwareError(HilError):
    """A worker that runs other software than the one who asked it."""


def plus(one: Any, other: Any, add: Callable[[Any, Any], Any] = operator.add) -> Any:
    """The sum of two terms, each of which may be None, which is nothing."""
    return one if other is None else other if one is None else add(one, other)


class TreeSum(Generic[T]):
    """The sum of terms that come in their order: runs of `FAN_IN`, then runs of their sums.

    At each time one sum per level of the tree is held.
    """

    def __init__(self, add: Callable[[Any, Any], Any] = operator.add) -> None:
        self._add = add
        self._levels: list[tuple[int, T | None]] = []  # terms so far, and their sum

    def add(self, term: T | None, level: int = 0) -> None:
        """Add the next term, which is not changed; None is nothing, and has its place."""
        if level == len(self._levels):
            self._levels.append((0, None))
        count, total = self._levels[level]
        total = plus(total, term, self._add)
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


def sum_tree(terms: Sequence[T | None], add: Callable[[T, T], T]) -> T | None:
    """The sum of :class:`TreeSum`."""
    sums = TreeSum[T](add)
    for term in terms:
        sums.add(term)
    return sums.result()


def joined(parts: Sequence[Summed[T, S]], add: Callable[[T, T], T]) -> Summed[T, S]:
    """The sum of successive runs of tasks, each a whole branch of the tree."""
    notes = tuple(note for part in parts for note in part.notes)
    return Summed(sum_tree([part.total for part in parts], add), notes)


def summed(parts: Sequence[Part[T, S] | Broken], add: Callable[[T, T], T]) -> Summed[T, S]:
    """What comes of the tasks of one group."""
    return Summed(
        sum_tree([None if isinstance(part, Broken) else part.total for part in parts], add),
        tuple(part if isinstance(part, Broken) else part.note for part in parts),
    )


class Workers(ABC):
    """Who does the work on archives.

    Attributes:
        near: whether files they write can be read here under the same names.
    """

    near: bool

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:  # noqa: B027
        """End or leave those who work, if they are others than this process."""

    @abstractmethod
    def sums_in_turn(
        self,
        groups: Sequence[Sequence[ArchiveTask[T, S]]],
        add: Callable[[T, T], T],
        *,
        done: Done | None = None,
    ) -> Iterator[Summed[T, S]]:
        """Do the tasks, and add up what comes of those of each group, in the order of `TreeSum`.

        A task that ends its process or takes too long has a `Broken` in place of its note. Later
        groups may be worked on before an earlier one is asked for.

        Args:
            groups: the work, in an order that decides about the last bits.
            add: sum of two totals, importable on the workers; it must not change them.
            done: called with a number of tasks whenever so many more are finished.
        """

    def sums(
        self,
        groups: Sequence[Sequence[ArchiveTask[T, S]]],
        add: Callable[[T, T], T],
        *,
        done: Done | None = None,
    ) -> list[Summed[T, S]]:
        """The same of all groups."""
        return list(self.sums_in_turn(groups, add, done=done))

    def notes(
        self, tasks: Sequence[ArchiveTask[T, S]], *, done: Done | None = None
    ) -> Iterator[S | Broken]:
        """The notes of tasks of which nothing is to be added up."""
        groups = [tasks[k : k + _TOGETHER] for k in range(0, len(tasks), _TOGETHER)]
        for found in self.sums_in_turn(groups, operator.add, done=done):
            yield from found.notes


class LocalWorkers(Workers):
    """Child processes of this one; they are started when there is something to do.

    Args:
        count: how many; by default one for each core this process may use.
        timeout: longest time for one task [s].
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

    def sums_in_turn(
        self,
        groups: Sequence[Sequence[ArchiveTask[T, S]]],
        add: Callable[[T, T], T],
        *,
        done: Done | None = None,
    ) -> Iterator[Summed[T, S]]:
        """See :class:`Workers`.

        Raises:
            PlannerNotStarted: no child process can be started.
            CacheError: the cache cannot be written.
        """
        tasks = [task for group in groups for task in group]
        children = [self._child() for _ in range(min(self.count, len(tasks)))]
        results = stream_in_children(
            children,
            run_tasks,
            ([k] for k in range(len(tasks))),
            lambda chunk: ([tasks[k] for k in chunk], self._timeout),
            done=done,
        )
        parts: dict[int, Part[T, S] | Broken] = {}
        try:
            first = 0
            for group in groups:
                wanted = range(first, first + len(group))
                first += len(group)
                while not all(k in parts for k in wanted):
                    k, result = next(results)
                    parts[k] = self._part(tasks[k], result)
                yield summed([parts.pop(k) for k in wanted], add)
        finally:
            results.close()
            self._idle += [child for child in children if child in self._children]

    def _child(self) -> WorkerProcess:
        if not self._idle:
            self._idle.append(WorkerProcess(timeout=self._timeout + _START))
            self._children += self._idle
        return self._idle.pop()

    def _part(
        self,
        task: ArchiveTask[T, S],
        result: Part[T, S] | Broken | PlannerCrashed | PlanningTimedOut,
    ) -> Part[T, S] | Broken:
        if isinstance(result, PlanningTimedOut):
            return Broken(task.path, f"took longer than {self._timeout:g} s")
        if isinstance(result, PlannerCrashed):
            status = result.status
            end = f"signal {-status}" if status < 0 else f"status {status}"
            return Broken(task.path, f"ended its process, twice, with {end}")
        return result


def run_tasks(tasks: Sequence[ArchiveTask[T, S]], timeout: float) -> list[Part[T, S] | Broken]:
    """In a child: what comes of each task, or what it met; one that takes too long kills it."""
    found = []
    for task in tasks:
        # From here: what a new process takes to import is no fault of the archive.
        # `planner.worker` switches the alarm off when this returns.
        signal.setitimer(signal.ITIMER_REAL, timeout)
        found.append(run_task(task))
    return found


def run_task(task: ArchiveTask[T, S]) -> Part[T, S] | Broken:
    """What comes of a task, or what it met.

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
