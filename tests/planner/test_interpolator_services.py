"""Any services in any order: what is sent to the arm stays smooth, within bounds, and true."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from planner import JointLimits
from planner.interpolator import Interpolator
from planner.rrs import AccelerationKind, EventKind, FlybyCriterion, SpeedCorrection, Status

ROUNDING = 1e-4  # of differences over three periods
PERIODS = (0.004, 0.01)
LIMITS = JointLimits(
    lower=np.array([-3.0, -1.0, -0.02]),
    upper=np.array([3.0, 2.0, 0.03]),
    velocity=np.array([2.5, 3.0, 0.5]),
    acceleration=np.array([9.0, 25.0, 6.0]),
    jerk=np.array([90.0, 400.0, 90.0]),
)
RATES = (LIMITS.velocity, LIMITS.acceleration, LIMITS.jerk)
SHARES = st.one_of(st.just(0.0), st.just(1.0), st.floats(0.0, 1.0))
PERCENT = st.one_of(st.just(100.0), st.floats(30.0, 100.0))


def point(shares):
    inside = LIMITS.lower + np.array(shares) * (LIMITS.upper - LIMITS.lower)
    return np.clip(inside, LIMITS.lower, LIMITS.upper)


class AnyServices(RuleBasedStateMachine):
    """Set-points are judged as a guard would: by differences of what was sent."""

    @initialize(shares=st.tuples(SHARES, SHARES, SHARES))
    def begin(self, shares):
        self.interpolator = Interpolator(LIMITS, PERIODS[0])
        self.period = PERIODS[0]
        start = point(shares)
        assert self.interpolator.set_next_target(1, start) == Status.INCONSISTENT
        assert self.interpolator.initialize() == Status.OK
        assert self.interpolator.set_initial_position(start) == Status.OK
        self.sent = [start] * 4
        self.queued: list[tuple[int, np.ndarray]] = []
        self.next_id = 1
        self.factors = (1.0, 1.0, 1.0)
        self.stopped = self.cancelled = False

    @rule(shares=st.tuples(SHARES, SHARES, SHARES), tiny=st.booleans())
    def set_target(self, shares, tiny):
        target = point(shares)
        if tiny:
            last = self.queued[-1][1] if self.queued else self.sent[-1]
            target = np.clip(last + 1e-6 * (target - last), LIMITS.lower, LIMITS.upper)
        status = self.interpolator.set_next_target(self.next_id, target)
        if self.cancelled:
            assert status == Status.INCONSISTENT
        elif status != Status.TIME_TOO_SHORT and status != Status.INCONSISTENT:
            assert status in (Status.OK, Status.NEED_MORE_DATA), self.interpolator.refusal
            self.queued.append((self.next_id, target))
            self.next_id += 1
        else:
            assert "motion time" in self.interpolator.refusal
            assert self.interpolator.set_motion_time(0.0) == Status.OK

    @rule(seconds=st.floats(0.0, 2.0))
    def take_time(self, seconds):
        assert self.interpolator.set_motion_time(seconds) == Status.OK

    @rule(count=st.sampled_from([1, 3, 20, 100]))
    def step(self, count):
        for _ in range(count):
            self._step()

    def _step(self):
        step = self.interpolator.get_next_step()
        if not self.queued:
            assert step.status == Status.NO_TARGET
        else:
            assert step.status in (Status.OK, Status.NEED_MORE_DATA, Status.FINAL_STEP)
        self.sent = [*self.sent[-3:], step.position]
        for order, (rate, factor) in enumerate(zip(RATES, self.factors, strict=True), 1):
            reached = np.abs(np.diff(self.sent[-order - 1 :], order, axis=0)[-1])
            assert np.all(reached <= factor * (1.0 + ROUNDING) * rate * self.period**order)
        assert np.all(step.position >= LIMITS.lower - 1e-11)
        assert np.all(step.position <= LIMITS.upper + 1e-11)
        for event in step.events:
            self._heed(event, step)

    def _heed(self, event, step):
        target_id, target = self.queued[0]
        assert event.target_id == target_id
        if event.kind is EventKind.MOTION_STOPPED:
            assert step.status == Status.FINAL_STEP
            assert self.stopped or self.cancelled
            if self.cancelled:
                self.queued.clear()
                self.stopped = self.cancelled = False
            return
        self.queued.pop(0)
        if event.kind is EventKind.MOTION_ENDED:
            assert step.status == Status.FINAL_STEP
            assert not self.queued
            np.testing.assert_array_equal(step.position, target)
            self.cancelled = False

    @rule(percent=st.one_of(st.just(0.0), PERCENT))
    def override(self, percent):
        self.factors = tuple(np.maximum(self.factors, (1.0, 1.3, 1.7)))
        assert self.interpolator.set_override_speed(percent) == Status.OK

    @rule()
    def stop(self):
        self.factors = (1.0, 2.0, 3.0)
        assert self.interpolator.stop_motion() == Status.OK
        self.stopped = True

    @rule()
    def go_on(self):
        assert self.interpolator.continue_motion() == Status.OK
        self.stopped = False

    @rule()
    def cancel(self):
        self.factors = (1.0, 2.0, 3.0)
        assert self.interpolator.cancel_motion() == Status.OK
        if self.interpolator.get_current_target_id() is None:  # the arm stood already
            self.queued.clear()
            self.stopped = self.cancelled = False
        else:
            self.cancelled = True

    @rule(on=st.booleans(), percent=st.floats(0.0, 100.0), distance=st.floats(1e-6, 0.5))
    def fly(self, on, percent, distance):
        interpolator = self.interpolator
        assert interpolator.select_flyby_mode(on) == Status.OK
        if percent < 50.0:
            status = interpolator.set_point_accuracy_parameter(FlybyCriterion.DISTANCE, distance)
        else:
            status = interpolator.set_point_accuracy_parameter(FlybyCriterion.PERCENT, percent)
        assert status == Status.OK

    @rule(a=PERCENT, b=PERCENT, c=PERCENT, joint=st.integers(0, 2))
    def rates(self, a, b, c, joint):
        interpolator = self.interpolator
        assert interpolator.set_joint_speeds(a) == Status.OK
        assert interpolator.set_joint_accelerations(b, [joint]) == Status.OK
        assert interpolator.set_joint_jerks(c, [joint]) == Status.OK
        assert interpolator.set_override_speed(c, SpeedCorrection.PROGRAM) == Status.OK
        assert interpolator.set_override_acceleration(a, AccelerationKind.DECELERATION) == 0

    @rule(period=st.sampled_from(PERIODS))
    def change_period(self, period):
        if self.interpolator.set_interpolation_time(period) == Status.OK:
            self.period = period
            self.sent = [self.sent[-1]] * 4  # only an arm at rest lets it change

    @precondition(lambda self: not self.queued)
    @rule()
    def place(self):
        assert self.interpolator.set_initial_position(self.sent[-1]) in (0, -76)

    @invariant()
    def the_current_target_is_the_first_not_told(self):
        expected = self.queued[0][0] if self.queued else None
        assert self.interpolator.get_current_target_id() == expected

    def teardown(self):
        if not hasattr(self, "sent"):
            return
        self.go_on()
        self.override(100.0)
        last = self.queued[-1][1] if self.queued and not self.cancelled else None
        for _ in range(40_000):
            if not self.queued:
                break
            self._step()
        assert not self.queued
        if last is not None:
            np.testing.assert_array_equal(self.sent[-1], last)


class TestAnyServices(AnyServices.TestCase):
    settings = settings(max_examples=25, stateful_step_count=25, deadline=None)


@pytest.mark.slow
class TestManyServices(AnyServices.TestCase):
    settings = settings(max_examples=1000, stateful_step_count=60, deadline=None)
