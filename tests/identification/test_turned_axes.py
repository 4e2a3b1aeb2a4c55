from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from identification.friction import FrictionLaw
from identification.model import RobotModel
from identification.motion import Motion
from identification.preprocessing import Samples
from identification.turned_axes import compare_turned, turned

Array = NDArray[np.float64]

URDF = (Path(__file__).parent / "two_link.urdf").read_text()


@pytest.fixture(scope="module")
def model() -> RobotModel:
    return RobotModel.from_urdf(URDF, friction=FrictionLaw(third=None))


def a_run(model: RobotModel, seed: int, noise: float = 0.5) -> Samples:
    time = np.arange(2000) * 4e-3
    rng = np.random.default_rng(seed)
    amplitude, rate = rng.uniform(0.4, 1.2, (2, 2)), rng.uniform(1.0, 4.0, (2, 2))
    angle = rate * time[:, None, None]
    motion = Motion(
        time,
        (amplitude * np.sin(angle)).sum(axis=1),
        (amplitude * rate * np.cos(angle)).sum(axis=1),
        (-amplitude * rate**2 * np.sin(angle)).sum(axis=1),
    )
    values = np.concatenate([model.base.grouping @ model.nominal, [4.0, 2.0, 1.5, 0.8]])
    torque = model.torque(values, *motion[1:])
    return Samples(
        motion=motion,
        torque=torque + noise * rng.standard_normal(torque.shape),
        usable=model.moving(motion.velocity),
        segments=(slice(0, len(time)),),
        origin=0.0,
        position_bandwidth=np.full(2, np.inf),
    )


@pytest.mark.parametrize("seed", range(1, 9))
def test_no_joint_of_a_sound_recording_seems_turned(model: RobotModel, seed: int) -> None:
    found = compare_turned(model, [a_run(model, seed)], [a_run(model, seed + 50)], 10.0)
    assert (found.ratio > 2.0).all()


@pytest.mark.parametrize("seed", range(1, 9))
@pytest.mark.parametrize("joint", [0, 1])
def test_a_joint_that_is_turned_is_better_turned_back(
    model: RobotModel, joint: int, seed: int
) -> None:
    training, held_out = ([turned(a_run(model, s), joint)] for s in (seed, seed + 50))
    found = compare_turned(model, training, held_out, 10.0)
    assert found.highest[joint] < 0.5


def test_noise_that_drowns_the_torque_makes_no_joint_seem_turned(
    model: RobotModel,
) -> None:
    for seed in range(20):
        training, held_out = (
            a_run(model, seed, noise=500.0),
            a_run(model, seed + 50, noise=500.0),
        )
        assert (compare_turned(model, [training], [held_out], 10.0).highest > 0.7).all()


def test_turning_twice_changes_nothing(model: RobotModel) -> None:
    run = a_run(model, 1)
    back = turned(turned(run, 0), 0)
    np.testing.assert_array_equal(back.torque, run.torque)
    np.testing.assert_array_equal(back.motion.position, run.motion.position)


def test_turning_leaves_power_and_the_other_joint_as_they_are(model: RobotModel) -> None:
    run = a_run(model, 1)
    other = turned(run, 0)
    np.testing.assert_array_equal(other.torque[:, 1], run.torque[:, 1])
    np.testing.assert_array_equal(
        other.torque * other.motion.velocity, run.torque * run.motion.velocity
    )
