"""One interval in open mode: set-points are computed, checked and written into the reply.

The first set-point is the target received in the packet in which the last wanted axis opened, at
zero velocity, compared with actual position and standstill. D2 is the step of the motor from one
sent set-point to the next, computed in float64; `drivers.c4g_packets.MODE_FIELDS` gives the fields
of each open mode. A motion requested while the axes are open begins under the same conditions, from
the set-point held. Without a requested motion the first set-point is held.

While axes are open, following error and current are checked, and that the target received (D1) is
within 10 % of the following-error threshold of one of the last `max_gap` + 1 set-points sent, or of
the last one extrapolated by as many steps as packets were missed, and within 25 % of the last. An
older target is a rejected reply: the last set-point is sent again until it is accepted, and more
than `max_gap` rejected replies in 100 cycles stop the motion on its path, from the set-point sent
last and no faster than the joint that slowed down least meanwhile (D4).

Without replies a controller may hold the last target, extrapolate it, or leave open mode, move the
arm and come back; the next set-point at full speed would then be a jump. Hence, after a gap longer
than `max_gap`, open mode continues only if D1 is within 10 % of the threshold of the set-point sent
last, or of some steps more, and its velocity (D2) is zero or within half the velocity sent last or
the standstill threshold; for an arm at rest the same is required of its own velocity (D4). The
motion comes to rest on its path from D1 and D2, which count as sent. Where packets arrive late
although none is missing, D4 is compared with the velocity sent last. A value needed for these
decisions, for the first set-point, or to be returned to an open axis is refused if it was not sent
in this packet.

The end is held for `settle_cycles`; the next reply asks for the end of open mode (status byte 1),
and again every `EXIT_RETRY_CYCLES`; after `EXIT_TIMEOUT` that is a fault. The end is requested as
well where a motion waits that long for the last axis to open.

Nothing here changes the session: `SetPointGenerator.reply` returns `Reply`, `Exit` or `Refuse`,
which the session applies.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from drivers.arrays import Array
from drivers.drive_train import MotorSide
from drivers.errors import (
    AxisNotInMode,
    Check,
    ExitTimeout,
    RefusalError,
    as_refusal,
)
from drivers.execution import Execution
from drivers.guard import FIRST_SET_POINT_FRACTION, Guard, Joints, all_true, require
from drivers.packet_losses import LossTracker
from drivers.states import AxesReport, State
from drivers.wire import Wire

MAX_TARGET_JUMP: Final = 0.25
"""Share of the following-error threshold allowed between target and set-point sent last."""
SLOW_STEP_FACTOR: Final = 4.0
"""Multiple of the standstill threshold, some 2 % of full speed. Several such steps in one cycle are
permissible."""
MAX_RESENDS: Final = 100
"""Times that a set-point is sent again, at most, to a controller that does not accept it."""
EXIT_RETRY_CYCLES: Final = 100
"""Cycles after which the end of open mode is requested again."""
EXIT_TIMEOUT: Final = 10.0
"""Time for a controller to open the last axis, and to leave open mode once asked, s."""


@dataclass(frozen=True)
class Reply:
    """A reply was filled in.

    Attributes:
        rejected: replies that the controller, according to this packet, did not use.
        begun: the requested motion began with this reply.
    """

    rejected: int = 0
    begun: bool = False


@dataclass(frozen=True)
class Exit(Reply):
    """A reply was filled in that is to ask for the end of open mode.

    Attributes:
        reason: why the motion requested cannot run, or None.
    """

    reason: str | None = None


@dataclass(frozen=True)
class Refuse:
    """No set-point may be sent.

    Attributes:
        error: why.
        rejected: replies that the controller, according to this packet, did not use.
    """

    error: RefusalError
    rejected: int = 0


OpenReply = Reply | Exit | Refuse
_REPLY: Final = Reply()


class OpenCycle(NamedTuple):
    """One cycle in open mode: what the packet says and what the session knows.

    Attributes:
        state: to which the packet leads: opening, open or exiting.
        cycle: of the controller.
        entered_at: cycle in which that state was entered.
        exit_requested_at: cycle in which the end of open mode was requested last, or in which its
            end began.
        packet: what it says of the axes.
        measured: (8, n) values of the packet in SI, joint side.
        commanded: (2, n) record of the reply, NaN, to be filled where set-points are sent.
        losses: before this packet.
        motion: the requested one, or None.
        entering: the first set-point is still to be sent.
        in_interval: an interval in open mode continues.
        stop_reason: why open mode is to be left, or None.
    """

    state: State
    cycle: int
    entered_at: int
    exit_requested_at: int
    packet: AxesReport
    measured: Array
    commanded: Array
    losses: LossTracker
    motion: Execution | None
    entering: bool
    in_interval: bool
    stop_reason: str | None


class SentSetPoints:
    """The set-points sent last, compared with the controller's target, motor revolutions.

    While replies are lost the controller holds its target, so the last set-point is sent again
    until the target shows that it was accepted; the motion waits, as it does for packets. After
    missed packets a controller that extrapolates reports a target ahead of those sent.

    A controller that reports its target a cycle late cannot be distinguished from a lost reply in
    its first cycle. It is recognised in the first steps of a motion, which are small
    (`SLOW_STEP_FACTOR`): there nothing is sent again, and the lag of the target is not a loss from
    then on. A link that becomes late at speed is a loss in every second cycle, which soon stops the
    motion; while stopping it counts as late.

    To a controller that continues by itself and uses the newest set-point, without `resends`,
    nothing is sent again; it states itself what it did not use.

    Attributes:
        resend_needed: the controller did not accept the last one: it is to be sent once more.
        target_latency: cycles by which the controller reports its target late.
    """

    def __init__(self, guard: Guard, depth: int, *, resends: bool = True) -> None:
        n = guard.limits.n_joints
        self._resends = resends
        self._guard = guard
        self._depth = depth
        # One more than allowed, so that one too many can be counted.
        self._sent = np.zeros((depth + 1, n))
        self._back = np.arange(depth + 1)
        self._ahead = np.arange(1.0, depth)[:, None]
        self._newest = 0
        self.target_latency = 0
        self._resent = 0
        self._resent_before = False
        self.resend_needed = False
        self._every = np.ones(n, dtype=np.bool_)

    def begin(self, target: Array) -> None:
        """Record that the first set-point (n,), the target received, was sent."""
        self._sent[...] = target
        self.target_latency = self._resent = 0
        self._resent_before = self.resend_needed = False

    def resume_from(self, target: Array, step: Array) -> None:
        """Record that the controller extrapolated to this target (n,) by this step (n,)."""
        self._sent[(self._newest - self._back) % len(self._sent)] = (
            target - self._back[:, None] * step
        )
        self._resent = 0
        self._resent_before = False
        self.resend_needed = False

    @property
    def is_resent(self) -> bool:
        """Whether the last set-point was sent again, or is to be."""
        return self._resent > 0 or self.resend_needed

    def resend(self) -> None:
        """Record that the last set-point was sent once more."""
        self._resent += 1

    def add(self, target: Array) -> None:
        """Record that the next set-point (n,) was sent."""
        self._resent_before = self._resent > 0
        self._resent = 0
        self._newest = newest = (self._newest + 1) % len(self._sent)
        self._sent[newest] = target

    def check(
        self,
        target: Array,
        missed: int,
        cycle: int,
        where: Joints | None = None,
        *,
        stopping: bool,
    ) -> int:
        """Require each joint's target to be one of the last set-points, or the last extrapolated.

        Args:
            target: (n,) D1 received, motor revolutions.
            missed: packets without a reply before this one, and so the most steps to extrapolate.
            cycle: for the error.
            where: (n,) which joints; None for all.
            stopping: the motion is being brought to rest.

        Returns:
            Number of replies rejected, beyond those of the cycle before; those of joints slower
            than standstill do not show.

        Raises:
            GuardError: a target further than `FIRST_SET_POINT_FRACTION` of the following-error
                threshold from all of them, or than `MAX_TARGET_JUMP` from the last, or not the last
                one after `MAX_RESENDS` of it.
        """
        sent = self._sent
        standstill = self._guard.limits.standstill
        newest = sent[self._newest]
        self.resend_needed = False
        # Usual case: the set-point sent last.
        if all_true(np.abs(target - newest) <= standstill):
            # At standstill a target reported late is equal to it as well.
            was_late = self.target_latency and not self._resent
            if was_late and np.abs(newest - sent[self._newest - 1]).max() > standstill:
                self.target_latency = 0
            return 0
        rows = sent[(self._newest - self._back) % len(sent)]
        extrapolated = newest + self._ahead[:missed] * (newest - rows[1])
        late = np.abs(rows - target)
        ahead = np.abs(extrapolated - target)
        where = self._every if where is None else where
        nearest = np.minimum(late[: self._depth].min(axis=0), ahead.min(axis=0, initial=np.inf))
        threshold = self._guard.following_error
        require(where, nearest, FIRST_SET_POINT_FRACTION * threshold, Check.ACCEPTED, cycle)
        require(where, late[0], MAX_TARGET_JUMP * threshold, Check.ACCEPTED, cycle)
        behind = where & (late[0] > standstill)
        behind &= late.min(axis=0) <= ahead.min(axis=0, initial=np.inf)
        lag = int(late.argmin(axis=0)[behind].max(initial=0))
        more = max(0, lag - self.target_latency)
        known_late = stopping and self._resent_before
        slow = np.abs(newest - rows[1]).max() <= SLOW_STEP_FACTOR * standstill
        if not more or known_late or slow or not self._resends:
            self.target_latency = lag
            return 0 if known_late else more
        self.resend_needed = True
        if self._resent >= MAX_RESENDS:
            require(where, late[0], np.full_like(newest, standstill), Check.ACCEPTED, cycle)
        return 1 if self._resent else more


# Rows of `MotorSide.raw`.
TARGET, TARGET_VELOCITY, ACTUAL, ACTUAL_VELOCITY, CURRENT = range(5)
RETURN_CYCLES_PER_STEP: Final = 2
"""Cycles, per step that a controller extrapolated, in which the motion returns to its path.
Where the motion accelerates, each step leaves the velocity of one cycle of that acceleration across
the path; spread over two cycles this is half of that acceleration, within the bounds of a stop."""
MAX_RETURN_SECONDS: Final = 0.03
"""Longest duration of that return, during which jerk has no bound, s. A path that was left for more
than half of it has so little curvature, less than 10 rad/s² within 1e-3 rad, that no longer return
is needed; and the motion does not stay beside its path for as long as a gap may last."""


class SetPointGenerator:
    """Writes set-points into a reply, which holds the safe one, and into the cycle's record.

    In the modes served, 4 and 5, the PC generates the targets.

    Methods that check or send something raise `GuardError` or `SourceFailed`; `reply` raises
    nothing.

    Args:
        guard: checks each set-point.
        wire: packets of the controller.
        motors: joint and motor side.
        max_gap: missed packets in a row that a motion tolerates.

    Attributes:
        set_point: (n,) rad, the one sent last.
        rejected: replies that were not used according to the last packet.
    """

    def __init__(self, guard: Guard, wire: Wire, motors: MotorSide, max_gap: int) -> None:
        n = guard.limits.n_joints
        self._guard = guard
        self._wire = wire
        self._motors = motors
        self._raw = motors.raw
        self._still = np.zeros(n)
        self._every = np.ones(n, dtype=np.bool_)
        self._exit_cycles = round(EXIT_TIMEOUT / guard.period)
        self.set_point = self._still
        self.rejected = 0
        self._history = SentSetPoints(guard, max_gap + 1, resends=not wire.reports_use)
        self._sent = self._still
        self._step = self._still
        self._velocity = self._still
        # Least share of that velocity that the arm had since the set-point was sent again.
        self._arm_share = 1.0
        self._continuing = wire.opened.copy()
        self._all_opened = bool(wire.opened.all())

    def reply(self, now: OpenCycle) -> OpenReply:
        """Fill in the reply to the packet of a cycle in open mode."""
        try:
            self._now = now
            self._packet = now.packet
            self._cycle = now.cycle
            self._measured = now.measured
            self._commanded = now.commanded
            self._check_losses(now)
            self._wire.require_other_targets(now.cycle)
            if now.state is State.OPEN:
                return self._reply_open(now)
            if now.state is State.EXITING and now.in_interval:
                self.leaving()
            else:
                # Left before the last axis opened, axes have been sent only their own targets.
                self.opening()
            self._wire.require_targets(now.cycle)
            return self._leave(now) if now.state is State.EXITING else self._wait(now)
        except BaseException as error:
            return Refuse(as_refusal(error, now.cycle))

    def _check_losses(self, now: OpenCycle) -> None:
        """Require that a gap or a pause before this packet allows to continue."""
        if not now.in_interval or now.state is State.OPENING or now.entering:
            return
        if now.losses.gap > now.losses.max_gap:
            self.check_after_gap(now.motion)
        elif now.losses.is_late:
            self.check_after_pause()

    def _reply_open(self, now: OpenCycle) -> OpenReply:
        """Fill in the next set-point; it is the last one where the motion has settled."""
        motion = now.motion
        rejected = 0
        moving = motion is not None and motion.started
        if now.entering:
            self.enter()
        else:
            if motion is not None and moving and now.stop_reason is not None:
                motion.stop(now.stop_reason, now.cycle)
            elif motion is not None and not moving:
                self.require_start()
            self.next(motion if moving else None)
            rejected = self.rejected
        if motion is None:
            return self._outcome(now.stop_reason is not None, rejected)
        if not moving:
            motion.begin(self.set_point, now.cycle)
        return self._outcome(motion.settled, rejected, not moving)

    @staticmethod
    def _outcome(is_last: bool, rejected: int, begun: bool = False) -> OpenReply:
        if is_last:
            return Exit(rejected, begun)
        return Reply(rejected, begun) if rejected or begun else _REPLY

    def _leave(self, now: OpenCycle) -> OpenReply:
        """Ask for the end of open mode once more, if that is due."""
        leaving = now.cycle - now.entered_at
        if leaving >= self._exit_cycles:
            message = f"open mode was asked to end {leaving} cycles ago and axes are still open"
            return Refuse(ExitTimeout(message, now.cycle), self.rejected)
        due = now.cycle - now.exit_requested_at >= EXIT_RETRY_CYCLES
        return self._outcome(due, self.rejected)

    def _wait(self, now: OpenCycle) -> OpenReply:
        """Leave open mode where the last axis has not opened in time, or the motion was dropped."""
        if now.motion is None:
            return self._outcome(now.stop_reason is not None, 0)
        if now.cycle - now.entered_at < self._exit_cycles:
            return _REPLY
        axes = np.flatnonzero(now.packet.held_joints) + 1
        hint = f": if axis {axes[0]} alone is to open, use --only-axis" if len(axes) == 1 else ""
        return Exit(reason=f"some axes did not open within {EXIT_TIMEOUT:g} s{hint}")

    def hold_in_pause(self, packet: AxesReport, cycle: int) -> None:
        """Require, in a pause, that open axes can hold their targets; raises `GuardError`."""
        self._cycle = cycle
        self.require_holdable(packet.held_joints)

    def opening(self) -> None:
        """Hold the axes that are open already, by the safe reply."""
        self.rejected = 0  # set-points of an earlier interval do not matter
        held = self._packet.held_joints
        self.require_holdable(held | self._packet.ready)
        self._record_held(held)

    def _record_held(self, held: Joints) -> None:
        """Record the targets of `held` joints as commanded, at rest."""
        self._commanded[0] = np.where(held, self._measured[0], np.nan)
        self._commanded[1] = np.where(held, 0.0, np.nan)

    def require_holdable(self, where: Joints) -> None:
        """Require all of `where` (n,) near their targets."""
        self._guard.check_hold(self._raw[TARGET], self._raw[ACTUAL], where, self._cycle)

    def _require_at_rest(self) -> None:
        """Require the conditions of the first set-point."""
        self._check_start(self._raw[TARGET])

    def _check_start(self, target: Array) -> None:
        raw = self._raw
        self._guard.check_start(target, raw[ACTUAL], raw[1:4:2], self._cycle)

    def _check_feedback(self, sent: Array, where: Joints | None = None) -> None:
        raw = self._raw
        self._guard.check_feedback(raw[TARGET], raw[ACTUAL], raw[CURRENT], sent, self._cycle, where)

    def enter(self) -> None:
        """Send the target received as the first set-point, at rest."""
        self._require_at_rest()
        target = self._raw[TARGET].copy()
        position = self._measured[0].copy()
        self._guard.begin(position, self._cycle)
        self._check_feedback(target)
        self.set_point = position
        self._sent = target
        self._history.begin(target)
        self.rejected = 0
        self._continuing[...] = self._wire.opened
        self._rest()

    def require_start(self) -> None:
        """Require the arm at rest at the set-point sent last, too."""
        self._require_at_rest()
        self._check_start(self._sent)

    def next(self, execution: Execution | None) -> None:
        """Send the motion's next set-point, or the last one without a motion."""
        cycle = self._cycle
        commanded = self._commanded
        stopping = execution is not None and execution.outcome == "stopped"
        self._check_feedback(self._sent)
        self._check_accepted(stopping=stopping)
        if execution is None:
            self._guard.check_set_point(self.set_point, self._still, "plan", cycle)
            self._rest()
            return
        if self._history.is_resent:
            self._arm_share = min(self._arm_share, self._share_of_arm())
        if self._history.resend_needed:
            # The controller holds the target before the last one: send that once more.
            self._wire.write(self._sent, self._step)
            self._history.resend()
            commanded[0] = self.set_point
            commanded[1] = self._velocity
            return
        if stopping and self._arm_share < 1.0 and execution.is_resumable:
            self._slow_down(execution)
        position, velocity, bounds = execution.advance(cycle)
        self._guard.check_set_point(position, velocity, bounds, cycle)
        motor = self._motors.motor(position)
        self._require_closed_still(motor)
        self._step = step = motor - self._sent
        self._velocity = (position - self.set_point) / self._guard.period
        commanded[0], commanded[1] = position, self._velocity
        self._wire.write(motor, step)
        self.set_point = position
        self._sent = motor
        self._history.add(motor)
        self._arm_share = 1.0

    def _share_of_arm(self) -> float:
        """Share of the speed sent last at which the joint that slowed down least moves (D4).

        Inf where no joint moves faster than `SLOW_STEP_FACTOR`, NaN where a velocity was not sent.
        """
        step = self._step
        fast = np.abs(step) > SLOW_STEP_FACTOR * self._guard.limits.standstill
        if not fast.any():
            return np.inf
        return max(float((self._raw[ACTUAL_VELOCITY][fast] / step[fast]).max()), 0.0)

    def _slow_down(self, execution: Execution) -> None:
        """Continue a stop from the set-point sent last, no faster than the arm has moved meanwhile.

        While replies were lost the controller held its target, and each joint slowed down as fast
        as its current and its servo allow. The stop begins with the speed of the joint that slowed
        down least: that joint does not speed up again, the others do as far as the path requires.
        With the mean of all joints, which is less, one that cannot brake as fast would leave its
        target behind by more than the following-error threshold (axis 2 of an NS 16 after five
        replies at full speed). The least share of all packets since counts, as the arm is pushed by
        the step to the set-point that was accepted late. The stop does not begin at the older
        target that was held: the set-points would go back along the path.
        """
        velocity = self._arm_share * self._velocity
        execution.resume_from(self.set_point, velocity, 0, self._cycle)
        self._guard.resume_from(self.set_point, velocity, 0)

    def _require_closed_still(self, motor: Array) -> None:
        """Require closed axes to stay where the controller holds them, wrist couplings included."""
        if self._all_opened:
            return
        opened = self._wire.opened
        off = np.abs(motor - self._raw[TARGET]) > self._guard.limits.standstill
        if (off & ~opened).any():
            joint = int(np.argmax(off & ~opened))
            raise AxisNotInMode(self._packet.misplacement(joint), self._cycle)

    def _check_accepted(self, where: Joints | None = None, *, stopping: bool) -> None:
        """Check the target received against the set-points sent, and count lost replies."""
        self.rejected = self._history.check(
            self._raw[TARGET], self._now.losses.gap, self._cycle, where, stopping=stopping
        )
        if self._wire.reports_use:
            self.rejected = self._wire.not_used()

    def check_after_gap(self, execution: Execution | None) -> None:
        """Compare target and velocity with the set-point sent last, after a long gap.

        A motion continues from the target, some steps further on its path, or at rest. Axes that
        have closed since the first set-point are left out.
        """
        cycle = self._cycle
        where = self._continuing & self._packet.ready
        raw = self._raw
        step = self._step
        target = np.where(where, raw[TARGET], self._sent)
        velocity = np.where(where, raw[1:4:2], 0)
        if not (execution is not None and execution.is_resumable and step.any()):
            self._guard.check_after_gap(target, velocity, self._sent, step, cycle, where)
            return
        # A target that is reported late is further on by now.
        target = target + self._history.target_latency * velocity[0]
        ahead = self._sent + np.arange(self._now.losses.gap + 1)[:, None] * step
        steps = int(np.abs(target - ahead).max(axis=1).argmin())
        moved, moves = np.abs((step, velocity[0])).max(axis=1) > self._guard.limits.standstill
        # For a motion slower than standstill, the target shows whether the controller held it.
        step = self._still if not moves and (moved or steps == 0) else step
        self._guard.check_after_gap(target, velocity, ahead[steps], step, cycle, where)
        step = velocity[0] if moves else step
        position = self.set_point + self._motors.joint_difference(target - self._sent)
        speed = self._motors.joint_difference(step) / self._guard.period
        spread = min(RETURN_CYCLES_PER_STEP * steps, round(MAX_RETURN_SECONDS / self._guard.period))
        execution.resume_from(position, speed, spread, cycle)
        self._guard.resume_from(position, speed, spread)
        self._history.resume_from(target, step)
        self.set_point = position
        self._sent = target

    def check_after_pause(self) -> None:
        """Require after a late packet that the arm moves as the set-points sent last."""
        where = self._continuing & self._packet.ready
        velocity = self._motors.joint_difference(self._raw[ACTUAL_VELOCITY])
        self._guard.check_after_pause(velocity / self._guard.period, self._cycle, where)

    def leaving(self) -> None:
        """Hold axes that were always open at the last set-point, reopened ones at their target."""
        ready = self._packet.ready
        continuing = self._continuing
        held = self._packet.held_joints
        continuing &= ready
        self.require_holdable(held | ready)
        self._record_held(held)
        self._check_feedback(self._sent, continuing)
        self._check_accepted(continuing, stopping=False)
        if np.array_equal(continuing, self._wire.opened):
            # A source that ends while moving would cause a jump to rest.
            self._guard.check_set_point(self.set_point, self._still, "plan", self._cycle)
        self._history.add(self._sent)
        self._step = self._still
        self._wire.write_rest(self._sent, continuing)
        self._commanded[0, continuing] = self.set_point[continuing]

    def _rest(self) -> None:
        self._step = self._still
        self._history.add(self._sent)
        self._wire.write(self._sent, self._still)
        self._commanded[0] = self.set_point
        self._commanded[1] = 0.0
