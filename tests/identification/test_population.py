from __future__ import annotations

import os
import signal
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from identification.excitation import (
    CurrentModel,
    DesignError,
    Population,
    Scores,
    SearchSettings,
    check_motion,
    midpoints,
)
from identification.excitation.searches.run import Evolution
from identification.excitation.searches.scores import ROW, unplanned
from identification.excitation.violation import KINDS, excess_by_kind
from planner import check_limits
from planner.errors import LimitExceeded
from tests.identification.searching import LIMITS, moody, problem

PLANNING = KINDS.index("planning")


def genes(count: int, n_genes: int = 8, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random((count, n_genes))


def same(scores: Scores, others: Scores) -> bool:
    return scores.rows.tobytes() == others.rows.tobytes()


@pytest.fixture(autouse=True)
def importable(monkeypatch):
    """A child finds the genomes of these tests under the name that they have here."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2]))


@pytest.fixture(scope="module")
def population():
    with Population(problem()) as population:
        yield population


def test_processes_company_and_order_change_no_bit(population):
    rows = genes(37)
    expected = population.score(rows)
    assert same(population.problem.score(rows), expected)
    with Population(population.problem, workers=3) as three:
        assert same(three.score(rows), expected)
    order = np.random.default_rng(1).permutation(37)
    assert population.score(rows[order]).rows.tobytes() == expected.rows[order].tobytes()
    alone = [population.score(rows[k : k + 1]).rows for k in range(3)]
    assert np.concatenate(alone).tobytes() == expected.rows[:3].tobytes()


@pytest.mark.slow
def test_a_motion_that_crashes_its_process_costs_no_other_motion(population):
    rows = genes(20, seed=3)
    rows[:, 0] *= 0.9
    rows[11, 0] = 0.99
    with Population(problem(moody(crash=(0.95, 1.0))), workers=2) as deadly:
        scores = deadly.score(rows)
        assert same(deadly.score(rows[:12]), Scores.of_rows(scores.rows[:12]))  # nor is it chance
    crashed = rows[:, 0] >= 0.95
    np.testing.assert_array_equal(scores.feasible, ~crashed)
    np.testing.assert_array_equal(scores.rows[crashed], unplanned()[None])
    assert np.all(scores.excess[crashed, PLANNING] > 0.0)
    assert scores.rows[~crashed].tobytes() == population.score(rows[~crashed]).rows.tobytes()


@pytest.mark.slow
def test_a_motion_is_late_only_if_it_was_alone(population):
    """Those that shared its process wait and are scored after all."""
    rows = genes(8, seed=4) * 0.9
    rows[5, 0] = 1.0
    with Population(problem(moody(hang=(0.99, 1.0))), timeout=5.0) as slow:
        begin = time.monotonic()
        scores = slow.score(rows)
        assert time.monotonic() - begin > 10.0  # once in company, once with all the time for itself
    others = np.arange(8) != 5
    np.testing.assert_array_equal(scores.feasible, others)
    assert scores.rows[others].tobytes() == population.score(rows[others]).rows.tobytes()


def test_genes_without_a_motion_are_worst_and_say_why(population):
    rows = genes(3)
    rows[1, 0] = 1.0
    with Population(problem(moody(refuse=(0.999, 1.0)))) as refusing:
        scores = refusing.score(rows)
        (violation,) = refusing.violations(rows[1])
        assert refusing.violations(rows[0]) == ()
    np.testing.assert_array_equal(scores.feasible, [True, False, True])
    np.testing.assert_array_equal(scores.rows[1], unplanned())
    np.testing.assert_array_equal(unplanned()[:3], [-np.inf, np.inf, np.nan])
    assert violation.kind == "planning" and "this motion cannot be" in str(violation)
    with Population(problem(moody(crash=(0.0, 1.0)))) as deadly:
        (violation,) = deadly.violations(rows[0])
    assert violation.kind == "planning" and "signal 6" in str(violation)


def test_a_process_ended_from_outside_changes_nothing(population):
    rows = genes(2)
    expected = population.score(rows[:1]), population.judged(rows[0], 0.01)[1]
    for pid in (child.pid for child in population._children):
        os.kill(pid, signal.SIGKILL)
    assert same(population.score(rows[:1]), expected[0])
    os.kill(population._children[0].pid, signal.SIGKILL)
    assert population.judged(rows[0], 0.01)[1] == expected[1]
    os.kill(population._children[0].pid, signal.SIGKILL)
    assert population.violations(rows[0]) == ()


def currents(limit: float) -> CurrentModel:
    model = problem().objective.model
    values = np.random.default_rng(2).uniform(0.1, 1.0, model.n_parameters)
    return CurrentModel(model, values, np.eye(2), np.ones(2), np.full(2, limit), uncertainty=0.2)


def test_excess_is_that_of_the_violations_by_kind(population):
    """A search sees what the last check sees, in the middle of steps and at their ends."""
    slower = replace(LIMITS, velocity=0.8 * LIMITS.velocity)
    asked = problem(max_duration=2.0, limits=slower, currents=currents(20.0))
    rows = genes(16, seed=5)
    scores = asked.score(rows)
    for k, motion in enumerate(asked.genome.motions(rows)):
        assert (scores.excess[k, KINDS.index("duration")] > 0.0) == (motion.duration > 2.0)
        try:
            check_limits(motion, slower)
            fast = False
        except LimitExceeded:
            fast = True
        assert (scores.excess[k, KINDS.index("joint limit")] > 0.0) == fast
        assert {each.kind for each in asked.violations(rows[k])} == {
            KINDS[j] for j in np.flatnonzero(scores.excess[k])
        }
        last = check_motion(motion, slower, currents=asked.constraints.currents).violations
        last_excess = excess_by_kind([each for each in last if each.kind != "duration"])
        others = np.array(KINDS) != "duration"
        np.testing.assert_array_equal(scores.excess[k, others], last_excess[others])
        measures = asked.objective.measures(midpoints(motion, asked.period))
        assert scores.measures[k].tolist() == list(measures.values())
    assert set(np.flatnonzero(scores.excess.any(axis=0))) >= {1, 2, 5}
    # constraints decide what is feasible, not what is measured
    np.testing.assert_array_equal(scores.measures, population.score(rows).measures)


def test_a_population_needs_a_process():
    with pytest.raises(DesignError, match="workers"):
        Population(problem(), workers=0)


def scored(log10_det: float, coupling_index: float, excess: float) -> np.ndarray:
    row = np.zeros(ROW)
    row[:3] = log10_det, coupling_index, 10.0
    row[3 + 1] = excess
    return row


@pytest.mark.parametrize(("method", "n_objectives"), [("b", 1), ("front", 2)])
def test_what_cannot_be_judged_ranks_behind_the_rest(method, n_objectives):
    rows = np.array(
        [
            unplanned(),
            scored(-np.inf, np.inf, 0.0),  # satisfies everything, and leaves a parameter out
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
    evolution.tell(scores, scores.measures[:, :n_objectives] * [-1.0, 1.0][:n_objectives])
    children = evolution.ask()
    assert children is not None
    without_motion = np.tile(unplanned(), (len(children), 1))
    evolution.tell(Scores.of_rows(without_motion), np.zeros((len(children), n_objectives)))
    ranked = evolution._algorithm.pop.get("X")
    np.testing.assert_array_equal(ranked[:5], asked[[5, 4, 3, 1, 2]])
