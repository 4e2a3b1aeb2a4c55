from __future__ import annotations

from itertools import combinations, pairwise

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from identification import ShapeError
from identification.excitation import (
    Box,
    CollisionChecker,
    CollisionModelError,
    Wall,
    Workspace,
    WorkspaceError,
)
from identification.excitation.collision import joint_poses
from identification.kinematics import chain_from_urdf
from sim_fixtures.ns16 import urdf_text

NOWHERE = Workspace(floor=None, margin=0.0)


def link(name: str, shape: str = "", at: str = "0 0 0") -> str:
    collision = (
        f'<collision><origin xyz="{at}"/><geometry>{shape}</geometry></collision>' if shape else ""
    )
    return (
        f'<link name="{name}"><inertial><mass value="1"/>'
        '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'
        f"{collision}</link>"
    )


def joint(number: int, parent: str, child: str, axis: str, kind: str = "revolute", at="0 0 0"):
    return (
        f'<joint name="joint_{number}" type="{kind}"><parent link="{parent}"/>'
        f'<child link="{child}"/><origin xyz="{at}" rpy="0.1 -0.3 0.7"/><axis xyz="{axis}"/>'
        '<limit lower="-2" upper="2" effort="1" velocity="1"/></joint>'
    )


def robot(*parts: str) -> str:
    return f'<robot name="r">{"".join(parts)}</robot>'


def ball_chain(*radii: float) -> str:
    """Balls 0.1 m apart, each on a joint of its own; radius 0 for a link without shape."""
    parts = [link("base")]
    for k, radius in enumerate(radii):
        shape = f'<sphere radius="{radius}"/>' if radius else ""
        parts.append(link(f"link_{k}", shape))
        parts.append(joint(k, f"link_{k - 1}" if k else "base", f"link_{k}", "0 0 1", at="0.1 0 0"))
    return robot(*parts)


@pytest.fixture(scope="module")
def arm():
    return pin.buildModelFromXML(urdf_text())


def postures(model, seed, count):
    random = np.random.default_rng(seed)
    return random.uniform(model.lowerPositionLimit, model.upperPositionLimit, (count, model.nq))


def test_joint_frames_are_those_of_pinocchio():
    urdf = robot(
        link("base"),
        link("a"),
        link("b"),
        link("c"),
        joint(1, "base", "a", "0.6 0 0.8", at="0.1 0.2 0.3"),
        joint(2, "a", "b", "0 0.6 -0.8", kind="prismatic", at="0 0.2 0"),
        joint(3, "b", "c", "0 1 0", at="0 0 0.5"),
    )
    model = pin.buildModelFromXML(urdf)
    data = model.createData()
    q = postures(model, 1, 20)
    rotations, translations = joint_poses(chain_from_urdf(urdf), q)
    for k, row in enumerate(q):
        pin.forwardKinematics(model, data, row)
        for i in range(4):
            np.testing.assert_allclose(rotations[i, k], data.oMi[i].rotation, atol=1e-12)
            np.testing.assert_allclose(translations[i, k], data.oMi[i].translation, atol=1e-12)


def test_clear_postures_are_those_where_pinocchio_finds_no_distance_below_zero(arm):
    shapes = pin.buildGeomFromUrdfString(arm, urdf_text(), pin.GeometryType.COLLISION)
    apart = [
        (a, b)
        for a, b in combinations(range(shapes.ngeoms), 2)
        if abs(shapes.geometryObjects[a].parentJoint - shapes.geometryObjects[b].parentJoint) > 1
    ]
    for a, b in apart:
        shapes.addCollisionPair(pin.CollisionPair(a, b))
    data, places = arm.createData(), pin.GeometryData(shapes)
    q = postures(arm, 2, 300)
    expected = []
    for row in q:
        pin.computeDistances(arm, data, shapes, places, row)
        expected.append(min(r.min_distance for r in places.distanceResults) >= 0.0)
    clear = CollisionChecker(urdf_text(), NOWHERE).clear(q)
    np.testing.assert_array_equal(clear, expected)
    assert 0.1 < np.mean(clear) < 0.95


