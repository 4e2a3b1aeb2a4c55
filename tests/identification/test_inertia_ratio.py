"""The diagonal of the identified inertia matrix is pinocchio's, and is compared where sent."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray

from identification import RobotModel
from identification.validation.inertia_ratio import diagonal_inertia, inertia_ratio
from tests.hil.identified_arm import packaged_urdf

Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def case() -> tuple[RobotModel, Array, Array, Array]:
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
    case: tuple[RobotModel, Array, Array, Array],
) -> None:
    model, values, position, diagonal = case
    np.testing.assert_allclose(diagonal_inertia(model, values, position), diagonal, rtol=1e-9)


def test_a_joint_that_is_off_is_named_and_a_silent_one_is_not(
    case: tuple[RobotModel, Array, Array, Array],
) -> None:
    model, values, position, diagonal = case
    theirs = diagonal * np.array([1.0, 1.1, 0.9, 1.0, 0.0, 1.0 / 0.7])
    found = inertia_ratio(model, values, position, theirs)
    assert found is not None
    np.testing.assert_allclose(found.ratio, [1.0, 1.1, 0.9, 1.0, np.nan, 1.0 / 0.7], rtol=1e-9)
    np.testing.assert_allclose(found.spread[:4], 0.0, atol=1e-9)
    (finding,) = found.findings()
    assert finding.level == "doubtful"
    assert "wrist_3_joint 1.43" in finding.words and "wrist_2_joint" not in finding.words


def test_zeros_are_no_inertia(case: tuple[RobotModel, Array, Array, Array]) -> None:
    model, values, position, diagonal = case
    assert inertia_ratio(model, values, position, 0.0 * diagonal) is None
