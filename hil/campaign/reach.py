"""Postures at the end of the arm's range, and beyond it."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from hil.cell import AngleFrame, Cell
from planner import JointLimits

Array = NDArray[np.float64]

_ROUNDED: Final = 9e-7
"""Share of half a joint's range by which the wire rounds an arm at its limit out of it; the guard
of every cycle and the player allow as much."""


def at_limit(posture: Array, limits: JointLimits) -> Array:
    """A posture (n,) [rad], brought back to a limit that only rounding took it across."""
    within = np.clip(posture, limits.lower, limits.upper)
    rounding = 0.5 * _ROUNDED * (limits.upper - limits.lower)
    return np.where(np.abs(posture - within) <= rounding, within, posture)


def beyond(cell: Cell, posture: Array, verb: str = "stands at") -> str | None:
    """Which joint of a posture (n,) [rad] is outside its limits, in words and degrees.

    Args:
        cell: its limits.
        posture: (n,) rad.
        verb: what the joint does there.
    """
    limits, frame = cell.joint_limits, AngleFrame.of(cell)
    posture = at_limit(posture, limits)
    outside = np.flatnonzero((posture < limits.lower) | (posture > limits.upper))
    if not len(outside):
        return None
    joint = int(outside[0])
    ends = np.sort([frame.shown(limits.lower)[joint], frame.shown(limits.upper)[joint]])
    return (
        f"{cell.joint_names[joint]} {verb} {frame.shown(posture)[joint]:.6g}°, its limits are "
        f"{ends[0]:.6g}° and {ends[1]:.6g}° ({frame.whose})"
    )
