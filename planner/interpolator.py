"""The interpolator as a controller offers it: targets in, one set-point per step out."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike

from planner.arrays import Array, read_only
from planner.commands import (
    STOP,
    Fly,
    FlyDistance,
    FlyPercent,
    Move,
    Overrides,
    Termination,
)
from planner.corners import STOP as NO_CORNER
from planner.corners import Corner
from planner.errors import InvalidSetting, PlannerError
from planner.limits import JointLimits
from planner.moves import Leg, assembled, between, check, corner, leg, passage
from planner.piecewise_cubic import PiecewiseCubic
from planner.player import PathReader
from planner.rrs import (
    AccelerationKind,
    Event,
    EventKind,
    FlybyCriterion,
    MotionType,
    OutputFormat,
    PointAccuracy,
    SpeedCorrection,
    Status,
    Step,
    member,
    real,
    reals,
    whole,
)
from planner.time_law import RateBounds, TimeLaw, admits, slowing_bounds, within
from planner.worker import in_child, in_child_now


class _Stretch(NamedTuple):
    """A part of the motion: its motion times [s] and how it is read."""

    begin: float
    end: float
    path: PathReader


class Timeline:
    """Parts of a motion in a row, of which the last may still be cut short.

    Args:
        position: Where the motion begins (n,) [rad]; the arm rests there until a part is added.
    """

    def __init__(self, position: Array) -> None:
        self._stretches: list[_Stretch] = []
        self._reading = 0
        self._rest = read_only(position)

    @property
    def end(self) -> float:
        """Motion time at which the last part ends [s]."""
        return self._stretches[-1].end if self._stretches else 0.0

    def append(self, part: PiecewiseCubic, rest: Array) -> None:
        """Add a part at the end; `rest` (n,) [rad] is where the arm then comes to rest."""
        if part.duration > 0.0:
            begin = self.end
            self._stretches.append(_Stretch(begin, begin + part.duration, PathReader(part)))
        self._rest = read_only(rest)

    def cut(self, time: float) -> None:
        """End the last part at a motion time [s] within it that was not read past yet.

        The arm does not rest there; whatever is appended next goes on from its state.
        """
        last = self._stretches[-1]
        self._stretches[-1] = last._replace(end=time)

    def forget_read(self) -> None:
        """Drop the parts before the one read last."""
        del self._stretches[: self._reading]
        self._reading = 0

    def position(self, time: float) -> Array:
        """Return the position (n,) [rad] at a motion time [s], not before the one read last."""
        stretches = self._stretches
        if not stretches or time >= stretches[-1].end:
            return self._rest
        while time >= stretches[self._reading].end:
            self._reading += 1
        begin, _, path = stretches[self._reading]
        return path.read(time - begin)[0]


CornerPlanner = Callable[[Leg, Leg, Fly], Corner]
"""What plans a corner, `planner.moves.corner` or the same in another process."""


class Passage(NamedTuple):
    """A target that is still ahead, and the motion time at which it is passed or reached [s]."""

    target_id: int
    time: float


class MotionQueue:
    """Targets queued for one motion from rest to rest, planned while it may already run.

    A corner takes at most the slowing down of the leg before it and the speeding up of the one
    after it, so corners never meet, and a new target changes nothing but the end of what was the
    last leg: from a stop there to a corner. That is possible until the arm has come to where the
    corner would begin.

    Args:
        start: Where the arm is at rest (n,) [rad].
        limits: Limits that the motion keeps.
        corner: What plans a corner.

    Attributes:
        ahead: Targets not passed yet, the next one first.
    """

    def __init__(self, start: Array, limits: JointLimits, corner: CornerPlanner) -> None:
        self._limits = limits
        self._corner = corner
        self._timeline = Timeline(start)
        self._point = start
        self._last: tuple[Leg, Move] | None = None
        self.ahead: deque[Passage] = deque()

    @property
    def end(self) -> float:
        """Motion time at which the arm rests at the last target [s]."""
        return self._timeline.end

    def position(self, time: float) -> Array:
        """Return the position (n,) [rad] at a motion time [s], not before the one read last."""
        return self._timeline.position(time)

    def leg_to(self, move: Move, overrides: Overrides) -> Leg:
        """Return the leg to a further target, as it would be from rest to rest.

        Raises:
            InvalidSetting: the move does not fit the arm.
        """
        return leg(self._point, move, self._limits, overrides)

    def append(self, target_id: int, move: Move, overrides: Overrides, now: float) -> None:
        """Go on to a further target; `now` is the motion time [s] read last.

        Raises:
            PlannerError: no motion to it was found; what was planned before stays.
        """
        new = self.leg_to(move, overrides)
        turn = self._turn(new, now)
        self._timeline.forget_read()
        if turn.join is not None:
            self._round(turn, turn.join)
        self._timeline.append(between(new.segment, turn, NO_CORNER), move.target)
        self._point, self._last = move.target, (new, move)
        self.ahead.append(Passage(target_id, self.end))

    def _turn(self, new: Leg, now: float) -> Corner:
        """Return the corner between the last leg and a new one, a stop if it comes too late.

        Raises:
            PlanningError: what was planned breaks a limit or jumps.
        """
        turn, legs = NO_CORNER, [new]
        if self._last is not None:
            before, move = self._last
            turn = self._corner(before, new, move.fly)
            if turn.join is None or self.end - turn.leave < now:
                turn = NO_CORNER
            else:
                legs = [before, new]
        # From rest to rest: what is new, and of what was there the leg that it joins.
        check(assembled(legs, [turn][: len(legs) - 1]), legs)
        return turn

    def _round(self, turn: Corner, join: PiecewiseCubic) -> None:
        """Replace the stop at the present end by a corner."""
        begin = self.end - turn.leave
        passed = passage(0, self._point, turn, begin)
        self._timeline.cut(begin)
        self._timeline.append(join, self._point)
        self.ahead[-1] = self.ahead[-1]._replace(time=passed.time)


# The joint kinds differ from the others only for Cartesian motion.
_TERMINATIONS: dict[PointAccuracy, Termination] = {
    PointAccuracy.FINE: "fine",
    PointAccuracy.COARSE: "coarse",
    PointAccuracy.NOSETTLE: "nosettle",
    PointAccuracy.JNT_FINE: "fine",
    PointAccuracy.JNT_COARSE: "coarse",
}
# No joint space is wider than this [rad].
_WIDEST = 1e9
# COMAU's default is 100 %; its distance of 5 mm says nothing of joints, so here it is 5 mrad.
_FLYBY = {FlybyCriterion.PERCENT: 100.0, FlybyCriterion.DISTANCE: 5e-3}


@dataclass(frozen=True, eq=False)
class MoveSettings:
    """What holds for every target until it is set again; shares in (0, 1].

    Attributes:
        speed: Share of each joint's velocity limit (n,).
        acceleration: Share of each joint's acceleration limit (n,).
        jerk: Share of each joint's jerk limit (n,).
        flying: Whether via points are flown by.
        criterion: What rules the size of a corner.
        flyby: Its value by each criterion: a percentage, a distance [rad].
        accuracy: Termination kind.
        overrides: Of the program, own quantity only.
        motion_time: What the next move has to take [s]; 0 for as short as possible.
        advance: How many targets should be known beyond the one that the arm moves to.
    """

    speed: Array
    acceleration: Array
    jerk: Array
    flying: bool = False
    criterion: FlybyCriterion = FlybyCriterion.PERCENT
    flyby: dict[FlybyCriterion, float] = field(default_factory=lambda: dict(_FLYBY))
    accuracy: PointAccuracy = PointAccuracy.NOSETTLE
    overrides: Overrides = field(default_factory=Overrides)
    motion_time: float = 0.0
    advance: int = 1

    @classmethod
    def default(cls, n_joints: int) -> MoveSettings:
        """Return what holds after initialisation: full rates, no fly-by."""
        full = read_only(np.ones(n_joints))
        return cls(full, full, full)

    def move_to(self, target: Array) -> Move:
        """Return a move to a target (n,) [rad] as set; `motion_time` is not in it."""
        return Move(
            target,
            joint_speed=self.speed,
            joint_acceleration=self.acceleration,
            fly=self._fly(),
            termination=_TERMINATIONS[self.accuracy],
            joint_jerk=self.jerk,
        )

    def _fly(self) -> Fly:
        value = self.flyby[self.criterion]
        if not self.flying or value == 0.0:
            return STOP
        return FlyPercent(value) if self.criterion is FlybyCriterion.PERCENT else FlyDistance(value)


class MoveServices:
    """RRS-1 services that describe moves. Each returns a `Status`; a refusal changes nothing.

    Attributes:
        refusal: Why the last refused service was refused, in words.
    """

    def __init__(self, limits: JointLimits) -> None:
        self._limits = limits
        self._settings = MoveSettings.default(limits.n_joints)
        self._initialized = False
        self.refusal = ""

    def select_motion_type(self, motion_type: int) -> Status:
        """Select how the arm gets to targets: `MotionType.JOINT`, nothing else is offered."""
        if member(MotionType, motion_type) is not MotionType.JOINT:
            return self._refuse(Status.INCONSISTENT, f"motion type {motion_type} is not JOINT (1)")
        return self._set()

    def set_advance_motion(self, count: int) -> Status:
        """Set how many targets beyond the present one are asked for (NEED_MORE_DATA), from 0."""
        targets = whole(count)
        if targets is None or targets < 0:
            return self._refuse(Status.INCONSISTENT, f"advance of {count} targets")
        return self._set(advance=targets)

    def set_joint_speeds(self, percent: ArrayLike, joints: Sequence[int] | None = None) -> Status:
        """Set the share of the velocity limit, in (0, 100] %, of all or of some joints."""
        return self._set_shares("speed", percent, joints)

    def set_joint_accelerations(
        self, percent: ArrayLike, joints: Sequence[int] | None = None
    ) -> Status:
        """Set the share of the acceleration limit, in (0, 100] %, of all or of some joints."""
        return self._set_shares("acceleration", percent, joints)

    def set_joint_jerks(self, percent: ArrayLike, joints: Sequence[int] | None = None) -> Status:
        """Set the share of the jerk limit, in (0, 100] %, of all or of some joints."""
        return self._set_shares("jerk", percent, joints)

    def set_override_acceleration(
        self, percent: float, kind: AccelerationKind = AccelerationKind.BOTH
    ) -> Status:
        """Scale the ramps of targets set from now on (PROG_ACC_OVR, PROG_DEC_OVR), (0, 100] %.

        Nothing but the ramps is scaled, so the path at fly-by corners can change.
        """
        share, overrides = real(percent) / 100.0, self._settings.overrides
        scaled = member(AccelerationKind, kind)
        if not 0.0 < share <= 1.0 or scaled is None:
            reason = f"acceleration override of {percent} %, kind {kind}"
            return self._refuse(Status.INCONSISTENT, reason)
        if scaled is not AccelerationKind.DECELERATION:
            overrides = replace(overrides, acceleration=share)
        if scaled is not AccelerationKind.ACCELERATION:
            overrides = replace(overrides, deceleration=share)
        return self._set(overrides=overrides)

    def select_flyby_mode(self, on: bool) -> Status:
        """Select whether the arm flies by the targets set from now on or stops there."""
        if not isinstance(on, bool | np.bool_) and whole(on) not in (0, 1):
            return self._refuse(Status.INCONSISTENT, f"fly-by {on!r} is neither on nor off")
        return self._set(flying=bool(on))

    def select_flyby_criteria(self, criterion: int) -> Status:
        """Select what rules the size of a corner, a `FlybyCriterion`."""
        selected = member(FlybyCriterion, criterion)
        if selected is None:
            return self._refuse(Status.INCONSISTENT, f"there is no fly-by criterion {criterion}")
        return self._set(criterion=selected)

    def set_flyby_criteria_parameter(self, criterion: int, value: float) -> Status:
        """Set the size of a corner: FLY_PER in 0..100 %, or the distance from the via point.

        The distance is the Euclidean one in joint space [rad], and is not exceeded.
        """
        most = {FlybyCriterion.PERCENT: 100.0, FlybyCriterion.DISTANCE: _WIDEST}
        named, size = member(FlybyCriterion, criterion), real(value)
        if named is None or not 0.0 <= size <= most[named]:
            return self._refuse(Status.INCONSISTENT, f"fly-by criterion {criterion} of {value}")
        return self._set(flyby={**self._settings.flyby, named: size})

    def cancel_flyby_criteria(self, criterion: int) -> Status:
        """Forget the value of a criterion; if it is selected, the percentage is from now on."""
        cancelled = member(FlybyCriterion, criterion)
        if cancelled is None:
            return self._refuse(Status.INCONSISTENT, f"there is no fly-by criterion {criterion}")
        previous = self._settings.criterion
        return self._set(
            flyby={**self._settings.flyby, cancelled: _FLYBY[cancelled]},
            criterion=FlybyCriterion.PERCENT if previous is cancelled else previous,
        )

    def select_point_accuracy(self, accuracy: int) -> Status:
        """Select the termination kind of the targets set from now on, a `PointAccuracy`.

        Set-points are exact whatever it is; it says what a servo has to do behind them.
        """
        selected = member(PointAccuracy, accuracy)
        if selected is None:
            return self._refuse(Status.INCONSISTENT, f"there is no point accuracy {accuracy}")
        return self._set(accuracy=selected)

    def set_point_accuracy_parameter(self, criterion: int, value: float) -> Status:
        """Set the size of a corner and select its criterion in one, as COMAU maps this service."""
        status = self.set_flyby_criteria_parameter(criterion, value)
        return status if status < 0 else self.select_flyby_criteria(criterion)

    def set_motion_time(self, seconds: float) -> Status:
        """Set what the move to the next target takes from rest to rest [s]; 0 takes that back.

        Its speed is lowered accordingly; `set_next_target` answers TIME_TOO_SHORT where the time
        is too short. Flying by either end of the move shortens it.
        """
        if not 0.0 <= real(seconds) < np.inf:
            return self._refuse(Status.INCONSISTENT, f"motion time of {seconds} s")
        return self._set(motion_time=real(seconds))

    def _set_shares(self, name: str, percent: ArrayLike, joints: Sequence[int] | None) -> Status:
        shares = np.array(getattr(self._settings, name))
        try:
            named = range(len(shares)) if joints is None else list(joints)
            chosen = [joint for joint in map(whole, named) if joint is not None]
            if len(chosen) < len(named) or not all(0 <= joint < len(shares) for joint in chosen):
                raise ValueError(f"joints {joints!r} are not of the arm's 0 to {len(shares) - 1}")
            each = reals(percent)
            if each.shape not in ((), (len(chosen),)):
                raise ValueError(f"{each.shape} values for {len(chosen)} joints")
            shares[chosen] = each / 100.0
        except (TypeError, ValueError) as error:
            return self._refuse(Status.INCONSISTENT, f"joint {name}: {error}")
        if not np.all((shares > 0.0) & (shares <= 1.0)):
            return self._refuse(Status.INCONSISTENT, f"joint {name} of {percent!r} %")
        return self._set(**{name: read_only(shares)})

    def _set(self, **changes: object) -> Status:
        if not self._initialized:
            return self._refuse(Status.INCONSISTENT, "the interpolator is not initialized")
        self._settings = replace(self._settings, **changes)  # type: ignore[arg-type]
        return Status.OK

    def _refuse(self, status: Status, reason: str) -> Status:
        self.refusal = reason
        return status


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
