"""Sharing out many like tasks among child processes, when any of them may end its process."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Generator, Iterable, Sequence
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
    """Return, for each index in order, what `stream_in_children` yields of it."""
    found = dict(stream_in_children(children, function, chunks, arguments, done=done))
    return [found[index] for index in range(len(found))]


def stream_in_children(
    children: Sequence[WorkerProcess],
    function: Callable[..., Iterable[T]],
    chunks: Iterable[Chunk],
    arguments: Callable[[Chunk], tuple[Any, ...]],
    *,
    done: Callable[[int], None] | None = None,
) -> Generator[tuple[int, T | PlannerCrashed | PlanningTimedOut], None, None]:
    """Call a function chunk by chunk in child processes; a crash costs one item, not its chunk.

    A chunk that ends its process, or takes longer than the children's time for one call, is tried
    again item by item, each with the whole time for itself. An item alone that ends its process is
    tried once more before that is believed: somebody else may have ended it. Chunks are handed out
    as children become free, so the function must give an item the same result in any company.

    Args:
        children: at least one; those at work are closed if this is interrupted, and start anew
            when used.
        function: importable in a child; returns one result for each index of its chunk.
        chunks: the indices 0 to count - 1, each once; asked for when a child is free.
        arguments: of the function, for some of the indices.
        done: called with a number of items whenever so many more have their result.

    Yields:
        Each index with its result, or with the error that it met alone, in any order.

    Raises:
        PlannerNotStarted: a child died before it was given anything to do, several times.
        Exception: whatever the function itself raised.
    """
    work, idle = _Work[T](chunks), list(children)
    busy: dict[Any, tuple[WorkerProcess, Chunk]] = {}
    found: list[tuple[int, T | PlannerCrashed | PlanningTimedOut]] = []
    try:
        while True:
            while idle and (chunk := work.next_chunk()) is not None:
                child = idle.pop()
                _begin(child, function, arguments(chunk))
                busy[child.connection] = child, chunk
            if done is not None and found:
                done(len(found))
            yield from found  # children are at work meanwhile
            if not busy:
                return
            nearest = min(child.deadline for child, _ in busy.values()) - monotonic()
            ready = wait(list(busy), max(0.0, nearest))
            late = [link for link, (child, _) in busy.items() if child.deadline <= monotonic()]
            found = []
            for link in {*ready, *late}:
                child, chunk = busy.pop(link)
                idle.append(child)
                found += work.fetch(child, chunk)
    finally:  # after Ctrl-C, a fault of ours or a break: nobody will fetch what is under way
        for child in children:
            if child not in idle:
                child.close()


class _Work(Generic[T]):
    """What is still to be done, and how often it went wrong."""

    def __init__(self, chunks: Iterable[Chunk]) -> None:
        self._chunks = iter(chunks)
        self._again: deque[Chunk] = deque()
        self._crashes: Counter[int] = Counter()
        self._not_started: Counter[int] = Counter()

    def next_chunk(self) -> Chunk | None:
        """Return what is to be handed out next, None if nothing is."""
        return self._again.popleft() if self._again else next(self._chunks, None)

    def fetch(
        self, child: WorkerProcess, chunk: Chunk
    ) -> list[tuple[int, T | PlannerCrashed | PlanningTimedOut]]:
        """Return the results of a chunk from a child; nothing if it is to be tried again."""
        try:
            found = list(child.receive())
        except PlannerNotStarted:
            self._not_started[id(child)] += 1
            if self._not_started[id(child)] > _FRESH_STARTS:
                raise
            self._again.append(chunk)
            return []
        except (PlannerCrashed, PlanningTimedOut) as error:
            return self._failed(chunk, error)
        del self._not_started[id(child)]
        return list(zip(chunk, found, strict=True))

    def _failed(
        self, chunk: Chunk, error: PlannerCrashed | PlanningTimedOut
    ) -> list[tuple[int, T | PlannerCrashed | PlanningTimedOut]]:
        if len(chunk) > 1:
            self._again.extend([index] for index in chunk)
            return []
        (index,) = chunk
        self._crashes[index] += isinstance(error, PlannerCrashed)
        if isinstance(error, PlannerCrashed) and self._crashes[index] < _CRASHES_ALONE:
            self._again.append(chunk)
            return []
        return [(index, error)]


def _begin(child: WorkerProcess, function: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
    """Give a child a task; one that died while idle, or while it was started, is replaced."""
    for _ in range(_FRESH_STARTS):
        try:
            return child.send(function, *arguments)
        except (PlannerCrashed, PlannerNotStarted):
            continue
    return child.send(function, *arguments)
