"""One interval in an open mode in which the controller generates the targets: 2, 7, 8 and 9."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.arm_wire import ArmWire
from drivers.correction_guard import CorrectionGuard
from drivers.errors import SourceFailed
from drivers.execution import CorrectionExecution, Execution
from drivers.guard import Guard
from drivers.open_mode import ACTUAL, CURRENT, TARGET, OpenMode
from drivers.packets import MODE_FIELDS, Mode
from drivers.reading import Reading
from drivers.replies import D1, D4, D5, ReplyFrame

Array = NDArray[np.float64]

_CURRENT_FIELD: Final = 5


class CorrectionMode(OpenMode):
    """Zeros, until a source corrects what the controller does.

    ====  ==============================  ===================================================
    mode  answered                        read as
    ====  ==============================  ===================================================
    2     D4 velocity, D5 current         fed forward beside the controller's own loop
    7     D1 offset                       added to the controller's own target of this cycle
    8     D4 velocity                     fed forward
    9     D5 current                      added to the current the servo asks for (D5 received)
    ====  ==============================  ===================================================

    How the controller uses an offset in mode 7 (for one cycle, or summed up) is documented
    nowhere. Hence it keeps the bounds under both readings: as a position beside the target, and
    as a step made anew in every cycle, which allows no more than the way of one cycle at full
    speed. So does the target with it, of which it is known how fast the controller moves it.

    Following error is |D1 - D3| as received: there is no target of ours to compare with.
    """

    def __init__(
        self,
        guard: Guard,
        wire: ArmWire,
        frame: ReplyFrame,
        mode: int,
        max_gap: int,  # noqa: ARG002  no target is ours
    ) -> None:
        super().__init__(guard, wire, frame)
        self._mode = mode
        self._offset = mode == Mode.DELTA_POSITION
        self._velocity = mode in (Mode.FEED_FORWARD, Mode.VELOCITY)
        self._current = _CURRENT_FIELD in MODE_FIELDS[mode]
        self._added_to_servo = mode == Mode.DELTA_CURRENT
        self._corrections = CorrectionGuard(guard, "offset" if self._offset else "velocity")

    def enter(self, measured: Array, commanded: Array, cycle: int) -> None:
        """The first answer is zero; the arm has to stand where the controller wants it."""
        self.require_start(cycle)
        self._check_arm(cycle)
        self.held = measured[0].copy()
        self._corrections.check_position(self.held, cycle)
        self._corrections.begin()
        self._corrections.note_target(self.held, self._still, self._sent_in(cycle))
        self._note(self._still, measured, commanded)

    def next(
        self, execution: Execution | None, measured: Array, commanded: Array, cycle: int
    ) -> None:
        """The next correction, or none."""
        self._check_arm(cycle)
        self.held = measured[0].copy()
        if execution is None:
            self._corrections.check_position(self.held, cycle)
            self._corrections.note_target(self.held, self._still, self._sent_in(cycle))
            self._note(self._still, measured, commanded)
            return
        assert isinstance(execution, CorrectionExecution)
        motion, current = execution.advance(cycle)
        self._require_fields(motion, current, cycle)
        guard = self._corrections
        guard.check_motion(motion, execution.granted, cycle)
        if execution.granted == "stop" and guard.resting:
            execution.rested()
        guard.check_position(self.held + motion if self._offset else self.held, cycle)
        if self._offset:
            rounding = self._wire.joint_rounding(self._wire.raw[TARGET])
            guard.check_target(self.held, motion, self._sent_in(cycle), rounding, cycle)
        servo = self._wire.raw[CURRENT] if self._added_to_servo else None
        guard.check_current(current, servo, cycle)
        if execution.finished:
            guard.check_end(cycle)
        self._write(motion, current)
        self._note(motion, measured, commanded)

    def require_carried_on(
        self,
        execution: Execution | None,  # noqa: ARG002  the motion is the controller's
        reading: Reading,  # noqa: ARG002  zero is zero in every axis
        cycle: int,
    ) -> None:
        """A correction that was not zero may have been applied or dropped: nothing tells."""
        self._corrections.check_after_gap(cycle)

    def require_no_pause(self, reading: Reading, cycle: int) -> None:
        """The controller generates the motion: what it should be is not known here."""

    def leaving(
        self,
        reading: Reading,
        measured: Array,
        commanded: Array,
        cycle: int,
    ) -> None:
        """Zeros, as the safe answer says; an axis in a mode of positions, its target."""
        held = reading.held
        if held.any():
            self.require_holdable(held, held, cycle)
            commanded[0] = np.where(held, measured[0], np.nan)
            commanded[1] = np.where(held, 0.0, np.nan)
        self._check_arm(cycle, where=reading.ready)

    def _sent_in(self, cycle: int) -> Array:
        """The cycle in which each target received was sent."""
        age = self._wire.age
        return self._still + cycle if age is None else cycle - age[TARGET].astype(np.float64)

    def _check_arm(self, cycle: int, where: NDArray[np.bool_] | None = None) -> None:
        raw = self._wire.raw
        target = raw[TARGET]
        self._guard.check_feedback(target, raw[ACTUAL], raw[CURRENT], target, cycle, where)

    def _require_fields(self, motion: Array, current: Array, cycle: int) -> None:
        """What this mode has no field for is a misunderstanding, not something to drop."""
        if not (self._offset or self._velocity) and np.any(motion):
            raise SourceFailed(f"mode {self._mode} has no field for a motion: {motion}", cycle)
        if not self._current and np.any(current):
            raise SourceFailed(f"mode {self._mode} has no field for a current: {current}", cycle)

    def _write(self, motion: Array, current: Array) -> None:
        frame, wire = self._frame.floats, self._wire
        if self._offset:
            wire.put(frame, D1, wire.motor_difference(motion))
        elif self._velocity:
            wire.put(frame, D4, wire.motor_difference(motion) * self._guard.period)
        if self._current:
            wire.put(frame, D5, current)

    def _note(self, motion: Array, measured: Array, commanded: Array) -> None:
        if self._offset:
            np.add(measured[0], motion, out=commanded[0])
        elif self._velocity:
            commanded[1] = motion
