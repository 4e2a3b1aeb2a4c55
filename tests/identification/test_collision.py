import gc
import struct
import time
from dataclasses import replace
from itertools import combinations, pairwise

import coal
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from identification import ShapeError
from identification.excitation import Box, CollisionChecker, Workspace
from identification.excitation.collision_bodies import link_bodies
from identification.excitation.collision_messages import unchecked_text
from planner import FourierSeries, JointLimits, PiecewiseCubic, plan
from sim_fixtures.ns16 import urdf_text
from tests.hil.simulated_logs import urdf_path
from tests.identification.robots import joint, link, robot

TILTED = "0.1 -0.3 0.7"
NOWHERE = Workspace(floor=None, margin=0.0)


def ball_chain(*radii):
    """Balls 0.1 m apart, one per joint; radius 0 for a link without shape."""
    parts = [link("base")]
    for k, radius in enumerate(radii):
        shape = f'<sphere radius="{radius}"/>' if radius else ""
        parts.append(link(f"link_{k}", shape))
        parent = f"link_{k - 1}" if k else "base"
        parts.append(joint(f"joint_{k}", parent, f"link_{k}", at="0.1 0 0", rpy=TILTED))
    return robot(*parts)


@pytest.fixture(scope="module")
def arm():
    return pin.buildModelFromXML(urdf_text())


def postures(model, seed, count):
    random = np.random.default_rng(seed)
    return random.uniform(model.lowerPositionLimit, model.upperPositionLimit, (count, model.nq))


@pytest.fixture(scope="module")
def brute(arm):
    """Smallest distance of all pairs that may touch, floor included, by posture."""
    shapes = pin.buildGeomFromUrdfString(arm, urdf_text(), pin.GeometryType.COLLISION)
    floor = pin.GeometryObject(
        "floor", 0, pin.SE3.Identity(), coal.Halfspace(np.array([0.0, 0.0, 1.0]), 0.0)
    )
    ground = shapes.addGeometryObject(floor)
    for a, b in combinations(range(shapes.ngeoms), 2):
        joints = [shapes.geometryObjects[k].parentJoint for k in (a, b)]
        if abs(joints[0] - joints[1]) > (0 if b == ground else 1):
            shapes.addCollisionPair(pin.CollisionPair(a, b))
    data = arm.createData()
    places = pin.GeometryData(shapes)

    def least(q):
        distances = []
        for row in q:
            pin.computeDistances(arm, data, shapes, places, row)
            distances.append(min(result.min_distance for result in places.distanceResults))
        return np.array(distances)

    return least


def checkers(margin, made={}):  # noqa: B006 - the cache is the point
    if margin not in made:
        made[margin] = CollisionChecker(urdf_text(), Workspace(margin=margin))
    return made[margin]


def mixed_shapes():
    """An arm with all kinds of shapes and joints among all kinds of obstacles."""
    urdf = robot(
        link("base", '<box size="0.3 0.2 0.1"/>'),
        link("a", '<cylinder radius="0.05" length="0.3"/>', at="0.1 0.2 0"),
        link("b", '<cylinder radius="0.04" length="0.2"/>', at="0 0.1 0.1"),
        link("c", '<box size="0.1 0.2 0.3"/>', at="0.2 0 0"),
        link("tool", '<sphere radius="0.05"/>', at="0 0 0.3"),
        joint("joint_1", "base", "a", "0 0 1", at="0 0 0.3", rpy=TILTED),
        joint("joint_2", "a", "b", "0 0.6 0.8", kind="prismatic", at="0.2 0.3 0.1", rpy=TILTED),
        joint("joint_3", "b", "c", "1 0 0", at="0.1 0 0.2", rpy=TILTED),
        joint("fixed", "c", "tool", kind="fixed"),
    )
    workspace = Workspace(floor=-0.4, boxes=(Box((0.4, 0.4, -0.2), (0.9, 0.7, 0.5)),), margin=0.02)
    return CollisionChecker(urdf, workspace)


def short_motion(seed):
    """A quick motion of some seconds about the middle of the range, as the arm can run it."""
    random = np.random.default_rng(seed)
    middle = np.array([0.0, -1.2, 2.0, 0.0, 0.0, 0.0])
    via = middle + random.uniform(-1.0, 1.0, (4, 6)) * [2.0, 1.1, 1.5, 3.0, 2.0, 3.0]
    return plan(via, FAST, fly=0.5)


