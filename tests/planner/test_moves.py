from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from planner import InvalidSetting, InvalidViaPoints, JointLimits, TooFewViaPoints, plan
from planner.moves import FlyDistance, FlyPercent, Move, Overrides, Stop, plan_moves


def decades(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high).map(lambda exponent: 10.0**exponent)


shares = st.one_of(st.just(1.0), st.floats(0.02, 1.0))
flies = st.one_of(
    st.just(Stop()),
    st.sampled_from([0.0, 1.0, 25.0, 50.0, 75.0, 100.0]).map(FlyPercent),
    st.floats(0.0, 100.0).map(FlyPercent),
    st.sampled_from([0.0, 1e-9, 1e-5, 1e-3, 0.03, 0.5, 10.0]).map(FlyDistance),
)


@st.composite
def robots(draw):
    """Joints of very different nature, 1 to 10 of them."""
    n = draw(st.integers(1, 10))
    span, velocity, ramp, rise = np.array(
        [draw(st.tuples(*[decades(-2, 1)] * 4)) for _ in range(n)]
    ).T
    acceleration = velocity / ramp
    centre = np.array(draw(st.lists(st.floats(-5, 5), min_size=n, max_size=n)))
    return JointLimits(
        centre - span, centre + span, velocity, acceleration, acceleration / rise * 10.0
    )


@st.composite
def routes(draw, limits: JointLimits):
    """Positions that planners stumble over: on the limits, repeated, microscopic, one joint."""
    n, span = limits.n_joints, (limits.upper - limits.lower) / 2.0
    centre = limits.lower + span
    rows = [centre]
    for _ in range(draw(st.integers(2, 6))):
        kind = draw(st.sampled_from(["random", "limits", "same", "back", "tiny", "one joint"]))
        row = rows[-1].copy()
        if kind == "random":
            row = centre + span * np.array(draw(st.lists(st.floats(-1, 1), min_size=n, max_size=n)))
        elif kind == "limits":
            on = np.array(draw(st.lists(st.booleans(), min_size=n, max_size=n)))
            row = np.where(on, limits.lower, limits.upper)
        elif kind == "back" and len(rows) > 1:
            row = rows[-2].copy()
        elif kind == "tiny":
            row = row + draw(st.sampled_from([1e-15, 1e-12, 1e-9, 1e-6, 1e-4])) * span
        elif kind == "one joint":
            joint = draw(st.integers(0, n - 1))
            row[joint] = draw(st.sampled_from([limits.lower[joint], limits.upper[joint]]))
        rows.append(np.clip(row, limits.lower, limits.upper))
    return np.array(rows)


@st.composite
def problems(draw):
    limits = draw(robots())
    points = draw(routes(limits))
    n = limits.n_joints
    per_joint = st.one_of(st.none(), st.lists(shares, min_size=n, max_size=n))
    moves = [
        Move(
            point,
            speed=draw(shares),
            acceleration=draw(shares),
            joint_speed=draw(per_joint),
            joint_acceleration=draw(per_joint),
            joint_jerk=draw(per_joint),
            fly=draw(flies),
        )
        for point in points[1:]
    ]
    joint = draw(st.one_of(shares, st.lists(shares, min_size=n, max_size=n)))
    overrides = Overrides(draw(shares), draw(shares), draw(shares), joint)
    return points, moves, limits, overrides


def rounding_of(limits: JointLimits, duration: float) -> tuple[np.ndarray, ...]:
    """What position, velocity and acceleration may be off by: digits, and the clock's late on."""
    tick = 4.0 * np.spacing(duration)
    size = np.maximum(np.abs(limits.lower), np.abs(limits.upper))
    return (
        1e-12 * size + tick * limits.velocity,
        1e-9 * limits.velocity + tick * limits.acceleration,
        1e-9 * limits.acceleration + tick * limits.jerk,
    )


