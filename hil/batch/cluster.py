"""Clusters that execute the tasks of a batch.

Few archives run in a thread of this process, others on a local Dask cluster of one process
per core, or on the cluster of a scheduler. Linear algebra has one thread in the processes of a
local cluster, so that the bits do not depend on their number.
"""

from __future__ import annotations

import logging
import os
import signal
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from concurrent.futures import Future as LocalFuture
from contextlib import ExitStack
from dataclasses import dataclass
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any, Final, Generic, NamedTuple, Self, TypeAlias, TypeVar
from uuid import uuid4

from hil.base.errors import HilError, InputError
from hil.base.progress import Reporter, Silent
from hil.base.threads import VARIABLES
from hil.base.version import software
from identification import IdentificationError

from .cache import CacheError, code_digest

if TYPE_CHECKING:  # half a second, only for those who use it
    from distributed import Client, Future, Worker

AnyFuture: TypeAlias = "Future | LocalFuture[Any]"
T = TypeVar("T")
T_co = TypeVar("T_co", covariant=True)

MAX_ARCHIVES_IN_PROCESS: Final = 32
"""Archives that are read in this process: a cluster takes two seconds to start, as do these.

By a thread pool of Python. Dask's own cluster in a thread takes half a second to import, to start
and to end, as long as a batch of a hundred cached archives; `dask.get`, without a cluster, takes
0.09 s to import.
"""

CONNECT_TIMEOUT: Final = 10.0  # s, for a scheduler to answer
WORKER_TIMEOUT: Final = 60.0  # s, for a worker of a scheduler to be there
_WORKER_POLL_PERIOD: Final = 1.0  # s between looks at the workers while no task ends

_LOGGERS: Final = ("distributed", "tornado.application")
"""Loggers of what a `Cluster` reports in a sentence, or of heartbeats while a worker ends."""
_THIS_PC: Final = "127.0.0.1:0"  # by default the dashboard is open to the network
_CONFIGURATION: Final = {
    "distributed.nanny.pre-spawn-environ": {
        **dict.fromkeys(VARIABLES, 1),
        # Memory of arrays is used again: returned to the system after each, as Dask sets it, its
        # pages cost a third of the time of an archive.
        "MALLOC_TRIM_THRESHOLD_": 1 << 28,
        "MALLOC_MMAP_THRESHOLD_": 1 << 25,
        "MALLOC_TOP_PAD_": 1 << 26,
    },
    "distributed.scheduler.allowed-failures": 1,  # another task may have ended the process first
    "distributed.worker.preload": [__name__],
    "distributed.worker.profile.enabled": False,
    # Looks at clocks and memory many times a second, which take some per cent of a core each.
    "distributed.admin.tick.interval": "1s",
    "distributed.admin.tick.limit": "30s",
    "distributed.admin.system-monitor.interval": "2s",
    "distributed.worker.memory.monitor-interval": "1s",
    "distributed.comm.retry.count": 3,
}


class SkippedArchive(NamedTuple):
    """An archive or campaign that was not used, and why.

    Attributes:
        reason: without the archive that it is a copy of.
        copy_of: that archive, "" for none.
        noun: what it is, for a count of the skipped ones, such as "move".
    """

    path: str
    reason: str
    copy_of: str = ""
    noun: str = "unusable recording"

    @property
    def message(self) -> str:
        """The whole reason."""
        return f"{self.reason} of {self.copy_of}" if self.copy_of else self.reason

    def as_json(self) -> dict[str, str]:
        """Return it for programs."""
        return {"path": self.path, "reason": self.message}


class ClusterError(HilError):
    """A cluster that ended, has no workers, or has workers of another version."""


@dataclass(frozen=True, eq=False)
class ClusterTask(Generic[T_co]):
    """A call in a worker."""

    path: str  #: file or folder that names the task in errors
    function: Callable[..., T_co]  #: importable in the worker
    arguments: tuple[Any, ...]  #: pickled, so they should be small; futures become their results


