from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from identification.excitation.constraints import KINDS
from identification.excitation.searches.polish import dominating, generation_size, polish
from identification.excitation.searches.scores import Scale, Scores, unplanned

N = 12
TARGET = np.linspace(0.2, 0.8, N)
# Ten times as long as wide, and not along the axes.
DIRECTIONS = np.linalg.qr(np.random.default_rng(0).standard_normal((N, N)))[0]
STIFFNESS = np.logspace(0, 2, N)
WORST = Scale(20.0, 10.0, 150.0, 30.0)


def bowl(genes):
    return np.sum(STIFFNESS * ((genes - TARGET) @ DIRECTIONS) ** 2, axis=1)


class Bowl:
    """Motions whose determinant is 100 at the target and less around it."""

    def __init__(self, forbidden=lambda genes: np.zeros(len(genes))):
        self.asked = []
        self.forbidden = forbidden

    def score(self, genes):
        self.asked.append(genes.copy())
        excess = np.zeros((len(genes), len(KINDS)))
        excess[:, 3] = self.forbidden(genes)
        size = 100.0 - bowl(genes)
        genes.fill(np.nan)  # whoever scores may do with its copy as it likes
        return Scores(size, 80.0 + np.zeros(len(size)), np.full(len(size), 5.0), excess)


class TwoGoals:
    """Larger determinants near one point, less coupling near another."""

    def __init__(self):
        self.other = TARGET[::-1]

    def score(self, genes):
        return Scores(
            100.0 - 30.0 * np.sum((genes - TARGET) ** 2, axis=1),
            80.0 + 50.0 * np.sum((genes - self.other) ** 2, axis=1),
            np.full(len(genes), 5.0),
            np.zeros((len(genes), len(KINDS))),
        )


def polished(population, genes, fitness, **others):
    """Polish from genes whose scores are known."""
    scores = population.score(np.array(genes, dtype=np.float64, ndmin=2)[:1].copy())
    if hasattr(population, "asked"):
        population.asked.clear()
    return polish(population.score, genes, scores, fitness, **others)


def larger(scores):
    return scores.log10_det


def start():
    return np.clip(TARGET + 0.05, 0.0, 1.0)


def test_it_finds_the_top_of_a_narrow_ridge():
    result = polished(Bowl(), start(), larger, evaluations=6000, seed=1)
    np.testing.assert_allclose(result.genes, TARGET, atol=1e-3)


def test_the_scores_belong_to_the_genes():
    population = Bowl()
    result = polished(population, start(), larger, evaluations=200, seed=1)
    expected = population.score(result.genes[None].copy())
    for found, value in zip(result.scores, expected, strict=True):
        np.testing.assert_array_equal(found, value)


def test_more_evaluations_never_give_less():
    reached = [
        polished(Bowl(), start(), larger, evaluations=count, seed=1).scores.log10_det[0]
        for count in (1, 50, 100, 400, 1600)
    ]
    assert reached == sorted(reached)
    assert reached[-1] > reached[0]


@pytest.mark.parametrize("evaluations", [1, 7, 40, 333])
def test_it_keeps_to_what_it_was_allowed(evaluations):
    population = Bowl()
    polished(population, start(), larger, evaluations=evaluations, seed=1)
    evaluated = sum(len(genes) for genes in population.asked)
    assert evaluated <= evaluations
    assert evaluations - evaluated < generation_size(N)


def test_whole_generations_are_scored_at_once_and_the_start_not_again():
    population = Bowl()
    polished(population, start(), larger, evaluations=400, seed=1)
    count = 400 // generation_size(N)
    assert [len(genes) for genes in population.asked] == [generation_size(N)] * count


def test_a_start_whose_scores_are_known_stays_whatever_becomes_of_scoring_it():
    class Unlucky(Bowl):  # as if every process was ended from outside
        def score(self, genes):
            return Scores.of_rows(np.tile(unplanned(), (len(genes), 1)))

    known = Bowl().score(start()[None].copy())
    result = polish(Unlucky().score, start(), known, larger, evaluations=100, seed=1)
    assert result.genes.tobytes() == start().tobytes()
    assert result.scores.rows.tobytes() == known.rows.tobytes()


