"""Re-identification on a Dask cluster, whose workers may join, leave and die.

Dask is imported only when it is used.
"""

from __future__ import annotations

import sys
import threading
from collections import defaultdict, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from importlib.metadata import version
from importlib.util import find_spec
from itertools import islice
from pathlib import Path
from socket import gethostname
from time import monotonic
from typing import Any, Final, TypeVar

from hil.errors import HilError, InputError
from hil.version import install_command

from .cache import LIBRARIES, code_digest
from .types import Unused
from .workers import (
    TIMEOUT,
    ArchiveTask,
    Done,
    LocalWorkers,
    Workers,
    WorkerSoftwareError,
    run_task,
)

T = TypeVar("T")

_POLL: Final = 2.0  # s, between polls of the cluster while no result arrives
_RETRIES: Final = 3  # of a task whose worker failed
_AHEAD: Final = 8  # tasks submitted per thread of the cluster

_INSTALL: Final = "install the same hil and constraints.txt on both, and start it again"
_LOST: Final = Unused("", "ended every worker that read it")


class ClusterError(HilError):
    """The cluster is lost or cannot be used."""


class DaskWorkers(Workers):
    """The workers of a Dask cluster.

    Args:
        address: of the scheduler, such as ``tcp://host:8786``.
        timeout: longest time of a task [s].
        patience: longest wait for scheduler and workers [s].

    Raises:
        InputError: Dask is not installed, or no scheduler answers at the address.
        ClusterError: no worker joins in time.
    """

    local = False

    def __init__(self, address: str, *, timeout: float = TIMEOUT, patience: float = 30.0) -> None:
        self._patience = patience
        self._client = _connected(address, patience)
        self._work = partial(perform_task, timeout=timeout, expected=software_versions())
        try:
            self._client.wait_for_workers(1, timeout=patience)
        except TimeoutError:
            self._client.close()
            raise ClusterError(
                f"the Dask scheduler at {address} has no worker after {patience:g} s; start some: "
                f"dask worker {address} --nthreads 1"
            ) from None

    def close(self) -> None:
        """Disconnect from the cluster."""
        if self._connected:
            self._on_all(release_children)
        self._client.close()

    def require_folders(self, folders: Sequence[Path]) -> None:
        """Check that every worker has these folders under the same names.

        Raises:
            ClusterError: one does not.
        """
        for folder in folders:
            for worker, seen in self._on_all(Path.exists, folder.resolve()).items():
                if seen is not True:
                    raise ClusterError(
                        f"the worker {worker} does not see {folder.resolve()}; share it with the "
                        "workers under the same name, or name an address such as s3://..."
                    )

    def results(
        self, tasks: Sequence[ArchiveTask[T]], done: Done | None = None
    ) -> Iterator[T | Unused]:
        """See :class:`Workers`.

        Raises:
            ClusterError: all workers, or the scheduler, are lost for longer than the patience.
            WorkerSoftwareError: a worker has other software.
        """
        waiting, begun = iter(tasks), deque[tuple[ArchiveTask[T], Any]]()
        most = 0
        try:
            while True:
                if len(begun) <= most // 2:  # a poll of the cluster takes milliseconds
                    most = _AHEAD * self._threads()
                    for task in islice(waiting, max(0, most - len(begun))):
                        begun.append((task, self._begin(task)))
                if not begun:
                    return
                task, future = begun.popleft()
                result = self._result(future)
                if result is _LOST:  # perhaps because of another task: repeat it alone
                    for other in begun:
                        self._wait(other[1])
                    result = self._result(self._begin(task))
                if done is not None:
                    done(1)
                yield Unused(task.path, _LOST.reason) if result is _LOST else result
        finally:
            if self._connected:
                self._client.cancel([future for _, future in begun])

    @property
    def _connected(self) -> bool:
        return bool(self._client.status == "running")

    def _threads(self) -> int:
        return max(1, int(sum(self._client.nthreads().values())))

    def _on_all(self, function: Callable[..., Any], *arguments: Any) -> dict[str, Any]:
        """Return the result or exception of a function by worker."""
        found: dict[str, Any] = self._client.run(function, *arguments, on_error="return")
        return found

    def _result(self, future: Any) -> Any:
        """Return the result of a task or raise its error; `_LOST` if all its workers died."""
        from distributed import KilledWorker

        self._wait(future)
        if future.status not in ("finished", "error"):
            raise ClusterError("the Dask scheduler dropped the work: it was ended or restarted")
        error = future.exception()
        if isinstance(error, KilledWorker):
            return _LOST
        if isinstance(error, HilError):
            raise error
        if error is not None:
            raise ClusterError(
                f"a worker cannot run a task ({type(error).__name__}: {error}); {_INSTALL}"
            ) from error
        return future.result()

    def _begin(self, task: ArchiveTask[Any]) -> Any:
        return self._client.submit(self._work, task, pure=False, retries=_RETRIES)

    def _wait(self, future: Any) -> None:
        """Wait for a task, while there is a scheduler with workers."""
        last_seen = monotonic()
        while future.status in ("pending", "lost"):  # lost with a worker: computed again
            ended = threading.Event()
            future.add_done_callback(lambda _, event=ended: event.set())
            ended.wait(_POLL)
            if self._connected and self._client.nthreads():
                last_seen = monotonic()
            elif monotonic() - last_seen > self._patience:
                missing = "all workers" if self._connected else "the scheduler"
                raise ClusterError(
                    f"{missing} of the Dask cluster disappeared and did not return within "
                    f"{self._patience:g} s; finished results are in the cache"
                )


