"""Planning: one motion move by move, one through via points, many together."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from planner import (
    InvalidSetting,
    InvalidViaPoints,
    JointLimits,
    LimitExceeded,
    NotSmooth,
    PiecewiseCubic,
    PlanningError,
    check_limits,
    plan,
    plan_chunk,
)
from planner.corners import StraightMoves, round_corners
from planner.moves import Move, Overrides, plan_moves
from planner.piecewise_cubic import Block, check_smooth
from tests.planner.problems import problems, robots, routes, shares
from tests.planner.six_axes import SIX_AXES, random_points, rows_of


def rounding_of(limits: JointLimits, duration: float) -> tuple[np.ndarray, ...]:
    """Rounding of position, velocity and acceleration, and of knots at late times."""
    tick = 4.0 * np.spacing(duration)
    size = np.maximum(np.abs(limits.lower), np.abs(limits.upper))
    return (
        1e-12 * size + tick * limits.velocity,
        1e-9 * limits.velocity + tick * limits.acceleration,
        1e-9 * limits.acceleration + tick * limits.jerk,
    )


class TestMotion:
    """Laws of every motion through moves."""

    @pytest.mark.safety
    @given(problems())
    @settings(max_examples=150)
    def test_it_satisfies_limits_and_is_smooth(self, problem):
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
        knots = motion.trajectory.knots
        assert all(np.all(np.diff(times) > 0.0) for times in knots if times[-1] > 0.0)

    @given(problems())
    @settings(max_examples=60)
    def test_targets_are_passed_as_reported(self, problem):
        points, moves, limits, overrides = problem
        motion = plan_moves(points[0], moves, limits, overrides)
        position, velocity, _ = rounding_of(limits, motion.duration)
        assert [passage.index for passage in motion.targets] == list(range(len(moves)))
        times = [0.0, *(passage.time for passage in motion.targets), motion.duration]
        assert all(a <= b + 4.0 * np.spacing(b) for a, b in pairwise(times))
        for passage, move in zip(motion.targets, moves, strict=True):
            q, qd, _ = motion.trajectory.sample_one(passage.time)
            apart = np.linalg.norm(q - move.target)
            assert apart == pytest.approx(passage.distance, rel=1e-6, abs=2.0 * position.max())
            if passage.how == "stopped":
                assert np.all(np.abs(q - move.target) <= 2.0 * position)
                assert np.all(np.abs(qd) <= velocity)
                assert passage.fly == 0.0
            else:
                asked = move.fly_percent / 100.0
                assert 0.0 < passage.fly <= asked
                assert (passage.how == "flown") == (passage.fly == asked)
        assert motion.targets[-1].how == "stopped"

    @pytest.mark.safety
    @given(problems(), st.floats(0.02, 1.0))
    @settings(max_examples=60)
    def test_stops_take_longer_than_fly_by_and_less_with_more_speed(self, problem, share):
        points, moves, limits, overrides = problem
        motion = plan_moves(points[0], moves, limits, overrides)
        stopping = [replace(move, fly_percent=0.0) for move in moves]
        stops = plan_moves(points[0], stopping, limits, overrides)
        assert stops.duration == pytest.approx(motion.duration_with_stops, rel=1e-14)
        # Equal but for the rounding of a sum in which a corner replaces times by themselves.
        assert motion.duration <= stops.duration * (1 + 1e-13)
        slower = replace(overrides, speed=share * overrides.speed)
        slow = plan_moves(points[0], stopping, limits, slower)
        assert stops.duration <= slow.duration * (1 + 1e-13)

    def test_moves_of_another_arm_are_refused(self):
        a, b = random_points(8, 2)
        for start, moves in ((a, [Move(b[:5])]), (a[:5], [Move(b[:5])]), (a, [])):
            with pytest.raises(InvalidViaPoints):
                plan_moves(start, moves, SIX_AXES)
        with pytest.raises(InvalidSetting, match="joint override"):
            plan_moves(a, [Move(b)], SIX_AXES, Overrides(joint=[1.0] * 5))

    def test_corners_not_rounded_as_requested_are_reported(self):
        a, b, c = random_points(7, 3)
        repeated = plan_moves(a, [Move(p, fly_percent=50) for p in (b, b, c)], SIX_AXES)
        assert (repeated.reduced_corners, repeated.stopped_corners) == (0, 0)  # nothing to round
        reduced = 0
        for seed in range(100, 200):
            a, b, c = random_points(seed, 3)
            # Joint 5 reverses exactly on its limit while joint 0 determines the time.
            moves = [Move(p, fly_percent=100) for p in (SIX_AXES.upper, c)]
            motion = plan_moves(a, moves, SIX_AXES)
            assert motion.reduced_corners == (motion.targets[0].how == "reduced")
            assert motion.stopped_corners == (motion.targets[0].how == "stopped")
            reduced += motion.reduced_corners
        assert reduced > 0


def ramps(motion):
    """Largest acceleration while speeding up and while slowing down, along a line."""
    _, qd, qdd = motion.trajectory.sample(np.linspace(0.0, motion.duration, 20001))
    along = qd * qdd
    return [np.max(np.where(sign * along > 0, np.abs(qdd), 0), axis=0) for sign in (1, -1)]


class TestShares:
    """Effects of overrides and of shares of moves."""

    @pytest.mark.parametrize(("name", "ramp"), [("acceleration", 0), ("deceleration", 1)])
    def test_an_override_of_one_ramp_does_not_change_the_other(self, name, ramp):
        start, end = random_points(3, 2)
        full = plan_moves(start, [Move(end)], SIX_AXES)
        gentle = plan_moves(start, [Move(end)], SIX_AXES, Overrides(**{name: 0.25}))
        changed = ramps(gentle)[ramp]
        unchanged = ramps(gentle)[1 - ramp]
        np.testing.assert_allclose(changed, 0.25 * ramps(full)[ramp], rtol=1e-3)
        np.testing.assert_allclose(unchanged, ramps(full)[1 - ramp], rtol=1e-3)
        extrema = gentle.trajectory.extrema()
        before = full.trajectory.extrema()
        np.testing.assert_allclose(extrema.velocity, before.velocity)
        np.testing.assert_allclose(extrema.jerk, before.jerk)

    @pytest.mark.parametrize(
        ("of_move", "of_program", "quantity"),
        [
            ("joint_speed", None, "velocity"),
            (None, "joint", "velocity"),
            ("joint_acceleration", None, "acceleration"),
            ("joint_jerk", None, "jerk"),
        ],
    )
    def test_a_share_of_one_joint_limits_that_joint_only(self, of_move, of_program, quantity):
        start, end = random_points(5, 2)
        share = np.array([1.0, 1.0, 1.0, 0.05, 1.0, 1.0])
        move = Move(end, **({of_move: share} if of_move else {}))
        overrides = Overrides(**({of_program: share} if of_program else {}))
        reached = plan_moves(start, [move], SIX_AXES, overrides).trajectory.extrema()
        used = getattr(reached, quantity) / getattr(SIX_AXES, quantity)
        assert used[3] == pytest.approx(0.05, rel=0.03)
        assert used[3] <= 0.05
        assert np.all(used <= 1.0)


class TestCorners:
    """How fly-by shapes a whole motion."""

    def test_a_miss_at_three_neighbouring_shares_is_avoided(self):
        # Speeds 0.07 % apart: at the second, full, 0.999 and 0.97 of the corner fall on a miss.
        limits = JointLimits(
            np.full(2, -3.0),
            np.full(2, 3.0),
            np.array([2.8797932657906435, 2.2689280275926285]),
            np.array([12.481528566433276, 9.833931597795916]),
            np.array([64.82294527864293, 51.0726235528702]),
        )
        points = [
            [0.25196215279360334, 0.5058684088195267],
            [-2.3053591353560425, -0.9312528155581958],
            [0.14937923146811105, -1.0521382451814305],
            [-0.4542626743936493, 0.009917351632736882],
        ]
        speeds = (0.7058524290377093, 0.7063463775534808)
        slow, fast = (plan(points, limits, speed=s, fly=0.4).duration for s in speeds)
        assert fast < slow


BAD_MOVES = (
    *({"target": target} for target in ([], [[1.0]], ["north"])),
    *({"speed": speed} for speed in (0.0, 1.1, float("nan"), None)),
    {"acceleration": -1.0},
    *({"joint_speed": share} for share in ([1.0], [1.0, 0.0])),
    {"joint_acceleration": [1.0, 2.0]},
    {"joint_jerk": ["fast", 1.0]},
)
UNIT = JointLimits(-np.ones(2), *[np.ones(2)] * 4)


@pytest.mark.parametrize(
    ("make", "name"),
    [
        *(
            (lambda bad=bad: Move(**{"target": [0.0, 1.0], **bad}), next(iter(bad)))
            for bad in BAD_MOVES
        ),
        *(
            (lambda v=v: Move([0.0], fly_percent=v), "fly percentage")
            for v in (-1.0, 100.5, np.nan)
        ),
        (lambda: Overrides(joint=[1.0, 0.0]), "joint override"),
        (lambda: Overrides(deceleration=0.0), "deceleration override"),
        *((lambda v=v: plan(np.zeros((2, 2)), UNIT, fly=v), "fly") for v in (-0.1, 1.1, np.nan)),
        *(
            (lambda v=v: plan(np.zeros((2, 2)), UNIT, speed=v), "speed")
            for v in (0.0, 1.01, -1.0, np.nan, [1.0], [1.0, 0.0])
        ),
    ],
)
def test_a_setting_out_of_range_is_refused_by_name(make, name):
    with pytest.raises(InvalidSetting) as refusal:
        make()
    assert refusal.value.name == name


@example(np.nextafter(1.0, 2.0))
@given(st.floats(1.0, 1e9, exclude_min=True))
@settings(max_examples=20)
def test_a_via_point_out_of_limits_is_named(factor):
    points = random_points(15)
    points[2, 4] = SIX_AXES.lower[4] * factor
    with pytest.raises(InvalidViaPoints, match=r"via point 2, joint 4: .* outside"):
        plan(points, SIX_AXES)


NO_NUMBERS = (np.nan, np.inf, -np.inf)


@pytest.mark.parametrize(
    ("points", "problem"),
    [
        (np.zeros((1, 6)), "at least 2"),
        (np.zeros((0, 6)), "at least 2"),
        (np.zeros((3, 5)), "shape"),
        (np.zeros(6), "shape"),
        (np.zeros((2, 3, 6)), "shape"),
        ([[0.0] * 6, [0.0] * 5], "table of numbers"),
        ([["north"] * 6, ["south"] * 6], "table of numbers"),
        *(([[0.0] * 6, [bad] * 6], "point 1, joint 0: .* not a finite") for bad in NO_NUMBERS),
    ],
)
def test_invalid_via_points_are_refused(points, problem):
    with pytest.raises(InvalidViaPoints, match=problem):
        plan(points, SIX_AXES)


def with_position(motion: PiecewiseCubic, value: float) -> PiecewiseCubic:
    table = motion.coefficients[2].copy()
    table[7, 0] = value
    return PiecewiseCubic(motion.knots, (*motion.coefficients[:2], table, *motion.coefficients[3:]))


class TestFinalCheck:
    """Checks of a finished motion."""

    @pytest.mark.parametrize("quantity", ["velocity", "acceleration", "jerk"])
    def test_it_finds_each_kind_of_excess(self, quantity):
        motion = plan(random_points(18), SIX_AXES)
        check_limits(motion, SIX_AXES)
        with pytest.raises(LimitExceeded) as refusal:
            check_limits(motion, SIX_AXES.scaled(**{quantity: 0.9}))
        assert refusal.value.quantity == quantity
        assert refusal.value.value > refusal.value.bound

    def test_it_finds_positions_jumps_and_nan(self):
        motion = plan(random_points(19), SIX_AXES)
        with pytest.raises(NotSmooth) as refusal:
            jumped = with_position(motion, motion.coefficients[2][7, 0] + 1e-8)
            check_smooth(jumped, SIX_AXES)
        assert (refusal.value.quantity, refusal.value.joint) == ("position", 2)
        with pytest.raises(LimitExceeded):
            check_limits(with_position(motion, np.nan), SIX_AXES)
        with pytest.raises(LimitExceeded) as refusal:
            outside = with_position(motion, SIX_AXES.upper[2] + 0.1)
            check_limits(outside, SIX_AXES)
        assert (refusal.value.quantity, refusal.value.joint) == ("position", 2)

    def test_a_planned_motion_beyond_its_limits_is_refused(self, monkeypatch):
        monkeypatch.setattr("planner.moves.SEGMENT_JERK", 1.1)
        points = random_points(20)
        with pytest.raises(LimitExceeded, match="jerk"):
            plan(points, SIX_AXES, fly=0.0)
        with pytest.raises(LimitExceeded, match="jerk"):
            plan_moves(points[0], [Move(points[1])], SIX_AXES)


def bits(motion: PiecewiseCubic) -> bytes:
    return b"".join(array.tobytes() for array in motion.knots + motion.coefficients)


@st.composite
def populations(draw):
    """Via points of several motions of one robot, at shares of its speed, for one fly-by."""
    limits = draw(robots())
    points = draw(st.lists(routes(limits), min_size=1, max_size=5))
    speed = [draw(st.lists(shares, min_size=limits.n_joints, max_size=limits.n_joints)) for _ in
             points]  # fmt: skip
    return points, limits, np.array(speed), draw(st.sampled_from([0.0, 0.01, 0.07, 0.25, 0.5, 1.0]))


class TestPopulation:
    """Motions planned together, as a search does."""

    @pytest.mark.safety
    @given(populations(), st.data())
    @settings(max_examples=100)
    def test_others_change_no_bit(self, problem, data):
        points, limits, speed, fly = problem
        together = plan_chunk(points, speed, limits, fly)
        index = data.draw(st.integers(0, len(points) - 1))
        alone = plan(points[index], limits, speed=speed[index], fly=fly)
        assert bits(alone) == bits(together[index])
        moves = [
            Move(point, joint_speed=speed[index], fly_percent=100.0 * fly)
            for point in points[index][1:]
        ]
        assert bits(plan_moves(points[index][0], moves, limits).trajectory) == bits(alone)

    def test_what_neighbours_have_in_common_is_planned_once(self, monkeypatch):
        """Each differs from the first motion in its point 3: in two legs and three corners."""
        points = random_points(4)
        neighbours = [points.copy() for _ in range(5)]
        for k, neighbour in enumerate(neighbours):
            neighbour[3, 0] += 1e-3 * k
        corners = []

        def counted(moves, before, after, bounds, fly):
            corners.append(len(before))
            return round_corners(moves, before, after, bounds, fly)

        monkeypatch.setattr("planner.moves.round_corners", counted)
        together = plan_chunk(neighbours, np.ones((5, 6)), SIX_AXES, 0.5)
        assert corners == [len(points) - 2 + 4 * 3]
        for neighbour, motion in zip(neighbours, together, strict=True):
            assert bits(plan(neighbour, SIX_AXES, fly=0.5)) == bits(motion)

    def test_motions_that_cannot_be_planned_are_errors(self):
        good = random_points(0)
        outside = random_points(1)
        unknown = random_points(2)
        outside[3, 2] = 50.0
        unknown[0, 0] = np.nan
        assert plan_chunk([], np.ones((0, 6)), SIX_AXES, 0.5) == []
        individuals = [good, outside, good[:1], unknown, good[:, :5], good[:3], good]
        planned = plan_chunk(individuals, np.ones((7, 6)), SIX_AXES, 0.5)
        assert [isinstance(each, InvalidViaPoints) for each in planned] == [False] + [True] * 4 + [
            False
        ] * 2
        assert bits(planned[0]) == bits(planned[6])
        assert planned[5].sample(np.array([np.inf]))[0][0] == pytest.approx(good[2], abs=1e-11)


COUNT = 3
JOINTS = 2
PIECES = 5
JUST = [0.5, 1.0 - 1e-6, 1.0, 1.0 + 1e-6, 2.0]


@st.composite
def blocks(draw):
    """Motions of constant jerks, some pieces without length or without jerk."""
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    shape = (COUNT, JOINTS, PIECES)
    knots = np.zeros((COUNT, JOINTS, PIECES + 1))
    lengths = random.uniform(0.0, 1.0, shape) * (random.random(shape) < 0.8)
    knots[..., 1:] = np.cumsum(lengths, axis=-1)
    knots *= (1.0 / np.maximum(knots[..., -1:], 1e-3)) * random.uniform(0.1, 10.0, (COUNT, 1, 1))
    knots[..., -1] = knots[:, :1, -1]
    jerks = random.normal(size=shape) * (random.random(shape) < 0.8)
    return Block.from_jerks(random.normal(size=(COUNT, JOINTS, 3)), knots, jerks)


def table(block: Block, row: int) -> PiecewiseCubic:
    return PiecewiseCubic(tuple(block.knots[row].copy()), tuple(block.coefficients[row].copy()))


def holds(check, motion: PiecewiseCubic, limits: JointLimits) -> bool:
    try:
        check(motion, limits)
    except PlanningError:
        return False
    return True


@given(blocks(), st.lists(st.sampled_from(JUST), min_size=5, max_size=5))
def test_limits_of_many_motions_are_checked_as_of_one(block, factors):
    each = []
    for row in range(COUNT):
        reach = table(block, row).extrema()
        far = 1.0 + np.maximum(np.abs(reach.lower), np.abs(reach.upper))
        lower = np.where(reach.lower < 0, reach.lower * factors[0], -far)
        upper = np.where(reach.upper > 0, reach.upper * factors[1], far)
        rates = [
            np.maximum(rate, 1e-3) * factor
            for rate, factor in zip(reach[2:], factors[2:], strict=True)
        ]
        each.append(JointLimits(lower, upper, *rates))
    rows = rows_of(*each)
    expected = [holds(check_limits, table(block, row), each[row]) for row in range(COUNT)]
    assert block.satisfies(rows).tolist() == expected


@given(
    st.integers(0, 2**32 - 1),
    st.integers(0, 6),
    st.integers(0, 2),
    st.sampled_from([0.0, 1e-11, 1e-3]),
)
def test_smoothness_of_many_motions_is_checked_as_of_one(seed, piece, quantity, jump):
    starts, ends = np.random.default_rng(seed).uniform(-1.0, 1.0, (2, COUNT, JOINTS))
    ones = np.ones((COUNT, JOINTS))
    unit = JointLimits(-ones[0], ones[0], ones[0], ones[0], ones[0])
    moves = StraightMoves.between(starts, ends, rows_of(*[unit] * COUNT), ones)
    knots, pieces = moves.cut(np.zeros(COUNT), moves.durations)
    pieces[1, 0, piece, quantity] += jump
    motion = Block.of_pieces(np.repeat(knots[:, None], JOINTS, axis=1), pieces)
    rows = rows_of(*[unit] * COUNT)
    expected = [holds(check_smooth, table(motion, row), unit) for row in range(COUNT)]
    assert motion.smooth(rows).tolist() == expected
    assert expected[0]
    assert expected[2]
    if jump != 1e-11:  # about as large as rounding: there only the two have to agree
        assert expected[1] is (jump == 0.0)


@given(blocks())
def test_tables_are_the_same_motions_without_empty_pieces(block):
    for row, motion in enumerate(block.tables()):
        whole = table(block, row)
        assert motion.duration == whole.duration
        times = np.linspace(-0.1, 1.1, 97) * whole.duration
        for ours, theirs in zip(motion.sample(times), whole.sample(times), strict=True):
            np.testing.assert_array_equal(ours, theirs)
        assert all(np.all(np.diff(knots) > 0.0) for knots in motion.knots)
