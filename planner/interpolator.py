"""The interpolator as a controller offers it: targets in, one set-point per step out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy
from numpy.typing import ArrayLike

from planner.arguments import member, real, reals, whole
from planner.arrays import Array, read_only
from planner.commands import Fly, Move
from planner.corners import Corner
from planner.errors import InvalidSetting, PlannerError
from planner.isolation import in_child, in_child_now
from planner.legs import Leg, corner
from planner.limits import JointLimits
from planner.motion_queue import CornerPlanner, MotionQueue
from planner.move_services import MoveServices, MoveSettings
from planner.rrs import Event, EventKind, OutputFormat, SpeedCorrection, Status, Step
from planner.time_law import RateBounds, TimeLaw, admits, slowing_bounds, within

# A motion time [s], and a share of a period, shorter than this is rounding.
_MOTION_TIME_ROUNDING = 1e-9
_LAST_PERIOD = 1e-9


class Interpolator(MoveServices):
    """Plan and interpolate joint moves while they run, by the services of RRS-1.

    Targets are planned as they are set, never in a step: `set_next_target` may be called before
    and during the motion. A target set before the arm comes to where the corner before it would
    begin is flown to if fly-by is on; one set later finds the arm stopping at the point before.
    Where nothing else is set, the motion ends at rest at the last target. Targets set at once
    give the motion that `planner.plan_moves` gives. The same calls give the same steps, bit by
    bit.

    Every service returns a `Status` (but `get_next_step`, which returns a `Step`, and
    `get_current_target_id`); `refusal` says in words why one was refused, and a refused service
    changed nothing. The order of calls is

        initialize, set_initial_position, {set_next_target | get_next_step}..., terminate

    with settings anywhere after `initialize`; they hold for targets set from then on, except
    GEN_OVR (`set_override_speed`), which acts at once and leaves the path as it is.

    Args:
        limits: Limits of the arm; planned motion keeps them.
        period: Time from step to step [s].
        override_bounds: Largest acceleration and jerk while GEN_OVR changes, as multiples (> 1)
            of the limits.
        stop_bounds: The same while the motion is stopped or continued; not below the others.
        isolated: Plan corners in a child process, whose crash is a FATAL status here and no more;
            False saves half a millisecond per corner.

    Raises:
        InvalidSetting: a period or a bound outside its range.
    """

    def __init__(
        self,
        limits: JointLimits,
        period: float,
        *,
        override_bounds: tuple[float, float] = (1.3, 1.7),
        stop_bounds: tuple[float, float] = (2.0, 3.0),
        isolated: bool = True,
    ) -> None:
        super().__init__(limits)
        if not 0.0 < period < np.inf:
            raise InvalidSetting("period", period, "a time above 0 s")
        if not (min(override_bounds) > 1.0 and np.all(np.less_equal(override_bounds, stop_bounds))):
            raise InvalidSetting("override_bounds", override_bounds, f"in (1, {stop_bounds}]")
        self._law = TimeLaw(period)
        self._elapsed = 0.0
        self._isolated = isolated
        self._corner: CornerPlanner = _isolated_corner if isolated else corner
        self._period = self._first_period = period
        self._stopping: RateBounds = slowing_bounds(limits, *stop_bounds)
        self._overriding = within(slowing_bounds(limits, *override_bounds), self._stopping)
        # A joint closer than rounding to an end of its range stands on it.
        rounding = 1e-12 * np.maximum(np.abs(limits.lower), np.abs(limits.upper))
        self._inside = (limits.lower + rounding, limits.upper - rounding)
        self._forget()

    # -- session ---------------------------------------------------------------------------

    def initialize(self) -> Status:
        """Begin, or begin anew: every setting at its default, no position, no target.

        Refused while the arm moves, as `reset` and `terminate` are: the set-points would end in
        mid-motion. `stop_motion` or `cancel_motion` bring it to rest first. FATAL if the process
        that plans corners does not start.
        """
        if self._moving:
            return self._refuse(Status.INCONSISTENT, "the arm moves")
        if self._isolated:
            try:
                in_child(float)  # to start it takes a third of a second, which no motion has
            except PlannerError as error:
                return self._refuse(Status.FATAL, str(error))
        self._forget()
        self._initialized = True
        return Status.OK

    def reset(self) -> Status:
        """Set everything back as `initialize` does; refused while the arm moves."""
        if self._moving:
            return self._refuse(Status.INCONSISTENT, "the arm moves")
        return self.initialize() if self._initialized else self._set()

    def terminate(self) -> Status:
        """End; only `initialize` is answered from then on. Refused while the arm moves."""
        if self._moving:
            return self._refuse(Status.INCONSISTENT, "the arm moves")
        status = self._set()
        if status >= 0:
            self._forget()
        return status

    def set_initial_position(self, position: ArrayLike) -> Status:
        """Tell where the arm is at rest (n,) [rad]; refused while targets are queued."""
        status = self._set()
        if status < 0:
            return status
        if self._queue is not None and self._queue.ahead:
            return self._refuse(Status.INCONSISTENT, "targets are queued; cancel the motion first")
        point = self._position_of(position)
        if point is None:
            return Status.INCONSISTENT
        self._held = False
        self._rest_at(point)
        return Status.OK

    def set_interpolation_time(self, period: float) -> Status:
        """Set the time from step to step [s]; refused while the arm moves."""
        if self._moving:
            return self._refuse(Status.INCONSISTENT, "the arm moves")
        if not 0.0 < real(period) < np.inf:
            return self._refuse(Status.INCONSISTENT, f"interpolation time of {period} s")
        status = self._set()
        if status >= 0:
            self._period = real(period)
            rate, time = self._law.rate, self._law.motion_time
            self._law = TimeLaw(self._period)
            self._law.restart(time, rate)
        return status

    # -- targets ---------------------------------------------------------------------------

    def set_next_target(self, target_id: int, position: ArrayLike) -> Status:
        """Queue a target (n,) [rad], to be reached as the settings say now.

        Returns OK, or NEED_MORE_DATA while fewer targets are known than `set_advance_motion`
        asks for. Refusals: INCONSISTENT, TIME_TOO_SHORT (see `set_motion_time`), and FATAL where
        no motion was found; the motion to the targets before goes on and stops at the last.
        """
        if self._queue is None:
            return self._refuse(Status.INCONSISTENT, "no initial position is set")
        if self._cancelling:
            return self._refuse(Status.INCONSISTENT, "the cancelled motion still comes to rest")
        number, point = whole(target_id), self._position_of(position)
        if number is None:
            return self._refuse(Status.INCONSISTENT, f"target id {target_id!r} is no whole number")
        if point is None:
            return Status.INCONSISTENT
        settings = self._settings
        try:
            move = _timed(self._queue, settings, point)
            if move is None:
                return self._refuse(
                    Status.TIME_TOO_SHORT,
                    f"the move takes longer than its motion time of {settings.motion_time} s",
                )
            self._queue.append(number, move, settings.overrides, self._law.motion_time)
        except InvalidSetting as error:
            return self._refuse(Status.INCONSISTENT, str(error))
        except PlannerError as error:
            return self._refuse(Status.FATAL, str(error))
        self._settings = replace(settings, motion_time=0.0)
        return self._wanted()

    def get_current_target_id(self) -> int | None:
        """Return the identifier of the target that the arm moves to; None where there is none."""
        ahead = self._queue.ahead if self._queue is not None else None
        return ahead[0].target_id if ahead else None

    # -- motion ----------------------------------------------------------------------------

    def get_next_step(self, output_format: int = OutputFormat.JOINT) -> Step:
        """Return the next step of the motion.

        Its status is OK; NEED_MORE_DATA while fewer targets are known than asked for (without
        another the motion goes on and ends at the last one); FINAL_STEP with the end of the
        motion, and for as long as it is stopped; NO_TARGET where there is nothing to move to;
        OUTPUT_FORMAT for any format but joint positions.
        """
        queue, law = self._queue, self._law
        if member(OutputFormat, output_format) is not OutputFormat.JOINT:
            return self._no_step(Status.OUTPUT_FORMAT, "only joint positions are offered")
        if queue is None:
            return self._no_step(Status.INCONSISTENT, "no initial position is set")
        if not queue.ahead:
            return self._no_step(Status.NO_TARGET, Status.NO_TARGET.meaning)
        braking = self._held or self._cancelling
        if braking and law.settled:
            return self._stand(())
        before = law.motion_time
        law.advance()
        now, ahead = law.motion_time, queue.ahead
        if now >= queue.end - _LAST_PERIOD * self._period:
            return self._finish(queue, before, now)
        self._position = queue.position(now)
        self._position.setflags(write=False)
        self._elapsed += self._period
        events: tuple[Event, ...] = ()
        while ahead[0].time <= now:
            events += (Event(EventKind.VIA_POINT_PASSED, ahead.popleft().target_id),)
        if braking and law.settled:
            return self._stand(events)
        return self._step(self._wanted(), events)

    def set_override_speed(
        self, percent: float, correction: SpeedCorrection = SpeedCorrection.GENERAL
    ) -> Status:
        """Set GEN_OVR, in 0..100 %, at once and on the path; or PROG_SPD_OVR, in (0, 100] %."""
        which, share = member(SpeedCorrection, correction), real(percent) / 100.0
        general = which is SpeedCorrection.GENERAL
        if which is None or not (0.0 if general else np.nextafter(0.0, 1.0)) <= share <= 1.0:
            reason = f"speed override of {percent} %, correction {correction}"
            return self._refuse(Status.INCONSISTENT, reason)
        if not general:
            return self._set(overrides=replace(self._settings.overrides, speed=share))
        status = self._set()
        if status >= 0:
            self._override = share
            self._run(self._overriding)
        return status

    def stop_motion(self) -> Status:
        """Come to rest on the path, and stay, with unchanged targets, until asked otherwise."""
        status = self._set()
        if status >= 0 and not self._held:
            self._held = True
            self._stop_reported = self._queue is None or not self._queue.ahead
            self._run(self._stopping)
        return status

    def continue_motion(self) -> Status:
        """Go on along the path after `stop_motion`, also while the arm still comes to rest."""
        status = self._set()
        if status >= 0 and self._held:
            self._held = False
            self._run(self._stopping)
        return status

    def cancel_motion(self) -> Status:
        """Come to rest on the path and drop all targets; the arm waits for a new one there."""
        status = self._set()
        if status < 0:
            return status
        if self._queue is None or not self._queue.ahead:
            self._held = False
        elif self._moving:
            self._cancelling, self._stop_reported = True, False
            self._run(self._stopping)
        else:
            self._drop()
        return status

    # -- within ----------------------------------------------------------------------------

    def _forget(self) -> None:
        self._settings = MoveSettings.default(self._limits.n_joints)
        self._initialized = False
        self._queue: MotionQueue | None = None
        self._position = read_only(np.full(self._limits.n_joints, np.nan))
        self._period = self._first_period
        self._law = TimeLaw(self._period)
        self._override = 1.0
        self._elapsed = 0.0
        self._held = self._cancelling = False
        self._stop_reported = True

    def _rest_at(self, position: Array) -> None:
        """Begin to wait for targets, at rest."""
        self._queue = MotionQueue(position, self._limits, self._corner)
        self._position = position
        self._elapsed = 0.0
        self._cancelling = False
        self._law.restart(0.0, self._override)

    def _drop(self) -> None:
        self._held = False
        self._rest_at(self._position)

    @property
    def _moving(self) -> bool:
        law = self._law
        at_rest = law.motion_time == 0.0 or (law.settled and law.rate == 0.0)
        return self._queue is not None and bool(self._queue.ahead) and not at_rest

    def _run(self, bounds: RateBounds) -> None:
        """Bring motion time to the rate it should have, within bounds if they suffice."""
        law = self._law
        rate = 0.0 if self._held or self._cancelling else self._override
        if law.motion_time == 0.0:  # at rest where the motion begins every rate is the same
            law.restart(0.0, rate)
        else:
            admitted = admits(bounds, law.rate, law.slope)
            law.aim(rate, bounds if admitted else self._stopping)

    def _wanted(self) -> Status:
        known = len(self._queue.ahead) if self._queue is not None else 0
        return Status.NEED_MORE_DATA if known <= self._settings.advance else Status.OK

    def _step(self, status: Status, events: tuple[Event, ...]) -> Step:
        low, high = self._inside
        position = self._position
        ends = (position <= low) | (position >= high)
        flags = sum(1 << joint for joint in np.flatnonzero(ends).tolist()) if ends.any() else 0
        return Step(status, position, self._elapsed, flags, events)

    def _no_step(self, status: Status, reason: str) -> Step:
        return self._step(self._refuse(status, reason), ())

    def _stand(self, events: tuple[Event, ...]) -> Step:
        """Return the step of an arm that was asked to stop and is at rest."""
        if not self._stop_reported:
            self._stop_reported = True
            target = self.get_current_target_id()
            assert target is not None
            events += (Event(EventKind.MOTION_STOPPED, target),)
        step = self._step(Status.FINAL_STEP, events)
        if self._cancelling:
            self._drop()
        return step

    def _finish(self, queue: MotionQueue, before: float, now: float) -> Step:
        """Return the step in which the motion ends, somewhere between two motion times."""
        share = (queue.end - before) / (now - before) if now > before else 0.0
        self._elapsed += self._period * min(share, 1.0)
        *passed, last = queue.ahead
        self._position = queue.position(queue.end)
        events = (
            *(Event(EventKind.VIA_POINT_PASSED, passage.target_id) for passage in passed),
            Event(EventKind.MOTION_ENDED, last.target_id),
        )
        self._stop_reported = True
        step = self._step(Status.FINAL_STEP, events)
        self._rest_at(self._position)
        return step

    def _position_of(self, position: ArrayLike) -> Array | None:
        """Return a position (n,) the arm can be at, or None and why not in `refusal`."""
        try:
            point = reals(position)
        except (TypeError, ValueError) as error:
            self._refuse(Status.INCONSISTENT, f"a position is no row of numbers: {error}")
            return None
        lower, upper = self._limits.lower, self._limits.upper
        if point.shape != lower.shape or not np.all((point >= lower) & (point <= upper)):
            self._refuse(Status.INCONSISTENT, f"position {point.tolist()} is not in the limits")
            return None
        return point


def _isolated_corner(before: Leg, after: Leg, fly: Fly) -> Corner:
    return in_child_now(corner, before, after, fly)  # the arm may move


def _timed(queue: MotionQueue, settings: MoveSettings, target: Array) -> Move | None:
    """Return the move to a target, slow enough for its motion time; None where that is too short.

    Raises:
        InvalidSetting: a move that goes nowhere was given a time.
    """
    move, seconds = settings.move_to(target), settings.motion_time
    if seconds == 0.0:
        return move

    def excess(speed: float) -> float:
        slowed = queue.leg_to(replace(move, speed=speed), settings.overrides)
        return slowed.segment.duration - seconds

    least = excess(1.0)
    if least == -seconds:
        raise InvalidSetting("motion time", seconds, "0 s where the target is the point before")
    if least > _MOTION_TIME_ROUNDING:
        return None
    slow = 1.0
    while excess(slow) < 0.0:
        slow /= 2.0
    if slow < 1.0:
        slow = float(scipy.optimize.brentq(excess, slow, 1.0, xtol=1e-300, rtol=1e-15))
    return replace(move, speed=slow)