@given(problems())
@settings(max_examples=100)
def test_no_input_makes_a_motion_break_a_limit_or_jump(problem):
    points, moves, limits, overrides = problem
    motion = plan_moves(points[0], moves, limits, overrides)
    extrema = motion.trajectory.extrema()
    position, velocity, acceleration = rounding_of(limits, motion.duration)
    assert np.all(extrema.lower >= limits.lower - position)
    assert np.all(extrema.upper <= limits.upper + position)
    assert np.all(extrema.velocity <= limits.velocity)
    assert np.all(extrema.acceleration <= limits.acceleration)
    assert np.all(extrema.jerk <= limits.jerk)
    for joint, ends in enumerate(motion.trajectory.ends()):
        jumps = np.abs(motion.trajectory.coefficients[joint][1:, :3] - ends[:-1])
        assert np.all(jumps <= [position[joint], velocity[joint], acceleration[joint]])
    q, qd, qdd = motion.trajectory.sample(np.array([0.0, motion.duration]))
    assert np.all(np.abs(q - points[[0, -1]]) <= 2.0 * position)
    assert np.all(np.abs(qd) <= velocity)
    assert np.all(np.abs(qdd) <= acceleration)


@given(problems())
@settings(max_examples=60)
def test_every_target_is_passed_as_it_says(problem):
    points, moves, limits, overrides = problem
    motion = plan_moves(points[0], moves, limits, overrides)
    position, velocity, _ = rounding_of(limits, motion.duration)
    assert [passage.index for passage in motion.targets] == list(range(len(moves)))
    times = [passage.time for passage in motion.targets]
    assert all(a <= b + 4.0 * np.spacing(b) for a, b in pairwise([0.0, *times, motion.duration]))
    for passage, move in zip(motion.targets, moves, strict=True):
        q, qd, _ = motion.trajectory.sample_one(passage.time)
        apart = np.linalg.norm(q - move.target)
        assert apart == pytest.approx(passage.distance, rel=1e-6, abs=2.0 * position.max())
        if passage.how == "stopped":
            assert np.all(np.abs(q - move.target) <= 2.0 * position)
            assert np.all(np.abs(qd) <= velocity)
            assert passage.fly == 0.0
        elif isinstance(move.fly, FlyDistance):
            assert passage.distance <= move.fly.distance
        else:
            assert isinstance(move.fly, FlyPercent)
            asked = move.fly.percent / 100.0
            assert 0.0 < passage.fly <= asked
            assert (passage.how == "flown") == (passage.fly == asked)
    assert motion.targets[-1].how == "stopped"


@given(problems())
@settings(max_examples=60)
def test_flying_by_never_takes_longer_than_stopping(problem):
    points, moves, limits, overrides = problem
    motion = plan_moves(points[0], moves, limits, overrides)
    stops = plan_moves(points[0], [replace(m, fly=Stop()) for m in moves], limits, overrides)
    assert stops.duration == pytest.approx(motion.duration_with_stops, rel=1e-14)
    # Equal but for the rounding of a sum in which a corner replaces times by themselves.
    assert motion.duration <= stops.duration * (1 + 1e-13)
    for corner in motion.corners:
        if corner.join is not None:
            assert corner.join.duration <= corner.leave + corner.enter


@given(problems())
@settings(max_examples=25)
def test_a_fly_of_nothing_is_a_stop(problem):
    points, moves, limits, overrides = problem
    tables = [
        plan_moves(points[0], [replace(m, fly=fly) for m in moves], limits, overrides)
        for fly in (Stop(), FlyPercent(0.0), FlyDistance(0.0))
    ]
    assert all(passage.how == "stopped" for table in tables for passage in table.targets)
    for other in tables[1:]:
        assert other.trajectory.to_dict() == tables[0].trajectory.to_dict()


@given(problems(), st.floats(0.02, 1.0))
@settings(max_examples=60)
def test_with_stops_more_speed_never_takes_longer(problem, share):
    points, moves, limits, overrides = problem
    moves = [replace(move, fly=Stop()) for move in moves]
    slower = replace(overrides, speed=share * overrides.speed)
    fast = plan_moves(points[0], moves, limits, overrides).duration
    assert fast <= plan_moves(points[0], moves, limits, slower).duration * (1 + 1e-13)


