"""One interval in open mode: set-points are computed, checked and written into the reply."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.drive_train import ArmWire
from drivers.errors import (
    AgeAfterGap,
    AxisNotInMode,
    FirstSetPointUnknown,
    GuardError,
    SetPointNotAccepted,
    SourceFailed,
)
from drivers.execution import CorrectionExecution, Execution, MotionExecution
from drivers.guard import FIRST_FRACTION, CorrectionGuard, Guard, require
from drivers.packets import MODE_FIELDS, Mode
from drivers.replies import D1, D2, D4, D5, Reading, ReplyFrame

Array = NDArray[np.float64]

LEAP_FRACTION: Final = 0.25
"""Share of the following-error threshold allowed between target and set-point sent last."""
SLOW: Final = 4.0
"""Multiple of the standstill threshold, some 2 % of full speed. Several such steps in one cycle are
permissible."""
REPETITIONS: Final = 100
"""Times that a set-point is sent again, at most, to a controller that does not accept it."""


class SentSetPoints:
    """The set-points sent last, compared with the controller's target, motor revolutions.

    While replies are lost the controller holds its target, so the last set-point is sent again
    until the target shows that it was accepted; the motion waits, as it does for packets. After
    missed packets a controller that extrapolates reports a target ahead of those sent.

    A controller that reports its target a cycle late cannot be distinguished from a lost reply in
    its first cycle. It is recognised in the first steps of a motion, which are small (`SLOW`):
    there nothing is sent again, and the lag of the target is not a loss from then on. A link that
    becomes late at speed is a loss in every second cycle, which soon stops the motion; while
    stopping it counts as late.

    Attributes:
        again: the controller did not accept the last one: it is to be sent once more.
        lag: cycles by which the controller reports its target late.
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
        self.lag = 0
        self._repeated = 0
        self._repeated_before = False
        self.again = False
        self._every = np.ones(n, dtype=np.bool_)

    def begin(self, target: Array) -> None:
        """Record that the first set-point (n,), the target received, was sent."""
        self._sent[...] = target
        self.lag = self._repeated = 0
        self._repeated_before = self.again = False

    def resume_from(self, target: Array, step: Array) -> None:
        """Record that the controller extrapolated to this target (n,) by this step (n,)."""
        self._sent[(self._newest - self._back) % len(self._sent)] = (
            target - self._back[:, None] * step
        )
        self._repeated, self._repeated_before, self.again = 0, False, False

    def repeat(self) -> None:
        """Record that the last set-point was sent once more."""
        self._repeated += 1

    def add(self, target: Array) -> None:
        """Record that the next set-point (n,) was sent."""
        self._repeated_before, self._repeated = self._repeated > 0, 0
        self._newest = newest = (self._newest + 1) % len(self._sent)
        self._sent[newest] = target

    def check(
        self,
        target: Array,
        missed: int,
        cycle: int,
        where: NDArray[np.bool_] | None = None,
        *,
        stopping: bool = False,
    ) -> int:
        """Require each joint's target to be one of the last set-points, or the last extrapolated.

        Args:
            target: (n,) D1 received, motor revolutions.
            missed: packets before this one without a reply: the controller may have extrapolated
                by as many steps, but less than `depth`.
            cycle: for the error.
            where: (n,) which joints; None for all.
            stopping: the motion is being brought to rest.

        Returns:
            Number of replies not accepted, beyond those of the cycle before. A joint that moves by
            less than the standstill threshold per cycle does not show one.

        Raises:
            NotFinite, SetPointNotAccepted: a target further than `FIRST_FRACTION` of the
                following-error threshold from all of them, or than `LEAP_FRACTION` from the last,
                or not the last one although this was sent `REPETITIONS` times.
        """
        sent, standstill = self._sent, self._guard.limits.standstill
        newest = sent[self._newest]
        self.again = False
        # Usual case: the set-point sent last.
        if np.abs(target - newest).max() <= standstill:
            # At standstill a target reported late is equal to it as well.
            step = np.abs(newest - sent[self._newest - 1]).max()
            if self.lag and not self._repeated and step > standstill:
                self.lag = 0
            return 0
        rows = sent[(self._newest - self._back) % len(sent)]
        extrapolated = newest + self._ahead[:missed] * (newest - rows[1])
        late, ahead = np.abs(rows - target), np.abs(extrapolated - target)
        where = self._every if where is None else where
        nearest = np.minimum(late[: self._depth].min(axis=0), ahead.min(axis=0, initial=np.inf))
        threshold = self._guard.following_error
        require(where, nearest, FIRST_FRACTION * threshold, SetPointNotAccepted, cycle)
        require(where, late[0], LEAP_FRACTION * threshold, SetPointNotAccepted, cycle)
        behind = where & (late[0] > standstill)
        behind &= late.min(axis=0) <= ahead.min(axis=0, initial=np.inf)
        lag = int(late.argmin(axis=0)[behind].max(initial=0))
        more = max(0, lag - self.lag)
        known_late = stopping and self._repeated_before
        if not more or known_late or np.abs(newest - rows[1]).max() <= SLOW * standstill:
            self.lag = lag
            return 0 if known_late else more
        self.again = True
        if self._repeated >= REPETITIONS:
            require(where, late[0], np.full_like(newest, standstill), SetPointNotAccepted, cycle)
        return 1 if self._repeated else more


