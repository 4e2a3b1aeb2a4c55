"""Re-identification on a Dask cluster: archives are read, and their sums made, on the workers.

Archives are taken where they lie, a sum stays where it was made until the next sum of the tree is
made, and only the last sum of each group comes back. The tree is that of `hil.batch.tree`, so the
result has the same bits as on one machine. Workers may join, leave and die: what a dead worker held
is made anew, as Dask does from the tasks it keeps.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, Final, NamedTuple, Self, TypeVar

from hil.batch.cluster import LOOK, Cluster, ClusterError, killed
from hil.batch.on_workers import (
    ArchiveTask,
    Identity,
    Summed,
    add_sums,
    differences,
    release_children,
    software,
    sum_archives,
)
from hil.batch.tree import FAN_IN
from hil.batch.types import Broken
from hil.batch.workers import Workers

T = TypeVar("T")
S = TypeVar("S")
Tasks = Sequence[ArchiveTask[Any, Any]]

_RETRIES: Final = 3
"""How often a task is given out anew for reasons that are not its own."""

_AHEAD: Final = 4
"""Tasks given out per thread of the cluster: enough that none waits, few enough to keep in mind."""


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
        self, address: str, *, identity: Identity, timeout: float = 300.0, patience: float = 30.0
    ) -> None:
        self._identity = identity
        self._timeout = timeout
        self._expected = software(identity)
        self._cluster = Cluster(address, patience)
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

    def sums(
        self,
        groups: Sequence[Sequence[ArchiveTask[T, S]]],
        add: Callable[[T, T], T],
        *,
        done: Callable[[int], None] | None = None,
    ) -> list[Summed[T, S]]:
        """Do all tasks, and add up what comes of those of each group; see `sums_in_turn`."""
        return list(self.sums_in_turn(groups, add, done=done))

    def sums_in_turn(
        self,
        groups: Sequence[Sequence[ArchiveTask[T, S]]],
        add: Callable[[T, T], T],
        *,
        done: Callable[[int], None] | None = None,
    ) -> Iterator[Summed[T, S]]:
        """The same as of any workers, but later groups are worked on meanwhile.

        Raises:
            ClusterError: all workers, or the scheduler, are gone for longer than the patience.
            StrangeWorkerError: a worker that joined later runs other software.
        """
        work = partial(
            sum_archives, timeout=self._timeout, identity=self._identity, expected=self._expected
        )
        return _Run(self._cluster, groups, work, add, done or _ignore).sums()

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
        cluster: Cluster,
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
                node = self._ended.get(timeout=LOOK)
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


def _ignore(_: int) -> None:
    pass
