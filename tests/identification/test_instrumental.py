from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from identification import (
    FrictionLaw,
    IdentificationError,
    Motion,
    RobotModel,
    estimate,
    estimate_instrumental,
    instrument_factor,
    planned_motion,
)
from identification.estimators.instrumental import partial_r2, same_plan
from identification.factor.columns import measured_part
from identification.signals.smoothing import fit_smoothing_spline
from tests.identification import two_link
from tests.identification.two_link import URDF, as_samples, four_sines, truth

pytestmark = pytest.mark.long

TRUTH = truth()
STEP = 5e-3
TIME = np.arange(0.0, 10.0, STEP)
LARGE, SMALL = 5e-4, 3e-6  # rad, encoder noise


MODEL = RobotModel.from_urdf(URDF, friction=FrictionLaw(third=None, standstill=0.1))


PLAN = four_sines(TIME)


def executed(seed, *, position_noise=0.0, correlation=0.02, noise=1.0):
    """Return the plan followed within 2 %, with noisy encoders and a 40 Hz smoother."""
    rng = np.random.default_rng(seed)
    beside = four_sines(TIME, seed=13 + seed, size=0.02)
    true = Motion(
        TIME,
        PLAN.position + beside.position,
        PLAN.velocity + beside.velocity,
        PLAN.acceleration + beside.acceleration,
    )
    torque = MODEL.torque(TRUTH, true) + noise * two_link.coloured(
        rng, len(TIME), STEP, correlation
    )
    if position_noise:
        noise_of_positions = position_noise * rng.standard_normal(true.position.shape)
        true = smoothed(true.position + noise_of_positions)
    return samples_of(true, torque)


def smoothed(position):
    """Smooth positions (m, n) by a spline of 40 Hz."""
    tolerance = np.full(position.shape[1], 1e-14)
    spline = fit_smoothing_spline(TIME, position, tolerance, widest=40.0)
    return Motion(TIME, *(spline(TIME, order) for order in range(3)))


def samples_of(motion, torque, arm=MODEL):
    usable = arm.moving(motion.velocity)
    usable[:50] = usable[-50:] = False
    return as_samples(arm, motion, torque, usable=usable, origin=float(motion.time[0]))


def fit(samples, plan=PLAN):
    factor = instrument_factor(MODEL, samples, plan)
    return factor, estimate_instrumental(MODEL, factor)


def dense(samples, plan=PLAN):
    """Return Z and W (m, n, p) and y (m, n), zero in unusable rows."""
    rows = samples.usable & MODEL.moving(plan.velocity)
    p = MODEL.n_parameters
    z, w = (MODEL.regressor(motion).dense(p) for motion in (plan, samples.motion))
    return (
        np.where(rows[..., None], z, 0.0),
        np.where(rows[..., None], w, 0.0),
        np.where(rows, samples.torque, 0.0),
    )


class TestStrength:
    def test_it_is_sheas_partial_r2(self):
        samples = executed(1, position_noise=LARGE)
        z, w, y = dense(samples)
        rows = [part.reshape(-1, MODEL.n_parameters) for part in (z, w)]
        table = np.column_stack([*rows, y.ravel()])
        strength = partial_r2(table.T @ table)
        fitted = rows[0] @ np.linalg.lstsq(rows[0], rows[1], rcond=None)[0]
        for k in range(MODEL.n_parameters):
            others = np.arange(MODEL.n_parameters) != k
            apart = [
                part[:, k]
                - part[:, others] @ np.linalg.lstsq(part[:, others], part[:, k], rcond=None)[0]
                for part in (rows[1], fitted)
            ]
            assert strength[k] == pytest.approx(
                (apart[1] @ apart[1]) / (apart[0] @ apart[0]), rel=1e-5
            )

    def test_unrelated_instruments_are_weak(self):
        samples = executed(1)
        _, result = fit(samples, four_sines(TIME, seed=99))
        assert set(result.weak) >= {"I1yy", "I2yy", "I2m"}


