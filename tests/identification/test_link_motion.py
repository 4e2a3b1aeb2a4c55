from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from identification.model.kinematics import chain_from_urdf
from identification.model.link_motion import LinkMotion, _cos_sin
from sim_fixtures.ns16 import urdf_text


@pytest.fixture(scope="module")
def state() -> np.ndarray:
    return np.random.default_rng(2).uniform(-3.0, 3.0, (3, 25, 6))


def test_link_motion_is_pinocchios(state: np.ndarray) -> None:
    gravity = np.array([1.0, 2.0, -9.0])
    links = LinkMotion(chain_from_urdf(urdf_text()), gravity, 32)
    links.update(*state)
    model = pin.buildModelFromXML(urdf_text())
    data = model.createData()
    for t, (q, qd, qdd) in enumerate(zip(*state, strict=True)):
        pin.forwardKinematics(model, data, q, qd, qdd)
        for link in range(6):
            velocity, acceleration = links.motion[link, :, :, :, t]
            assert np.allclose(velocity, [data.v[link + 1].angular, data.v[link + 1].linear])
            # pinocchio's acceleration is the spatial one as well, without gravity.
            down = data.oMi[link + 1].rotation.T @ gravity
            theirs = [data.a[link + 1].angular, data.a[link + 1].linear - down]
            assert np.allclose(acceleration, theirs)


def test_twists_are_the_jacobian_in_the_links_frame(state: np.ndarray) -> None:
    links = LinkMotion(chain_from_urdf(urdf_text()), np.zeros(3), 25)
    links.update(*state)
    model = pin.buildModelFromXML(urdf_text())
    data = model.createData()
    for t, q in enumerate(state[0]):
        for link in range(6):
            jacobian = pin.computeJointJacobian(model, data, q, link + 1)
            twists = links.twists[link][..., t].reshape(link + 1, 6)
            assert np.allclose(twists[:, :3], jacobian[3:, : link + 1].T)
            assert np.allclose(twists[:, 3:], jacobian[:3, : link + 1].T)


def test_a_shorter_block_leaves_nothing_of_the_block_before_it(state: np.ndarray) -> None:
    links = LinkMotion(chain_from_urdf(urdf_text()), np.zeros(3), 25)
    with np.errstate(invalid="ignore"):
        links.update(*np.full((3, 25, 6), np.inf))
    links.update(*state[:, :10])
    assert np.all(np.isfinite(links.motion))


def test_cosine_and_sine_are_exact_to_rounding() -> None:
    special = np.array([0.0, np.pi / 2, np.pi, -np.pi, 2.0 * np.pi, 1e-300, 1e6])
    angle = np.concatenate([special, np.random.default_rng(0).uniform(-20.0, 20.0, 100_000)])
    cosine, sine = np.empty_like(angle), np.empty_like(angle)
    _cos_sin(angle, cosine, sine)
    assert np.abs(cosine - np.cos(angle)).max() < 1e-15
    assert np.abs(sine - np.sin(angle)).max() < 1e-15
