from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from identification.excitation.constraints import KINDS
from identification.excitation.errors import DesignError
from identification.excitation.searches.scores import Scale, Scores

HALF = (0.5, 0.5)


def scores_of(log10_det, coupling_index, *, infeasible=0):
    excess = np.zeros((len(log10_det), len(KINDS)))
    excess[:infeasible, 3] = 1.0
    return Scores(
        np.asarray(log10_det, dtype=float),
        np.asarray(coupling_index, dtype=float),
        np.full(len(log10_det), 5.0),
        excess,
    )


@pytest.fixture
def random_motions():
    random = np.random.default_rng(4)
    return random.normal(19.0, 8.0, 200), random.normal(148.0, 25.0, 200)


def test_the_median_random_motion_is_worth_nothing(random_motions):
    scale = Scale.of(scores_of(*random_motions))
    median = [np.median(values) for values in random_motions]
    assert scale.fitness(*median, HALF) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("weights", [(1.0, 0.0), (0.0, 1.0)])
def test_from_the_worse_to_the_better_quarter_is_one_unit_in_either_measure(
    random_motions, weights
):
    scale = Scale.of(scores_of(*random_motions))
    size, coupled = (np.quantile(values, (0.25, 0.75)) for values in random_motions)
    better = scale.fitness(size[1], coupled[0], weights)
    worse = scale.fitness(size[0], coupled[1], weights)
    assert better - worse == pytest.approx(1.0)


@given(st.floats(-300, 300), st.floats(0.0, 1.0))
def test_other_units_of_the_parameters_do_not_change_the_fitness(shift, first):
    random = np.random.default_rng(4)
    size, coupled = random.normal(19.0, 8.0, 60), random.normal(148.0, 25.0, 60)
    weights = (first, 1.0 - first)
    plain = Scale.of(scores_of(size, coupled)).fitness(size, coupled, weights)
    shifted = Scale.of(scores_of(size + shift, coupled)).fitness(size + shift, coupled, weights)
    np.testing.assert_allclose(shifted, plain, rtol=0, atol=1e-10)


def test_a_larger_determinant_and_less_coupling_are_better(random_motions):
    scale = Scale.of(scores_of(*random_motions))
    worse, larger, less_coupled = scale.fitness([50.0, 51.0, 50.0], [90.0, 90.0, 89.0], HALF)
    assert larger > worse
    assert less_coupled > worse


def test_a_motion_that_leaves_a_parameter_unexcited_is_worst(random_motions):
    scale = Scale.of(scores_of(*random_motions))
    assert scale.fitness([-np.inf, -1e4], [np.inf, 1653.0], HALF)[0] == -np.inf


def test_only_feasible_motions_count_where_there_are_enough(random_motions):
    size, coupled = random_motions
    mixed = scores_of(
        np.concatenate((np.full(100, -500.0), size)),
        np.concatenate((np.full(100, 1000.0), coupled)),
        infeasible=100,
    )
    assert Scale.of(mixed) == Scale.of(scores_of(size, coupled))


def test_where_hardly_any_is_feasible_all_that_could_be_judged_count(random_motions):
    assert Scale.of(scores_of(*random_motions, infeasible=195)) == Scale.of(
        scores_of(*random_motions)
    )


def test_motions_that_do_not_exist_do_not_count(random_motions):
    size, coupled = random_motions
    holes = scores_of(np.append(size, -np.inf), np.append(coupled, np.inf))
    assert Scale.of(holes) == Scale.of(scores_of(size, coupled))


@pytest.mark.parametrize("count", [0, 1, 5])
def test_a_scale_needs_different_motions(count):
    with pytest.raises(DesignError, match="random motions"):
        Scale.of(scores_of(np.full(count, 20.0), np.full(count, 150.0)))
