"""Least squares drawn towards the physically consistent solution."""

from __future__ import annotations

import math

import numpy as np
import pytest

from identification.estimators.least_squares import fit_least_squares
from identification.estimators.shrinkage import (
    Shrinkage,
    consistent_centre,
    fit_shrunk,
    shrunk_values,
)
from identification.factor.factor import joint_weights
from identification.factor.phases import total_phase
from identification.signals.samples import Samples
from tests.identification.two_link import MODEL, a_motion, gaussian, recording, truth


@pytest.fixture(scope="module")
def samples() -> Samples:
    motion = a_motion()
    return recording(gaussian(np.random.default_rng(3), motion), motion)


@pytest.fixture(scope="module")
def centre(samples: Samples) -> np.ndarray:
    total = total_phase(MODEL, [samples]).total
    return consistent_centre(MODEL, total, joint_weights(total), 0.1).estimate.values


class TestShrunkEstimate:
    def test_strength_zero_is_least_squares(self, samples: Samples, centre: np.ndarray) -> None:
        shrunk = fit_shrunk(MODEL, [samples], Shrinkage(0.0), centre=centre)
        free = fit_least_squares(MODEL, [samples])
        np.testing.assert_allclose(shrunk.values, free.values, rtol=1e-9)
        np.testing.assert_allclose(shrunk.covariance, free.covariance, rtol=1e-6)

    def test_infinite_strength_is_the_centre(self, samples: Samples, centre: np.ndarray) -> None:
        shrunk = fit_shrunk(MODEL, [samples], Shrinkage(math.inf), centre=centre)
        np.testing.assert_array_equal(shrunk.values, centre)

    def test_it_solves_the_penalised_equations(self, samples: Samples) -> None:
        """(A + s D) (x - c) = b - A c with D = diag(A), for any centre c."""
        total = total_phase(MODEL, [samples]).total
        equations = total.weighted(joint_weights(total))
        far = truth() + 1.0
        values = shrunk_values(equations, far, 0.3)
        penalised = equations.A + 0.3 * np.diag(np.diag(equations.A))
        residual = equations.b - equations.A @ far - penalised @ (values - far)
        assert np.abs(residual).max() < 1e-8 * np.abs(equations.b).max()

    def test_a_parameter_without_data_stays_at_the_centre(self, samples: Samples) -> None:
        total = total_phase(MODEL, [samples]).total
        equations = total.weighted(joint_weights(total))
        unseen = equations.A.copy()
        unseen[:, 0] = unseen[0, :] = 0.0
        blind = equations._replace(A=unseen, b=np.append(0.0, equations.b[1:]))
        assert shrunk_values(blind, np.full(MODEL.n_parameters, 7.0), 0.1)[0] == 7.0

    def test_the_covariance_is_symmetric_and_positive(
        self, samples: Samples, centre: np.ndarray
    ) -> None:
        found = fit_shrunk(MODEL, [samples], Shrinkage(0.1), centre=centre)
        np.testing.assert_allclose(found.covariance, found.covariance.T, atol=1e-12)
        assert np.linalg.eigvalsh(found.covariance).min() > 0.0