def test_the_best_stays_the_start_bit_for_bit():
    result = polished(Bowl(), TARGET, larger, evaluations=200, seed=1)
    assert result.genes.tobytes() == TARGET.tobytes()
    assert result.scores.log10_det[0] == 100.0


def test_what_is_merely_alike_does_not_replace_the_start():
    result = polished(
        Bowl(), start(), lambda scores: np.zeros(len(scores.log10_det)), evaluations=200, seed=1
    )
    assert result.genes.tobytes() == start().tobytes()


@pytest.mark.parametrize("corner", [0.0, 1.0])
def test_genes_stay_within_their_bounds_from_a_corner_too(corner):
    population = Bowl()
    polished(population, np.full(N, corner), larger, evaluations=1500, seed=1)
    asked = np.concatenate(population.asked)
    assert np.all((asked >= 0.0) & (asked <= 1.0))
    assert np.all(np.ptp(asked, axis=0) > 0.0)


def test_a_feasible_start_stays_feasible_though_something_forbidden_is_better():
    def forbidden(genes):  # the target lies behind it
        return np.maximum(0.0, start()[0] - 0.02 - genes[:, 0])

    population = Bowl(forbidden)
    result = polished(population, start(), larger, evaluations=2000, seed=1)
    assert result.scores.feasible.tolist() == [True]
    assert result.scores.log10_det[0] > 100.0 - bowl(start()[None])[0]
    # It goes as far as it may.
    assert result.genes[0] == pytest.approx(start()[0] - 0.02, abs=2e-3)


def test_from_an_infeasible_start_it_finds_the_way_out():
    def forbidden(genes):
        return np.maximum(0.0, genes[:, 0] - start()[0] + 0.03)

    result = polished(Bowl(forbidden), start(), larger, evaluations=1000, seed=1)
    assert result.scores.feasible.tolist() == [True]


def test_less_excess_is_better_though_the_fitness_is_worse():
    result = polished(
        Bowl(lambda genes: 1.0 + bowl(genes)),
        start(),
        lambda scores: -scores.log10_det,
        evaluations=600,
        seed=1,
    )
    assert result.scores.excess[0].sum() < 1.0 + 0.1 * bowl(start()[None])[0]


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32), st.lists(st.floats(0, 1), min_size=N, max_size=N))
def test_it_is_never_worse_than_its_start(seed, genes):
    def rugged(scores):
        return np.sin(1e4 * scores.log10_det)

    population = Bowl(lambda genes: np.maximum(0.0, np.sin(50.0 * genes.sum(axis=1)) - 0.5))
    before = population.score(np.array([genes]))
    result = polished(population, genes, rugged, evaluations=60, seed=seed)
    excess = before.excess.sum(), result.scores.excess.sum()
    assert excess[1] <= excess[0]
    if excess[1] == excess[0]:
        assert rugged(result.scores)[0] >= rugged(before)[0]


def test_motions_that_cannot_be_judged_rank_last():
    def patchy(scores):
        return np.where(np.sin(40.0 * scores.log10_det) > 0.5, -np.inf, scores.log10_det)

    result = polished(Bowl(), start(), patchy, evaluations=1000, seed=1)
    assert np.isfinite(patchy(result.scores)[0])
    assert patchy(result.scores)[0] > 100.0 - bowl(start()[None])[0]


def test_the_same_seed_gives_the_same_motion_whatever_else_draws_numbers():
    class Disturbing(Bowl):
        def score(self, genes):
            np.random.seed(len(self.asked))  # noqa: NPY002
            np.random.standard_normal(7)  # noqa: NPY002
            return super().score(genes)

    plain = polished(Bowl(), start(), larger, evaluations=500, seed=1)
    disturbed = polished(Disturbing(), start(), larger, evaluations=500, seed=1)
    assert plain.genes.tobytes() == disturbed.genes.tobytes()


