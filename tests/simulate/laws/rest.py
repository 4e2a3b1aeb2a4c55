"""The arm ends at rest with closed axes.

Checked on the true state of the arm after the last run, and at the end of each run that ends
without a lost or refused motion: set-points rest for `[campaign] settle_s`, and the speed is below
`[robot.friction] standstill`.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from drivers.events import MotionEnded
from drivers.states import State
from hil.base.errors import ControllerError, HilError
from hil.control.errors import MotionFailedError
from sim_fixtures import Phase
from tests.faults import DISTURBS_THE_ARM, kind_of
from tests.laws.arm import closed, stands
from tests.simulate.observed import Life, Observed

from .wire import Array, Gears

_STANDSTILL: Final = 5e-4  # motor revolutions per cycle (`drivers.guard`)
_SWING: Final = 0.1
"""Largest speed left of the last motion's after the controller stopped the arm abruptly."""


def rest(observed: Observed) -> Iterator[str]:
    """Check the law of this module."""
    arm = observed.arm
    period = observed.cell.period
    gears = Gears.of(observed.cell.drive_table)
    phase = arm.phase[-1] if arm.phase else ""
    yield from closed(phase, any_open=bool(arm.open_axes[-1:].any()), when="at the end")
    revolutions = _revolutions(arm.velocity[-1:], gears, period)
    yield from stands(revolutions, _STANDSTILL, "at the end", "motor revolutions per cycle")
    # A disturbed arm may still approach its set-points.
    disturbed = any(kind_of(line) in DISTURBS_THE_ARM for line in observed.struck)
    for number, life in enumerate(observed.runs, 1):
        if _ends_at_rest(life) and life.exchanged:
            at = min(life.last_cycle, len(arm.open_axes) - 1)
            speed = np.abs(arm.velocity[at])
            rests = observed.cell.model.friction.standstill
            if _held_up(life):
                last = life.records[life.records["interval"] == life.records["interval"].max()]
                moved = np.abs(arm.velocity[last["cycle"]]).max()
                rests = np.maximum(rests, _SWING * moved)
            if not disturbed:
                yield from stands(speed, rests, f"where life {number} ends")
            # A controller that lost its drive closes the axes some cycles later, by itself. Axes
            # that open after the run's last packet are closed when the link is closed.
            excused = arm.phase[at] == Phase.TRIPPED.name or not arm.open_axes[at - 1]
            still_open = bool(arm.open_axes[at]) and not excused
            yield from closed(arm.phase[at], any_open=still_open, when=f"where life {number} ends")
        for interval, held, wanted in _held_too_short(life):
            text = f"interval {interval} is left {held} cycles after it moved, not {wanted}"
            yield f"life {number}: {text}"


def _revolutions(velocity: Array, gears: Gears, period: float) -> Array:
    """Return motor speeds [rev per cycle] of joint velocities (k, n) [rad/s]."""
    return np.asarray(velocity @ gears.matrix.T * period)


def _held_up(life: Life) -> bool:
    """Whether the controller may have stopped the last motion abruptly."""
    ends = [event.reason for _, event in life.events if isinstance(event, MotionEnded)]
    return any("missed in a row" in reason for reason in ends[-1:])


def _held_too_short(life: Life) -> Iterator[tuple[int, int, int]]:
    """Yield intervals with too short a settling time: number, cycles, required cycles."""
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
    """Whether the arm must be at rest outside open mode at the end of a run.

    Not after a kill, a refused or lost motion, or without a session: there the controller acts.
    """
    error = life.error
    if any(isinstance(cause, KeyboardInterrupt) for cause in _behind(error)):
        return False  # the disk failed during the abort
    if isinstance(error, MotionFailedError):
        return error.outcome == "stopped"
    ends = [event.outcome for _, event in life.events if isinstance(event, MotionEnded)]
    alone = isinstance(error, ControllerError) or ends[-1:] in (["refused"], ["lost"])
    return error is None or (isinstance(error, HilError) and not alone)


def _behind(error: BaseException | None) -> Iterator[BaseException]:
    """Yield an error and the chain of its contexts."""
    while error is not None:
        yield error
        error = error.__context__
