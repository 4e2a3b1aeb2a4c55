"""Torque constants from a known payload."""

import numpy as np
import pytest

from identification.errors import IdentificationError
from identification.estimators.gains import identify_gains
from identification.factor.columns import gain_factor
from identification.factor.factor import joined
from identification.model.friction import FrictionLaw
from identification.model.payload import Load, Payload
from identification.model.robot import RobotModel
from sim_fixtures.ns16 import urdf_text
from tests.identification.robots import joint, link, ns16_values, robot
from tests.identification.two_link import (
    MODEL,
    as_samples,
    four_sines,
    truth,
    values_of,
)

LOAD = Payload(2.0, (0.03, 0.0, 0.45))
PLANTED = np.array([12.0, 5.0])  # N m / A
NOISE = np.array([0.3, 0.1])  # A
SEEDS = 100
TIME = np.arange(2000) * 5e-3

# Lifts along gravity, then turns about it: no payload loads the second axis.
LIFT_AND_TURN = robot(
    '<link name="base"/>',
    joint("lift", "base", "column", kind="prismatic"),
    link("column", mass=8, inertia=(0.2, 0.2, 0.05)),
    joint("turn", "column", "hand", ends=3),
    link("hand", mass=3, inertia=(0.02, 0.02, 0.03)),
)


def load_torque(model, payload, motion):
    return Load(model.chain, model.gravity, payload).torque(*motion[1:4])


def factor_of(noise=NOISE, *, seed=0, model=MODEL, values=None, gains=PLANTED, load=LOAD, **more):
    """Reduce a recording without payload and one with it; noise is on the currents."""
    motion, turns = more.get("motion"), more.get("turns")
    motion = four_sines(TIME, n=model.n_joints) if motion is None else motion
    samples = as_samples(model, motion, np.zeros_like(motion.position))
    rng = np.random.default_rng(seed)
    torque = model.torque(truth() if values is None else values, *motion[1:])
    factors = []
    for payload in (None, load):
        joint = torque if payload is None else torque + load_torque(model, payload, motion)
        motor = joint if turns is None else np.linalg.solve(turns.T, joint.T).T
        current = motor / gains + noise * rng.standard_normal(joint.shape)
        factors.append(gain_factor(model, samples, current, payload=payload, transmission=turns))
    return joined(factors)


def gains_of(factor, model=MODEL):
    return identify_gains(factor, model.joint_names)


def lifted(payload):
    """Return gains of an arm that lifts along gravity and turns about it."""
    model = RobotModel.from_urdf(LIFT_AND_TURN, friction=FrictionLaw(third=None))
    values = values_of(model, [20.0, 3.0, 15.0, 1.0], (2.0, 0.05))
    return gains_of(factor_of(model=model, values=values, load=payload), model)


# Motors' angles per joint angle with a coupled wrist, as the NS 16 has it.
TURNS = np.diag([-116.0, 116.0, -106.0, -50.0, 51.5, -33.0]) @ (
    np.eye(6) + np.array([[0.0] * 6] * 4 + [[0, 0, 0, -0.03, 0, 0], [0, 0, 0, 0.021, -0.035, 0]])
)
CONSTANTS = np.array([1.10, 1.10, 0.75, 0.36, 0.42, 0.42])
NS16_LOAD = Payload(16.0, (0.10, 0.05, 0.25), (0.1, 0.0, 0.0, 0.1, 0.0, 0.05))


def ns16(motion=None):
    """Return gains of the coupled NS 16."""
    model = RobotModel.from_urdf(urdf_text(), friction=FrictionLaw(third=None))
    factor = factor_of(
        np.full(6, 0.05),
        model=model,
        values=ns16_values(model),
        gains=CONSTANTS,
        load=NS16_LOAD,
        motion=motion,
        turns=TURNS,
    )
    return gains_of(factor, model)


@pytest.fixture(scope="module")
def many():
    return [gains_of(factor_of(seed=seed)) for seed in range(SEEDS)]


class TestGains:
    def test_without_noise_the_true_gains_are_found(self):
        assert gains_of(factor_of(np.zeros(2))).values == pytest.approx(PLANTED, rel=1e-6)

    def test_95_percent_intervals_cover(self, many):
        inside = [np.abs(one.values - PLANTED) <= one.interval_factor * one.std for one in many]
        # Fewer than 89 of 100 have a probability of 0.5 %.
        assert np.all(np.sum(inside, axis=0) >= 89)
        scatter = np.std([one.values for one in many], axis=0, ddof=1)
        claimed = np.sqrt(np.mean([one.std**2 for one in many], axis=0))
        # The standard deviation of 100 samples has an error of 7 %.
        assert np.all(np.abs(np.log(claimed / scatter)) < 3 * 0.07)

    def test_current_noise_does_not_bias_gains(self, many):
        """Unlike least squares of the equation linear in gains and parameters."""
        values = np.array([one.values for one in many])
        error = values.std(axis=0, ddof=1) / np.sqrt(SEEDS)
        assert np.all(np.abs(values.mean(axis=0) - PLANTED) < 3.0 * error)

    def test_an_unloaded_axis_is_undetermined(self):
        """An eccentric payload determines it."""
        gains = lifted(Payload(4.0, (0.0, 0.0, 0.1)))
        assert gains.values[0] == pytest.approx(PLANTED[0], abs=4.0 * gains.std[0])
        assert gains.determined.tolist() == [True, False]
        assert np.isnan(gains.values[1])
        assert np.isinf(gains.std[1])
        assert gains.reasons == (None, "the payload does not load it")
        gains = lifted(Payload(4.0, (0.2, 0.0, 0.1)))
        assert np.all(np.abs(gains.values - PLANTED) < 4.0 * gains.std)

    def test_the_torque_constants_of_a_coupled_ns16(self):
        gains = ns16()
        assert gains.determined.all()
        assert np.all(np.abs(gains.values - CONSTANTS) < 4.0 * gains.std)
        assert np.all(gains.std < 0.02 * CONSTANTS)

    def test_on_a_slow_ns16_only_loaded_axes_are_determined(self):
        gains = ns16(four_sines(np.arange(6000) * 0.02, 0.03, n=6))
        assert not gains.determined[0]
        assert gains.determined[[1, 2]].all()
        assert np.all(np.abs(gains.values - CONSTANTS)[1:3] < 4.0 * gains.std[1:3])

    def test_recordings_add_up_in_any_order(self):
        one, other = factor_of(seed=1), factor_of(seed=2)
        there, back = gains_of(one + other), gains_of(other + one)
        assert there.values == pytest.approx(back.values, rel=1e-9)
        assert np.all(there.std < gains_of(one).std)

    def test_missing_payload_raises(self):
        with pytest.raises(IdentificationError, match="no recording has a known payload"):
            gains_of(factor_of(load=None))
