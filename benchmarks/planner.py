"""The planner in figures: its times, what its plans keep, and what flying by gains.

Run with ``python -m benchmarks.planner [--json] [--plans 10000] [--sets 1000]``. All with the
limits of the NS 16 (6 joints).

- ``plan_ms``: 6 via points to a finished table, fly 50 %; ``sample_ms``: 16 000 samples of
  position, velocity and acceleration of such a motion.
- ``ratio_to_at_time``: the same number of samples from the solver's own trajectories through the
  same via points, asked time by time, as its interface has it, into the same arrays, over ours.
  ``at_time_calls_only_ms`` is what its bare calls take when all that they return is thrown away.
- ``batch_ms``: one motion of a population planned together (``plan_chunk``, in this process).
- ``player_step_us``, ``interpolator_step_us``: one cycle of a motion whose override changes.
- ``worst_limit_ratio``: how far any quantity of ``--plans`` random motions goes, 1 being its limit.

Times are processor time of one thread; medians.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import ruckig

from benchmarks import parser_of, show, timed
from hil import Cell
from planner import JointLimits, PiecewiseCubic, TrajectoryPlayer, plan
from planner.arrays import Array
from planner.interpolator import Interpolator
from planner.limits import position_rounding
from planner.moves import MotionPlan, Move, plan_chunk, plan_moves
from sim_fixtures.ns16 import CELL_PATH

POINTS = 6
SAMPLES = 16_000
MOTIONS = 200
POPULATION = 32
PERIOD = 1e-3
FLYS = (0.1, 0.25, 0.5, 0.75, 1.0)
# The ranges of the table: half width and centre of each joint [deg].
_RANGES = np.deg2rad([[180, 92, 78, 200, 125, 200], [0, 33, -87, 0, 0, 0]])


def _stretches(points: Array, limits: JointLimits) -> list[ruckig.Trajectory]:
    """Return the solver's own motions from point to point."""
    n = limits.n_joints
    stretches = []
    for start, end in pairwise(points.tolist()):
        problem = ruckig.InputParameter(n)
        problem.current_position = start
        problem.target_position = end
        problem.max_velocity = limits.velocity.tolist()
        problem.max_acceleration = limits.acceleration.tolist()
        problem.max_jerk = limits.jerk.tolist()
        stretch = ruckig.Trajectory(n)
        ruckig.Ruckig(n).calculate(problem, stretch)
        stretches.append(stretch)
    return stretches


