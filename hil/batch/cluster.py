"""Re-identification on a Dask cluster: archives are read, and their sums made, on the workers.

Archives are taken where they lie, a sum stays where it was made until the next sum of the tree is
made, and only the last sum of each group comes back. The tree is that of `hil.batch.workers`, so
the result has the same bits as on one machine. Workers may join, leave and die: what a dead worker
held is made anew, as Dask does from the tasks it holds.

Dask is imported here, and only when it is called.
"""

from __future__ import annotations

import sys
import threading
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache, partial
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from queue import Empty, SimpleQueue
from time import monotonic
from typing import Any, Final, NamedTuple, Self, TypeVar

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
    run_task,
    sum_tree,
)

T = TypeVar("T")
S = TypeVar("S")
Tasks = Sequence[ArchiveTask[Any, Any]]
Identity = Callable[[], str]

_LOOK: Final = 2.0
"""s between looks at the cluster while nothing comes from it."""

_RETRIES: Final = 3
"""How often a task is given out anew for reasons that are not its own."""

_AHEAD: Final = 4
"""Tasks given out per thread of the cluster: enough that none waits, few enough to keep in mind."""


class ClusterError(HilError):
    """The cluster is gone, or cannot be used."""


class DaskWorkers(Workers):
    """The workers of a Dask cluster.

    Args:
        address: of its scheduler, such as ``tcp://host:8786``.
        identity: digest of the code that computes; importable on the workers.
        timeout: longest time for one task [s].
        patience: longest time to wait for a scheduler, and for a worker [s].

    Attributes:
        near: whether files they write can be read here under the same names.

    Raises:
        InputError: Dask is not installed, or no scheduler answers at the address.
        ClusterError: no worker joins in time, or one has other software.
    """

    near = False

    def __init__(
        self, address: str, *, identity: Identity, timeout: float = TIMEOUT, patience: float = 30.0
    ) -> None:
        self._identity = identity
        self._timeout = timeout
        self._expected = software(identity)
        self._cluster = _Cluster(address, patience)
        try:
            self._check_software()
        except BaseException:
            self._cluster.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def n_workers(self) -> int:
        """How many there are now."""
        return self._cluster.n_workers

    def close(self) -> None:
        """Leave the cluster to others."""
        if self._cluster.connected:
            self._cluster.on_all(release_children)
        self._cluster.close()

    def require_folders(self, folders: Sequence[Path]) -> None:
        """Check that every worker sees folders under the same names as this machine does.

        Raises:
            ClusterError: one does not.
        """
        for folder in folders:
            for worker, seen in self._cluster.on_all(Path.exists, folder.resolve()).items():
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
        work = partial(
            sum_archives, timeout=self._timeout, identity=self._identity, expected=self._expected
        )
        return _Run(self._cluster, groups, work, add, done or (lambda _: None)).sums()

    def _check_software(self) -> None:
        for worker, found in self._cluster.on_all(software, self._identity).items():
            if isinstance(found, ModuleNotFoundError):
                reason = f"lacks the package {found.name}"
            elif isinstance(found, Exception):
                reason = f"cannot be asked what it runs: {found}"
            else:
                reason = differences(self._expected, found)
            if reason:
                raise ClusterError(
                    f"the worker {worker} has other software than this machine ({reason}); "
                    "install the same hil and constraints.txt on both, and start it again"
                )


class _Node(NamedTuple):
    """A sum of the tree: of which group, how many levels above its tasks, and the how-manieth."""

    group: int
    level: int
    place: int


