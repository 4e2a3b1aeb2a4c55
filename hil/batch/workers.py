"""Child processes that work on archives.

A crash or a hang costs one archive only. Linear algebra has one thread in a child, so the bits do
not depend on the number of parallel tasks.
"""

from __future__ import annotations

import os
import signal
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Generic, Self, TypeVar

from hil.errors import HilError
from identification import IdentificationError
from planner.errors import PlannerCrashed, PlanningTimedOut
from planner.worker import WorkerProcess, stream_in_children

from .types import CacheError, Unused

T = TypeVar("T")
T_co = TypeVar("T_co", covariant=True)
Done = Callable[[int], None]

TIMEOUT: Final = 300.0  # s, of one bundle of archives
_START: Final = 60.0  # s, in which a new process imports its modules on a busy machine


@dataclass(frozen=True, eq=False)
class ArchiveTask(Generic[T_co]):
    """A task on archives."""

    path: str  #: file or URL that names the task in errors
    function: Callable[..., T_co]  #: importable in the child
    #: of the function; they are pickled with each task, so they should be small
    arguments: tuple[Any, ...]


class WorkerSoftwareError(HilError):
    """A worker has other software than the client."""


class Workers(ABC):
    """Interface of workers."""

    local: bool  #: whether files they write are readable here under the same names

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:  # noqa: B027
        """End the workers."""

    def require_folders(self, folders: Sequence[Path]) -> None:  # noqa: B027
        """Check that workers on other machines have these folders under the same names."""

    @abstractmethod
    def results(
        self, tasks: Sequence[ArchiveTask[T]], done: Done | None = None
    ) -> Iterator[T | Unused]:
        """Yield the results of tasks in their order; later ones are computed meanwhile.

        A task that fails, ends its process or takes too long gives an `Unused`. `done` is called
        with the number of tasks that were finished since the last call.
        """


class LocalWorkers(Workers):
    """Child processes of this one, started on demand.

    The default is one for each core that this process may use; a task may last for `timeout` [s].
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
                result = early.pop(k)
                if isinstance(result, PlanningTimedOut):
                    result = Unused(task.path, f"took longer than {self._timeout:g} s")
                elif isinstance(result, PlannerCrashed):
                    status = result.status
                    end = f"signal {-status}" if status < 0 else f"status {status}"
                    result = Unused(task.path, f"ended its process, twice, with {end}")
                yield result
        finally:
            found.close()
            self._idle += [child for child in children if child in self._children]

    def _child(self) -> WorkerProcess:
        if not self._idle:
            self._idle.append(WorkerProcess(timeout=self._timeout + _START))
            self._children += self._idle
        return self._idle.pop()


def _run_tasks(tasks: Sequence[ArchiveTask[T]], timeout: float) -> list[T | Unused]:
    """Run tasks in a child; one that takes too long ends the process."""
    found = []
    for task in tasks:
        # Started here: imports of a new process do not count.
        # `planner.worker` switches the alarm off when this returns.
        signal.setitimer(signal.ITIMER_REAL, timeout)
        found.append(run_task(task))
    return found


def run_task(task: ArchiveTask[T]) -> T | Unused:
    """Return the result of a task, or why there is none.

    Raises:
        CacheError: the cache cannot be written, which affects every task.
        WorkerSoftwareError: the worker has other software.
    """
    try:
        return task.function(*task.arguments)
    except (CacheError, WorkerSoftwareError):
        raise
    except Exception as error:
        return Unused(task.path, reason_of(error))


def reason_of(error: Exception) -> str:
    """Return the text of an error; an internal one costs an archive, not the batch."""
    expected = isinstance(error, HilError | IdentificationError)
    return str(error) if expected else f"{type(error).__name__}: {error}"
