from __future__ import annotations

import numpy as np
import pytest

from identification.excitation import CurrentModel, Scores, SearchSettings, check_motion, midpoints
from identification.excitation.searches.run import Evolution
from identification.excitation.searches.scores import ROW, unplanned
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


def scored(log10_det: float, coupling_index: float, excess: float) -> np.ndarray:
    row = np.zeros(ROW)
    row[:3] = log10_det, coupling_index, 10.0
    row[3 + 1] = excess
    return row


@pytest.mark.parametrize(("method", "n_objectives"), [("b", 1), ("front", 2)])
def test_a_motion_that_cannot_be_judged_ranks_behind_all_that_can(method, n_objectives) -> None:
    rows = np.array(
        [
            unplanned(),
            scored(-np.inf, np.inf, 0.0),  # keeps everything, and leaves a parameter out
            scored(-np.inf, np.inf, 0.3),
            scored(80.0, 90.0, 40.0),  # far beyond a limit
            scored(81.0, 90.0, 0.2),
            scored(70.0, 100.0, 0.0),
        ]
    )
    first = np.linspace(0.1, 0.9, len(rows))[:, None] * np.ones(4)
    settings = SearchSettings(method=method, population=len(rows), generations=2)
    evolution = Evolution(settings, first, n_objectives)
    asked = evolution.ask()
    assert asked is not None
    scores = Scores.of_rows(rows)
    evolution.tell(scores, np.stack((-scores.log10_det, scores.coupling_index)[:n_objectives], 1))
    children = evolution.ask()
    assert children is not None
    without_motion = np.tile(unplanned(), (len(children), 1))
    evolution.tell(Scores.of_rows(without_motion), np.zeros((len(children), n_objectives)))
    ranked = evolution._algorithm.pop.get("X")
    np.testing.assert_array_equal(ranked[:5], asked[[5, 4, 3, 1, 2]])
