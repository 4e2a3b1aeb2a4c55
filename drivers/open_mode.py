"""The set-points of one interval in open mode: asked for, guarded, written into the answer."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drivers.arm_wire import ArmWire
from drivers.execution import Execution
from drivers.guard import Guard
from drivers.reading import Reading
from drivers.replies import D1, D2, ReplyFrame

Array = NDArray[np.float64]


class OpenMode:
    """Writes set-points into `frame` and into the record (2, n) of what was commanded.

    Attributes:
        held: (n,) rad, the set-point sent last.
    """

    def __init__(self, guard: Guard, wire: ArmWire, frame: ReplyFrame) -> None:
        self._guard = guard
        self._wire = wire
        self._frame = frame
        n = len(wire.joint_slots)
        self._still = np.zeros(n)
        self.held = self._still
        self._sent = self._still
        self._step = self._still

    def opening(self, reading: Reading, measured: Array, commanded: Array, cycle: int) -> None:
        """Some axes are open: the safe answer gives them their target, if it can be held.

        Raises:
            GuardError: it cannot.
        """
        raw = self._wire.raw
        self._guard.check_hold(raw[0], raw[2], reading.held, cycle)
        commanded[0] = np.where(reading.held, measured[0], np.nan)
        commanded[1] = np.where(reading.held, 0.0, np.nan)

    def enter(self, measured: Array, commanded: Array, cycle: int) -> None:
        """The last wanted axis opened in this packet: the first set-point.

        Raises:
            GuardError: it must not be sent.
        """
        raw = self._wire.raw
        target = raw[0].copy()
        position = measured[0].copy()
        self._guard.begin(position, target, raw[2], raw[1:4:2], cycle)
        self._guard.check_feedback(target, raw[2], raw[4], target, cycle)
        self.held = position
        self._sent = target
        self._write(target, self._still, commanded)

    def next(self, execution: Execution | None, commanded: Array, cycle: int) -> None:
        """One period on: the motion's next set-point, or the last one where nothing moves.

        Raises:
            RefusalError: the arm does not follow, the source failed or the guard said no.
        """
        raw = self._wire.raw
        self._guard.check_feedback(raw[0], raw[2], raw[4], self._sent, cycle)
        if execution is None or not execution.started:
            self._guard.check_set_point(self.held, self._still, "plan", cycle)
            self._write(self._sent, self._still, commanded)
            return
        position, velocity, bounds = execution.advance(cycle)
        self._guard.check_set_point(position, velocity, bounds, cycle)
        motor = self._wire.motor(position)
        self._step = step = motor - self._sent
        np.subtract(position, self.held, out=commanded[1])
        commanded[1] /= self._guard.period
        commanded[0] = position
        self._wire.write(self._frame.floats, motor, step)
        self.held = position
        self._sent = motor

    def require_carried_on(self, cycle: int) -> None:
        """The packet read last, the first after a long gap, against the set-point sent last.

        Raises:
            NotFinite, MotionNotCarriedOn, MotionHeld: the arm is not where and as fast as it was.
        """
        raw = self._wire.raw
        self._guard.check_after_gap(raw[0], raw[1:4:2], self._sent, self._step, cycle)

    def leaving(self, reading: Reading, commanded: Array) -> None:
        """Axes still open keep the last set-point; those that closed have the safe answer."""
        ready = reading.ready
        slots = self._wire.joint_slots[ready]
        self._frame.floats[slots, D1] = self._sent[ready]
        self._frame.floats[slots, D2] = 0.0
        commanded[0] = np.where(ready, self.held, np.nan)
        commanded[1] = np.where(ready, 0.0, np.nan)

    def _write(self, motor: Array, step: Array, commanded: Array) -> None:
        self._step = step
        self._wire.write(self._frame.floats, motor, step)
        commanded[0] = self.held
        commanded[1] = 0.0
