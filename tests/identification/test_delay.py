"""Delay of the torque, of two links and of the simulated NS 16."""

from dataclasses import replace

import numpy as np
import pytest

from identification.errors import IdentificationError
from identification.estimators.delay import (
    LONGEST_DELAY,
    estimate_delay,
    rate_products,
    with_uncertain_delay,
)
from identification.factor.factor import Factor, estimate
from identification.model.friction import FrictionLaw
from identification.model.payload import Payload
from identification.model.robot import RobotModel
from identification.signals.recording import Recording
from identification.signals.samples import Preprocessing, prepare
from identification.signals.smoothing import low_pass
from tests.identification.two_link import MODEL, URDF, four_sines, truth

TRUTH = truth()
STEP = 1e-3
UNEVEN = np.cumsum(STEP * np.random.default_rng(5).uniform(0.4, 1.6, 6000))
CARRYING = RobotModel.from_urdf(
    URDF, friction=FrictionLaw(third=None), payload=Payload(mass=60.0, centre=(0.3, 0.1, 0.0))
)


def motion(time, speed=1.0):
    """Position, velocity and acceleration (m, 2) of four sines for each joint."""
    return four_sines(time, speed)[1:4]


def a_recording(
    delays, *, model=MODEL, seed=0, speed=1.0, torque_noise=1.0, position_noise=2e-5, time=None
):
    """Simulate two links whose torque is logged `delays` [s] after the position."""
    if time is None:
        time = np.arange(6000) * STEP
    rng = np.random.default_rng(seed)
    late = [motion(time - delay, speed) for delay in np.broadcast_to(delays, 2)]
    torque = np.column_stack(
        [(model.torque(TRUTH, *one) + model.load_torque(*one))[:, j] for j, one in enumerate(late)]
    )
    shape = torque.shape
    return Recording(
        time=time,
        position=motion(time, speed)[0] + position_noise * rng.standard_normal(shape),
        joint_names=model.joint_names,
        torque=torque + torque_noise * np.array([1.0, 0.2]) * rng.standard_normal(shape),
    )


class TestDelay:
    @pytest.mark.parametrize(
        ("planted", "near", "options"),
        [
            (3.7e-4, 5e-6, {"torque_noise": 0.0, "position_noise": 1e-8}),
            (3.7e-4, 1e-4, {"time": UNEVEN, "torque_noise": 0.3}),
            # Of many cycles.
            *((planted, 3e-4, {}) for planted in (-0.043, 0.01, 0.048)),
            # The known torque of a payload, subtracted with another delay.
            (0.01, 1e-4, {"model": CARRYING, "torque_noise": 0.1}),
        ],
    )
    def test_it_is_found(self, planted, near, options):
        options = {"model": MODEL} | options
        found = estimate_delay(a_recording(delays=planted, **options), options["model"])
        assert found.delay == pytest.approx(planted, abs=near)
        assert found.applied == found.delay

    def test_it_is_found_in_a_filtered_torque(self):
        time = np.arange(0.0, 8.0, 0.004)
        recording = a_recording(delays=0.003, time=time, torque_noise=0.3)
        filtered = replace(recording, torque=low_pass(time, recording.torque, 8.0))
        found = estimate_delay(filtered, MODEL, options=Preprocessing(torque_bandwidth=8.0))
        assert found.delay == pytest.approx(0.003, abs=4e-4)

    def test_noise_does_not_bias_it_and_the_interval_covers(self):
        """Mean within its standard error, scatter over seeds as estimated."""
        found = [estimate_delay(a_recording(1.6e-3, seed=seed), MODEL) for seed in range(12)]
        error = np.array([one.delay - 1.6e-3 for one in found])
        claimed = np.sqrt(np.mean([one.std**2 for one in found]))
        scatter = error.std(ddof=1)
        assert abs(error.mean()) < 3.0 * scatter / np.sqrt(len(found)) + 5e-6
        # The standard deviation of 12 samples has an error of 21 %.
        assert abs(np.log(claimed / scatter)) < 3 * 0.21
        assert all(one.significant for one in found)

    def test_a_delay_beyond_the_range_is_undetermined(self):
        found = estimate_delay(a_recording(0.06), MODEL)
        assert found.reason == "the residual decreases up to the longest delay tested"
        assert found.applied == 0.0

    def test_it_is_found_beside_an_assumed_delay(self):
        recording = a_recording(0.004)
        found = estimate_delay(recording, MODEL, options=Preprocessing(torque_delay=0.003))
        assert found.delay == pytest.approx(0.004, abs=3e-4)
        assert found.significant
        right = estimate_delay(recording, MODEL, options=Preprocessing(torque_delay=0.004))
        assert not right.significant
        assert right.applied == 0.004

    def test_presliding_friction_is_read_at_the_same_time(self):
        law = FrictionLaw(third=None, presliding=1e-3)
        model = RobotModel.from_urdf(URDF, friction=law)
        time = np.arange(6000) * STEP
        late = motion(time - 0.005)
        direction = model.friction.direction(time, late[0], late[1])
        recording = replace(
            a_recording(0.0, model=model), torque=model.torque(TRUTH, *late, direction)
        )
        assert estimate_delay(recording, model).delay == pytest.approx(0.005, abs=5e-5)


class TestUndeterminedDelay:
    def test_a_slow_motion_does_not_determine_it(self):
        slow = estimate_delay(a_recording(0.0, speed=0.05), MODEL)
        assert not slow.determined
        assert slow.applied == 0.0
        line = slow.describe()
        assert line.startswith("all axes: not determined; 95 % interval of ± ")
        assert line.endswith("the torques change too slowly, or are too noisy")
        unknown = replace(slow, std=np.inf)
        assert unknown.variance == pytest.approx(LONGEST_DELAY**2 / 3.0)
        assert replace(slow, std=1e-4).variance == pytest.approx(1e-8)

    def test_an_uncertain_significant_delay_is_applied(self):
        found = estimate_delay(a_recording(0.045, speed=0.2, seed=2), MODEL)
        assert found.reason is not None and found.significant
        assert found.applied == found.delay
        line = found.describe()
        assert line.endswith("cycles), significantly different from the 0 ms assumed")

    def test_a_recording_without_motion_raises(self):
        still = a_recording(0.0, speed=0.0)
        with pytest.raises(IdentificationError, match="not one usable sample"):
            estimate_delay(still, MODEL)


class TestDelayUncertainty:
    def fit(self, model, samples):
        return estimate(model, Factor.of(model, samples), np.array([1.0, 25.0]))

    def test_the_sensitivity_is_the_derivative_of_the_estimate(self):
        """Compared with fits at delays half a millisecond shorter and longer."""
        recording = a_recording(0.004, torque_noise=0.0, position_noise=1e-8)

        def samples(delay):
            options = Preprocessing(torque_delay=delay, left_out="slow", rigid_bandwidth=40.0)
            return prepare(recording, MODEL, options=options)

        middle = samples(0.004)
        fitted, products = self.fit(MODEL, middle), rate_products(MODEL, middle)
        fitted = replace(fitted, noise_std=np.array([1.0, 0.2]))  # as weighted
        wider = with_uncertain_delay(fitted, Factor.of(MODEL, middle), products, 0.25)
        ends = [self.fit(MODEL, samples(0.004 + side)).values for side in (-5e-4, 5e-4)]
        slope = (ends[1] - ends[0]) / 1e-3
        added = wider.covariance - fitted.covariance
        np.testing.assert_allclose(added, 0.25 * np.outer(slope, slope), rtol=0.06, atol=1e-6)
        np.testing.assert_array_equal(wider.values, fitted.values)
