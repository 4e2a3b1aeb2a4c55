from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from identification.model.pseudo_inertia import Body, inertial_parameters, margin, pseudo_inertia
from identification.model.reference_bodies import AS_GIVEN, ASSUMED, MADE_POSSIBLE, reference_bodies

Array = NDArray[np.float64]

STEPS = np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.4]])


def a_link(moments: tuple[float, float, float], mass: float = 2.0) -> Array:
    return inertial_parameters(Body(mass, np.array([0.1, 0.0, 0.2]), np.diag(moments)))


def test_a_possible_body_is_left_alone() -> None:
    links = np.array([a_link((0.02, 0.02, 0.03)), a_link((0.1, 0.1, 0.02))])
    found = reference_bodies(links, STEPS)
    np.testing.assert_allclose(found.inertial, links, atol=1e-14)
    assert found.words == (AS_GIVEN, AS_GIVEN)


def test_an_impossible_one_keeps_its_mass_and_centre() -> None:
    links = np.array([a_link((0.001, 0.002, 0.02)), a_link((0.1, 0.1, 0.02))])
    found = reference_bodies(links, STEPS)
    assert found.words == (MADE_POSSIBLE, AS_GIVEN)
    np.testing.assert_allclose(found.inertial[0, 6:], links[0, 6:])
    assert margin(found.inertial[0]) > 0.0


def test_a_point_becomes_a_body() -> None:
    found = reference_bodies(np.array([a_link((0.0, 0.0, 0.0)), a_link((0.1, 0.1, 0.02))]), STEPS)
    assert found.words[0] == MADE_POSSIBLE
    assert margin(found.inertial[0]) > 1e-6


def test_a_link_without_mass_weighs_what_the_others_do() -> None:
    links = np.array([a_link((0.1, 0.1, 0.02), mass=3.0), np.zeros(10)])
    found = reference_bodies(links, STEPS)
    assert found.words == (AS_GIVEN, ASSUMED)
    assert found.inertial[1, 9] == 3.0


@given(st.integers(0, 2**32 - 1))
def test_whatever_is_given_the_result_is_a_possible_body(seed: int) -> None:
    rng = np.random.default_rng(seed)
    links = rng.normal(size=(3, 10)) * 10.0 ** rng.uniform(-3, 3, (3, 1))
    links[rng.random(3) < 0.3] = 0.0
    found = reference_bodies(links, np.zeros((3, 3)))
    assert np.all(margin(found.inertial) > 0.0)
    squares = found.frames @ found.frames.transpose(0, 2, 1)
    np.testing.assert_allclose(squares, pseudo_inertia(found.inertial), rtol=1e-9, atol=1e-12)
