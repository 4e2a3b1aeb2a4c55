"""Joint moves by the services of RRS-1: a thin layer over `MotionQueue` and `TrajectoryPlayer`.

RRS-1 (Realistic Robot Simulation, 1993) is the interface by which simulators call the motion
software of a controller. Speeds, accelerations and jerks are percentages.
"""

from __future__ import annotations

from dataclasses import replace
from math import inf, nan
from operator import index

import numpy as np
from numpy.typing import ArrayLike

from planner.arrays import Array, read_only
from planner.errors import InvalidSetting
from planner.interpolator_codes import (
    AccelerationKind,
    Event,
    EventKind,
    FlybyCriterion,
    InterpolationStep,
    MotionType,
    OutputFormat,
    PointAccuracy,
    SpeedCorrection,
    Status,
)
from planner.interpolator_settings import MoveSettings, require, service
from planner.limits import JointLimits
from planner.motion_queue import MotionQueue
from planner.piecewise_cubic import PiecewiseCubic
from planner.player import TrajectoryPlayer
from planner.worker import in_child

__all__ = [
    "Interpolator",
    "AccelerationKind",
    "Event",
    "EventKind",
    "FlybyCriterion",
    "MotionType",
    "OutputFormat",
    "PointAccuracy",
    "SpeedCorrection",
    "Status",
    "InterpolationStep",
]


