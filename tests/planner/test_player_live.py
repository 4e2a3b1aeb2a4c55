"""Overrides, holds and stops in the middle of a motion, as the arm's guard sees them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from drivers.execution import MotionExecution
from drivers.guard import Guard, GuardLimits
from planner import InvalidSetting, TrajectoryPlayer, plan
from planner.piecewise_cubic import Block
from planner.time_law import ramp, slowing_bounds, within

PERIOD = 0.002


class Smooth:
    """A motion from rest to rest that is no table of cubics: a polynomial of degree 7."""

    n_joints = 6

    def __init__(self, start, way, duration):
        self.start, self.way, self.duration = start, way, duration

    def sample(self, t):
        x = (np.clip(t, 0.0, self.duration) / self.duration)[:, None]
        q = x**4 * (35 - 84 * x + 70 * x**2 - 20 * x**3)
        qd = 140 * x**3 * (1 - x) ** 3
        qdd = 420 * x**2 * (1 - x) ** 2 * (1 - 2 * x)
        return (
            self.start + self.way * q,
            self.way * qd / self.duration,
            self.way * qdd / self.duration**2,
        )


def all_at_their_limits(limits):
    """Every joint at its limits of jerk, acceleration and velocity, there and back."""
    rise = limits.acceleration / limits.jerk
    flat = limits.velocity / limits.acceleration - rise
    lengths = [rise, flat, rise, np.full(6, 0.1), rise, flat, rise]
    lengths = np.stack(lengths + lengths, axis=1)
    signs = np.array([1, 0, -1, 0, -1, 0, 1])
    knots = np.concatenate((np.zeros((6, 1)), np.cumsum(lengths, axis=1)), axis=1)
    start = np.zeros((6, 3))
    half_way = limits.velocity * (2.0 * rise + flat + 0.1) / 2.0
    start[:, 0] = (limits.lower + limits.upper) / 2 - half_way
    jerks = limits.jerk[:, None] * np.concatenate((signs, -signs))
    (motion,) = Block.from_jerks(start[None], knots[None], jerks[None]).tables()
    return motion


class Motions(list):
    """So many numbers that a failing test should not print them."""

    def __repr__(self):
        return "the motions"


@pytest.fixture(scope="module")
def motions(six_axis_limits, random_points):
    """Fast and slow, long and microscopic, of cubics and not, at the very limits and below."""
    limits = six_axis_limits
    short = random_points(0, 1) + np.array([[0.0], [1e-4]])
    middle = (limits.lower + limits.upper) / 2

    def near(seed, count):
        return middle + 0.2 * (random_points(seed, count) - middle)

    motions = [
        *(plan(near(seed, 4), limits, fly=1.0) for seed in range(4)),
        plan(near(7, 3), limits, speed=0.3),
        plan(short, limits),
        all_at_their_limits(limits),
        Smooth(middle, 0.3 * limits.velocity, 1.4),
        plan(np.tile(short[0], (2, 1)), limits),
    ]
    return Motions(motions)


class Arm:
    """Sends what a player gives, as the session would: within what was granted, past the guard."""

    def __init__(self, motion, limits, period=PERIOD, offset=0.0):
        bounds = GuardLimits(
            *(getattr(limits, name) + 1e-3 * side for name, side in (("lower", -1), ("upper", 1))),
            limits.velocity,
            limits.acceleration,
            limits.jerk,
            following_error=np.ones(6),
            current=np.ones(6),
        )
        self.motion = motion
        self.offset = offset
        self.player = TrajectoryPlayer(motion, period, limits)
        self.guard = Guard(bounds, period)
        self.granted = {"plan"}
        self.bounds, self.rates, self.times, self.positions = [], [], [], []

    def begin(self):
        first = self.player.start + self.offset
        self.player.begin(first)
        self.guard.begin(first, np.zeros(6), np.zeros(6), np.zeros((2, 6)), 0)
        return self

    def run(self, cycles):
        """Take set-points until there are so many, or the motion ends."""
        for _ in range(cycles):
            if self.player.finished:
                return self
            position, velocity = self.player.advance()
            bounds = self.player.bounds
            assert bounds in self.granted
            self.guard.check_set_point(position, velocity, bounds, len(self.times))
            self.positions.append(position)
            self.bounds.append(bounds)
            self.rates.append(self.player.rate)
            self.times.append(self.player.motion_time)
        return self

    def ask(self, what, fraction=0.0):
        if what == "override":
            self.player.override(fraction)
            self.granted.add("override")
        else:
            getattr(self.player, what)()
            if what != "resume":
                self.granted.add("stop")
        return self

    def rest(self):
        """Whatever happens after the end."""
        for _ in range(5):
            position, velocity = self.player.advance()
            self.guard.check_set_point(position, velocity, self.player.bounds, len(self.times))
            assert not np.any(velocity)

    def off_the_path(self):
        """Largest distance of any set-point to the path, which it runs along forwards."""
        times = np.array(self.times)
        assert np.all(np.diff(times) >= 0.0)
        q = self.motion.sample(times)[0] + self.offset
        return np.max(np.abs(np.array(self.positions) - q))


fractions = st.one_of(st.sampled_from([0.0, 0.2, 1.0]), st.floats(0.0, 1.0))
requests = st.one_of(
    st.tuples(st.just("override"), fractions),
    st.sampled_from([("hold", 0.0), ("resume", 0.0)]),
)
waits = st.one_of(st.integers(0, 5), st.integers(0, 400))


@given(
    which=st.integers(0, 8),
    period=st.sampled_from([0.001, 0.002]),
    script=st.lists(st.tuples(waits, requests), min_size=1, max_size=12),
    end=st.sampled_from(["stop", "cancel", "resume"]),
    before=st.none() | fractions,
)
@settings(max_examples=400)
@example(
    0, 0.002, [(300, ("hold", 0.0)), (40, ("resume", 0.0)), (20, ("override", 0.3))], "stop", None
)
@example(
    6, 0.001, [(450, ("override", 0.0)), (1, ("hold", 0.0)), (9, ("resume", 0.0))], "cancel", None
)
@example(
    6, 0.001, [(1, ("hold", 0.0)), (0, ("override", 0.2)), (0, ("resume", 0.0))], "stop", 5e-288
)
def test_nothing_that_can_be_asked_for_is_refused_by_the_guard(
    motions, six_axis_limits, which, period, script, end, before
):
    arm = Arm(motions[which], six_axis_limits, period, offset=np.linspace(-9e-4, 9e-4, 6))
    if before is not None:
        arm.ask("override", before)
    arm.begin()
    for wait, request in script:
        arm.run(wait).ask(*request)
        assert -1e-12 <= arm.player.rate <= 1.0 + 1e-12
    arm.run(50)
    if end != "resume":
        arm.ask(end).run(4000)
    else:
        arm.ask("resume").ask("override", 1.0).run(int(20.0 / period))
    assert arm.player.finished
    arm.rest()
    if arm.times:
        assert arm.off_the_path() <= 1e-9
        assert max(arm.rates) <= 1.0 + 1e-12
        assert min(arm.rates) >= -1e-12
    if end != "resume" and (not arm.times or arm.times[-1] < arm.motion.duration):
        assert arm.player.rate == 0.0


def test_bounds_say_what_each_set_point_keeps(motions, six_axis_limits):
    arm = Arm(motions[0], six_axis_limits).begin().run(300)
    assert set(arm.bounds) == {"plan"}
    allowed = slowing_bounds(six_axis_limits, 1.3, 1.7, motions[0].extrema())
    stopping = slowing_bounds(six_axis_limits, 2.0, 3.0, motions[0].extrema())
    slower = ramp(1.0, 0.0, 0.5, within(allowed, stopping))
    arm.ask("override", 0.5).run(1000)
    changing = int(np.ceil(slower.duration / PERIOD))
    assert arm.bounds[300 : 300 + changing] == ["override"] * changing
    assert set(arm.bounds[300 + changing :]) == {"plan"}
    for request, way in (
        ("hold", ramp(0.5, 0.0, 0.0, stopping)),
        ("resume", ramp(0.0, 0.0, 0.5, stopping)),
        ("stop", ramp(0.5, 0.0, 0.0, stopping)),
    ):
        seen = len(arm.bounds)
        arm.ask(request).run(300)
        changing = int(np.ceil(way.duration / PERIOD))
        assert arm.bounds[seen : seen + changing] == ["stop"] * changing
        assert set(arm.bounds[seen + changing :]) <= {"plan"}
    assert arm.player.finished
    assert arm.player.bounds == "stop"


def test_an_override_asked_for_while_resuming_keeps_the_wider_bounds_only_where_it_must(
    motions, six_axis_limits
):
    gentle = Arm(motions[0], six_axis_limits).begin().run(300).ask("hold").run(500).ask("resume")
    gentle.run(3).ask("override", 0.4).run(1000)
    assert gentle.bounds[-1] == "plan"
    assert gentle.bounds[803] == "override"  # hardly gathering speed yet
    steep = Arm(motions[0], six_axis_limits).begin().run(300).ask("hold").run(500).ask("resume")
    steep.run(80).ask("override", 0.4).run(1000)
    assert steep.bounds[880] == "stop"
    assert steep.player.rate == gentle.player.rate == 0.4


def test_a_hold_waits_until_it_is_resumed(motions, six_axis_limits):
    arm = Arm(motions[1], six_axis_limits).begin().run(500).ask("hold").run(1000)
    assert not arm.player.finished
    assert arm.player.rate == 0.0
    np.testing.assert_array_equal(arm.positions[-700:], np.tile(arm.positions[-1], (700, 1)))
    where = arm.player.motion_time
    arm.ask("hold").ask("override", 0.5).run(100)
    assert arm.player.motion_time == where
    arm.ask("resume").run(300)
    assert arm.player.rate == 0.5
    arm.ask("resume").run(10)
    assert arm.player.rate == 0.5
    arm.ask("hold").run(20).ask("resume").run(500)  # in the middle of slowing down
    assert arm.player.rate == 0.5


def test_nothing_resumes_after_a_stop(motions, six_axis_limits):
    for end in ("stop", "cancel"):
        arm = Arm(motions[1], six_axis_limits).begin().run(500).ask("hold").run(20).ask(end)
        arm.ask("resume").ask("override", 1.0).ask("hold").ask("resume").run(1000)
        assert arm.player.finished
        assert arm.player.rate == 0.0
        arm.rest()


@pytest.mark.parametrize("fraction", [0.0, 0.3])
def test_at_rest_at_the_start_a_rate_is_taken_up_at_once(motions, six_axis_limits, fraction):
    arm = Arm(motions[0], six_axis_limits).begin().ask("override", fraction).run(100)
    assert set(arm.bounds) == {"plan"}
    np.testing.assert_allclose(arm.times, fraction * PERIOD * np.arange(1, 101), atol=1e-15)
    held = Arm(motions[0], six_axis_limits).begin().ask("hold").run(100)
    assert set(held.times) == {0.0}
    held.ask("override", fraction).ask("resume").run(100)
    np.testing.assert_array_equal(held.times[100:], arm.times)


def test_an_override_lasts_from_one_beginning_to_the_next_and_a_hold_does_not(
    motions, six_axis_limits
):
    arm = Arm(motions[0], six_axis_limits).begin().run(300).ask("override", 0.5).ask("hold").run(9)
    arm.begin()
    assert arm.player.rate == 0.5
    arm.ask("override", 1.0)
    times = len(arm.times)
    arm.run(10)
    np.testing.assert_allclose(arm.times[times:], PERIOD * np.arange(1, 11))


@pytest.mark.parametrize("fraction", [-1e-9, 1.0 + 1e-9, np.nan, np.inf])
def test_a_fraction_that_is_none_is_refused_and_changes_nothing(motions, six_axis_limits, fraction):
    arm = Arm(motions[0], six_axis_limits).begin().run(300)
    with pytest.raises(InvalidSetting, match="override"):
        arm.player.override(fraction)
    arm.run(100)
    assert arm.player.rate == 1.0


def test_the_session_may_override_and_stop_it(motions, six_axis_limits):
    player = TrajectoryPlayer(motions[0], PERIOD, six_axis_limits)
    stop_cycles = int(0.5 / PERIOD)
    execution = MotionExecution(player, 6, settle_cycles=3, stop_cycles=stop_cycles)
    assert execution.override(0.9) is None  # before it begins, as after
    execution.begin(player.start, 0)
    bounds = [execution.advance(cycle)[2] for cycle in range(200)]
    assert execution.override(0.1) is None
    bounds += [execution.advance(cycle)[2] for cycle in range(200, 300)]
    execution.stop("enough", 300)
    bounds += [execution.advance(cycle)[2] for cycle in range(300, 300 + stop_cycles)]
    assert bounds == ["plan"] * 200 + ["override"] * 100 + ["stop"] * stop_cycles
    assert execution.settled
    assert execution.override(1.5) is not None


def test_a_motion_that_ends_in_the_middle_of_a_hold_is_over(motions, six_axis_limits):
    cycles = int(motions[1].duration / PERIOD)
    arm = Arm(motions[1], six_axis_limits).begin().run(cycles - 10).ask("hold").run(1000)
    assert arm.player.finished
    rate, bounds = arm.player.rate, arm.player.bounds
    assert rate > 0.0  # of a time that moves nothing any more
    for request in ("resume", "hold", "stop"):
        arm.ask(request)
        assert (arm.player.rate, arm.player.bounds) == (rate, bounds)
    arm.rest()
