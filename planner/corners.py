"""Flying by a via point: leave one segment early, enter the next late, join the two states.

How far a corner is rounded. A join saves the time that it replaces minus its own. Joins found by
a perfect solver save the more the more of both ramps they replace, because to follow the ramps and
then a smaller join is one of the motions to choose from. The solver is not perfect: at a few
isolated states, such as those at a knot of a ramp, it misses the fastest join by far, or takes one
that breaks a limit. So it is asked at shares next to each other and the corner that saves most is
used; none is used that would be slower than to stop.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import chain
from typing import Final, Literal, NamedTuple

import numpy as np
import ruckig
from numpy.typing import NDArray

from planner.arrays import Array
from planner.blocks import Block, LimitRows
from planner.errors import UnsupportedSolver
from planner.limits import Bounds
from planner.piecewise_cubic import PiecewiseCubic
from planner.segments import StraightSegment
from planner.verify import jump_rounding

_SAMPLES = 65  # a join has one bend; its distance to the corner has one dip, now and then two
_STEPS = 60  # of Newton's method, four or five as a rule; halving alone would need about fifty
_RESOLUTION = 1e-15  # share of the duration: two times closer than this are one


# Which versions of the corner solver (community ruckig) this package was measured with.
#
# Its margins against crashes are measurements of one series of versions, not properties of the
# algorithm. So another version is not merely warned of: no corner is planned with it. Whatever
# does not fly by (stops, playing, reading of plans) works with any version.
SERIES: Final = "0.19"


def is_supported(version: str) -> bool:
    """Whether a version is of the series measured."""
    return version.split(".")[:2] == SERIES.split(".")


_VERSION: Final = str(getattr(ruckig, "__version__", "unknown"))
_SUPPORTED: Final = is_supported(_VERSION)


def require_solver() -> None:
    """Return if the installed solver is of the series measured.

    Raises:
        UnsupportedSolver: it is of another one.
    """
    if not _SUPPORTED:
        raise UnsupportedSolver(_VERSION, SERIES)


class Passing(NamedTuple):
    """Where a motion is nearest to a point.

    Attributes:
        time: When, from the beginning of the motion [s].
        distance: Euclidean distance in joint space [rad].
    """

    time: float
    distance: float


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


class Corner(NamedTuple):
    """How a via point is passed.

    Attributes:
        leave: Time cut from the end of the segment before [s].
        enter: Time cut from the beginning of the segment after [s].
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


class Solution(NamedTuple):
    """What the solver says.

    Attributes:
        duration: How long the motion takes [s].
        answer: All else, in the units in which it was asked.
        time: Unit of time [s].
        jerk: Unit of jerk of each joint (n,) [rad/s³].
    """

    duration: float
    answer: ruckig.Trajectory
    time: float
    jerk: Array

    def pieces(self) -> tuple[Array, Array]:
        """Return how long each constant jerk lasts [s], and the jerks [rad/s³], (n, m) each."""
        rows = [[*p.brake.t, *p.t, *p.brake.j, *p.j] for p in self.answer.profiles[0]]
        lengths, jerks = np.array(rows).reshape(len(self.jerk), 2, -1).swapaxes(0, 1)
        return lengths * self.time, jerks * self.jerk[:, None]


def fly_by(before: StraightSegment, after: StraightSegment, bounds: Bounds, share: float) -> Corner:
    """Round the corner between two segments as far as `share` asks and the bounds allow.

    The cut takes the share of the ramp before and of the ramp after the corner, so that no part
    of a segment goes to both of its corners. It never takes longer than to stop.
    """
    if share < LEAST_SHARE or before.slowing_down == 0.0 or after.speeding_up == 0.0:
        return STOP
    for tried in _candidates(before, after, bounds, share):
        joined = _finished(tried.solution, tried.start, tried.end, bounds)
        if joined is not None:
            how: How = "flown" if tried.share == share else "reduced"
            return Corner(tried.leave, tried.enter, joined, tried.share, how)
    return STOP


def fly_within(
    before: StraightSegment, after: StraightSegment, bounds: Bounds, distance: float
) -> Corner:
    """Round a corner as far as the path stays within `distance` [rad] of it, or stop.

    The path passes between 0.9 and 1 times the distance from the corner, or nearer where even
    the whole ramps lead it nearer or the bounds forbid to go farther.
    """
    best, saving = STOP, 0.0
    low, share, high = 0.0, 1.0, 1.0
    for _ in range(_SEARCH if distance > 0.0 else 0):
        corner = fly_by(before, after, bounds, share)
        if corner.join is None:
            break
        passed = passing(corner.join, after.start).distance
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