def short_sines(seed):
    """Sines for some seconds about the middle of the range."""
    random = np.random.default_rng(seed)
    size = np.array([1.5, 0.6, 1.0, 2.0, 1.2, 2.0])[:, None] / 3.0
    return FourierSeries(
        offset=np.array([0.0, -1.2, 2.0, 0.0, 0.0, 0.0]),
        amplitude=size * random.uniform(-1.0, 1.0, (6, 3)),
        frequency=random.uniform(0.5, 3.0, (6, 3)),
        length=3.0,
        ramp=0.5,
    )


FAST = JointLimits(
    [-3.2, -2.5, -0.4, -6.3, -2.1, -6.3],
    [3.2, 0.1, 4.6, 6.3, 2.1, 6.3],
    [2.7, 2.7, 3.0, 6.3, 6.1, 9.6],
    [9.0, 9.0, 9.9, 21.0, 20.4, 32.0],
    [90.0, 90.0, 99.0, 210.0, 204.0, 320.0],
)


def ball_on_a_turntable(radius):
    """A ball at 1 m from a vertical axis."""
    return robot(
        link("base"),
        link("arm", f'<sphere radius="{radius}"/>', at="1 0 0"),
        joint("turn", "base", "arm", kind="continuous"),
    )


def violent_sines(size, pace, ramp):
    return FourierSeries(
        offset=np.array([0.0, -1.2, 2.0, 0.0, 0.0, 0.0]),
        amplitude=np.full((6, 2), size),
        frequency=np.array([[pace, 1.3 * pace]] * 6),
        length=5.0,
        ramp=ramp,
    )


def violent_pieces(jerk):
    random = np.random.default_rng(3)
    scale = [1.0, 3.0, 9.0, jerk]
    table = np.array([random.uniform(-1.0, 1.0, (500, 4)) * scale for _ in range(6)])
    return PiecewiseCubic(tuple(np.linspace(0.0, 5.0, 501) for _ in range(6)), tuple(table))


class TestMotions:
    @given(
        seed=st.integers(0, 10**6),
        kind=st.sampled_from([short_motion, short_sines]),
        beyond=st.sampled_from([-3e-3, -1e-4, 1e-4, 3e-3]),
    )
    @settings(max_examples=20, deadline=None)
    def test_they_are_clear_if_and_only_if_every_instant_is(self, brute, seed, kind, beyond):
        # The margin is close to the smallest distance.
        motion = kind(seed)
        time = np.linspace(0.0, motion.duration, int(motion.duration / 0.008) + 2)
        coarse = brute(motion.sample(time)[0])
        around = time[np.argmin(coarse)] + np.linspace(-0.008, 0.008, 161)
        least = min(coarse.min(), brute(motion.sample(around)[0]).min())
        checker = CollisionChecker(urdf_text(), Workspace(margin=max(least + beyond, 0.0)))
        contact = checker.deepest_along(motion)
        if least + beyond <= 0.0 and least > 0.0:
            return  # the margin was cut off at zero
        assert (contact is not None) == (beyond > 0.0 or least < 0.0)
        if contact is not None:
            assert contact.distance < checker.workspace.margin
            np.testing.assert_allclose(
                contact.posture, motion.sample_one(contact.time)[0], atol=1e-12
            )
            there = brute(np.array([contact.posture]))[0]
            assert contact.distance == pytest.approx(there, abs=1e-5)
            assert contact.distance <= least + 0.025

    def test_short_contacts_are_found(self):
        # A ball on an arm of 1 m sweeps past a post of 2 cm in a hundredth of a second.
        urdf = ball_on_a_turntable(0.01)
        limits = JointLimits([-4.0], [4.0], [4.0], [20.0], [200.0])
        motion = plan([[-1.5], [1.63]], limits)
        post = Box((0.99, -0.001, -1.0), (1.01, 0.001, 1.0))
        aside = Box((1.0102, -0.001, -1.0), (1.02, 0.001, 1.0))  # 0.2 mm beside the path
        contact, none = (
            CollisionChecker(urdf, replace(NOWHERE, boxes=(box,))).deepest_along(motion)
            for box in (post, aside)
        )
        assert (contact.first, contact.second) == ("arm", "box 0")
        assert abs(np.sin(contact.posture[0])) < 0.011
        assert none is None

    @pytest.mark.parametrize("touches", [True, False])
    def test_a_reversal_is_found(self, touches):
        """The ball touches the wall, or nearly, at one instant."""
        motion = FourierSeries([0.0], [[0.5]], [[2.0 * np.pi]], length=3.0, ramp=0.5)
        nearest = np.sin(0.5) + 0.01  # y at 1.25 s
        wall = Box((0.8, nearest + (-0.01 if touches else 0.001), -1.0), (1.2, 1.0, 1.0))
        checker = CollisionChecker(ball_on_a_turntable(0.01), replace(NOWHERE, boxes=(wall,)))
        contact = checker.deepest_along(motion)
        assert (contact is not None) == touches

    @pytest.mark.parametrize(
        "motion",
        [
            *(violent_sines(0.2, 3.0, ramp) for ramp in (0.0, 1e-9, 1e-3)),
            violent_sines(3.0, 50.0, 2.5),
            violent_pieces(1e9),
        ],
    )
    def test_violent_ones_are_checked_quickly(self, motion):
        began = time.process_time()
        checkers(0.05).deepest_along(motion)
        assert time.process_time() - began < 3.0


