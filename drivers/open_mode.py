"""One interval in open mode: set-points are computed, checked and written into the reply."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Final

import numpy as np

from drivers.drive_train import ArmWire
from drivers.errors import AxisNotInMode, Check, SourceFailed
from drivers.execution import Execution
from drivers.guard import FIRST_FRACTION, Array, CorrectionGuard, Guard, Joints, require
from drivers.packets import MODE_FIELDS, Mode
from drivers.replies import D1, D2, D4, D5, Reading, ReplyFrame

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
        where: Joints | None = None,
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
            GuardError: a target further than `FIRST_FRACTION` of the
                following-error threshold from all of them, or than `LEAP_FRACTION` from the last,
                or not the last one although this was sent `REPETITIONS` times.
        """
        sent, standstill = self._sent, self._guard.limits.standstill
        newest = sent[self._newest]
        self.again = False
        # Usual case: the set-point sent last.
        if np.abs(target - newest).max() <= standstill:
            # At standstill a target reported late is equal to it as well.
            before = sent[self._newest - 1]
            if self.lag and not self._repeated and np.abs(newest - before).max() > standstill:
                self.lag = 0
            return 0
        rows = sent[(self._newest - self._back) % len(sent)]
        extrapolated = newest + self._ahead[:missed] * (newest - rows[1])
        late, ahead = np.abs(rows - target), np.abs(extrapolated - target)
        where = self._every if where is None else where
        nearest = np.minimum(late[: self._depth].min(axis=0), ahead.min(axis=0, initial=np.inf))
        threshold = self._guard.following_error
        require(where, nearest, FIRST_FRACTION * threshold, Check.ACCEPTED, cycle)
        require(where, late[0], LEAP_FRACTION * threshold, Check.ACCEPTED, cycle)
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
            require(where, late[0], np.full_like(newest, standstill), Check.ACCEPTED, cycle)
        return 1 if self._repeated else more


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


class OpenMode(ABC):
    """Writes set-points into `frame`, which holds the safe reply, and into the cycle's record.

    Methods that check or send something raise `GuardError` or `SourceFailed`.

    Attributes:
        set_point: (n,) rad, the one sent last.
        lost: replies that were not accepted according to the last packet.
    """

    def __init__(self, guard: Guard, wire: ArmWire, frame: ReplyFrame, mode: int) -> None:
        n = guard.limits.n_joints
        self._guard = guard
        self._wire = wire
        self._raw = wire.raw
        self._frame = frame
        self._mode = mode
        self._still = np.zeros(n)
        self._every = np.ones(n, dtype=np.bool_)
        self.set_point = self._still
        self.lost = 0

    def receive(
        self, reading: Reading, measured: Array, commanded: Array, cycle: int, missed: int
    ) -> None:
        """Receive the packet of `cycle`; to be called before any other method.

        Args:
            reading: status and modes.
            measured: (8, n) its values in SI, joint side.
            commanded: (2, n) record of the reply, NaN.
            cycle: of the controller.
            missed: packets before this one without a reply.
        """
        self._reading, self._measured, self._commanded = reading, measured, commanded
        self._cycle, self._missed = cycle, missed

    def opening(self) -> None:
        """Hold the axes that are open already, by the safe reply."""
        self.lost = 0  # set-points of an earlier interval do not matter
        returned = self._reading.returned
        self.require_holdable(returned, returned | self._reading.ready)
        self._record_returned(returned)

    def _record_returned(self, returned: Joints) -> None:
        """Record the targets of `returned` joints as commanded, at rest."""
        self._commanded[0] = np.where(returned, self._measured[0], np.nan)
        self._commanded[1] = np.where(returned, 0.0, np.nan)

    def require_holdable(self, returned: Joints, where: Joints) -> None:
        """Require new targets for joints `returned` (n,), and all of `where` near their targets."""
        self._require_fresh((TARGET,), Check.FIRST_AGE, returned)
        self._guard.check_hold(self._raw[TARGET], self._raw[ACTUAL], where, self._cycle)

    def require_start(self) -> None:
        """Require the conditions of the first set-point."""
        self._require_fresh(_NEEDED_FIRST, Check.FIRST_AGE, self._every)
        self._check_start(self._raw[TARGET])

    def _check_start(self, target: Array) -> None:
        raw = self._raw
        self._guard.check_start(target, raw[ACTUAL], raw[1:4:2], self._cycle)

    def _require_fresh(self, rows: tuple[int, ...], check: Check, where: Joints) -> None:
        age = self._wire.age
        if age is None:
            return
        for row in rows:
            require(where, age[row].astype(np.float64), self._still, check, self._cycle)

    def _check_feedback(self, sent: Array, where: Joints | None = None) -> None:
        raw = self._raw
        self._guard.check_feedback(raw[TARGET], raw[ACTUAL], raw[CURRENT], sent, self._cycle, where)

    @abstractmethod
    def enter(self) -> None:
        """Send the first set-point, at rest, or a correction of zero."""

    @abstractmethod
    def next(self, execution: Execution | None) -> None:
        """Send the next set-point or correction of the motion; without one, rest."""

    @abstractmethod
    def check_after_gap(self, execution: Execution | None) -> None:
        """Require after a long gap that to continue is no jump."""

    @abstractmethod
    def check_after_pause(self) -> None:
        """Require after a late packet that the arm moves as commanded."""

    @abstractmethod
    def leaving(self) -> None:
        """Rest, while the controller closes open mode."""


