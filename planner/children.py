"""Sharing out many like tasks among child processes, when any of them may end its process."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from multiprocessing.connection import wait
from time import monotonic
from typing import Any, Final, Generic, TypeVar

from planner.errors import PlannerCrashed, PlannerNotStarted, PlanningTimedOut
from planner.isolation import WorkerProcess

T = TypeVar("T")
Chunk = Sequence[int]

# How often a child that died before it could be asked anything is started anew: the reason may be
# somebody else's (a full memory, a kill), and a map may have hours of work behind it.
_FRESH_STARTS: Final = 2
# How often an item must end its process by itself: once may be the work of somebody else.
_CRASHES_ALONE: Final = 2


def chunks_of(count: int, size: int) -> list[range]:
    """Return the indices 0 to count - 1 in runs of `size`, the last one maybe shorter."""
    return [range(begin, min(begin + size, count)) for begin in range(0, count, size)]


def map_in_children(
    children: Sequence[WorkerProcess],
    function: Callable[..., Iterable[T]],
    chunks: Sequence[Chunk],
    arguments: Callable[[Chunk], tuple[Any, ...]],
    *,
    done: Callable[[int], None] | None = None,
) -> list[T | PlannerCrashed | PlanningTimedOut]:
    """Call a function chunk by chunk in child processes; a crash costs one item, not its chunk.

    A chunk that ends its process, or takes longer than the children's time for one call, is tried
    again item by item, each with the whole time for itself. An item alone that ends its process is
    tried once more before that is believed: somebody else may have ended it. Chunks are handed out
    as children become free, so the function must give an item the same result in any company.

    Args:
        children: at least one; they are closed if this is interrupted, and start anew when used.
        function: importable in a child; returns one result for each index of its chunk.
        chunks: the indices 0 to count - 1, each once.
        arguments: of the function, for some of the indices.
        done: called with a number of items whenever so many more have their result.

    Returns:
        For each index in order its result, or the error that it met alone.

    Raises:
        PlannerNotStarted: a child died before it was given anything to do, several times.
        Exception: whatever the function itself raised.
    """
    work, idle = _Work[T](chunks, done), list(children)
    busy: dict[Any, tuple[WorkerProcess, Chunk]] = {}
    try:
        while work.waiting or busy:
            while work.waiting and idle:
                child, chunk = idle.pop(), work.waiting.popleft()
                _begin(child, function, arguments(chunk))
                busy[child.connection] = child, chunk
            nearest = min(child.deadline for child, _ in busy.values()) - monotonic()
            ready = wait(list(busy), max(0.0, nearest))
            late = [link for link, (child, _) in busy.items() if child.deadline <= monotonic()]
            for link in {*ready, *late}:
                child, chunk = busy.pop(link)
                idle.append(child)
                work.fetch(child, chunk)
    except BaseException:  # Ctrl-C, or a fault of ours: nobody will fetch what is under way
        for child in children:
            child.close()
        raise
    return work.results()


class _Work(Generic[T]):
    """What is still to be done, and what came of the rest."""

    def __init__(self, chunks: Sequence[Chunk], done: Callable[[int], None] | None) -> None:
        self.waiting: deque[Chunk] = deque(chunks)
        self._done = done
        self._results: dict[int, T | PlannerCrashed | PlanningTimedOut] = {}
        self._crashes: Counter[int] = Counter()
        self._not_started: Counter[int] = Counter()

    def fetch(self, child: WorkerProcess, chunk: Chunk) -> None:
        """Take the results of a chunk from a child, or have it tried again."""
        try:
            found = list(child.receive())
        except PlannerNotStarted:
            self._not_started[id(child)] += 1
            if self._not_started[id(child)] > _FRESH_STARTS:
                raise
            self.waiting.append(chunk)
        except (PlannerCrashed, PlanningTimedOut) as error:
            self._tried_again(chunk, error)
        else:
            del self._not_started[id(child)]
            self._enter(chunk, found)

    def results(self) -> list[T | PlannerCrashed | PlanningTimedOut]:
        """Return the results in order."""
        return [self._results[index] for index in range(len(self._results))]

    def _tried_again(self, chunk: Chunk, error: PlannerCrashed | PlanningTimedOut) -> None:
        if len(chunk) > 1:
            self.waiting.extend([index] for index in chunk)
            return
        (index,) = chunk
        self._crashes[index] += isinstance(error, PlannerCrashed)
        if isinstance(error, PlannerCrashed) and self._crashes[index] < _CRASHES_ALONE:
            self.waiting.append(chunk)
        else:
            self._enter(chunk, [error])

    def _enter(self, chunk: Chunk, found: Sequence[T | PlannerCrashed | PlanningTimedOut]) -> None:
        self._results.update(zip(chunk, found, strict=True))
        if self._done is not None:
            self._done(len(chunk))


def _begin(child: WorkerProcess, function: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
    """Give a child a task; one that died while idle, or while it was started, is replaced."""
    for _ in range(_FRESH_STARTS):
        try:
            return child.send(function, *arguments)
        except (PlannerCrashed, PlannerNotStarted):
            continue
    return child.send(function, *arguments)