@given(st.integers(0, 10**6), st.sampled_from([0.0, 0.05, 0.15]))
@settings(max_examples=30)
def test_the_first_contact_is_the_one_that_looking_at_every_sample_finds(arm, seed, margin):
    checker = checkers(margin)
    ends = postures(arm, seed, 4)
    q = np.concatenate([np.linspace(a, b, 60) for a, b in pairwise(ends)])
    q = np.concatenate((np.linspace(np.zeros(6), ends[0], 60), q))
    blocked = np.flatnonzero(~checker.clear(q))
    contact = checker.first_contact(q)
    if len(blocked) == 0:
        assert contact is None
    else:
        assert contact is not None
        assert contact.sample == blocked[0]
        assert contact.distance < margin


def checkers(margin, made={}):  # noqa: B006 - the cache is the point
    if margin not in made:
        made[margin] = CollisionChecker(urdf_text(), Workspace(margin=margin))
    return made[margin]


@given(st.integers(0, 10**6))
@settings(max_examples=15)
def test_no_distance_changes_faster_than_the_bodies_travel(arm, seed):
    checker = checkers(0.05)
    q = np.linspace(*postures(arm, seed, 2), 40)
    paths = checker._paths(q)
    for a, b in checker._pairs:
        distance = np.array([checker._distance(a, b, paths, k) for k in range(len(q))])
        step = np.diff(paths[a].travel + paths[b].travel)
        apart = (distance[1:] > 0.0) & (distance[:-1] > 0.0)  # how deep they overlap is a guess
        assert np.all(np.abs(np.diff(distance))[apart] <= step[apart] + 1e-6)


def test_reaching_into_the_floor_is_named(arm):
    # Upper arm straight forward and down, forearm stretched: the wrist is below the ground.
    into_floor = np.array([0.0, 0.0872, np.pi / 2, 0.0, 0.0, 0.0])
    upright = np.array([0.0, -np.pi / 2, np.pi / 2, 0.0, 0.0, 0.0])
    q = np.linspace(upright, into_floor, 200)
    high = Workspace(floor=0.3, margin=0.02)
    contact = CollisionChecker(urdf_text(), high).first_contact(q)
    assert contact is not None
    assert contact.second == "floor"
    assert 0 < contact.sample < 199
    assert 0.0 <= contact.distance < 0.02
    # Without the floor the same way is free.
    assert CollisionChecker(urdf_text(), NOWHERE).first_contact(q) is None


def test_walls_and_boxes_are_named_and_met_where_they_stand():
    urdf = robot(
        link("base"),
        link("arm", '<sphere radius="0.1"/>', at="1 0 0"),
        '<joint name="turn" type="continuous"><parent link="base"/><child link="arm"/>'
        '<axis xyz="0 0 1"/></joint>',
    )
    q = np.linspace(0.0, np.pi, 1801)[:, None]  # 0.1 degrees each
    wall = Workspace(floor=None, walls=(Wall((0.0, -2.0, 0.0), -1.6),), margin=0.0)  # y <= 0.8
    contact = CollisionChecker(urdf, wall).first_contact(q)
    assert (contact.first, contact.second) == ("arm", "wall 0")
    assert np.sin(q[contact.sample, 0]) == pytest.approx(0.7, abs=2e-3)

    box = Workspace(floor=None, boxes=(Box((-2.0, -1.0, -1.0), (-0.5, 1.0, 1.0)),), margin=0.05)
    contact = CollisionChecker(urdf, box).first_contact(q)
    assert (contact.first, contact.second) == ("arm", "box 0")
    assert np.cos(q[contact.sample, 0]) == pytest.approx(-0.5 + 0.15, abs=2e-3)


def test_the_arm_at_rest_above_its_own_floor_is_clear():
    home = np.array([[0.0, -np.pi / 2, np.pi / 2, 0.0, np.pi / 2, 0.0]])
    assert checkers(0.05).first_contact(home) is None


