"""Sharing out many like tasks among child processes, when any of them may end its process."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from multiprocessing.connection import wait
from time import monotonic
from typing import Any, TypeVar

from planner.errors import PlannerCrashed, PlanningTimedOut
from planner.isolation import PlanningChild

T = TypeVar("T")
Chunk = Sequence[int]


def chunks_of(count: int, size: int) -> list[range]:
    """Return the indices 0 to count - 1 in runs of `size`, the last one maybe shorter."""
    return [range(begin, min(begin + size, count)) for begin in range(0, count, size)]


def map_in_children(
    children: Sequence[PlanningChild],
    function: Callable[..., Iterable[T]],
    chunks: Sequence[Chunk],
    arguments: Callable[[Chunk], tuple[Any, ...]],
) -> list[T | PlannerCrashed | PlanningTimedOut]:
    """Call a function chunk by chunk in child processes; a crash costs one item, not its chunk.

    A chunk that ends its process, or takes longer than the children's time for one call, is tried
    again item by item, each with the whole time for itself. Chunks are handed out as children
    become free, so the function must give an item the same result in any company.

    Args:
        children: at least one; they are closed if this is interrupted, and start anew when used.
        function: importable in a child; returns one result for each index of its chunk.
        chunks: the indices 0 to count - 1, each once.
        arguments: of the function, for some of the indices.

    Returns:
        For each index in order its result, or the error that it met alone.

    Raises:
        PlannerNotStarted: a child died before it was given anything to do.
        Exception: whatever the function itself raised.
    """
    results: dict[int, T | PlannerCrashed | PlanningTimedOut] = {}
    waiting, idle = deque(chunks), list(children)
    busy: dict[Any, tuple[PlanningChild, Chunk]] = {}
    try:
        while waiting or busy:
            while waiting and idle:
                child, chunk = idle.pop(), waiting.popleft()
                _begin(child, function, arguments(chunk))
                busy[child.connection] = child, chunk
            nearest = min(child.deadline for child, _ in busy.values())
            ready = wait(list(busy), max(0.0, nearest - monotonic()))
            late = [link for link, (child, _) in busy.items() if child.deadline <= monotonic()]
            for link in {*ready, *late}:
                child, chunk = busy.pop(link)
                idle.append(child)
                try:
                    results.update(zip(chunk, child.receive(), strict=True))
                except (PlannerCrashed, PlanningTimedOut) as error:
                    if len(chunk) == 1:
                        results[chunk[0]] = error
                    else:
                        waiting.extend([index] for index in chunk)
    except BaseException:  # Ctrl-C, or a fault of ours: nobody will fetch what is under way
        for child in children:
            child.close()
        raise
    return [results[index] for index in range(len(results))]


def _begin(child: PlanningChild, function: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
    """Give a child a task; one that died while idle is replaced, once."""
    try:
        child.send(function, *arguments)
    except PlannerCrashed:
        child.send(function, *arguments)