class _Run:
    """One pass over the tasks: gives out work ahead of the workers, and has added what is there.

    Args:
        work: sums the tasks of one run.
    """

    def __init__(
        self,
        cluster: _Cluster,
        groups: Sequence[Tasks],
        work: Callable[..., Any],
        add: Callable[[Any, Any], Any],
        done: Callable[[int], None],
    ) -> None:
        self._cluster, self._groups = cluster, groups
        self._work, self._add, self._done = work, add, done
        # Whole runs at once where there is work for all: less is sent, and less is asked.
        many = sum(map(len, groups)) >= _AHEAD * FAN_IN * cluster.threads()
        self._first = 1 if many else 0
        self._busy: dict[_Node, Any] = {}
        self._made: dict[_Node, Any] = {}
        self._killed: dict[_Node, int] = {}
        self._suspects: list[_Node] = []
        self._ended: SimpleQueue[_Node] = SimpleQueue()

    def sums(self) -> Iterator[Summed[Any, Any]]:
        """Do the work; yield the sum of each group in turn."""
        waiting = (
            _Node(group, self._first, place)
            for group, tasks in enumerate(self._groups)
            for place in range(_width(len(tasks), self._first))
        )
        try:
            for group, tasks in enumerate(self._groups):
                whole = _Node(group, _height(len(tasks), self._first), 0)
                while tasks and whole not in self._made:
                    self._hand_out(waiting)
                    if self._busy:
                        self._take(self._next_ended())
                    else:
                        self._try_alone(self._suspects.pop(0))
                self._hand_out(waiting)
                yield self._made.pop(whole).result() if tasks else Summed(None, ())
        finally:
            self._cluster.cancel([*self._busy.values(), *self._made.values()])

    def _hand_out(self, waiting: Iterator[_Node]) -> None:
        """Give out work, but not much more than the cluster can do at once."""
        limit = max(_AHEAD * self._cluster.threads(), FAN_IN)
        while len(self._busy) < limit and (node := next(waiting, None)) is not None:
            self._begin(node, self._tasks(node))

    def _tasks(self, node: _Node) -> Tasks:
        length = FAN_IN**node.level
        return self._groups[node.group][node.place * length : (node.place + 1) * length]

    def _begin(self, node: _Node, tasks: Tasks) -> None:
        self._busy[node] = self._cluster.submit(
            partial(self._ended.put, node), self._work, tasks, self._add, retries=_RETRIES
        )

    def _begin_sum(self, node: _Node, parts: Sequence[Any]) -> None:
        # Before further archives: what is added up takes no memory any more.
        self._busy[node] = self._cluster.submit(
            partial(self._ended.put, node), add_sums, parts, self._add, priority=1
        )

    def _next_ended(self) -> _Node:
        """Wait for a task; see meanwhile that there is somebody to wait for."""
        while True:
            try:
                node = self._ended.get(timeout=_LOOK)
            except Empty:
                self._cluster.check()
                continue
            self._cluster.seen()
            return node

    def _take(self, node: _Node) -> None:
        """Go on from a sum that ended."""
        future = self._busy.pop(node)
        if future.status == "finished":
            self._made[node] = future
            if node.level == self._first:
                self._done(len(self._tasks(node)))
            self._add_above(node)
            return
        _raise_unless_killed(future)
        self._killed[node] = self._killed.get(node, 0) + 1
        if self._killed[node] > _RETRIES:
            raise ClusterError("the workers die faster than sums can be made; see their logs")
        if node.level == self._first:
            self._suspects.append(node)
        else:  # no sum kills a worker: archives did, or somebody else
            self._cluster.again(partial(self._ended.put, node), future)
            self._busy[node] = future

    def _add_above(self, node: _Node) -> None:
        """Begin the sum that this one is part of, if it was the last one missing."""
        width = _width(len(self._groups[node.group]), node.level)
        above = _Node(node.group, node.level + 1, node.place // FAN_IN)
        first = above.place * FAN_IN
        parts = [node._replace(place=place) for place in range(first, min(first + FAN_IN, width))]
        if width > 1 and all(part in self._made for part in parts):
            self._begin_sum(above, [self._made.pop(part) for part in parts])

    def _try_alone(self, node: _Node) -> None:
        """Do tasks that were there when workers died one by one, with nothing beside them."""
        parts: list[Any] = []
        for task in self._tasks(node):
            self._begin(node, [task])
            self._next_ended()
            future = self._busy.pop(node)
            if future.status == "finished":
                parts.append(future)
            else:
                _raise_unless_killed(future)
                reason = Broken(task.path, "ended every worker that read it")
                parts.append(Summed(None, (reason,)))
        self._begin_sum(node, parts)


def _raise_unless_killed(future: Any) -> None:
    """Raise what ended a task, unless it was the death of its workers."""
    if future.status != "error":
        raise ClusterError("the Dask scheduler dropped the work: it was ended or started anew")
    if not killed(future):
        raise future.exception()


def _width(count: int, level: int) -> int:
    """Sums on a level of the tree over `count` tasks; level 0 are the tasks."""
    for _ in range(level):
        count = -(-count // FAN_IN)
    return count


def _height(count: int, first: int) -> int:
    """The level of the tree on which there is but one sum, at least `first`."""
    level = first
    while _width(count, level) > 1:
        level += 1
    return level


class _Cluster:
    """The client's end of a cluster.

    Args:
        address: of its scheduler, such as ``tcp://host:8786``.
        patience: longest time to wait for a scheduler, and for a worker [s].

    Raises:
        InputError: Dask is not installed, or no scheduler answers at the address.
        ClusterError: no worker joins in time.
    """

    def __init__(self, address: str, patience: float) -> None:
        self._patience = patience
        self._client = _connected(address, patience)
        self._threads = 1
        self._last_look = -_LOOK
        self._last_seen = monotonic()
        try:
            self._client.wait_for_workers(1, timeout=patience)
        except TimeoutError:
            self.close()
            raise ClusterError(
                f"the Dask scheduler at {address} has no worker after {patience:g} s; start some: "
                f"dask worker {address} --nthreads 1"
            ) from None
        except BaseException:
            self.close()
            raise

    @property
    def connected(self) -> bool:
        """Whether the scheduler is there."""
        return bool(self._client.status == "running")

    @property
    def n_workers(self) -> int:
        """How many workers there are now."""
        return len(self._client.nthreads())

    def threads(self) -> int:
        """Threads of the workers, as of a moment ago; at least one."""
        if monotonic() - self._last_look > _LOOK:
            self._last_look = monotonic()
            self._threads = max(1, sum(self._client.nthreads().values()))
        return self._threads

    def on_all(self, function: Callable[..., Any], *arguments: Any) -> dict[str, Any]:
        """What a function returns or raises, by worker."""
        found: dict[str, Any] = self._client.run(function, *arguments, on_error="return")
        return found

    def submit(
        self, ended: Callable[[], None], function: Callable[..., Any], *arguments: Any, **how: Any
    ) -> Any:
        """Give out a call; its future.

        Args:
            ended: called, by another thread, when the call has ended in any way.
            function: importable on the workers.
            arguments: of the function; futures among them, also in lists, become their results.
            how: keywords of the function, and ``retries`` and ``priority`` of the call.
        """
        future = self._client.submit(function, *arguments, pure=False, **how)
        future.add_done_callback(lambda _: ended())
        return future

    def again(self, ended: Callable[[], None], future: Any) -> None:
        """Give out a call that failed once more."""
        future.retry()
        future.add_done_callback(lambda _: ended())

    def cancel(self, futures: Iterable[Any]) -> None:
        """Drop calls and results."""
        if self.connected:
            self._client.cancel(list(futures))

    def seen(self) -> None:
        """Something came from the cluster."""
        self._last_seen = monotonic()

    def check(self) -> None:
        """See whether there is still somebody to wait for.

        Raises:
            ClusterError: no scheduler, or no worker, for longer than the patience.
        """
        if self.connected and self.n_workers:
            self.seen()
        elif monotonic() - self._last_seen > self._patience:
            missing = "all workers" if self.connected else "the scheduler"
            raise ClusterError(
                f"{missing} of the Dask cluster went away and did not come back within "
                f"{self._patience:g} s; what was finished is in the cache"
            )

    def close(self) -> None:
        """Leave the cluster."""
        self._client.close()


def killed(future: Any) -> bool:
    """Whether a call failed because every worker that took it up died."""
    from distributed import KilledWorker

    return isinstance(future.exception(), KilledWorker)


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


def add_sums(sums: Sequence[Summed[T, S]], add: Callable[[T, T], T]) -> Summed[T, S]:
    """Add up sums of successive runs of archives, as one node of the tree."""
    notes = tuple(note for part in sums for note in part.notes)
    return Summed(sum_tree([part.total for part in sums], add), notes)


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
