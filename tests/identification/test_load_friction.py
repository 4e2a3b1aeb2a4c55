"""Friction that grows with the torque that a gear transmits."""

from dataclasses import replace

import numpy as np
import pytest

from identification.estimators.least_squares import fit_least_squares
from identification.estimators.load_friction import MAX_TORQUE_CHANGE, fit_with_load
from identification.excitation.criteria import Objective
from identification.factor.factor import Factor
from identification.model.coupling import Coupling
from identification.model.elements import TorqueRipple, TorsionSpring
from identification.model.friction import FrictionLaw, dissipation
from identification.model.known_payload import Payload
from identification.model.messages import law_text
from identification.model.robot import RobotModel
from sim_fixtures.ns16 import urdf_text
from tests.identification.two_link import MODEL, NOISE, URDF, a_motion, simulated, truth

LAW = FrictionLaw(third=None, load=True)
LOADED = RobotModel.from_urdf(URDF, friction=LAW)
SHARES = np.array([0.12, 0.06])
VALUES = np.append(truth(), SHARES)
"""Parameters of an arm whose gears lose a share of their torque."""


def gravity_and_inertia(model, values, motion):
    """Torque of an arm without friction, and without rotors where they have own columns."""
    rigid = values.copy()
    rigid[model.friction_part] = 0.0
    rigid[[name.endswith("m") for name in model.parameter_names]] = 0.0
    return model.torque(rigid, motion)


def weighted_fit(samples):
    return fit_least_squares(LOADED, list(samples))


class TestLaw:
    def test_the_share_is_a_number_and_not_negative(self):
        assert LOADED.parameter_names[-2:] == ("fl_1", "fl_2")
        assert LOADED.units[-2:] == ("1", "1")
        assert dissipation(LOADED.friction).not_negative[-2:].all()

    def test_it_is_a_table_of_a_cell_file(self):
        assert FrictionLaw.from_table(LAW.table()) == LAW
        assert law_text(LAW) == "Coulomb, viscous, load"

    def test_joints_may_differ(self):
        model = RobotModel.from_urdf(
            URDF, friction=FrictionLaw(third=None), joint_friction={MODEL.joint_names[1]: LAW}
        )
        motion = a_motion()
        torque = model.torque(np.append(truth(), 0.06), motion)
        assert model.parameter_names[-1] == "fl_2"
        both = LOADED.torque(np.append(truth(), [0.0, 0.06]), motion)
        np.testing.assert_allclose(torque, both, rtol=1e-12, atol=1e-10)


class TestTorque:
    def test_it_is_a_share_of_the_rigid_torque_against_the_motion(self):
        motion = a_motion()
        rigid = gravity_and_inertia(MODEL, truth(), motion)
        added = LOADED.torque(VALUES, motion) - MODEL.torque(truth(), motion)
        expected = SHARES * np.sign(motion.velocity) * np.abs(rigid)
        np.testing.assert_allclose(added, expected, rtol=1e-9, atol=1e-9)

    def test_it_follows_the_presliding_state(self):
        model = LOADED.with_friction(presliding=1e-3)
        motion = a_motion()
        z = model.friction.direction(motion)
        torque = model.torque(VALUES, replace(motion, direction=z))
        without = MODEL.torque(truth(), replace(motion, direction=z))
        rigid = gravity_and_inertia(MODEL, truth(), motion)
        np.testing.assert_allclose(torque - without, SHARES * z * np.abs(rigid), atol=1e-9)

    def test_the_gear_carries_payload_and_springs_but_no_ripple(self):
        spring = TorsionSpring(MODEL.joint_names[1], rest=0.2, stiffness=50.0)
        ripple = TorqueRipple(MODEL.joint_names[0], (1,), ((MODEL.joint_names[0], 80.0),))
        payload = Payload(5.0, (0.1, 0.0, 0.2))
        model = RobotModel.from_urdf(URDF, friction=LAW, payload=payload, elements=[spring, ripple])
        motion = a_motion()
        values = np.concatenate([VALUES, [7.0, 8.0]])
        expected = gravity_and_inertia(MODEL, truth(), motion) + model.load_torque(motion)
        torque = model.gear_torque(values, motion)
        np.testing.assert_allclose(torque, expected, rtol=1e-9, atol=1e-9)

    def test_coupled_motors_have_no_such_term(self):
        wrist = np.eye(6)
        wrist[5, 4] = 0.5
        model = RobotModel.from_urdf(urdf_text(), friction=LAW, coupling=Coupling(wrist))
        shares = [term for term in model.friction.terms if term.symbol == "fl"]
        assert [term.owner for term in shares] == list(range(6))
        assert not any(term.motor for term in shares)


