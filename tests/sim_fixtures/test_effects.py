"""Sizes and shapes of the unmodelled effects."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sim_fixtures import SettingError, UnmodelledEffects
from sim_fixtures.arm import WARM_UP_TIME, FrictionDrift, TorqueRipple


def test_nothing_is_on_unless_asked_for() -> None:
    none = UnmodelledEffects()
    assert (none.torque_ripple, none.friction_drift, none.delay) == (0.0, 0.0, 0.0)
    assert not none.is_elastic


def test_the_cell_file_documents_the_default_sizes(cell: dict[str, Any]) -> None:
    sizes = UnmodelledEffects.default_sizes(6)
    planted = cell["simulation"]
    assert sizes.torque_ripple == planted["torque_ripple"]
    assert sizes.friction_drift == planted["friction_drift"]
    assert sizes.elasticity == tuple(planted["elasticity"])
    assert sizes.delay == planted["delay"]


def test_ripple_repeats_twice_per_motor_turn_with_the_stated_amplitude() -> None:
    ripple = TorqueRipple(np.array([5.0, 2.0]), np.random.default_rng(1))
    turns = np.linspace(0.0, 1.0, 401)
    torque = np.array([ripple.torque([t, t]) for t in turns])
    np.testing.assert_allclose(np.abs(torque).max(axis=0), [5.0, 2.0], rtol=1e-3)
    np.testing.assert_allclose(torque[:201], torque[200:], atol=1e-9)
    np.testing.assert_allclose(torque[:-1].mean(axis=0), 0.0, atol=1e-9)


def test_friction_falls_from_cold_to_hot_by_the_stated_share() -> None:
    drift = FrictionDrift(0.08, 2)
    cold = drift.scale(np.zeros(2), 0.001)
    np.testing.assert_allclose(cold, 1.04, rtol=1e-6)
    previous = cold
    for _ in range(3000):  # half an hour; one joint races, the other rests
        factor = drift.scale(np.array([1e6, 0.0]), 6.0)
        assert factor[0] <= previous[0]
        previous = factor
    np.testing.assert_allclose(factor, [0.96, 1.04], rtol=1e-4)


def test_a_joint_warms_up_in_ten_minutes() -> None:
    drift = FrictionDrift(0.1, 1)
    factor = drift.scale(np.array([1e9]), 0.0)
    for _ in range(round(WARM_UP_TIME)):
        factor = drift.scale(np.array([1e9]), 1.0)
    assert factor[0] == pytest.approx(1.05 - 0.1 * (1.0 - np.exp(-1.0)), abs=1e-4)


@pytest.mark.parametrize(
    "sizes",
    [
        {"torque_ripple": -0.1},
        {"delay": float("nan")},
        {"friction_drift": 1.0},
        {"elasticity": (1e-6, -1e-6)},
    ],
)
def test_impossible_sizes_are_refused(sizes: dict[str, Any]) -> None:
    with pytest.raises(SettingError):
        UnmodelledEffects(**sizes)
