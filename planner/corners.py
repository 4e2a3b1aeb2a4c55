"""Flying by a via point: leave one move early, enter the next late, join the two states.

How far a corner is rounded. A join saves the time that it replaces minus its own. Joins found by
a perfect solver save the more the more of both ramps they replace, because to follow the ramps and
then a smaller join is one of the motions to choose from. The solver is not perfect: at a few
isolated states, such as those at a knot of a ramp, it misses the fastest join by far, or takes one
that breaks a limit. So it is asked at shares next to each other and the corner that saves most is
used; none is used that would be slower than to stop.

Many corners are joined at once: a join is solved in 10 µs, all else goes over all of them together.
Each number is made by the same operations whatever else is in the arrays, so a corner does not
depend on its company, to the last bit.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, Literal, NamedTuple

import numpy as np
import ruckig
from numpy.typing import NDArray

from planner.arrays import Array
from planner.errors import UnsupportedSolver
from planner.limits import Allowance, jump_rounding
from planner.piecewise_cubic import Block, Mask, PiecewiseCubic, Rows
from planner.straight import StraightMoves

# The margins against crashes of the corner solver (community ruckig) are measurements of one series
# of versions, not properties of the algorithm. So another version is not merely warned of: no
# corner is planned with it. Stops, playing and reading of plans work with any version.
SERIES: Final = "0.19"
_VERSION = str(getattr(ruckig, "__version__", "unknown"))

# Shares of the fly asked for that are compared, and those tried one by one if none of them will do.
FIRST_SHARES: Final = (1.0, 0.9999, 0.999, 0.99, 0.97)
LAST_SHARES: Final = (0.9, 0.5, 0.25, 0.125, 0.0625)
# A corner that takes less of its ramps than this cannot be distinguished from a stop: its path
# passes at some 1e-12 of the distance of a full one.
LEAST_SHARE: Final = 1e-4
# A join is preferred to that at the share asked for if it saves this much more [s].
BETTER: Final = 1e-9
# ruckig is never shown a state closer than this to its limits: it can crash the process there.
NEAREST_STATE: Final = 0.995
# Joins use the full limits but for a little room in which the last digits are closed.
FULL: Final = 0.999
# What ruckig raises where it finds no motion: now and then (1 in 200 000) it ends with an error
# number that its own Python face does not know, which is then a ValueError.
REFUSALS: Final = (ruckig.RuckigError, ValueError)
# Jerk limit in the units in which the solver is asked.
SOLVER_JERK: Final = 64.0
# Shares of a distance: what is aimed at, and from where on it is near enough; and how many corners
# a search for it may try.
_AIM: Final = 0.95
_NEAR_ENOUGH: Final = 0.9
_SEARCH: Final = 12
# A join may miss its end by this share of what counts as rounding between two pieces.
_MISS: Final = 0.1
# Of a solution: two to brake into the limits (of no length here), seven to move.
_PIECES: Final = 9


class Passing(NamedTuple):
    """Where a motion is nearest to a point.

    Attributes:
        time: When, from the beginning of the motion [s].
        distance: Euclidean distance in joint space [rad].
    """

    time: float
    distance: float


_SAMPLES = 65  # a join has one bend; its distance to the corner has one dip, now and then two
_STEPS = 60  # of Newton's method, four or five as a rule; halving alone would need about fifty
_RESOLUTION = 1e-15  # share of the duration: two times closer than this are one


def passing(motion: PiecewiseCubic, point: Array) -> Passing:
    """Return where `motion` comes nearest to `point` (n,) [rad].

    The distance is that of a point of the path, so that the true one is never larger: what is
    found to be within a tolerance is.
    """
    times = np.linspace(0.0, motion.duration, _SAMPLES)
    apart = motion.sample(times)[0] - point
    square = np.einsum("ij,ij->i", apart, apart)
    index = int(square.argmin())
    time, best = float(times[index]), float(square[index])
    low, high = float(times[max(index - 1, 0)]), float(times[min(index + 1, _SAMPLES - 1)])
    # At its ends a motion may rest, where the slope tells nothing.
    t = time if low < time < high else 0.5 * (low + high)
    for _ in range(_STEPS):
        q, qd, qdd = motion.sample_one(t)
        gap = q - point
        apart_here, slope = float(gap @ gap), float(gap @ qd)
        if apart_here < best:
            time, best = t, apart_here
        low, high = (t, high) if slope < 0.0 else (low, t)
        bend = float(qd @ qd + gap @ qdd)
        closer = t - slope / bend if bend > 0.0 else high
        if not low < closer < high:  # Newton's step is none: halve what is left
            closer = 0.5 * (low + high)
        if abs(closer - t) <= _RESOLUTION * motion.duration:
            break
        t = closer
    return Passing(time, float(np.sqrt(best)))


How = Literal["stopped", "flown", "reduced"]


class Corner(NamedTuple):
    """How a via point is passed.

    Attributes:
        leave: Time cut from the end of the move before [s].
        enter: Time cut from the beginning of the move after [s].
        join: What replaces them; None where the arm stops.
        share: Share of the ramps that the corner takes.
        how: "flown" as asked; "reduced": rounded less than asked; or "stopped".
    """

    leave: float
    enter: float
    join: PiecewiseCubic | None
    share: float = 0.0
    how: How = "stopped"


STOP: Final = Corner(0.0, 0.0, None)


def round_within(moves: StraightMoves, bounds: Allowance, distance: float) -> Corner:
    """Round the corner between two moves as far as the path stays within `distance` [rad] of it.

    The path passes between 0.9 and 1 times the distance from the corner, or nearer where even
    the whole ramps lead it nearer or the bounds (1, n) forbid to go farther; else it stops.
    """
    best, saving = STOP, 0.0
    low, share, high = 0.0, 1.0, 1.0
    first, second = np.arange(2)[:, None]
    for _ in range(_SEARCH if distance > 0.0 else 0):
        (corner,) = round_corners(moves, first, second, bounds, np.array([share]))
        if corner.join is None:
            break
        passed = passing(corner.join, moves.start[1]).distance
        if passed <= distance:
            if corner.leave + corner.enter - corner.join.duration >= saving:
                best = corner._replace(how="flown")
                saving = corner.leave + corner.enter - corner.join.duration
            if share == high or passed >= _NEAR_ENOUGH * distance:
                break
            low = share
        else:
            high = share
        # Near its point a path strays with the cube of the share, farther off with its square.
        share = corner.share * (_AIM * distance / passed) ** 0.4 if passed > 0.0 else high
        if not low < share < high:
            share = 0.5 * (low + high)
    return best


def round_corners(
    moves: StraightMoves, before: Rows, after: Rows, bounds: Allowance, fly: Array
) -> list[Corner]:
    """Round corners between two of the moves each as far as asked and the bounds allow.

    The cut takes the share of the ramp before and of the ramp after the corner, so that no part
    of a move goes to both of its corners. It never takes longer than to stop.

    Args:
        moves: The straight moves.
        before: Which of them lead to the corners (c,).
        after: Which lead on (c,).
        bounds: What each join may use (c, n).
        fly: Share of the ramps that each is asked to take (c,).

    Raises:
        UnsupportedSolver: a corner is to be rounded, and nothing is known about the solver.
    """
    corners = [STOP] * len(before)
    slowing, speeding = moves.slowing_down[before], moves.speeding_up[after]
    asked = np.flatnonzero((slowing > 0.0) & (speeding > 0.0) & (fly >= LEAST_SHARE))
    if len(asked) == 0:  # the solver is not even asked whether it is there
        return corners

    def cuts(rows: Rows, shares: Array) -> tuple[Array, Array]:
        return shares * slowing[rows], shares * speeding[rows]

    def solved(rows: Rows, shares: Array) -> Solutions:
        leave, enter = cuts(rows, shares)
        first, second = moves.take(before[rows]), moves.take(after[rows])
        starts, ends = first.states(first.durations - leave), second.states(enter)
        full = fly[rows] * (slowing[rows] + speeding[rows])
        return solve_many(starts, ends, full, bounds.take(rows))

    def finish(rows: Rows, shares: Array, solutions: Solutions) -> None:
        joins = finish_many(solutions, bounds.take(rows))
        leave, enter = (cut.tolist() for cut in cuts(rows, shares))
        for k, (row, share) in enumerate(zip(rows.tolist(), shares.tolist(), strict=True)):
            join = joins[k]
            if join is not None and join.duration <= leave[k] + enter[k]:
                how: How = "flown" if share == fly[row] else "reduced"
                corners[row] = Corner(leave[k], enter[k], join, share, how)

    def stopped(rows: Rows) -> Mask:
        return np.array([corners[row].join is None for row in rows.tolist()], dtype=np.bool_)

    shares = np.multiply.outer(FIRST_SHARES, fly[asked]).ravel()
    rows = np.tile(asked, len(FIRST_SHARES))
    candidates = solved(rows, shares)
    saving = sum(cuts(rows, shares)) - candidates.durations
    saving = saving.reshape(len(FIRST_SHARES), -1)
    for place in ranked(saving):
        picked = np.flatnonzero(np.take_along_axis(saving, place[None], axis=0)[0] >= 0.0)
        picked = picked[stopped(asked[picked])]
        if len(picked) > 0:
            chosen = place[picked] * len(asked) + picked
            finish(rows[chosen], shares[chosen], candidates.take(chosen))
    for part in LAST_SHARES:
        rows = asked[stopped(asked)]
        if len(rows) == 0:
            break
        shares = fly[rows] * part
        solutions = solved(rows, shares)
        found = np.flatnonzero(sum(cuts(rows, shares)) >= solutions.durations)
        finish(rows[found], shares[found], solutions.take(found))
    return corners


def ranked(savings: Array) -> NDArray[np.intp]:
    """Return the rows of savings (s, ...) [s] in the order in which to try corners, best first.

    Rows are those of `FIRST_SHARES`, -inf where no corner is known; the first, as a rule that
    asked for, comes first unless another one is clearly better. One that costs is not to be tried.
    """
    preferred = savings.copy()
    preferred[0] += BETTER
    return np.argsort(-preferred, axis=0, kind="stable")


class Solutions(NamedTuple):
    """What the solver found for many joins, not yet checked.

    Attributes:
        starts: Position, velocity and acceleration of the joints at each start, (c, n, 3).
        ends: The same at each end, (c, n, 3); all joints arrive together.
        times: Unit of time in which each was asked for (c,) [s].
        durations: Length in time of each join (c,) [s]; infinite where there is none.
        found: The solver's own results (c,), in its units; None where there is none.
    """

    starts: Array
    ends: Array
    times: Array
    durations: Array
    found: NDArray[np.object_]

    def take(self, rows: Rows) -> Solutions:
        """Return some of the solutions, by index."""
        fields: list[Any] = [field[rows] for field in self]
        return Solutions(*fields)


def solve_many(starts: Array, ends: Array, times: Array, bounds: Allowance) -> Solutions:
    """Find the fastest motions between two states (c, n, 3) each under limits (c, n).

    Args:
        starts: Position, velocity and acceleration of the joints at each start.
        ends: The same at each end; all joints arrive together.
        times: About how long each may take (c,) [s].
        bounds: What each may use.

    Raises:
        UnsupportedSolver: the solver is of a version that nothing is known about.
    """
    if _VERSION.split(".")[:2] != SERIES.split("."):
        raise UnsupportedSolver(
            f"ruckig {_VERSION} is installed; corners are planned with {SERIES}.x only, whose "
            "behaviour near its limits is known"
        )
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
        result = ruckig.Trajectory(n_joints)
        try:
            solver.calculate(problem, result)
        except REFUSALS:
            continue
        durations[row], found[row] = result.duration * time, result
    return Solutions(starts, ends, times, durations, found)


def _askable(states: Array, bounds: Allowance) -> Mask:
    """Return which states (c, n, 3) the solver may be shown, (c,)."""
    slow = np.abs(states[..., 1]) < NEAREST_STATE * bounds.velocity
    gentle = np.abs(states[..., 2]) < NEAREST_STATE * bounds.acceleration
    askable: Mask = np.all(slow & gentle, axis=-1)
    return askable


def _in_units(starts: Array, ends: Array, times: Array, bounds: Allowance) -> Sequence[list[Any]]:
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
    largest = FULL * (np.stack((bounds.velocity, bounds.acceleration), axis=2) / units[..., 1:])
    return [each.swapaxes(1, 2).tolist() for each in (here, there, largest)]


def finish_many(solutions: Solutions, bounds: Allowance) -> list[PiecewiseCubic | None]:
    """Turn solutions, none of which is None, into joins; None for one that breaks its bounds."""
    joined: list[PiecewiseCubic | None] = [None] * len(solutions.durations)
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
            pieces = tuple(block.knots[index]), tuple(block.coefficients[index])
            joined[int(rows[index])] = PiecewiseCubic(*pieces)
    return joined


def _tables(solutions: Solutions, bounds: Allowance) -> Block:
    """Turn solutions into cubic pieces."""
    profiles = np.array(
        [
            [[*p.brake.t, *p.t, *p.brake.j, *p.j] for p in result.profiles[0]]
            for result in solutions.found
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


def _meets(block: Block, end: Array, bounds: Allowance) -> Mask:
    """Whether tables end in their state `end` (c, n, 3) but for rounding, (c,)."""
    rounding = _MISS * jump_rounding(bounds, block.durations)
    met: Mask = np.all(np.abs(end - block.end) <= rounding, axis=(1, 2))
    return met