Joints = NDArray[np.bool_]

# Rows of `ArmWire.raw`.
TARGET, TARGET_VELOCITY, ACTUAL, ACTUAL_VELOCITY, CURRENT = range(5)
_NEEDED_FIRST: Final = (TARGET, ACTUAL, ACTUAL_VELOCITY)
_NEEDED_AFTER_GAP: Final = (TARGET, TARGET_VELOCITY, ACTUAL_VELOCITY)
SPREAD: Final = 2
"""Cycles, per step that a controller extrapolated, in which the motion returns to its path.
Where the motion accelerates, each step leaves the velocity of one cycle of that acceleration across
the path; spread over two cycles this is half of that acceleration, within the bounds of a stop."""
RETURN: Final = 0.03
"""Longest duration of that return, during which jerk has no bound, s. A path that was left for more
than half of it has so little curvature, less than 10 rad/s² within 1e-3 rad, that no longer return
is needed; and the motion does not stay beside its path for as long as a gap may last."""


class _OpenMode:
    """Writes set-points into `frame`, which holds the safe reply, and into a record (2, n).

    Attributes:
        held: (n,) rad, the set-point sent last.
        lost: replies that were not accepted according to the last packet.
        missed: packets before that one without a reply; to be set for each packet.
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
        """Hold the axes that are open already, by the safe reply; raises GuardError."""
        self.lost = 0  # set-points of an earlier interval do not matter
        self._hold(reading.held, reading.held | reading.ready, measured, commanded, cycle)

    def _hold(
        self, held: Joints, where: Joints, measured: Array, commanded: Array, cycle: int
    ) -> None:
        self.require_holdable(held, where, cycle)
        _command_targets(held, measured, commanded)

    def require_holdable(self, held: Joints, where: Joints, cycle: int) -> None:
        """Require new targets for joints `held` (n,), and all of `where` near their targets.

        Raises:
            FirstSetPointUnknown, NotFinite, FollowingError: a target is old or not finite, or the
                arm is elsewhere.
        """
        self._require_fresh((TARGET,), FirstSetPointUnknown, cycle, held)
        raw = self._wire.raw
        self._guard.check_hold(raw[TARGET], raw[ACTUAL], where, cycle)

    def require_start(self, cycle: int) -> None:
        """Require the conditions of the first set-point; raises NotFinite, FirstSetPoint."""
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


def _command_targets(held: Joints, measured: Array, commanded: Array) -> None:
    """Record the targets of `held` joints as commanded, at rest."""
    commanded[0] = np.where(held, measured[0], np.nan)
    commanded[1] = np.where(held, 0.0, np.nan)


class PositionMode(_OpenMode):
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
        self._last_reply = frame.floats[self._slots].copy()
        self._continuing = wire.opened.copy()
        self._feed_forward = (
            CorrectionGuard(guard, "velocity") if mode == Mode.POSITION_FEED_FORWARD else None
        )

    def enter(self, measured: Array, commanded: Array, cycle: int) -> None:
        """Send the target received as the first set-point, at rest; raises GuardError."""
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
        """Require the arm at rest at the set-point that was held, too."""
        super().require_start(cycle)
        raw = self._wire.raw
        self._guard.check_start(self._sent, raw[ACTUAL], raw[1:4:2], cycle)

    def next(
        self,
        execution: Execution | None,
        measured: Array,  # noqa: ARG002  needed for corrections only
        commanded: Array,
        cycle: int,
    ) -> None:
        """Send the motion's next set-point, or the last one without a motion.

        Raises:
            RefusalError: the arm does not follow, the source failed or the guard refused.
        """
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
        self._last_reply = frame[self._slots].copy()
        self._velocity = commanded[1].copy()

    def _repeat(self, commanded: Array) -> None:
        """Send the last reply once more, because the controller holds the target before it."""
        self._frame.floats[self._slots] = self._last_reply
        self._history.repeat()
        commanded[0] = self.held
        commanded[1] = self._velocity

    def _require_closed_still(self, motor: Array, cycle: int) -> None:
        """Require closed axes to stay where the controller holds them, wrist couplings included."""
        opened = self._wire.opened
        if opened.all():
            return
        off = np.abs(motor - self._wire.raw[TARGET]) > self._guard.limits.standstill
        if (off & ~opened).any():
            raise AxisNotInMode(int(np.argmax(off & ~opened)), Mode.CLOSED, self._mode, cycle)

    def _check_accepted(
        self, cycle: int, where: Joints | None = None, *, stopping: bool = False
    ) -> None:
        """Check the target received against the set-points sent, and count lost replies."""
        target, age = self._wire.raw[TARGET], self._wire.age
        lost = self._history.check(target, self.missed, cycle, where, stopping=stopping)
        if age is not None and age[TARGET].any():
            # An old target does not show whether the last reply was accepted.
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
        guard.check_motion(velocity, execution.widest, cycle)
        guard.check_current(current, None, cycle)
        if execution.finished:
            guard.check_end(cycle)
        wire.put(frame, D4, wire.motor_difference(velocity) * self._guard.period)
        wire.put(frame, D5, current)

    def check_after_gap(self, execution: Execution | None, reading: Reading, cycle: int) -> None:
        """Compare target and velocity with the set-point sent last, after a long gap.

        A motion continues from the target, some steps further on its path, or at rest. Axes that
        have closed since the first set-point are left out.

        Raises:
            NotFinite, SetPointNotAccepted, VelocityAfterGap, SourceFailed: it cannot continue.
        """
        where = self._continuing & reading.ready
        self._require_fresh(_NEEDED_AFTER_GAP, AgeAfterGap, cycle, where)
        raw, step = self._wire.raw, self._step
        target, velocity = np.where(where, raw[TARGET], self._sent), np.where(where, raw[1:4:2], 0)
        if not (isinstance(execution, MotionExecution) and execution.is_resumable and step.any()):
            self._guard.check_after_gap(target, velocity, self._sent, step, cycle, where)
            return
        # A target that is reported late is further on by now.
        target = target + self._history.lag * velocity[0]
        ahead = self._sent + np.arange(self.missed + 1)[:, None] * step
        steps = int(np.abs(target - ahead).max(axis=1).argmin())
        moved, moves = np.abs((step, velocity[0])).max(axis=1) > self._guard.limits.standstill
        # For a motion slower than standstill, the target shows whether it was held.
        step = self._still if not moves and (moved or steps == 0) else step
        self._guard.check_after_gap(target, velocity, ahead[steps], step, cycle, where)
        step = velocity[0] if moves else step
        position = self.held + self._wire.joint_difference(target - self._sent)
        speed = self._wire.joint_difference(step) / self._guard.period
        spread = min(SPREAD * steps, round(RETURN / self._guard.period))
        execution.resume_from(position, speed, spread, cycle)
        self._guard.resume_from(position, speed, spread)
        self._history.resume_from(target, step)
        self.held, self._sent = position, target

    def check_after_pause(self, reading: Reading, cycle: int) -> None:
        """Require after a late packet that the arm moves as the set-points sent last."""
        where = self._continuing & reading.ready
        self._require_fresh((ACTUAL_VELOCITY,), AgeAfterGap, cycle, where)
        velocity = self._wire.joint_difference(self._wire.raw[ACTUAL_VELOCITY])
        self._guard.check_after_pause(velocity / self._guard.period, cycle, where)

    def leaving(self, reading: Reading, measured: Array, commanded: Array, cycle: int) -> None:
        """Hold axes that were always open at the last set-point, reopened ones at their target."""
        raw, continuing, held = self._wire.raw, self._continuing, reading.held
        continuing &= reading.ready
        self.require_holdable(held & ~continuing, held | reading.ready, cycle)
        _command_targets(held, measured, commanded)
        self._guard.check_feedback(
            raw[TARGET], raw[ACTUAL], raw[CURRENT], self._sent, cycle, where=continuing
        )
        self._check_accepted(cycle, continuing)
        if np.array_equal(continuing, self._wire.opened):
            # A source that ends while moving would cause a jump to rest.
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


_CURRENT_FIELD: Final = 5


class CorrectionMode(_OpenMode):
    """Modes 2, 7, 8 and 9: corrections of targets that the controller generates, or zeros.

    ====  ==============================  ===================================================
    mode  reply                           effect in the controller
    ====  ==============================  ===================================================
    2     D4 velocity, D5 current         fed forward beside the controller's own loop
    7     D1 offset                       added to the controller's own target of this cycle
    8     D4 velocity                     fed forward
    9     D5 current                      added to the current the servo asks for (D5 received)
    ====  ==============================  ===================================================

    Whether the controller applies an offset in mode 7 for one cycle or adds it up is not
    documented. Hence it satisfies the bounds in both cases: as a position beside the target, and
    as a step in every cycle, which limits it to the distance of one cycle at full speed. So does
    its sum with the target.

    Following error is |D1 - D3| as received, because the PC sends no target.
    """

    def __init__(
        self,
        guard: Guard,
        wire: ArmWire,
        frame: ReplyFrame,
        mode: int,
        max_gap: int,  # noqa: ARG002  needed for targets of the PC only
    ) -> None:
        super().__init__(guard, wire, frame)
        self._mode = mode
        self._offset = mode == Mode.DELTA_POSITION
        self._velocity = mode in (Mode.FEED_FORWARD, Mode.VELOCITY)
        self._current = _CURRENT_FIELD in MODE_FIELDS[mode]
        self._added_to_servo = mode == Mode.DELTA_CURRENT
        self._corrections = CorrectionGuard(guard, "offset" if self._offset else "velocity")

    def enter(self, measured: Array, commanded: Array, cycle: int) -> None:
        """Send zero; require the arm at rest at the controller's target."""
        self.require_start(cycle)
        self._check_arm(cycle)
        self.held = measured[0].copy()
        self._corrections.check_position(self.held, cycle)
        self._corrections.begin()
        self._send_zero(measured, commanded, cycle)

    def _send_zero(self, measured: Array, commanded: Array, cycle: int) -> None:
        self._corrections.set_target(self.held, self._still, self._sent_in(cycle))
        self._record(self._still, measured, commanded)

    def next(
        self, execution: Execution | None, measured: Array, commanded: Array, cycle: int
    ) -> None:
        """Send the next correction, or zero without a motion."""
        self._check_arm(cycle)
        self.held = measured[0].copy()
        if execution is None:
            self._corrections.check_position(self.held, cycle)
            self._send_zero(measured, commanded, cycle)
            return
        assert isinstance(execution, CorrectionExecution)
        motion, current = execution.advance(cycle)
        self._require_fields(motion, current, cycle)
        guard = self._corrections
        guard.check_motion(motion, execution.widest, cycle)
        if execution.widest == "stop" and guard.resting:
            execution.mark_at_rest()
        guard.check_position(self.held + motion if self._offset else self.held, cycle)
        if self._offset:
            rounding = self._wire.joint_rounding(self._wire.raw[TARGET])
            guard.check_target(self.held, motion, self._sent_in(cycle), rounding, cycle)
        servo = self._wire.raw[CURRENT] if self._added_to_servo else None
        guard.check_current(current, servo, cycle)
        if execution.finished:
            guard.check_end(cycle)
        self._write(motion, current)
        self._record(motion, measured, commanded)

    def check_after_gap(
        self,
        execution: Execution | None,  # noqa: ARG002  needed for targets of the PC only
        reading: Reading,  # noqa: ARG002
        cycle: int,
    ) -> None:
        """Require the last correction to be zero: it is unknown whether it was applied."""
        self._corrections.check_after_gap(cycle)

    def check_after_pause(self, reading: Reading, cycle: int) -> None:
        """Check nothing: the controller generates the motion."""

    def leaving(self, reading: Reading, measured: Array, commanded: Array, cycle: int) -> None:
        """Send zeros, by the safe reply; the target to an axis in a position mode."""
        if reading.held.any():
            self._hold(reading.held, reading.held, measured, commanded, cycle)
        self._check_arm(cycle, where=reading.ready)

    def _sent_in(self, cycle: int) -> Array:
        """Return the cycle in which each target received was sent."""
        age = self._wire.age
        return self._still + cycle if age is None else cycle - age[TARGET].astype(np.float64)

    def _check_arm(self, cycle: int, where: NDArray[np.bool_] | None = None) -> None:
        raw = self._wire.raw
        target = raw[TARGET]
        self._guard.check_feedback(target, raw[ACTUAL], raw[CURRENT], target, cycle, where)

    def _require_fields(self, motion: Array, current: Array, cycle: int) -> None:
        """Refuse a correction that this mode has no field for."""
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

    def _record(self, motion: Array, measured: Array, commanded: Array) -> None:
        if self._offset:
            np.add(measured[0], motion, out=commanded[0])
        elif self._velocity:
            commanded[1] = motion


OpenMode = PositionMode | CorrectionMode
