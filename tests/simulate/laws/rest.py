"""Whatever happened, the arm ends at rest with its axes closed.

Seen at the arm itself, after the last process of the PC is gone and the controller alone has acted;
and at the end of each run that says it brought the arm to rest. There the set-points rest and the
arm stands as the cell means it (`[robot.friction] standstill`): against dry friction its servo may
still creep to where it was sent.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from hil.campaign.errors import MotionFailedError
from tests.simulate.observed import Broken, Life, Observed

from .wire import Array, Gears

LAW: Final = "rest"
_STANDSTILL: Final = 5e-4
"""Motor revolutions per cycle below which an axis stands (`drivers.guard_limits`)."""


def rest(observed: Observed) -> Iterator[Broken]:
    """See above."""
    arm, period = observed.arm, observed.cell.period
    gears = Gears.of(observed.cell.drive_table)
    if arm.open_axes[-1:].any():
        yield Broken(LAW, f"axes are open at the end, phase {arm.phase[-1]}")
    fastest = _speed(arm.velocity[-1:], gears, period)
    if fastest > _STANDSTILL:
        yield Broken(LAW, f"the arm moves at the end, by {fastest:.2g} motor revolutions a cycle")
    for number, life in enumerate(observed.runs, 1):
        if _says_at_rest(life) and life.exchanged:
            at = min(life.last_cycle, len(arm.open_axes) - 1)
            speed = np.abs(arm.velocity[at])
            if (speed > observed.cell.model.friction.standstill).any():
                yield Broken(LAW, f"life {number} ends on a moving arm: {speed.max():.2g} rad/s")
            if arm.open_axes[at]:
                yield Broken(LAW, f"life {number} ends with open axes, phase {arm.phase[at]}")


def _speed(velocity: Array, gears: Gears, period: float) -> float:
    """The fastest motor, revolutions per cycle, of joint velocities (k, n) [rad/s]."""
    return float(np.abs(velocity @ gears.matrix.T).max(initial=0.0) * period)


def _says_at_rest(life: Life) -> bool:
    """Whether the run itself says that the arm stands and open mode was left."""
    if life.result is not None:
        return True
    return isinstance(life.error, MotionFailedError) and life.error.outcome == "stopped"