class PositionMode(OpenMode):
    """Modes 1, 4 and 5: the PC generates the targets."""

    def __init__(
        self, guard: Guard, wire: ArmWire, frame: ReplyFrame, mode: int, max_gap: int
    ) -> None:
        super().__init__(guard, wire, frame, mode)
        self._history = SentSetPoints(guard, max_gap + 1)
        self._sent = self._still
        self._step = self._still
        self._velocity = self._still
        self._slots = wire.joint_slots[wire.opened]
        self._last_reply = frame.floats[self._slots]
        self._continuing = wire.opened.copy()
        self._feed_forward = (
            CorrectionGuard(guard, "velocity") if mode == Mode.POSITION_FEED_FORWARD else None
        )

    def enter(self) -> None:
        """Send the target received as the first set-point, at rest."""
        super().require_start()
        target, position = self._raw[TARGET].copy(), self._measured[0].copy()
        self._guard.begin(position, self._cycle)
        self._check_feedback(target)
        if self._feed_forward is not None:
            self._feed_forward.begin()
        self.set_point = position
        self._sent = target
        self._history.begin(target)
        self.lost = 0
        self._continuing[...] = self._wire.opened
        self._rest()

    def require_start(self) -> None:
        """Require the arm at rest at the set-point sent last, too."""
        super().require_start()
        self._check_start(self._sent)

    def next(self, execution: Execution | None) -> None:
        """Send the motion's next set-point, or the last one without a motion."""
        cycle, commanded = self._cycle, self._commanded
        self._check_feedback(self._sent)
        self._check_accepted(stopping=execution is not None and execution.outcome == "stopped")
        if execution is None:
            self._guard.check_set_point(self.set_point, self._still, "plan", cycle)
            self._rest()
            return
        frame = self._frame.floats
        if self._history.again:
            # The controller holds the target before the last one: send that once more.
            frame[self._slots] = self._last_reply
            self._history.repeat()
            commanded[0] = self.set_point
            commanded[1] = self._velocity
            return
        position, velocity, bounds = execution.advance(cycle)
        self._guard.check_set_point(position, velocity, bounds, cycle)
        motor = self._wire.motor(position)
        self._require_closed_still(motor)
        self._step = step = motor - self._sent
        self._velocity = (position - self.set_point) / self._guard.period
        commanded[0], commanded[1] = position, self._velocity
        self._wire.write(frame, motor, step)
        if self._feed_forward is not None:
            self._write_feed_forward(self._feed_forward, execution, step)
        self.set_point = position
        self._sent = motor
        self._history.add(motor)
        self._last_reply = frame[self._slots]

    def _require_closed_still(self, motor: Array) -> None:
        """Require closed axes to stay where the controller holds them, wrist couplings included."""
        opened = self._wire.opened
        if opened.all():
            return
        off = np.abs(motor - self._raw[TARGET]) > self._guard.limits.standstill
        if (off & ~opened).any():
            joint, wanted = int(np.argmax(off & ~opened)) + 1, int(self._mode)
            message = f"joint {joint} is in mode {int(Mode.CLOSED)}; the motion needs {wanted}"
            raise AxisNotInMode(message, self._cycle)

    def _check_accepted(self, where: Joints | None = None, *, stopping: bool = False) -> None:
        """Check the target received against the set-points sent, and count lost replies."""
        target, age = self._raw[TARGET], self._wire.age
        self.lost = self._history.check(target, self._missed, self._cycle, where, stopping=stopping)
        if age is not None and age[TARGET].any():
            # An old target does not show whether the last reply was accepted.
            self.lost, self._history.again = 0, False

    def _write_feed_forward(
        self, guard: CorrectionGuard, execution: Execution, step: Array
    ) -> None:
        frame, wire = self._frame.floats, self._wire
        if not execution.feeds_forward:
            wire.put(frame, D4, step)
            return
        velocity, current = execution.feed_forward(self._cycle)
        guard.check_motion(velocity, execution.widest, self._cycle)
        guard.check_current(current, None, self._cycle)
        if execution.finished:
            guard.require_zero(Check.CORRECTION_END, self._cycle)
        wire.put(frame, D4, wire.motor_difference(velocity) * self._guard.period)
        wire.put(frame, D5, current)

    def check_after_gap(self, execution: Execution | None) -> None:
        """Compare target and velocity with the set-point sent last, after a long gap.

        A motion continues from the target, some steps further on its path, or at rest. Axes that
        have closed since the first set-point are left out.
        """
        cycle, where = self._cycle, self._continuing & self._reading.ready
        self._require_fresh(_NEEDED_AFTER_GAP, Check.GAP_AGE, where)
        raw, step = self._raw, self._step
        target, velocity = np.where(where, raw[TARGET], self._sent), np.where(where, raw[1:4:2], 0)
        if not (execution is not None and execution.is_resumable and step.any()):
            self._guard.check_after_gap(target, velocity, self._sent, step, cycle, where)
            return
        # A target that is reported late is further on by now.
        target = target + self._history.lag * velocity[0]
        ahead = self._sent + np.arange(self._missed + 1)[:, None] * step
        steps = int(np.abs(target - ahead).max(axis=1).argmin())
        moved, moves = np.abs((step, velocity[0])).max(axis=1) > self._guard.limits.standstill
        # For a motion slower than standstill, the target shows whether the controller held it.
        step = self._still if not moves and (moved or steps == 0) else step
        self._guard.check_after_gap(target, velocity, ahead[steps], step, cycle, where)
        step = velocity[0] if moves else step
        position = self.set_point + self._wire.joint_difference(target - self._sent)
        speed = self._wire.joint_difference(step) / self._guard.period
        spread = min(SPREAD * steps, round(RETURN / self._guard.period))
        execution.resume_from(position, speed, spread, cycle)
        self._guard.resume_from(position, speed, spread)
        self._history.resume_from(target, step)
        self.set_point, self._sent = position, target

    def check_after_pause(self) -> None:
        """Require after a late packet that the arm moves as the set-points sent last."""
        where = self._continuing & self._reading.ready
        self._require_fresh((ACTUAL_VELOCITY,), Check.GAP_AGE, where)
        velocity = self._wire.joint_difference(self._raw[ACTUAL_VELOCITY])
        self._guard.check_after_pause(velocity / self._guard.period, self._cycle, where)

    def leaving(self) -> None:
        """Hold axes that were always open at the last set-point, reopened ones at their target."""
        ready, continuing, returned = self._reading.ready, self._continuing, self._reading.returned
        continuing &= ready
        self.require_holdable(returned & ~continuing, returned | ready)
        self._record_returned(returned)
        self._check_feedback(self._sent, continuing)
        self._check_accepted(continuing)
        if np.array_equal(continuing, self._wire.opened):
            # A source that ends while moving would cause a jump to rest.
            self._guard.check_set_point(self.set_point, self._still, "plan", self._cycle)
        self._history.add(self._sent)
        self._step = self._still
        slots = self._wire.joint_slots[continuing]
        self._frame.floats[slots, D1] = self._sent[continuing]
        self._frame.floats[slots, D2] = 0.0
        self._commanded[0, continuing] = self.set_point[continuing]

    def _rest(self) -> None:
        self._step = self._still
        self._history.add(self._sent)
        self._wire.write(self._frame.floats, self._sent, self._still)
        self._commanded[0] = self.set_point
        self._commanded[1] = 0.0


