from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import butter, sosfiltfilt

from identification.friction import FrictionLaw
from identification.model import RobotModel
from identification.recording import Recording
from identification.torque_channel import find_torque_bandwidth

Array = NDArray[np.float64]

URDF = (Path(__file__).parent / "two_link.urdf").read_text()


@pytest.fixture(scope="module")
def model() -> RobotModel:
    return RobotModel.from_urdf(URDF, friction=FrictionLaw(third=None))


def a_recording(model: RobotModel, *, bandwidth: float | None, noise: float) -> Recording:
    """Torque with heavy Coulomb friction and an unmodelled wobble, logged through a low-pass."""
    time = np.arange(4000) * 4e-3
    amplitude, rate = np.array([0.9, 1.2]), np.array([2.1, 3.7])
    angle = rate * time[:, None] + np.array([0.3, 1.1])
    position = amplitude * np.sin(angle)
    values = np.concatenate([model.base.grouping @ model.nominal, np.array([12.0, 6.0, 1.0, 0.5])])
    torque = model.torque(values, position, amplitude * rate * np.cos(angle), -(rate**2) * position)
    torque += 0.5 * np.sin(5.0 * angle)
    torque += noise * np.random.default_rng(1).standard_normal(torque.shape)
    if bandwidth is not None:
        torque = sosfiltfilt(butter(3, bandwidth, fs=250.0, output="sos"), torque, axis=0)
    return Recording(time, position, model.joint_names, torque)


@pytest.mark.parametrize("bandwidth", [2.0, 6.0])
def test_a_low_pass_before_the_log_is_found(model: RobotModel, bandwidth: float) -> None:
    found = find_torque_bandwidth(a_recording(model, bandwidth=bandwidth, noise=0.0), model)
    assert found == pytest.approx(bandwidth, rel=0.15)


def test_torque_with_its_noise_still_on_has_not_been_filtered(model: RobotModel) -> None:
    assert find_torque_bandwidth(a_recording(model, bandwidth=None, noise=0.3), model) is None


def test_a_low_pass_that_explains_nothing_is_not_claimed(model: RobotModel) -> None:
    # Noise-free torque, as a simulation without noise gives: no filter fits better than none.
    assert find_torque_bandwidth(a_recording(model, bandwidth=None, noise=0.0), model) is None
