from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from identification.errors import IdentificationError
from identification.factor.factor import Factor, estimate
from identification.model.friction import FrictionLaw
from identification.model.motion import Motion
from identification.model.robot import RobotModel
from identification.selection.essential import CutRule, choose_essential, eliminate
from sim_fixtures.ns16 import urdf_text
from tests.identification.robots import ns16_values
from tests.identification.two_link import URDF, simulated, sine_motion, truth

NOISE = np.array([3.0, 0.6])


MODEL = RobotModel.from_urdf(URDF, friction=FrictionLaw(third="quadratic", offset=True))
# Without offsets and without quadratic friction.
TRUTH = np.concatenate([truth(), np.zeros(4)])


def a_motion(seed, n=2, duration=12.0, step=0.005):
    time = np.arange(0.0, duration, step)
    rng = np.random.default_rng(seed)
    a = rng.uniform(0.2, 0.5, (3, n))
    w, phase = rng.uniform(2.0, 9.0, (3, n)), rng.uniform(0.0, 6.0, (3, n))
    return sine_motion(time, a, w, phase)


def factors(model, values, seed=0):
    """Return factors of a fitted and of another motion."""
    runs = (simulated(model, values, a_motion(k), NOISE, seed + k) for k in (1, 2))
    return tuple(Factor.by_time(model, run) for run in runs)


