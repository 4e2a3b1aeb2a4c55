from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from identification import FrictionLaw, ModelError, Recording, RobotModel, prepare
from identification.model.payload import Payload
from identification.validation.prediction import prediction_error
from sim_fixtures.ns16 import urdf_text
from tests.identification.robots import random_urdf, robot_text

TILTED = (2.0, -3.0, -9.0)
INERTIA = (0.05, 0.01, -0.02, 0.04, 0.005, 0.03)


def pinocchio_torque(urdf: str, payload: Payload | None, joint: int, where: pin.SE3) -> np.ndarray:
    """Torques with a body of pinocchio's own added to a joint."""
    model = pin.buildModelFromXML(urdf)
    model.gravity.linear = np.array(TILTED)
    if payload is not None:
        xx, xy, xz, yy, yz, zz = payload.inertia
        tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        model.appendBodyToJoint(
            joint, pin.Inertia(payload.mass, np.array(payload.centre), tensor), where
        )
    data = model.createData()
    q, qd, qdd = states(model.nv)
    rows = [
        pin.rnea(model, data, pin.integrate(model, pin.neutral(model), a), b, c)
        for a, b, c in zip(q, qd, qdd, strict=True)
    ]
    return np.array(rows)


def states(n: int) -> np.ndarray:
    return np.random.default_rng(6).uniform(-2.0, 2.0, (3, 20, n))


@pytest.mark.parametrize("case", ["ns16", "ur10 at its tool", *range(6)])
def test_the_load_is_what_pinocchio_needs_more_with_it(case: str | int) -> None:
    frame, where = None, pin.SE3.Identity()
    urdf = urdf_text()
    if isinstance(case, int):
        urdf = random_urdf(case)
    elif case.startswith("ur10"):
        urdf, frame = robot_text("ur_description/urdf/ur10_robot.urdf"), "tool0"
        reader = pin.buildModelFromXML(urdf)
        where = reader.frames[reader.getFrameId("tool0", pin.FrameType.BODY)].placement
    payload = Payload(7.0, (0.05, -0.02, 0.11), INERTIA, frame)
    model = RobotModel.from_urdf(urdf, gravity=TILTED, payload=payload)
    expected = pinocchio_torque(urdf, payload, model.n_joints, where)
    expected -= pinocchio_torque(urdf, None, model.n_joints, where)
    np.testing.assert_allclose(model.load_torque(*states(model.n_joints)), expected, atol=1e-9)


def test_a_payload_changes_no_parameter_and_no_torque_of_theirs() -> None:
    plain = RobotModel.from_urdf(urdf_text())
    loaded = RobotModel.from_urdf(urdf_text(), payload=Payload(16.0, (0.1, 0.0, 0.2)))
    assert loaded.parameter_names == plain.parameter_names
    values = np.arange(1.0, plain.n_parameters + 1)
    np.testing.assert_array_equal(
        loaded.torque(values, *states(6)), plain.torque(values, *states(6))
    )
    assert not plain.load_torque(*states(6)).any()


def test_a_frame_that_is_not_there_is_refused_with_those_that_are() -> None:
    with pytest.raises(ModelError, match=r"'tool9' is no link .* link_6"):
        RobotModel.from_urdf(urdf_text(), payload=Payload(1.0, (0.0, 0.0, 0.0), frame="tool9"))
    with pytest.raises(ModelError, match="fixed to the base"):
        RobotModel.from_urdf(urdf_text(), payload=Payload(1.0, (0.0, 0.0, 0.0), frame="base_link"))


@pytest.mark.parametrize("mass", [-1.0, np.nan])
def test_a_mass_that_cannot_be_is_refused(mass: float) -> None:
    with pytest.raises(ModelError, match="weighs"):
        Payload(mass, (0.0, 0.0, 0.0))


def test_an_inertia_that_no_body_has_is_told() -> None:
    at = (0.0, 0.0, 0.0)
    assert Payload(1.0, at).possible
    assert Payload(1.0, at, (0.1, 0.0, 0.0, 0.2, 0.0, 0.3)).possible, "a flat body"
    assert not Payload(1.0, at, (0.1, 0.0, 0.0, 0.1, 0.0, 0.3)).possible
    assert not Payload(1.0, at, (-0.1, 0.0, 0.0, 0.1, 0.0, 0.1)).possible


def test_a_recording_of_the_loaded_arm_gives_the_parameters_of_the_bare_one() -> None:
    payload = Payload(16.0, (0.1, 0.0, 0.2), INERTIA, "link_6")
    law = FrictionLaw(third=None)
    model = RobotModel.from_urdf(urdf_text(), friction=law, payload=payload)
    bare = RobotModel.from_urdf(urdf_text(), friction=law)
    random = np.random.default_rng(8)
    time = np.arange(8000, dtype=np.float64) * 1e-3
    pace, phase = random.uniform(2.0, 9.0, (4, 1, 6)), random.uniform(0.0, 6.0, (4, 1, 6))
    angle = pace * time[:, None] + phase
    motion = (
        0.4 * np.sin(angle).sum(axis=0),
        0.4 * (pace * np.cos(angle)).sum(axis=0),
        -0.4 * (pace**2 * np.sin(angle)).sum(axis=0),
    )
    truth = np.append(bare.base.grouping @ bare.nominal, np.full(12, 5.0))
    recording = Recording(
        time=time,
        position=motion[0],
        joint_names=model.joint_names,
        torque=bare.torque(truth, *motion) + model.load_torque(*motion),
    )

    def largest_error(of: RobotModel) -> float:
        samples = prepare(recording, of, noise_variance=np.full(6, 1e-14))
        (error,) = prediction_error(of, truth, [samples])
        return float(error.overall)

    assert largest_error(model) < 0.01
    assert largest_error(bare) > 0.1
