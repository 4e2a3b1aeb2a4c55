from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from identification.errors import IdentificationError, ShapeError
from identification.estimators.delay import (
    compensate,
    delay_sensitivity,
    rate_products,
    with_uncertain_delay,
)
from identification.factor.factor import Estimate, Factor, estimate
from identification.model.robot import RobotModel
from identification.signals.samples import Preprocessing, Samples, prepare
from tests.identification.test_delay import a_recording, model, motion, truth

Array = NDArray[np.float64]
__all__ = ["model", "truth"]  # fixtures

PLANTED = np.array([0.37e-3, -1.3e-3])  # s


class TestCompensation:
    def test_torques_belong_to_their_positions(self, model: RobotModel, truth: Array) -> None:
        late = a_recording(model, truth, PLANTED, torque_noise=0.0, position_noise=0.0)
        time = late.time
        gap = np.zeros(len(time), dtype=np.bool_)
        gap[2500] = True
        torn = replace(late, gap_before=gap)
        there = compensate(torn, PLANTED)
        assert there.torque is not None
        exact = model.torque(truth, *motion(there.time))
        clear = np.abs(motion(there.time)[1]) > 0.1  # Coulomb friction jumps between samples
        assert np.abs(there.torque - exact)[clear].max() < 2e-3
        assert len(there.segments()) == 2
        # Nothing was read across the gap: the samples beside it that would need it are gone.
        assert there.n_samples == torn.n_samples - 2 * 3

    def test_by_nothing_it_changes_nothing(self, model: RobotModel, truth: Array) -> None:
        recording = a_recording(model, truth, 0.0)
        same = compensate(recording, [0.0, 0.0])
        assert recording.torque is not None
        np.testing.assert_array_equal(same.torque, recording.torque)
        np.testing.assert_array_equal(same.time, recording.time)

    def test_what_cannot_be_compensated_is_refused(self, model: RobotModel, truth: Array) -> None:
        recording = a_recording(model, truth, 0.0)
        with pytest.raises(ShapeError, match="delays"):
            compensate(recording, [0.1])
        with pytest.raises(IdentificationError, match="shorter than the delay"):
            compensate(recording, [100.0, 0.0])


class TestDelayUncertainty:
    def fit(self, model: RobotModel, samples: Samples) -> Estimate:
        return estimate(model, Factor.of(model, samples), np.array([1.0, 25.0]))

    def test_the_sensitivity_is_the_slope_of_the_estimate(
        self, model: RobotModel, truth: Array
    ) -> None:
        """Against fits with a delay half a millisecond shorter and longer."""
        recording = a_recording(model, truth, 0.004, torque_noise=0.0, position_noise=1e-8)

        def samples(delay: float) -> Samples:
            options = Preprocessing(torque_delay=delay, left_out="slow", rigid_bandwidth=40.0)
            return prepare(recording, model, options=options)

        fitted = self.fit(model, samples(0.004))
        middle, weights = samples(0.004), np.array([1.0, 25.0])
        slope = delay_sensitivity(
            Factor.of(model, middle), rate_products(model, middle), weights, fitted.values
        )
        ends = [self.fit(model, samples(0.004 + side)).values for side in (-5e-4, 5e-4)]
        assert slope == pytest.approx((ends[1] - ends[0]) / 1e-3, rel=0.03)

    def test_variances_grow_by_the_square_of_the_sensitivity(
        self, model: RobotModel, truth: Array
    ) -> None:
        samples = prepare(a_recording(model, truth, 0.0), model)
        fitted, factor = self.fit(model, samples), Factor.of(model, samples)
        products = rate_products(model, samples)
        weights = fitted.noise_std**-2.0
        sensitivity = delay_sensitivity(factor, products, weights, fitted.values)
        wider = with_uncertain_delay(fitted, factor, products, 0.25)
        np.testing.assert_allclose(wider.std**2, fitted.std**2 + 0.25 * sensitivity**2)
        np.testing.assert_array_equal(wider.values, fitted.values)

    def test_what_is_undetermined_stays_so(self, model: RobotModel, truth: Array) -> None:
        samples = prepare(a_recording(model, truth, 0.0), model)
        fitted, products = self.fit(model, samples), rate_products(model, samples)
        covariance = fitted.covariance.copy()
        covariance[0, :] = covariance[:, 0] = 0.0
        covariance[0, 0] = np.inf
        unknown = replace(fitted, covariance=covariance)
        wider = with_uncertain_delay(unknown, Factor.of(model, samples), products, 1.0)
        assert np.isinf(wider.covariance[0, 0])
        np.testing.assert_array_equal(wider.covariance[0, 1:], 0.0)
