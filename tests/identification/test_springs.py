"""A spring, balancer or cable on a joint: a torque of the joint's own angle that nobody stated."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
import pytest
from numpy.typing import NDArray

from identification import FrictionLaw, Recording, RobotModel
from identification.hypotheses.diagnosis import explain_errors, few_rows, torque_of
from identification.hypotheses.inertia_scale import find_inertia_scale
from identification.hypotheses.joint_changes import Change
from identification.hypotheses.scores import score_of
from identification.hypotheses.search import find_readings
from identification.signals.samples import Preprocessing, Samples, prepare
from tests.hil.simulated_logs import Simulated, simulate
from tests.identification import three_axes

Floats = NDArray[np.float64]

NOTHING: Mapping[str, float] = MappingProxyType({})
TIME = np.arange(0.0, 30.0, 0.02)
OPTIONS = Preprocessing(14.0, exclude_rows="rests")
FINGERS = ("panda_finger_joint1", "panda_finger_joint2")
WRIST = 4  # the fifth joint of a Panda
ELBOW = 2  # of a UR5


def model_of(
    simulated: Simulated, locked: Mapping[str, float] = MappingProxyType({})
) -> RobotModel:
    return RobotModel.from_urdf(
        simulated.urdf.read_text(), friction=FrictionLaw(third=None, offset=True), locked=locked
    )


def panda_of(simulated: Simulated) -> RobotModel:
    return model_of(simulated, dict.fromkeys(FINGERS, 0.0))


def samples_of(model: RobotModel, simulated: Simulated, torque: Floats) -> Samples:
    recording = Recording(simulated.time, simulated.position, model.joint_names, torque)
    return prepare(recording, model, options=OPTIONS)


def spring(simulated: Simulated, joint: int, size: float, phase: float) -> Floats:
    """Torques (m, n) of a spring of one joint."""
    torque = np.zeros_like(simulated.torque)
    torque[:, joint] = size * np.sin(simulated.position[:, joint] + phase)
    return torque


@pytest.fixture(scope="module")
def moved_panda() -> Simulated:
    return simulate("panda.urdf", TIME, locked=FINGERS, seed=6, pace=1.381)


@pytest.mark.long
def test_a_spring_is_no_certain_scale_of_a_torque(moved_panda: Simulated) -> None:
    """Twice the torque of the joint's body: half the scale of the torque is the nearest reading."""
    model = panda_of(moved_panda)
    torque = moved_panda.torque + spring(moved_panda, WRIST, 4.4, 2.9)
    found = find_readings(model, samples_of(model, moved_panda, torque), unit_is_open=False)
    (step,) = found.steps
    assert step.change[:2] == ("scale", (WRIST,))
    assert not step.sure
    (best, error), *_ = step.springs
    assert best == Change("spring", (WRIST,))
    assert error < 0.6 * step.error


@pytest.mark.long
@pytest.mark.parametrize(
    "fault",
    [Change("zero", (3,), 0.35), Change("scale", (3,), 0.6)],
    ids=lambda fault: fault.meaning,
)
def test_a_zero_or_a_scale_is_certain_if_no_spring_explains_it(
    moved_panda: Simulated, fault: Change
) -> None:
    """The weight of a body acts on the joints before it as well; a spring does not."""
    model = panda_of(moved_panda)
    position, torque = moved_panda.position.copy(), moved_panda.torque.copy()
    if fault.meaning == "zero":
        position[:, fault.joints] -= fault.size
    else:
        torque[:, fault.joints] *= 1.0 + fault.size
    recording = Recording(TIME, position, model.joint_names, torque)
    samples = prepare(recording, model, options=OPTIONS)
    (step,) = find_readings(model, samples, unit_is_open=False).steps
    assert step.change[:2] == fault[:2]
    assert step.change.size == pytest.approx(fault.size, abs=0.1)
    assert step.sure
    assert not step.springs


@pytest.mark.parametrize(("size", "phase"), [(14.0, 0.5), (-13.0, 1.5)])
def test_a_spring_that_bodies_cannot_imitate_is_named(size: float, phase: float) -> None:
    """Also one that carries most of the weight; its joint is right, and nothing else is found."""
    simulated = simulate("ur5_robot.urdf", TIME, seed=2, pace=1.5)
    model = model_of(simulated)
    torque = simulated.torque + spring(simulated, ELBOW, size, phase)
    samples = samples_of(model, simulated, torque)
    (found,) = explain_errors(model, samples, np.zeros(model.n_joints))
    assert found.change == Change("spring", (ELBOW,))
    assert found.is_certain


def test_no_spring_is_named_without_one() -> None:
    simulated = simulate("ur5_robot.urdf", TIME, seed=2, pace=1.5)
    model = model_of(simulated)
    samples = samples_of(model, simulated, simulated.torque)
    assert not explain_errors(model, samples, np.zeros(model.n_joints))


@pytest.mark.parametrize("share", [0.8, 0.92, 1.0])
def test_springs_that_carry_the_weight_are_no_missing_gravity(share: float) -> None:
    """Nor links of another length, which have less weight for their inertia too."""
    position, torque, weight = three_axes.motion()
    torque = torque.copy()
    for joint, angle in enumerate(position.T):
        of_angle = np.column_stack([np.cos(angle), np.sin(angle)])
        size = np.linalg.lstsq(of_angle, weight[:, joint], rcond=None)[0]
        torque[:, joint] -= share * of_angle @ size
    model = three_axes.model()
    recording = Recording(three_axes.TIME, position, three_axes.NAMES, torque)
    samples = prepare(recording, model, options=OPTIONS)
    rows = few_rows([samples])
    score = score_of(model, rows)
    found = torque_of(model, [samples], rows, score)
    assert found.is_balanced
    assert not found.is_weightless
    assert not found.is_partly_weightless
    assert find_inertia_scale(model, rows, score) is None
