from __future__ import annotations

import os
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from drivers.exchange.motion_transfer import pack, unpack
from planner import (
    FourierSeries,
    InvalidSetting,
    JointLimits,
    LimitExceeded,
    NotBegun,
    StartMismatch,
    TrajectoryPlayer,
    plan,
)
from planner.player import PathReader

PERIOD = 0.002


@pytest.fixture(scope="module")
def motions(six_axis_limits, random_points):
    """Some motions at full speed, and one as short as motions get."""
    short = random_points(0, 1) + np.array([[0.0], [1e-4]])
    return [plan(random_points(seed, 4), six_axis_limits) for seed in range(6)] + [
        plan(short, six_axis_limits)
    ]


def play(player, stop_after=None, extra=5, times=None):
    """Everything a link would see: the first set-point, then one per cycle."""
    positions, velocities = [player._last], [np.zeros(6)]
    times = [] if times is None else times
    times.append(player.motion_time)
    while not player.finished:
        if len(positions) - 1 == stop_after:
            player.stop()
            stop_after = None
            continue
        position, velocity = player.advance()
        positions.append(position)
        velocities.append(velocity)
        times.append(player.motion_time)
        assert len(positions) < 100_000
    for _ in range(extra):
        position, velocity = player.advance()
        positions.append(position)
        velocities.append(velocity)
        times.append(player.motion_time)
    return np.array(positions), np.array(velocities)


@given(seed=st.integers(0, 10**6))
@settings(max_examples=20)
def test_what_separates_the_arm_from_the_start_is_carried_unchanged(motions, six_axis_limits, seed):
    offset = np.random.default_rng(seed).uniform(-1e-3, 1e-3, 6)
    reference = TrajectoryPlayer(motions[0], PERIOD, six_axis_limits)
    reference.begin(reference.start)
    player = TrajectoryPlayer(motions[0], PERIOD, six_axis_limits)
    player.begin(player.start + offset)
    exact, shifted = play(reference, 300), play(player, 300)
    np.testing.assert_allclose(shifted[0] - exact[0], np.tile(offset, (len(exact[0]), 1)))
    np.testing.assert_array_equal(shifted[1], exact[1])


@pytest.mark.parametrize("away", [1.001e-3, -0.5, np.nan, np.inf])
def test_an_arm_that_is_elsewhere_is_refused(motions, six_axis_limits, away):
    player = TrajectoryPlayer(motions[0], PERIOD, six_axis_limits)
    position = player.start.copy()
    position[3] += away
    with pytest.raises(StartMismatch) as refusal:
        player.begin(position)
    assert refusal.value.joint == 3
    assert refusal.value.expected == player.start[3]
    assert refusal.value.tolerance == 1e-3
    with pytest.raises(NotBegun):
        player.advance()


@given(which=st.integers(0, 6), share=st.floats(0.0, 1.0), period=st.sampled_from([0.001, 0.002]))
@settings(max_examples=60)
@example(which=0, share=0.0, period=0.002)
@example(which=0, share=1.0, period=0.002)
@example(which=6, share=0.5, period=0.001)
def test_a_stop_at_any_instant_stays_on_the_path_and_within_the_stop_bounds(
    motions, six_axis_limits, which, share, period
):
    motion, limits = motions[which], six_axis_limits
    player = TrajectoryPlayer(motion, period, limits)
    offset = np.linspace(-9e-4, 9e-4, 6)
    player.begin(player.start + offset)
    played = int(share * motion.duration / period)
    positions, velocities = play(player, played, extra=10, times=(times := []))

    # Exactly what a guard sees: differences of consecutive set-points, at rest before and after.
    seen = np.concatenate((np.tile(positions[0], (5, 1)), positions))
    slack = 1 + 1e-5
    for order, bound in (
        (1, limits.velocity),
        (2, 2.0 * limits.acceleration),
        (3, 3.0 * limits.jerk),
    ):
        assert np.all(np.abs(np.diff(seen, order, axis=0)) / period**order <= bound * slack)
    assert np.all(np.abs(velocities) <= limits.velocity * slack)
    # What is sent as velocity is the slope of what is sent as position.
    slope = (positions[2:] - positions[:-2]) / (2.0 * period)
    assert np.all(np.abs(slope - velocities[1:-1]) <= 3.0 * limits.jerk * period**2 / 6.0 + 1e-9)

    # At rest in the end, and for as long as anyone asks.
    assert player.finished
    np.testing.assert_array_equal(positions[-11:], np.tile(positions[-1], (11, 1)))
    assert not np.any(velocities[-11:])

    # On the path, which is what it was at some time that only moves on.
    q = motion.sample(np.array(times))[0] + offset
    assert np.all(np.diff(times) >= 0.0)
    np.testing.assert_allclose(positions[1 + played :], q[1 + played :], rtol=0, atol=1e-12)


