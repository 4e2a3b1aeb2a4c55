"""The simulated servo loop moves the arm that the model describes, whatever that has."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from identification import FrictionLaw, Motion, RobotModel
from identification.model.coupling import Coupling
from identification.model.elements import TorsionSpring
from identification.model.payload import Payload
from tests.identification.closed_loop import JointServo, simulated_motion
from tests.identification.two_link import sine_motion

Array = NDArray[np.float64]

URDF = (Path(__file__).parent / "two_link.urdf").read_text()
SPRINGS = (TorsionSpring("elbow", 0.2, 40.0), TorsionSpring("elbow", -0.3, 25.0, identified=True))
SERVO = JointServo(np.array([4000.0, 1500.0]), np.array([300.0, 60.0]))


def command() -> Motion:
    rng = np.random.default_rng(12)
    time = np.arange(2000, dtype=np.float64) * 2e-3
    a, w, phase = rng.uniform([[[0.2]], [[1.0]], [[0.0]]], [[[0.5]], [[5.0]], [[6.0]]], (3, 4, 2))
    return sine_motion(time, a, w, phase)


@pytest.mark.parametrize(
    "extra",
    [
        {"coupling": Coupling(np.array([[1.0, 0.0], [0.5, 1.0]]))},
        {"payload": Payload(3.0, (0.05, 0.0, 0.3))},
        {"friction": FrictionLaw(asymmetric=True, stribeck=0.5, standstill=0.05)},
        {"joint_friction": {"elbow": FrictionLaw(third="cubic", viscous=False, standstill=0.05)}},
        {"elements": SPRINGS},
    ],
    ids=["coupled motors", "payload", "six terms", "own laws", "springs"],
)
def test_the_servos_torque_is_what_the_model_needs(extra: dict[str, object]) -> None:
    settings = {"friction": FrictionLaw(third=None, standstill=0.05)} | extra
    model = RobotModel.from_urdf(URDF, **settings)  # type: ignore[arg-type]
    standard = model.nominal
    standard[model.layout.rotors] = 0.8, 0.6
    standard[model.layout.couplings] = 0.6
    sizes = {"f0": 4.0, "f1": 1.5, "fd": 0.3, "f2": 0.5, "fs": 1.0, "fo": 0.5}
    friction = np.array([sizes[term.symbol] for term in model.friction.terms])
    truth = np.concatenate([model.base.grouping @ standard, friction, model.elements.nominal])

    moved = simulated_motion(model, truth, SERVO, (plan := command())).motion
    applied = SERVO.position * (plan.position - moved.position)
    applied += SERVO.velocity * (plan.velocity - moved.velocity)
    needed = model.torque(truth, *moved[1:]) + model.load_torque(*moved[1:4])
    rows = model.moving(moved.velocity)
    error = np.where(rows, needed - applied, 0.0)
    assert np.all(np.linalg.norm(error, axis=0) < 0.04 * np.linalg.norm(needed * rows, axis=0))