class Cluster:
    """A thread of this process or a Dask cluster, started when it is needed.

    Args:
        workers: number of local processes; by default one for each core that this process may use,
            and none for few archives.
        scheduler: address of a running scheduler, whose workers are used.
        reporter: reports which workers there are, and the address of the dashboard.

    Raises:
        InputError: both a number of workers and a scheduler are given.
    """

    def __init__(
        self,
        workers: int | None = None,
        *,
        scheduler: str | None = None,
        reporter: Reporter | None = None,
    ) -> None:
        if workers is not None and scheduler is not None:
            problem = "a running cluster has its own workers"
            remedy = "omit --workers, or --scheduler"
            raise InputError(None, problem, field="--workers", remedy=remedy)
        self._workers = workers
        self._scheduler = scheduler
        self._reporter = Silent() if reporter is None else reporter
        self._open = ExitStack()
        self._client: Client | ThreadPoolExecutor | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Cancel all tasks and end the workers that were started here."""
        self._close()

    def _close(self) -> None:
        self._client = None
        self._open.close()

    # Clients

    def client(self, archives: int) -> Client | ThreadPoolExecutor:
        """Return a client of Dask, or one thread for few archives.

        Raises:
            InputError: no scheduler answers at the address.
            ClusterError: the scheduler has no worker, or one of another version.
        """
        few = (
            archives <= MAX_ARCHIVES_IN_PROCESS
            and self._workers is None
            and self._scheduler is None
        )
        if isinstance(self._client, ThreadPoolExecutor) and not few:
            self._close()
        if self._client is None:
            if few:
                self._client = ThreadPoolExecutor(1)
                self._open.callback(self._client.shutdown, cancel_futures=True)
            else:
                self._client = self._started()
        return self._client

    def _started(self) -> Client:
        for logger in map(logging.getLogger, _LOGGERS):
            self._open.callback(logger.setLevel, logger.level)
            logger.setLevel(logging.CRITICAL)
        return self._local() if self._scheduler is None else self._connected(self._scheduler)

    def _local(self) -> Client:
        import dask
        from distributed import Client, LocalCluster

        count = self._workers or len(os.sched_getaffinity(0))
        self._open.enter_context(dask.config.set(_CONFIGURATION))
        try:
            cluster = LocalCluster(
                n_workers=count,
                threads_per_worker=1,
                dashboard_address=_THIS_PC,
                silence_logs=logging.CRITICAL,
            )
        except RuntimeError as error:
            raise ClusterError(
                f"{count} workers of Dask did not start ({error}); try fewer with --workers"
            ) from error
        self._open.enter_context(cluster)
        client = Client(cluster, set_as_default=False)
        self._open.callback(client.close)
        self._reporter.step(f"{count} workers on this PC; dashboard {cluster.dashboard_link}")
        return client

    def _connected(self, address: str) -> Client:
        from distributed import Client

        try:
            client = Client(address, timeout=CONNECT_TIMEOUT, set_as_default=False)
        except (OSError, ValueError) as error:
            raise InputError(
                None,
                f"no Dask scheduler answers at {address}",
                field="--scheduler",
                remedy="start one with `dask scheduler`, or give the address that it prints, such"
                " as tcp://host:8786",
            ) from error
        self._open.callback(client.close)
        try:
            client.wait_for_workers(1, timeout=WORKER_TIMEOUT)
        except TimeoutError as error:
            raise self._without_workers() from error
        self._require_same_code(client)
        count = len(client.scheduler_info(n_workers=-1)["workers"])
        self._reporter.step(f"{count} workers of {address}; dashboard {client.dashboard_link}")
        return client

    def _require_same_code(self, client: Client) -> None:
        """Raise a `ClusterError` if a worker has other programs than this process."""
        try:
            digests = client.run(code_digest, on_error="return")
        except Exception as error:
            digests = {self._scheduler: error}
        for address, digest in digests.items():
            if digest != code_digest():
                raise other_version(str(address))

    def _without_workers(self) -> ClusterError:
        return ClusterError(
            f"the Dask scheduler {self._scheduler} has no worker since {WORKER_TIMEOUT:.0f} s;"
            f" start some with `dask worker {self._scheduler}` and run the command again: what was"
            " computed is in the cache"
        )

    # Tasks

    def submit(self, task: ClusterTask[Any], *, archives: int) -> AnyFuture:
        """Submit a task with the number of archives that it reads."""
        arguments = (code_digest(), task.path, task.function, *task.arguments)
        client = self.client(archives)
        if isinstance(client, ThreadPoolExecutor):
            return client.submit(_run_with_results, arguments)
        key = f"{task.function.__name__}-{uuid4().hex}"
        return client.submit(run_task, *arguments, key=key, pure=False)

    def completed(self, futures: Iterable[AnyFuture]) -> Iterator[AnyFuture]:
        """Yield futures when they are done, in any order, and keep none of them.

        Raises:
            ClusterError: the scheduler does not answer any more, or has no worker left.
            CacheError: the cache cannot be written.
        """
        done: SimpleQueue[AnyFuture] = SimpleQueue()
        count = 0
        future: AnyFuture | None = None
        for future in futures:
            future.add_done_callback(done.put)
            count += 1
        del future
        since = time.monotonic()
        while count:
            try:
                future = done.get(timeout=_WORKER_POLL_PERIOD)
            except Empty:
                since = self._watch(since)
                continue
            since = time.monotonic()
            count -= 1
            if future.cancelled():
                raise self._without_scheduler()
            error = error_of(future)
            if error is not None and not _is_death(error):
                raise _unexpected(error)
            yield future
            del future

    def outcome_of(self, future: AnyFuture) -> Any:
        """Return the result of a task that is done, or a `Death`.

        A result that is lost with its worker is computed again, which may end in one, too.

        Raises:
            ClusterError: the scheduler ended before the result was fetched from it.
        """
        try:
            return future.result()
        except HilError:
            raise
        except Exception as error:
            if _is_death(error):
                return Death()
            if isinstance(error, OSError | RuntimeError | CancelledError):
                raise self._without_scheduler() from error
            raise

    def _without_scheduler(self) -> ClusterError:
        address = self._scheduler or "of this PC"
        return ClusterError(
            f"the Dask scheduler {address} does not answer any more; start it and run the command"
            " again: what was computed is in the cache"
        )

    def _watch(self, since: float) -> float:
        """Return since when there is a worker, or raise a `ClusterError` after `WORKER_TIMEOUT`."""
        client = self._client
        if self._scheduler is None or client is None or isinstance(client, ThreadPoolExecutor):
            return time.monotonic()  # processes of this PC are started again
        if client.scheduler_info(n_workers=-1)["workers"]:
            return time.monotonic()
        if time.monotonic() - since > WORKER_TIMEOUT:
            raise self._without_workers()
        return since

    def results(
        self,
        tasks: Sequence[ClusterTask[T]],
        done: Callable[[int], None] | None = None,
        *,
        archives: int | None = None,
    ) -> list[T | SkippedArchive]:
        """Return the results of tasks in their order.

        A task that fails gives a `SkippedArchive`, as does one that ends its process, again when it
        runs alone. `done` is called with 1 for each result; `archives` are read, by default one a
        task.

        Raises:
            ClusterError: the scheduler does not answer any more, or has no worker left.
            CacheError: the cache cannot be written.
        """
        if not tasks:
            return []
        count = len(tasks) if archives is None else archives
        places: dict[int, int] = {}  # by the identity of futures, none of which is held
        results: dict[int, T | SkippedArchive] = {}
        deaths: list[int] = []

        def submitted() -> Iterator[AnyFuture]:
            for number, task in enumerate(tasks):
                future = self.submit(task, archives=count)
                places[id(future)] = number
                yield future

        for future in self.completed(submitted()):
            number = places[id(future)]
            result = self.outcome_of(future)
            if isinstance(result, Death):
                deaths.append(number)
            else:
                results[number] = result
            if done is not None:
                done(1)
        for number in deaths:  # another task of the process may have ended it
            results[number] = self._alone(tasks[number], count)
        return [results[number] for number in range(len(tasks))]

    def _alone(self, task: ClusterTask[T], archives: int) -> T | SkippedArchive:
        (future,) = self.completed(iter([self.submit(task, archives=archives)]))
        result: T | SkippedArchive | Death = self.outcome_of(future)
        if isinstance(result, Death):
            return SkippedArchive(task.path, "crashed the process that read it, twice")
        return result


def _unexpected(error: BaseException) -> BaseException:
    """Return an error of the cluster or its cache, or that about a worker that has no hil."""
    if isinstance(error, HilError):
        return error
    return ClusterError(
        f"a Dask worker cannot run the tasks of hil ({type(error).__name__}: {error}); install the"
        " same version of hil there and start it again"
    )


def error_of(future: AnyFuture) -> BaseException | None:
    """Return the error of a future that is done; Dask's is read only if there is one."""
    if isinstance(future, LocalFuture) or future.status == "error":
        error: BaseException | None = future.exception()
        return error
    return None


