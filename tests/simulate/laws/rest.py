"""Whatever happened, the arm ends at rest with its axes closed.

Seen at the arm itself, after the last process of the PC is gone and the controller alone has acted;
and at the end of each run that ends by itself, but for what it lost or was refused. There the
set-points rest, for as long as the cell says (`[campaign] settle_s`), and the arm stands as the
cell means it (`[robot.friction] standstill`): against dry friction its servo may still creep to
where it was sent.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from drivers.events import MotionEnded
from drivers.states import State
from hil.campaign.errors import MotionFailedError
from hil.errors import ControllerFault, HilError
from tests.simulate.observed import Broken, Life, Observed
from tests.simulate.script import DISTURBS_THE_ARM, kind_of

from .wire import Array, Gears

LAW: Final = "rest"
_STANDSTILL: Final = 5e-4
"""Motor revolutions per cycle below which an axis stands (`drivers.guard`)."""
_SWING: Final = 3.0
"""Times the cell's standstill that an arm may swing that the controller stopped at once."""


def rest(observed: Observed) -> Iterator[Broken]:
    """See above."""
    arm, period = observed.arm, observed.cell.period
    gears = Gears.of(observed.cell.drive_table)
    if arm.open_axes[-1:].any():
        yield Broken(LAW, f"axes are open at the end, phase {arm.phase[-1]}")
    fastest = _speed(arm.velocity[-1:], gears, period)
    if fastest > _STANDSTILL:
        yield Broken(LAW, f"the arm moves at the end, by {fastest:.2g} motor revolutions a cycle")
    # An arm that was held up still catches up when its set-points rest.
    disturbed = any(kind_of(line) in DISTURBS_THE_ARM for line in observed.struck)
    for number, life in enumerate(observed.runs, 1):
        if _ends_at_rest(life) and life.exchanged:
            at = min(life.last_cycle, len(arm.open_axes) - 1)
            speed = np.abs(arm.velocity[at])
            rests = observed.cell.model.friction.standstill * (_SWING if _held_up(life) else 1.0)
            if not disturbed and (speed > rests).any():
                yield Broken(LAW, f"life {number} ends on a moving arm: {speed.max():.2g} rad/s")
            if arm.open_axes[at]:
                yield Broken(LAW, f"life {number} ends with open axes, phase {arm.phase[at]}")
        for interval, held, wanted in _held_too_short(life):
            text = f"interval {interval} is left {held} cycles after it moved, not {wanted}"
            yield Broken(LAW, f"life {number}: {text}")


def _speed(velocity: Array, gears: Gears, period: float) -> float:
    """The fastest motor, revolutions per cycle, of joint velocities (k, n) [rad/s]."""
    return float(np.abs(velocity @ gears.matrix.T).max(initial=0.0) * period)


def _held_up(life: Life) -> bool:
    """Whether the controller may have stopped the last motion at once, so that the servo swings."""
    ends = [event.reason for _, event in life.events if isinstance(event, MotionEnded)]
    return any("missed in a row" in reason for reason in ends[-1:])


def _held_too_short(life: Life) -> Iterator[tuple[int, int, int]]:
    """Intervals in which the set-points rested for fewer cycles than the cell says."""
    wanted = int(life.settings.get("settle_cycles", 200))
    for _, event in life.events:
        if not isinstance(event, MotionEnded) or event.outcome not in ("completed", "stopped"):
            continue
        rows = life.records[life.records["interval"] == event.interval]
        left = np.flatnonzero(rows["state"] == State.EXITING)[:1]
        sent = rows["commanded_position"][: left[0] + 1 if left.size else 0]
        moved = np.flatnonzero((np.abs(np.diff(sent, axis=0)) > 0.0).any(axis=1)) + 1
        if moved.size and left[0] - moved[-1] < wanted:
            yield event.interval, int(left[0] - moved[-1]), wanted


def _ends_at_rest(life: Life) -> bool:
    """Whether the arm has to stand, outside open mode, when the run has ended.

    Who dies leaves that to the controller, which also acts alone where a motion was refused or
    lost, or where there was never a session to speak of.
    """
    error = life.error
    if any(isinstance(one, KeyboardInterrupt) for one in _behind(error)):
        return False  # the disk failed while it unwound
    if isinstance(error, MotionFailedError):
        return error.outcome == "stopped"
    ends = [event.outcome for _, event in life.events if isinstance(event, MotionEnded)]
    alone = isinstance(error, ControllerFault) or ends[-1:] in (["refused"], ["lost"])
    return error is None or (isinstance(error, HilError) and not alone)


def _behind(error: BaseException | None) -> Iterator[BaseException]:
    """An error, and what was being handled when it was raised."""
    while error is not None:
        yield error
        error = error.__context__
