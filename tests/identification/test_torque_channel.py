from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import butter, sosfiltfilt

from identification.estimators.torque_channel import possible_low_passes
from identification.model.robot import RobotModel
from identification.signals.recording import Recording

Array = NDArray[np.float64]


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


class TestPossibleLowPasses:
    """Shapes that explain a recording clearly better than none, with their bandwidths."""

    @pytest.mark.parametrize("bandwidth", [2.0, 6.0])
    def test_one_before_the_log_is_among_them(self, model: RobotModel, bandwidth: float) -> None:
        found = possible_low_passes(a_recording(model, bandwidth=bandwidth, noise=0.0), model)
        (same,) = (one for one in found if not one.torque_shape.causal)
        assert same.torque_bandwidth == pytest.approx(bandwidth, rel=0.15)

    @pytest.mark.parametrize("noise", [0.0, 0.3])
    def test_there_are_none_without_one(self, model: RobotModel, noise: float) -> None:
        assert possible_low_passes(a_recording(model, bandwidth=None, noise=noise), model) == ()
