"""Stretches of motions in which something else held or pushed the arm, and windows without them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.servo.contacts import contacts_of
from identification.servo.fit import ServoWindows
from identification.servo.pushes import pushes_of
from identification.servo.recorded_motion import ServoMotion
from identification.servo.servo_fit import ServoFit, Touch
from identification.servo.servo_simulation import simulate

_AROUND: Final = 1.0  # s before and after a stretch, in which an arm is caught and let go


def touches_of(motions: Sequence[ServoMotion], fit: ServoFit, resolution: Array) -> list[Touch]:
    """Return the stretches in which something held or pushed an arm, by motion and time.

    Args:
        motions: as they were measured.
        fit: of the servos.
        resolution: standard deviation of the measured positions (n,).
    """
    touches = []
    for number, motion in enumerate(motions):
        simulated = simulate(motion.inputs(0, len(motion.position)), fit.estimate.values[None])
        pushes = pushes_of(motion.step, motion.command, motion.position, simulated[:, 0])
        spans = [(push.time, push.end) for push in pushes]
        spans += [(each.start, each.end) for each in contacts_of(motion, fit, resolution)]
        touches += [Touch(number, *span) for span in _joined(spans)]
    return touches


def untouched(windows: ServoWindows, touches: Sequence[Touch]) -> NDArray[np.bool_]:
    """Return the windows (w,) in which nothing held or pushed the arm, nor shortly before."""
    free = np.ones(windows.count, np.bool_)
    for touch in touches:
        near = (windows.start < touch.end + _AROUND) & (windows.end > touch.start - _AROUND)
        free &= ~(near & (windows.motion == touch.motion))
    return free


def windows_without(windows: ServoWindows, touches: Sequence[Touch]) -> ServoWindows:
    """Return the windows in which nothing held or pushed the arm."""
    return windows.some(np.flatnonzero(untouched(windows, touches))) if touches else windows


def _joined(spans: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    joined: list[tuple[float, float]] = []
    for start, end in sorted(spans):
        if joined and start <= joined[-1][1]:
            joined[-1] = (joined[-1][0], max(end, joined[-1][1]))
        else:
            joined.append((start, end))
    return joined
