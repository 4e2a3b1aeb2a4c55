"""The page of a designed motion: what it shows is what the robot is going to do."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from hil.arm import Arm, surface_points
from hil.cell import Cell
from hil.plots import save, style
from hil.plots.design_picture import POSTURES, draw_design
from hil.plots.posture_strip import Strip, covered, outlines
from identification.excitation import Design, information
from identification.excitation.constraints import sampled
from identification.excitation.criteria import Criteria
from identification.excitation.excitation import Excitation
from identification.excitation.searches.scores import Front
from identification.factor.factor import Factor
from planner import FourierSeries, Trajectory, plan
from sim_fixtures.ns16 import CELL_PATH

pin = pytest.importorskip("pinocchio")
coal = pytest.importorskip("coal")

TWO_LINK = Path(__file__).parents[1] / "identification" / "two_link.urdf"
TWO_LINK_CELL = """
[cell]
name = "two links"
urdf = "two_link.urdf"
[limits]
frame = "urdf"
lower_deg = [-150.0, -140.0]
upper_deg = [150.0, 140.0]
velocity_deg = [180.0, 200.0]
acceleration_deg = [600.0, 700.0]
jerk_deg = [6000.0, 7000.0]
[workspace]
floor = "none"
walls = [{ lower = [0.7, -0.3, -0.2], upper = [0.9, 0.3, 0.6] }]
"""
SHAPES = """
<robot name="shapes"><link name="base"/>
  <joint name="j" type="revolute"><parent link="base"/><child link="l"/>
    <axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
  <link name="l"><inertial><mass value="1"/>
    <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>
    <collision><origin xyz="0.3 -0.1 0.2" rpy="0.4 0.5 0.6"/><geometry>{}</geometry></collision>
  </link></robot>