class Interpolator(MoveSettings):
    """Plans joint moves while they run, and plays them, with the services of RRS-1.

    Services return a `Status` (`get_next_step` an `InterpolationStep`); a refused service changed
    nothing, and `refusal` is the reason of the last one. Settings apply to later targets, except
    GEN_OVR (`set_override_speed`), which acts at once. The same calls return the same steps bit by
    bit.

    Args:
        limits: Limits of the arm.
        period: Time of a step [s].
        override_bounds: Largest acceleration and jerk while GEN_OVR changes, as multiples (> 1)
            of the limits.
        stop_bounds: The same while the motion is stopped or continued; not below the others.
        isolated: Plan corners in a child process, whose crash is a FATAL status.

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
        super().__init__(limits)
        self._first_period = period
        self._override_bounds = override_bounds
        self._stop_bounds = stop_bounds
        self._isolated = isolated
        self._clear()

    def _clear(self) -> None:
        self._reset_settings()
        self._initialized = False
        self._period = self._first_period
        self._override = 1.0
        self._queue: MotionQueue | None = None
        self._player: TrajectoryPlayer | None = None
        self._position = read_only(np.full(self._limits.n_joints, nan))
        self._elapsed = 0.0
        self._held = self._cancelling = False
        self._stop_reported = True

    def initialize(self) -> Status:
        """As `reset`; FATAL if the process that plans corners does not start."""
        before = self._initialized
        self._initialized = True
        status = self.reset()
        self._initialized = before or status >= 0
        return status

    @service
    def reset(self) -> None:
        """Reset settings, position and targets; refused while the arm moves."""
        require(not self._moving, "the arm moves")
        if self._isolated:
            in_child(float)  # starts the child, before a motion runs
        self._clear()
        self._initialized = True

    @service
    def terminate(self) -> None:
        """End; only `initialize` is accepted afterwards. Refused while the arm moves."""
        require(not self._moving, "the arm moves")
        self._clear()

    @service
    def set_initial_position(self, position: ArrayLike) -> None:
        """Set the position of the arm at rest (n,) [rad]; refused while targets are queued."""
        require(self._player is None, "targets are queued; cancel the motion first")
        self._rest_at(self._checked(position))
        self._held = False

    @service
    def set_interpolation_time(self, period: float) -> None:
        """Set the time of a step [s]; refused while targets are queued."""
        require(self._player is None, "targets are queued; cancel the motion first")
        require(0.0 < period < inf, f"interpolation time of {period} s")
        self._period = float(period)

    @service
    def set_next_target(self, target_id: int, position: ArrayLike) -> Status:
        """Add a target (n,) [rad] with the present settings; OK or NEED_MORE_DATA.

        TIME_TOO_SHORT: see `set_motion_time`. FATAL: none was found, the present one continues.
        """
        queue = self._queue
        if queue is None:
            raise ValueError("no initial position is set")
        require(not self._cancelling, "the cancelled motion still comes to rest")
        move = self._next_move(queue, self._checked(position))
        now = self._player.motion_time if self._player else 0.0
        motion = queue.append(index(target_id), move, self._overrides, now)
        if self._player is None:
            self._player = self._begun(motion)
        else:
            self._player.extend(motion)
        self.set_motion_time(0.0)
        return self._wanted(queue)

    def get_current_target_id(self) -> int | None:
        """Return the identifier of the next target, or None."""
        return self._queue.ahead[0].target_id if self._queue and self._queue.ahead else None

    def get_next_step(self, output_format: int = OutputFormat.JOINT) -> InterpolationStep:
        """Return the next step of the motion.

        OK; NEED_MORE_DATA while fewer targets are known than requested; FINAL_STEP at the end of
        the motion and while it is stopped; NO_TARGET without targets; OUTPUT_FORMAT for others.
        """
        queue = self._queue
        player = self._player
        if output_format != OutputFormat.JOINT:
            return self._no_step(Status.OUTPUT_FORMAT, "only joint positions are available")
        if queue is None:
            return self._no_step(Status.INCONSISTENT, "no initial position is set")
        if player is None:
            return self._no_step(Status.NO_TARGET, "no target is set")
        if self._stopped(player):
            return self._stand(())
        before = player.motion_time
        self._position, _ = player.advance()
        self._position.setflags(write=False)
        if player.finished:
            return self._finish(queue, before, player.motion_time)
        self._elapsed += self._period
        passed = queue.pass_until(player.motion_time)
        events = tuple(Event(EventKind.VIA_POINT_PASSED, target) for target in passed)
        if self._stopped(player):
            return self._stand(events)
        return self._step(self._wanted(queue), events)

    @service
    def set_override_speed(
        self, percent: float, correction: SpeedCorrection = SpeedCorrection.GENERAL
    ) -> None:
        """Set GEN_OVR, in 0..100 %, which acts immediately; or PROG_SPD_OVR, in (0, 100] %."""
        share = percent / 100.0
        if SpeedCorrection(correction) is SpeedCorrection.PROGRAM:
            self._overrides = replace(self._overrides, speed=share)
            return
        require(0.0 <= share <= 1.0, f"speed override of {percent} %")
        self._override = share
        if self._player is not None:
            self._player.override(share)

    @service
    def stop_motion(self) -> None:
        """Stop on the path until `continue_motion`; the targets are unchanged."""
        if not self._held:
            self._stop_reported = self._player is None
        self._held = True
        if self._player is not None:
            self._player.hold()

    @service
    def continue_motion(self) -> None:
        """Continue after `stop_motion`, also while the arm still slows down."""
        self._held = False
        if self._player is not None and not self._cancelling:
            self._player.resume()

    @service
    def cancel_motion(self) -> None:
        """Stop on the path and drop all targets."""
        if self._moving and self._player is not None:
            self._cancelling = True
            self._stop_reported = False
            self._player.hold()
        elif self._player is not None:
            self._rest_at(self._position)
        self._held = self._held and self._cancelling

    def _begun(self, motion: PiecewiseCubic) -> TrajectoryPlayer:
        """Return a player of a motion from the present position, at the present override."""
        player = TrajectoryPlayer(
            motion,
            self._period,
            self._limits,
            override_acceleration=self._override_bounds[0],
            override_jerk=self._override_bounds[1],
            stop_acceleration=self._stop_bounds[0],
            stop_jerk=self._stop_bounds[1],
            extendable=True,
        )
        player.begin(self._position)
        player.override(self._override)
        if self._held:
            player.hold()
        return player

    def _rest_at(self, position: Array) -> None:
        """Wait for targets at a position (n,) [rad]."""
        self._queue = MotionQueue(position, self._limits, isolated=self._isolated)
        self._player = None
        self._position = position
        self._elapsed = 0.0
        self._cancelling = False

    @property
    def _moving(self) -> bool:
        player = self._player
        return player is not None and player.motion_time > 0.0 and player.rate > 0.0

    def _stopped(self, player: TrajectoryPlayer) -> bool:
        return (self._held or self._cancelling) and player.rate == 0.0

    def _wanted(self, queue: MotionQueue) -> Status:
        return Status.NEED_MORE_DATA if len(queue.ahead) <= self._advance else Status.OK

    def _step(self, status: Status, events: tuple[Event, ...]) -> InterpolationStep:
        return InterpolationStep(
            status, self._position, self._elapsed, self._at_ends(self._position), events
        )

    def _no_step(self, status: Status, reason: str) -> InterpolationStep:
        self.refusal = reason
        return self._step(status, ())

    def _stand(self, events: tuple[Event, ...]) -> InterpolationStep:
        """Return the step of a stopped arm at rest."""
        target = self.get_current_target_id()
        if not self._stop_reported and target is not None:
            self._stop_reported = True
            events += (Event(EventKind.MOTION_STOPPED, target),)
        step = self._step(Status.FINAL_STEP, events)
        if self._cancelling:
            self._held = False
            self._rest_at(self._position)
        return step

    def _finish(self, queue: MotionQueue, before: float, now: float) -> InterpolationStep:
        """Return the step in which the motion ends, between two motion times [s]."""
        share = (queue.duration - before) / (now - before) if now > before else 0.0
        self._elapsed += self._period * min(share, 1.0)
        *passed, last = queue.pass_until(inf)
        events = tuple(Event(EventKind.VIA_POINT_PASSED, target) for target in passed)
        events += (Event(EventKind.MOTION_ENDED, last),)
        self._position = queue.end
        self._stop_reported = True
        step = self._step(Status.FINAL_STEP, events)
        self._rest_at(self._position)
        return step
