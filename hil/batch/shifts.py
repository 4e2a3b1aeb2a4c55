"""From one level to another: what the chart of a figure has to tell, change by change."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import groupby
from typing import Literal

import numpy as np

from hil.batch.trend import Watched


@dataclass(frozen=True)
class Shift:
    """Campaigns in a row that are elsewhere than those before them.

    Attributes:
        kind: "departs": at no level known before; "returns": at one that was left before.
        first: number of the first of these campaigns.
        last: of the last.
        before: median of those before.
        value: median of these.
        settled: whether they made a level by which later ones are judged.
        lasts: whether no later campaign is elsewhere.
    """

    kind: Literal["departs", "returns"]
    first: int
    last: int
    before: float
    value: float
    settled: bool
    lasts: bool


def shifts(watched: Watched) -> list[Shift]:
    """All shifts of a figure, in order of time."""
    runs = _runs(watched)
    seen = {level for level, _ in runs[:1]}
    found = []
    for number, (level, own) in enumerate(runs[1:], start=1):
        fresh = level < 0 or level not in seen
        seen.add(level)
        band = watched.limits[own[0]]
        left = float(np.median(watched.values[runs[number - 1][1]]))
        found.append(
            Shift(
                kind="departs" if fresh else "returns",
                first=own[0],
                last=own[-1],
                before=band.centre if fresh and band is not None else left,
                value=float(np.median(watched.values[own])),
                settled=level >= 0,
                lasts=number == len(runs) - 1,
            )
        )
    return found


def _runs(watched: Watched) -> list[tuple[int, list[int]]]:
    """Known campaigns in a row at one level, or outside on one side, and the number of it."""

    def place(k: int) -> tuple[int, bool]:
        level, band = watched.levels[k], watched.limits[k]
        above = level < 0 and band is not None and watched.values[k] > band.centre
        return level, bool(above)

    known = [k for k, value in enumerate(watched.values) if np.isfinite(value)]
    return [(level, list(own)) for (level, _), own in groupby(known, place)]
