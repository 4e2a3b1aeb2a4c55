"""Child processes that execute the tasks of a batch."""

from __future__ import annotations

import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import islice
from typing import Any, Final, Generic, NamedTuple, Self, TypeVar

from hil.errors import HilError
from identification import IdentificationError
from planner.errors import PlannerCrashed, PlanningTimedOut
from planner.worker import WorkerProcess

from .cache import CacheError

T = TypeVar("T")
T_co = TypeVar("T_co", covariant=True)
Done = Callable[[int], None]

TIMEOUT: Final = 300.0  # s, of one bundle of archives
_AHEAD: Final = 4  # tasks submitted per worker


class Unused(NamedTuple):
    """An archive or campaign that was not used, and why."""

    path: str
    reason: str


@dataclass(frozen=True, eq=False)
class ArchiveTask(Generic[T_co]):
    """A task on archives."""

    path: str  #: file or folder that names the task in errors
    function: Callable[..., T_co]  #: importable in the worker
    arguments: tuple[Any, ...]  #: of the function; pickled, so they should be small


class Workers:
    """Child processes of this one, started on demand, each with a thread that waits for it.

    The default is one for each core that this process may use; a task may last for `timeout` [s].
    Linear algebra has one thread in a child, so the bits do not depend on the number of processes.
    Unlike in a `ProcessPoolExecutor` a process that ends fails one task, which is known.
    """

    def __init__(self, count: int | None = None, *, timeout: float = TIMEOUT) -> None:
        self.count = count or len(os.sched_getaffinity(0))
        self._threads = ThreadPoolExecutor(self.count)
        self._timeout = timeout
        self._own = threading.local()
        self._children: list[WorkerProcess] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """End the processes, and the tasks in them."""
        self._threads.shutdown(wait=False, cancel_futures=True)
        for child in self._children:
            if child.pid is not None:
                os.kill(child.pid, signal.SIGKILL)
        self._threads.shutdown(wait=True)
        for child in self._children:
            child.close()

    def results(
        self, tasks: Sequence[ArchiveTask[T]], done: Done | None = None
    ) -> Iterator[T | Unused]:
        """Yield the results of tasks in their order; later ones are computed meanwhile.

        A task that fails, takes too long, or ends its process twice gives an `Unused`. `done` is
        called with 1 for each result.

        Raises:
            CacheError: the cache cannot be written.
        """
        waiting, begun = iter(tasks), deque[tuple[ArchiveTask[T], Future[T | Unused]]]()
        try:
            while True:
                for task in islice(waiting, _AHEAD * self.count - len(begun)):
                    begun.append((task, self._threads.submit(self._call, task)))
                if not begun:
                    return
                task, future = begun.popleft()
                result = self._result(task, future)
                if done is not None:
                    done(1)
                yield result
        finally:
            for _, future in begun:
                future.cancel()

    def _call(self, task: ArchiveTask[T]) -> T | Unused:
        """Run a task in the child process of this thread."""
        if not hasattr(self._own, "child"):
            self._own.child = WorkerProcess(timeout=self._timeout)
            self._children.append(self._own.child)
        child: WorkerProcess = self._own.child
        return child.call(run_task, task)

    def _result(self, task: ArchiveTask[T], future: Future[T | Unused]) -> T | Unused:
        """Return a result; a task whose worker died is run once more, as another may be to blame.

        Its own archives are reported if the worker dies again.
        """
        for last in (False, True):
            try:
                return future.result()
            except PlanningTimedOut:
                return Unused(task.path, "took too long, so that its process was ended")
            except PlannerCrashed as error:
                if last:
                    reason = f"ended its process, twice, with status {error.status}"
                    return Unused(task.path, reason)
                future = self._threads.submit(self._call, task)
        raise AssertionError


def run_task(task: ArchiveTask[T]) -> T | Unused:
    """Return the result of a task, or why there is none.

    Raises:
        CacheError: the cache cannot be written, which affects every task.
    """
    try:
        return task.function(*task.arguments)
    except CacheError:
        raise
    except Exception as error:
        return Unused(task.path, reason_of(error))


def reason_of(error: Exception) -> str:
    """Return the text of an error; an internal one costs an archive, not the batch."""
    expected = isinstance(error, HilError | IdentificationError)
    return str(error) if expected else f"{type(error).__name__}: {error}"