@given(problems(), st.floats(0.0, 50.0), st.floats(0.02, 1.0))
@settings(max_examples=60)
def test_up_to_half_of_the_ramps_more_speed_never_takes_longer(problem, percent, share):
    # Seen backwards from its stop, a ramp from a higher speed begins with at least half of one
    # from a lower speed: so the faster motion may follow the slower one's join, and a join that
    # replaces more saves more. Above half this is not so; see the slow test.
    points, moves, limits, overrides = problem
    moves = [replace(move, fly=FlyPercent(percent)) for move in moves]
    slower = replace(overrides, speed=share * overrides.speed)
    fast = plan_moves(points[0], moves, limits, overrides).duration
    assert fast <= plan_moves(points[0], moves, limits, slower).duration * (1 + 1e-9)


@given(st.integers(0, 10**6), st.sampled_from([0.0, 0.3, 0.5, 1.0]), st.floats(0.1, 1.0))
@settings(max_examples=20)
def test_plan_is_the_same_motion(six_axis_limits, random_points, seed, fly, speed):
    points = random_points(seed)
    moves = [Move(point, speed=speed, fly=FlyPercent(100.0 * fly)) for point in points[1:]]
    table = plan_moves(points[0], moves, six_axis_limits).trajectory
    assert table.to_dict() == plan(points, six_axis_limits, speed=speed, fly=fly).to_dict()


def ramps(motion):
    """Largest share of each limit while speeding up and while slowing down, along a line."""
    law = motion.trajectory
    t = np.linspace(0.0, law.duration, 20001)
    _, qd, qdd = law.sample(t)
    along = qd * qdd
    return np.max(np.where(along > 0, np.abs(qdd), 0), axis=0), np.max(
        np.where(along < 0, np.abs(qdd), 0), axis=0
    )


@pytest.mark.parametrize(("name", "ramp"), [("acceleration", 0), ("deceleration", 1)])
def test_an_override_of_one_ramp_leaves_the_other_as_it_is(
    six_axis_limits, random_points, name, ramp
):
    start, end = random_points(3, 2)
    plain = plan_moves(start, [Move(end)], six_axis_limits)
    gentle = plan_moves(start, [Move(end)], six_axis_limits, Overrides(**{name: 0.25}))
    changed, unchanged = ramps(gentle)[ramp], ramps(gentle)[1 - ramp]
    np.testing.assert_allclose(changed, 0.25 * ramps(plain)[ramp], rtol=1e-3)
    np.testing.assert_allclose(unchanged, ramps(plain)[1 - ramp], rtol=1e-3)
    extrema, before = gentle.trajectory.extrema(), plain.trajectory.extrema()
    np.testing.assert_allclose(extrema.velocity, before.velocity)
    np.testing.assert_allclose(extrema.jerk, before.jerk)


def test_an_override_of_speed_leaves_acceleration_and_jerk_as_they_are(
    six_axis_limits, random_points
):
    start, end = random_points(4, 2)
    plain = plan_moves(start, [Move(end)], six_axis_limits).trajectory.extrema()
    slow = plan_moves(start, [Move(end)], six_axis_limits, Overrides(speed=0.5))
    extrema = slow.trajectory.extrema()
    np.testing.assert_allclose(extrema.velocity, 0.5 * plain.velocity)
    np.testing.assert_allclose(extrema.acceleration, plain.acceleration)
    np.testing.assert_allclose(extrema.jerk, plain.jerk)


def test_shares_of_one_joint_bind_that_joint_alone(six_axis_limits, random_points):
    start, end = random_points(5, 2)
    share = np.array([1.0, 1.0, 1.0, 0.05, 1.0, 1.0])
    for move, overrides, quantity in (
        (Move(end, joint_speed=share), Overrides(), "velocity"),
        (Move(end), Overrides(joint=share), "velocity"),
        (Move(end, joint_acceleration=share), Overrides(), "acceleration"),
        (Move(end, joint_jerk=share), Overrides(), "jerk"),
    ):
        reached = plan_moves(start, [move], six_axis_limits, overrides).trajectory.extrema()
        used = getattr(reached, quantity) / getattr(six_axis_limits, quantity)
        assert used[3] == pytest.approx(0.05, rel=0.03)
        assert used[3] <= 0.05
        assert np.all(used <= 1.0)