def _run_with_results(arguments: tuple[Any, ...]) -> Any:
    """Run a task in the thread that ran all before it: futures in it have results."""
    return run_task(*map(_with_results, arguments))


def _with_results(argument: Any) -> Any:
    if isinstance(argument, LocalFuture):
        return argument.result()
    return [*map(_with_results, argument)] if isinstance(argument, list) else argument


class Death:
    """In place of a result: the task, or one that it depends on, ended its process repeatedly."""


def _is_death(error: BaseException) -> bool:
    from distributed import KilledWorker

    return isinstance(error, KilledWorker)


def dask_setup(worker: Worker) -> None:
    """Leave Ctrl-C and errors to the client; called in the workers that a `Cluster` starts."""
    del worker
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    for logger in map(logging.getLogger, _LOGGERS):
        logger.setLevel(logging.CRITICAL)


def run_task(
    code: str, path: str, function: Callable[..., T], *arguments: Any
) -> T | SkippedArchive:
    """Return the result of a task, or why there is none.

    Raises:
        ClusterError: this worker has other programs than the client, of this digest.
        CacheError: the cache cannot be written, which affects every task.
    """
    if code != code_digest():
        from distributed import get_worker

        raise other_version(get_worker().address)
    try:
        return function(*arguments)
    except CacheError:
        raise
    except Exception as error:
        return SkippedArchive(path, reason_of(error, path))


def other_version(address: str) -> ClusterError:
    """Return the error about a worker with other programs."""
    versions = ", ".join(f"{name} {number}" for name, number in software().items())
    return ClusterError(
        f"the Dask worker {address} has another version of hil, numpy, scipy or pin, so that its"
        f" numbers would differ; install the same there and start it again: {versions}"
    )


def reason_of(error: Exception, path: str) -> str:
    """Return the text of an error next to a path; an internal one costs only its archive."""
    if isinstance(error, InputError):
        return error.message_next_to(path)
    expected = isinstance(error, HilError | IdentificationError)
    return str(error) if expected else f"{type(error).__name__}: {error}"