class TestDistances:
    @pytest.mark.long
    def test_shapes_are_freed(self, arm):
        def living():
            gc.collect()
            return sum(isinstance(thing, pin.GeometryModel) for thing in gc.get_objects())

        before = living()
        for _ in range(5):
            assert link_bodies(arm, urdf_text(), [])
        assert living() == before

    @given(seed=st.integers(0, 10**6), margin=st.sampled_from([0.0, 0.05, 0.15]))
    @settings(max_examples=20)
    def test_the_deepest_contact_agrees_with_brute_force(self, arm, brute, seed, margin):
        ends = np.concatenate((np.zeros((1, 6)), postures(arm, seed, 3)))
        q = np.concatenate([np.linspace(a, b, 60) for a, b in pairwise(ends)])
        distances = brute(q)
        contact = checkers(margin).deepest_contact(q)
        certain = np.abs(distances - margin) > 1e-5
        clear = checkers(margin).clear(q)
        np.testing.assert_array_equal(clear[certain], (distances >= margin)[certain])
        paths = np.arange(len(q)) // 60
        of_paths = [clear[paths == path].all() for path in range(3)]
        assert checkers(margin).clear(q, paths).tolist() == of_paths
        if distances.min() >= margin:
            assert contact is None
        else:
            assert contact.distance == pytest.approx(distances[contact.sample], abs=1e-5)
            assert contact.distance <= min(distances.min() + 0.00501, margin)

    @given(st.integers(0, 10**6))
    @settings(max_examples=10)
    def test_bounds_do_not_exceed_distances(self, arm, seed):
        scene = mixed_shapes()
        path = scene.path(np.random.default_rng(seed).uniform(-2.0, 2.0, (30, 3)))
        count = len(scene.separation.first)
        pair, sample = np.indices((count, 30)).reshape(2, -1)
        lower = scene.separation.bound(path.bodies, pair, sample)
        distance = np.array(
            [
                scene.distance(p, path, k)
                for p, k in zip(pair.tolist(), sample.tolist(), strict=True)
            ]
        )
        assert np.all(lower <= distance + 1e-5)
        exact = scene.separation.exact[pair]
        np.testing.assert_allclose(lower[exact], distance[exact], atol=1e-9)
        assert np.any(exact)

    @given(st.integers(0, 10**6), st.sampled_from([1.0, 0.1, 0.01]))
    @settings(max_examples=20)
    def test_reaches_bound_the_change_of_every_distance(self, seed, size):
        scene = mixed_shapes()
        q = np.random.default_rng(seed).uniform(-2.0, 2.0, (2, 3))
        q[1] = q[0] + size * (q[1] - q[0])
        path = scene.path(q)
        change = scene.reaches(np.abs(q).max(axis=0)) @ np.abs(q[1] - q[0])
        for pair in range(len(scene.separation.first)):
            before, after = (scene.distance(pair, path, k) for k in range(2))
            assert abs(after - before) <= change[pair] + 1e-5

    def test_a_mesh_counts_as_its_convex_hull(self, tmp_path):
        corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * 0.2 - 0.1
        triangles = corners[ConvexHull(corners).simplices].astype("<f4")
        facets = [b"\0" * 12 + triangle.tobytes() + b"\0\0" for triangle in triangles]
        folder = tmp_path / "cell" / "meshes"
        folder.mkdir(parents=True)
        binary = b"\0" * 80 + struct.pack("<I", len(facets)) + b"".join(facets)
        (folder / "cube.stl").write_bytes(binary)

        def cell(shape):
            return robot(
                link("base"),
                link("tip", shape),
                joint("joint_1", "base", "tip", "0 0 1", rpy=TILTED),
            )

        workspace = Workspace(floor=-0.15, margin=0.0)
        meshed = CollisionChecker(
            cell('<mesh filename="package://cell/meshes/cube.stl"/>'),
            workspace,
            mesh_folders=[str(tmp_path)],
        )
        boxed = CollisionChecker(cell('<box size="0.2 0.2 0.2"/>'), workspace)
        q = np.linspace(-2.0, 2.0, 9)[:, None]
        for k in range(len(q)):
            distances = [checker.distance(0, checker.path(q), k) for checker in (meshed, boxed)]
            assert distances[0] == pytest.approx(distances[1], abs=1e-6)


