r"""First-order change of criteria and constraints of a motion with its genes.

The slope of a function :math:`F(\Phi^T\Phi)` along a motion is that of
:math:`\sum_t \mathrm{tr}(\Phi_t M \Phi_t^T)` with :math:`M = \partial F / \partial(\Phi^T\Phi)`. It
needs the regressor only near the sampled states, whatever the number of genes; how the states
change with a gene follows from the interpolator, which plans each gene with a small step.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.excitation.collision import CollisionChecker
from identification.excitation.constraints import Constraints, CurrentModel, midpoints, sampled
from identification.excitation.criteria import Objective
from identification.excitation.genomes import Genome, ViaPointGenome
from identification.excitation.searches.local_change import LocalChange, PlannedMoves
from identification.model.motion import Motion
from planner import PlannerError


class SensitivityProblem(Protocol):
    """What a sensitivity needs of a search's problem."""

    @property
    def genome(self) -> Genome:
        """Decodes genes."""

    @property
    def objective(self) -> Objective:
        """Evaluates excitation."""

    @property
    def constraints(self) -> Constraints:
        """Of every motion."""

    @property
    def period(self) -> float:
        """Of the samples at which loads are checked [s]."""


_SAMPLE_PERIOD: Final = 0.022  # s, at most; steps along slopes of twice that gain less
_MIN_SAMPLES: Final = 900
_GENE_STEP: Final = 1e-4
_POSITION_STEP: Final = 1e-3  # rad or m
_VELOCITY_STEP: Final = 1e-3  # rad/s or m/s, at least
_ACCELERATION_STEP: Final = 1.0  # exact: the regressor is linear in accelerations
_DURATION_STEP: Final = 1e-3  # relative
_MIN_LOAD_SHARE: Final = 0.75  # loads above this fraction of the limit are followed
# pairs of bodies closer than this to their least distance are followed [m]
_NEAR_DISTANCE: Final = 0.08
_BOUND_RESERVE: Final = 1e-3  # margin to each bound, relative, above the rounding of a check
# m, likewise: the check of a motion does not resolve a distance at its bound
_DISTANCE_RESERVE: Final = 1e-3


class Margin(NamedTuple):
    """What is left to the bound of a load or a distance, and its slopes by the states there."""

    time: float  # s
    states: Array  # position, velocity and acceleration (3, n)
    slope: Array  # by these (3, n)
    left: float  # negative if violated


class Margins(NamedTuple):
    """Times, states and slopes of the c margins of a motion."""

    time: Array  # (c,) [s]
    states: Array  # (3, c, n)
    slope: Array  # (3, c, n)

    @classmethod
    def of(cls, margins: Sequence[Margin], n: int) -> Self:
        """Stack the margins of an arm of n joints."""
        time = np.array([margin.time for margin in margins])
        states = np.array([margin.states for margin in margins]).reshape(-1, 3, n)
        slope = np.array([margin.slope for margin in margins]).reshape(-1, 3, n)
        return cls(time, states.transpose(1, 0, 2), slope.transpose(1, 0, 2))


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """Slopes of a motion's criterion and constraints by its states."""

    time: Array  #: the middles of equal steps (N,) [s]
    states: Array  #: position, velocity and acceleration then (3, N, n)
    duration: float  #: of the motion [s]
    criterion: Array  #: slopes of the criterion by the states (3, N, n)
    values: Array  #: first-order share of each state in the criterion (N,)
    #: of the criterion by the duration [1/s]: a longer motion weighs more against given recordings
    by_duration: float
    margins: Margins  #: of loads and distances
    left: Array  #: (1 + c,) to the longest duration [s], then of the margins; negative if violated
    moves: PlannedMoves | None  #: of the motion; None where a gene changes all of it

    def slopes(self, change: LocalChange, step: float) -> Array:
        """Return the slopes (2 + c,) of criterion, duration's and other margins for one gene.

        `change` of the motion, for a change of the gene by `step`. States keep their places in the
        part that changes.
        """
        part = slice(*np.searchsorted(self.time, (change.enter, change.left)).tolist())
        margins = self.margins
        near = np.flatnonzero((margins.time >= change.enter) & (margins.time <= change.left))
        states = change.states(np.concatenate((self.time[part], margins.time[near])))
        before = np.concatenate((self.states[:, part], margins.states[:, near]), axis=1)
        by_step = (states - before) / step
        longer = change.later / step
        # A longer part has a larger share in the motion, and the others have smaller ones.
        share = self.values[part].sum() / change.length - self.values.sum() / self.duration
        count = part.stop - part.start
        slopes = np.zeros(1 + len(self.left))
        slopes[0] = np.sum(self.criterion[:, part] * by_step[:, :count])
        slopes[0] += (share + self.by_duration) * longer
        slopes[1] = -longer
        slopes[2 + near] = np.sum(margins.slope[:, near] * by_step[:, count:], axis=(0, 2))
        return slopes


class Linearisation(NamedTuple):
    """Criterion and margins of a motion to first order in its genes."""

    gradient: Array  #: of the criterion (n_genes,)
    rows: Array  #: gradients of the margins (1 + c, n_genes)
    left: Array  #: the margins (1 + c,); negative if violated


