"""Re-identification on a Dask cluster: archives are read, and runs of them added up, on workers.

What comes back are the sums of runs and a summary of each archive; they are added up here in the
tree of `hil.batch.workers`, so the result has the same bits as on one machine. Workers may join,
leave and die: what a dead worker held is made anew, as Dask does from the tasks it holds.

Dask is imported here, and only when it is called.
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
    FAN_IN,
    TIMEOUT,
    ArchiveTask,
    Done,
    LocalWorkers,
    Part,
    Summed,
    Workers,
    WorkerSoftwareError,
    joined,
    run_task,
)

T = TypeVar("T")
S = TypeVar("S")
Identity = Callable[[], str]

_LOOK: Final = 2.0
"""s between looks at the cluster while nothing comes from it."""

_RETRIES: Final = 3
"""How often a task is given out anew for reasons that are not its own."""

_AHEAD: Final = 4
"""Runs given out per thread of the cluster: enough that none waits, few enough to keep in mind."""


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
        self._last_seen, self._last_look, self._threads = monotonic(), -_LOOK, 1
        self._work = partial(
            sum_archives, timeout=timeout, identity=identity, expected=software(identity)
        )
        self._client = _connected(address, patience)
        try:
            self._client.wait_for_workers(1, timeout=patience)
            self._require_software(identity)
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

    def sums_in_turn(
        self,
        groups: Sequence[Sequence[ArchiveTask[T, S]]],
        add: Callable[[T, T], T],
        *,
        done: Done | None = None,
    ) -> Iterator[Summed[T, S]]:
        """See :class:`Workers`.

        Raises:
            ClusterError: all workers, or the scheduler, are gone for longer than the patience.
            WorkerSoftwareError: a worker that joined later runs other software.
        """
        # Whole runs at once where there is work for all: less is sent, and less is asked.
        size = FAN_IN if sum(map(len, groups)) >= FAN_IN * self._ahead() else 1
        runs = [tasks[k : k + size] for tasks in groups for k in range(0, len(tasks), size)]
        waiting = iter(range(len(runs)))
        found: dict[int, Summed[T, S]] = {}
        suspects: list[int] = []
        busy: dict[int, Any] = {}
        ended: SimpleQueue[int] = SimpleQueue()

        def begin(k: int, tasks: Sequence[ArchiveTask[T, S]]) -> None:
            busy[k] = self._client.submit(self._work, tasks, add, pure=False, retries=_RETRIES)
            busy[k].add_done_callback(lambda _: ended.put(k))

        def next_result() -> tuple[int, Summed[T, S] | None]:
            """A run that ended, and its sum; None if its workers died."""
            k = self._next(ended)
            return k, _result(busy.pop(k))

        def alone(k: int) -> Summed[T, S]:
            """Do tasks that were there when workers died one by one, with nothing beside them."""
            parts: list[Summed[T, S]] = []
            for task in runs[k]:
                begin(k, [task])
                lost = Summed[T, S](None, (Broken(task.path, "ended every worker that read it"),))
                parts.append(next_result()[1] or lost)
            return joined(parts, add)

        try:
            first = 0
            for tasks in groups:
                own = range(first, first + -(-len(tasks) // size))
                first = own.stop
                while not all(k in found for k in own):
                    ahead = max(self._ahead(), FAN_IN, len(own)) - len(busy) - len(found)
                    for k in islice(waiting, max(0, ahead)):
                        begin(k, runs[k])
                    if busy:
                        k, result = next_result()
                        if result is None:
                            suspects.append(k)
                            continue
                    else:
                        k = suspects.pop(0)
                        result = alone(k)
                    found[k] = result
                    if done is not None:
                        done(len(runs[k]))
                yield joined([found.pop(k) for k in own], add)
        finally:
            if self._connected:
                self._client.cancel(list(busy.values()))

    @property
    def _connected(self) -> bool:
        return bool(self._client.status == "running")

    def _ahead(self) -> int:
        """How many runs to give out to the workers there were a moment ago."""
        if monotonic() - self._last_look > _LOOK:
            self._last_look = monotonic()
            self._threads = sum(self._client.nthreads().values())
        return _AHEAD * max(1, self._threads)

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
    """What came of a call; None if every worker that took it up died.

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
        return None
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


def sum_archives(
    tasks: Sequence[ArchiveTask[T, S]],
    add: Callable[[T, T], T],
    *,
    timeout: float,
    identity: Identity,
    expected: Mapping[str, str],
) -> Summed[T, S]:
    """Do the work on a run of archives in a child process, and add up what came of them.

    Args:
        tasks: at most as many as the tree adds at once.
        add: sum of two totals.
        timeout: longest time for one archive [s].
        identity: digest of the code that runs.
        expected: `software` of whoever asks.

    Raises:
        WorkerSoftwareError: other software runs here.
        PlannerNotStarted: no child process can be started here.
    """
    checked: list[ArchiveTask[T, S]] = [
        ArchiveTask(task.path, _checked, (task, identity, expected)) for task in tasks
    ]
    with _borrowed(timeout) as child:
        return child.sums([checked], add)[0]


def _checked(
    task: ArchiveTask[T, S], identity: Identity, expected: Mapping[str, str]
) -> Part[T, S] | Broken:
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