def _connected(address: str, patience: float) -> Any:
    if find_spec("distributed") is None:
        problem = "a cluster needs the package distributed, which is not installed"
        remedy = f"install it with: {install_command('cluster')}"
        raise InputError(None, problem, field="--dask", remedy=remedy)
    from distributed import Client

    client: Any = Client
    try:
        return client(address, timeout=patience, set_as_default=False)
    except (OSError, ValueError) as error:
        problem = f"no Dask scheduler answers at {address} ({str(error) or type(error).__name__})"
        remedy = "start one with: dask scheduler"
        raise InputError(None, problem, field="--dask", remedy=remedy) from error


# On a worker


def software_versions() -> dict[str, str]:
    """Return the versions that determine the bits of a result: code, Python and libraries."""
    python = ".".join(str(part) for part in sys.version_info[:3])
    return {"hil": code_digest(), "python": python} | {name: version(name) for name in LIBRARIES}


def perform_task(
    task: ArchiveTask[T], *, timeout: float, expected: Mapping[str, str]
) -> T | Unused:
    """Run a task in a child process of a worker, for at most `timeout` [s].

    `expected` are the `software_versions` of the client.

    Raises:
        WorkerSoftwareError: the worker has other software.
        PlannerNotStarted: no child process can be started.
    """
    checked = ArchiveTask[T | Unused](task.path, _checked, (task, expected))
    with _borrowed(timeout) as child:
        (found,) = child.results([checked])
        return found


def _checked(task: ArchiveTask[T], expected: Mapping[str, str]) -> T | Unused:
    """Run a task in the child, which must have the same software as the client."""
    for name, here in software_versions().items():
        if here != expected[name]:
            raise WorkerSoftwareError(
                f"the worker on {gethostname()} has other software than this machine"
                f" ({name} {here:.12} instead of {expected[name]:.12}); {_INSTALL}"
            )
    return run_task(task)


_lock = threading.Lock()
_idle: defaultdict[float, list[LocalWorkers]] = defaultdict(list)


@contextmanager
def _borrowed(timeout: float) -> Iterator[LocalWorkers]:
    """Yield a child process, an idle one if there is one; a worker may have several threads."""
    with _lock:
        child = _idle[timeout].pop() if _idle[timeout] else LocalWorkers(1, timeout=timeout)
    try:
        yield child
    finally:
        with _lock:
            _idle[timeout].append(child)


def release_children() -> None:
    """End the idle child processes."""
    with _lock:
        while _idle:
            for child in _idle.popitem()[1]:
                child.close()
