"""Robot descriptions as they are published: sliding, mimicking and continuous joints, branches."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from identification import ModelError, RobotModel
from tests.identification.robots import robot_text

ARMS = {
    "ur5": "ur_description/urdf/ur5_robot.urdf",
    "ur3 with a gripper": "ur_description/urdf/ur3_gripper.urdf",
    "panda, fingers sliding": "panda_description/urdf/panda.urdf",
    "kinova, continuous": "kinova_description/robots/kinova.urdf",
    "xarm7": "xarm_description/urdf/xarm7.urdf",
    "so100, joint named as its link": "so_arm_description/urdf/so100.urdf",
    "tiago, sliding torso": "tiago_description/robots/tiago_no_hand.urdf",
    "allegro hand, four branches": "allegro_hand_description/urdf/allegro_left_hand.urdf",
    "talos arm, mimicking": "talos_data/robots/talos_left_arm.urdf",
}


# Angles rounded in the file (1.5708) make singular values of up to 4e-5, real parameters of 1e-3.
TOLERANCE = 1e-4


def rank_by_pinocchio(urdf: str) -> int:
    """Numerical rank of pinocchio's own regressor with a column per rotor."""
    model = pin.buildModelFromXML(urdf)
    data = model.createData()
    random = np.random.default_rng(11)
    rows = []
    for _ in range(20 + 2 * model.nv):
        q = pin.integrate(model, pin.neutral(model), random.uniform(-3.0, 3.0, model.nv))
        qd, qdd = random.uniform(-3.0, 3.0, (2, model.nv))
        links = pin.computeJointTorqueRegressor(model, data, q, qd, qdd)
        rows.append(np.hstack([links, np.diag(qdd)]))
    stacked = np.vstack(rows)
    length = np.linalg.norm(stacked, axis=0)
    felt = length > TOLERANCE * length.max()
    singular = np.linalg.svd(stacked[:, felt] / length[felt], compute_uv=False)
    return int(np.count_nonzero(singular > TOLERANCE * singular[0]))


@pytest.mark.parametrize("arm", ARMS)
def test_the_number_of_base_parameters_is_the_rank_of_pinocchios_regressor(arm: str) -> None:
    urdf = robot_text(ARMS[arm])
    base = RobotModel.from_urdf(urdf).base
    assert base.rank == rank_by_pinocchio(urdf)
    assert base.gap > 1e4


def test_a_description_that_xacro_left_empty_says_so() -> None:
    with pytest.raises(ModelError, match=r"no name; write <robot name="):
        RobotModel.from_urdf(robot_text("ur_description/urdf/ur3.urdf"))