class CorrectionMode(OpenMode):
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

    def __init__(self, guard: Guard, wire: ArmWire, frame: ReplyFrame, mode: int) -> None:
        super().__init__(guard, wire, frame, mode)
        self._offset = mode == Mode.DELTA_POSITION
        self._velocity = D4 in MODE_FIELDS[mode]
        self._current = D5 in MODE_FIELDS[mode]
        self._added_to_servo = mode == Mode.DELTA_CURRENT
        self._corrections = CorrectionGuard(guard, "offset" if self._offset else "velocity")

    def enter(self) -> None:
        """Send zero; require the arm at rest at the controller's target."""
        self.require_start()
        self._corrections.begin()
        self._send_zero()

    def _send_zero(self) -> None:
        self._check_feedback(self._raw[TARGET])
        self.set_point = self._measured[0].copy()
        self._guard.check_position(self.set_point, self._cycle)
        self._corrections.set_target(self.set_point, self._still, self._sent_in())
        self._record(self._still)

    def next(self, execution: Execution | None) -> None:
        """Send the next correction, or zero without a motion."""
        if execution is None:
            self._send_zero()
            return
        cycle, guard, target = self._cycle, self._corrections, self._raw[TARGET]
        self._check_feedback(target)
        self.set_point = self._measured[0].copy()
        motion, current, bounds = execution.advance(cycle)
        self._require_fields(motion, current)
        guard.check_motion(motion, bounds, cycle)
        if bounds == "stop" and guard.resting:
            execution.mark_at_rest()
        corrected = self.set_point + motion if self._offset else self.set_point
        self._guard.check_position(corrected, cycle)
        if self._offset:
            rounding = self._wire.joint_rounding(target)
            guard.check_target(self.set_point, motion, self._sent_in(), rounding, cycle)
        servo = self._raw[CURRENT] if self._added_to_servo else None
        guard.check_current(current, servo, cycle)
        if execution.finished:
            guard.require_zero(Check.CORRECTION_END, cycle)
        self._write(motion, current)
        self._record(motion)

    def check_after_gap(self, execution: Execution | None) -> None:  # noqa: ARG002
        """Require the last correction to be zero: it is unknown whether it was applied."""
        self._corrections.require_zero(Check.GAP_CORRECTION, self._cycle)

    def check_after_pause(self) -> None:
        """Check nothing: the controller generates the motion."""

    def leaving(self) -> None:
        """Send zeros, by the safe reply; the target to an axis in a position mode."""
        returned = self._reading.returned
        if returned.any():
            self.require_holdable(returned, returned)
            self._record_returned(returned)
        self._check_feedback(self._raw[TARGET], self._reading.ready)

    def _sent_in(self) -> Array:
        """Return the cycle in which each target received was sent."""
        age = self._wire.age
        return self._still + self._cycle if age is None else self._cycle - age[TARGET] * 1.0

    def _require_fields(self, motion: Array, current: Array) -> None:
        """Refuse a correction that this mode has no field for."""
        for name, values, has_field in (
            ("motion", motion, self._offset or self._velocity),
            ("current", current, self._current),
        ):
            if not has_field and np.any(values):
                message = f"mode {self._mode} has no field for a {name}: {values}"
                raise SourceFailed(message, self._cycle)

    def _write(self, motion: Array, current: Array) -> None:
        frame, wire = self._frame.floats, self._wire
        if self._offset:
            wire.put(frame, D1, wire.motor_difference(motion))
        elif self._velocity:
            wire.put(frame, D4, wire.motor_difference(motion) * self._guard.period)
        if self._current:
            wire.put(frame, D5, current)

    def _record(self, motion: Array) -> None:
        if self._offset:
            np.add(self._measured[0], motion, out=self._commanded[0])
        elif self._velocity:
            self._commanded[1] = motion
