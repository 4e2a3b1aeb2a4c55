"""Ripple of a torque over the angle of its joint, of which no gears are known."""

from __future__ import annotations

import numpy as np
import pytest

from identification.signals.recording import Recording
from identification.signals.samples import Preprocessing, prepare
from identification.validation.ripple import Ripple, joint_ripple
from tests.identification import three_axes

TIME = np.arange(0.0, 20.0, 0.005)
KNEE = 1
NOISE = 0.1  # N·m


def found(periods: float, amplitude: float = NOISE) -> Ripple:
    """Ripple of the knee in the residual of a motion at 200 Hz, with noise."""
    rng = np.random.default_rng(1)
    rate = np.array([1.1, 1.7, 2.3])
    position = 0.8 * np.sin(rate * TIME[:, None]) + 0.3 * np.sin(2.9 * rate * TIME[:, None] + 1.0)
    model = three_axes.model()
    recording = Recording(
        time=TIME, position=position, torque=np.ones_like(position), joint_names=three_axes.NAMES
    )
    samples = prepare(recording, model, options=Preprocessing(14.0))
    slow = np.sin(3.0 * position) + 0.3 * np.cos(5.0 * TIME[:, None])  # what the model lacks
    residual = rng.normal(0.0, NOISE, position.shape) + NOISE * slow
    residual[:, KNEE] += amplitude * np.sin(periods * position[:, KNEE] + 0.4)
    return joint_ripple(model, [samples], [np.where(samples.usable, residual, 0.0)])


@pytest.mark.parametrize("periods", [60.0, 101.0, 200.0])
def test_the_joint_and_the_periods_of_a_ripple_are_found(periods: float) -> None:
    ripple = found(periods)
    assert ripple.significant.tolist() == [False, True, False]
    assert ripple.periods[KNEE] == pytest.approx(periods, abs=0.5)
    assert ripple.rms[KNEE] == pytest.approx(NOISE / np.sqrt(2.0), rel=0.15)


def test_noise_and_what_varies_slowly_are_no_ripple() -> None:
    assert not found(3.0).significant.any()
    assert not found(200.0, amplitude=0.0).significant.any()