def _each_time(stretches: list[ruckig.Trajectory]) -> tuple[Array, Array, Array]:
    """Return position, velocity and acceleration (m, n) of the solver's motions."""
    q, qd, qdd = np.empty((3, SAMPLES, stretches[0].degrees_of_freedom))
    row = 0
    for stretch in stretches:
        at_time = stretch.at_time
        for t in np.linspace(0.0, stretch.duration, SAMPLES // len(stretches)).tolist():
            q[row], qd[row], qdd[row] = at_time(t)
            row += 1
    return q, qd, qdd


def _calls_only(stretches: list[ruckig.Trajectory]) -> None:
    for stretch in stretches:
        at_time = stretch.at_time
        for t in np.linspace(0.0, stretch.duration, SAMPLES // len(stretches)).tolist():
            at_time(t)


def planning_times(limits: JointLimits, random: np.random.Generator) -> dict[str, float]:
    """Return times [ms] of planning one motion, alone and in company."""
    sets = [random_points(limits, random, POINTS) for _ in range(MOTIONS)]
    shares = np.ones((POPULATION, limits.n_joints))
    groups = [sets[begin : begin + POPULATION] for begin in range(0, MOTIONS, POPULATION)][:-1]
    alone = [timed(partial(plan, points, limits)) for points in sets]
    company = [timed(partial(plan_chunk, group, shares, limits, 0.5)) for group in groups]
    return {
        "plan_ms": 1e3 * float(np.median(alone)),
        "batch_ms": 1e3 * float(np.median(company)) / POPULATION,
    }


def sampling_times(limits: JointLimits, random: np.random.Generator) -> dict[str, float]:
    """Return the time [ms] of a table's samples, and how many times longer the solver takes."""
    times = []
    for _ in range(25):  # alternating, so that both meet the same machine
        points = random_points(limits, random, POINTS)
        motion = plan(points, limits)
        stretches = _stretches(points, limits)
        t = np.linspace(0.0, motion.duration, SAMPLES)
        times.append(
            [
                timed(partial(motion.sample, t)),
                timed(partial(_each_time, stretches)),
                timed(partial(_calls_only, stretches)),
            ]
        )
    ours, arrays, calls = (1e3 * float(value) for value in np.median(times, axis=0))
    return {
        "sample_ms": ours,
        "at_time_ms": arrays,
        "at_time_calls_only_ms": calls,
        "ratio_to_at_time": arrays / ours,
    }


def step_times(limits: JointLimits, random: np.random.Generator) -> dict[str, float]:
    """Return times [us] of one cycle while the override changes, median and 99 %."""
    points = random_points(limits, random, 2 * POINTS)
    result = {}
    for name, steps in (
        ("player_step_us", _player_steps(plan(points, limits), limits)),
        ("interpolator_step_us", _interpolator_steps(points, limits)),
    ):
        times = 1e6 * np.array([timed(step) for step in steps])
        result[name] = float(np.median(times))
        result[name.replace("_us", "_99_us")] = float(np.quantile(times, 0.99))
    return result


def _player_steps(motion: PiecewiseCubic, limits: JointLimits) -> Iterator[Callable[[], object]]:
    player = TrajectoryPlayer(motion, PERIOD, limits)
    player.begin(player.start)
    for step in range(5000):
        if step % 400 == 100:
            player.override(0.2 if step % 800 == 100 else 1.0)
        yield player.advance


def _interpolator_steps(points: Array, limits: JointLimits) -> Iterator[Callable[[], object]]:
    arm = Interpolator(limits, PERIOD)
    arm.initialize()
    arm.set_initial_position(points[0])
    arm.select_flyby_mode(True)
    for number, point in enumerate(points[1:]):
        arm.set_next_target(number, point)
    for step in range(5000):
        if step % 400 == 100:
            arm.set_override_speed(20.0 if step % 800 == 100 else 100.0)
        yield arm.get_next_step


class NarrowRow(NamedTuple):
    """One line of the table: a fly, what it gains, how far it passes, how often it is less."""

    fly: float
    time_ratio: float
    passing_deg: float
    corners: int
    reduced: int
    stopped: int


def random_points(limits: JointLimits, random: np.random.Generator, count: int) -> Array:
    """Return via points (count, n) anywhere within the limits [rad]."""
    return random.uniform(limits.lower, limits.upper, (count, limits.n_joints))


def limit_ratios(
    limits: JointLimits, plans: int, random: np.random.Generator
) -> dict[str, float | int]:
    """Return how far random motions go, 1 being the limit, and how their corners are passed.

    A fifth each: anywhere; on the ends of the ranges; near one another; one joint at a time; and
    out and back. Flies, and the joints' shares of speed, are random as well.
    """
    worst = np.zeros(4)
    corners = reduced = stopped = 0
    for index in range(plans):
        points = _points(limits, random, index % 5)
        speed = (
            random.uniform(0.05, 1.0, limits.n_joints) if index % 2 else np.ones(limits.n_joints)
        )
        planned = _planned(points, limits, float(random.uniform(0.01, 1.0)), speed)
        worst = np.maximum(worst, _reach(planned, limits.scaled(velocity=speed)))
        corners += len(planned.corners)
        reduced += planned.reduced_corners
        stopped += planned.stopped_corners
    return {
        "plans": plans,
        "worst_limit_ratio": float(worst.max()),
        **{
            f"worst_{name}_ratio": float(value)
            for name, value in zip(
                ("position", "velocity", "acceleration", "jerk"), worst, strict=True
            )
        },
        "corners": corners,
        "corners_reduced": reduced,
        "corners_stopped": stopped,
    }


def fly_table(limits: JointLimits, sets: int) -> list[NarrowRow]:
    """Return the table for random sets of 6 via points within the ranges of `docs/motion.md`."""
    half, centre = _RANGES
    narrow = replace(limits, lower=centre - half, upper=centre + half)
    random = np.random.default_rng(0)
    points = [random_points(narrow, random, 6) for _ in range(sets)]
    return [_row(narrow, points, fly) for fly in FLYS]


def _row(limits: JointLimits, sets: Sequence[Array], fly: float) -> NarrowRow:
    ones = np.ones(limits.n_joints)
    plans = [_planned(points, limits, fly, ones) for points in sets]
    stops = sum(planned.duration_with_stops for planned in plans)
    passing = [target.distance for planned in plans for target in planned.targets[:-1]]
    return NarrowRow(
        fly,
        sum(planned.duration for planned in plans) / stops,
        float(np.rad2deg(np.mean(passing))),
        sum(len(planned.corners) for planned in plans),
        sum(planned.reduced_corners for planned in plans),
        sum(planned.stopped_corners for planned in plans),
    )


def _planned(points: Array, limits: JointLimits, fly: float, speed: Array) -> MotionPlan:
    moves = [Move(point, joint_speed=speed, fly_percent=100.0 * fly) for point in points[1:]]
    return plan_moves(points[0], moves, limits)


def _points(limits: JointLimits, random: np.random.Generator, kind: int) -> Array:
    points = random_points(limits, random, 6)
    if kind == 1:
        points = np.where(points > (limits.lower + limits.upper) / 2.0, limits.upper, limits.lower)
    elif kind == 2:
        points = points[0] + 10.0 ** random.uniform(-6.0, -1.0) * (points - points[0])
    elif kind == 3:
        for before, point in pairwise(points):
            resting = np.arange(limits.n_joints) != random.integers(limits.n_joints)
            point[resting] = before[resting]
    elif kind == 4:
        points[2::2] = points[0]
    return points


def _reach(planned: MotionPlan, limits: JointLimits) -> Array:
    """Return how far position, velocity, acceleration and jerk go, 1 being the limit."""
    extrema = planned.trajectory.extrema()
    half = (limits.upper - limits.lower) / 2.0
    beyond = np.maximum(extrema.upper - limits.upper, limits.lower - extrema.lower)
    beyond = beyond - position_rounding(limits)  # which is not reaching further
    rates = (
        extrema.velocity / limits.velocity,
        extrema.acceleration / limits.acceleration,
        extrema.jerk / limits.jerk,
    )
    return np.array([ratio.max() for ratio in (1.0 + beyond / half, *rates)])


def main() -> None:
    """Measure, and print the figures."""
    parser = parser_of(__doc__)
    parser.add_argument("--plans", type=int, default=1000, help="motions whose limits are checked")
    parser.add_argument("--sets", type=int, default=1000, help="sets of via points of the table")
    arguments = parser.parse_args()

    limits = Cell.load(CELL_PATH).joint_limits
    random = np.random.default_rng(1)
    result: dict[str, object] = {
        **planning_times(limits, random),
        **sampling_times(limits, random),
        **step_times(limits, random),
    }
    result |= limit_ratios(limits, arguments.plans, random)
    result["fly_table"] = [row._asdict() for row in fly_table(limits, arguments.sets)]
    show(result, only_json=arguments.json)


if __name__ == "__main__":
    main()