def sensitivity_of(problem: SensitivityProblem, genes: Array, weights: Array | None) -> Sensitivity:
    """Return the slopes of `weights` (d,) times the criteria, and of the margins, by the states.

    Without weights, of minus the logarithm of the criterion of the required precision.

    Raises:
        PlannerError: the motion cannot be planned.
    """
    (motion,) = problem.genome.motions(genes[None])
    if isinstance(motion, PlannerError):
        raise motion
    middles = midpoints(motion, min(_SAMPLE_PERIOD, motion.duration / _MIN_SAMPLES))
    time = middles.time
    states = _states(middles)
    constraints = problem.constraints
    n = states.shape[2]
    steps = _steps(states)
    steps[1] = np.maximum(steps[1], _velocity_change(states[1]))
    margins: list[Margin] = []
    if constraints.currents is not None:
        margins += _loads(constraints.currents, sampled(motion, problem.period))
    if constraints.checker is not None:
        margins += _distances(constraints.checker, time, states)
    criterion, values, by_duration = _excitation(
        problem.objective, states, steps, weights, motion.duration / len(time)
    )
    longest = (1.0 - _BOUND_RESERVE) * constraints.max_duration
    return Sensitivity(
        time=time,
        states=states,
        duration=motion.duration,
        criterion=criterion,
        values=values,
        by_duration=by_duration,
        margins=Margins.of(margins, n),
        left=np.array([longest - motion.duration, *(margin.left for margin in margins)]),
        moves=PlannedMoves.of(problem.genome, genes, motion),
    )


def gene_steps(genes: Array) -> Array:
    """Return the step of each gene (n_genes,), towards the middle of their range."""
    return np.where(genes > 0.5, -_GENE_STEP, _GENE_STEP)


def gene_slopes(
    problem: SensitivityProblem, sensitivity: Sensitivity, genes: Array, which: NDArray[np.intp]
) -> Array:
    """Return the slopes of fitness, error and constraints (k, 2 + c) for some genes.

    They are 0 for a gene whose step cannot be planned.

    Args:
        problem: of the search.
        sensitivity: at the genes.
        genes: of the motion (n_genes,).
        which: genes whose slopes are returned (k,), in ascending order.
    """
    steps = gene_steps(genes)[which]
    rows = np.repeat(genes[None], len(which), axis=0)
    rows[np.arange(len(which)), which] += steps
    slopes = np.zeros((len(which), 1 + len(sensitivity.left)))
    changes = _changes(problem.genome, sensitivity, rows, which)
    for row, (change, step) in enumerate(zip(changes, steps.tolist(), strict=True)):
        if change is not None:
            slopes[row] = sensitivity.slopes(change, step)
    return slopes


def _changes(
    genome: Genome, sensitivity: Sensitivity, rows: Array, which: NDArray[np.intp]
) -> Iterator[LocalChange | None]:
    """Yield the change of the motion with each row of genes; one gene is changed in each."""
    local = 0
    if sensitivity.moves is not None and isinstance(genome, ViaPointGenome):
        local = int(np.searchsorted(which, genome.n_point_genes))
        yield from sensitivity.moves.changed(genome, rows[:local], which[:local])
    duration = sensitivity.duration
    for motion in genome.motions(rows[local:]):
        if isinstance(motion, PlannerError):
            yield None
        else:
            yield LocalChange(motion, 0.0, 0.0, duration, motion.duration - duration)


def _steps(states: Array) -> Array:
    """Return the step of each of the states (3, N, n)."""
    steps = np.empty_like(states)
    steps[:] = np.array((_POSITION_STEP, _VELOCITY_STEP, _ACCELERATION_STEP))[:, None, None]
    return steps


def _velocity_change(velocity: Array) -> Array:
    """Return the larger change of each velocity (N, n) to one of its neighbours.

    sgn(qd) jumps between two samples. Steps of this width find each jump near it; wider ones would
    find it in slow moves as well, which do not reverse. Where a law has no standstill speed, the
    slopes of a joint at rest are those of a jump, too.
    """
    change = np.abs(np.diff(velocity, axis=0))
    to_next = np.pad(change, ((0, 1), (0, 0)))
    return np.asarray(np.maximum(to_next, np.pad(change, ((1, 0), (0, 0)))))


def _neighbours(states: Array, steps: Array) -> Iterator[tuple[int, int, Array, Array, Array]]:
    """Yield for each state of each joint the states (3, N, n) above and below, and their gap."""
    for kind, joint in np.ndindex(states.shape[0], states.shape[2]):
        step = steps[kind, :, joint]
        above = states.copy()
        below = states.copy()
        above[kind, :, joint] += step
        below[kind, :, joint] -= step
        yield kind, joint, above, below, 2.0 * step


