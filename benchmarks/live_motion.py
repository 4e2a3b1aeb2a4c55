"""Stopping and overriding in mid-motion on the NS 16: time, joint travel, and cost of a cycle.

Plans through random via points are brought to rest from full rate at every instant, and the
farthest that each joint still travels is kept, back and forth counted as way. The time and the
motion time that passes follow from the time law, the travel from the plan; the worst case of all
is then really played, and what the player gives out has to agree and to pass the guard.

    python -m benchmarks.live_motion [--json] [--plans N] [--points K] [--fly F] [--cycles N]
"""

# ruff: noqa: E402  the number of BLAS threads has to stand before numpy is imported

from __future__ import annotations

import os

for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_variable] = "1"

import argparse
import gc
import json
import time
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers import Guard, GuardLimits
from hil import Cell
from planner import JointLimits, PiecewiseCubic, TrajectoryPlayer, plan
from planner.time_law import Ramp, RateBounds, ramp, slowing_bounds, within
from sim_fixtures.ns16 import CELL_PATH

Array = NDArray[np.float64]

STEP = 0.001
"""Time between two instants at which a stop is tried [s]."""


class Factors(NamedTuple):
    """Multiples of the acceleration and jerk limits."""

    acceleration: float
    jerk: float


class Worst(NamedTuple):
    """The stop on which a joint travels farthest: plan, instant [s], way of each joint [rad]."""

    motion: PiecewiseCubic
    instant: float
    travel: Array


def from_full_rate(bounds: RateBounds) -> Ramp:
    """The change from full rate to rest."""
    return ramp(1.0, 0.0, 0.0, bounds)


def travels(motion: PiecewiseCubic, gone: float) -> tuple[Array, Array]:
    """Instants (m,) [s], and the way (m, n) [rad] from each over `gone` seconds of motion time."""
    t = np.arange(0.0, motion.duration + gone + STEP, STEP)
    _, qd, _ = motion.sample(t)
    way = np.concatenate((np.zeros((1, qd.shape[1])), np.cumsum(np.abs(qd) * STEP, axis=0)))
    window = round(gone / STEP)
    return t[: len(way) - window], way[window:] - way[: len(way) - window]


def play(worst: Worst, limits: JointLimits, guard: Guard) -> tuple[float, Array]:
    """Time to rest [s] and way (n,) [rad] that the player really needs, past the guard."""
    n = limits.n_joints
    player = TrajectoryPlayer(worst.motion, guard.period, limits)
    player.begin(player.start)
    guard.begin(player.start, np.zeros(n), np.zeros(n), np.zeros((2, n)), 0)
    for cycle in range(round(worst.instant / guard.period)):
        position, velocity = player.advance()
        guard.check_set_point(position, velocity, player.bounds, cycle)
    player.stop()
    way, cycles = np.zeros(n), 0
    while not player.finished:
        before, (position, velocity) = position, player.advance()
        guard.check_set_point(position, velocity, player.bounds, cycles)
        way, cycles = way + np.abs(position - before), cycles + 1
    return cycles * guard.period, way


def step_cost(motion: PiecewiseCubic, limits: JointLimits, cycles: int, what: str) -> float:
    """Median cost of a cycle [µs] on the table, at a constant rate beside it, or changing it."""
    player = TrajectoryPlayer(motion, STEP, limits)
    player.begin(player.start)
    player.advance()
    taken: list[int] = []
    gc.disable()
    while len(taken) < cycles:
        if player.finished or len(taken) == 0:
            player.begin(player.start)
            player.advance()
            player.override(1.0 if what == "table" else 0.8)
        began = time.perf_counter_ns()
        if what == "turning":
            player.override(0.5 + 0.4 * (len(taken) % 100) / 100.0)
        player.advance()
        taken.append(time.perf_counter_ns() - began)
    gc.enable()
    return float(np.median(taken)) / 1e3


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """All figures."""
    cell = Cell.load(CELL_PATH)
    limits, n = cell.joint_limits, cell.joint_limits.n_joints
    stop, override = Factors(2.0, 3.0), Factors(1.3, 1.7)
    random = np.random.default_rng(0)
    stop_s, override_s, travel = [], [], np.zeros(n)
    worst: Worst | None = None
    for _ in range(options.plans):
        points = limits.lower + random.random((options.points, n)) * (limits.upper - limits.lower)
        motion = plan(points, limits, fly=options.fly)
        extrema = motion.extrema()
        stopping = slowing_bounds(limits, *stop, extrema)
        law = from_full_rate(stopping)
        stop_s.append(law.duration)
        overriding = within(slowing_bounds(limits, *override, extrema), stopping)
        override_s.append(from_full_rate(overriding).duration)
        instants, way = travels(motion, law.gone)
        travel = np.maximum(travel, way.max(axis=0))
        at, joint = np.unravel_index(int(np.argmax(way)), way.shape)
        if worst is None or way[at, joint] > worst.travel.max():
            worst = Worst(motion, float(instants[at]), way[at])
    assert worst is not None
    guard_limits = GuardLimits(
        limits.lower, limits.upper, limits.velocity, limits.acceleration, limits.jerk,
        following_error=np.ones(n), current=np.ones(n),
    )  # fmt: skip
    played_s, played = play(worst, limits, Guard(guard_limits, STEP))
    general = slowing_bounds(limits, *stop)
    return {
        "plans": options.plans,
        "stop_s": max(stop_s),
        "stop_s_median": float(np.median(stop_s)),
        "stop_s_any_path": from_full_rate(general).duration,
        "stop_motion_time_s": from_full_rate(general).gone,
        "override_s": max(override_s),
        "override_s_median": float(np.median(override_s)),
        "travel_deg": np.degrees(travel).round(2).tolist(),
        "worst_played_s": played_s,
        "worst_played_deg": np.degrees(played).round(2).tolist(),
        "worst_expected_deg": np.degrees(worst.travel).round(2).tolist(),
        **{
            f"step_us_{what}": step_cost(worst.motion, limits, options.cycles, what)
            for what in ("table", "constant", "turning")
        },
    }


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--json", action="store_true", help="only the line of JSON")
    parser.add_argument("--plans", type=int, default=1000)
    parser.add_argument("--points", type=int, default=6)
    parser.add_argument("--fly", type=float, default=0.5)
    parser.add_argument("--cycles", type=int, default=20_000)
    options = parser.parse_args()
    result = measure(options)
    if not options.json:
        for name, value in result.items():
            print(f"  {name:20s} {value}")
    print(json.dumps(result))


if __name__ == "__main__":
    main()
