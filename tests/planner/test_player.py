"""Set-points of a player; overrides, holds and stops checked by the guard."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from drivers.guard import Guard, GuardLimits
from planner import (
    FourierSeries,
    InvalidSetting,
    LimitExceeded,
    StartMismatch,
    TrajectoryPlayer,
    plan,
)
from planner.piecewise_cubic import Block
from planner.player import PathReader
from planner.time_law import ramp, slowing_bounds, within
from tests.planner.six_axes import SIX_AXES, random_points

PERIOD = 0.002


@pytest.fixture(scope="module")
def motions():
    """Some motions at full speed, and one as short as motions get."""
    short = random_points(0, 1) + np.array([[0.0], [1e-4]])
    return [plan(random_points(seed, 4), SIX_AXES) for seed in range(6)] + [plan(short, SIX_AXES)]


def play(player, stop_after=None, extra=5, times=None):
    """Positions and velocities: the first set-point, then one per cycle, some after the end."""
    rows = [(player._last, np.zeros(6))]
    times = [] if times is None else times
    times.append(player.motion_time)
    while not player.finished or extra:
        if len(rows) - 1 == stop_after:
            player.stop()
            stop_after = None
            continue
        extra -= player.finished
        rows.append(player.advance())
        times.append(player.motion_time)
        assert len(rows) < 100_000
    return tuple(np.array(column) for column in zip(*rows, strict=True))


@given(seed=st.integers(0, 10**6))
@settings(max_examples=20)
def test_the_distance_from_the_start_remains(motions, seed):
    offset = np.random.default_rng(seed).uniform(-1e-3, 1e-3, 6)
    reference = TrajectoryPlayer(motions[0], PERIOD, SIX_AXES)
    reference.begin(reference.start)
    player = TrajectoryPlayer(motions[0], PERIOD, SIX_AXES)
    player.begin(player.start + offset)
    exact = play(reference, 300)
    shifted = play(player, 300)
    np.testing.assert_allclose(shifted[0] - exact[0], np.tile(offset, (len(exact[0]), 1)))
    np.testing.assert_array_equal(shifted[1], exact[1])


@pytest.mark.parametrize("away", [1.001e-3, -0.5, np.nan, np.inf])
def test_an_arm_away_from_the_start_is_refused(motions, away):
    player = TrajectoryPlayer(motions[0], PERIOD, SIX_AXES)
    position = player.start.copy()
    position[3] += away
    with pytest.raises(StartMismatch) as refusal:
        player.begin(position)
    assert refusal.value.joint == 3
    assert refusal.value.expected == player.start[3]
    assert refusal.value.tolerance == 1e-3
    with pytest.raises(RuntimeError, match="not begun"):
        player.advance()


@given(which=st.integers(0, 6), share=st.floats(0.0, 1.0), period=st.sampled_from([0.001, 0.002]))
@settings(max_examples=60)
@example(which=0, share=0.0, period=0.002)
@example(which=0, share=1.0, period=0.002)
@example(which=6, share=0.5, period=0.001)
def test_a_stop_stays_on_the_path_and_within_its_bounds(motions, which, share, period):
    motion = motions[which]
    limits = SIX_AXES
    player = TrajectoryPlayer(motion, period, limits)
    offset = np.linspace(-9e-4, 9e-4, 6)
    player.begin(player.start + offset)
    played = int(share * motion.duration / period)
    positions, velocities = play(player, played, extra=10, times=(times := []))

    # As a guard does: differences of consecutive set-points, at rest before and after.
    seen = np.concatenate((np.tile(positions[0], (5, 1)), positions))
    slack = 1 + 1e-5
    for order, bound in (
        (1, limits.velocity),
        (2, 2.0 * limits.acceleration),
        (3, 3.0 * limits.jerk),
    ):
        assert np.all(np.abs(np.diff(seen, order, axis=0)) / period**order <= bound * slack)
    assert np.all(np.abs(velocities) <= limits.velocity * slack)
    # The velocity is the slope of the positions.
    slope = (positions[2:] - positions[:-2]) / (2.0 * period)
    assert np.all(np.abs(slope - velocities[1:-1]) <= 3.0 * limits.jerk * period**2 / 6.0 + 1e-9)

    # At rest after the end.
    assert player.finished
    np.testing.assert_array_equal(positions[-11:], np.tile(positions[-1], (11, 1)))
    assert not np.any(velocities[-11:])

    # On the path, at times that do not decrease.
    q = motion.sample(np.array(times))[0] + offset
    assert np.all(np.diff(times) >= 0.0)
    np.testing.assert_allclose(positions[1 + played :], q[1 + played :], rtol=0, atol=1e-12)


def test_a_start_that_moves_the_motion_out_of_range_is_refused():
    upper = SIX_AXES.upper
    points = np.array([np.zeros(6), upper, np.zeros(6)])
    motion = plan(points, SIX_AXES, fly=0.0)
    player = TrajectoryPlayer(motion, 0.002, SIX_AXES)
    player.begin(player.start)
    beside = np.zeros(6)
    beside[2] = 9e-4
    with pytest.raises(LimitExceeded, match="position of joint 2"):
        player.begin(beside)
    player.begin(-beside)  # away from the end of the range
    reached = [player.advance()[0] for _ in range(4000)]
    assert player.finished
    assert np.max(np.array(reached) - upper) <= 1e-12


def begun(motion, cycles):
    """A player after some cycles, and its last two set-points."""
    player = TrajectoryPlayer(motion, PERIOD, SIX_AXES)
    player.begin(player.start)
    before, last = [player.advance()[0] for _ in range(cycles)][-2:]
    return player, before, last


class TestResumeFrom:
    """The controller extrapolated the motion by `k` steps as long as the last one, or to rest."""

    @pytest.fixture
    def extrapolated(self, motions):
        # 0.7 of the motion, where the arm moves fast
        player, before, last = begun(motions[2], int(0.7 * motions[2].duration / PERIOD))
        return player, last, last - before

    @pytest.mark.parametrize("k", [0, 1, 3, 5])
    def test_it_stops_on_its_path_within_the_bounds(self, extrapolated, motions, k):
        player, last, step = extrapolated
        player.resume_from(last + k * step, step / PERIOD, 2 * k)
        player.stop()
        given = [last + (k - 1) * step, last + k * step]
        while not player.finished:
            given.append(player.advance()[0])
        acceleration = np.diff(given, 2, axis=0) / PERIOD**2
        assert np.all(np.abs(acceleration) <= 2.0 * SIX_AXES.acceleration * (1 + 1e-6))
        planned = motions[2].sample(np.arange(0.0, player.duration, 1e-4))[0]
        assert cKDTree(planned).query(given)[0].max() < 2e-3

    @pytest.mark.parametrize("k", [3, 5])
    def test_a_stop_with_gaps_takes_at_most_twice_as_many_set_points(self, k):
        """Else a stop has no effect on a link on which every fourth packet is answered."""
        cruise = replace(SIX_AXES, velocity=np.full(6, 0.5))
        line = plan([np.zeros(6), np.full(6, 1.8)], cruise)

        def set_points_to_rest(gaps):
            player, before, last = begun(line, int(0.2 / PERIOD))
            player.stop()
            count = 0
            while not player.finished:
                if gaps:
                    step = last - before
                    last = last + k * step
                    player.resume_from(last, step / PERIOD, 2 * k)
                before = last
                last = player.advance()[0]
                count += 1
            return count

        assert set_points_to_rest(True) <= 2 * set_points_to_rest(False)

    def test_many_gaps_stay_within_twice_the_tolerance(self, motions):
        """A controller that shifts it by 0.4 mrad at each gap is not followed without limit."""
        player, before, last = begun(motions[2], int(0.3 * motions[2].duration / PERIOD))
        aside = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 4e-4])
        with pytest.raises(StartMismatch, match=r"tolerance is 0\.002 rad"):
            for _ in range(30):
                player.resume_from(last + aside, (last - before) / PERIOD, 2)
                before = last + aside
                last = player.advance()[0]

    @pytest.mark.parametrize("left", [18, 22, 26, 30])
    def test_near_the_end_it_comes_to_rest_within_bounds(self, left):
        """There the path slows down to rest, and has no direction."""
        points = random_points(0, 4)
        closed = plan([*points, points[0]], SIX_AXES)
        player, before, last = begun(closed, round(closed.duration / PERIOD) - left)
        step = last - before
        guard = Arm(closed, SIX_AXES).guard
        for resumable in (guard, player):
            resumable.resume_from(last + 8 * step, step / PERIOD, 15)
        assert player.motion_time > 0.5 * closed.duration
        player.stop()
        for cycle in range(100):
            guard.check_set_point(*player.advance(), player.bounds, cycle)
        assert player.finished

    def test_brought_to_rest_it_stays_there(self, extrapolated):
        player, last, step = extrapolated
        player.resume_from(last + step, 0.0 * step, 2)
        player.stop()
        position, velocity = player.advance()
        assert player.finished
        np.testing.assert_array_equal(position, last + step)
        assert not velocity.any()

    @pytest.mark.parametrize("share", [0.0, 0.3, 0.9])
    def test_a_stop_continues_at_a_slower_speed_given(self, extrapolated, share):
        """From the same set-point, or near it; at no speed it stays there."""
        player, _, _ = extrapolated
        player.stop()
        first, velocity = player.advance()
        player.resume_from(first, share * velocity, 0)
        before = np.linalg.norm(velocity)
        assert player.rate <= share
        while not player.finished:
            _, velocity = player.advance()
            assert np.linalg.norm(velocity) <= 1.001 * share * before

    def test_away_from_its_path_it_is_refused(self, extrapolated):
        player, last, step = extrapolated
        with pytest.raises(StartMismatch, match="the motion at"):
            player.resume_from(last + 3 * step + 2e-3, step / PERIOD, 6)


class TestPathReader:
    """Evaluation at one motion time, as in each cycle."""

    @pytest.mark.parametrize("which", range(6))
    def test_it_agrees_with_samples_of_cubics(self, motions, which):
        """Also at every knot of every joint."""
        motion = motions[which]
        reader = PathReader(motion)
        times = [*np.linspace(0.0, motion.duration, 99), *np.concatenate(motion.knots)]
        for s in times:
            for near in (np.nextafter(s, 0.0), s, min(np.nextafter(s, np.inf), motion.duration)):
                q, qd, _ = motion.sample_one(float(near))
                position, velocity = reader.read(float(near))
                np.testing.assert_allclose(position, q, rtol=0, atol=1e-13)
                np.testing.assert_allclose(velocity, qd, rtol=0, atol=1e-12)

    @given(
        seed=st.integers(0, 99),
        share=st.floats(0.0, 1.0),
        ramp=st.sampled_from([0.0, 1e-3, 1.5, 4.0]),
    )
    def test_it_agrees_with_samples_of_sines(self, seed, share, ramp):
        random = np.random.default_rng(seed)
        series = FourierSeries(
            offset=random.uniform(-1.0, 1.0, 6),
            amplitude=random.uniform(-1.0, 1.0, (6, 3)),
            frequency=random.uniform(0.3, 4.0, (6, 3)),
            length=8.0,
            ramp=ramp,
        )
        s = share * series.duration
        position, velocity = PathReader(series).read(s)
        q, qd, _ = series.sample_one(s)
        np.testing.assert_allclose(position, q, rtol=0, atol=1e-13)
        # A slope of rounding in u is one of rounding / ramp in time.
        np.testing.assert_allclose(velocity, qd, rtol=0, atol=1e-12 / min(ramp or 1.0, 1.0))


class Smooth:
    """A motion from rest to rest of another kind: a polynomial of degree 7."""

    n_joints = 6

    def __init__(self, start, way, duration):
        self.start = start
        self.way = way
        self.duration = duration

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
    """Every joint at its limits of jerk, acceleration and velocity, forth and back."""
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
    """A list whose many numbers a failing test does not print."""

    def __repr__(self):
        return "the live_motions"


@pytest.fixture(scope="module")
def live_motions():
    """Fast and slow, long and microscopic, of cubics and not, at the limits and below."""
    limits = SIX_AXES
    short = random_points(0, 1) + np.array([[0.0], [1e-4]])
    middle = (limits.lower + limits.upper) / 2

    def near(seed, count):
        return middle + 0.2 * (random_points(seed, count) - middle)

    made = [
        *(plan(near(seed, 4), limits, fly=1.0) for seed in range(4)),
        plan(near(7, 3), limits, speed=0.3),
        plan(short, limits),
        all_at_their_limits(limits),
        Smooth(middle, 0.3 * limits.velocity, 1.4),
        plan(np.tile(short[0], (2, 1)), limits),
    ]
    return Motions(made)


class Arm:
    """Sends the set-points of a player through the guard, within the bounds requested so far."""

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
        self.bounds = []
        self.rates = []
        self.times = []
        self.positions = []

    def begin(self):
        first = self.player.start + self.offset
        self.player.begin(first)
        self.guard.begin(first, 0)
        return self

    def run(self, cycles):
        """Send some set-points, or fewer if the motion ends."""
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
        """Send some set-points after the end."""
        for _ in range(5):
            position, velocity = self.player.advance()
            self.guard.check_set_point(position, velocity, self.player.bounds, len(self.times))
            assert not np.any(velocity)

    def off_the_path(self):
        """Largest distance of a set-point from the path; motion time does not decrease."""
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
    end=st.sampled_from(["stop", "resume"]),
    before=st.none() | fractions,
)
@pytest.mark.safety
@settings(max_examples=400)
@example(
    0, 0.002, [(300, ("hold", 0.0)), (40, ("resume", 0.0)), (20, ("override", 0.3))], "stop", None
)
@example(
    6, 0.001, [(450, ("override", 0.0)), (1, ("hold", 0.0)), (9, ("resume", 0.0))], "stop", None
)
@example(
    6, 0.001, [(1, ("hold", 0.0)), (0, ("override", 0.2)), (0, ("resume", 0.0))], "stop", 5e-288
)
def test_no_sequence_of_requests_is_refused_by_the_guard(
    live_motions, which, period, script, end, before
):
    arm = Arm(live_motions[which], SIX_AXES, period, offset=np.linspace(-9e-4, 9e-4, 6))
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


def test_bounds_are_those_that_each_set_point_satisfies(live_motions):
    arm = Arm(live_motions[0], SIX_AXES).begin().run(300)
    assert set(arm.bounds) == {"plan"}
    allowed = slowing_bounds(SIX_AXES, 1.3, 1.7, live_motions[0].extrema())
    stopping = slowing_bounds(SIX_AXES, 2.0, 3.0, live_motions[0].extrema())
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


def test_nothing_resumes_after_a_stop(live_motions):
    arm = Arm(live_motions[1], SIX_AXES).begin().run(500).ask("hold").run(20).ask("stop")
    arm.ask("resume").ask("override", 1.0).ask("hold").ask("resume").run(1000)
    assert arm.player.finished
    assert arm.player.rate == 0.0
    arm.rest()


@pytest.mark.parametrize("fraction", [0.0, 0.3])
def test_a_rate_at_the_start_applies_at_once(live_motions, fraction):
    arm = Arm(live_motions[0], SIX_AXES).begin().ask("override", fraction).run(100)
    assert set(arm.bounds) == {"plan"}
    np.testing.assert_allclose(arm.times, fraction * PERIOD * np.arange(1, 101), atol=1e-15)
    held = Arm(live_motions[0], SIX_AXES).begin().ask("hold").run(100)
    assert set(held.times) == {0.0}
    held.ask("override", fraction).ask("resume").run(100)
    np.testing.assert_array_equal(held.times[100:], arm.times)


@pytest.mark.parametrize("paused_by", ["hold", "stop"])
def test_begin_clears_a_hold_or_stop_and_keeps_an_override(live_motions, paused_by):
    arm = Arm(live_motions[0], SIX_AXES).begin().run(300).ask("override", 0.5)
    arm.ask(paused_by).run(500)
    assert arm.player.finished is (paused_by == "stop")
    arm.begin()
    assert arm.player.rate == 0.5
    arm.ask("override", 1.0)
    times = len(arm.times)
    arm.run(10)
    np.testing.assert_allclose(arm.times[times:], PERIOD * np.arange(1, 11))


@pytest.mark.parametrize("fraction", [-1e-9, 1.0 + 1e-9, np.nan])
def test_an_override_out_of_range_changes_nothing(live_motions, fraction):
    arm = Arm(live_motions[0], SIX_AXES).begin().run(300)
    with pytest.raises(InvalidSetting, match="override"):
        arm.player.override(fraction)
    arm.run(100)
    assert arm.player.rate == 1.0


def test_a_motion_that_ends_during_a_hold_has_ended(live_motions):
    cycles = int(live_motions[1].duration / PERIOD)
    arm = Arm(live_motions[1], SIX_AXES).begin().run(cycles - 10).ask("hold").run(1000)
    assert arm.player.finished
    rate = arm.player.rate
    bounds = arm.player.bounds
    assert rate > 0.0  # of motion time after the end
    for request in ("resume", "hold", "stop"):
        arm.ask(request)
        assert (arm.player.rate, arm.player.bounds) == (rate, bounds)
    arm.rest()


# -- motions that grow ----------------------------------------------------------------------


def test_an_extended_motion_goes_on_without_a_jump():
    points = random_points(3, 3)
    plans = [plan(points[:2], SIX_AXES, fly=0.0), plan(points, SIX_AXES, fly=0.0)]
    player = TrajectoryPlayer(plans[0], PERIOD, SIX_AXES, extendable=True)
    player.begin(player.start)
    player.override(0.5)
    rows = [player.advance()[0] for _ in range(200)]
    player.extend(plans[1])
    player.override(1.0)
    assert player.duration == plans[1].duration
    while not player.finished:
        rows.append(player.advance()[0])
    whole = TrajectoryPlayer(plans[1], PERIOD, SIX_AXES, extendable=True)
    whole.begin(whole.start)
    whole.override(0.5)
    expected = [whole.advance()[0] for _ in range(200)]
    whole.override(1.0)
    while not whole.finished:
        expected.append(whole.advance()[0])
    np.testing.assert_allclose(rows, expected, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(rows[-1], plans[1].sample(np.array([plans[1].duration]))[0][0])


def test_only_a_running_motion_planned_to_grow_is_extended(motions):
    fixed = TrajectoryPlayer(motions[0], PERIOD, SIX_AXES)
    fixed.begin(fixed.start)
    with pytest.raises(RuntimeError, match="extend"):
        fixed.extend(motions[0])
    growing = TrajectoryPlayer(motions[0], PERIOD, SIX_AXES, extendable=True)
    growing.begin(growing.start)
    play(growing)
    with pytest.raises(RuntimeError, match="not finished"):
        growing.extend(motions[0])


def test_an_extended_motion_is_not_begun_again(motions):
    player = TrajectoryPlayer(motions[0], PERIOD, SIX_AXES, extendable=True)
    player.begin(player.start)
    player.extend(motions[0])
    with pytest.raises(RuntimeError, match="begun again"):
        player.begin(player.start)


def test_bounds_of_a_growing_motion_are_those_of_the_limits(motions):
    """A slow start must not admit a fast change of rate, which the rest could not follow."""
    slow = plan(random_points(3, 2), SIX_AXES, speed=0.05)
    player = TrajectoryPlayer(slow, PERIOD, SIX_AXES, extendable=True)
    player.begin(player.start)
    for _ in range(100):
        player.advance()
    player.hold()
    cycles = 0
    while player.rate > 0.0:
        player.advance()
        cycles += 1
    bounds = slowing_bounds(SIX_AXES, 2.0, 3.0)
    assert cycles == np.ceil(ramp(1.0, 0.0, 0.0, bounds).duration / PERIOD)
