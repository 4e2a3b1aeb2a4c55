"""Many joins between two moving states at once: the solver per join, all else in whole arrays.

A join is solved in 10 µs; to turn its solution into cubic pieces and check them, one join at a
time, costs twenty times that in calls on tiny arrays. Here every step but the solver's runs over
all joins together. Each number is made by the same operations whatever else is in the arrays, so
a join does not depend on its company, to the last bit.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import ruckig
from numpy.typing import NDArray

from planner.arrays import Array
from planner.blocks import Block, LimitRows, Mask, Rows
from planner.corners import FULL, NEAREST_STATE, REFUSALS, SOLVER_JERK, require_solver
from planner.verify import jump_rounding

# A join may miss its end by this share of what counts as rounding between two pieces.
_MISS = 0.1
# Of a solution: two to brake into the limits (of no length here), seven to move.
_PIECES = 9


class Join(NamedTuple):
    """A motion between two states, all joints with the same number of cubic pieces.

    Attributes:
        knots: Times from 0 to the common duration (n, m + 1) [s].
        coefficients: Position, velocity, acceleration at the start of each piece, and its jerk,
            (n, m, 4).
    """

    knots: Array
    coefficients: Array

    @property
    def duration(self) -> float:
        """Length in time [s]."""
        return float(self.knots[0, -1])


class Solutions(NamedTuple):
    """What the solver found for many joins, not yet checked.

    Attributes:
        starts: Position, velocity and acceleration of the joints at each start, (c, n, 3).
        ends: The same at each end, (c, n, 3); all joints arrive together.
        times: Unit of time in which each was asked for (c,) [s].
        durations: Length in time of each join (c,) [s]; infinite where there is none.
        answers: The solver's own results (c,), in its units; None where there is none.
    """

    starts: Array
    ends: Array
    times: Array
    durations: Array
    found: NDArray[np.object_]

    def take(self, rows: Rows) -> Solutions:
        """Return some of the solutions, by index."""
        return Solutions(
            self.starts[rows],
            self.ends[rows],
            self.times[rows],
            self.durations[rows],
            self.found[rows],
        )


def solve_many(starts: Array, ends: Array, times: Array, bounds: LimitRows) -> Solutions:
    """Find the fastest motions between two states (c, n, 3) each under limits (c, n).

    Args:
        starts: Position, velocity and acceleration of the joints at each start.
        ends: The same at each end; all joints arrive together.
        times: About how long each may take (c,) [s].
        bounds: What each may use.

    Raises:
        UnsupportedSolver: the solver is of a version that nothing is known about.
    """
    require_solver()
    n_joints = starts.shape[1]
    problem = ruckig.InputParameter(n_joints)
    problem.synchronization = ruckig.Synchronization.Time
    problem.max_jerk = [FULL * SOLVER_JERK] * n_joints
    solver = ruckig.Ruckig(n_joints)
    durations = np.full(len(starts), np.inf)
    found = np.full(len(starts), None, dtype=np.object_)
    rows = np.flatnonzero(_askable(starts, bounds) & _askable(ends, bounds))
    tasks = zip(
        rows.tolist(),
        times[rows].tolist(),
        *_in_units(starts[rows], ends[rows], times[rows], bounds.take(rows)),
        strict=True,
    )
    for row, time, here, there, largest in tasks:
        problem.current_position, problem.current_velocity, problem.current_acceleration = here
        problem.target_position, problem.target_velocity, problem.target_acceleration = there
        problem.max_velocity, problem.max_acceleration = largest
        answer = ruckig.Trajectory(n_joints)
        try:
            solver.calculate(problem, answer)
        except REFUSALS:
            continue
        durations[row], found[row] = answer.duration * time, answer
    return Solutions(starts, ends, times, durations, found)


def _in_units(
    starts: Array, ends: Array, times: Array, bounds: LimitRows
) -> tuple[list[Any], list[Any], list[Any]]:
    """Return starts, ends (c, 3, n) and limits (c, 2, n) in the solver's units, as lists.

    Setting lists costs the solver's face a third of setting arrays.
    """
    # Powers as floats have them: those of arrays may differ in the last digit.
    square, cube = np.array([(time**2, time**3) for time in times.tolist()]).reshape(-1, 2).T
    way = bounds.jerk / SOLVER_JERK * cube[:, None]
    units = np.stack((way, way / times[:, None], way / square[:, None]), axis=2)
    here, there = starts / units, ends / units
    there[..., 0] = (ends[..., 0] - starts[..., 0]) / way
    here[..., 0] = 0.0
    largest = np.stack((bounds.velocity, bounds.acceleration), axis=2) / units[..., 1:]
    return (
        here.swapaxes(1, 2).tolist(),
        there.swapaxes(1, 2).tolist(),
        (FULL * largest).swapaxes(1, 2).tolist(),
    )


def finish_many(solutions: Solutions, bounds: LimitRows) -> list[Join | None]:
    """Turn solutions, none of which is None, into joins; None for one that breaks its bounds."""
    joined: list[Join | None] = [None] * len(solutions.durations)
    if not joined:
        return joined
    tables = _tables(solutions, bounds)
    met = _meets(tables, solutions.ends, bounds)
    groups = [(np.flatnonzero(met), tables.take(met))]
    if not np.all(met):
        missed = np.flatnonzero(~met)
        starts, ends = solutions.starts[missed], solutions.ends[missed]
        groups.append((missed, _closed(tables.take(missed), starts, ends)))
    for rows, block in groups:
        own = bounds.take(rows)
        valid = block.keeps(own) & _meets(block, solutions.ends[rows], own)
        for index in np.flatnonzero(valid).tolist():
            joined[int(rows[index])] = Join(block.knots[index], block.coefficients[index])
    return joined


def _askable(states: Array, bounds: LimitRows) -> Mask:
    """Return which states (c, n, 3) the solver may be shown, (c,)."""
    slow = np.abs(states[..., 1]) < NEAREST_STATE * bounds.velocity
    gentle = np.abs(states[..., 2]) < NEAREST_STATE * bounds.acceleration
    askable: Mask = np.all(slow & gentle, axis=-1)
    return askable


def _tables(solutions: Solutions, bounds: LimitRows) -> Block:
    """Turn solutions into cubic pieces."""
    profiles = np.array(
        [
            [[*p.brake.t, *p.t, *p.brake.j, *p.j] for p in answer.profiles[0]]
            for answer in solutions.found
        ]
    )
    lengths = profiles[..., :_PIECES] * solutions.times[:, None, None]
    jerks = profiles[..., _PIECES:] * (bounds.jerk / SOLVER_JERK)[..., None]
    last = solutions.durations[:, None, None]
    knots = np.zeros((*profiles.shape[:2], _PIECES + 1))
    np.minimum(np.cumsum(lengths, axis=-1), last, out=knots[..., 1:])
    knots[..., -1:] = last
    return Block.from_jerks(solutions.starts, knots, jerks)


def _closed(block: Block, start: Array, end: Array) -> Block:
    """Change the jerks of tables from `start` as little as it takes to end in `end`.

    The solver is content with 1e-8 rad. Sampled each millisecond, such a jump is a jerk of
    10 rad/s³ and more. Knots at the quarters keep the change small: the fastest way to shift
    a joint a little, all else equal, changes its jerk there.
    """
    duration = block.durations[:, None, None]
    quarters = np.broadcast_to(duration * np.array([0.25, 0.5, 0.75]), (*start.shape[:2], 3))
    finer = np.sort(np.concatenate((block.knots, quarters), axis=-1), axis=-1)
    piece = np.sum(finer[..., :-1, None] >= block.knots[..., None, 1:-1], axis=-1)
    jerks = np.take_along_axis(block.coefficients[..., 3], piece, axis=-1)
    # What each jerk does to the end state, by the time that is left at its two knots.
    left = duration - finer
    effect = -np.diff(np.stack((left**3 / 6.0, left**2 / 2.0, left), axis=-2), axis=-1)
    # Makes the three rows comparable.
    scale = np.concatenate((np.ones_like(duration), duration, duration**2), axis=-1)
    closing = np.linalg.pinv(effect * scale[..., None])
    for _ in range(2):  # the second time for what rounding left of the first
        gap = (end - block.end) * scale
        jerks = jerks + np.einsum("cjik,cjk->cji", closing, gap)
        block = Block.from_jerks(start, finer, jerks)
    return block


def _meets(block: Block, end: Array, bounds: LimitRows) -> Mask:
    """Whether tables end in their state `end` (c, n, 3) but for rounding, (c,)."""
    rounding = _MISS * jump_rounding(bounds, block.durations)
    met: Mask = np.all(np.abs(end - block.end) <= rounding, axis=(1, 2))
    return met
