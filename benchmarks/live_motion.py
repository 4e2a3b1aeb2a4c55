"""Stopping in mid-motion on the NS 16: time and joint travel.

Plans through random via points are brought to rest from full rate at every instant, and the
farthest that each joint still travels is found, back and forth added up. The time and the motion
time that passes follow from the time law, the travel from the plan; the worst case of all is then
really played, and what the player gives out has to agree and to pass the guard.

    python -m benchmarks.live_motion [--json] [--plans N] [--points K] [--fly F]
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks import parser_of, show
from drivers import Guard
from hil import Cell
from planner import PiecewiseCubic, TrajectoryPlayer, plan
from planner.time_law import ramp, slowing_bounds
from sim_fixtures.ns16 import CELL_PATH

Array = NDArray[np.float64]

STEP = 0.001
"""Time between two instants at which a stop is tried [s]."""


class Worst(NamedTuple):
    """The stop on which a joint travels farthest: plan, instant [s], travel of each joint [rad]."""

    motion: PiecewiseCubic
    instant: float
    travel: Array


def travels(motion: PiecewiseCubic, gone: float) -> tuple[Array, Array]:
    """Instants (m,) [s], and travel (m, n) [rad] from each over `gone` seconds of motion time."""
    t = np.arange(0.0, motion.duration + gone + STEP, STEP)
    _, qd, _ = motion.sample(t)
    way = np.concatenate((np.zeros((1, qd.shape[1])), np.cumsum(np.abs(qd) * STEP, axis=0)))
    window = round(gone / STEP)
    return t[: len(way) - window], way[window:] - way[: len(way) - window]


def play(worst: Worst, cell: Cell) -> tuple[float, Array]:
    """Time to rest [s] and travel (n,) [rad] that the player really needs, past the guard."""
    guard = Guard(cell.guard_limits, STEP)
    n = len(worst.travel)
    player = TrajectoryPlayer(worst.motion, STEP, cell.joint_limits)
    player.begin(player.start)
    guard.begin(player.start, 0)
    for cycle in range(round(worst.instant / STEP)):
        position, velocity = player.advance()
        guard.check_set_point(position, velocity, player.bounds, cycle)
    player.stop()
    way = np.zeros(n)
    cycles = 0
    while not player.finished:
        before = position
        (position, velocity) = player.advance()
        guard.check_set_point(position, velocity, player.bounds, cycles)
        way = way + np.abs(position - before)
        cycles = cycles + 1
    return cycles * STEP, way


def measure(plans: int, points: int, fly: float) -> dict[str, Any]:
    """All figures."""
    cell = Cell.load(CELL_PATH)
    limits = cell.joint_limits
    factors = cell.file.bounds.stop
    random = np.random.default_rng(0)
    stop_s = []
    travel = np.zeros(limits.n_joints)
    worst: Worst | None = None
    for _ in range(plans):
        via = limits.lower + random.random((points, limits.n_joints)) * (
            limits.upper - limits.lower
        )
        motion = plan(via, limits, fly=fly)
        bounds = slowing_bounds(limits, factors.acceleration, factors.jerk, motion.extrema())
        law = ramp(1.0, 0.0, 0.0, bounds)
        stop_s.append(law.duration)
        instants, way = travels(motion, law.motion_time)
        travel = np.maximum(travel, way.max(axis=0))
        at, joint = np.unravel_index(int(np.argmax(way)), way.shape)
        if worst is None or way[at, joint] > worst.travel.max():
            worst = Worst(motion, float(instants[at]), way[at])
    assert worst is not None
    played_s, played = play(worst, cell)
    return {
        "plans": plans,
        "stop_s": max(stop_s),
        "stop_s_median": float(np.median(stop_s)),
        "travel_deg": np.degrees(travel).round(2).tolist(),
        "worst_played_s": played_s,
        "worst_played_deg": np.degrees(played).round(2).tolist(),
        "worst_expected_deg": np.degrees(worst.travel).round(2).tolist(),
    }


def main() -> None:
    """Print the figures."""
    parser = parser_of(__doc__)
    parser.add_argument("--plans", type=int, default=1000)
    parser.add_argument("--points", type=int, default=6)
    parser.add_argument("--fly", type=float, default=0.5)
    options = parser.parse_args()
    show(measure(options.plans, options.points, options.fly), only_json=options.json)


if __name__ == "__main__":
    main()
