from __future__ import annotations

import os
import signal
import time
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
from planner import PiecewiseCubic, check_limits
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


def test_scores_are_those_of_the_regressor_of_the_planned_motion(population):
    model = population.problem.objective.model
    rows = genes(5)
    scores = population.score(rows)
    for k, trajectory in enumerate(population.problem.genome.motions(rows)):
        assert isinstance(trajectory, PiecewiseCubic)
        motion = midpoints(trajectory, 0.008)
        phi = model.regressor(motion.position, motion.velocity, motion.acceleration)
        stacked = phi.dense(model.n_parameters).reshape(-1, model.n_parameters)
        sign, log_det = np.linalg.slogdet(stacked.T @ stacked / motion.n_samples)
        assert sign == 1.0
        np.testing.assert_allclose(scores.log10_det[k], log_det / np.log(10.0), rtol=1e-9)
        psi = np.linalg.inv(stacked.T @ stacked)
        length = np.sqrt(np.diag(psi))
        coupling = np.abs(np.tril(psi / length[:, None] / length, -1)).sum()
        np.testing.assert_allclose(scores.coupling_index[k], coupling, rtol=1e-9)
        assert scores.duration[k] == trajectory.duration
    assert np.all(scores.feasible)
    assert np.all(scores.usable)


def test_a_child_scores_as_this_process_does_to_the_last_bit(population):
    rows = genes(20)
    assert same(population.score(rows), population.problem.score(rows))


def test_the_number_of_workers_changes_no_bit(population):
    rows = genes(37)
    with Population(population.problem, workers=3) as three:
        assert same(three.score(rows), population.score(rows))


def test_company_and_order_change_no_bit(population):
    rows = genes(29)
    order = np.random.default_rng(1).permutation(29)
    shuffled = population.score(rows[order]).rows
    assert shuffled.tobytes() == population.score(rows).rows[order].tobytes()
    alone = [population.score(rows[k : k + 1]).rows for k in range(3)]
    assert np.concatenate(alone).tobytes() == population.score(rows[:3]).rows.tobytes()


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


def test_genes_without_a_motion_have_the_worst_scores_and_say_why(population):
    rows = genes(3)
    rows[1, 0] = 1.0
    with Population(problem(moody(refuse=(0.999, 1.0)))) as refusing:
        scores = refusing.score(rows)
        (violation,) = refusing.violations(rows[1])
        assert refusing.violations(rows[0]) == ()
    np.testing.assert_array_equal(scores.feasible, [True, False, True])
    assert scores.log10_det[1] == -np.inf
    assert scores.coupling_index[1] == np.inf
    assert np.isnan(scores.duration[1])
    assert violation.kind == "planning"
    assert "this motion cannot be" in str(violation)


def test_a_crash_is_told_as_a_reason_too():
    with Population(problem(moody(crash=(0.0, 1.0)))) as deadly:
        (violation,) = deadly.violations(genes(1)[0])
    assert violation.kind == "planning"
    assert "signal 6" in str(violation)


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


def test_excess_is_told_kind_by_kind_and_agrees_with_the_violations(population):
    tight = problem(max_duration=2.0, limits=_slower(0.8))
    rows = genes(16, seed=5)
    scores = tight.score(rows)
    for k, trajectory in enumerate(tight.genome.motions(rows)):
        assert isinstance(trajectory, PiecewiseCubic)
        assert (scores.excess[k, KINDS.index("duration")] > 0.0) == (trajectory.duration > 2.0)
        try:
            check_limits(trajectory, tight.constraints.limits)
            fast = False
        except LimitExceeded:
            fast = True
        assert (scores.excess[k, KINDS.index("joint limit")] > 0.0) == fast
        kinds = {violation.kind for violation in tight.violations(rows[k])}
        assert kinds == {KINDS[j] for j in np.flatnonzero(scores.excess[k])}
    assert 0 < np.count_nonzero(scores.feasible) < 16
    # constraints decide what is feasible, not what is measured
    np.testing.assert_array_equal(scores.log10_det, population.score(rows).log10_det)


def test_a_motion_is_judged_at_a_period_of_choice(population):
    row = genes(1)[0]
    trajectory, criteria = population.judged(row, 0.001)
    assert criteria.n_samples == midpoints(trajectory, 0.001).n_samples
    assert criteria == population.problem.objective.criteria(trajectory, 0.001)


def test_a_motion_that_leaves_a_parameter_out_is_feasible_and_of_no_use(population):
    rows = genes(1)
    rows[:, 1:6:2] = 0.5  # the elbow stands still
    scores = population.score(rows)
    assert scores.feasible.tolist() == [True]
    assert scores.usable.tolist() == [False]
    assert scores.coupling_index.tolist() == [np.inf]


def test_rows_carry_every_bit():
    rows = np.random.default_rng(0).normal(size=(6, ROW))
    rows[2] = unplanned()
    assert Scores.of_rows(rows).rows.tobytes() == rows.tobytes()
    assert Scores.of_rows(rows).take(2).rows.tobytes() == unplanned().tobytes()


def test_a_population_needs_a_process():
    with pytest.raises(DesignError, match="workers"):
        Population(problem(), workers=0)


def _slower(share: float):
    return type(LIMITS)(
        LIMITS.lower, LIMITS.upper, LIMITS.velocity * share, LIMITS.acceleration, LIMITS.jerk
    )


def currents(limit: float) -> CurrentModel:
    model = problem().objective.model
    values = np.random.default_rng(2).uniform(0.1, 1.0, model.n_parameters)
    return CurrentModel(model, values, np.eye(2), np.ones(2), np.full(2, limit), uncertainty=0.2)


def test_motions_are_judged_in_the_middle_of_their_steps():
    asked = problem(currents=currents(100.0))
    genes = np.random.default_rng(0).random((6, asked.genome.n_genes))
    scores = asked.score(genes)
    for k, motion in enumerate(asked.genome.motions(genes)):
        expected = asked.objective.measures(midpoints(motion, asked.period))
        assert (scores.log10_det[k], scores.coupling_index[k]) == expected
        criteria = asked.judged(genes[k], asked.period)[1]
        assert (criteria.log10_det, criteria.coupling_index) == expected


def test_a_search_sees_of_currents_what_the_last_check_sees():
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
def test_a_motion_that_cannot_be_judged_ranks_behind_all_that_can(method, n_objectives):
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
