from __future__ import annotations

import numpy as np
import pytest

from identification.excitation import Scores, SearchSettings
from identification.excitation.searches.problem import ROW, unplanned
from identification.excitation.searches.run import Evolution


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