class TestElimination:
    """Parameters are removed while unseen motion is predicted as well."""

    def test_zero_parameters_are_removed(self):
        nothing = {"f2_1", "f2_2", "fo_1", "fo_2"}
        gone = []
        for seed in range(0, 40, 2):
            result = eliminate(MODEL, *factors(MODEL, TRUTH, seed))
            gone += result.removed
            assert not {"f0_1", "f0_2", "f1_1", "f1_2", "mc2z", "I2yy"} & set(result.removed)
        counts = {name: gone.count(name) for name in nothing}
        assert min(counts.values()) >= 17, counts  # of 20
        assert set(gone) <= nothing | {"mc2x", "mc1x"}  # small in the URDF: 0.12 and 0.03 kg m

    def test_a_step_is_the_least_squares_fit_of_the_columns_left(self):
        runs = [simulated(MODEL, TRUTH, a_motion(k), NOISE, k) for k in (1, 2)]
        training, unseen = (Factor.by_time(MODEL, run) for run in runs)
        weights = np.array([0.2, 3.0])
        result = eliminate(MODEL, training, unseen, weights=weights)
        left = [MODEL.parameter_names.index(name) for name in result.estimate.names]
        rows, torque = [], []
        for run in runs:
            dense = MODEL.regressor(*run.motion[1:]).dense(MODEL.n_parameters)
            rows.append(np.where(run.usable[..., None], dense, 0.0))
            torque.append(np.where(run.usable, run.torque, 0.0))
        scale = np.sqrt(weights)
        fitted = (rows[0] * scale[:, None])[:, :, left].reshape(-1, len(left))
        expected = np.linalg.lstsq(fitted, (torque[0] * scale).ravel(), rcond=None)[0]
        np.testing.assert_allclose(result.estimate.values, expected, rtol=1e-6, atol=1e-8)
        np.testing.assert_allclose(result.values[left], expected, rtol=1e-6, atol=1e-8)
        assert np.count_nonzero(result.values) == len(left)
        for step_error, part in ((result.chosen.in_sample, 0), (result.chosen.held_out, 1)):
            error = torque[part] - rows[part][:, :, left] @ expected
            assert step_error == pytest.approx(
                np.linalg.norm(error) / np.linalg.norm(torque[part]), rel=1e-6
            )
        length = np.linalg.norm(fitted, axis=0)
        assert result.estimate.condition == pytest.approx(np.linalg.cond(fitted / length), rel=1e-5)

    def test_the_path_removes_the_most_uncertain_parameter(self):
        training, unseen = factors(MODEL, TRUTH)
        result = eliminate(MODEL, training, unseen)
        full = estimate(MODEL, training)
        relative = full.std / np.abs(full.values)
        assert result.steps[0].removed is None
        assert result.steps[0].spread == pytest.approx(relative.max() / relative.min(), rel=1e-9)
        assert result.steps[1].removed == full.names[int(relative.argmax())]
        assert result.steps[0].largest_relative_std == pytest.approx(relative.max(), rel=1e-9)
        assert [step.left for step in result.steps] == list(range(MODEL.n_parameters, 0, -1))
        errors = [step.in_sample for step in result.steps]
        # Monotonic with weights; nearly so without.
        assert errors[-1] > 5.0 * errors[0]
        removed = [step.removed for step in result.steps[1:]]
        assert len(set(removed)) == len(removed)

    def test_a_parameter_needed_by_unseen_motion_stays(self):
        values = TRUTH.copy()
        values[MODEL.parameter_names.index("fo_2")] = 1.0
        training, unseen = factors(MODEL, values)
        blind = eliminate(MODEL, training, unseen, rule=CutRule(spread=4.0, overall=9.0, axis=9.0))
        result = eliminate(MODEL, training, unseen, rule=CutRule(spread=4.0))
        assert "f1_1" in blind.removed  # a friction of 1.5 N·m·s/rad, among a noise of 3 N·m
        assert "f1_1" in result.refused
        assert "f1_1" in result.reason
        assert result.chosen.held_out < blind.chosen.held_out - 0.001

    @settings(max_examples=15)
    @given(st.integers(0, 2**16))
    def test_removals_up_to_the_cut_satisfy_the_rule(self, seed):
        model = RobotModel.from_urdf(URDF, friction=FrictionLaw(offset=True))
        values = np.random.default_rng(seed).normal(0.0, 2.0, model.n_parameters)
        result = eliminate(model, *factors(model, values, seed))
        rule = CutRule()
        best = min(step.held_out for step in result.steps[: result.cut + 1])
        assert result.chosen.held_out <= best + 2.0 * rule.overall
        assert set(result.refused).isdisjoint(result.removed)
        assert set(result.removed) | set(result.estimate.names) == set(model.parameter_names)
        if not result.refused:
            assert result.chosen.spread < rule.spread

    def test_undetermined_parameters_are_removed_first(self):
        motion = a_motion(1)
        held = Motion(motion.time, *(part * [1.0, 0.0] for part in motion[1:4]))
        training = Factor.by_time(MODEL, simulated(MODEL, TRUTH, held, NOISE, 3))
        result = eliminate(MODEL, training, training)
        full = estimate(MODEL, training)
        lost = [
            after
            for before, after in pairwise(result.steps)
            if np.isinf(before.largest_relative_std)
        ]
        assert {"f0_2", "f1_2", "f2_2", "fo_2"} <= {step.removed for step in lost}
        assert len(lost) < len(full.undetermined)  # one parameter of a combination can stay
        assert result.estimate.undetermined == ()
        assert np.all(np.isfinite(result.estimate.std))

    def test_95_percent_intervals_cover_88_to_99_percent(self):
        covered = []
        for seed in range(0, 60, 2):
            result = eliminate(MODEL, *factors(MODEL, TRUTH, seed))
            one = result.estimate
            true = TRUTH[[MODEL.parameter_names.index(name) for name in one.names]]
            covered.append(np.abs(one.values - true) < one.interval_factor * one.std)
        assert 0.88 <= np.mean(np.concatenate(covered)) <= 0.995
        assert one.units == tuple(
            MODEL.units[MODEL.parameter_names.index(name)] for name in one.names
        )
        assert "essential" in one.method
        assert "cluster-robust" in one.method

    def test_the_ns16_predicts_equally_with_fewer_parameters(self):
        model = RobotModel.from_urdf(urdf_text())
        values = ns16_values(model)
        noise = np.array([20.0, 20.0, 12.0, 2.0, 2.0, 1.5])
        training, unseen = (
            Factor.by_time(model, simulated(model, values, a_motion(k, 6, step=0.01), noise, k))
            for k in (1, 2)
        )
        result = eliminate(model, training, unseen)
        assert {f"f2_{joint}" for joint in range(1, 7)} <= set(result.removed)
        assert {f"f{k}_{joint}" for joint in range(1, 7) for k in (0, 1)} <= set(
            result.estimate.names
        )
        assert result.chosen.left < 45
        assert result.chosen.held_out < result.steps[0].held_out + 0.001


def runs_of(model, truth, seed, count):
    seeds = range(seed, seed + count)
    return [simulated(model, truth, a_motion(k), NOISE, k) for k in seeds]


def factors_of(model, runs):
    return [Factor.by_time(model, run) for run in runs]


class TestChoice:
    def test_empty_factors_raise(self):
        (training,) = factors_of(MODEL, runs_of(MODEL, TRUTH, 1, 1))
        with pytest.raises(IdentificationError, match="no usable held-out sample"):
            choose_essential(MODEL, training, [Factor.zero(MODEL)])
        with pytest.raises(IdentificationError, match="no usable fitted"):
            eliminate(MODEL, Factor.zero(MODEL), training)
