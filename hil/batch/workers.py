"""Workers that execute the tasks of a batch: child processes here, or those of a Dask cluster.

Workers of a cluster may join, leave and die.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError, Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass
from importlib.metadata import version
from importlib.util import find_spec
from itertools import islice
from pathlib import Path
from socket import gethostname
from typing import Any, Final, Generic, NamedTuple, Self, TypeVar

from hil.errors import HilError, InputError
from hil.version import install_command
from identification import IdentificationError
from planner.errors import PlannerCrashed, PlanningTimedOut
from planner.worker import WorkerProcess

from .cache import LIBRARIES, CacheError, code_digest

T = TypeVar("T")
T_co = TypeVar("T_co", covariant=True)
Done = Callable[[int], None]

TIMEOUT: Final = 300.0  # s, of one bundle of archives
_AHEAD: Final = 4  # tasks submitted per worker
_RETRIES: Final = 3  # of a task whose worker in a cluster failed
_CLUSTER_AHEAD: Final = 64  # tasks submitted to a cluster, or more with more workers


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


class WorkerSoftwareError(HilError):
    """A worker has other software than the client."""


class Workers:
    """An executor, which runs at most `ahead` tasks before their results are used."""

    local = True  #: whether files they write are readable here under the same names
    died: tuple[type[Exception], ...] = (PlannerCrashed,)  #: errors of a task whose worker ended
    software = ""  #: `software_versions` that workers must have; "" for any

    def __init__(self, executor: Executor, ahead: int = 1) -> None:
        self._executor, self._ahead = executor, ahead

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the workers."""
        self._executor.shutdown(cancel_futures=True)

    def require_folders(self, folders: Sequence[Path]) -> None:
        """Check that workers on other machines have these folders under the same names."""

    def results(
        self, tasks: Sequence[ArchiveTask[T]], done: Done | None = None
    ) -> Iterator[T | Unused]:
        """Yield the results of tasks in their order; later ones are computed meanwhile.

        A task that fails, takes too long, or ends its process twice gives an `Unused`. `done` is
        called with 1 for each result.

        Raises:
            CacheError: the cache cannot be written.
            WorkerSoftwareError: a worker has other software.
        """
        waiting, begun = iter(tasks), deque[tuple[ArchiveTask[T], Future[T | Unused]]]()
        try:
            while True:
                for task in islice(waiting, self._ahead - len(begun)):
                    begun.append((task, self._begin(task)))
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

    def _begin(self, task: ArchiveTask[T]) -> Future[T | Unused]:
        return self._executor.submit(run_task, task, self.software)

    def _result(self, task: ArchiveTask[T], future: Future[T | Unused]) -> T | Unused:
        """Return a result; a task whose worker died is run once more, as another may be to blame.

        Its own archives are reported if the worker dies again.
        """
        for last in (False, True):
            try:
                return future.result()
            except PlanningTimedOut:
                return Unused(task.path, "took too long, so that its process was ended")
            except self.died as error:
                if last:
                    status = getattr(error, "status", "unknown")
                    return Unused(task.path, f"ended its process, twice, with status {status}")
                future = self._begin(task)
        raise AssertionError


class LocalWorkers(Workers):
    """Child processes of this one, started on demand.

    The default is one for each core that this process may use; a task may last for `timeout` [s].
    Linear algebra has one thread in a child, so the bits do not depend on the number of processes.
    """

    def __init__(self, count: int | None = None, *, timeout: float = TIMEOUT) -> None:
        self.count = count or len(os.sched_getaffinity(0))
        super().__init__(ChildExecutor(self.count, timeout), _AHEAD * self.count)


class ChildExecutor(ThreadPoolExecutor):
    """Threads with a child process each, which runs their calls for at most `timeout` [s].

    Unlike in a `ProcessPoolExecutor` a process that ends fails one call, which is known.
    """

    def __init__(self, count: int, timeout: float) -> None:
        super().__init__(count)
        self._timeout = timeout
        self._own = threading.local()
        self._children: list[WorkerProcess] = []

    def submit(self, function: Callable[..., T], /, *args: Any, **kwargs: Any) -> Future[T]:
        """Call a function in a child process."""
        return super().submit(self._call, function, *args, **kwargs)

    def _call(self, function: Callable[..., T], *args: Any, **kwargs: Any) -> T:
        if not hasattr(self._own, "child"):
            self._own.child = WorkerProcess(timeout=self._timeout)
            self._children.append(self._own.child)
        child: WorkerProcess = self._own.child
        return child.call(function, *args, **kwargs)

    def shutdown(self, *_: object, **__: object) -> None:
        """End the processes, and the calls in them."""
        super().shutdown(wait=False, cancel_futures=True)
        for child in self._children:
            if child.pid is not None:
                os.kill(child.pid, signal.SIGKILL)
        super().shutdown(wait=True)
        for child in self._children:
            child.close()


