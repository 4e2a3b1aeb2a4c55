"""Wanted precision: variances, their slopes, and a search that follows them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from identification.estimators.payload_estimate import parameter_change
from identification.excitation import (
    LoadQuantities,
    Precision,
    Quantities,
    SearchSettings,
    midpoints,
    search,
)
from identification.excitation.criteria import friction_of_excitation
from identification.excitation.motion_precision import INTERVAL_SIGMAS
from identification.excitation.searches.population import Population
from identification.excitation.searches.sensitivity import gene_slopes
from tests.identification.searching import problem as small_problem


@pytest.fixture(autouse=True)
def importable(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the genomes of these tests importable in child processes."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2]))


RANDOM = np.random.default_rng(52)


def positive(p: int) -> np.ndarray:
    root = RANDOM.standard_normal((p, 2 * p))
    return root @ root.T


def wanted(kind: str, p: int = 12) -> Precision:
    """Three quantities of an arm of p parameters, or of a load that changes four of them."""
    allowed = np.array([0.1, 0.2, 0.3])
    if kind == "arm":
        quantities = Quantities(RANDOM.standard_normal((3, p)), allowed)
    else:
        change = RANDOM.standard_normal((p, 4))
        root = np.linalg.cholesky(positive(p))
        quantities = LoadQuantities(RANDOM.standard_normal((3, 4)), allowed, change, root)
    return Precision(quantities, np.ones(2), positive(p))


class TestVariances:
    def test_of_an_arm_are_those_of_the_inverse_information(self) -> None:
        precision = wanted("arm")
        information = positive(12)
        a = precision.quantities.directions
        covariance = np.linalg.inv(precision.prior + information)
        half = INTERVAL_SIGMAS * np.sqrt(np.diag(a @ covariance @ a.T))
        np.testing.assert_allclose(precision.ratios(information), half / [0.1, 0.2, 0.3])

    def test_of_a_load_are_those_of_least_squares(self) -> None:
        """The arm is known with C, the loaded recording determines arm and load together."""
        precision = wanted("load")
        data = positive(12)
        load = precision.quantities
        assert isinstance(load, LoadQuantities)
        arm_information = np.linalg.inv(load.root @ load.root.T)
        d = load.change
        both = np.block([[data + arm_information, data @ d], [d.T @ data, d.T @ data @ d]])
        covariance = np.linalg.inv(both)[12:, 12:]
        half = INTERVAL_SIGMAS * np.sqrt(np.diag(load.directions @ covariance @ load.directions.T))
        np.testing.assert_allclose(precision.ratios(data), half / load.allowed, rtol=1e-6)

    @pytest.mark.parametrize("kind", ["arm", "load"])
    def test_the_slope_is_that_of_differences(self, kind: str) -> None:
        precision = wanted(kind)
        information = positive(12)
        change = positive(12)
        step = 1e-6
        above, below = (
            -np.log(precision.criterion(information + sign * step * change)) for sign in (1, -1)
        )
        slope = float(np.sum(precision.slope(information) * change))
        assert slope == pytest.approx((above - below) / (2.0 * step), rel=1e-5)


def search_problem(kind: str = "arm"):
    """A search for all parameters of an arm, or for a mass at the end of its second link."""
    problem = small_problem()
    model = problem.objective.model
    p = model.n_parameters
    quantities: Quantities | LoadQuantities = Quantities(np.eye(p), np.ones(p))
    if kind == "load":
        mass = np.eye(10)[-1:]
        quantities = LoadQuantities(mass, np.ones(1), parameter_change(model, None), np.eye(p))
    density = np.linspace(1.0, 3.0, model.n_joints)
    precision = Precision(quantities, density, 1e-3 * np.eye(p))
    return replace(problem, objective=replace(problem.objective, precision=precision))


def random_genes(problem) -> np.ndarray:
    return 0.3 + 0.4 * np.random.default_rng(3).random(problem.genome.n_genes)


def test_a_load_is_weighed_beside_unknown_offsets() -> None:
    """The information on the parameters when the offsets are eliminated from the equations."""
    problem = search_problem("load")
    model = problem.objective.model
    (planned,) = problem.genome.motions(random_genes(problem)[None])
    motion = midpoints(planned, 1e-2)
    direction = friction_of_excitation(model).direction(motion)
    rows = model.regressor(replace(motion, direction=direction)).dense(model.n_parameters)
    m, n, p = rows.shape
    beside = np.tile(np.eye(n), (m, 1))
    whole = np.column_stack([rows.reshape(m * n, p), beside])
    weights = np.tile((motion.time[1] - motion.time[0]) / problem.objective.precision.density, m)
    total = whole.T @ (weights[:, None] * whole)
    offsets = slice(p, None)
    expected = total[:p, :p] - total[:p, offsets] @ np.linalg.solve(
        total[offsets, offsets], total[offsets, :p]
    )
    information = problem.objective.precise_information(motion)
    np.testing.assert_allclose(information, expected, atol=1e-9 * np.abs(expected).max())


class TestSearch:
    @pytest.mark.parametrize("kind", ["arm", "load"])
    def test_the_gradient_predicts_changes_of_the_criterion(self, kind: str) -> None:
        """A motion that lasts longer informs more, so that the duration counts too."""
        problem = search_problem(kind)
        random = np.random.default_rng(4)
        genes = random_genes(problem)
        sensitivity = problem.sensitivity(genes, None)
        gradient = gene_slopes(problem, sensitivity, genes, np.arange(len(genes)))[:, 0]

        def value(row: np.ndarray) -> float:
            (motion,) = problem.genome.motions(row[None])
            return -np.log(problem.objective.scores(midpoints(motion, 1e-3))[1])

        changes = 1e-3 * random.standard_normal((12, len(genes)))
        expected = [(value(genes + d) - value(genes - d)) / 2.0 for d in changes]
        assert np.corrcoef(changes @ gradient, expected)[0, 1] > 0.95

    @pytest.mark.long
    def test_the_gradient_makes_a_motion_more_precise(self) -> None:
        problem = search_problem()
        effort = {"population": 16, "generations": 2, "mutation": 0.1}
        with Population(problem, 1) as population:
            short, longer = (
                search(population, SearchSettings("gradient", gradient=steps, **effort))
                for steps in (0, 12)
            )
            first, last = population.score(np.array([short.genes, longer.genes])).precision
        assert last < 0.95 * first
