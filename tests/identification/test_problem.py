from __future__ import annotations

import numpy as np

from identification.excitation import CurrentModel, check_motion, midpoints
from identification.excitation.violation import excess_by_kind
from tests.identification.searching import LIMITS, problem


def currents(limit: float) -> CurrentModel:
    model = problem().objective.model
    values = np.random.default_rng(2).uniform(0.1, 1.0, model.n_parameters)
    return CurrentModel(model, values, np.eye(2), np.ones(2), np.full(2, limit), uncertainty=0.2)


def test_motions_are_judged_in_the_middle_of_their_steps() -> None:
    asked = problem(currents=currents(100.0))
    genes = np.random.default_rng(0).random((6, asked.genome.n_genes))
    scores = asked.score(genes)
    for k, motion in enumerate(asked.genome.motions(genes)):
        expected = asked.objective.measures(midpoints(motion, asked.period))
        assert (scores.log10_det[k], scores.coupling_index[k]) == expected
        criteria = asked.judged(genes[k], asked.period)[1]
        assert (criteria.log10_det, criteria.coupling_index) == expected


def test_a_search_sees_of_currents_what_the_last_check_sees() -> None:
    asked = problem(currents=currents(20.0))
    genes = np.random.default_rng(1).random((12, asked.genome.n_genes))
    scores = asked.score(genes)
    for k, motion in enumerate(asked.genome.motions(genes)):
        found = check_motion(motion, LIMITS, currents=asked.constraints.currents).violations
        np.testing.assert_array_equal(scores.excess[k], excess_by_kind(found))
    assert 0 < np.count_nonzero(scores.feasible) < len(genes)