class ClusterError(HilError):
    """The cluster is lost or cannot be used."""


class DaskWorkers(Workers):
    """The workers of a Dask cluster, which is imported when this is used.

    Args:
        address: of the scheduler, such as ``tcp://host:8786``.
        patience: longest wait for scheduler and workers [s].

    Raises:
        InputError: Dask is not installed, or no scheduler answers at the address.
        ClusterError: no worker joins in time.
    """

    local = False

    def __init__(self, address: str, *, patience: float = 30.0) -> None:
        if find_spec("distributed") is None:
            problem = "a cluster needs the package distributed, which is not installed"
            remedy = f"install it with: {install_command('cluster')}"
            raise InputError(None, problem, field="--dask", remedy=remedy)
        from distributed import Client, KilledWorker

        client: Any = Client
        try:
            self._client = client(address, timeout=patience, set_as_default=False)
        except (OSError, ValueError) as error:
            problem = f"no Dask scheduler answers at {address} ({error or type(error).__name__})"
            remedy = "start one with: dask scheduler"
            raise InputError(None, problem, field="--dask", remedy=remedy) from error
        try:
            self._client.wait_for_workers(1, timeout=patience)
        except TimeoutError:
            self._client.close()
            raise ClusterError(
                f"the Dask scheduler at {address} has no worker after {patience:g} s; start some: "
                f"dask worker {address} --nthreads 1"
            ) from None
        threads = int(sum(self._client.nthreads().values()))
        executor = self._client.get_executor(pure=False, retries=_RETRIES)
        super().__init__(executor, max(_CLUSTER_AHEAD, _AHEAD * threads))
        self.died, self.software = (KilledWorker,), software_versions()

    def close(self) -> None:
        """Disconnect from the cluster."""
        self._executor.shutdown(wait=False)  # cancels what has not ended
        self._client.close()

    def require_folders(self, folders: Sequence[Path]) -> None:
        """Check that every worker has these folders under the same names.

        Raises:
            ClusterError: one does not.
        """
        for folder in folders:
            path = folder.resolve()
            for worker, seen in self._client.run(Path.exists, path, on_error="return").items():
                if seen is not True:
                    raise ClusterError(
                        f"the worker {worker} does not see {path}; share it with the workers under"
                        " the same name"
                    )

    def _result(self, task: ArchiveTask[T], future: Future[T | Unused]) -> T | Unused:
        try:
            return super()._result(task, future)
        except HilError:
            raise
        except CancelledError as error:
            raise ClusterError(
                "the Dask scheduler dropped the work: it was ended or restarted; finished results"
                " are in the cache"
            ) from error
        except Exception as error:
            raise ClusterError(
                f"a worker cannot run a task ({type(error).__name__}: {error}); install the same"
                " hil and constraints.txt on all machines"
            ) from error


# In a worker


def run_task(task: ArchiveTask[T], software: str = "") -> T | Unused:
    """Return the result of a task, or why there is none.

    Raises:
        CacheError: the cache cannot be written, which affects every task.
        WorkerSoftwareError: the worker has other software than `software`, if that is given.
    """
    if software and software != (own := software_versions()):
        raise WorkerSoftwareError(
            f"the worker on {gethostname()} has other software than this machine ({own} instead of"
            f" {software}); install the same hil and constraints.txt on both, and start it again"
        )
    try:
        return task.function(*task.arguments)
    except CacheError:
        raise
    except Exception as error:
        return Unused(task.path, reason_of(error))


def software_versions() -> str:
    """Return the versions that determine the bits of a result: code, Python and libraries."""
    libraries = [f"{name} {version(name)}" for name in LIBRARIES]
    python = ".".join(str(part) for part in sys.version_info[:3])
    return ", ".join([f"hil {code_digest():.12}", f"python {python}", *libraries])


def reason_of(error: Exception) -> str:
    """Return the text of an error; an internal one costs an archive, not the batch."""
    expected = isinstance(error, HilError | IdentificationError)
    return str(error) if expected else f"{type(error).__name__}: {error}"
