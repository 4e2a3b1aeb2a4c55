"""Angles that wrap at a whole turn, and their continuation."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.signals.recording import Recording

UNWRAPPED: Final = "unwrapped"
"""Entry of the provenance: joints whose angles wrapped."""
_TURN: Final = 2.0 * np.pi
# Largest distance of an unwrapped step from its neighbours [rad]; a glitch to zero or to
# another joint's angle is no whole turn.
_MAX_UNWRAP_DISTANCE: Final = 0.3


def unwrap(position: Array, gap_before: NDArray[np.bool_] | None = None) -> Array:
    """Return angles (m, n) [rad] without steps of whole turns; bit-identical without such a step.

    A step is a wrap if it continues its neighbouring steps apart from the turns. After a gap, the
    nearest turn is used for a joint that has such steps.
    """
    steps = np.diff(position, axis=0)
    turns = np.rint(np.nan_to_num(steps) / _TURN)
    if not turns.any():
        return position
    remainder = np.nan_to_num(steps) - _TURN * turns
    padded = np.pad(remainder, ((1, 1), (0, 0)), mode="edge")
    usual = 0.5 * (padded[:-2] + padded[2:])
    turns[np.abs(remainder - usual) > _MAX_UNWRAP_DISTANCE + np.abs(usual)] = 0.0
    if gap_before is not None:
        at_gap = turns * gap_before[1:, None]
        wraps = (turns - at_gap).any(axis=0)
        turns -= np.where(wraps, 0.0, at_gap)
    if not turns.any():
        return position
    passed = np.vstack([np.zeros(position.shape[1]), np.cumsum(turns, axis=0)])
    return np.asarray(np.where(passed == 0.0, position, position - _TURN * passed))


def unwrapped(recording: Recording) -> Recording:
    """Return the recording with angles that do not wrap at +-180 or 360 degrees.

    The joints that wrapped are named in the provenance, under `UNWRAPPED`.
    """
    position = unwrap(recording.position, recording.gap_before)
    if position is recording.position:
        return recording
    commanded = recording.commanded_position
    joints = np.flatnonzero((position != recording.position).any(axis=0))
    names = ", ".join(recording.joint_names[joint] for joint in joints)
    return replace(
        recording,
        position=position,
        commanded_position=None if commanded is None else unwrap(commanded, recording.gap_before),
        provenance={**recording.provenance, UNWRAPPED: names},
    )
