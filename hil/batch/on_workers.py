"""What runs on a worker: archives one by one in a child process, and sums of what came of them.

Nothing here knows who hands out the work. The child process costs little and gives much: an
archive that crashes or hangs costs itself and no worker, linear algebra has one thread, and so
the bits do not depend on how many tasks a worker has at once.
"""

from __future__ import annotations

import signal
import sys
import threading
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from typing import Any, Final, Generic, NamedTuple, TypeVar

from hil.batch.errors import CacheError
from hil.batch.tree import sum_run, sum_tree
from hil.batch.types import Broken
from hil.errors import HilError
from planner.errors import PlannerCrashed, PlanningTimedOut
from planner.isolation import WorkerProcess

T = TypeVar("T")
S = TypeVar("S")
Identity = Callable[[], str]

_CRASHES: Final = 2
"""How often an archive must end its process before it is believed to be the reason."""

_START: Final = 60.0
"""s that a new process may take to import what it needs, on a busy machine."""

_DECISIVE: Final = ("numpy", "scipy", "pin")
"""Packages that decide about the numbers."""


class Part(NamedTuple, Generic[T, S]):
    """What came of an archive: what is added up (None for nothing), and what is told of it."""

    total: T | None
    note: S


@dataclass(frozen=True, eq=False)
class ArchiveTask(Generic[T, S]):
    """Work on one archive.

    Attributes:
        path: file or URL, by which it is named where it fails.
        function: returns its part; importable where it runs.
        arguments: of the function; they travel with each task, so they should be small.
    """

    path: str
    function: Callable[..., Part[T, S]]
    arguments: tuple[Any, ...]


@dataclass(frozen=True, eq=False)
class Summed(Generic[T, S]):
    """What came of several archives.

    Attributes:
        total: sum of the parts that are there; None where there is none.
        notes: of each archive in order, or why there is none.
    """

    total: T | None
    notes: tuple[S | Broken, ...]


class StrangeWorkerError(HilError):
    """A worker that runs other software than the one who asked it."""


def software(identity: Identity) -> dict[str, str]:
    """What decides about the bits of a result here: this code, and what it computes with."""
    python = ".".join(str(part) for part in sys.version_info[:3])
    return {"hil": identity(), "python": python} | {name: version(name) for name in _DECISIVE}


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
    """Do the work on a run of archives and add up what came of them.

    Args:
        tasks: at most as many as the tree adds at once.
        add: sum of two totals.
        timeout: longest time for one archive [s].
        identity: digest of the code that runs.
        expected: `software` of whoever asks.

    Raises:
        StrangeWorkerError: other software runs here.
        PlannerNotStarted: no child process can be started here.
    """
    with _borrowed(timeout) as child:
        parts = [_attempt(child, task, timeout, identity, expected) for task in tasks]
    return Summed(
        sum_run([None if isinstance(part, Broken) else part.total for part in parts], add),
        tuple(part if isinstance(part, Broken) else part.note for part in parts),
    )


def add_sums(sums: Sequence[Summed[T, S]], add: Callable[[T, T], T]) -> Summed[T, S]:
    """Add up sums of successive runs of archives, as one node of the tree."""
    notes = tuple(note for part in sums for note in part.notes)
    return Summed(sum_tree([part.total for part in sums], add), notes)


def run_task(task: ArchiveTask[T, S]) -> Part[T, S] | Broken:
    """What comes of a task, or what it met.

    Raises:
        CacheError: nothing can be kept; the next task would meet it as well.
    """
    try:
        return task.function(*task.arguments)
    except CacheError:
        raise
    except HilError as error:
        return Broken(task.path, str(error))
    except Exception as error:  # a fault of ours: it costs this archive, not the batch
        return Broken(task.path, f"{type(error).__name__}: {error}")


def release_children() -> None:
    """End the child processes kept for the next archive."""
    with _lock:
        while _idle:
            for child in _idle.popitem()[1]:
                child.close()


def _attempt(
    child: WorkerProcess,
    task: ArchiveTask[T, S],
    timeout: float,
    identity: Identity,
    expected: Mapping[str, str],
) -> Part[T, S] | Broken:
    """The part of an archive, or what was learnt of its end."""
    end = ""
    for _ in range(_CRASHES):
        try:
            return child.call(_checked, task, timeout, identity, expected)
        except PlannerCrashed as error:
            if error.status == -signal.SIGALRM:
                return Broken(task.path, f"took longer than {timeout:g} s")
            end = f"signal {-error.status}" if error.status < 0 else f"status {error.status}"
        except PlanningTimedOut:
            return Broken(task.path, f"took longer than {timeout:g} s")
    return Broken(task.path, f"ended {_CRASHES} processes that read it, with {end}")


def _checked(
    task: ArchiveTask[T, S], timeout: float, identity: Identity, expected: Mapping[str, str]
) -> Part[T, S] | Broken:
    """In the child: the part of an archive, or what it met, by the same code as the caller's."""
    other = differences(expected, _software_once(identity))
    if other:
        raise StrangeWorkerError(f"a worker runs other software: {other}")
    # From here: what a new process takes to import is no fault of the archive. The alarm kills, and
    # `planner.remote` switches it off when this returns.
    signal.setitimer(signal.ITIMER_REAL, timeout)
    return run_task(task)


_lock = threading.Lock()
_idle: defaultdict[float, list[WorkerProcess]] = defaultdict(list)


@contextmanager
def _borrowed(timeout: float) -> Iterator[WorkerProcess]:
    """A child of one's own, warm where one is idle; a worker may have several threads."""
    with _lock:
        child = _idle[timeout].pop() if _idle[timeout] else None
    child = child or WorkerProcess(timeout=timeout + _START)
    try:
        yield child
    finally:
        with _lock:
            _idle[timeout].append(child)
