"""Lines that set a payload, read back by rules of the controllers' manuals and own rotations."""

from __future__ import annotations

import re

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray

from hil.payload.payload_settings import (
    NOT_DETERMINED,
    ControllerLoad,
    controller_settings,
    principal_axes,
)
from identification.model.pseudo_inertia import Body

Array = NDArray[np.float64]

NUMBER = r"(-?\d+\.\d+)"
KILOGRAM_FORCE = 9.80665  # N


def random_body(seed: int) -> Body:
    """Of a box of some decimetres, turned and away from the flange."""
    rng = np.random.default_rng(seed)
    mass = rng.uniform(1.0, 60.0)
    sides = rng.uniform(0.05, 0.6, 3)
    squares = sides**2
    moments = mass / 12.0 * (squares.sum() - squares)
    turned = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    return Body(mass, rng.uniform(-0.3, 0.3, 3), turned @ np.diag(moments) @ turned.T)


BODIES = [random_body(seed) for seed in range(40)]
ROD = Body(2.0, np.array([0.0, 0.0, 0.1]), np.diag([0.02, 0.02, 0.001]))  # of two equal moments
BALL = Body(3.0, np.array([0.01, 0.0, 0.2]), np.eye(3) * 0.01)


def lines(body: Body, *, with_centre: bool = True, with_inertia: bool = True) -> dict[str, str]:
    return controller_settings(ControllerLoad(body, with_centre, with_inertia))


def about(axis: int, degrees: float) -> Array:
    """Rotation about a coordinate axis, by its definition."""
    c = np.cos(np.radians(degrees))
    s = np.sin(np.radians(degrees))
    j = (axis + 1) % 3
    k = (axis + 2) % 3
    matrix = np.eye(3)
    matrix[j, j] = matrix[k, k] = c
    matrix[j, k], matrix[k, j] = -s, s
    return matrix


def kuka(text: str) -> Body:
    """Mass in kg, centre in mm, A about Z, then B about the new Y, then C about the new X."""
    mass, x, y, z, a, b, c, jx, jy, jz = map(
        float,
        re.fullmatch(
            rf"LOAD_DATA\[1\]={{M {NUMBER},CM {{X {NUMBER},Y {NUMBER},Z {NUMBER},A {NUMBER},"
            rf"B {NUMBER},C {NUMBER}}},J {{X {NUMBER},Y {NUMBER},Z {NUMBER}}}}}",
            text,
        ).groups(),  # type: ignore[union-attr]
    )
    rotation = about(2, a) @ about(1, b) @ about(0, c)
    return Body(mass, np.array([x, y, z]) / 1e3, rotation @ np.diag([jx, jy, jz]) @ rotation.T)


def abb(text: str) -> Body:
    """[kg, [mm], [q1, q2, q3, q4], kg m² three times], q1 the real part of a unit quaternion."""
    comment, line = text.splitlines()
    assert comment.startswith("!")
    assert line.startswith("PERS loaddata payload := [")
    assert line.endswith("];")
    mass, x, y, z, w, i, j, k, ix, iy, iz = map(float, re.findall(NUMBER, line))
    assert np.linalg.norm([w, i, j, k]) == pytest.approx(1.0, abs=2e-6)
    rotation = pin.Quaternion(w, i, j, k).toRotationMatrix()
    return Body(mass, np.array([x, y, z]) / 1e3, rotation @ np.diag([ix, iy, iz]) @ rotation.T)


def fanuc(text: str) -> tuple[float, Array, Array, Array]:
    """Mass in kg, centre in cm, moments in kgf cm s²; then the products of the remark in kg m²."""
    *screen, remark = text.splitlines()
    assert remark.startswith("! the screen takes no products of inertia: ")
    mass, *others = (float(re.findall(NUMBER, line)[-1]) for line in screen)
    products = np.array([float(part) for part in re.findall(NUMBER, remark)])
    return mass, np.array(others[:3]) / 100.0, np.array(others[3:]) * KILOGRAM_FORCE / 100, products


