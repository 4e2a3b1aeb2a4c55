"""Torque constants by an arm's own statements at rest."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from drivers.ur.torque_constants import by_size, stated_constants

CURRENTS = st.lists(st.floats(0.1, 5.0) | st.floats(-5.0, -0.1), min_size=3, max_size=3)


@given(
    CURRENTS,
    st.lists(st.floats(1.0, 20.0), min_size=3, max_size=3),
    st.integers(1, 50),
    st.integers(0, 50),
)
def test_they_are_the_ratio_at_rest_without_friction(
    currents: list[float], constants: list[float], resting: int, moving: int
) -> None:
    current = np.tile(currents, (resting + moving, 1))
    moment = current * constants
    velocity = np.zeros_like(current)
    velocity[resting:] = 0.5
    current[resting:] += 3.0  # friction
    np.testing.assert_allclose(stated_constants(moment, current, velocity), constants)


def test_joints_without_load_and_moving_arms_say_nothing() -> None:
    moment, current = np.array([[10.0, 0.05]]), np.array([[1.0, 0.005]])
    rest = np.zeros((1, 2))
    assert stated_constants(moment, current, rest)[0] == 10.0
    assert np.isnan(stated_constants(moment, current, rest)[1])
    assert np.isnan(stated_constants(moment, current, np.array([[0.0, 0.1]]))).all()


def test_ratios_that_differ_are_no_constant() -> None:
    """As where a current is not of the controller's model, or has another sign than its moment."""
    current = np.array([[1.0, 1.0], [1.0, 1.0]])
    moment = np.array([[10.0, -5.0], [11.0, -5.0]])
    assert np.isnan(stated_constants(moment, current, np.zeros((2, 2)))).all()


def test_joints_of_one_size_have_one_constant() -> None:
    constants = np.array([np.nan, 9.8, 9.9, 7.4, np.nan, np.nan])
    filled = by_size(constants, (150.0, 150.0, 150.0, 28.0, 28.0, 12.0))
    np.testing.assert_allclose(filled, [9.85, 9.8, 9.9, 7.4, 7.4, np.nan])
