"""A low-pass of the recorded torque, and what resembles one. The motion is simulated."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from identification.estimators.torque_channel import possible_low_passes
from identification.hypotheses.torque_low_pass import torque_low_pass
from identification.model.motion import Motion
from identification.model.robot import RobotModel
from identification.signals.recording import Recording
from identification.signals.samples import Preprocessing
from identification.signals.smoothing import LowPassShape, low_passed
from tests.identification import three_axes

Floats = three_axes.Floats
TIME = np.arange(0.0, 30.0, 0.004)
SETTINGS = Preprocessing(14.0, exclude_rows="rests")


def recording(dry: Callable[[Floats], Floats], channel: Callable[[Floats], Floats]) -> Recording:
    """The arm with a dry friction of each velocity, whose torque passes a channel."""
    rng = np.random.default_rng(3)
    rate = rng.uniform(2.0, 6.0, (3, 3))
    angle = rate * TIME[:, None, None] + rng.uniform(0.0, 6.0, rate.shape)
    q = 0.3 * np.sin(angle).sum(axis=1)
    v = 0.3 * (rate * np.cos(angle)).sum(axis=1)
    a = -0.3 * (rate**2 * np.sin(angle)).sum(axis=1)
    robot = three_axes.model()
    values = np.zeros(robot.n_parameters)
    values[: robot.base.rank] = robot.base.grouping @ robot.nominal
    torque = robot.torque(values, Motion.of_states(q, v, a)) + 1.5 * dry(v) + 0.8 * v
    torque = channel(torque) + rng.normal(0.0, 0.02, torque.shape)
    return Recording(
        time=TIME,
        position=q + rng.normal(0.0, 1e-5, q.shape),
        torque=torque,
        joint_names=three_axes.NAMES,
    )


def model() -> RobotModel:
    return three_axes.model()


def as_it_is(torque: Floats) -> Floats:
    return torque


def filtered(bandwidth: float, shape: LowPassShape) -> Callable[[Floats], Floats]:
    return lambda torque: low_passed(TIME, torque, bandwidth, shape)


def late(torque: Floats) -> Floats:
    return np.column_stack([np.interp(TIME - 0.012, TIME, column) for column in torque.T])


@pytest.mark.parametrize(
    ("bandwidth", "shape"),
    [
        (8.0, LowPassShape(1, causal=True)),
        # A fit without it takes up half of its fall, by other inertias and friction.
        (3.0, LowPassShape(2, causal=True)),
        pytest.param(5.0, LowPassShape(2, causal=True), marks=pytest.mark.long),
        pytest.param(6.0, LowPassShape(2), marks=pytest.mark.long),
    ],
)
def test_a_low_pass_is_found(bandwidth: float, shape: LowPassShape) -> None:
    found = torque_low_pass(recording(np.sign, filtered(bandwidth, shape)), model(), SETTINGS)
    assert found is not None
    assert found.confirmed
    assert found.settings.torque_bandwidth == pytest.approx(bandwidth, rel=0.3)


def soft(velocity: Floats) -> Floats:
    """Friction that the model lacks: it rises over a range of velocities."""
    return np.sign(velocity) * -np.expm1(-np.abs(velocity) / 0.05)


def smooth(velocity: Floats) -> Floats:
    return np.tanh(velocity / 0.15)


@pytest.mark.parametrize(
    ("dry", "channel"), [(np.sign, as_it_is), (np.sign, late), (soft, as_it_is)]
)
def test_no_low_pass_is_found_where_there_is_none(
    dry: Callable[[Floats], Floats], channel: Callable[[Floats], Floats]
) -> None:
    assert torque_low_pass(recording(dry, channel), model(), SETTINGS) is None


def test_a_gain_that_falls_is_not_enough() -> None:
    """Its candidates are there, and predict other parts worse."""
    assert possible_low_passes(recording(soft, as_it_is), model(), options=SETTINGS)


def test_smooth_reversals_leave_a_low_pass_open() -> None:
    found = torque_low_pass(recording(smooth, as_it_is), model(), SETTINGS)
    assert found is not None
    assert not found.confirmed
