"""The URDF of the NS 16: its figures, its posture, its limits and its shapes."""

from __future__ import annotations

import tomllib

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray

from sim_fixtures import FixtureError, ns16
from sim_fixtures.ns16 import LinkInertia, geometry, inertial

Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def model() -> pin.Model:
    return pin.buildModelFromXML(ns16.urdf_text())


def dh(controller_deg: list[float]) -> Array:
    """DH angles [rad] of controller angles [deg]."""
    angles = np.array(controller_deg) - geometry.JOINT_OFFSET_DEG
    return np.radians(angles * geometry.JOINT_SIGN)


def wrist_and_flange(model: pin.Model, controller_deg: list[float]) -> tuple[Array, Array]:
    data = model.createData()
    pin.framesForwardKinematics(model, data, dh(controller_deg))
    flange = data.oMf[model.getFrameId("flange")].translation
    return np.array(data.oMi[6].translation), np.array(flange)


def test_the_file_has_the_nominal_inertias() -> None:
    cell = tomllib.loads(ns16.CELL_PATH.read_text(encoding="utf-8"))
    nominal = ns16.urdf_text(cell["simulation"]["inertia_scale"])
    assert ns16.URDF_PATH.read_text(encoding="utf-8") == nominal


def test_pinocchio_reads_the_planted_standard_parameters(model: pin.Model) -> None:
    planted = ns16.standard_parameters()
    for i in range(1, 7):
        keys = [f"m{i}", *(f"mc{i}{a}" for a in "xyz")]
        keys += [f"I{i}{k}" for k in ("xx", "xy", "yy", "xz", "yz", "zz")]
        read = model.inertias[i].toDynamicParameters()
        np.testing.assert_allclose(read, [planted[k] for k in keys], rtol=1e-12, atol=1e-12)


def test_every_link_is_a_possible_rigid_body(model: pin.Model) -> None:
    for inertia in list(model.inertias)[1:]:
        moments = np.linalg.eigvalsh(inertia.inertia)
        assert moments[0] > 0.0
        assert moments[2] < moments[0] + moments[1]


def test_an_impossible_body_is_refused() -> None:
    with pytest.raises(FixtureError, match="link_9"):
        inertial(LinkInertia(1.0, (1.0, 0.0, 0.0), (0.1, 0.0, 0.0, 0.1, 0.0, 0.1)), "link_9")


def test_link_frames_are_the_dh_frames_at_the_previous_origin(model: pin.Model) -> None:
    """Independent of the URDF: multiply the DH matrices."""
    q = np.array([0.3, -0.7, 1.9, 0.4, -1.1, 2.0])
    data = model.createData()
    pin.forwardKinematics(model, data, q)
    before = np.eye(4)
    for i in range(6):
        alpha = geometry.ALPHA_QUARTER_TURNS[i] * np.pi / 2
        c, s, ca, sa = np.cos(q[i]), np.sin(q[i]), np.cos(alpha), np.sin(alpha)
        after = before @ np.array(
            [
                [c, -s * ca, s * sa, geometry.A[i] * c],
                [s, c * ca, -c * sa, geometry.A[i] * s],
                [0.0, sa, ca, geometry.D[i]],
                [0.0, 0.0, 0.0, 1.0],
            ]
        )
        placement = data.oMi[i + 1]
        np.testing.assert_allclose(placement.rotation, after[:3, :3], atol=1e-14)
        origin = before[:3, 3] + ([0.0, 0.0, 0.6] if i == 0 else 0.0)  # O_0 at joint 2's height
        np.testing.assert_allclose(placement.translation, origin, atol=1e-14)
        before = after


def test_home_has_the_wrist_in_front_of_and_above_the_base(model: pin.Model) -> None:
    wrist, flange = wrist_and_flange(model, list(geometry.HOME_DEG))
    np.testing.assert_allclose(wrist, [0.300 + 0.624, 0.0, 0.600 + 0.700 - 0.185], atol=1e-12)
    # a wrist bent by 90 deg turns the flange out of the forearm's line, straight up or down
    np.testing.assert_allclose(np.abs(flange - wrist), [0.0, 0.0, 0.135], atol=1e-12)


def test_joint_2_forward_is_positive_on_the_teach_pendant(model: pin.Model) -> None:
    upright, _ = wrist_and_flange(model, [0.0, 0.0, -90.0, 0.0, 0.0, 0.0])
    leaning, _ = wrist_and_flange(model, [0.0, 10.0, -90.0, 0.0, 0.0, 0.0])
    assert leaning[0] > upright[0]
    assert leaning[2] < upright[2]


def test_limits_are_the_controllers_mapped_to_dh_angles(model: pin.Model) -> None:
    np.testing.assert_allclose(
        np.degrees(np.column_stack([model.lowerPositionLimit, model.upperPositionLimit])),
        [(-180, 180), (-140, 5), (-20, 260), (-360, 360), (-120, 120), (-360, 360)],
        atol=1e-12,
    )
    ends = np.sort([dh(list(geometry.LOWER_DEG)), dh(list(geometry.UPPER_DEG))], axis=0)
    np.testing.assert_allclose(ends[0], model.lowerPositionLimit, atol=1e-12)
    np.testing.assert_allclose(ends[1], model.upperPositionLimit, atol=1e-12)


class Collisions:
    """Distances between the shapes of links that are not neighbours."""

    def __init__(self, model: pin.Model) -> None:
        self.model = model
        self.shapes = pin.buildGeomFromUrdfString(
            model, ns16.urdf_text(), pin.GeometryType.COLLISION
        )
        objects = list(self.shapes.geometryObjects)
        for a, first in enumerate(objects):
            for b, second in enumerate(objects[:a]):
                if abs(first.parentJoint - second.parentJoint) > 1:
                    self.shapes.addCollisionPair(pin.CollisionPair(b, a))

    def smallest_distance(self, q: Array) -> float:
        data, shapes = self.model.createData(), self.shapes.createData()
        pin.computeDistances(self.model, data, self.shapes, shapes, q)
        return min(result.min_distance for result in shapes.distanceResults)


@pytest.fixture(scope="module")
def collisions(model: pin.Model) -> Collisions:
    return Collisions(model)


@pytest.mark.parametrize("wrist_deg", [-120.0, -90.0, 0.0, 90.0, 120.0])
@pytest.mark.parametrize("forearm_deg", [-130.0, -90.0, -45.0, 0.0, 45.0])
@pytest.mark.parametrize("arm_deg", [-50.0, 0.0, 45.0, 90.0])
def test_working_postures_are_free_by_the_cells_margin(
    collisions: Collisions, arm_deg: float, forearm_deg: float, wrist_deg: float
) -> None:
    q = dh([0.0, arm_deg, forearm_deg, 30.0, wrist_deg, 0.0])
    assert collisions.smallest_distance(q) > 0.05


def test_a_folded_arm_collides(collisions: Collisions) -> None:
    assert collisions.smallest_distance(dh([0.0, 0.0, -165.0, 0.0, 0.0, 0.0])) <= 0.0
