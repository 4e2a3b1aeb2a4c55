"""Set-points are those of the plan."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from planner import FourierSeries, PiecewiseCubic
from tests.laws.second_reader import Archived

Array = NDArray[np.float64]
Motion = PiecewiseCubic | FourierSeries

OFF_PATH: Final = 1e-4
"""Largest difference between set-point and plan [rad] (`hil.campaign.quality`)."""


def as_planned(archived: Archived, motion: Motion, period: float) -> Iterator[str]:
    """An archive that counts is the recording of the complete motion at full speed."""
    problem = _not_as_planned(archived, motion, period)
    if problem:
        yield f"{archived.path.name} counts, and {problem}"


def _not_as_planned(archived: Archived, motion: Motion, period: float) -> str:
    if archived.ended != "completed":
        return f"it ended {archived.ended!r}"
    q: Array = archived.cycles["commanded_position"]
    # Set-points that were not accepted were sent again with their velocity.
    waits = (np.diff(q, axis=0, prepend=np.nan) == 0.0).all(axis=1)
    waits &= (archived.cycles["commanded_velocity"] != 0.0).any(axis=1)
    q = q[np.isfinite(q).all(axis=1) & ~waits]
    count = int(np.ceil(motion.duration / period)) + 1
    times: Array = np.arange(count, dtype=np.float64) * period
    planned = motion.sample(times)[0]
    moves = np.flatnonzero((np.diff(q, axis=0) != 0.0).any(axis=1))
    if not moves.size:
        return "nothing moves in it"
    # The first steps of a motion may be below the resolution.
    for first in range(max(0, int(moves[0]) - 5), int(moves[0]) + 1):
        part = q[first : first + len(planned)]
        off = np.abs(part - planned[: len(part)]).max()
        if len(part) >= len(planned) - 1 and off <= OFF_PATH:
            return ""
    return "it is not the motion as it was planned"


def on_path(commanded: Array, motion: Motion) -> Iterator[str]:
    """Set-points (k, n) [rad] lie on the path, however fast, up to a constant rounding offset."""
    step = 2e-4  # s
    path, velocity, _ = motion.sample(np.arange(0.0, motion.duration + step, step))
    offset = commanded[0] - path[0]
    near = 0.5 * step * np.abs(velocity).max() + 1e-9
    apart = np.abs(path[np.newaxis] + offset - commanded[::5, np.newaxis]).max(axis=2).min(axis=1)
    if not (np.abs(offset).max() < 1e-5 and apart.max() <= near):
        yield f"its motion left its path by {max(np.abs(offset).max(), apart.max()):.2g} rad"


def slows_down(rates: Sequence[float], along: Sequence[float]) -> Iterator[str]:
    """From the begin of a stop the motion neither speeds up nor goes back.

    Args:
        rates: of motion time, one a cycle, 1 as planned.
        along: set-points of the same cycles, along a straight path.
    """
    growth = np.diff(np.asarray(rates, float))
    if (growth > 1e-9).any():
        yield f"its rate grew by {growth.max():.3g} after the stop began"
    steps = np.diff(np.asarray(along, float))
    steps = steps[np.isfinite(steps)]
    if (steps < -1e-12).any():
        yield f"its set-points went back by {-steps.min():.3g}"
