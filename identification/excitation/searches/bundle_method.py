r"""Improvement of a feasible motion by the gradient of its criterion, from feasible to feasible.

A proximal bundle method (Kiwiel 1985, "Methods of Descent for Nondifferentiable Optimization"),
since criterion and duration have kinks: the slowest joint sets the time of a move. Each step solves

.. math:: \max_d \; \min_i (\alpha_i + g_i^T d) - \tfrac{\rho}{2} d^T d

over changes d of the genes in a box, with the linearised constraints of all motions i of the
bundle. A step that fails adds the linearisation there; after one that breaks a constraint the next
ones back off from all bounds, by a share of what the box would change.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
import scipy

from identification.arrays import Array
from identification.excitation.searches.population import Scores
from identification.excitation.searches.sensitivity import Linearisation

Fitness = Callable[[Scores], Array]

_FIRST_HALF_WIDTH: Final = 0.1  # first half width of the box, as a fraction of each gene's range
_MAX_HALF_WIDTH: Final = 0.2
_MIN_HALF_WIDTH: Final = 1e-4
_CURVATURE: Final = 5.0  # rho
_MIN_LINEARISATION_OFFSET: Final = 5.0  # least offset of the linearisation at a distance of 1
_BUNDLE_SIZE: Final = 20  # linearisations in the bundle
_MIN_GAIN_SHARE: Final = 0.05  # of the predicted gain that makes a step
_MAX_FAILURES: Final = 4  # failures before the box is made smaller
_BACKOFF_STEP: Final = 0.1  # from the bounds; by so much more after each infeasible step
_MAX_BACKOFF: Final = 0.5
_STEP_FRACTIONS: Final = np.array((1.0, 0.4))  # of a step that are scored

SCORED_STEPS: Final = len(_STEP_FRACTIONS)
"""Motions that a step scores."""


class _Cut(NamedTuple):
    """Linearisation at some genes (n_genes,), with the fitness there."""

    genes: Array
    fitness: float
    slopes: Linearisation

    def offset(self, genes: Array, fitness: float) -> float:
        """Return by how much the linearisation may exceed the fitness at other genes, >= 0."""
        change = genes - self.genes
        error = self.fitness + float(np.sum(self.slopes.gradient * change)) - fitness
        return max(abs(error), _MIN_LINEARISATION_OFFSET * float(np.sum(change**2)))

    def left(self, genes: Array) -> Array:
        """Return the linearised margins (1 + c,) at other genes."""
        change = genes - self.genes
        return np.asarray(self.slopes.left + np.sum(self.slopes.rows * change, axis=1))


@dataclass(frozen=True, eq=False)
class Ascent:
    """Functions of a search that an improvement by gradient calls."""

    score: Callable[[Array], Scores]  #: of genes (m, n_genes)
    #: of genes (n_genes,) with their scores (m = 1); None if the motion cannot be planned
    linearise: Callable[[Array, Scores], Linearisation | None]
    fitness: Fitness  #: to maximise; -inf is the worst
    stop: Callable[[], bool]  #: asked before each step; true ends with the best motion so far


def improve(ascent: Ascent, genes: Array, scores: Scores, steps: int) -> tuple[Array, Scores]:
    """Return genes (n_genes,) and scores (m = 1) of a motion that is not worse than a feasible one.

    Every motion that replaces another satisfies all constraints and has a larger fitness.

    Args:
        ascent: of the problem.
        genes: of the feasible motion (n_genes,).
        scores: of it (m = 1).
        steps: most of them.
    """
    best = (genes.copy(), scores)
    value = float(ascent.fitness(scores)[0])
    slopes = ascent.linearise(genes, scores)
    if slopes is None:
        return best
    bundle = [_Cut(best[0], value, slopes)]
    failures = 0
    backoff = 0.0
    box = _FIRST_HALF_WIDTH
    for _ in range(steps):
        if box < _MIN_HALF_WIDTH or ascent.stop():
            break
        centre = best[0]
        here = next(cut for cut in bundle if cut.genes is centre)
        near = [c for c in bundle if c is not here and np.abs(c.genes - centre).max() <= 2 * box]
        bundle = [here, *near[-_BUNDLE_SIZE:]]
        change, gain = _step(bundle, centre, value, box, backoff)
        tried = np.clip(centre + _STEP_FRACTIONS[:, None] * change, 0.0, 1.0)
        trial_scores = ascent.score(tried.copy())
        values = np.where(trial_scores.usable, ascent.fitness(trial_scores), -np.inf)
        index = int(np.argmax(values))
        if values[index] > value + _MIN_GAIN_SHARE * max(gain, 0.0):
            if values[index] - value > 0.5 * gain:
                box = min(1.5 * box, _MAX_HALF_WIDTH)
            best = (tried[index].copy(), trial_scores.take(index))
            value = values[index]
            failures = 0
            backoff *= 0.5
            slopes = ascent.linearise(best[0], best[1])
            if slopes is None:
                break
            bundle.append(_Cut(best[0], float(value), slopes))
            continue
        failures += 1
        if not np.any(trial_scores.feasible):
            backoff = min(backoff + _BACKOFF_STEP, _MAX_BACKOFF)
        refused = _refused(ascent, tried[0].copy(), trial_scores.take(0))
        if refused is not None:
            bundle.append(refused)
        if refused is None or failures >= _MAX_FAILURES:
            box *= 0.6
            failures = min(failures, 1)
    return best


def _refused(ascent: Ascent, genes: Array, scores: Scores) -> _Cut | None:
    """Return the linearisation at a motion that was no step, None if it has none."""
    value = float(ascent.fitness(scores)[0])
    if not (np.isfinite(value) and scores.exciting[0]):
        return None
    slopes = ascent.linearise(genes, scores)
    return None if slopes is None else _Cut(genes, value, slopes)


def _step(
    bundle: list[_Cut], genes: Array, fitness: float, box: float, backoff: float
) -> tuple[Array, float]:
    """Return the change of genes (n_genes,) with the best of the model, and its predicted gain.

    Each margin stays above the share `backoff` of its largest change in the box.
    """
    import clarabel  # slow to import

    n = len(genes)
    offsets = [0.0] + [cut.offset(genes, fitness) for cut in bundle[1:]]
    rows = np.concatenate([-cut.slopes.rows for cut in bundle])
    margins = np.concatenate([np.maximum(cut.left(genes), 0.0) for cut in bundle])
    reach = box * np.abs(rows).sum(axis=1)
    margins -= backoff * reach
    within = margins < reach  # the others hold in all of the box
    rows = rows[within]
    margins = margins[within]
    gradients = np.array([-cut.slopes.gradient for cut in bundle])
    scale = np.abs(rows).max(axis=1, initial=0.0)
    unit = np.eye(n)
    zero = np.zeros((n, 1))
    matrix = np.block(
        [
            [rows / scale[:, None], np.zeros((len(rows), 1))],
            [unit, zero],
            [-unit, zero],
            [gradients, np.ones((len(gradients), 1))],
        ]
    )
    upper = np.minimum(box, 1.0 - genes)
    lower = np.minimum(box, genes)
    bound = np.concatenate((margins / scale, upper, lower, offsets))
    quadratic = scipy.sparse.diags_array(np.append(np.full(n, _CURVATURE), 0.0)).tocsc()
    settings: Any = clarabel.DefaultSettings()
    settings.verbose = False
    cones = [clarabel.NonnegativeConeT(len(bound))]
    solution = clarabel.DefaultSolver(
        quadratic,
        np.append(np.zeros(n), -1.0),
        scipy.sparse.csc_matrix(matrix),
        bound,
        cones,
        settings,
    ).solve()
    if solution.status != clarabel.SolverStatus.Solved and backoff > 0.0:
        return _step(bundle, genes, fitness, box, 0.0)
    optimum = np.array(solution.x)
    if not np.all(np.isfinite(optimum)):
        return np.zeros(n), 0.0
    return optimum[:n], float(optimum[n])