def ranked(savings: Array) -> NDArray[np.intp]:
    """Return the rows of savings (s, ...) [s] in the order in which to try corners, best first.

    Rows are those of `FIRST_SHARES`, -inf where no corner is known; the first, as a rule that
    asked for, comes first unless another one is clearly better. One that costs is not to be tried.
    """
    preferred = savings.copy()
    preferred[0] += BETTER
    return np.argsort(-preferred, axis=0, kind="stable")


class _Candidate(NamedTuple):
    """A corner that the solver was asked about, and knows an answer to."""

    share: float
    leave: float
    enter: float
    start: Array
    end: Array
    solution: Solution

    @property
    def saving(self) -> float:
        """Time gained against a stop [s]."""
        return self.leave + self.enter - self.solution.duration


def _candidates(
    before: StraightSegment, after: StraightSegment, bounds: Bounds, share: float
) -> Iterator[_Candidate]:
    """Give solved corners in the order in which they are to be tried."""
    ask = Solver(bounds, share * (before.slowing_down + after.speeding_up))
    first = _solved(before, after, ask, share, FIRST_SHARES)
    savings = np.array([-np.inf if each is None else each.saving for each in first])
    order = (first[i] for i in ranked(savings).tolist())
    last = (_solved(before, after, ask, share, (part,))[0] for part in LAST_SHARES)
    yield from (each for each in chain(order, last) if each is not None and each.saving >= 0.0)


def _solved(
    before: StraightSegment,
    after: StraightSegment,
    ask: Solver,
    share: float,
    parts: Sequence[float],
) -> list[_Candidate | None]:
    """Ask the solver for corners that take parts of a share; None where it knows none."""
    shares = share * np.array(parts)
    leave, enter = shares * before.slowing_down, shares * after.speeding_up
    starts, ends = before.states(before.duration - leave), after.states(enter)
    solutions = ask(starts, ends)
    return [
        None
        if solution is None
        else _Candidate(
            float(shares[i]), float(leave[i]), float(enter[i]), starts[i], ends[i], solution
        )
        for i, solution in enumerate(solutions)
    ]


def join(start: Array, end: Array, bounds: Bounds, time: float) -> PiecewiseCubic | None:
    """Plan the fastest motion between two states (n, 3) that keeps the bounds, if there is one.

    Rows are position, velocity and acceleration of a joint; all joints arrive together. `time`
    [s] is about how long it may take.

    Raises:
        UnsupportedSolver: the installed ruckig is not of the series measured.
    """
    solution = Solver(bounds, time)(start[None], end[None])[0]
    return None if solution is None else _finished(solution, start, end, bounds)


class Solver:
    """The solver, asked for one corner: for motions between two states within the same bounds.

    It works to absolute tolerances, such as 1e-8 of a position, that suit motions of some radians
    and seconds. So it is asked in units in which every joint's motion is such a one: `time` [s],
    which the motion takes at most about, and as much way as full jerk makes in a part of that.

    Raises:
        UnsupportedSolver: the installed ruckig is not of the series measured.
    """

    def __init__(self, bounds: Bounds, time: float) -> None:
        require_solver()
        self._n = len(bounds.velocity)
        self._time = time
        self._per_jerk = bounds.jerk / SOLVER_JERK
        way = self._per_jerk * time**3
        self._units = np.stack((way, way / time, way / time**2), axis=1)
        largest = np.stack((bounds.velocity, bounds.acceleration), axis=1)
        self._nearest = NEAREST_STATE * largest
        largest /= self._units[:, 1:]
        self._problem = ruckig.InputParameter(self._n)
        self._problem.synchronization = ruckig.Synchronization.Time
        self._problem.max_velocity, self._problem.max_acceleration = (FULL * largest.T).tolist()
        self._problem.max_jerk = [FULL * SOLVER_JERK] * self._n

    def __call__(self, starts: Array, ends: Array) -> list[Solution | None]:
        """Return motions between states (m, n, 3); None for any not to be asked for or unknown."""
        # Written so that NaN is refused too.
        askable = np.abs(starts[:, :, 1:]) < self._nearest
        askable &= np.abs(ends[:, :, 1:]) < self._nearest
        here, there = starts / self._units, ends / self._units
        there[:, :, 0] = (ends[:, :, 0] - starts[:, :, 0]) / self._units[:, 0]
        here[:, :, 0] = 0.0
        here_rows, there_rows = here.swapaxes(1, 2).tolist(), there.swapaxes(1, 2).tolist()
        return [
            self._solution(here_rows[i], there_rows[i]) if fair else None
            for i, fair in enumerate(np.all(askable, axis=(1, 2)))
        ]

    def _solution(self, here: list[list[float]], there: list[list[float]]) -> Solution | None:
        ask = self._problem
        ask.current_position, ask.current_velocity, ask.current_acceleration = here
        ask.target_position, ask.target_velocity, ask.target_acceleration = there
        answer = ruckig.Trajectory(self._n)
        try:
            ruckig.Ruckig(self._n).calculate(ask, answer)
        except REFUSALS:
            return None
        duration = float(answer.duration) * self._time
        return Solution(duration, answer, self._time, self._per_jerk)


