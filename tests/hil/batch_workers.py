"""Workers for tests: in this process, and with archives that end theirs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final

from hil.batch.discovery import Place
from hil.batch.types import ArchiveRef, Broken
from hil.batch.workers import ArchiveTask, Part, Summed, Workers, run_task, summed

NOTHING_OPEN: Final = (
    *("--bandwidth", "40", "--velocity", "position", "--friction", "coulomb,viscous"),
    *("--standstill", "slow", "--delay", "stated", "--estimator", "wls"),
)
"""Options of `hil reidentify` that leave nothing to be chosen of a controller's archives."""


class Here(Workers):
    """This process; `deadly` archives, by name, end it, or would if it were another."""

    def __init__(self, *deadly: str, near: bool = True) -> None:
        self.deadly, self.near = deadly, near
        self.tasks: list[ArchiveTask[Any, Any]] = []

    def sums_in_turn(
        self,
        groups: Sequence[Sequence[ArchiveTask[Any, Any]]],
        add: Callable[[Any, Any], Any],
        *,
        done: Callable[[int], None] | None = None,
    ) -> Iterator[Summed[Any, Any]]:
        return (summed([self._part(task, done) for task in group], add) for group in groups)

    def _part(
        self, task: ArchiveTask[Any, Any], done: Callable[[int], None] | None
    ) -> Part[Any, Any] | Broken:
        self.tasks.append(task)
        if done is not None:
            done(1)
        if any(ref.name in self.deadly for ref in _refs(task.arguments[0])):
            return Broken(task.path, "ended its process")
        return run_task(task)


def _refs(argument: Any) -> Sequence[ArchiveRef]:
    if isinstance(argument, Place):  # looking into an archive is harmless
        return []
    return [argument] if isinstance(argument, ArchiveRef) else argument
