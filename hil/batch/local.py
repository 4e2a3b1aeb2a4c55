"""Workers on this machine: child processes, each with one thread for linear algebra."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Any, Final, Self, TypeVar

from planner.children import map_in_children
from planner.errors import PlannerCrashed, PlanningTimedOut
from planner.isolation import WorkerProcess

from .on_workers import ArchiveTask, Part, Summed, run_task
from .types import Broken
from .workers import Workers, summed

T = TypeVar("T")
S = TypeVar("S")

TIMEOUT: Final = 300.0
"""Longest time for one task [s]."""


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

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the processes."""
        while self._children:
            self._children.pop().close()

    def sums(
        self,
        groups: Sequence[Sequence[ArchiveTask[T, S]]],
        add: Callable[[T, T], T],
        *,
        done: Callable[[int], None] | None = None,
    ) -> list[Summed[T, S]]:
        """See :class:`Workers`.

        Raises:
            PlannerNotStarted: no child process can be started.
            CacheError: nothing can be kept.
        """
        tasks = [task for group in groups for task in group]
        while len(self._children) < min(self.count, len(tasks)):
            self._children.append(WorkerProcess(timeout=self._timeout))
        found = iter(self._done(tasks, done))
        return [summed([next(found) for _ in group], add) for group in groups]

    def _done(
        self, tasks: Sequence[ArchiveTask[Any, Any]], done: Callable[[int], None] | None
    ) -> list[Part[Any, Any] | Broken]:
        if not tasks:
            return []
        results = map_in_children(
            self._children,
            run_tasks,
            [[k] for k in range(len(tasks))],
            lambda chunk: ([tasks[k] for k in chunk],),
            done=done,
        )
        return [
            Broken(task.path, self._reason(result))
            if isinstance(result, PlannerCrashed | PlanningTimedOut)
            else result
            for task, result in zip(tasks, results, strict=True)
        ]

    def _reason(self, error: PlannerCrashed | PlanningTimedOut) -> str:
        if isinstance(error, PlanningTimedOut):
            return f"took longer than {self._timeout:g} s"
        return "ended its process, twice"


def run_tasks(tasks: Sequence[ArchiveTask[T, S]]) -> list[Part[T, S] | Broken]:
    """In a child: what comes of each task, or what it met."""
    return [run_task(task) for task in tasks]