def _finished(
    solution: Solution, start: Array, end: Array, bounds: Bounds
) -> PiecewiseCubic | None:
    """Turn a solution into cubic pieces that end in `end` and keep the bounds, if it does."""
    lengths, jerks = solution.pieces()
    knots = np.zeros((len(start), lengths.shape[1] + 1))
    knots[:, 1:] = np.minimum(np.cumsum(lengths, axis=1), solution.duration)
    knots[:, -1] = solution.duration
    table, reached = _integrated(start, knots, jerks)
    rounding = 0.1 * jump_rounding(bounds, solution.duration)
    if not (np.abs(end - reached) <= rounding).all():
        table, reached = _closed(start, end, knots, jerks, reached)
    if not (np.abs(end - reached) <= rounding).all():
        return None
    block = Block(table[0][None], table[1][None], reached[None])
    rows = LimitRows(
        *(bound[None] for bound in (bounds.lower, bounds.upper, bounds.velocity)),
        *(bound[None] for bound in (bounds.acceleration, bounds.jerk)),
    )
    return PiecewiseCubic(tuple(table[0]), tuple(table[1])) if block.keeps(rows)[0] else None


def _integrated(start: Array, knots: Array, jerks: Array) -> tuple[tuple[Array, Array], Array]:
    """Integrate constant jerks (n, m): the pieces (n, m, 4), and the states they end in (n, 3)."""
    x = knots[:, 1:] - knots[:, :-1]
    states = np.empty((len(start), jerks.shape[1] + 1, 3))
    states[:, 0] = start
    # In the order of operations in which a table is evaluated: so pieces meet to the last bit.
    np.multiply(jerks, x, out=states[:, 1:, 2])
    p, v, a = (states[:, :, i] for i in range(3))
    np.cumsum(a, axis=1, out=a)
    jx = jerks * x
    v[:, 1:] = x * (a[:, :-1] + jx * 0.5)
    np.cumsum(v, axis=1, out=v)
    p[:, 1:] = x * (v[:, :-1] + x * (a[:, :-1] * 0.5 + jx * (1.0 / 6.0)))
    np.cumsum(p, axis=1, out=p)
    pieces = np.concatenate((states[:, :-1], jerks[:, :, None]), axis=2)
    return (knots, pieces), states[:, -1]


def _closed(
    start: Array, end: Array, knots: Array, jerks: Array, reached: Array
) -> tuple[tuple[Array, Array], Array]:
    """Change the jerks of a motion from `start` as little as it takes to end in `end`.

    The solver is content with 1e-8 rad. Sampled each millisecond, such a jump is a jerk of
    10 rad/s³ and more. Knots at the quarters keep the change small: the fastest way to shift
    a joint a little, all else equal, changes its jerk there.
    """
    duration = knots[0, -1]
    quarters = np.broadcast_to(duration * np.array([0.25, 0.5, 0.75]), (len(start), 3))
    finer = np.sort(np.concatenate((knots, quarters), axis=1), axis=1)
    piece = np.sum(finer[:, :-1, None] >= knots[:, None, 1:-1], axis=2)
    jerks = np.take_along_axis(jerks, piece, axis=1)
    # What each jerk does to the end state, by the time that is left at its two knots.
    left = duration - finer
    effect = -np.diff(np.stack((left**3 / 6.0, left**2 / 2.0, left), axis=1), axis=2)
    scale = np.array([1.0, duration, duration**2])  # makes the three rows comparable
    closing = np.linalg.pinv(effect * scale[:, None])
    for _ in range(2):  # the second time for what rounding left of the first
        jerks = jerks + np.einsum("jik,jk->ji", closing, (end - reached) * scale)
        table, reached = _integrated(start, finer, jerks)
    return table, reached
