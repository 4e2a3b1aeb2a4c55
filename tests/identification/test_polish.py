import os
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from identification.excitation import KINDS, Scores
from identification.excitation.searches.run import dominating, polish
from identification.excitation.searches.scores import unplanned

N = 12
TARGET = np.linspace(0.2, 0.8, N)
START = TARGET + 0.05
# Ten times as long as wide, and not along the axes.
DIRECTIONS = np.linalg.qr(np.random.default_rng(0).standard_normal((N, N)))[0]
STIFFNESS = np.logspace(0, 2, N)


def bowl(genes):
    return np.sum(STIFFNESS * ((genes - TARGET) @ DIRECTIONS) ** 2, axis=1)


def scores_of(log10_det, coupling_index, excess=0.0):
    measures = np.column_stack(np.broadcast_arrays(log10_det, coupling_index))
    broken = np.zeros((len(measures), len(KINDS)))
    broken[:, 3] = excess
    return Scores(measures, np.full(len(measures), 5.0), broken)


class Bowl:
    """Motions with a maximum of the determinant, 100, at the target."""

    def __init__(self, excess=lambda genes: 0.0):
        self.scored = []
        self.excess = excess

    def score(self, genes):
        self.scored.append(genes.copy())
        found = scores_of(100.0 - bowl(genes), 80.0, self.excess(genes))
        genes.fill(np.nan)  # callers must pass copies
        return found


class TwoGoals:
    """Larger determinants near one point, less coupling near another."""

    def score(self, genes):
        return scores_of(
            100.0 - 30.0 * np.sum((genes - TARGET) ** 2, axis=1),
            80.0 + 50.0 * np.sum((genes - TARGET[::-1]) ** 2, axis=1),
        )


def size_of(scores):
    return scores.measure("log10_det")


def polished(population, genes, fitness=size_of, **others):
    """Polish from genes whose scores are known; returns genes and scores."""
    scores = population.score(np.array(genes, dtype=np.float64, ndmin=2))
    if hasattr(population, "scored"):
        population.scored.clear()
    others = {"evaluations": 200, "seed": 1} | others
    return polish(population.score, genes, scores, fitness, **others)


def failing(genes):
    """As if every process was killed."""
    return Scores.of_rows(np.tile(unplanned(), (len(genes), 1)))


SCRIPT = """
import numpy as np
from identification.excitation.searches.run import polish
from tests.identification.test_polish import scores_of, size_of

def score(genes):
    size = 100.0 - np.sum(np.arange(1, 91) * (genes - 0.4) ** 2 * (2 + np.roll(genes, 1, 1)), 1)
    return scores_of(size, 80.0)

start = np.full(90, 0.5)
genes, _ = polish(score, start, score(start[None]), size_of, evaluations=1200, seed=1)
print(genes.tobytes().hex())
"""


class TestPolish:
    def test_it_finds_the_maximum_of_a_narrow_ridge(self):
        genes, scores = polished(Bowl(), START, evaluations=6000)
        np.testing.assert_allclose(genes, TARGET, atol=1e-3)
        assert scores.rows.tobytes() == Bowl().score(genes[None].copy()).rows.tobytes()

    @pytest.mark.parametrize(
        ("score", "start", "fitness"),
        [
            (Bowl().score, TARGET, size_of),
            (Bowl().score, START, lambda scores: np.zeros(len(scores.duration))),
            (failing, START, size_of),
        ],
    )
    def test_only_improvements_replace_the_start(self, score, start, fitness):
        known = Bowl().score(start[None].copy())
        genes, scores = polish(score, start, known, fitness, evaluations=200, seed=1)
        assert genes.tobytes() == start.tobytes()
        assert scores.rows.tobytes() == known.rows.tobytes()

    @pytest.mark.parametrize("corner", [0.0, 1.0])
    def test_genes_stay_within_bounds_from_a_corner_too(self, corner):
        population = Bowl()
        polished(population, np.full(N, corner), evaluations=1500)
        asked = np.concatenate(population.scored)
        assert np.all((asked >= 0.0) & (asked <= 1.0))
        assert np.all(np.ptp(asked, axis=0) > 0.0)

    def test_constraints_come_before_the_fitness(self):
        def beyond(genes):  # excludes the target
            return np.maximum(0.0, START[0] - 0.02 - genes[:, 0])

        genes, scores = polished(Bowl(beyond), START, evaluations=2000)
        assert scores.feasible.all() and size_of(scores)[0] > 100.0 - bowl(START[None])[0]
        assert genes[0] == pytest.approx(START[0] - 0.02, abs=2e-3)  # at the constraint

        def around(genes):
            return np.maximum(0.0, genes[:, 0] - START[0] + 0.03)

        assert polished(Bowl(around), START, evaluations=1000)[1].feasible.all()
        everywhere = Bowl(lambda genes: 1.0 + bowl(genes))
        _, scores = polished(everywhere, START, lambda scores: -size_of(scores), evaluations=600)
        assert scores.excess.sum() < 1.0 + 0.1 * bowl(START[None])[0]

    @settings(max_examples=20, deadline=None)
    @given(st.integers(0, 2**32), st.lists(st.floats(0, 1), min_size=N, max_size=N))
    def test_it_is_never_worse_than_its_start(self, seed, genes):
        def rugged(scores):
            return np.sin(1e4 * size_of(scores))

        population = Bowl(lambda genes: np.maximum(0.0, np.sin(50.0 * genes.sum(axis=1)) - 0.5))
        before = population.score(np.array([genes]))
        _, after = polished(population, np.array(genes), rugged, evaluations=60, seed=seed)
        excess = before.excess.sum(), after.excess.sum()
        assert excess[1] <= excess[0]
        if excess[1] == excess[0]:
            assert rugged(after)[0] >= rugged(before)[0]

    def test_it_ends_on_request_and_when_steps_are_tiny(self):
        population = Bowl()

        def enough():
            return len(population.scored) > 5

        _, scores = polished(population, START, evaluations=10_000, stop=enough)
        assert len(population.scored) == 6
        assert size_of(scores)[0] == max(100.0 - bowl(genes).min() for genes in population.scored)
        polished(population, START, evaluations=100_000)
        assert sum(map(len, population.scored)) < 50_000

    def test_a_compromise_improves_in_all_measures_or_stays(self):
        genes = np.clip(0.5 * (TARGET + TARGET[::-1]) + 0.1, 0.0, 1.0)
        before = TwoGoals().score(genes[None])
        _, after = polished(TwoGoals(), genes, dominating(before), evaluations=2000)
        assert size_of(after)[0] > size_of(before)[0]
        assert after.measure("coupling_index")[0] < before.measure("coupling_index")[0]
        largest = TwoGoals().score(TARGET[None])
        found, _ = polished(TwoGoals(), TARGET, dominating(largest), evaluations=500)
        assert found.tobytes() == TARGET.tobytes()

    @pytest.mark.slow
    def test_the_threads_of_linear_algebra_change_nothing(self):
        genes = [
            subprocess.run(
                [sys.executable, "-c", SCRIPT],
                env=os.environ | {"OPENBLAS_NUM_THREADS": threads, "OMP_NUM_THREADS": threads},
                capture_output=True,
                text=True,
                check=True,
            ).stdout
            for threads in ("1", "2")
        ]
        assert len(genes[0]) > 90
        assert genes[0] == genes[1]
