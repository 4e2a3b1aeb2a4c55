"""Delayed torque, on recordings made without code of the project."""

import numpy as np
import pytest

from identification.estimators.delay import estimate_delay, rate_products, with_uncertain_delay
from identification.estimators.least_squares import fit_least_squares
from identification.factor.factor import Factor
from identification.model.friction import FrictionLaw
from identification.model.robot import RobotModel
from identification.selection.inner_prediction import Settings, choose_settings
from identification.signals.recording import Recording
from identification.signals.samples import Preprocessing, prepare
from tests.independent.simulated_arm import ns16, panda, record

ARMS = {"NS 16": ns16, "Panda": panda}
DELAYS = [0.0, 0.0013, 0.004, 0.01]  # s
NEAR = 0.3e-3  # s
BRISK, SLOW = 1.3, 0.05  # pace; at 1.3 the NS 16 is at its acceleration limits
SEEDS = 20


def model_of(arm):
    return RobotModel.from_urdf(arm.urdf, locked=arm.locked, friction=FrictionLaw(third=None))


def recorded(arm, seed, noise, delay, pace):
    log = record(arm, seed, delay=delay, pace=pace, noise=noise, duration=30.0)
    return Recording(*log[:2], arm.joint_names, torque=log[2])


def coverage(arm, model, recording, found):
    """Return the share of parameters in their 95 % intervals, with the delay compensated."""
    standard = model.nominal
    standard[10::11] = arm.model.armature
    truth = np.concatenate([model.base.grouping @ standard, arm.coulomb, arm.viscous])
    # Rows at a reversal depend on presliding.
    options = Preprocessing(torque_delay=found.applied, left_out="slow")
    samples = prepare(recording, model, options=options)
    phase = Factor.by_time(model, samples)
    fitted = fit_least_squares(model, [samples], factor=phase)
    products = rate_products(model, samples)
    fitted = with_uncertain_delay(fitted, phase, products, found.variance)
    known = np.isfinite(fitted.std)
    inside = np.abs(fitted.values - truth) <= fitted.interval_factor * fitted.std
    return float(np.mean(inside[known]))


class TestDelayOfABriskMotion:
    @pytest.mark.parametrize(
        ("name", "noise", "delay"),
        [
            ("NS 16", "white", 0.0),
            ("NS 16", "coloured", 0.0013),
            ("Panda", "coloured", 0.004),
            ("NS 16", "coloured", 0.01),
        ],
    )
    def test_it_is_found(self, name, noise, delay):
        arm = ARMS[name]()
        found = estimate_delay(recorded(arm, 0, noise, delay, BRISK), model_of(arm))
        assert found.determined
        assert found.delay == pytest.approx(delay, abs=NEAR)
        assert found.significant == (delay > 0.0)

    @pytest.mark.slow
    @pytest.mark.parametrize("name", ARMS)
    @pytest.mark.parametrize("noise", ["white", "coloured"])
    @pytest.mark.parametrize("delay", DELAYS)
    def test_it_is_found_and_intervals_cover(self, name, noise, delay):
        """Within 0.3 ms in 19 of 20 runs; 95 % intervals of parameters cover 93 to 98 %."""
        arm = ARMS[name]()
        model = model_of(arm)
        near, shares = 0, []
        for seed in range(SEEDS):
            recording = recorded(arm, seed, noise, delay, BRISK)
            found = estimate_delay(recording, model)
            near += found.determined and abs(found.delay - delay) < NEAR
            shares.append(coverage(arm, model, recording, found))
        # Within two standard errors of the share.
        share, unsure = np.mean(shares), 2.0 * np.std(shares, ddof=1) / np.sqrt(SEEDS)
        assert near >= 0.95 * SEEDS
        assert 0.93 - unsure < share < 0.98 + unsure


class TestDelayBesideOtherSettings:
    @pytest.mark.slow
    @pytest.mark.parametrize("seed", [2, 3, 4])
    def test_a_presliding_displacement_does_not_replace_it(self, seed):
        """On all rows 1e-5 rad without delay predicts better than 1e-6 rad with the true one."""
        arm = ns16()
        model, recording = model_of(arm), recorded(arm, seed, "coloured", 0.0013, BRISK)
        found = estimate_delay(recording, model)

        def ready(model, how):
            return [prepare(recording, model, options=how)]

        best, _ = choose_settings(
            ready,
            Settings(model, Preprocessing()),
            {"delay", "bandwidth", "presliding", "rows"},
            lambda *_: (),
            (found.delay,),
        )
        assert best.preprocessing.torque_delay == found.delay


class TestDelayOfASlowMotion:
    @pytest.mark.parametrize("name", ARMS)
    def test_it_is_not_determined(self, name):
        arm = ARMS[name]()
        found = estimate_delay(recorded(arm, 0, "coloured", 0.0, SLOW), model_of(arm))
        assert not found.determined
        assert found.applied == 0.0