class TestInvalidInput:
    def test_limits_and_postures_of_another_arm_are_refused(self):
        with pytest.raises(ShapeError):
            checkers(0.05).deepest_contact(np.zeros((3, 5)))
        with pytest.raises(ShapeError, match="limits"):
            CollisionChecker(ball_chain(0.05, 0.05), NOWHERE, limits=FAST)

        q = np.zeros((3, 6))
        q[1, 4] = np.nan
        for check in (checkers(0.05).clear, checkers(0.05).deepest_contact):
            with pytest.raises(ValueError, match="finite"):
                check(q)


class TestPairs:
    """Pairs that can touch are checked; those that touch in every posture are named."""

    def test_all_pairs_that_can_touch_are_checked(self):
        pairs = {frozenset(pair) for pair in checkers(0.05).pairs}
        links = ["base_link", *(f"link_{k}" for k in range(1, 7))]
        for (i, a), (k, b) in combinations(enumerate(links), 2):
            assert (frozenset((a, b)) in pairs) == (k - i > 1), (a, b)
        for name in links[1:]:
            assert frozenset((name, "floor")) in pairs
        assert frozenset(("base_link", "floor")) not in pairs
        for wider in (0.2, 0.5):
            assert checkers(wider).pairs == checkers(0.05).pairs

    def test_only_close_pairs_of_a_wrist_are_unchecked(self):
        wrist = CollisionChecker(ball_chain(0.08, 0.01, 0.2), NOWHERE)
        assert ("link_0", "link_2") not in wrist.pairs
        (pair,) = wrist.exceptions.unchecked
        assert (pair.first, pair.second) == ("link_0_0", "link_2_0")
        assert pair.nearest <= pair.farthest < 0.0
        assert "link_0_0 and link_2_0" in str(unchecked_text(wrist.exceptions))
        assert checkers(0.05).exceptions.unchecked == ()
        assert unchecked_text(checkers(0.05).exceptions) is None
        # Four joints between base and tip: permanent contact is reported.
        far = CollisionChecker(ball_chain(0.3, 0.0, 0.0, 0.4), NOWHERE)
        contact = far.deepest_contact(np.zeros((1, 4)))
        assert (contact.first, contact.second, contact.sample) == ("link_0", "link_3", 0)
        assert contact.distance < 0.0

    def test_a_pair_that_hardly_has_the_margin_must_have_less(self):
        """Its largest distance less 5 mm, as no motion could keep the margin."""
        urdf = ball_chain(0.08, 0.0, 0.1)
        _, most = CollisionChecker(urdf, NOWHERE).spread("link_0", "link_2")
        checker = CollisionChecker(urdf, Workspace(floor=None, margin=most - 0.001))
        assert (len(checker.exceptions.reduced), checker.exceptions.unchecked) == (1, ())
        assert "link_0_0 and link_2_0" in str(unchecked_text(checker.exceptions))
        q = np.random.default_rng(5).uniform(-np.pi, np.pi, (100, 3))
        distances = [checker.distance(0, checker.path(q), k) for k in range(len(q))]
        clear = np.array(distances) >= most - 0.005
        assert 10 < np.sum(clear) < 90
        assert checker.clear(q).tolist() == clear.tolist()
        contact = checker.deepest_contact(q)
        assert contact.required == pytest.approx(most - 0.005)
        assert contact.distance == pytest.approx(min(distances), abs=0.005)

    def test_missing_limits_leave_no_pair_unchecked(self):
        # Two arms of 0.6 m beyond a turntable; the first swings to and from a box in its way.
        rod = '<cylinder radius="0.05" length="0.5"/>'
        parts = [link("base")]
        for k in range(3):
            parent, at = ("base", "0 0 0.42") if k == 0 else (f"l{k - 1}", "0.6 0 0")
            parts += [
                link(f"l{k}", rod, at="0.3 0 0"),
                f'<joint name="j{k}" type="revolute"><parent link="{parent}"/><child link="l{k}"/>'
                f'<origin xyz="{at}"/><axis xyz="0 {int(k > 0)} {int(k == 0)}"/>'
                '<limit effort="1" velocity="1"/></joint>',
            ]
        urdf = robot(*parts)
        limits = JointLimits([-3.0] * 3, [3.0] * 3, [2.0] * 3, [10.0] * 3, [100.0] * 3)
        crate = Box((0.8, -0.2, 0.0), (0.95, 0.2, 0.33))
        workspace = Workspace(floor=None, boxes=(crate,))
        for in_use in (limits, None):
            checker = CollisionChecker(urdf, workspace, limits=in_use)
            assert ("l1", "box 0") in checker.pairs
            contact = checker.deepest_contact(np.array([[0.0, 0.3, -0.6]]))
            assert contact is not None and "box 0" in (contact.first, contact.second)

    @pytest.mark.parametrize(
        "workspace",
        [
            Workspace(floor=0.6),
            Workspace(floor=1e6),
            Workspace(floor=None, boxes=(Box((-9.0, -9.0, -9.0), (9.0, 9.0, 9.0)),)),
        ],
        ids=["floor above the foot", "floor above all", "box around all"],
    )
    def test_misplaced_obstacles_leave_no_moving_link_unchecked(self, arm, workspace):
        checker = CollisionChecker(urdf_text(), workspace, limits=FAST)
        with_obstacle = {first for first, second in checker.pairs if not second.startswith("link")}
        assert with_obstacle >= {f"link_{k}" for k in range(2, 7)}
        # The first link turns in it in all motions: reported, not checked.
        assert {pair.first[:6] for pair in checker.exceptions.unchecked} == {"link_1"}
        home = np.array([[0.0, -np.pi / 2, np.pi / 2, 0.0, np.pi / 2, 0.0]])
        contact = checker.deepest_contact(home)
        assert contact is not None and contact.first == "link_2"
        assert not np.any(checker.clear(postures(arm, 3, 200)))

    # It is in the floor in every posture: the ends of the rod now more, now less.
    @pytest.mark.parametrize("floor", [0.0, 0.4])
    def test_a_first_link_that_swings_towards_the_floor_is_checked(self, floor):
        rod = '<cylinder radius="0.05" length="0.6"/>'
        urdf = robot(
            link("base"), link("arm", rod), joint("joint_1", "base", "arm", "1 0 0", rpy=TILTED)
        )
        checker = CollisionChecker(urdf, Workspace(floor=floor))
        assert checker.pairs == (("arm", "floor"),)
        assert checker.exceptions.unchecked == ()

    def test_a_ur5_on_the_floor_is_checked_but_for_its_mounting(self):
        """Base and shoulder turn 3 cm above it, less than the margin, in every posture."""
        path = urdf_path("ur5_robot.urdf")
        checker = CollisionChecker(
            path.read_text(), Workspace(floor=0.0), mesh_folders=(str(path.parents[4]),)
        )
        near = {first for first, second in checker.pairs if second == "floor"}
        assert not near & {"base_link", "shoulder_link"}
        assert {"upper_arm_link", "forearm_link", "wrist_3_link"} <= near
        upright = np.array([0.0, -1.57, 0.0, -1.57, 0.0, 0.0])
        level = np.array([0.0, -0.05, 0.0, -1.57, 0.0, 0.0])
        bowed = np.array([0.0, 0.1, -0.6, -1.57, 0.0, 0.0])
        assert checker.clear(np.array([upright, level, bowed])).tolist() == [True, True, False]
        assert "upper_arm_link_0 and floor" in str(unchecked_text(checker.exceptions))