def test_it_draws_none_of_the_numbers_of_others():
    np.random.seed(3)  # noqa: NPY002
    expected = np.random.standard_normal(3)  # noqa: NPY002
    np.random.seed(3)  # noqa: NPY002
    polished(Bowl(), start(), larger, evaluations=200, seed=1)
    np.testing.assert_array_equal(np.random.standard_normal(3), expected)  # noqa: NPY002


def test_another_seed_gives_another_motion():
    one, two = (polished(Bowl(), start(), larger, evaluations=200, seed=seed) for seed in (1, 2))
    assert not np.array_equal(one.genes, two.genes)


def test_it_prints_nothing_and_leaves_no_file(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    polished(Bowl(), start(), larger, evaluations=300, seed=1)
    assert capfd.readouterr() == ("", "")
    assert list(tmp_path.iterdir()) == []


def test_asked_to_stop_it_returns_the_best_so_far():
    population = Bowl()
    result = polished(
        population,
        start(),
        larger,
        evaluations=10_000,
        seed=1,
        stop=lambda: len(population.asked) > 5,
    )
    assert len(population.asked) == 6
    assert result.scores.log10_det[0] == max(
        100.0 - bowl(genes).min() for genes in population.asked
    )


def test_it_ends_where_nothing_moves_any_more():
    population = Bowl()
    polished(population, start(), larger, evaluations=100_000, seed=1)
    assert sum(map(len, population.asked)) < 50_000


def test_a_polished_compromise_is_better_in_both_measures():
    population = TwoGoals()
    genes = np.clip(0.5 * (TARGET + population.other) + 0.1, 0.0, 1.0)
    before = population.score(genes[None])
    after = polished(population, genes, dominating(before), evaluations=2000, seed=1).scores
    assert after.log10_det[0] > before.log10_det[0]
    assert after.coupling_index[0] < before.coupling_index[0]


def test_a_compromise_that_cannot_be_bettered_in_both_measures_stays():
    population = TwoGoals()
    genes = TARGET + 0.0  # the largest determinant there is
    before = population.score(genes[None])
    result = polished(population, genes, dominating(before), evaluations=500, seed=1)
    assert result.genes.tobytes() == genes.tobytes()


@given(st.floats(50, 150), st.floats(30, 300), st.sampled_from([None, WORST]))
def test_nothing_that_is_worse_in_a_measure_dominates(log10_det, coupling_index, scale):
    def one(size, coupled):
        return Scores(
            np.array([size]), np.array([coupled]), np.array([5.0]), np.zeros((1, len(KINDS)))
        )

    fitness = dominating(one(100.0, 80.0), scale)
    merit = fitness(one(log10_det, coupling_index))[0]
    assert fitness(one(100.0, 80.0))[0] == 0.0
    if log10_det < 100.0 or coupling_index > 80.0:
        assert merit < 0.0
    elif log10_det > 100.0 or coupling_index < 80.0:
        assert merit > 0.0


ON_ITS_OWN = """
import numpy as np
from identification.excitation.searches.polish import polish
from identification.excitation.searches.scores import Scores, unplanned

class Bowl:
    def score(self, genes):
        size = 100.0 - np.sum(np.arange(1, 91) * (genes - 0.4) ** 2 * (2 + np.roll(genes, 1, 1)), 1)
        ones = np.ones(len(size))
        return Scores(size, 80.0 * ones, 5.0 * ones, np.zeros((len(size), 6)))

start = np.full(90, 0.5)
known = Bowl().score(start[None])
fitness = lambda scores: scores.log10_det
result = polish(Bowl().score, start, known, fitness, evaluations=1200, seed=1)
print(result.genes.tobytes().hex())
"""


@pytest.mark.slow
def test_the_threads_of_linear_algebra_change_nothing():
    genes = [
        subprocess.run(
            [sys.executable, "-c", ON_ITS_OWN],
            env=os.environ | {"OPENBLAS_NUM_THREADS": threads, "OMP_NUM_THREADS": threads},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for threads in ("1", "2")
    ]
    assert len(genes[0]) > 90
    assert genes[0] == genes[1]