def test_every_pair_that_can_meet_is_looked_at():
    pairs = {frozenset(pair) for pair in checkers(0.05).pairs}
    links = ["base_link", *(f"link_{k}" for k in range(1, 7))]
    for (i, a), (k, b) in combinations(enumerate(links), 2):
        assert (frozenset((a, b)) in pairs) == (k - i > 1), (a, b)
    for name in links[1:]:
        assert frozenset((name, "floor")) in pairs
    assert frozenset(("base_link", "floor")) not in pairs


def test_a_wrist_that_always_overlaps_is_left_out_but_never_a_farther_pair():
    wrist = CollisionChecker(ball_chain(0.08, 0.01, 0.2), NOWHERE)
    assert ("link_0", "link_2") not in wrist.pairs
    # Four joints between base and tip: always touching is a fault, and is reported as one.
    far = CollisionChecker(ball_chain(0.3, 0.0, 0.0, 0.4), NOWHERE)
    contact = far.first_contact(np.zeros((1, 4)))
    assert contact is not None
    assert (contact.first, contact.second, contact.sample) == ("link_0", "link_3", 0)
    assert contact.distance < 0.0


def test_a_wider_margin_checks_no_fewer_pairs():
    pairs = [CollisionChecker(urdf_text(), Workspace(margin=m)).pairs for m in (0.05, 0.2, 0.5)]
    assert pairs[0] == pairs[1] == pairs[2]


def test_a_mesh_counts_as_its_convex_hull(tmp_path):
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * 0.2 - 0.1
    facets = [
        (0, 2, 1), (1, 2, 3), (4, 5, 6), (5, 7, 6), (0, 1, 4), (1, 5, 4),
        (2, 6, 3), (3, 6, 7), (0, 4, 2), (2, 4, 6), (1, 3, 5), (3, 7, 5),
    ]  # fmt: skip
    lines = ["solid cube"]
    for facet in facets:
        lines += ["facet normal 0 0 0", "outer loop"]
        lines += [f"vertex {' '.join(map(str, corners[k]))}" for k in facet]
        lines += ["endloop", "endfacet"]
    folder = tmp_path / "cell" / "meshes"
    folder.mkdir(parents=True)
    (folder / "cube.stl").write_text("\n".join([*lines, "endsolid cube"]))

    def cell(shape):
        return robot(link("base"), link("tip", shape), joint(1, "base", "tip", "0 0 1"))

    workspace = Workspace(floor=-0.15, margin=0.0)
    meshed = CollisionChecker(
        cell('<mesh filename="package://cell/meshes/cube.stl"/>'),
        workspace,
        mesh_folders=[str(tmp_path)],
    )
    boxed = CollisionChecker(cell('<box size="0.2 0.2 0.2"/>'), workspace)
    q = np.linspace(-2.0, 2.0, 9)[:, None]
    for k in range(len(q)):
        distances = [
            checker._distance(*checker._pairs[0], checker._paths(q), k)
            for checker in (meshed, boxed)
        ]
        assert distances[0] == pytest.approx(distances[1], abs=1e-6)


@pytest.mark.parametrize(
    "shape", ['<mesh filename="package://nowhere/part.stl"/>', ""], ids=["no mesh", "no shape"]
)
def test_a_description_without_usable_shapes_is_refused(shape):
    urdf = robot(link("base"), link("tip", shape), joint(1, "base", "tip", "0 0 1"))
    with pytest.raises(CollisionModelError):
        CollisionChecker(urdf, Workspace())


def test_postures_of_another_arm_are_refused():
    with pytest.raises(ShapeError):
        checkers(0.05).first_contact(np.zeros((3, 5)))


@pytest.mark.parametrize(
    "build",
    [
        lambda: Workspace(margin=-0.01),
        lambda: Workspace(margin=np.nan),
        lambda: Workspace(floor=np.inf),
        lambda: Wall((0.0, 0.0, 0.0), 1.0),
        lambda: Wall((1.0, 0.0, 0.0), np.nan),
        lambda: Box((0.0, 0.0, 0.0), (1.0, 0.0, 1.0)),
    ],
)
def test_obstacles_that_mean_nothing_are_refused(build):
    with pytest.raises(WorkspaceError):
        build()
