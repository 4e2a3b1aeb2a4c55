"""One interval in open mode: set-points asked for, guarded, written into the answer."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.arm_wire import ArmWire
from drivers.checks import require
from drivers.correction_guard import CorrectionGuard
from drivers.errors import AxisLeft, FirstSetPointUnknown, GuardError, MotionUnknown
from drivers.execution import Execution, MotionExecution
from drivers.guard import Guard
from drivers.packets import Mode
from drivers.reading import Reading
from drivers.replies import D1, D2, D4, D5, ReplyFrame
from drivers.set_points import SentSetPoints

Array = NDArray[np.float64]
Joints = NDArray[np.bool_]

# Rows of `ArmWire.raw`.
TARGET, TARGET_VELOCITY, ACTUAL, ACTUAL_VELOCITY, CURRENT = range(5)
_NEEDED_FIRST: Final = (TARGET, ACTUAL, ACTUAL_VELOCITY)
_NEEDED_AFTER_GAP: Final = (TARGET, TARGET_VELOCITY, ACTUAL_VELOCITY)
SPREAD: Final = 2
"""Cycles for each step that a controller made by itself in which the motion returns to its path.
Where the motion accelerates, each step leaves the velocity of one cycle of that acceleration across
the path; so spread it is half of that acceleration, within the bounds of a stop."""
RETURN: Final = 0.03
"""s that this takes at most, and jerk has no bound. A path that the controller left for longer than
half of it bends so little, at less than 10 rad/s² within 1e-3 rad, that spread no further it is
well within those bounds; and nothing goes on beside the path for as long as a gap may last."""


class OpenMode(ABC):
    """Writes into `frame` what is sent, and into the record (2, n) what was commanded.

    The frame holds the safe answer already.

    Attributes:
        held: (n,) rad, the set-point sent last.
        lost: answers that the packet read last shows not to have been accepted.
        missed: packets before that one that were not answered; to be set for each.
    """

    def __init__(self, guard: Guard, wire: ArmWire, frame: ReplyFrame) -> None:
        self._guard = guard
        self._wire = wire
        self._frame = frame
        self._still = np.zeros(guard.limits.n_joints)
        self._every = np.ones(guard.limits.n_joints, dtype=np.bool_)
        self.held = self._still
        self.lost = 0
        self.missed = 0

    def opening(self, reading: Reading, measured: Array, commanded: Array, cycle: int) -> None:
        """Some axes are open: the safe answer holds them, if they can be held.

        Raises:
            GuardError: they cannot.
        """
        self.lost = 0  # what was sent in an earlier interval is no longer asked for
        held = reading.held
        self.require_holdable(held, held | reading.ready, cycle)
        commanded[0] = np.where(held, measured[0], np.nan)
        commanded[1] = np.where(held, 0.0, np.nan)

    def require_holdable(self, given: Joints, where: Joints, cycle: int) -> None:
        """Joints `given` (n,) back the target received, and all of `where` near theirs.

        Raises:
            FirstSetPointUnknown: the target was sent in an earlier cycle.
            NotFinite, FollowingError: it is no number, or the arm is elsewhere.
        """
        self._require_fresh((TARGET,), FirstSetPointUnknown, cycle, given)
        raw = self._wire.raw
        self._guard.check_hold(raw[TARGET], raw[ACTUAL], where, cycle)

    @abstractmethod
    def enter(self, measured: Array, commanded: Array, cycle: int) -> None:
        """The last wanted axis opened in this packet: the first answer in open mode.

        Raises:
            GuardError: it must not be sent.
        """

    @abstractmethod
    def next(
        self, execution: Execution | None, measured: Array, commanded: Array, cycle: int
    ) -> None:
        """One period on: what the source gives, or rest where nothing was begun.

        Raises:
            RefusalError: the arm does not follow, the source failed or the guard said no.
        """

    @abstractmethod
    def require_carried_on(self, execution: Execution | None, reading: Reading, cycle: int) -> None:
        """The packet read last, the first after a long gap, against what was sent last.

        Axes that have closed, or did so since the first set-point, do not matter.

        Raises:
            NotFinite, MotionNotCarriedOn, MotionHeld, SourceFailed: going on would be a jump.
        """

    @abstractmethod
    def require_no_pause(self, reading: Reading, cycle: int) -> None:
        """The packet read last came late by the clock: the arm moves as it should, all the same.

        Raises:
            NotFinite, MotionPaused: going on would be a jump.
        """

    @abstractmethod
    def leaving(self, reading: Reading, measured: Array, commanded: Array, cycle: int) -> None:
        """Axes still open stay at rest; those that closed have the safe answer.

        Raises:
            GuardError: an axis still open does not follow, or takes too much current.
        """

    def require_start(self, cycle: int) -> None:
        """A motion begins where the arm was held: the conditions of the first set-point.

        Raises:
            NotFinite, FirstSetPoint: they do not hold.
        """
        self._require_fresh(_NEEDED_FIRST, FirstSetPointUnknown, cycle)
        raw = self._wire.raw
        self._guard.check_start(raw[TARGET], raw[ACTUAL], raw[1:4:2], cycle)

    def _require_fresh(
        self,
        rows: tuple[int, ...],
        error: type[GuardError],
        cycle: int,
        where: Joints | None = None,
    ) -> None:
        age = self._wire.age
        if age is None:
            return
        where = self._every if where is None else where
        for row in rows:
            require(where, age[row].astype(np.float64), self._still, error, cycle)


class PositionMode(OpenMode):
    """Modes 1, 4 and 5: the PC generates the targets."""

    def __init__(
        self, guard: Guard, wire: ArmWire, frame: ReplyFrame, mode: int, max_gap: int
    ) -> None:
        super().__init__(guard, wire, frame)
        self._mode = mode
        self._history = SentSetPoints(guard, max_gap + 1)
        self._sent = self._still
        self._step = self._still
        self._velocity = self._still
        self._slots = wire.joint_slots[wire.opened]
        self._answer = frame.floats[self._slots].copy()
        self._continuing = wire.opened.copy()
        self._feed_forward = (
            CorrectionGuard(guard, "velocity") if mode == Mode.POSITION_FEED_FORWARD else None
        )

    def enter(self, measured: Array, commanded: Array, cycle: int) -> None:
        """The first set-point is the target received, at zero velocity."""
        self._require_fresh(_NEEDED_FIRST, FirstSetPointUnknown, cycle)
        raw = self._wire.raw
        target = raw[TARGET].copy()
        position = measured[0].copy()
        self._guard.begin(position, target, raw[ACTUAL], raw[1:4:2], cycle)
        self._guard.check_feedback(target, raw[ACTUAL], raw[CURRENT], target, cycle)
        if self._feed_forward is not None:
            self._feed_forward.begin()
        self.held = position
        self._sent = target
        self._history.begin(target)
        self.lost = 0
        self._continuing[...] = self._wire.opened
        self._rest(commanded)

    def require_start(self, cycle: int) -> None:
        """The arm has to stand at the set-point that was held, too."""
        super().require_start(cycle)
        raw = self._wire.raw
        self._guard.check_start(self._sent, raw[ACTUAL], raw[1:4:2], cycle)

    def next(
        self,
        execution: Execution | None,
        measured: Array,  # noqa: ARG002  the motion does not come from there
        commanded: Array,
        cycle: int,
    ) -> None:
        """The motion's next set-point, or the last one where nothing moves."""
        raw = self._wire.raw
        self._guard.check_feedback(raw[TARGET], raw[ACTUAL], raw[CURRENT], self._sent, cycle)
        stopping = execution is not None and execution.outcome == "stopped"
        self._check_accepted(cycle, stopping=stopping)
        if execution is None:
            self._guard.check_set_point(self.held, self._still, "plan", cycle)
            self._rest(commanded)
            return
        assert isinstance(execution, MotionExecution)
        if self._history.again:
            self._repeat(commanded)
            return
        position, velocity, bounds = execution.advance(cycle)
        self._guard.check_set_point(position, velocity, bounds, cycle)
        motor = self._wire.motor(position)
        self._require_closed_still(motor, cycle)
        self._step = step = motor - self._sent
        np.subtract(position, self.held, out=commanded[1])
        commanded[1] /= self._guard.period
        commanded[0] = position
        frame = self._frame.floats
        self._wire.write(frame, motor, step)
        if self._feed_forward is not None:
            self._write_feed_forward(self._feed_forward, execution, step, cycle)
        self.held = position
        self._sent = motor
        self._history.add(motor)
        self._answer = frame[self._slots].copy()
        self._velocity = commanded[1].copy()

    def _repeat(self, commanded: Array) -> None:
        """The answer sent last once more: the controller holds the target before it."""
        self._frame.floats[self._slots] = self._answer
        self._history.repeat()
        commanded[0] = self.held
        commanded[1] = self._velocity

    def _require_closed_still(self, motor: Array, cycle: int) -> None:
        """Axes that stay closed are where the controller holds them, wrist couplings included."""
        opened = self._wire.opened
        if opened.all():
            return
        off = np.abs(motor - self._wire.raw[TARGET]) > self._guard.limits.standstill
        if (off & ~opened).any():
            raise AxisLeft(int(np.argmax(off & ~opened)), Mode.CLOSED, self._mode, cycle)

    def _check_accepted(
        self, cycle: int, where: Joints | None = None, *, stopping: bool = False
    ) -> None:
        """Whether the controller accepts the set-points sent.

        An older target, or answers lost for longer than `max_gap`, would make a leap of the next.
        """
        target, age = self._wire.raw[TARGET], self._wire.age
        lost = self._history.check(target, self.missed, cycle, where, stopping=stopping)
        if age is not None and age[TARGET].any():
            # The answer to the packet may have been accepted all the same if the target is older.
            lost, self._history.again = 0, False
        self.lost = lost

    def _write_feed_forward(
        self, guard: CorrectionGuard, execution: MotionExecution, step: Array, cycle: int
    ) -> None:
        frame, wire = self._frame.floats, self._wire
        if not execution.feeds_forward:
            wire.put(frame, D4, step)
            return
        velocity, current = execution.feed_forward(cycle)
        guard.check_motion(velocity, execution.granted, cycle)
        guard.check_current(current, None, cycle)
        if execution.finished:
            guard.check_end(cycle)
        wire.put(frame, D4, wire.motor_difference(velocity) * self._guard.period)
        wire.put(frame, D5, current)

    def require_carried_on(self, execution: Execution | None, reading: Reading, cycle: int) -> None:
        """Target and velocity received against the set-point sent last, and some steps more.

        A motion goes on from there: as many steps further on its path, or at rest.
        """
        where = self._continuing & reading.ready
        self._require_fresh(_NEEDED_AFTER_GAP, MotionUnknown, cycle, where)
        raw, step = self._wire.raw, self._step
        target, velocity = np.where(where, raw[TARGET], self._sent), np.where(where, raw[1:4:2], 0)
        if not (isinstance(execution, MotionExecution) and execution.follows and step.any()):
            self._guard.check_after_gap(target, velocity, self._sent, step, cycle, where)
            return
        # One that is reported late is further on by now.
        target = target + self._history.lag * velocity[0]
        ahead = self._sent + np.arange(self.missed + 1)[:, None] * step
        steps = int(np.abs(target - ahead).max(axis=1).argmin())
        moved, moves = np.abs((step, velocity[0])).max(axis=1) > self._guard.limits.standstill
        step = self._still if moved and not moves else step
        self._guard.check_after_gap(target, velocity, ahead[steps], step, cycle, where)
        # What counts as standstill does not say how fast a slow motion is.
        step = velocity[0] if moves else step
        position = self.held + self._wire.joint_difference(target - self._sent)
        speed = self._wire.joint_difference(step) / self._guard.period
        spread = min(SPREAD * steps, round(RETURN / self._guard.period))
        execution.go_on_from(position, speed, spread, cycle)
        self._guard.go_on_from(position, speed, spread)
        self._history.go_on_from(target, step)
        self.held, self._sent = position, target

    def require_no_pause(self, reading: Reading, cycle: int) -> None:
        """Velocity of the arm against that of the set-points sent last."""
        where = self._continuing & reading.ready
        self._require_fresh((ACTUAL_VELOCITY,), MotionUnknown, cycle, where)
        velocity = self._wire.joint_difference(self._wire.raw[ACTUAL_VELOCITY])
        self._guard.check_after_pause(velocity / self._guard.period, cycle, where)

    def leaving(self, reading: Reading, measured: Array, commanded: Array, cycle: int) -> None:
        """Axes open all the time keep the last set-point; those open again, their target."""
        raw, continuing, held = self._wire.raw, self._continuing, reading.held
        continuing &= reading.ready
        self.require_holdable(held & ~continuing, held | reading.ready, cycle)
        commanded[0] = np.where(held, measured[0], np.nan)
        commanded[1] = np.where(held, 0.0, np.nan)
        self._guard.check_feedback(
            raw[TARGET], raw[ACTUAL], raw[CURRENT], self._sent, cycle, where=continuing
        )
        self._check_accepted(cycle, continuing)
        if np.array_equal(continuing, self._wire.opened):
            # A source that ends in mid-motion would leave a jump to rest.
            self._guard.check_set_point(self.held, self._still, "plan", cycle)
        self._history.add(self._sent)
        self._step = self._still
        slots = self._wire.joint_slots[continuing]
        self._frame.floats[slots, D1] = self._sent[continuing]
        self._frame.floats[slots, D2] = 0.0
        commanded[0, continuing] = self.held[continuing]

    def _rest(self, commanded: Array) -> None:
        self._step = self._still
        self._history.add(self._sent)
        self._wire.write(self._frame.floats, self._sent, self._still)
        commanded[0] = self.held
        commanded[1] = 0.0
