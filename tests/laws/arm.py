"""The arm is at rest outside open mode when a run has ended."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim_fixtures import Phase

IN_OPEN_MODE = (Phase.OPENING, Phase.OPEN, Phase.CLOSING)
"""Phases of the controller with an axis in open mode."""


def stands(
    velocity: ArrayLike, allowed: ArrayLike, when: str, unit: str = "rad/s"
) -> Iterator[str]:
    """No joint is faster than what counts as rest; speeds of joints or motors (n,) or (k, n)."""
    speed: NDArray[np.float64] = np.abs(np.asarray(velocity, float))
    if (speed > np.asarray(allowed)).any():
        yield f"{when} the arm moves: {speed.max():.3g} {unit}"


def closed(phase: str, *, any_open: bool, when: str) -> Iterator[str]:
    """No axis is in open mode; `phase` is the controller's."""
    if any_open:
        yield f"{when} axes are open, phase {phase}"