def _excitation(
    objective: Objective, states: Array, steps: Array, weights: Array | None, period: float
) -> tuple[Array, Array, float]:
    """Return the slopes of the weighted criteria by the states, and by the duration.

    Between them stands the share (N,) of each sample: that of a change in how often it counts.
    """
    by_duration = 0.0
    of_joints = None
    means = None
    if weights is None:
        precision = objective.precision
        assert precision is not None
        whole = objective.precise_information(_motion(states, period))
        matrix = precision.slope(whole)
        of_joints = period / precision.density
        # The sum over rows about their mean changes with a row as if the mean stayed.
        means = objective.precise_means(_motion(states))
        by_duration = float(np.sum(matrix * whole) / (states.shape[1] * period))
    else:
        matrix = objective.slope(objective.information(_motion(states, period)), weights)
        if objective.given is not None:
            longer, shorter = (
                np.array([*objective.measures(_motion(states, factor * period)).values()]) @ weights
                for factor in (1.0 + _DURATION_STEP, 1.0 - _DURATION_STEP)
            )
            change = 2.0 * _DURATION_STEP * states.shape[1] * period
            by_duration = float((longer - shorter) / change)
    slope = np.zeros_like(states)
    for kind, joint, above, below, gap in _neighbours(states, steps):
        difference = objective.along(_motion(above), matrix, of_joints, means)
        difference -= objective.along(_motion(below), matrix, of_joints, means)
        slope[kind, :, joint] = difference / gap
    return slope, objective.along(_motion(states), matrix, of_joints, means), by_duration


def _loads(currents: CurrentModel, motion: Motion) -> Iterator[Margin]:
    """Yield the margin, as a fraction, at each peak of the load of a motor or joint."""
    loads = currents.loads(motion)
    before, after = (np.full((1, loads.shape[1]), -np.inf) for _ in range(2))
    is_peak = loads > np.maximum(_MIN_LOAD_SHARE, np.concatenate((before, loads[:-1])))
    is_peak &= loads >= np.concatenate((loads[1:], after))
    sample, column = np.nonzero(is_peak)
    if len(sample) == 0:
        return
    samples, row = np.unique(sample, return_inverse=True)
    chosen = _states(motion.rows(samples))
    slope = np.zeros((len(sample), 3, chosen.shape[2]))
    reversing = _near_reversal(currents, chosen[1])
    for kind, joint, above, below, gap in _neighbours(chosen, _steps(chosen)):
        change = currents.loads(_motion(above)) - currents.loads(_motion(below))
        change /= gap[:, None]
        if kind == 1:  # no slope where sgn(qd) jumps
            change[reversing[:, joint]] = 0.0
        slope[:, kind, joint] = -change[row, column]
    for peak, at, which, place in zip(slope, sample, column, row, strict=True):
        margin = float(1.0 - _BOUND_RESERVE - loads[at, which])
        yield Margin(float(motion.time[at]), chosen[:, place], peak, margin)


def _near_reversal(currents: CurrentModel, velocity: Array) -> NDArray[np.bool_]:
    """Return which joints (k, n), or coupled motors that they move, are as slow as a step."""
    slow = np.abs(velocity) <= _VELOCITY_STEP
    for share in currents.model.friction.motor_speeds():
        motor = np.abs(velocity @ share) <= _VELOCITY_STEP * np.abs(share).max()
        slow |= motor[:, None] & (share != 0.0)
    return slow


def _runs(which: NDArray[np.bool_]) -> list[NDArray[np.intp]]:
    """Return the indices of each stretch of true values."""
    chosen = np.flatnonzero(which)
    if len(chosen) == 0:
        return []
    return np.split(chosen, np.flatnonzero(np.diff(chosen) > 1) + 1)


def _distances(checker: CollisionChecker, time: Array, states: Array) -> Iterator[Margin]:
    """Yield the margin [m] of each approach of two bodies along states (3, N, n)."""
    q = states[0]
    path = checker.path(q)
    n = q.shape[1]
    pairs = len(checker.required)
    count = len(q)
    pair, sample = np.indices((pairs, count)).reshape(2, -1)
    bound = checker.separation.bound(path.bodies, pair, sample).reshape(pairs, count)
    near = bound < checker.required[:, None] + _NEAR_DISTANCE
    for index in range(pairs):
        for run in _runs(near[index]):
            nearest = run[np.argmin(bound[index, run])]
            postures = np.repeat(q[nearest][None], 2 * n, axis=0)
            postures[:n] += _POSITION_STEP * np.eye(n)
            postures[n:] -= _POSITION_STEP * np.eye(n)
            around = checker.path(postures)
            distance = np.array([checker.distance(index, around, k) for k in range(2 * n)])
            here = checker.distance(index, path, int(nearest))
            if not (np.isfinite(here) and np.all(np.isfinite(distance))):
                continue
            slope = np.zeros((3, n))
            slope[0] = (distance[:n] - distance[n:]) / (2.0 * _POSITION_STEP)
            margin = here - checker.required[index] - _DISTANCE_RESERVE
            yield Margin(float(time[nearest]), states[:, nearest], slope, margin)


def _states(motion: Motion) -> Array:
    """Return position, velocity and acceleration (3, m, n)."""
    return np.array([motion.position, motion.velocity, motion.acceleration])


def _motion(states: Array, period: float = 1.0) -> Motion:
    return Motion(period * np.arange(states.shape[1], dtype=np.float64), *states)
