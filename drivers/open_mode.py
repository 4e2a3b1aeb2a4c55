"""One interval in open mode: set-points asked for, guarded, written into the answer."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.arm_wire import ArmWire
from drivers.checks import require
from drivers.correction_guard import CorrectionGuard
from drivers.errors import FirstSetPointUnknown, GuardError, MotionNotCarriedOn, MotionUnknown
from drivers.execution import Execution, MotionExecution
from drivers.guard import FIRST_FRACTION, Guard
from drivers.packets import Mode
from drivers.reading import Reading
from drivers.replies import D1, D2, D4, D5, ReplyFrame

# Whether the controller takes our set-points: its target held against those sent last.
#
# While answers are lost the controller has to make do without; when it then hears the next one,
# the arm is asked to leap by all that was lost. Unlike a packet that never arrived, a lost
# answer shows nowhere but in the target that the controller reports. A packet that never arrived
# is no answer either: a controller that carries its target on meanwhile reports one ahead of
# those sent.
Array = NDArray[np.float64]

LEAP_FRACTION: Final = 0.25
"""Share of the following-error threshold allowed between target and set-point sent last."""


class SentSetPoints:
    """The set-points sent last, in motor revolutions.

    Args:
        guard: whose following-error threshold and standstill apply.
        depth: how many of them the target received may be.
    """

    def __init__(self, guard: Guard, depth: int) -> None:
        n = guard.limits.n_joints
        self._guard = guard
        self._depth = depth
        # One more than allowed, so that one too many can be counted.
        self._sent = np.zeros((depth + 1, n))
        self._back = np.arange(depth + 1)
        self._ahead = np.arange(1.0, depth)[:, None]
        self._newest = 0
        self._lag = 0
        self._every = np.ones(n, dtype=np.bool_)

    def begin(self, target: Array) -> None:
        """The first set-point (n,) was sent, the target received."""
        self._sent[...] = target
        self._lag = 0

    def add(self, target: Array) -> None:
        """The next set-point (n,) was sent."""
        self._newest = newest = (self._newest + 1) % len(self._sent)
        self._sent[newest] = target

    def check(
        self, target: Array, missed: int, cycle: int, where: NDArray[np.bool_] | None = None
    ) -> int:
        """Each joint's target has to be one of the set-points sent last, or the last carried on.

        Args:
            target: (n,) D1 received, motor revolutions.
            missed: packets before this one that were not answered: for so many steps, but less
                than `depth`, the controller may have carried on.
            cycle: for the error.
            where: (n,) which joints; None for all.

        Returns:
            How many answers more than in the cycle before were not accepted. What a joint at
            standstill moves in a cycle hides one.

        Raises:
            NotFinite, MotionNotCarriedOn: a target further than `FIRST_FRACTION` of the
                following-error threshold from all of them, or than `LEAP_FRACTION` from the last.
        """
        sent, standstill = self._sent, self._guard.limits.standstill
        newest = sent[self._newest]
        # As always: the set-point sent last. All else may take its time.
        if np.abs(target - newest).max() <= standstill:
            # Where hardly anything moves, a target reported late looks the same.
            if self._lag and np.abs(newest - sent[self._newest - 1]).max() > standstill:
                self._lag = 0
            return 0
        rows = sent[(self._newest - self._back) % len(sent)]
        carried = newest + self._ahead[:missed] * (newest - rows[1])
        late, ahead = np.abs(rows - target), np.abs(carried - target)
        where = self._every if where is None else where
        nearest = np.minimum(late[: self._depth].min(axis=0), ahead.min(axis=0, initial=np.inf))
        threshold = self._guard.following_error
        require(where, nearest, FIRST_FRACTION * threshold, MotionNotCarriedOn, cycle)
        require(where, late[0], LEAP_FRACTION * threshold, MotionNotCarriedOn, cycle)
        behind = where & (late[0] > standstill)
        behind &= late.min(axis=0) <= ahead.min(axis=0, initial=np.inf)
        lag = int(late.argmin(axis=0)[behind].max(initial=0))
        more, self._lag = max(0, lag - self._lag), lag
        return more


Joints = NDArray[np.bool_]

# Rows of `ArmWire.raw`.
TARGET, TARGET_VELOCITY, ACTUAL, ACTUAL_VELOCITY, CURRENT = range(5)
_NEEDED_FIRST: Final = (TARGET, ACTUAL, ACTUAL_VELOCITY)
_NEEDED_AFTER_GAP: Final = (TARGET, TARGET_VELOCITY, ACTUAL_VELOCITY)


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
    def require_carried_on(self, reading: Reading, cycle: int) -> None:
        """The packet read last, the first after a long gap, against what was sent last.

        Axes that have closed, or did so since the first set-point, do not matter.

        Raises:
            NotFinite, MotionNotCarriedOn, MotionHeld: going on would be a jump.
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
        self._history = SentSetPoints(guard, max_gap + 1)
        self._sent = self._still
        self._step = self._still
        self._continuing = np.ones(len(self._still), dtype=np.bool_)
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
        self._continuing[...] = True
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
        self._check_accepted(cycle)
        if execution is None:
            self._guard.check_set_point(self.held, self._still, "plan", cycle)
            self._rest(commanded)
            return
        assert isinstance(execution, MotionExecution)
        position, velocity, bounds = execution.advance(cycle)
        self._guard.check_set_point(position, velocity, bounds, cycle)
        motor = self._wire.motor(position)
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

    def _check_accepted(self, cycle: int, where: Joints | None = None) -> None:
        """Whether the controller takes the set-points sent.

        An older target, or answers lost for longer than `max_gap`, would make a leap of the next.
        """
        lost = self._history.check(self._wire.raw[TARGET], self.missed, cycle, where)
        age = self._wire.age
        # The answer to the packet may have been taken all the same if the target is older.
        self.lost = lost if lost and (age is None or not age[TARGET].any()) else 0

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

    def require_carried_on(self, reading: Reading, cycle: int) -> None:
        """Target and velocity received against the set-point sent last."""
        where = self._continuing & reading.ready
        self._require_fresh(_NEEDED_AFTER_GAP, MotionUnknown, cycle, where)
        raw = self._wire.raw
        velocity, step = raw[1:4:2], self._step
        self._guard.check_after_gap(raw[TARGET], velocity, self._sent, step, cycle, where)

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
        if continuing.all():  # a source that ends in mid-motion would leave a jump to rest
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
