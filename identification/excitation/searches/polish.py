"""Improving a motion by CMA-ES, from where a search left it.

A genetic search finds the right region and then wanders in it; a covariance matrix adaptation
(Hansen 2016, "The CMA Evolution Strategy: A Tutorial") learns how far each gene of a motion can
still be moved for the better. It looks at nothing but ranks, so constraints need no penalty:
whatever keeps them all ranks before whatever breaks one.

The covariance is diagonal (Ros and Hansen 2008, "A simple modification in CMA-ES"). A full one
has thousands of entries to learn for a hundred genes, more than a polish has evaluations; and its
eigenvectors differ in their last bits with the threads that linear algebra is given.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import numpy as np
import scipy
from numpy.typing import NDArray

from identification.excitation.criteria import SENSE
from identification.excitation.searches.population import CHUNK
from identification.excitation.searches.scores import Scale, Scores

Array = NDArray[np.float64]
Fitness = Callable[[Scores], Array]

# First steps, as a share of each gene's range: the search has left the motion near something good.
_STEP: Final = 0.03
# Steps below this change no motion that anybody could tell from the one before.
_SMALLEST_STEP: Final = 1e-7
# Random numbers that are no other search's, whatever the seeds.
_STREAM: Final = 3
# How much the largest gain counts where none is a loss.
_SECOND: Final = 1e-3


def polish(
    score: Callable[[Array], Scores],
    genes: Array,
    scores: Scores,
    fitness: Fitness,
    *,
    evaluations: int,
    seed: int,
    stop: Callable[[], bool] = lambda: False,
) -> tuple[Array, Scores]:
    """Return the best motion found near a start, its genes (n_genes,) and scores (m = 1).

    Those of the start, bit for bit, where nothing better was found. "Better" is: nearer to keeping
    the constraints by their summed excess, then the fitness. The same seed gives the same motion
    to the last bit, whatever else draws random numbers meanwhile.

    Args:
        score: gives the scores of a whole generation of genes (m, n_genes) at once.
        genes: (n_genes,) of the start, two or more, within [0, 1].
        scores: of the start, m = 1. It is not scored again: were that to fail for a reason that is
            not its own, anything would be better than the start.
        fitness: (m,) of scores, the larger the better; -inf is the worst there is.
        evaluations: how many motions may be scored.
        seed: of the random numbers.
        stop: asked before each generation; true ends the polish with the best so far.
    """
    best = genes.copy(), scores
    least, most = (float(each[0]) for each in _merits(scores, fitness))
    size = generation_size(len(genes))
    strategy = _strategy(best[0], size, seed)
    evaluated = 0
    while evaluated + size <= evaluations and not stop():
        asked = np.array(strategy.ask())
        found = score(asked.copy())
        excess, values = _merits(found, fitness)
        strategy.tell(list(asked), _ranks(excess, values).tolist())
        # The first of those that are alike.
        index = int(np.lexsort((-values, excess))[0])
        if (excess[index], -values[index]) < (least, -most):
            least, most = float(excess[index]), float(values[index])
            best = asked[index].copy(), found.take(index)
        evaluated += size
        if not _SMALLEST_STEP < float(np.max(strategy.stds)) < np.inf:
            break
    return best


def dominating(reference: Scores, scale: Scale | None = None) -> Fitness:
    """Return a fitness that no motion can have above 0 unless it is as good as `reference`.

    The smallest of its gains counts (an achievement function, Wierzbicki 1980); where none is a
    loss the largest one counts a little too. Polished on this, a motion gets better in all
    measures or stays.

    Args:
        reference: scores of one motion, m = 1, that excites every parameter.
        scale: units of the gains; without it those of the measures themselves.
    """
    spread = 1.0 if scale is None else np.array(scale.spread)

    def fitness(scores: Scores) -> Array:
        gains = SENSE * (scores.measures - reference.measures) / spread
        least = gains.min(axis=1)
        merit: Array = np.where(least < 0.0, least, least + _SECOND * gains.max(axis=1))
        return merit

    return fitness


def generation_size(n_genes: int) -> int:
    """Return how many motions make a generation: the usual 4 + 3 ln n, in whole chunks."""
    return CHUNK * int(np.ceil((4.0 + 3.0 * np.log(n_genes)) / CHUNK))


def _merits(scores: Scores, fitness: Fitness) -> tuple[Array, Array]:
    """Return what motions are ranked by: excess (m,), the less the better, then fitness (m,)."""
    excess = np.where(scores.feasible, 0.0, np.sum(scores.excess, axis=1))
    values = np.asarray(fitness(scores), dtype=np.float64)
    # A motion that cannot be judged is the worst of its kind.
    return np.nan_to_num(excess, nan=np.inf), np.nan_to_num(values, nan=-np.inf)


def _ranks(excess: Array, fitness: Array) -> Array:
    """Return ranks from 1 for the best (m,), alike for motions that are alike."""
    pairs = np.stack((excess, -fitness))
    _, place = np.unique(pairs, axis=1, return_inverse=True)
    ranks: Array = scipy.stats.rankdata(place.ravel(), method="average")
    return ranks


def _strategy(start: Array, size: int, seed: int) -> Any:
    """Return a CMA-ES that draws from a generator of its own and neither prints nor writes."""
    import cma  # here, because it takes longer to load than many a command to run

    random = np.random.default_rng([_STREAM, seed])

    def normal(count: int, length: int | None = None) -> Array:
        return random.standard_normal(count if length is None else (count, length))

    return cma.CMAEvolutionStrategy(
        start,
        _STEP,
        {
            "bounds": [0.0, 1.0],
            "popsize": size,
            "CMA_diagonal": True,
            "randn": normal,
            # nan: the package does not touch numpy's global generator
            "seed": np.nan,
            # below -9 nothing is shown, and no file of options is looked for
            "verbose": -10,
            "verb_log": 0,
        },
    )
