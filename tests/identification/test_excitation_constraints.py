from __future__ import annotations

import numpy as np
import pytest

from identification import FrictionLaw, RobotModel, ShapeError
from identification.excitation import (
    CollisionChecker,
    CurrentModel,
    MotionCheck,
    Workspace,
    check_motion,
)
from identification.excitation.constraints import sampled
from planner import JointLimits, plan

# Two links of 1 m that swing in a vertical plane: known to every textbook.
URDF = """<robot name="pendulum">
<link name="base"><collision><geometry><box size="0.1 0.1 0.1"/></geometry></collision></link>
<link name="upper"><inertial><origin xyz="0.5 0 0"/><mass value="2"/>
  <inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial>
  <collision><origin xyz="0.5 0 0" rpy="0 1.5707963 0"/><geometry>
    <cylinder radius="0.05" length="0.8"/></geometry></collision></link>
<link name="lower"><inertial><origin xyz="0.5 0 0"/><mass value="1"/>
  <inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial>
  <collision><origin xyz="0.5 0 0" rpy="0 1.5707963 0"/><geometry>
    <cylinder radius="0.05" length="0.8"/></geometry></collision></link>
<joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/>
  <axis xyz="0 -1 0"/><limit lower="-3" upper="3" effort="100" velocity="3"/></joint>
<joint name="elbow" type="revolute"><parent link="upper"/><child link="lower"/>
  <origin xyz="1 0 0"/><axis xyz="0 -1 0"/><limit lower="-3" upper="3" effort="100" velocity="3"/>
</joint></robot>"""

LIMITS = JointLimits([-3.0] * 2, [3.0] * 2, [3.0] * 2, [10.0] * 2, [100.0] * 2)
MOTOR_FROM_JOINT = np.array([[100.0, 0.0], [5.0, -80.0]])
TORQUE_CONSTANT = np.array([0.5, 0.25])


@pytest.fixture(scope="module")
def model():
    return RobotModel.from_urdf(URDF, friction=FrictionLaw(third=None))


@pytest.fixture(scope="module")
def values(model):
    friction = {"f0_1": 3.0, "f0_2": 1.0, "f1_1": 0.0, "f1_2": 0.0}
    inertial = model.base.grouping @ model.nominal
    return np.array([*inertial, *(friction[n] for n in model.parameter_names[len(inertial) :])])


@pytest.fixture(scope="module")
def make_currents(model, values):
    def make(current_limit, **more):
        return CurrentModel(
            model, values, MOTOR_FROM_JOINT, TORQUE_CONSTANT, np.array(current_limit), **more
        )

    return make


@pytest.fixture(scope="module")
def swing():
    return plan([[0.0, 0.0], [1.5, -1.0], [0.0, 0.0]], LIMITS, fly=0.0)


def test_torque_holds_the_arm_against_gravity_as_the_textbook_says(make_currents, swing):
    motion = sampled(swing, 0.008)
    torque = make_currents([1.0, 1.0]).torque(motion)
    # At rest and level at the very start: elbow 1 kg at 0.5 m, shoulder 2 kg at 0.5 m more.
    np.testing.assert_allclose(torque[0], 9.81 * np.array([2 * 0.5 + 1 * 1.5, 1 * 0.5]), rtol=1e-9)


def test_currents_drive_the_joints_with_the_same_power_on_both_sides(make_currents, swing):
    currents = make_currents([1.0, 1.0])
    torque = currents.torque(sampled(swing, 0.008))
    current = currents.current(torque)
    joint_speed = np.array([0.7, -0.3])
    motor_speed = MOTOR_FROM_JOINT @ joint_speed
    np.testing.assert_allclose(
        (current * TORQUE_CONSTANT) @ motor_speed, torque @ joint_speed, rtol=1e-12, atol=1e-12
    )


