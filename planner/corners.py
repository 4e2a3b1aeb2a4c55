"""Straight moves from rest to rest, many together, and the fly-by corners that join them.

One scalar profile of seven pieces along each line keeps it straight for any ratio between the
limits of the joints; ruckig's phase synchronisation does not. Results do not depend on what else is
in the arrays.

With an ideal solver, the more of both ramps a join replaces the more time it saves. ruckig misses
the fastest join at a few isolated states, such as those at a knot of a ramp, or returns one that
breaks a limit. So neighbouring shares of the ramps are compared and the corner that saves most is
used; a corner slower than a stop is not used.

Many corners are computed together: a join takes 10 µs, everything else is vectorised. Results do
not depend on what else is in the arrays, to the last bit.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import cbrt
from typing import Any, Final, Literal, NamedTuple

import numpy as np
import ruckig
from numpy.typing import NDArray

from planner.arrays import Array
from planner.errors import UnsupportedSolver
from planner.limits import Allowance, jump_rounding
from planner.piecewise_cubic import Block, Mask, PiecewiseCubic, Rows, after

# Shorter moves [rad] are rests: their times would underflow.
_MIN_MOVE: Final = 1e-200


class StraightMoves(NamedTuple):
    """Straight moves of all joints in phase; the slowest joint determines the time.

    Attributes:
        start: Start of each (s, n) [rad].
        direction: Change of the joints per unit of path, largest entry 1, (s, n).
        knots: Times of the profile (s, 8) [s].
        pieces: Path and its two rates at the start of each piece, and its jerk, (s, 7, 4).
        speeding_up, slowing_down: Time from rest to the highest speed and back (s,) [s].
    """

    start: Array
    direction: Array
    knots: Array
    pieces: Array
    speeding_up: Array
    slowing_down: Array

    @classmethod
    def between(
        cls, starts: Array, ends: Array, bounds: Allowance, deceleration: Array
    ) -> StraightMoves:
        """Plan the fastest straight moves between positions.

        Args:
            starts: positions (s, n) [rad].
            ends: positions (s, n) [rad].
            bounds: of velocity, acceleration and jerk (s, n).
            deceleration: bound of the slowing down (s, n) [rad/s²].
        """
        change = ends - starts
        length = np.max(np.abs(change), axis=1)
        moves = length > _MIN_MOVE
        direction = change / np.where(moves, length, 1.0)[:, None]
        with np.errstate(divide="ignore", over="ignore"):
            along = [
                np.where(moves, np.min(bound / np.abs(direction), axis=1), 1.0)
                for bound in (bounds.velocity, bounds.acceleration, deceleration, bounds.jerk)
            ]
        knots, pieces, *ramps = rest_to_rest(np.where(moves, length, 1.0), *along)
        knots *= moves[:, None]
        pieces *= moves[:, None, None]
        return cls(starts, direction, knots, pieces, ramps[0] * moves, ramps[1] * moves)

    def take(self, rows: Rows) -> StraightMoves:
        """Return moves by index."""
        return StraightMoves(*(field[rows] for field in self))

    @property
    def durations(self) -> Array:
        """Length in time (s,) [s]."""
        last: Array = self.knots[:, -1]
        return last

    def states(self, t: Array) -> Array:
        """Return position, velocity, acceleration (s, n, 3) of each at its time `t` (s,) [s]."""
        along = self._along(t)
        states = self.direction[:, :, None] * along[:, None, :3]
        states[..., 0] += self.start
        return states

    def cut(self, begin: Array, end: Array) -> tuple[Array, Array]:
        """Return knots from 0 (s, 8) [s] and pieces (s, n, 7, 4) between two times (s,) [s].

        Pieces outside have zero length and the state at the cut.
        """
        begin = begin[:, None]
        end = end[:, None]
        knots = np.clip(self.knots, begin, end)
        pieces = self.pieces.copy()
        moved = knots[:, :-1] - self.knots[:, :-1]
        pieces[..., :3] = np.stack(after(np.moveaxis(self.pieces, -1, 0), moved), axis=-1)
        for outside, at in (
            (self.knots[:, 1:] <= begin, begin[:, 0]),
            (self.knots[:, :-1] >= end, end[:, 0]),
        ):
            np.copyto(pieces, self._along(at)[:, None, :], where=outside[..., None])
        table = self.direction[:, :, None, None] * pieces[:, None]
        table[..., 0] += self.start[:, :, None]
        return knots - begin, table

    def tables(self, begin: Array, end: Array) -> list[PiecewiseCubic]:
        """Return the parts between two times (s,) [s], each starting at time 0."""
        knots, pieces = self.cut(begin, end)
        each = np.broadcast_to(knots[:, None], (*pieces.shape[:2], knots.shape[1]))
        return Block.of_pieces(each, pieces).tables()

    def _along(self, t: Array) -> Array:
        """Return path, its two rates and its jerk at one time in each move, (s, 4)."""
        index = np.sum(self.knots[:, 1:-1] <= t[:, None], axis=1)
        rows = np.arange(len(t))
        pieces = self.pieces[rows, index].T
        return np.stack((*after(pieces, t - self.knots[rows, index]), pieces[3]), axis=-1)


def rest_to_rest(
    distance: Array, velocity: Array, acceleration: Array, deceleration: Array, jerk: Array
) -> tuple[Array, Array, Array, Array]:
    """Plan the fastest scalar moves that start and end at rest.

    Args:
        distance: of each move, > 0 (s,).
        velocity: largest (s,).
        acceleration: largest while speeding up (s,).
        deceleration: largest while slowing down (s,).
        jerk: largest (s,).

    Returns:
        Knots (s, 8) [s], pieces (s, 7, 4), and the times of speeding up and slowing down (s,) [s].
    """
    rates = acceleration, deceleration
    ramps = [_pulse(velocity, rate, jerk) for rate in rates]
    # Velocity rises and falls symmetrically about its half.
    cruises = distance > velocity * sum(2.0 * rise + flat for rise, flat in ramps) / 2.0
    short = _half_pulse(distance, np.maximum(*rates), jerk)
    ramps = [_where(cruises, ramp, short) for ramp in ramps]
    unlike = ~cruises & (acceleration != deceleration)
    if np.any(unlike):
        peak = jerk * short[0] * (short[0] + short[1])
        peak = np.minimum(_peak(distance, peak, rates, jerk), velocity)
        ramps = [
            _where(unlike, _pulse(peak, rate, jerk), ramp)
            for rate, ramp in zip(rates, ramps, strict=True)
        ]

    # The second ramp is computed backwards from rest, so that no rounding error of the acceleration
    # is integrated over a long cruise.
    (p1, v1, a1, p2, v2, p3, v3), (p4, v4, a4, p5, v5, p6, v6) = (_ramp(*r, jerk) for r in ramps)
    cruise = np.where(cruises, (distance - p3 - p6) / v3, 0.0)
    zero = np.zeros_like(distance)
    pieces = np.array(
        [
            (zero, zero, zero, jerk),
            (p1, v1, a1, zero),
            (p2, v2, a1, -jerk),
            (p3, v3, zero, zero),
            (distance - p6, v6, zero, -jerk),
            (distance - p5, v5, -a4, zero),
            (distance - p4, v4, -a4, jerk),
        ]
    )
    (up, high), (down, low) = ramps
    knots = np.cumsum(np.stack((zero, up, high, up, cruise, down, low, down), axis=-1), axis=-1)
    return knots, np.moveaxis(pieces, -1, 0), 2.0 * up + high, 2.0 * down + low


_Pulse = tuple[Array, Array]
"""Acceleration pulses: rise time, equal to the fall time, and flat time (s,) [s]."""


def _pulse(velocity_change: Array, acceleration: Array, jerk: Array) -> _Pulse:
    """Return the shortest pulses with this change of velocity."""
    rise = np.minimum(acceleration / jerk, np.sqrt(velocity_change / jerk))
    return rise, np.maximum(velocity_change / (jerk * rise) - rise, 0.0)


def _half_pulse(distance: Array, acceleration: Array, jerk: Array) -> _Pulse:
    """Return the pulses that cover a distance with their mirror images, without a cruise."""
    rise = acceleration / jerk
    # peak velocity a (rise + flat), held on average for 2 rise + flat
    flat = (np.sqrt(rise * rise + 4.0 * distance / acceleration) - 3.0 * rise) / 2.0
    holds = distance >= 2.0 * acceleration * rise * rise
    # The shortest do not reach full acceleration. Roots of floats: those of arrays may differ in
    # the last digit.
    rise[~holds] = [cbrt(cube) for cube in (distance / (2.0 * jerk))[~holds].tolist()]
    return rise, np.where(holds, np.maximum(flat, 0.0), 0.0)


def _where(which: Any, pulses: _Pulse, others: _Pulse) -> _Pulse:
    return np.where(which, pulses[0], others[0]), np.where(which, pulses[1], others[1])


def _ramp(rise: Array, flat: Array, jerk: Array) -> tuple[Array, ...]:
    """Return path and rates at the ends of the three pieces of a ramp from rest."""
    a1 = jerk * rise
    v1 = a1 * rise / 2.0
    p1 = v1 * rise / 3.0
    v2 = v1 + a1 * flat
    p2 = p1 + flat * (v1 + a1 * flat / 2.0)
    v3 = v2 + v1
    p3 = p2 + rise * (v2 + a1 * rise / 3.0)
    return p1, v1, a1, p2, v2, p3, v3


def _peak(distance: Array, above: Array, rates: tuple[Array, Array], jerk: Array) -> Array:
    """Return the peak velocity, at most `above`, of two different ramps that cover a distance.

    The distance is convex in the peak, so Newton's method from above converges monotonically.
    """
    peak = above
    for _ in range(60):
        way, slope = np.zeros((2, len(peak)))
        for rate in rates:
            rise, flat = _pulse(peak, rate, jerk)
            way += peak * (2.0 * rise + flat) / 2.0
            held = peak / rate + rate / (2.0 * jerk)
            slope += np.where(rise == rate / jerk, held, 1.5 * rise)
        closer = peak - (way - distance) / slope
        if not np.any(closer < peak):
            break
        peak = np.minimum(closer, peak)
    return peak


# Margins against crashes were measured for this series of ruckig; corners need it.
RUCKIG_SERIES: Final = "0.19"
_RUCKIG_VERSION = str(getattr(ruckig, "__version__", "unknown"))

# Shares of the requested fly that are compared, and those tried one by one if none of them works.
FIRST_FLY_SHARES: Final = (1.0, 0.9999, 0.999, 0.99, 0.97)
LAST_FLY_SHARES: Final = (0.9, 0.5, 0.25, 0.125, 0.0625)
# Smaller shares of the ramps are treated as stops.
MIN_FLY_SHARE: Final = 1e-4
# A join is preferred to that of the requested share if it saves this much more [s].
MIN_TIME_SAVED: Final = 1e-9
# States closer to their limits than this can crash ruckig, and are not passed to it.
MAX_STATE_SHARE: Final = 0.995
# Joins use this share of the limits; `_closed` uses the rest.
LIMIT_SHARE: Final = 0.999
# Errors of ruckig where it finds no motion; one in 200 000 is an unknown error number (ValueError).
SOLVER_ERRORS: Final = (ruckig.RuckigError, ValueError)
# Jerk limit in the units passed to ruckig.
SOLVER_JERK: Final = 64.0
# Largest error of a join's end, as a share of the tolerance on jumps.
_END_ERROR_SHARE: Final = 0.1
# Pieces of a ruckig profile: two to brake into the limits (of zero length here), seven to move.
_PROFILE_PIECES: Final = 9


class Passing(NamedTuple):
    """Time [s] and Euclidean distance [rad] at which a motion is nearest to a point."""

    time: float
    distance: float


_SEARCH_SAMPLES = 65  # to find the minimum: a join has one, sometimes two
# of Newton's method; mostly four or five are needed, bisection alone takes fifty
_MAX_NEWTON_STEPS = 60
_TIME_RESOLUTION = 1e-15  # of the time, as a share of the duration


def passing(motion: PiecewiseCubic, point: Array) -> Passing:
    """Return where `motion` is nearest to `point` (n,) [rad].

    The distance of one point of the path, hence an upper bound of the true one.
    """
    times = np.linspace(0.0, motion.duration, _SEARCH_SAMPLES)
    apart = motion.sample(times)[0] - point
    square = np.einsum("ij,ij->i", apart, apart)
    index = int(square.argmin())
    time = float(times[index])
    best = float(square[index])
    low = float(times[max(index - 1, 0)])
    high = float(times[min(index + 1, _SEARCH_SAMPLES - 1)])
    # At its ends a motion may rest, where the slope is zero.
    t = time if low < time < high else 0.5 * (low + high)
    for _ in range(_MAX_NEWTON_STEPS):
        q, qd, qdd = motion.sample_one(t)
        gap = q - point
        apart_here = float(gap @ gap)
        slope = float(gap @ qd)
        if apart_here < best:
            time = t
            best = apart_here
        low, high = (t, high) if slope < 0.0 else (low, t)
        bend = float(qd @ qd + gap @ qdd)
        closer = t - slope / bend if bend > 0.0 else high
        if not low < closer < high:  # bisect where Newton's step fails
            closer = 0.5 * (low + high)
        if abs(closer - t) <= _TIME_RESOLUTION * motion.duration:
            break
        t = closer
    return Passing(time, float(np.sqrt(best)))


How = Literal["stopped", "flown", "reduced"]


class Corner(NamedTuple):
    """Passage of a via point.

    `leave` and `enter` are the times cut from the end of the previous move and the beginning of the
    next one [s], `join` the motion in their place (None for a stop), `share` its share of the
    ramps.
    """

    leave: float
    enter: float
    join: PiecewiseCubic | None
    share: float = 0.0
    how: How = "stopped"


STOP: Final = Corner(0.0, 0.0, None)


def round_corners(
    moves: StraightMoves, before: Rows, after: Rows, bounds: Allowance, fly: Array
) -> list[Corner]:
    """Round corners between moves as requested.

    A corner takes the same share of the ramps before and after it, so that no part of a move
    belongs to two corners. It never takes longer than a stop.

    Args:
        moves: straight ones.
        before: row of the move before each corner (c,).
        after: row of the move after each corner (c,).
        bounds: of the corners (c, n).
        fly: share of the ramps that is requested (c,).

    Raises:
        UnsupportedSolver: a corner is to be rounded with an untested version of ruckig.
    """
    corners = [STOP] * len(before)
    slowing = moves.slowing_down[before]
    speeding = moves.speeding_up[after]
    requested = np.flatnonzero((slowing > 0.0) & (speeding > 0.0) & (fly >= MIN_FLY_SHARE))
    if len(requested) == 0:  # stops need no solver, of whatever version
        return corners

    def cuts(rows: Rows, shares: Array) -> tuple[Array, Array]:
        return shares * slowing[rows], shares * speeding[rows]

    def solved(rows: Rows, shares: Array) -> Solutions:
        leave, enter = cuts(rows, shares)
        first = moves.take(before[rows])
        second = moves.take(after[rows])
        starts = first.states(first.durations - leave)
        ends = second.states(enter)
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

    shares = np.multiply.outer(FIRST_FLY_SHARES, fly[requested]).ravel()
    rows = np.tile(requested, len(FIRST_FLY_SHARES))
    candidates = solved(rows, shares)
    saving = sum(cuts(rows, shares)) - candidates.durations
    saving = saving.reshape(len(FIRST_FLY_SHARES), -1)
    for index in ranked(saving):
        picked = np.flatnonzero(np.take_along_axis(saving, index[None], axis=0)[0] >= 0.0)
        picked = picked[stopped(requested[picked])]
        if len(picked) > 0:
            chosen = index[picked] * len(requested) + picked
            finish(rows[chosen], shares[chosen], candidates.take(chosen))
    for part in LAST_FLY_SHARES:
        rows = requested[stopped(requested)]
        if len(rows) == 0:
            break
        shares = fly[rows] * part
        solutions = solved(rows, shares)
        successes = np.flatnonzero(sum(cuts(rows, shares)) >= solutions.durations)
        finish(rows[successes], shares[successes], solutions.take(successes))
    return corners


def ranked(savings: Array) -> NDArray[np.intp]:
    """Return the order in which to try the rows of savings (s, ...) [s], best first.

    Rows are those of `FIRST_FLY_SHARES`, -inf where there is no corner; the first, which was
    requested, comes first unless another is better by `MIN_TIME_SAVED`.
    """
    preferred = savings.copy()
    preferred[0] += MIN_TIME_SAVED
    return np.argsort(-preferred, axis=0, kind="stable")


class Solutions(NamedTuple):
    """Unchecked solutions of ruckig for many joins.

    `starts` and `ends` are position, velocity and acceleration of the joints (c, n, 3); `times` the
    unit of time of each (c,) [s]; `durations` (c,) [s] are infinite, and `trajectories` (in
    normalised units) None, where there is no join.
    """

    starts: Array
    ends: Array
    times: Array
    durations: Array
    trajectories: NDArray[np.object_]

    def take(self, rows: Rows) -> Solutions:
        """Return solutions by index."""
        fields: list[Any] = [field[rows] for field in self]
        return Solutions(*fields)


def solve_many(starts: Array, ends: Array, times: Array, bounds: Allowance) -> Solutions:
    """Find the fastest motions between states, in which all joints arrive together.

    Args:
        starts: position, velocity and acceleration of each joint (c, n, 3).
        ends: likewise (c, n, 3).
        times: expected durations (c,) [s].
        bounds: limits (c, n).

    Raises:
        UnsupportedSolver: ruckig is of another series than `RUCKIG_SERIES`.
    """
    if _RUCKIG_VERSION.split(".")[:2] != RUCKIG_SERIES.split("."):
        raise UnsupportedSolver(
            f"ruckig {_RUCKIG_VERSION} is installed; corners are planned with"
            f" {RUCKIG_SERIES}.x only"
        )
    n_joints = starts.shape[1]
    problem = ruckig.InputParameter(n_joints)
    problem.synchronization = ruckig.Synchronization.Time
    problem.max_jerk = [LIMIT_SHARE * SOLVER_JERK] * n_joints
    solver = ruckig.Ruckig(n_joints)
    durations = np.full(len(starts), np.inf)
    results = np.full(len(starts), None, dtype=np.object_)
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
        except SOLVER_ERRORS:
            continue
        durations[row] = result.duration * time
        results[row] = result
    return Solutions(starts, ends, times, durations, results)


def _askable(states: Array, bounds: Allowance) -> Mask:
    """Whether states (c, n, 3) are far enough from their limits for ruckig, (c,)."""
    slow = np.abs(states[..., 1]) < MAX_STATE_SHARE * bounds.velocity
    gentle = np.abs(states[..., 2]) < MAX_STATE_SHARE * bounds.acceleration
    askable: Mask = np.all(slow & gentle, axis=-1)
    return askable


def _in_units(starts: Array, ends: Array, times: Array, bounds: Allowance) -> Sequence[list[Any]]:
    """Return starts, ends (c, 3, n) and limits (c, 2, n) in the solver's units, as lists.

    ruckig reads lists three times as fast as arrays.
    """
    # Powers of floats: powers of arrays may differ in the last digit.
    square, cube = np.array([(time**2, time**3) for time in times.tolist()]).reshape(-1, 2).T
    way = bounds.jerk / SOLVER_JERK * cube[:, None]
    units = np.stack((way, way / times[:, None], way / square[:, None]), axis=2)
    here = starts / units
    there = ends / units
    there[..., 0] = (ends[..., 0] - starts[..., 0]) / way
    here[..., 0] = 0.0
    largest = LIMIT_SHARE * (
        np.stack((bounds.velocity, bounds.acceleration), axis=2) / units[..., 1:]
    )
    return [each.swapaxes(1, 2).tolist() for each in (here, there, largest)]


def finish_many(solutions: Solutions, bounds: Allowance) -> list[PiecewiseCubic | None]:
    """Return the joins of solutions that exist; None for one that breaks its bounds."""
    joined: list[PiecewiseCubic | None] = [None] * len(solutions.durations)
    if not joined:
        return joined
    tables = _tables(solutions, bounds)
    met = _meets(tables, solutions.ends, bounds)
    groups = [(np.flatnonzero(met), tables.take(met))]
    if not np.all(met):
        missed = np.flatnonzero(~met)
        starts = solutions.starts[missed]
        ends = solutions.ends[missed]
        groups.append((missed, _closed(tables.take(missed), starts, ends)))
    for rows, block in groups:
        block_bounds = bounds.take(rows)
        valid = block.satisfies(block_bounds) & _meets(block, solutions.ends[rows], block_bounds)
        for index in np.flatnonzero(valid).tolist():
            pieces = tuple(block.knots[index]), tuple(block.coefficients[index])
            joined[int(rows[index])] = PiecewiseCubic(*pieces)
    return joined


def _tables(solutions: Solutions, bounds: Allowance) -> Block:
    """Return the cubic pieces of solutions."""
    profiles = np.array(
        [
            [[*p.brake.t, *p.t, *p.brake.j, *p.j] for p in result.profiles[0]]
            for result in solutions.trajectories
        ]
    )
    lengths = profiles[..., :_PROFILE_PIECES] * solutions.times[:, None, None]
    jerks = profiles[..., _PROFILE_PIECES:] * (bounds.jerk / SOLVER_JERK)[..., None]
    last = solutions.durations[:, None, None]
    knots = np.zeros((*profiles.shape[:2], _PROFILE_PIECES + 1))
    np.minimum(np.cumsum(lengths, axis=-1), last, out=knots[..., 1:])
    knots[..., -1:] = last
    return Block.from_jerks(solutions.starts, knots, jerks)


def _closed(block: Block, start: Array, end: Array) -> Block:
    """Change the jerks of motions from `start` by least squares such that they end in `end`.

    ruckig is exact to 1e-8 rad: sampled each millisecond, a jump by that is a jerk of 10 rad/s³
    and more. Additional knots at the quarters keep the changes of jerk small.
    """
    duration = block.durations[:, None, None]
    quarters = np.broadcast_to(duration * np.array([0.25, 0.5, 0.75]), (*start.shape[:2], 3))
    finer = np.sort(np.concatenate((block.knots, quarters), axis=-1), axis=-1)
    piece = np.sum(finer[..., :-1, None] >= block.knots[..., None, 1:-1], axis=-1)
    jerks = np.take_along_axis(block.coefficients[..., 3], piece, axis=-1)
    # Effect of each jerk on the end state, from the time left at its two knots.
    remaining = duration - finer
    effect = -np.diff(
        np.stack((remaining**3 / 6.0, remaining**2 / 2.0, remaining), axis=-2), axis=-1
    )
    # Makes the three rows comparable.
    scale = np.concatenate((np.ones_like(duration), duration, duration**2), axis=-1)
    closing = np.linalg.pinv(effect * scale[..., None])
    for _ in range(2):  # the second removes rounding errors of the first
        gap = (end - block.end) * scale
        jerks = jerks + np.einsum("cjik,cjk->cji", closing, gap)
        block = Block.from_jerks(start, finer, jerks)
    return block


def _meets(block: Block, end: Array, bounds: Allowance) -> Mask:
    """Whether motions end in the states `end` (c, n, 3) within rounding, (c,)."""
    rounding = _END_ERROR_SHARE * jump_rounding(bounds, block.durations)
    met: Mask = np.all(np.abs(end - block.end) <= rounding, axis=(1, 2))
    return met
