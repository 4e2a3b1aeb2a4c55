from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from identification.errors import IdentificationError
from identification.estimators.covariance import with_block_covariance
from identification.estimators.least_squares import (
    fit_least_squares,
)
from identification.estimators.robust import robust_estimate
from identification.factor.factor import Factor, QRFactor, estimate, joint_weights
from identification.factor.phases import PhaseFactor
from identification.model.motion import Motion
from tests.identification.two_link import (
    MODEL,
    P,
    a_motion,
    coloured,
    gaussian,
    recording,
    truth,
)

Array = NDArray[np.float64]


def test_ordinary_least_squares_is_the_stacked_unweighted_solution() -> None:
    motion = a_motion(4.0)
    samples = recording(gaussian(np.random.default_rng(8), motion), motion)
    rows = MODEL.regressor(*motion[1:]).dense(P)[samples.usable]
    expected, *_ = np.linalg.lstsq(rows, samples.torque[samples.usable], rcond=None)
    result = fit_least_squares(MODEL, [samples], "ordinary")
    np.testing.assert_allclose(result.values, expected, rtol=1e-8)
    assert result.method.startswith("ordinary least squares")


def test_the_covariance_from_rows_is_that_from_gram_matrices_of_blocks() -> None:
    motion, rng = a_motion(), np.random.default_rng(9)
    runs = [recording(coloured(rng, len(motion.time), 5e-3, 0.05), motion) for _ in range(3)]
    phase = PhaseFactor.from_samples(MODEL, runs[0])
    for run in runs[1:]:
        phase = phase + PhaseFactor.from_samples(MODEL, run)
    for weighting in ("ordinary", "weighted"):
        ordinary = weighting == "ordinary"
        weights = np.ones(2) if ordinary else joint_weights(phase.total)
        expected = with_block_covariance(estimate(MODEL, phase.total, weights), phase, weights)
        found = fit_least_squares(MODEL, runs, weighting)  # type: ignore[arg-type]
        np.testing.assert_allclose(found.values, expected.values, rtol=1e-9)
        np.testing.assert_allclose(found.std, expected.std, rtol=1e-6)
        assert found.interval_factor == expected.interval_factor
        assert found.method.startswith(f"{weighting} least squares, cluster-robust covariance")


def test_an_ill_conditioned_fit_is_done_by_qr_and_says_so() -> None:
    time = np.arange(400) * 2e-3
    ripple, w = 1e-5, 3.7
    q = np.column_stack([0.9 * np.sin(2.1 * time), time + ripple * np.sin(w * time)])
    qd = np.column_stack([1.89 * np.cos(2.1 * time), 1.0 + ripple * w * np.cos(w * time)])
    qdd = np.column_stack([-3.969 * np.sin(2.1 * time), -ripple * w**2 * np.sin(w * time)])
    samples = recording(np.zeros((400, 2)), Motion(time, q, qd, qdd))
    result = fit_least_squares(MODEL, [samples])
    assert "by QR" in result.method
    assert result.condition > 1e6
    np.testing.assert_allclose(result.values, truth(), rtol=1e-4)
    robust = robust_estimate(MODEL, [samples])
    assert "by QR" in robust.estimate.method


def test_weighted_least_squares_takes_either_factor() -> None:
    motion = a_motion(4.0)
    samples = recording(gaussian(np.random.default_rng(10), motion), motion)
    by_gram = estimate(MODEL, Factor.of(MODEL, samples))
    by_qr = estimate(MODEL, QRFactor.of(MODEL, samples))
    np.testing.assert_allclose(by_qr.values, by_gram.values, rtol=1e-9)
    with pytest.raises(IdentificationError, match="not one usable sample"):
        fit_least_squares(MODEL, [replace(samples, usable=np.zeros_like(samples.usable))])