def test_each_move_keeps_its_own_shares(six_axis_limits, random_points):
    points = random_points(6, 4)
    speeds = (1.0, 0.2, 0.6)
    moves = [Move(p, speed=s, fly=Stop()) for p, s in zip(points[1:], speeds, strict=True)]
    motion = plan_moves(points[0], moves, six_axis_limits)
    arrivals = [0.0, *(passage.time for passage in motion.targets)]
    for (begin, end), speed in zip(pairwise(arrivals), speeds, strict=True):
        reached = motion.trajectory.restricted(begin, end).extrema().velocity
        assert np.max(reached / six_axis_limits.velocity) <= speed
        assert np.max(reached / six_axis_limits.velocity) > 0.9 * speed


def test_corners_that_were_not_rounded_as_asked_are_counted(six_axis_limits, random_points):
    a, b, c = random_points(7, 3)
    repeated = plan_moves(a, [Move(p, fly=FlyPercent(50)) for p in (b, b, c)], six_axis_limits)
    assert (repeated.reduced_corners, repeated.stopped_corners) == (0, 0)  # nothing to round
    reduced = 0
    for seed in range(300):
        a, b, c = random_points(seed, 3)
        # Joint 5 turns round exactly on its limit while joint 0 sets the pace.
        motion = plan_moves(
            a,
            [Move(p, fly=FlyPercent(100)) for p in (six_axis_limits.upper, c)],
            six_axis_limits,
        )
        assert motion.reduced_corners == (motion.targets[0].how == "reduced")
        assert motion.stopped_corners == (motion.targets[0].how == "stopped")
        reduced += motion.reduced_corners
    assert reduced > 0


@pytest.mark.parametrize(
    "bad",
    [
        {"target": []},
        {"target": [[1.0]]},
        {"target": ["north"]},
        {"speed": 0.0},
        {"speed": 1.1},
        {"speed": float("nan")},
        {"speed": None},
        {"acceleration": -1.0},
        {"joint_speed": [1.0]},
        {"joint_speed": [1.0, 0.0]},
        {"joint_acceleration": [1.0, 2.0]},
        {"joint_jerk": ["fast", 1.0]},
        {"fly": 50},
        {"termination": "exact"},
    ],
)
def test_a_move_that_is_none_is_refused_by_name(bad):
    with pytest.raises(InvalidSetting) as refusal:
        Move(**{"target": [0.0, 1.0], **bad})
    assert refusal.value.name == next(iter(bad))


@pytest.mark.parametrize("value", [-1.0, 100.5, float("nan")])
def test_a_fly_percentage_out_of_range_is_refused(value):
    with pytest.raises(InvalidSetting, match="percentage"):
        FlyPercent(value)


@pytest.mark.parametrize("value", [-1e-9, float("inf"), float("nan")])
def test_a_fly_distance_out_of_range_is_refused(value):
    with pytest.raises(InvalidSetting, match="distance"):
        FlyDistance(value)


def test_moves_of_another_arm_are_refused(six_axis_limits, random_points):
    a, b = random_points(8, 2)
    with pytest.raises(InvalidViaPoints):
        plan_moves(a, [Move(b[:5])], six_axis_limits)
    with pytest.raises(InvalidViaPoints):
        plan_moves(a[:5], [Move(b[:5])], six_axis_limits)
    with pytest.raises(InvalidSetting, match="joint override"):
        plan_moves(a, [Move(b)], six_axis_limits, Overrides(joint=[1.0] * 5))
    with pytest.raises(TooFewViaPoints):
        plan_moves(a, [], six_axis_limits)
    with pytest.raises(InvalidSetting, match="joint override"):
        Overrides(joint=[1.0, 0.0])
    with pytest.raises(InvalidSetting, match="deceleration override"):
        Overrides(deceleration=0.0)
