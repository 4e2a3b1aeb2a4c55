"""Online interpolator with the services of RRS-1: targets in, one set-point per step out.

RRS-1 (Realistic Robot Simulation, 1993) is the interface by which simulators call the motion
software of a controller. The numbers of its codes are those of public clients of RRS-1 and of
COMAU's ORL. Speeds, accelerations and jerks are percentages.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum, IntEnum
from functools import wraps
from math import inf, nan
from operator import index
from typing import Any, Concatenate, Final, NamedTuple, ParamSpec

import numpy as np
import scipy
from numpy.typing import ArrayLike

from planner.arrays import Array, read_only
from planner.corners import STOP, Corner
from planner.errors import InvalidSetting, PlannerError
from planner.limits import JointLimits, position_rounding
from planner.moves import (
    Legs,
    Move,
    Overrides,
    checked_shares,
    legs_through,
    passage,
)
from planner.piecewise_cubic import PiecewiseCubic
from planner.player import PathReader
from planner.time_law import RateBounds, TimeLaw, admits, slowing_bounds, within
from planner.worker import in_child


class Status(IntEnum):
    """Return code of a service: success if not negative; a refused service changed nothing."""

    OK = 0
    NEED_MORE_DATA = 1
    FINAL_STEP = 2
    OUTPUT_FORMAT = -13
    TIME_TOO_SHORT = -25
    NO_TARGET = -42
    FATAL = -68
    INCONSISTENT = -76


class MotionType(IntEnum):
    """Kind of path to a target."""

    JOINT = 1
    LINEAR = 2
    CIRCULAR = 4


class OutputFormat(IntEnum):
    """Format of the positions of a step."""

    JOINT = 0
    CARTESIAN = 1


class PointAccuracy(IntEnum):
    """When a target at which the arm stops counts as reached (ORL's termination kinds)."""

    FINE = 0
    COARSE = 1
    NOSETTLE = 2
    JNT_FINE = 3
    JNT_COARSE = 4


class FlybyCriterion(IntEnum):
    """Criterion for the size of a fly-by corner (the numbers are not from ORL).

    A distance is one of the tool, which a joint interpolator does not know.
    """

    PERCENT = 1
    DISTANCE = 2


class AccelerationKind(IntEnum):
    """Ramps that an acceleration override scales."""

    BOTH = 0
    ACCELERATION = 1
    DECELERATION = 2


class SpeedCorrection(IntEnum):
    """Speed override of the controller.

    GENERAL (GEN_OVR) acts at once and does not change the path; PROGRAM (PROG_SPD_OVR) scales the
    speed of later targets, whose corners may change with it.
    """

    GENERAL = 0
    PROGRAM = 1


class EventKind(Enum):
    """Kind of an `Event`."""

    VIA_POINT_PASSED = "via point passed"
    MOTION_ENDED = "motion ended"
    MOTION_STOPPED = "motion stopped"


class Event(NamedTuple):
    """Event during a step, with its target.

    A via point is passed where the path is nearest to it. A motion ends at its last target;
    a requested stop names the next target.
    """

    kind: EventKind
    target_id: int


class Step(NamedTuple):
    """One interpolation step.

    `position` is the set-point (n,) [rad], read-only, the last one after an error and NaN before
    the first; `elapsed_time` [s] counts since the last motion ended, to a fraction of a step; bit j
    of `joint_limits` is set while joint j is at an end of its range.
    """

    status: Status
    position: Array
    elapsed_time: float
    joint_limits: int
    events: tuple[Event, ...]


# Tolerance on motion times [s], and on times as a share of a period.
_ROUNDING: Final = 1e-9
# COMAU's default of FLY_PER.
_FLY_PERCENT: Final = 100.0


def corner(legs: Legs, fly: float) -> Corner:
    """Plan the corner between two legs, `fly` a share as of `Legs.corners`."""
    first, second = np.arange(2)[:, None]
    return legs.corners(first, second, np.array([fly]))[0]


def _isolated_corner(legs: Legs, fly: float) -> Corner:
    return in_child(corner, legs, fly)


class _Stretch(NamedTuple):
    """A leg or corner of the motion between two motion times [s]."""

    begin: float
    end: float
    path: PathReader


class _Passage(NamedTuple):
    """A target ahead, and the motion time at which it is passed or reached [s]."""

    target_id: int
    time: float


class MotionQueue:
    """Targets of one motion from rest to rest, planned while it runs.

    Corners use the deceleration before and the acceleration after a target, so they never overlap:
    a new target replaces the stop at the last one by a corner, unless the arm has reached its
    start. `ahead` has the targets not passed yet.

    Args:
        start: Start position of the arm, at rest (n,) [rad].
        limits: Limits of the motion.
        corner: `corner`, or the same in another process.
    """

    def __init__(
        self, start: Array, limits: JointLimits, corner: Callable[[Legs, float], Corner]
    ) -> None:
        self._limits = limits
        self._corner = corner
        self._stretches: list[_Stretch] = []
        self._reading = 0
        self._point = start
        self._last: tuple[Legs, float] | None = None
        self.ahead: deque[_Passage] = deque()

    @property
    def end(self) -> float:
        """Motion time at which the motion ends at the last target [s]."""
        return self._stretches[-1].end if self._stretches else 0.0

    def position(self, time: float) -> Array:
        """Return the position (n,) [rad] at a motion time [s], not before that of the last call."""
        stretches = self._stretches
        if not stretches or time >= stretches[-1].end:
            return self._point
        while time >= stretches[self._reading].end:
            self._reading += 1
        begin, _, path = stretches[self._reading]
        return path.read(time - begin)[0]

    def leg_to(self, move: Move, overrides: Overrides) -> Legs:
        """Return the leg to a further target, from rest to rest."""
        points = np.stack((self._point, move.target))
        return legs_through(points, [move], self._limits, overrides)

    def append(self, target_id: int, move: Move, overrides: Overrides, now: float) -> None:
        """Add a target; `now` is the present motion time [s].

        Raises:
            PlannerError: no motion to it was found; the motion planned before is unchanged.
        """
        new = legs = self.leg_to(move, overrides)
        turn = STOP
        turns = list[Corner]()
        if self._last is not None:
            both = self._last[0].followed_by(new)
            found = self._corner(both, self._last[1])
            if found.join is not None and self.end - found.leave >= now:
                turn = found
                turns = [found]
                legs = both
        legs.motions(turns, 1)  # checked from rest to rest, with the leg before the corner
        del self._stretches[: self._reading]
        self._reading = 0
        if turn.join is not None:
            begin = self.end - turn.leave
            passed = passage(0, self._point, turn, begin)
            self._stretches[-1] = self._stretches[-1]._replace(end=begin)
            self._extend(turn.join)
            self.ahead[-1] = self.ahead[-1]._replace(time=passed.time)
        enter = np.array([turn.enter])
        (part,) = new.moves.tables(enter, np.maximum(enter, new.moves.durations))
        self._extend(part)
        self._point = move.target
        self._last = (new, move.fly_percent / 100.0)
        self.ahead.append(_Passage(target_id, self.end))

    def _extend(self, part: PiecewiseCubic) -> None:
        if part.duration > 0.0:
            stretch = _Stretch(self.end, self.end + part.duration, PathReader(part))
            self._stretches.append(stretch)


@dataclass(frozen=True, eq=False)
class MoveSettings:
    """Settings of the next targets.

    `speed`, `acceleration` and `jerk` are shares of the limits of each joint (n,); `motion_time` is
    that of the next move [s], 0 for the shortest; `advance` is the number of targets that should be
    known beyond the next one.
    """

    speed: Array
    acceleration: Array
    jerk: Array
    flying: bool = False
    fly_percent: float = _FLY_PERCENT
    overrides: Overrides = field(default_factory=Overrides)
    motion_time: float = 0.0
    advance: int = 1

    def move_to(self, target: Array, speed: float = 1.0) -> Move:
        """Return a move to a target (n,) [rad] without `motion_time`."""
        return Move(
            target,
            speed=speed,
            joint_speed=self.speed,
            joint_acceleration=self.acceleration,
            fly_percent=self.fly_percent if self.flying else 0.0,
            joint_jerk=self.jerk,
        )


class _RefusedError(Exception):
    def __init__(self, reason: str, status: Status = Status.INCONSISTENT) -> None:
        self.status = status
        super().__init__(reason)


P = ParamSpec("P")


def _service(
    method: Callable[Concatenate[Interpolator, P], Status | None],
) -> Callable[Concatenate[Interpolator, P], Status]:
    """Return a service that returns the status of the errors which the method raises."""

    @wraps(method)
    def service(self: Interpolator, /, *args: P.args, **kwargs: P.kwargs) -> Status:
        try:
            self._require(self._initialized, "the interpolator is not initialized")
            return method(self, *args, **kwargs) or Status.OK
        except _RefusedError as refused:
            status = refused.status
            self.refusal = str(refused)
        except (InvalidSetting, TypeError, ValueError, OverflowError) as error:
            status = Status.INCONSISTENT
            self.refusal = str(error)
        except PlannerError as error:
            status = Status.FATAL
            self.refusal = str(error)
        return status

    return service


class Interpolator:
    """Plans and interpolates joint moves while they run, with the services of RRS-1.

    A target set before the arm reaches the start of the corner before it is reached by a fly-by, if
    that is selected; with a later one the arm stops at the point before. The motion ends at rest at
    the last target. Targets set before the motion give the motion of `planner.plan_moves`. The same
    calls return the same steps bit by bit.

    Services return a `Status` (`get_next_step` a `Step`); a refused service changed nothing, and
    `refusal` is the reason of the last one. The order of calls is

        initialize, set_initial_position, {set_next_target | get_next_step}..., terminate

    Settings apply to later targets, except GEN_OVR (`set_override_speed`), which acts at once.

    Args:
        limits: Limits of the arm.
        period: Time of a step [s].
        override_bounds: Largest acceleration and jerk while GEN_OVR changes, as multiples (> 1)
            of the limits.
        stop_bounds: The same while the motion is stopped or continued; not below the others.
        isolated: Plan corners in a child process, whose crash is a FATAL status; without it, a
            corner takes half a millisecond less.

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
        if not 0.0 < period < inf:
            raise InvalidSetting("period", period, "a time above 0 s")
        if not (min(override_bounds) > 1.0 and np.all(np.less_equal(override_bounds, stop_bounds))):
            raise InvalidSetting("override_bounds", override_bounds, f"in (1, {stop_bounds}]")
        self.refusal = ""
        self._limits = limits
        self._isolated = isolated
        self._initialized = False
        self._elapsed = 0.0
        self._law = TimeLaw(period)
        self._corner = _isolated_corner if isolated else corner
        self._first_period = period
        self._stopping: RateBounds = slowing_bounds(limits, *stop_bounds)
        self._overriding = within(slowing_bounds(limits, *override_bounds), self._stopping)
        rounding = position_rounding(limits)
        self._inside = (limits.lower + rounding, limits.upper - rounding)
        self._clear()

    # -- session ---------------------------------------------------------------------------

    def initialize(self) -> Status:
        """Start with default settings and without position and targets.

        Refused while the arm moves, as `reset` and `terminate` are: call `stop_motion` or
        `cancel_motion` first. FATAL if the process that plans corners does not start.
        """
        before = self._initialized
        self._initialized = True
        status = self.reset()
        if status < 0:
            self._initialized = before
        return status

    @_service
    def reset(self) -> None:
        """Reset all settings as `initialize` does; refused while the arm moves."""
        self._require_rest()
        if self._isolated:
            try:
                in_child(float)  # starts the child, before a motion runs
            except PlannerError as error:
                raise _RefusedError(str(error), Status.FATAL) from error
        self._clear()
        self._initialized = True

    @_service
    def terminate(self) -> None:
        """End; only `initialize` is accepted afterwards. Refused while the arm moves."""
        self._require_rest()
        self._clear()

    @_service
    def set_initial_position(self, position: ArrayLike) -> None:
        """Set the position of the arm at rest (n,) [rad]; refused while targets are queued."""
        queued = self._queue is not None and self._queue.ahead
        self._require(not queued, "targets are queued; cancel the motion first")
        point = self._position_of(position)
        self._held = False
        self._rest_at(point)

    @_service
    def set_interpolation_time(self, period: float) -> None:
        """Set the time of a step [s]; refused while the arm moves."""
        self._require_rest()
        self._require(0.0 < period < inf, f"interpolation time of {period} s")
        self._period = float(period)
        time = self._law.motion_time
        rate = self._law.rate
        self._law = TimeLaw(self._period)
        self._law.restart(time, rate)

    # -- settings --------------------------------------------------------------------------

    @_service
    def select_motion_type(self, motion_type: int) -> None:
        """Select the kind of path; only `MotionType.JOINT` is implemented."""
        joint = MotionType(motion_type) is MotionType.JOINT
        self._require(joint, f"motion type {motion_type} is not JOINT (1)")

    @_service
    def set_advance_motion(self, count: int) -> None:
        """Set the number of targets beyond the next one below which NEED_MORE_DATA is returned."""
        self._require(index(count) >= 0, f"advance of {count} targets")
        self._set(advance=index(count))

    @_service
    def set_joint_speeds(self, percent: ArrayLike, joints: Sequence[int] | None = None) -> None:
        """Set the share of the velocity limit, in (0, 100] %, of all or of some joints."""
        self._set_shares("speed", percent, joints)

    @_service
    def set_joint_accelerations(
        self, percent: ArrayLike, joints: Sequence[int] | None = None
    ) -> None:
        """Set the share of the acceleration limit, in (0, 100] %, of all or of some joints."""
        self._set_shares("acceleration", percent, joints)

    @_service
    def set_joint_jerks(self, percent: ArrayLike, joints: Sequence[int] | None = None) -> None:
        """Set the share of the jerk limit, in (0, 100] %, of all or of some joints."""
        self._set_shares("jerk", percent, joints)

    @_service
    def set_override_acceleration(
        self, percent: float, kind: AccelerationKind = AccelerationKind.BOTH
    ) -> None:
        """Scale the ramps of later targets (PROG_ACC_OVR, PROG_DEC_OVR), in (0, 100] %.

        The path at fly-by corners can change.
        """
        share = percent / 100.0
        overrides = self._settings.overrides
        scaled = AccelerationKind(kind)
        if scaled is not AccelerationKind.DECELERATION:
            overrides = replace(overrides, acceleration=share)
        if scaled is not AccelerationKind.ACCELERATION:
            overrides = replace(overrides, deceleration=share)
        self._set(overrides=overrides)

    @_service
    def select_flyby_mode(self, on: bool) -> None:
        """Select whether the arm flies by later targets or stops there."""
        self._require(on in (0, 1), f"fly-by {on!r} is neither on nor off")
        self._set(flying=bool(on))

    @_service
    def select_flyby_criteria(self, criterion: int) -> None:
        """Select the criterion of the size of corners; only PERCENT is implemented."""
        self._require_percent(criterion)

    @_service
    def set_flyby_criteria_parameter(self, criterion: int, value: float) -> None:
        """Set the size of corners: FLY_PER in 0..100 %."""
        self._set_flyby(criterion, value)

    @_service
    def set_point_accuracy_parameter(self, criterion: int, value: float) -> None:
        """Set the size of corners, as COMAU maps this service."""
        self._set_flyby(criterion, value)

    @_service
    def cancel_flyby_criteria(self, criterion: int) -> None:
        """Reset the value of a criterion."""
        self._set_flyby(criterion, _FLY_PERCENT)

    @_service
    def select_point_accuracy(self, accuracy: int) -> None:
        """Select the `PointAccuracy` of later targets; it does not change set-points."""
        PointAccuracy(accuracy)

    @_service
    def set_motion_time(self, seconds: float) -> None:
        """Set the duration of the next move, from rest to rest [s]; 0 for the shortest."""
        self._require(0.0 <= seconds < inf, f"motion time of {seconds} s")
        self._set(motion_time=float(seconds))

    # -- targets ---------------------------------------------------------------------------

    @_service
    def set_next_target(self, target_id: int, position: ArrayLike) -> Status:
        """Add a target (n,) [rad] with the present settings; OK or NEED_MORE_DATA.

        Refusals are INCONSISTENT, TIME_TOO_SHORT (see `set_motion_time`), and FATAL where no motion
        was found; the motion to the targets before it continues.
        """
        queue = self._queue
        if queue is None:
            raise _RefusedError("no initial position is set")
        self._require(not self._cancelling, "the cancelled motion still comes to rest")
        move = _timed(queue, self._settings, self._position_of(position))
        queue.append(index(target_id), move, self._settings.overrides, self._law.motion_time)
        self._set(motion_time=0.0)
        return self._wanted(queue)

    def get_current_target_id(self) -> int | None:
        """Return the identifier of the next target, or None."""
        ahead = self._queue.ahead if self._queue is not None else None
        return ahead[0].target_id if ahead else None

    # -- motion ----------------------------------------------------------------------------

    def get_next_step(self, output_format: int = OutputFormat.JOINT) -> Step:
        """Return the next step of the motion.

        OK; NEED_MORE_DATA while fewer targets are known than requested; FINAL_STEP at the end of
        the motion and while it is stopped; NO_TARGET without targets; OUTPUT_FORMAT for another
        format.
        """
        queue = self._queue
        law = self._law
        if output_format != OutputFormat.JOINT:
            return self._no_step(Status.OUTPUT_FORMAT, "only joint positions are available")
        if queue is None:
            return self._no_step(Status.INCONSISTENT, "no initial position is set")
        ahead = queue.ahead
        if not ahead:
            return self._no_step(Status.NO_TARGET, "no target is set")
        braking = self._held or self._cancelling
        if braking and law.settled:
            return self._stand(())
        before = law.motion_time
        law.advance()
        now = law.motion_time
        if now >= queue.end - _ROUNDING * self._period:
            return self._finish(queue, before, now)
        self._position = queue.position(now)
        self._position.setflags(write=False)
        self._elapsed += self._period
        events: tuple[Event, ...] = ()
        while ahead[0].time <= now:
            events += (Event(EventKind.VIA_POINT_PASSED, ahead.popleft().target_id),)
        if braking and law.settled:
            return self._stand(events)
        return self._step(self._wanted(queue), events)

    @_service
    def set_override_speed(
        self, percent: float, correction: SpeedCorrection = SpeedCorrection.GENERAL
    ) -> None:
        """Set GEN_OVR, in 0..100 %, which acts at once; or PROG_SPD_OVR, in (0, 100] %."""
        share = percent / 100.0
        if SpeedCorrection(correction) is SpeedCorrection.PROGRAM:
            self._set(overrides=replace(self._settings.overrides, speed=share))
        else:
            self._require(0.0 <= share <= 1.0, f"speed override of {percent} %")
            self._override = share
            self._run(self._overriding)

    @_service
    def stop_motion(self) -> None:
        """Stop on the path until `continue_motion`; the targets are unchanged."""
        if not self._held:
            self._held = True
            self._stop_reported = self.get_current_target_id() is None
            self._run(self._stopping)

    @_service
    def continue_motion(self) -> None:
        """Continue after `stop_motion`, also while the arm still slows down."""
        if self._held:
            self._held = False
            self._run(self._stopping)

    @_service
    def cancel_motion(self) -> None:
        """Stop on the path and drop all targets."""
        if self.get_current_target_id() is None:
            self._held = False
        elif self._moving:
            self._cancelling = True
            self._stop_reported = False
            self._run(self._stopping)
        else:
            self._drop()

    def _clear(self) -> None:
        n = self._limits.n_joints
        full = read_only(np.ones(n))
        self._settings = MoveSettings(full, full, full)
        self._initialized = False
        self._queue: MotionQueue | None = None
        self._position = read_only(np.full(n, nan))
        self._period = self._first_period
        self._law = TimeLaw(self._period)
        self._override = 1.0
        self._elapsed = 0.0
        self._held = self._cancelling = False
        self._stop_reported = True

    def _rest_at(self, position: Array) -> None:
        """Wait for targets at a position."""
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
        return self.get_current_target_id() is not None and not at_rest

    def _run(self, bounds: RateBounds) -> None:
        """Change the rate to its target within bounds, or within those of a stop if needed."""
        law = self._law
        rate = 0.0 if self._held or self._cancelling else self._override
        if law.motion_time == 0.0:  # at rest at the start
            law.restart(0.0, rate)
        else:
            admitted = admits(bounds, law.rate, law.slope)
            law.aim(rate, bounds if admitted else self._stopping)

    def _require(self, condition: bool, reason: str) -> None:
        if not condition:
            raise _RefusedError(reason)

    def _require_rest(self) -> None:
        self._require(not self._moving, "the arm moves")

    def _set(self, **changes: Any) -> None:
        self._settings = replace(self._settings, **changes)

    def _require_percent(self, criterion: int) -> None:
        percent = FlybyCriterion(criterion) is FlybyCriterion.PERCENT
        self._require(percent, "only percentages of the deceleration are implemented")

    def _set_flyby(self, criterion: int, value: float) -> None:
        self._require_percent(criterion)
        self._require(0.0 <= value <= 100.0, f"fly-by of {value} %")
        self._set(fly_percent=float(value))

    def _set_shares(self, name: str, percent: ArrayLike, joints: Sequence[int] | None) -> None:
        shares = np.array(getattr(self._settings, name))
        chosen = [index(joint) for joint in (range(len(shares)) if joints is None else joints)]
        known = all(0 <= joint < len(shares) for joint in chosen)
        self._require(known, f"joints {joints!r} are not of the arm's 0 to {len(shares) - 1}")
        each = np.divide(percent, 100.0)
        shares[chosen] = checked_shares(f"joint {name}", each, len(chosen))
        self._set(**{name: read_only(shares)})

    def _position_of(self, position: ArrayLike) -> Array:
        """Return a position (n,) checked to be inside the limits."""
        point = read_only(position)
        lower = self._limits.lower
        upper = self._limits.upper
        inside = point.shape == lower.shape and np.all((point >= lower) & (point <= upper))
        self._require(bool(inside), f"position {position!r:.200} is not in the limits")
        return point

    def _wanted(self, queue: MotionQueue) -> Status:
        more = len(queue.ahead) <= self._settings.advance
        return Status.NEED_MORE_DATA if more else Status.OK

    def _step(self, status: Status, events: tuple[Event, ...]) -> Step:
        low, high = self._inside
        position = self._position
        ends = (position <= low) | (position >= high)
        flags = sum(1 << joint for joint in np.flatnonzero(ends).tolist()) if ends.any() else 0
        return Step(status, position, self._elapsed, flags, events)

    def _no_step(self, status: Status, reason: str) -> Step:
        self.refusal = reason
        return self._step(status, ())

    def _stand(self, events: tuple[Event, ...]) -> Step:
        """Return the step of a stopped arm at rest."""
        target = self.get_current_target_id()
        if not self._stop_reported and target is not None:
            self._stop_reported = True
            events += (Event(EventKind.MOTION_STOPPED, target),)
        step = self._step(Status.FINAL_STEP, events)
        if self._cancelling:
            self._drop()
        return step

    def _finish(self, queue: MotionQueue, before: float, now: float) -> Step:
        """Return the step in which the motion ends, between two motion times."""
        share = (queue.end - before) / (now - before) if now > before else 0.0
        self._elapsed += self._period * min(share, 1.0)
        *passed, last = queue.ahead
        self._position = queue.position(queue.end)
        events = (
            *(Event(EventKind.VIA_POINT_PASSED, target.target_id) for target in passed),
            Event(EventKind.MOTION_ENDED, last.target_id),
        )
        self._stop_reported = True
        step = self._step(Status.FINAL_STEP, events)
        self._rest_at(self._position)
        return step


def _timed(queue: MotionQueue, settings: MoveSettings, target: Array) -> Move:
    """Return the move to a target with its motion time.

    Raises:
        InvalidSetting: a motion time for a target that is the point before.
    """
    seconds = settings.motion_time
    if seconds == 0.0:
        return settings.move_to(target)

    def excess(speed: float) -> float:
        leg = queue.leg_to(settings.move_to(target, speed), settings.overrides)
        return float(leg.moves.durations[0]) - seconds

    least = excess(1.0)
    if least == -seconds:
        raise InvalidSetting("motion time", seconds, "0 s where the target is the point before")
    if least > _ROUNDING:
        reason = f"the move takes longer than its motion time of {seconds} s"
        raise _RefusedError(reason, Status.TIME_TOO_SHORT)
    slow = 1.0
    while excess(slow) < 0.0:
        slow /= 2.0
    if slow < 1.0:
        slow = float(scipy.optimize.brentq(excess, slow, 1.0, xtol=1e-300, rtol=1e-15))
    return settings.move_to(target, slow)
