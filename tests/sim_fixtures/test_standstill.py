"""Dry friction of one step: rest, slide, turn."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from sim_fixtures.plant import TOLERANCE, resolve_dry_friction

Array = NDArray[np.float64]
STEP = 5e-4


def random_inverse_inertia(rng: np.random.Generator, n: int) -> Array:
    root = rng.normal(size=(n, n))
    return root @ root.T + 0.1 * np.eye(n)


@given(seed=st.integers(0, 10_000), n=st.integers(1, 6), push=st.floats(0.01, 100.0))
def test_friction_holds_what_it_can_and_opposes_what_slides(seed: int, n: int, push: float) -> None:
    rng = np.random.default_rng(seed)
    inverse = random_inverse_inertia(rng, n)
    coulomb = rng.uniform(0.0, 50.0, n) * rng.integers(0, 2, n)
    free = STEP * push * rng.normal(size=n)
    guess = rng.uniform(-60.0, 60.0, n)
    result = resolve_dry_friction(free.tolist(), inverse, coulomb.tolist(), STEP, guess.tolist())
    velocity, torque = np.array(result.velocity), np.array(result.torque)

    slack = 10.0 * TOLERANCE * (coulomb.max() + 1.0)
    assert np.all(np.abs(torque) <= coulomb)
    sliding = velocity != 0.0
    np.testing.assert_allclose(torque[sliding], (coulomb * np.sign(velocity))[sliding], atol=slack)
    # momentum: what friction did not take away is still there
    balance = free - STEP * inverse @ torque - velocity
    np.testing.assert_allclose(balance, 0.0, atol=STEP * np.abs(inverse).sum() * slack)


def test_a_joint_slides_on_when_its_coulomb_torque_grows_a_little() -> None:
    """A guess just short of the bound must not pass for a torque that holds."""
    result = resolve_dry_friction([1.0], np.eye(1), [10.0 * (1.0 + 1e-9)], STEP, [10.0])
    assert result.velocity[0] > 0.9


def test_without_friction_nothing_changes() -> None:
    result = resolve_dry_friction([0.3, -0.2], np.eye(2), [0.0, 0.0], STEP, [5.0, -5.0])
    assert result.velocity == [0.3, -0.2]
    assert result.torque == [0.0, 0.0]


def test_friction_never_pushes_a_joint_backwards() -> None:
    result = resolve_dry_friction([0.001, -0.002], np.eye(2), [100.0, 100.0], STEP, [0.0, 0.0])
    assert result.velocity == [0.0, 0.0]
