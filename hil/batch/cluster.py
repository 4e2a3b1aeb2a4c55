"""Re-identification on a Dask cluster: archives are read, and runs of them added up, on workers.

Workers may join, leave and die: what a dead worker held is made anew, as Dask does from the tasks
it holds. Dask is imported here, and only when it is called.
"""

from __future__ import annotations

import sys
import threading
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache, partial
from importlib.metadata import version
from importlib.util import find_spec
from itertools import islice
from pathlib import Path
from queue import Empty, SimpleQueue
from time import monotonic
from typing import Any, Final, TypeVar

from hil.errors import HilError, InputError
from hil.version import install_command

from .cache import LIBRARIES
from .types import Broken
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
Identity = Callable[[], str]

_LOOK: Final = 2.0
"""s between looks at the cluster while nothing comes from it."""
_RETRIES: Final = 3
"""How often a task is given out anew for reasons that are not its own."""
_AHEAD: Final = 4
"""Tasks given out per thread of the cluster: enough that none waits, few enough to keep in mind."""
_LOST: Final = Broken("", "ended every worker that read it")


class ClusterError(HilError):
    """The cluster is gone, or cannot be used."""


class DaskWorkers(Workers):
    """The workers of a Dask cluster.

    Args:
        address: of its scheduler, such as ``tcp://host:8786``.
        identity: digest of the code that computes; importable on the workers.
        timeout: longest time for one task [s].
        patience: longest time to wait for a scheduler, and for a worker [s].

    Raises:
        InputError: Dask is not installed, or no scheduler answers at the address.
        ClusterError: no worker joins in time, or one has other software.
    """

    near = False

    def __init__(
        self, address: str, *, identity: Identity, timeout: float = TIMEOUT, patience: float = 30.0
    ) -> None:
        self._patience = patience
        self._last_seen, self._last_look, self.count = monotonic(), -_LOOK, 1
        self._work = partial(
            perform, timeout=timeout, identity=identity, expected=software(identity)
        )
        self._client = _connected(address, patience)
        try:
            self._client.wait_for_workers(1, timeout=patience)
            self._require_software(identity)
            self._ahead()
        except TimeoutError:
            self._client.close()
            raise ClusterError(
                f"the Dask scheduler at {address} has no worker after {patience:g} s; start some: "
                f"dask worker {address} --nthreads 1"
            ) from None
        except BaseException:
            self._client.close()
            raise

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
    ) -> Iterator[T | Broken]:
        """See :class:`Workers`.

        Raises:
            ClusterError: all workers, or the scheduler, are gone for longer than the patience.
            WorkerSoftwareError: a worker that joined later runs other software.
        """
        waiting, found = iter(range(len(tasks))), dict[int, Any]()
        busy, ended = dict[int, Any](), SimpleQueue[int]()
        suspects: list[int] = []  # begun when workers died: again one by one, with nothing beside

        def begin(k: int) -> None:
            busy[k] = self._client.submit(self._work, tasks[k], pure=False, retries=_RETRIES)
            busy[k].add_done_callback(lambda _: ended.put(k))

        try:
            for k, task in enumerate(tasks):
                while k not in found:
                    for another in islice(waiting, max(0, self._ahead() - len(busy) - len(found))):
                        begin(another)
                    alone = not busy
                    if alone:
                        begin(suspects.pop(0))
                    other = self._next(ended)
                    result = _result(busy.pop(other))
                    if result is _LOST and not alone:
                        suspects.append(other)
                        continue
                    found[other] = result
                    if done is not None:
                        done(1)
                result = found.pop(k)
                yield Broken(task.path, _LOST.reason) if result is _LOST else result
        finally:
            if self._connected:
                self._client.cancel(list(busy.values()))

    @property
    def _connected(self) -> bool:
        return bool(self._client.status == "running")

    def _ahead(self) -> int:
        """How many tasks to give out to the workers there were a moment ago."""
        if monotonic() - self._last_look > _LOOK:
            self._last_look = monotonic()
            self.count = max(1, sum(self._client.nthreads().values()))
        return _AHEAD * self.count

    def _on_all(self, function: Callable[..., Any], *arguments: Any) -> dict[str, Any]:
        """What a function returns or raises, by worker."""
        found: dict[str, Any] = self._client.run(function, *arguments, on_error="return")
        return found

    def _next(self, ended: SimpleQueue[int]) -> int:
        """Wait for a run; see meanwhile that there is somebody to wait for."""
        self._last_seen = monotonic()
        while True:
            try:
                return ended.get(timeout=_LOOK)
            except Empty:
                if self._connected and self.n_workers:
                    self._last_seen = monotonic()
                elif monotonic() - self._last_seen > self._patience:
                    missing = "all workers" if self._connected else "the scheduler"
                    raise ClusterError(
                        f"{missing} of the Dask cluster went away and did not come back within "
                        f"{self._patience:g} s; what was finished is in the cache"
                    ) from None

    def _require_software(self, identity: Identity) -> None:
        here = software(identity)
        for worker, found in self._on_all(software, identity).items():
            if isinstance(found, ModuleNotFoundError):
                reason = f"lacks the package {found.name}"
            elif isinstance(found, Exception):
                reason = f"cannot be asked what it runs: {found}"
            else:
                reason = differences(here, found)
            if reason:
                raise ClusterError(
                    f"the worker {worker} has other software than this machine ({reason}); "
                    "install the same hil and constraints.txt on both, and start it again"
                )


def _result(future: Any) -> Any:
    """What came of a call; `_LOST` if every worker that took it up died.

    Raises:
        ClusterError: the call was dropped.
        Exception: what the call raised.
    """
    from distributed import KilledWorker

    if future.status not in ("finished", "error"):
        raise ClusterError("the Dask scheduler dropped the work: it was ended or started anew")
    error = future.exception()
    if error is None:
        return future.result()
    if isinstance(error, KilledWorker):
        return _LOST
    raise error


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


def software(identity: Identity) -> dict[str, str]:
    """What decides about the bits of a result here: this code, and what it computes with."""
    python = ".".join(str(part) for part in sys.version_info[:3])
    return {"hil": identity(), "python": python} | {name: version(name) for name in LIBRARIES}


_software_once = cache(software)


def differences(here: Mapping[str, str], there: Mapping[str, str]) -> str:
    """What is other there, in words; empty if nothing."""
    return ", ".join(
        f"{name} {there.get(name, 'none'):.12} instead of {here[name]:.12}"
        for name in here
        if there.get(name) != here[name]
    )


def perform(
    task: ArchiveTask[T], *, timeout: float, identity: Identity, expected: Mapping[str, str]
) -> T | Broken:
    """Do a task in a child process.

    Args:
        task: the work.
        timeout: longest time for a task of size 1 [s].
        identity: digest of the code that runs.
        expected: `software` of whoever asks.

    Raises:
        WorkerSoftwareError: other software runs here.
        PlannerNotStarted: no child process can be started here.
    """
    arguments = task, identity, expected
    checked = ArchiveTask[T | Broken](task.path, _checked, arguments, task.size)
    with _borrowed(timeout) as child:
        (found,) = child.results([checked])
        return found


def _checked(task: ArchiveTask[T], identity: Identity, expected: Mapping[str, str]) -> T | Broken:
    """In the child: what comes of a task, by the same code as the caller's."""
    other = differences(expected, _software_once(identity))
    if other:
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
