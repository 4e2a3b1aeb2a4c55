"""The processes that a study works with: started once, and used from step to step."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Final, TypeVar

from hil.errors import HilError
from identification import IdentificationError
from planner import PlannerError
from planner.children import map_in_children
from planner.errors import PlannerCrashed, PlanningTimedOut
from planner.isolation import PlanningChild

T = TypeVar("T")

LONGEST: Final = 6 * 3600.0
"""s that one campaign, or one reading of archives, may take."""


class StudyError(HilError):
    """A part of a study did not come to its end; starting it again goes on there."""


@dataclass(frozen=True, eq=False)
class Workers:
    """Child processes; without any, all is done in this process."""

    children: tuple[PlanningChild, ...]

    @property
    def count(self) -> int:
        """Processes that are at work at once."""
        return max(1, len(self.children))

    def map(
        self,
        function: Callable[..., T],
        arguments: Sequence[tuple[Any, ...]],
        done: Callable[[int], None] = lambda _: None,
    ) -> list[T]:
        """Call a function of a module with each of the arguments; results in order.

        Args:
            function: to be called.
            arguments: of each call; those that take longest first.
            done: called with a number of calls whenever so many more have ended.

        Raises:
            StudyError: a call was refused, ended its process, or took too long.
        """
        if not self.children:
            return [_told(function, some, done) for some in arguments]
        results = map_in_children(
            self.children,
            _listed,
            [[k] for k in range(len(arguments))],
            lambda chunk: (function, [arguments[k] for k in chunk]),
            done=done,
        )
        found = []
        for result in results:
            if isinstance(result, PlannerCrashed | PlanningTimedOut):
                raise StudyError(f"a part of the study failed ({result}); start it again to go on")
            found.append(result)
        return found


@contextmanager
def workers_of(count: int) -> Iterator[Workers]:
    """So many processes, ended when this is left; one is this process itself."""
    children = [PlanningChild(timeout=LONGEST) for _ in range(count if count > 1 else 0)]
    try:
        yield Workers(tuple(children))
    finally:
        for child in children:
            child.close()


def _listed(function: Callable[..., T], arguments: Sequence[tuple[Any, ...]]) -> list[T]:
    """In a child."""
    return [_told(function, some) for some in arguments]


def _told(
    function: Callable[..., T],
    arguments: tuple[Any, ...],
    done: Callable[[int], None] = lambda _: None,
) -> T:
    """What a call returns; a refusal as an error that travels between processes."""
    try:
        result = function(*arguments)
    except StudyError:
        raise
    except (HilError, IdentificationError, PlannerError) as error:
        raise StudyError(str(error)) from error
    done(1)
    return result