"""


@pytest.fixture(scope="module")
def ns16() -> Cell:
    return Cell.load(CELL_PATH)


@pytest.fixture(scope="module")
def two_link() -> Cell:
    return Cell.from_texts(TWO_LINK_CELL, TWO_LINK.read_text(), Path("cell.toml"))


def excitation(cell: Cell, trajectory: Trajectory) -> Excitation:
    motion = sampled(trajectory)
    factor = Factor.from_samples(cell.model, motion, np.zeros_like(motion.position))
    criteria = Criteria.of_gram(information(factor), motion.n_samples)
    return Excitation(trajectory, criteria, "front", seed=1, tried=1, rejected={})


def design_of(cell: Cell, trajectory: Trajectory, chosen: int | None = 1) -> Design:
    """A design with three motions on its front, of which the second is chosen or polished."""
    found = excitation(cell, trajectory)
    measures = np.array([[100.0, 70.0], [105.7, 80.0], [108.0, 110.0]])
    return Design(
        genes=np.zeros(1),
        excitation=found,
        front=Front(np.zeros((3, 1)), measures, np.ones(3)),
        chosen=chosen,
        origin=1,
        origin_criteria=found.criteria,
        generations=1,
        complete=True,
        exhausted=False,
    )


def wandering(cell: Cell, points: int = 5) -> Trajectory:
    limits = cell.joint_limits
    middle, half = (limits.upper + limits.lower) / 2.0, (limits.upper - limits.lower) / 2.0
    random = np.random.default_rng(4)
    via = middle + 0.4 * half * random.uniform(-1.0, 1.0, (points, limits.n_joints))
    return plan(via, limits, fly=0.5)


def texts(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.findobj(Text)]


def axes_of(figure: Figure, xlabel: str) -> Axes:
    (axes,) = (axes for axes in figure.axes if axes.get_xlabel().startswith(xlabel))
    return axes


class TestSilhouettes:
    @given(st.integers(0, 1000))
    def test_an_outline_is_the_convex_hull_but_for_little(self, seed):
        points = np.random.default_rng(seed).normal(size=(1, 40, 2))
        hull = ConvexHull(points[0])
        x, y = outlines(points)[0].T
        area = 0.5 * np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))
        assert 0.98 * hull.volume < area <= hull.volume * (1.0 + 1e-12)

    def test_a_body_sweeps_all_between_two_samples(self):
        square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
        body = np.stack((square, square + np.array([5.0, 0.0])))
        grid = covered([body], np.array([[-1.0, 7.0], [-1.0, 3.0]]), 801)
        assert grid.mean() == pytest.approx(6.0 / 32.0, rel=0.02)
        assert grid[150, 400] == 1.0  # half way, where the body is at no sample
        assert grid[50, 400] == grid[350, 400] == 0.0


class TestArm:
    @pytest.mark.parametrize(
        ("shape", "volume"),
        [
            (coal.Box(0.2, 0.3, 0.4), 0.024),
            (coal.Sphere(0.2), 4.0 / 3.0 * np.pi * 0.2**3),
            (coal.Cylinder(0.2, 0.5), np.pi * 0.2**2 * 0.5),
            (coal.Capsule(0.1, 0.5), np.pi * (0.1**2 * 0.5 + 4.0 / 3.0 * 0.1**3)),
        ],
    )
    def test_a_polyhedron_inside_a_shape_fills_nearly_all_of_it(self, shape, volume):
        hull = ConvexHull(surface_points(shape))
        assert 0.93 * volume < hull.volume < 1.0001 * volume

    def test_shapes_are_placed_or_replaced_by_bars(self):
        (solid,) = Arm.from_urdf(SHAPES.format('<box size="0.2 0.3 0.4"/>')).solids
        np.testing.assert_allclose(solid.vertices.mean(axis=0), [0.3, -0.1, 0.2], atol=1e-12)
        turned = Rotation.from_euler("xyz", [0.4, 0.5, 0.6])  # fixed axes, as URDF has it
        corner = turned.apply([0.1, 0.15, 0.2]) + np.array([0.3, -0.1, 0.2])
        assert np.min(np.linalg.norm(solid.vertices - corner, axis=1)) < 1e-9
        lost = Arm.from_urdf(SHAPES.format('<mesh filename="package://nowhere/link.stl"/>'))
        assert not lost.has_shapes
        arm = Arm.from_urdf(TWO_LINK.read_text())
        assert not arm.has_shapes
        np.testing.assert_allclose(
            arm.bones(np.zeros((1, 2)))[0],
            [[[0.0, 0.0, 0.5], [0.0, 0.0, 1.0]], [[0.0, 0.0, 1.0], [0.01, 0.0, 1.2]]],
            atol=1e-12,
        )

    @settings(max_examples=20)
    @given(st.integers(0, 1000))
    def test_bodies_move_as_pinocchio_moves_them(self, seed):
        urdf = Cell.load(CELL_PATH).urdf
        arm, model = Arm.from_urdf(urdf), pin.buildModelFromXML(urdf)
        data, q = model.createData(), np.random.default_rng(seed).uniform(-3.0, 3.0, 6)
        pin.framesForwardKinematics(model, data, q)
        flange = data.oMf[model.getFrameId("flange")].translation
        np.testing.assert_allclose(arm.tips(q[None])[0], flange, atol=1e-12)
        for solid, corners in zip(arm.solids, arm.corners(q[None]), strict=True):
            pose = data.oMi[solid.joint + 1]
            expected = solid.vertices @ pose.rotation.T + pose.translation
            np.testing.assert_allclose(corners[0], expected, atol=1e-12)


class TestStrip:
    def test_it_contains_the_swept_volume_and_near_obstacles(self, ns16, two_link):
        motion = wandering(ns16)
        strip = Strip.of(Arm.from_urdf(ns16.urdf), motion, ns16.workspace, 7)
        fine = Arm.from_urdf(ns16.urdf).corners(
            motion.sample(np.arange(0, motion.duration, 0.01))[0]
        )
        for axis in range(3):
            low, high = strip.extents[axis]
            assert all(low < c[..., axis].min() and c[..., axis].max() < high for c in fine)
        assert strip.extents[2][0] < ns16.workspace.floor
        arm, motion = Arm.from_urdf(two_link.urdf), wandering(two_link)
        near = Strip.of(arm, motion, two_link.workspace, 5).extents
        assert near[0][1] > 0.7
        far_away = TWO_LINK_CELL.replace("0.7, -0.3", "7.7, -0.3").replace("0.9, 0.3", "8.9, 0.3")
        far = Cell.from_texts(far_away, two_link.urdf, Path("cell.toml"))
        assert Strip.of(arm, motion, far.workspace, 5).extents[0][1] < 3.0


class TestPage:
    def test_a_design_of_an_industrial_arm(self, ns16):
        """Correlations of its motion without friction; positions in angles of the cell."""
        design = design_of(ns16, wandering(ns16))
        figure = draw_design(design, ns16)
        (image,) = axes_of(figure, "parameters").images
        motion = sampled(design.excitation.trajectory, 0.001)
        factor = Factor.from_samples(ns16.model, motion, np.zeros_like(motion.position))
        inverse = np.linalg.inv(information(factor))
        deviation = np.sqrt(np.diag(inverse))
        expected = np.abs(inverse / np.outer(deviation, deviation))[:40, :40]
        np.testing.assert_allclose(np.asarray(image.get_array()), expected, atol=1e-5)
        (position,) = (a for a in figure.axes if a.get_ylabel() == "joint_2")
        assert position.get_yticks() == pytest.approx([-50.0, 0.0, 95.0])  # as in the file
        assert "position [deg, controller angles]" in texts(figure)
        equal = [axes for axes in figure.axes if axes.get_aspect() == 1.0 and not axes.images]
        assert len(equal) == 2 * POSTURES  # each from the side and from above

    def test_motions_on_the_front_are_labelled_with_their_criteria(self, two_link):
        design = design_of(two_link, wandering(two_link))
        references = {"A": (104.0, 90.5), "B (kinematic)": (20.0, 400.0)}
        figure = draw_design(design, two_link, references=references)
        labels = "chosen (105.7, 80.0)", "A (104.0, 90.5)", "B (kinematic) (20.0, 400.0)"
        assert set(labels) <= set(texts(figure))
        axes = axes_of(figure, "coupling index")
        assert axes.get_xlim()[1] < 120.0 and axes.get_ylim()[0] > 95.0  # B does not flatten it
        figure = draw_design(replace(design, chosen=None), two_link)
        log10_det, index = design.excitation.criteria.measures
        assert f"chosen, polished ({log10_det:.1f}, {index:.1f})" in texts(figure)
        assert "grew from (105.7, 80.0)" in texts(figure)
        axes = axes_of(figure, "coupling index")
        star = next(line for line in axes.lines if line.get_marker() == "*")
        assert (star.get_xdata(), star.get_ydata()) == (index, log10_det)

    def test_warnings_are_red(self, two_link):
        design = replace(design_of(two_link, wandering(two_link)), complete=False)
        page = draw_design(design, two_link, unchecked=("floor", "walls"), together=True)
        red = [text.get_text() for text in page.texts if text.get_color() == style.LIMIT]
        assert red == [
            "NOT CHECKED: floor, walls; not for a robot",
            "search interrupted: better motions may exist",
        ]
        assert "with earlier archives, not comparable" in " ".join(t.get_text() for t in page.texts)
        margins = "current at most 71 % (motor of joint_2)"
        page = draw_design(replace(design, complete=True), two_link, margins=margins)
        assert not [text for text in page.texts if text.get_color() == style.LIMIT]
        assert margins in texts(page)

    def test_one_motion_gives_the_same_bytes(self, two_link, tmp_path):
        frequency = np.array([[1.0, 2.0], [1.3, 2.9]])
        bare = FourierSeries(np.zeros(2), np.full((2, 2), 0.4), frequency, 6.0, 0.0)
        for motion in (wandering(two_link), bare):
            for name in ("a.png", "b.png"):
                save(draw_design(design_of(two_link, motion), two_link), tmp_path / name)
            assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


# The arm as it is drawn.


SHAPE = '<collision><geometry><box size="0.3 0.1 0.1"/></geometry></collision>'
URDF = (
    f'<robot name="r"><link name="base"/><link name="upper">{SHAPE}{SHAPE}</link>'
    '<joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/>'
    '<axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>'
)


@pytest.mark.parametrize(
    ("old", "new"),
    [("<collision>", '<collision><origin xyz="0 0 1e300"/>'), ("0.3 0.1", "0.3 1e308")],
)
def test_shapes_beyond_every_robot_are_left_out(old: str, new: str) -> None:
    arm = Arm.from_urdf(URDF.replace(old, new, 1))
    assert len(Arm.from_urdf(URDF).solids) == 2
    assert len(arm.solids) == 1
    assert np.isfinite(arm.tips(np.zeros((1, 1)))).all()


def test_an_arm_that_is_a_point_ends_there() -> None:
    arm = Arm.from_urdf(URDF.replace("0.3 0.1 0.1", "0 0 0"))
    assert arm.tip.tolist() == [0.0, 0.0, 0.0]