class TestInstrumentalEstimate:
    def test_it_solves_the_weighted_instrumental_equations(self):
        samples = executed(1, position_noise=LARGE)
        z, w, y = dense(samples)
        weights = np.array([0.3, 20.0])
        z = z * weights[:, None]
        expected = np.linalg.solve(np.einsum("tji,tjk->ik", z, w), np.einsum("tji,tj->i", z, y))
        factor = instrument_factor(MODEL, samples, PLAN)
        result = estimate_instrumental(MODEL, factor, weights)
        np.testing.assert_allclose(result.estimate.values, expected, rtol=1e-8, atol=1e-9)

    def test_with_large_position_noise_it_beats_least_squares(self):
        runs = [fit(executed(s, position_noise=LARGE)) for s in range(30)]
        instrumental = np.array([run.estimate.values for _, run in runs]) - TRUTH
        rows = [measured_part(factor) for factor, _ in runs]
        least = np.array([estimate(MODEL, measured).values for measured in rows]) - TRUTH
        inertias = [MODEL.parameter_names.index(name) for name in ("I1yy", "I2yy", "I2m")]
        # Least squares shrinks the coefficients of the acceleration, instruments do not, and their
        # total error is far smaller.
        assert np.all(np.abs(least.mean(axis=0))[inertias] > 0.2 * TRUTH[inertias])
        assert np.all(np.abs(instrumental.mean(axis=0))[inertias] < 0.02 * TRUTH[inertias])
        errors = [np.sqrt((e**2).mean(axis=0)) for e in (instrumental, least)]
        assert np.median(errors[0] / errors[1]) < 0.3

    @pytest.mark.parametrize("correlation", [0.0, 0.05])
    def test_95_percent_intervals_cover_90_to_99_percent(self, correlation):
        covered = []
        for seed in range(60):
            samples = executed(seed, position_noise=1e-4, correlation=correlation)
            estimated = fit(samples)[1].estimate
            covered.append(
                np.abs(estimated.values - TRUTH) < estimated.interval_factor * estimated.std
            )
        assert 0.90 <= np.mean(covered) <= 0.99

    def test_a_resting_instrument_determines_nothing(self):
        still = replace(
            PLAN, velocity=PLAN.velocity * [1.0, 0.0], acceleration=PLAN.acceleration * [1.0, 0.0]
        )
        _, result = fit(executed(1), still)
        assert {"f0_2", "f1_2"} <= set(result.estimate.undetermined)
        assert np.isinf(result.estimate.std[MODEL.parameter_names.index("f0_2")])
        assert {"f0_2", "f1_2"} <= set(result.weak)


class TestPlannedMotion:
    @settings(max_examples=10)
    @given(st.floats(0.002, 0.2), st.floats(0.002, 0.2))
    def test_the_plan_is_shifted_by_the_lag_of_each_axis(self, shoulder, elbow):
        spline = fit_smoothing_spline(TIME, PLAN.position, np.full(2, 1e-16), widest=40.0)
        late = [
            np.column_stack(
                [spline(TIME - lag, order)[:, j] for j, lag in enumerate((shoulder, elbow))]
            )
            for order in range(3)
        ]
        noise = 1e-4 * np.random.default_rng(0).standard_normal(late[0].shape)
        drooped = Motion(TIME, late[0] + noise + [0.01, -0.02], *late[1:])
        instruments = planned_motion(samples_of(drooped, 0.0 * noise), PLAN.position)
        np.testing.assert_allclose(instruments.lag, [shoulder, elbow], atol=1e-4)
        inside = (TIME > 0.5) & (TIME < 9.5)
        np.testing.assert_allclose(
            instruments.motion.acceleration[inside], late[2][inside], atol=0.01 * late[2].max()
        )
        assert not instruments.usable[TIME - min(shoulder, elbow) < -STEP].any()
        assert instruments.usable[inside].all()

    def test_missing_commands_are_not_used(self):
        samples = executed(0)
        command = PLAN.position.copy()
        command[300:340, 1] = np.nan
        instruments = planned_motion(samples, command)
        assert not instruments.usable[300:340].any()
        assert instruments.usable[400:-400].all()
        for value, message in ((np.nan, "no commanded positions"), (1.0, "no joint is commanded")):
            with pytest.raises(IdentificationError, match=message):
                planned_motion(samples, np.full_like(command, value))

    def test_repetitions_share_a_plan_for_any_clock(self):
        plan = TIME, PLAN.position
        spline = fit_smoothing_spline(TIME, PLAN.position, np.full(2, 1e-16), widest=40.0)
        later = TIME[20:-20] + 0.3 * STEP
        half = len(TIME) // 2
        gapped = spline(later)
        gapped[100:120] = np.nan
        assert same_plan(plan, (later, gapped))
        assert not same_plan(plan, (TIME[:half], PLAN.position[:half]))
        others = (
            0.9 * PLAN.position,
            PLAN.position[::-1],
            PLAN.position[:, :1],
            np.nan * PLAN.position,
        )
        assert not any(same_plan(plan, (TIME, other)) for other in others)
