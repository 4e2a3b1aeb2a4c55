"""Dahl's presliding state: dry friction that follows displacement at a reversal."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from identification.model.friction import FrictionLaw, presliding_state
from tests.identification.two_link import MODEL, a_motion, truth

steps = st.lists(st.sampled_from([-3e-4, -1e-5, 0.0, 1e-5, 2e-3]), min_size=2, max_size=60)
distances = st.sampled_from([1e-5, 1e-4, 1e-3])


class TestPreslidingState:
    @given(steps=steps, distance=distances)
    def test_it_is_dahls_recursion(self, steps: list[float], distance: float) -> None:
        """z <- s + (z - s) exp(-|dq| / d), from zero."""
        position = 0.3 + np.cumsum([0.0, *steps])
        state, expected = 0.0, [0.0]
        for step in np.diff(position):
            state = np.sign(step) + (state - np.sign(step)) * np.exp(-abs(step) / distance)
            expected.append(state)
        np.testing.assert_allclose(presliding_state(position, distance), expected, atol=1e-12)

    @given(steps=steps, distance=distances)
    def test_it_never_exceeds_full_friction(self, steps: list[float], distance: float) -> None:
        state = presliding_state(np.cumsum(steps), distance)
        assert np.all(np.abs(state) <= 1.0)

    def test_at_rest_it_keeps_what_the_motion_left(self) -> None:
        position = np.array([0.0, 0.1, 0.1, 0.1, 0.1])
        np.testing.assert_allclose(presliding_state(position, 1e-4)[1:], 1.0, rtol=1e-12)


class TestDirectionOfFriction:
    def test_without_presliding_it_is_the_sign(self) -> None:
        motion = a_motion()
        direction = MODEL.friction.direction(*motion[:3])
        np.testing.assert_array_equal(direction, np.sign(motion.velocity))

    def test_a_short_displacement_is_the_sign_away_from_reversals(self) -> None:
        motion = a_motion()
        sliding = MODEL.with_friction(presliding=1e-7)
        moved = motion._replace(direction=sliding.friction.direction(*motion[:3]))
        fast = np.abs(motion.velocity).min(axis=1) > 0.3  # as much as changes in one step
        fast[0] = False  # nothing is known of what was before
        np.testing.assert_allclose(
            sliding.torque(truth(), *moved[1:])[fast],
            MODEL.torque(truth(), *motion[1:])[fast],
            rtol=1e-9,
        )

    def test_the_torque_of_a_motion_takes_its_direction(self) -> None:
        motion = a_motion()
        half = motion._replace(direction=0.5 * np.sign(motion.velocity))
        dry = np.zeros_like(truth())
        dry[MODEL.parameter_names.index("f0_1")] = 4.0
        dry[MODEL.parameter_names.index("f0_2")] = 2.0
        np.testing.assert_allclose(
            MODEL.torque(dry, *half[1:]), 0.5 * MODEL.torque(dry, *motion[1:]), atol=1e-12
        )


class TestOtherFriction:
    def test_a_model_with_other_friction_names_its_parameters(self) -> None:
        changed = MODEL.with_friction(third="cubic", offset=True)
        assert changed.friction.laws[0] == FrictionLaw(third="cubic", offset=True)
        assert changed.parameter_names == MODEL.base.names + changed.friction.names
        assert len(changed.units) == changed.n_parameters