def test_uncertainty_adds_its_share_to_everything(make_currents, swing):
    motion = sampled(swing, 0.008)
    sure, unsure = make_currents([1.0, 1.0]), make_currents([1.0, 1.0], uncertainty=0.2)
    np.testing.assert_allclose(unsure.torque(motion), 1.2 * sure.torque(motion))


def test_a_current_beyond_its_limit_is_named_with_value_bound_and_instant(make_currents, swing):
    motion = sampled(swing, 0.008)
    generous = make_currents([100.0, 100.0])
    assert check_motion(swing, LIMITS, currents=generous) == MotionCheck(())
    current = np.abs(generous.current(generous.torque(motion)))
    peak = current.max(axis=0)
    tight = make_currents([100.0, 0.9 * peak[1]])
    check = check_motion(swing, LIMITS, currents=tight)
    assert not check.ok
    (violation,) = check.violations
    assert (violation.kind, violation.subject) == ("current", "motor of elbow")
    assert violation.value == pytest.approx(peak[1])
    assert violation.bound == pytest.approx(0.9 * peak[1])
    assert violation.excess == pytest.approx(1 / 0.9 - 1)
    assert violation.time == motion.time[current[:, 1].argmax()]
    for word in ("current", "motor of elbow", "A", f"{violation.time:.3f} s"):
        assert word in str(violation)


def test_a_torque_limit_is_checked_besides(make_currents, swing):
    check = check_motion(
        swing, LIMITS, currents=make_currents([100.0, 100.0], torque_limit=np.array([5.0, 1e3]))
    )
    (violation,) = check.violations
    assert (violation.kind, violation.subject) == ("torque", "shoulder")
    assert violation.value > 9.81 * 2.5


def test_a_joint_limit_is_checked_besides(swing):
    lower = JointLimits([-3.0] * 2, [1.4, 3.0], [3.0] * 2, [10.0] * 2, [100.0] * 2)
    (violation,) = check_motion(swing, lower).violations
    assert (violation.kind, violation.subject) == ("joint limit", "position of joint 0")
    assert violation.value == pytest.approx(1.5)


def test_a_contact_is_reported_with_pair_and_instant():
    checker = CollisionChecker(URDF, Workspace(floor=-0.5, margin=0.1))
    down = plan([[0.0, 0.0], [-0.6, 0.0]], LIMITS)
    (violation,) = check_motion(down, LIMITS, checker=checker).violations
    assert (violation.kind, violation.subject) == ("collision", "lower and floor")
    assert violation.bound == 0.1
    assert 0.0 < violation.value < 0.1
    q = down.sample_one(violation.time)[0]
    # the end of the lower link, 1.9 m out, its edge 0.05 m below the centre line
    height = 1.9 * np.sin(q[0]) - 0.05 * np.cos(q[0])
    assert height == pytest.approx(-0.5 + violation.value, abs=1e-6)
    np.testing.assert_allclose(violation.posture, q, atol=1e-9)


def test_a_prediction_that_is_no_number_is_beyond_every_limit(model, values, swing):
    broken = CurrentModel(
        model, values * np.nan, MOTOR_FROM_JOINT, TORQUE_CONSTANT, np.array([1e9, 1e9])
    )
    assert len(check_motion(swing, LIMITS, currents=broken).violations) == 2


@pytest.mark.parametrize(
    "wrong",
    [
        {"values": np.zeros(3)},
        {"motor_from_joint": np.eye(3)},
        {"torque_constant": np.ones(3)},
        {"current_limit": np.ones(1)},
        {"torque_limit": np.ones(6)},
    ],
)
def test_arrays_of_another_arm_are_refused_by_name(model, values, wrong):
    given = {
        "values": values,
        "motor_from_joint": MOTOR_FROM_JOINT,
        "torque_constant": TORQUE_CONSTANT,
        "current_limit": np.ones(2),
    }
    with pytest.raises(ShapeError, match=next(iter(wrong))):
        CurrentModel(model, **{**given, **wrong})