class TestSamples:
    def test_the_torque_is_linear_in_the_parameters_for_a_given_load(self):
        samples = simulated(LOADED, VALUES, a_motion()).with_load(LOADED, VALUES)
        columns = samples.regressor(LOADED).dense(LOADED.n_parameters)
        np.testing.assert_allclose(columns @ VALUES, samples.torque, rtol=1e-9, atol=1e-9)

    def test_predictions_have_the_load_of_their_parameters(self):
        samples = simulated(LOADED, VALUES, a_motion())
        for stored in (samples, samples.with_load(LOADED, 3.0 * VALUES)):
            np.testing.assert_allclose(stored.predicted_torque(LOADED, VALUES), samples.torque)

    def test_a_part_of_the_parameters_has_the_load_of_all(self):
        samples = simulated(LOADED, VALUES, a_motion())
        friction = LOADED.friction_columns
        parts = [samples.predicted_torque(LOADED, VALUES, part) for part in (friction, ~friction)]
        assert np.abs(parts[0]).max() > 0.0
        np.testing.assert_allclose(np.add(*parts), samples.torque, rtol=1e-9, atol=1e-9)

    def test_parts_of_a_filtered_recording_have_their_load(self):
        whole = simulated(LOADED, VALUES, a_motion(), torque_bandwidth=np.full(2, 30.0))
        part = whole.between(300, 900).with_load(LOADED, VALUES)
        expected = whole.with_load(LOADED, VALUES).regressor(LOADED)
        for block, all_rows in zip(part.regressor(LOADED).blocks, expected.blocks, strict=True):
            np.testing.assert_array_equal(block, all_rows[300:900])

    def test_without_an_estimate_the_load_is_that_of_the_description(self):
        samples = simulated(LOADED, VALUES, a_motion())
        nominal = np.zeros(LOADED.n_parameters)
        nominal[: LOADED.base.rank] = LOADED.base.grouping @ LOADED.nominal
        blocks = samples.regressor(LOADED).blocks
        for block, expected in zip(
            blocks, samples.with_load(LOADED, nominal).regressor(LOADED).blocks, strict=True
        ):
            np.testing.assert_array_equal(block, expected)

    def test_other_models_do_not_depend_on_a_load(self):
        samples = simulated(LOADED, VALUES, a_motion())
        loaded = samples.with_load(LOADED, VALUES)
        gram, same = (Factor.of(MODEL, recording).gram for recording in (samples, loaded))
        np.testing.assert_array_equal(gram, same)


class TestPlannedMotions:
    def test_they_excite_the_shares_by_the_load_of_the_description(self):
        motion = a_motion()
        # Below standstill a plan counts less of dry friction than a recording.
        fast = LOADED.friction.moving(motion.velocity).all(axis=1)
        motion = motion.rows(fast)
        gram = Objective(LOADED).information(motion)
        columns = LOADED.regressor(motion).dense(LOADED.n_parameters)
        expected = np.einsum("mjp,mjq->pq", columns, columns)
        np.testing.assert_allclose(gram, expected, rtol=1e-9, atol=1e-9)
        assert np.isfinite([*Objective(LOADED).measures(motion).values()]).all()


class TestFixedPoint:
    @pytest.mark.parametrize("seed", range(3))
    def test_planted_shares_are_found(self, seed):
        samples = simulated(LOADED, VALUES, a_motion(), NOISE, seed)
        load_fit = fit_with_load(LOADED, [samples], weighted_fit)
        assert load_fit.converged
        error = np.abs(load_fit.result.values - VALUES) / load_fit.result.std
        assert error.max() < 3.5  # of 13 parameters
        rms = np.sqrt(np.mean((samples.torque - _predicted(load_fit, samples)) ** 2, axis=0))
        np.testing.assert_allclose(rms, NOISE, rtol=0.05)

    @pytest.mark.long
    def test_intervals_cover_the_shares(self):
        inside = []
        for seed in range(40):
            samples = simulated(LOADED, VALUES, a_motion(6.0, 0.01), NOISE, seed)
            result = fit_with_load(LOADED, [samples], weighted_fit).result
            half = result.interval_factor * result.std[-2:]
            inside.append(np.abs(result.values[-2:] - SHARES) < half)
        # 80 intervals of 95 %: fewer than 69 inside have a probability below 0.2 %
        assert np.sum(inside) >= 69

    def test_absent_shares_are_zero_within_their_intervals(self):
        samples = simulated(MODEL, truth(), a_motion(), NOISE, 4)
        result = fit_with_load(LOADED, [samples], weighted_fit).result
        assert (np.abs(result.values[-2:]) < 3.5 * result.std[-2:]).all()

    def test_a_large_share_converges(self):
        values = np.append(truth(), [0.3, 0.3])
        samples = simulated(LOADED, values, a_motion())
        load_fit = fit_with_load(LOADED, [samples], weighted_fit, most=20)
        assert load_fit.converged
        np.testing.assert_allclose(load_fit.result.values, values, rtol=0.02, atol=0.01)

    def test_it_ends_where_the_torque_stays(self):
        samples = simulated(LOADED, VALUES, a_motion(), NOISE, 5)
        load_fit = fit_with_load(LOADED, [samples], weighted_fit)
        again = fit_with_load(LOADED, load_fit.samples, weighted_fit, most=2)
        before, after = (_predicted(fixed_point, samples) for fixed_point in (load_fit, again))
        assert np.sqrt(np.mean((after - before) ** 2) / np.mean(after**2)) < MAX_TORQUE_CHANGE

    def test_an_estimate_without_shares_saves_a_pass(self):
        samples = simulated(LOADED, VALUES, a_motion(), NOISE, 6)
        start = fit_least_squares(MODEL, [samples]).values
        warm = fit_with_load(LOADED, [samples.with_load(MODEL, start)], weighted_fit)
        cold = fit_with_load(LOADED, [samples], weighted_fit)
        assert warm.passes == cold.passes - 1
        np.testing.assert_allclose(warm.result.values, cold.result.values, rtol=1e-6)

    def test_passes_are_limited_and_reported(self):
        samples = simulated(LOADED, VALUES, a_motion(), NOISE, 7)
        load_fit = fit_with_load(LOADED, [samples], weighted_fit, most=2)
        assert load_fit.passes == 2
        assert not load_fit.converged

    def test_a_model_without_shares_is_fitted_once(self):
        samples = simulated(MODEL, truth(), a_motion(), NOISE, 8)
        load_fit = fit_with_load(
            MODEL, [samples], lambda some: fit_least_squares(MODEL, list(some))
        )
        assert (load_fit.passes, load_fit.converged) == (1, True)
        assert load_fit.samples == (samples,)


def _predicted(load_fit, samples):
    return samples.predicted_torque(LOADED, load_fit.result.values)
