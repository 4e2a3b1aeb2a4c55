"""A wrong torque constant shows beside the nominal inertias, or the controller's own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray

from identification import RobotModel
from identification.model.friction import FrictionLaw
from identification.signals.samples import Samples
from identification.validation.finding import Finding
from identification.validation.nominal_scale import inertia_ratio, nominal_scale
from identification.validation.plausibility import inertia_matrices
from tests.hil.identified_arm import a_motion, packaged_urdf
from tests.identification.test_verdict import an_error, judged
from tests.identification.two_link import as_samples

Array = NDArray[np.float64]
AXES = range(1, 4)  # of the UR5, whose weight and inertia stand out of their friction


def findings(model: RobotModel, **surroundings: object) -> list[Finding]:
    """What these surroundings make a verdict say."""
    error = an_error(0.05, joints=model.n_joints)
    known = judged(model.joint_names, held_out=error, training=error).findings
    found = judged(model.joint_names, held_out=error, training=error, **surroundings).findings
    return [one for one in found if one not in known]


@pytest.fixture(scope="module")
def model() -> RobotModel:
    return RobotModel.from_urdf(packaged_urdf("ur5_robot.urdf"), friction=FrictionLaw(offset=True))


def standard(model: RobotModel, wrong: float, seed: int) -> Array:
    """Nominal parameters with every link off by its own share, and rotors."""
    values = model.nominal.copy()
    rng = np.random.default_rng(seed)
    for link in range(model.n_joints):
        rows = model.layout.links[link]
        values[rows] *= 1.0 + wrong * rng.uniform(-1.0, 1.0)
    values[model.layout.rotors] = 0.2
    return values


def runs(model: RobotModel, values: Array, seed: int) -> list[Samples]:
    friction = [{"f0": 3.0, "f1": 2.0, "fo": 0.2}.get(t.symbol, 0.3) for t in model.friction.terms]
    truth = np.concatenate([model.base.grouping @ values, friction])
    found = []
    for number in range(2):
        motion = a_motion(model.n_joints, 10 * seed + number)
        torque = model.torque(truth, *motion[1:])
        torque += (
            0.02 * torque.std(axis=0) * np.random.default_rng(seed).standard_normal(torque.shape)
        )
        found.append(as_samples(model, motion, torque))
    return found


def nominal(model: RobotModel) -> Array:
    friction = np.zeros(model.n_parameters - model.base.rank)
    return np.concatenate([model.base.grouping @ model.nominal, friction])


@pytest.mark.parametrize("seed", range(10))
def test_links_that_are_off_by_a_tenth_raise_no_doubt(model: RobotModel, seed: int) -> None:
    found = nominal_scale(model, nominal(model), runs(model, standard(model, 0.1, seed), seed))
    assert np.isfinite(found.scale[2])
    assert findings(model, nominal_scale=found) == []


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize("factor", [0.6, 1.5])
def test_a_wrong_torque_constant_is_told_by_axis_and_factor(
    model: RobotModel, axis: int, factor: float
) -> None:
    scaled = []
    for run in runs(model, standard(model, 0.05, axis), axis):
        torque = run.torque.copy()
        torque[:, axis] *= factor
        scaled.append(replace(run, torque=torque))
    found = nominal_scale(model, nominal(model), scaled)
    assert np.flatnonzero(found.off).tolist() == [axis]
    assert found.scale[axis] == pytest.approx(factor, rel=0.1)
    (finding,) = findings(model, nominal_scale=found)
    name = model.joint_names[axis]
    assert finding.level == "doubtful" and name in finding.words and name in finding.next_step


def test_of_a_urdf_without_masses_nothing_is_said(model: RobotModel) -> None:
    zero = np.zeros(model.n_parameters)
    found = nominal_scale(model, zero, runs(model, standard(model, 0.0, 1), 1))
    assert np.isnan(found.scale).all() and findings(model, nominal_scale=found) == []


@pytest.mark.parametrize("factor", [0.01, 1000.0])
def test_torques_of_another_unit_or_of_the_motors_leave_no_model_to_rely_on(
    model: RobotModel, factor: float
) -> None:
    scaled = [
        replace(run, torque=factor * run.torque) for run in runs(model, standard(model, 0.05, 1), 1)
    ]
    (finding,) = findings(model, nominal_scale=nominal_scale(model, nominal(model), scaled))
    assert finding.level == "wrong"
    assert "unit" in finding.next_step and "side" in finding.next_step


def test_all_torques_negated_are_one_finding(model: RobotModel) -> None:
    negated = [replace(run, torque=-run.torque) for run in runs(model, standard(model, 0.05, 1), 1)]
    found = nominal_scale(model, nominal(model), negated)
    (finding,) = findings(model, nominal_scale=found)
    assert (finding.check, finding.level) == ("direction of axes", "wrong")
    assert "all torques seem to have the other sign" in finding.words


@pytest.fixture(scope="module")
def arm() -> tuple[RobotModel, Array, Array, Array]:
    """Model, parameters, postures, and the diagonal by pinocchio, rotors of 0.2 included."""
    urdf = packaged_urdf("ur5_robot.urdf")
    model = RobotModel.from_urdf(urdf)
    standard = model.nominal.copy()
    standard[model.layout.rotors] = 0.2
    friction = np.full(model.n_parameters - model.base.rank, 3.0)
    values = np.concatenate([model.base.grouping @ standard, friction])
    position = np.random.default_rng(1).uniform(-2.0, 2.0, (20, 6))
    reference = pin.buildModelFromXML(urdf)
    data = reference.createData()
    diagonal = np.array([np.diag(pin.crba(reference, data, q)) for q in position]) + 0.2
    return model, values, position, diagonal


def test_the_diagonal_is_that_of_the_composite_rigid_body_algorithm(
    arm: tuple[RobotModel, Array, Array, Array],
) -> None:
    model, values, position, diagonal = arm
    matrices = inertia_matrices(model, values, position)
    np.testing.assert_allclose(np.diagonal(matrices, axis1=1, axis2=2), diagonal, rtol=1e-9)


def test_a_joint_that_is_off_is_named_and_a_silent_one_is_not(
    arm: tuple[RobotModel, Array, Array, Array],
) -> None:
    model, values, position, diagonal = arm
    theirs = diagonal * np.array([1.0, 1.1, 0.9, 1.0, 0.0, 1.0 / 0.7])
    found = inertia_ratio(model, values, position, theirs)
    assert found is not None
    np.testing.assert_allclose(found.ratio, [1.0, 1.1, 0.9, 1.0, np.nan, 1.0 / 0.7], rtol=1e-9)
    np.testing.assert_allclose(found.spread[:4], 0.0, atol=1e-9)
    (finding,) = findings(model, controller_inertia=found)
    assert finding.level == "doubtful"
    assert "wrist_3_joint 1.43" in finding.words and "wrist_2_joint" not in finding.words


def test_zeros_are_no_inertia(arm: tuple[RobotModel, Array, Array, Array]) -> None:
    model, values, position, diagonal = arm
    assert inertia_ratio(model, values, position, 0.0 * diagonal) is None
