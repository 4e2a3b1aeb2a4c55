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
- ``worst_limit_ratio``: how far any quantity of ``--plans`` random motions goes, 1 being its limit
  (`benchmarks.planner_statistics`).

Times are processor time of one thread; medians.
"""

# ruff: noqa: E402 - threads are pinned before numpy is imported, or BLAS does not see it

from __future__ import annotations

import os

for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_variable] = "1"

import argparse
import json
import time
from collections.abc import Callable, Iterator
from functools import partial
from itertools import pairwise

import numpy as np
import ruckig

from benchmarks.planner_statistics import (
    FACTS,
    FLYS,
    NarrowRow,
    fly_table,
    limit_ratios,
    random_points,
)
from hil import Cell
from planner import JointLimits, PiecewiseCubic, TrajectoryPlayer, plan
from planner.arrays import Array
from planner.interpolator import Interpolator
from planner.moves import plan_chunk
from sim_fixtures.ns16 import CELL_PATH

POINTS = 6
SAMPLES = 16_000
MOTIONS = 200
POPULATION = 32
PERIOD = 1e-3


def _timed(function: Callable[[], object]) -> float:
    """Return the processor time of a call: on a busy machine the wall clock times the others."""
    start = time.thread_time()
    function()
    return time.thread_time() - start


def _stretches(points: Array, limits: JointLimits) -> list[ruckig.Trajectory]:
    """Return the solver's own motions from point to point."""
    n = limits.n_joints
    stretches = []
    for start, end in pairwise(points.tolist()):
        problem = ruckig.InputParameter(n)
        problem.current_position, problem.target_position = start, end
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
    alone = [_timed(partial(plan, points, limits)) for points in sets]
    company = [_timed(partial(plan_chunk, group, shares, limits, 0.5)) for group in groups]
    return {
        "plan_ms": 1e3 * float(np.median(alone)),
        "batch_ms": 1e3 * float(np.median(company)) / POPULATION,
    }


def sampling_times(limits: JointLimits, random: np.random.Generator) -> dict[str, float]:
    """Return the time [ms] of a table's samples, and how many times longer the solver takes."""
    times = []
    for _ in range(25):  # alternating, so that both meet the same machine
        points = random_points(limits, random, POINTS)
        motion, stretches = plan(points, limits), _stretches(points, limits)
        t = np.linspace(0.0, motion.duration, SAMPLES)
        times.append(
            [
                _timed(partial(motion.sample, t)),
                _timed(partial(_each_time, stretches)),
                _timed(partial(_calls_only, stretches)),
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
        times = 1e6 * np.array([_timed(step) for step in steps])
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


def main() -> None:
    """Measure, and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--json", action="store_true", help="print the line of JSON only")
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
    rows = fly_table(limits, arguments.sets)
    result["fly_table"] = [row._asdict() for row in rows]
    if not arguments.json:
        _print(result, rows, arguments.sets)
    print(json.dumps(result))


def _print(result: dict[str, object], rows: list[NarrowRow], sets: int) -> None:
    for name, value in result.items():
        if name != "fly_table":
            print(
                f"  {name:26} {value:.6f}" if isinstance(value, float) else f"  {name:26} {value}"
            )
    print(f"\n{sets} sets of {POINTS} via points; in brackets: cut and join as first tried (facts)")
    print("  fly %   T / T with stops    passing [deg]    corners: all  reduced  stopped")
    for row in rows:
        ratio, distance = FACTS[FLYS.index(row.fly)]
        print(
            f"  {row.fly:5.0%}   {row.time_ratio:.3f} ({ratio})       "
            f"{row.passing_deg:6.2f} ({distance:4})  "
            f"{row.corners:12} {row.reduced:8} {row.stopped:8}"
        )


if __name__ == "__main__":
    main()