@pytest.mark.parametrize("body", [*BODIES, ROD, BALL])
class TestReadBack:
    def test_kuka_and_abb_have_the_whole_tensor(self, body: Body) -> None:
        size = np.trace(body.inertia)
        for read in (kuka(lines(body)["KUKA"]), abb(lines(body)["ABB"])):
            assert read.mass == pytest.approx(body.mass, abs=5e-4)
            assert np.allclose(read.centre, body.centre, atol=6e-6)
            assert np.allclose(read.inertia, body.inertia, atol=2e-5 * size + 1e-5)

    def test_fanuc_has_the_moments_and_a_remark_on_the_products(self, body: Body) -> None:
        mass, centre, moments, products = fanuc(lines(body)["FANUC"])
        assert mass == pytest.approx(body.mass, abs=5e-4)
        assert np.allclose(centre, body.centre, atol=6e-6)
        assert np.allclose(moments, np.diag(body.inertia), atol=1e-5)
        assert np.allclose(products, body.inertia[[0, 0, 1], [1, 2, 2]], atol=6e-6)

    def test_they_are_those_of_ur_and_franka(self, body: Body) -> None:
        text = lines(body)
        six = [float(part) for part in re.findall(NUMBER, text["UR"].split("[")[2])]
        nine = [float(part) for part in re.findall(NUMBER, text["Franka"].split("{")[2])]
        tensor = np.array(nine).reshape(3, 3)
        assert np.allclose(tensor, body.inertia, atol=6e-6)
        assert np.allclose(six, [*np.diag(tensor), tensor[0, 1], tensor[0, 2], tensor[1, 2]])


class TestPrincipalAxes:
    def test_a_diagonal_tensor_is_not_turned(self) -> None:
        tensor = np.diag([0.3, 0.1, 0.2])
        moments, rotation = principal_axes(tensor)
        assert np.allclose(rotation.as_matrix(), np.eye(3))
        assert np.allclose(moments, [0.3, 0.1, 0.2])
        assert "A 0.000,B 0.000,C 0.000" in lines(Body(1.0, np.zeros(3), tensor))["KUKA"]

    @pytest.mark.parametrize("body", BODIES)
    def test_the_frame_is_right_handed_and_turned_least(self, body: Body) -> None:
        moments, rotation = principal_axes(body.inertia)
        axes = rotation.as_matrix()
        assert np.linalg.det(axes) == pytest.approx(1.0)
        assert np.allclose(axes @ np.diag(moments) @ axes.T, body.inertia)
        quarter = [about(axis, 90.0 * turns) for axis in range(3) for turns in (1, 2, 3)]
        assert all(np.trace(axes) >= np.trace(axes @ turn) - 1e-9 for turn in quarter)


COMMENTS = {"COMAU": "--", "UR": "#", "Franka": "//", "KUKA": ";", "ABB": "!", "FANUC": "!"}


class TestNotDetermined:
    def test_an_inertia_is_a_comment_and_no_zeros(self) -> None:
        for controller, text in lines(BODIES[0], with_inertia=False).items():
            assert NOT_DETERMINED in text, controller
            typed = [
                line for line in text.splitlines() if not line.startswith(COMMENTS[controller])
            ]
            assert not any("INERTIA" in line or "J {" in line or "0, 0, 0]" in line
                           for line in typed)  # fmt: skip
            assert f"{BODIES[0].mass:.3f}" in text

    def test_a_centre_leaves_at_most_the_mass(self) -> None:
        for controller, text in lines(BODIES[0], with_centre=False, with_inertia=False).items():
            assert NOT_DETERMINED in text
            typed = [
                line for line in text.splitlines() if not line.startswith(COMMENTS[controller])
            ]
            assert all("MASS" in line or line.startswith("PAYLOAD   ") for line in typed)