def test_a_stop_before_the_first_step_keeps_the_arm_where_it_is(motions, six_axis_limits):
    player = TrajectoryPlayer(motions[1], PERIOD, six_axis_limits)
    player.begin(player.start + 5e-4)
    player.stop()
    assert player.finished
    position, velocity = player.advance()
    np.testing.assert_array_equal(position, player.start + 5e-4)
    assert not np.any(velocity)


def test_beginning_again_plays_the_whole_motion_again(motions, six_axis_limits):
    player = TrajectoryPlayer(motions[2], PERIOD, six_axis_limits)
    player.begin(player.start)
    first = play(player)[0]
    player.begin(player.start)
    interrupted = play(player, 100)[0]
    player.begin(player.start)
    assert player.bounds == "plan"
    np.testing.assert_array_equal(play(player)[0], first)
    assert len(interrupted) < len(first)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("period", 0.0),
        ("period", np.inf),
        ("period", np.nan),
        ("override_acceleration", 1.0),
        ("override_jerk", np.nan),
        ("stop_acceleration", 1.0),
        ("stop_jerk", 0.9),
        ("start_tolerance", -1e-3),
    ],
)
def test_settings_outside_their_range_are_refused(motions, six_axis_limits, name, value):
    settings = {"period": PERIOD, name: value}
    with pytest.raises(InvalidSetting) as refusal:
        TrajectoryPlayer(motions[0], limits=six_axis_limits, **settings)
    assert refusal.value.name == name


@pytest.mark.parametrize("quantity", ["acceleration", "jerk"])
def test_a_stop_must_not_be_gentler_than_an_override(motions, six_axis_limits, quantity):
    settings = {f"override_{quantity}": 4.0, f"stop_{quantity}": 3.9}
    with pytest.raises(InvalidSetting, match=f"stop_{quantity} = 3.9 .* override_{quantity}"):
        TrajectoryPlayer(motions[0], PERIOD, six_axis_limits, **settings)


def test_limits_of_another_arm_are_refused(motions):
    limits = JointLimits([-1.0], [1.0], [1.0], [1.0], [1.0])
    with pytest.raises(InvalidSetting, match="joints"):
        TrajectoryPlayer(motions[0], PERIOD, limits)


@pytest.mark.parametrize("moved", [False, True])
def test_it_goes_on_the_same_in_another_process_which_cannot_write_to_its_tables(
    motions, six_axis_limits, moved
):
    player = TrajectoryPlayer(motions[0], PERIOD, six_axis_limits)
    if moved:
        player.begin(player.start)
        for _ in range(200):
            player.advance()
        player.override(0.4)
        player.advance()
    descriptor = pack(player)
    try:
        copy = unpack(descriptor)
    finally:
        os.close(descriptor)
    runs = []
    for each in (player, copy):
        if not moved:
            each.begin(each.start)
        given = [each.advance() for _ in range(100)]
        each.hold()
        given += [each.advance() for _ in range(30)]
        each.resume()
        each.override(0.7)
        given += [each.advance() for _ in range(300)]
        each.stop()
        while not each.finished:
            given.append(each.advance())
        runs.append(given)
    np.testing.assert_array_equal(*runs)
    # Tables and cubics are mapped; what is copied of them would be read from the pickle.
    assert not copy._table.position.flags.writeable
    assert not copy._path._pieces.flags.writeable


def test_a_start_that_would_carry_the_motion_out_of_its_range_is_refused(six_axis_limits):
    upper = six_axis_limits.upper
    points = np.array([np.zeros(6), upper, np.zeros(6)])
    motion = plan(points, six_axis_limits, fly=0.0)
    player = TrajectoryPlayer(motion, 0.002, six_axis_limits)
    player.begin(player.start)
    beside = np.zeros(6)
    beside[2] = 9e-4
    with pytest.raises(LimitExceeded, match="position of joint 2"):
        player.begin(beside)
    player.begin(-beside)  # away from the end of the range
    reached = [player.advance()[0] for _ in range(4000)]
    assert player.finished
    assert np.max(np.array(reached) - upper) <= 1e-12


