from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from identification.model.kinematics import FROM_PINOCCHIO
from identification.model.pseudo_inertia import (
    AS_GIVEN,
    ASSUMED,
    MADE_POSSIBLE,
    Body,
    NoMassError,
    body,
    inertial_from_pseudo,
    inertial_parameters,
    margin,
    pseudo_inertia,
    pseudo_inertia_map,
    reference_bodies,
)

Array = NDArray[np.float64]

seeds = st.integers(0, 2**32 - 1)


def point_masses(seed: int, count: int = 8) -> tuple[Array, Array]:
    rng = np.random.default_rng(seed)
    return rng.uniform(0.1, 2.0, count), rng.normal(size=(count, 3))


def of_points(masses: Array, places: Array) -> Array:
    """Inertial parameters by the definition: sums over the masses."""
    tensor = sum(
        m * ((p @ p) * np.eye(3) - np.outer(p, p)) for m, p in zip(masses, places, strict=True)
    )
    assert isinstance(tensor, np.ndarray)
    return np.concatenate([tensor[np.triu_indices(3)], masses @ places, [masses.sum()]])


@given(seeds)
def test_it_is_the_matrix_of_second_moments_of_the_mass(seed: int) -> None:
    masses, places = point_masses(seed)
    homogeneous = np.column_stack([places, np.ones(len(places))])
    expected = np.einsum("i,ij,ik->jk", masses, homogeneous, homogeneous)
    np.testing.assert_allclose(pseudo_inertia(of_points(masses, places)), expected, atol=1e-12)


@given(seeds)
def test_parameters_come_back_from_their_pseudo_inertia(seed: int) -> None:
    inertial = np.random.default_rng(seed).normal(size=(3, 10))
    back = inertial_from_pseudo(pseudo_inertia(inertial))
    np.testing.assert_allclose(back, inertial, atol=1e-12)


@given(seeds)
def test_it_is_linear_in_the_parameters(seed: int) -> None:
    inertial = np.random.default_rng(seed).normal(size=10)
    expected = np.tensordot(inertial, pseudo_inertia_map(), axes=1)
    np.testing.assert_allclose(pseudo_inertia(inertial), expected, atol=1e-12)


@given(seeds)
def test_any_distribution_of_mass_is_consistent(seed: int) -> None:
    assert margin(of_points(*point_masses(seed))) > 0.0


@given(seeds)
def test_consistent_is_positive_mass_and_the_triangle_inequalities(seed: int) -> None:
    """Of the tensor about the centre of mass; the definition that needs no pseudo-inertia."""
    rng = np.random.default_rng(seed)
    moments = rng.uniform(0.05, 1.0, 3)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    some = Body(1.3, rng.normal(size=3), turn @ np.diag(moments) @ turn.T)
    possible = bool(np.all(moments.sum() - 2.0 * moments > 0.0))
    assert (margin(inertial_parameters(some)) > 0.0) == possible


def test_a_negative_mass_is_not_consistent() -> None:
    inertial = of_points(*point_masses(1))
    assert margin(-inertial) < 0.0


@given(seeds)
def test_body_and_parameters_are_those_of_pinocchio(seed: int) -> None:
    inertial = of_points(*point_masses(seed))
    found = body(inertial)
    expected = pin.Inertia(found.mass, found.centre, found.inertia)
    order = list(FROM_PINOCCHIO)
    np.testing.assert_allclose(expected.toDynamicParameters()[order], inertial, atol=1e-12)
    np.testing.assert_allclose(inertial_parameters(found), inertial, atol=1e-12)


def test_a_body_without_mass_has_no_centre() -> None:
    with pytest.raises(NoMassError):
        body(np.zeros(10))


STEPS = np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.4]])


def a_link(moments: tuple[float, float, float], mass: float = 2.0) -> Array:
    return inertial_parameters(Body(mass, np.array([0.1, 0.0, 0.2]), np.diag(moments)))


SOUND, FLAT, POINT = (0.1, 0.1, 0.02), (0.001, 0.002, 0.02), (0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("moments", "words"), [(SOUND, AS_GIVEN), (FLAT, MADE_POSSIBLE), (POINT, MADE_POSSIBLE)]
)
def test_as_much_of_a_link_is_used_as_is_possible(
    moments: tuple[float, float, float], words: str
) -> None:
    """All of a possible one, mass and centre of another, those of the others without mass."""
    links = np.array([a_link(moments), a_link(SOUND), np.zeros(10)])
    found = reference_bodies(links, STEPS)
    assert found.words == (words, AS_GIVEN, ASSUMED)
    possible = slice(None) if words == AS_GIVEN else slice(6, None)
    np.testing.assert_allclose(found.inertial[0, possible], links[0, possible], atol=1e-14)
    np.testing.assert_allclose(found.inertial[1], links[1], atol=1e-14)
    assert np.all(margin(found.inertial) > 1e-6)
    assert found.inertial[2, 9] == 2.0


@given(st.integers(0, 2**32 - 1))
def test_whatever_is_given_the_result_is_a_possible_body(seed: int) -> None:
    rng = np.random.default_rng(seed)
    links = rng.normal(size=(3, 10)) * 10.0 ** rng.uniform(-3, 3, (3, 1))
    links[rng.random(3) < 0.3] = 0.0
    found = reference_bodies(links, np.zeros((3, 3)))
    assert np.all(margin(found.inertial) > 0.0)
    squares = found.frames @ found.frames.transpose(0, 2, 1)
    np.testing.assert_allclose(squares, pseudo_inertia(found.inertial), rtol=1e-9, atol=1e-12)
