"""A motion that is not the one that was planned, as by a defect of ours: only the guard is left."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from unittest.mock import patch

from planner import TrajectoryPlayer
from planner.arrays import Array
from tests.simulate.script import Mishap, Script


@contextmanager
def lurching(script: Script, cycle: Callable[[], int], struck: list[str]) -> Iterator[None]:
    """Motions lurch where the script says so; `struck` takes the lines that came to pass."""
    due = [one for one in script.of("cycle") if one.kind == "lurch" and one.line not in struck]
    if not due:
        yield
        return
    due.sort(key=lambda one: one.at)
    left = due[0].count
    advance = TrajectoryPlayer.advance

    def advanced(player: TrajectoryPlayer) -> tuple[Array, Array]:
        nonlocal left
        position, velocity = advance(player)
        if not due or cycle() < due[0].at:
            return position, velocity
        if due[0].line not in struck:
            struck.append(due[0].line)
        position = position.copy()
        position[0] += _size(due[0])
        left -= 1
        if not left:
            due.pop(0)
            left = due[0].count if due else 0
        return position, velocity

    with patch.object(TrajectoryPlayer, "advance", advanced):
        yield


def _size(lurch: Mishap) -> float:
    return math.nan if lurch.word == "nan" else lurch.value