class TestCarriedOn:
    """A controller took the motion on by itself: `k` steps as long as the last one, or to rest."""

    LONG = 0.7  # of the motion, in which the arm moves fast

    @pytest.fixture
    def carried(self, motions, six_axis_limits):
        player = TrajectoryPlayer(motions[2], PERIOD, six_axis_limits)
        player.begin(player.start)
        given = [player.advance()[0] for _ in range(int(self.LONG * player.duration / PERIOD))]
        return player, given[-1], given[-1] - given[-2]

    @pytest.mark.parametrize("k", [0, 1, 3, 5])
    def test_it_stops_on_its_path_within_the_bounds(self, carried, six_axis_limits, motions, k):
        player, last, step = carried
        player.go_on_from(last + k * step, step / PERIOD, 2 * k)
        player.stop()
        given = [last + (k - 1) * step, last + k * step]
        while not player.finished:
            given.append(player.advance()[0])
        acceleration = np.diff(given, 2, axis=0) / PERIOD**2
        assert np.all(np.abs(acceleration) <= 2.0 * six_axis_limits.acceleration * (1 + 1e-6))
        planned = motions[2].sample(np.arange(0.0, player.duration, 1e-4))[0]
        assert cKDTree(planned).query(given)[0].max() < 2e-3

    @pytest.mark.parametrize("k", [3, 5])
    def test_gap_after_gap_it_is_at_rest_as_many_set_points_later(self, k, six_axis_limits):
        """Else somebody's stop would be void on a link that answers every fourth packet."""
        cruise = replace(six_axis_limits, velocity=np.full(6, 0.5))
        line = plan([np.zeros(6), np.full(6, 1.8)], cruise)

        def set_points_to_rest(gaps):
            player = TrajectoryPlayer(line, PERIOD, six_axis_limits)
            player.begin(player.start)
            before, last = ([player.advance()[0] for _ in range(int(0.2 / PERIOD))])[-2:]
            player.stop()
            count = 0
            while not player.finished:
                if gaps:
                    step = last - before
                    last = last + k * step
                    player.go_on_from(last, step / PERIOD, 2 * k)
                before, last = last, player.advance()[0]
                count += 1
            return count

        assert set_points_to_rest(True) <= 2 * set_points_to_rest(False)

    def test_brought_to_rest_it_stays_there(self, carried):
        player, last, step = carried
        player.go_on_from(last + step, 0.0 * step, 2)
        player.stop()
        position, velocity = player.advance()
        assert player.finished
        np.testing.assert_array_equal(position, last + step)
        assert not velocity.any()

    def test_away_from_its_path_it_is_refused(self, carried):
        player, last, step = carried
        with pytest.raises(StartMismatch, match="the motion at"):
            player.go_on_from(last + 3 * step + 2e-3, step / PERIOD, 6)


class TestPathReader:
    """One motion time at a time, as a cycle reads it."""

    @given(which=st.integers(0, 5), share=st.floats(0.0, 1.0))
    def test_it_reads_what_the_table_holds(self, motions, which, share):
        motion = motions[which]
        s = share * motion.duration
        position, velocity = PathReader(motion).read(s)
        q, qd, _ = motion.sample_one(s)
        np.testing.assert_allclose(position, q, rtol=0, atol=1e-13)
        np.testing.assert_allclose(velocity, qd, rtol=0, atol=1e-12)

    def test_it_reads_at_every_knot_of_every_joint(self, motions):
        motion = motions[0]
        reader = PathReader(motion)
        for s in np.concatenate(motion.knots):
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
    def test_it_reads_what_a_sum_of_sines_says(self, seed, share, ramp):
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

    def test_a_trajectory_of_another_kind_is_asked_itself(self):
        class Line:
            duration = 2.0
            n_joints = 2

            def sample(self, t):
                slope = np.array([1.0, -2.0])
                return np.outer(t, slope), np.tile(slope, (len(t), 1)), np.zeros((len(t), 2))

        position, velocity = PathReader(Line()).read(0.5)
        np.testing.assert_array_equal(position, [0.5, -1.0])
        np.testing.assert_array_equal(velocity, [1.0, -2.0])
