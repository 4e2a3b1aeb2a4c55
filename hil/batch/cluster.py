"""Re-identification on a Dask cluster: archives are read on its workers.

Workers may join, leave and die: what a dead worker held is made anew, as Dask does from the tasks
it holds. Dask is imported here, and only when it is called.
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

_LOOK: Final = 2.0
"""s between looks at the cluster while nothing comes from it."""
_RETRIES: Final = 3
"""How often a task is given out anew for reasons that are not its own."""
_AHEAD: Final = 8
"""Tasks given out per thread of the cluster: enough that none waits, few enough to keep in mind."""

_LOST: Final = Unused("", "ended every worker that read it")


class ClusterError(HilError):
    """The cluster is gone, or cannot be used."""


class DaskWorkers(Workers):
    """The workers of a Dask cluster.

    The scheduler has an address such as ``tcp://host:8786``; a task may last for `timeout`, and
    scheduler and worker are waited for with `patience` [s].

    Raises:
        InputError: Dask is not installed, or no scheduler answers at the address.
        ClusterError: no worker joins in time, or one has other software.
    """

    local = False

    def __init__(self, address: str, *, timeout: float = TIMEOUT, patience: float = 30.0) -> None:
        self._patience = patience
        self._client = _connected(address, patience)
        expected = software_versions()
        self._work = partial(perform_task, timeout=timeout, expected=expected)
        try:
            self._client.wait_for_workers(1, timeout=patience)
            for worker, found in self._on_all(software_versions).items():
                if apart := version_differences(expected, found):
                    raise ClusterError(
                        f"the worker {worker} has other software than this machine ({apart}); "
                        "install the same hil and constraints.txt on both, and start it again"
                    )
        except TimeoutError:
            self._client.close()
            raise ClusterError(
                f"the Dask scheduler at {address} has no worker after {patience:g} s; start some: "
                f"dask worker {address} --nthreads 1"
            ) from None
        except BaseException:
            self._client.close()
            raise
        self.count = self._threads()

    @property
    def n_workers(self) -> int:
        """How many there are now."""
        return len(self._client.nthreads())

    def close(self) -> None:
        """Leave the cluster to others."""
        if self._connected:
            self._on_all(release_children)
        self._client.close()

    def require_folders(self, folders: Sequence[Path]) -> None:
        """Check that every worker sees folders under the same names as this machine does.

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
            ClusterError: all workers, or the scheduler, are gone for longer than the patience.
            WorkerSoftwareError: a worker that joined later runs other software.
        """
        waiting, begun = iter(tasks), deque[tuple[ArchiveTask[T], Any]]()
        most = 0
        try:
            while True:
                if len(begun) <= most // 2:  # each look at the cluster takes milliseconds
                    most = _AHEAD * self._threads()
                    for task in islice(waiting, max(0, most - len(begun))):
                        begun.append((task, self._begin(task)))
                if not begun:
                    return
                task, future = begun.popleft()
                result = self._result(future)
                if result is _LOST:  # perhaps by another task: again with nothing beside
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
        """What a function returns or raises, by worker."""
        found: dict[str, Any] = self._client.run(function, *arguments, on_error="return")
        return found

    def _result(self, future: Any) -> Any:
        """What came of a task, or what it raised; `_LOST` if every worker that took it up died."""
        from distributed import KilledWorker

        self._wait(future)
        if future.status not in ("finished", "error"):
            raise ClusterError("the Dask scheduler dropped the work: it was ended or started anew")
        error = future.exception()
        if isinstance(error, KilledWorker):
            return _LOST
        if error is not None:
            raise error
        return future.result()

    def _begin(self, task: ArchiveTask[Any]) -> Any:
        return self._client.submit(self._work, task, pure=False, retries=_RETRIES)

    def _wait(self, future: Any) -> None:
        """Wait for a run; see meanwhile that there is somebody to wait for."""
        last_seen = monotonic()
        while future.status in ("pending", "lost"):  # lost with a worker: it is made anew
            ended = threading.Event()
            future.add_done_callback(lambda _, event=ended: event.set())
            ended.wait(_LOOK)
            if self._connected and self.n_workers:
                last_seen = monotonic()
            elif monotonic() - last_seen > self._patience:
                missing = "all workers" if self._connected else "the scheduler"
                raise ClusterError(
                    f"{missing} of the Dask cluster went away and did not come back within "
                    f"{self._patience:g} s; what was finished is in the cache"
                )


def _connected(address: str, patience: float) -> Any:
    if find_spec("distributed") is None:
        raise InputError(
            None,
            "a cluster needs the package distributed, which is not installed",
            field="--dask",
            remedy=f"install it with: {install_command('cluster')}",
        )
    from distributed import Client

    client: Any = Client
    try:
        return client(address, timeout=patience, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError(
            None,
            f"no Dask scheduler answers at {address} ({str(error) or type(error).__name__})",
            field="--dask",
            remedy="start one with: dask scheduler",
        ) from error


# On a worker


def software_versions() -> dict[str, str]:
    """What decides about the bits of a result here: this code, and what it computes with."""
    python = ".".join(str(part) for part in sys.version_info[:3])
    return {"hil": code_digest(), "python": python} | {name: version(name) for name in LIBRARIES}


def version_differences(here: Mapping[str, str], there: Mapping[str, str] | Exception) -> str:
    """What is other there, in words; empty if nothing."""
    if isinstance(there, Exception):
        return str(there)
    return ", ".join(
        f"{name} {there.get(name, 'none'):.12} instead of {here[name]:.12}"
        for name in here
        if there.get(name) != here[name]
    )


def perform_task(
    task: ArchiveTask[T], *, timeout: float, expected: Mapping[str, str]
) -> T | Unused:
    """Do a task in a child process.

    It may last for `timeout` [s]; `expected` is the `software_versions` of whoever asks.

    Raises:
        WorkerSoftwareError: other software runs here.
        PlannerNotStarted: no child process can be started here.
    """
    checked = ArchiveTask[T | Unused](task.path, _checked, (task, expected))
    with _borrowed(timeout) as child:
        (found,) = child.results([checked])
        return found


def _checked(task: ArchiveTask[T], expected: Mapping[str, str]) -> T | Unused:
    """In the child: what comes of a task, by the same code as the caller's."""
    if other := version_differences(expected, software_versions()):
        raise WorkerSoftwareError(f"a worker runs other software: {other}")
    return run_task(task)


_lock = threading.Lock()
_idle: defaultdict[float, list[LocalWorkers]] = defaultdict(list)


@contextmanager
def _borrowed(timeout: float) -> Iterator[LocalWorkers]:
    """A child of one's own, warm where one is idle; a worker may have several threads."""
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
