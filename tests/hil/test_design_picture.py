"""The page of a designed motion: what it shows is what the robot is going to do."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg, RendererAgg
from matplotlib.figure import Figure
from matplotlib.text import Text
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from hil.arm import Arm, surface_points
from hil.cell import Cell
from hil.plots import save, style
from hil.plots.design_picture import POSTURES, draw_design
from hil.plots.posture_strip import Strip, covered, draw_strip, outlines, posture_times
from identification.excitation import correlation, information
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


def front_of(log10_det: list[float], coupling_index: list[float]) -> Front:
    count = len(log10_det)
    measures = np.column_stack([log10_det, coupling_index])
    return Front(np.zeros((count, 1)), measures, np.ones(count))


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


def wandering(cell: Cell, points: int = 5) -> Trajectory:
    limits = cell.joint_limits
    middle, half = (limits.upper + limits.lower) / 2.0, (limits.upper - limits.lower) / 2.0
    random = np.random.default_rng(4)
    via = middle + 0.4 * half * random.uniform(-1.0, 1.0, (points, limits.n_joints))
    return plan(via, limits, fly=0.5)


def texts(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.findobj(Text)]


def laid_out(figure: Figure) -> RendererAgg:
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return canvas.get_renderer()


def front_axes(figure: Figure) -> list[Axes]:
    return [axes for axes in figure.axes if axes.get_xlabel().startswith("coupling index")]


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
            (coal.Cone(0.2, 0.5), np.pi * 0.2**2 * 0.5 / 3.0),
            (coal.Capsule(0.1, 0.5), np.pi * (0.1**2 * 0.5 + 4.0 / 3.0 * 0.1**3)),
            (coal.Ellipsoid(0.1, 0.2, 0.3), 4.0 / 3.0 * np.pi * 0.1 * 0.2 * 0.3),
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


class TestPostures:
    def test_a_closed_motion_does_not_show_its_beginning_twice(self, ns16):
        away = ns16.home + 0.3
        there = plan(np.array([ns16.home, away]), ns16.joint_limits)
        back = plan(np.array([ns16.home, away, ns16.home]), ns16.joint_limits)
        assert posture_times(there, 5)[-1] == there.duration
        times = posture_times(back, 5)
        assert times[-1] < back.duration
        np.testing.assert_allclose(np.diff(times), back.duration / 5.0)

    def test_the_strip_shows_all_that_the_arm_does(self, ns16, two_link):
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

    def test_a_motion_of_an_instant_has_a_picture(self, ns16):
        points = np.array([ns16.home, ns16.home + 1e-4])
        motion = plan(points, ns16.joint_limits)
        strip = Strip.of(Arm.from_urdf(ns16.urdf), motion, ns16.workspace, 7)
        draw_strip(Figure().subplots(2, 7).tolist(), strip)


class TestCorrelations:
    def test_the_matrix_is_that_of_the_motion_without_friction(self, ns16):
        designed = excitation(ns16, wandering(ns16))
        figure = draw_design(designed, ns16)
        shown = np.asarray(
            next(a for a in figure.axes if a.get_xlabel().startswith("parameters"))
            .images[0]
            .get_array()
        )
        motion = sampled(designed.trajectory, 0.001)
        factor = Factor.from_samples(ns16.model, motion, np.zeros_like(motion.position))
        inverse = np.linalg.inv(information(factor))
        deviation = np.sqrt(np.diag(inverse))
        expected = np.abs(inverse / np.outer(deviation, deviation))[:40, :40]
        assert shown.shape == (40, 40)
        np.testing.assert_allclose(shown, expected, atol=1e-5)
        assert np.all(np.isfinite(correlation(information(factor))))

    def test_parameters_without_excitation_are_reported(self, ns16):
        still = plan(np.array([ns16.home, ns16.home + 0.4 * np.eye(6)[0]]), ns16.joint_limits)
        figure = draw_design(excitation(ns16, still), ns16)
        shown = " ".join(texts(figure))
        assert "does not excite a parameter" in shown
        assert "I_c ∞" in shown
        assert "nan" not in shown


class TestFront:
    def page(self, cell: Cell, front: Front, **options) -> tuple[Figure, Axes]:
        figure = draw_design(excitation(cell, wandering(cell)), cell, front=front, **options)
        (axes,) = front_axes(figure)
        return figure, axes

    @pytest.mark.parametrize("count", [0, 1, 2, 60])
    def test_any_number_of_motions(self, two_link, count):
        share = np.linspace(0.0, 1.0, count)
        front = front_of((100.0 + 8.0 * np.sqrt(share)).tolist(), (70.0 + 40.0 * share**2).tolist())
        _, axes = self.page(two_link, front, chosen=count // 2 if count else None)
        points = [line for line in axes.lines if line.get_label().startswith("front")]
        assert [len(line.get_xdata()) for line in points] == ([count] if count > 1 else [])

    def test_motions_on_the_page_carry_their_figures(self, two_link):
        front = front_of([100.0, 105.7, 108.0], [70.0, 80.0, 110.0])
        others = {"A": (104.0, 90.5), "B (kinematic)": (101.2, 80.9), "C": (20.0, 400.0)}
        figure, axes = self.page(two_link, front, chosen=1, references=others)
        shown = texts(figure)
        for label in (
            "chosen (105.7, 80.0)",
            "A (104.0, 90.5)",
            "B (kinematic) (101.2, 80.9)",
            "C (20.0, 400.0)",
        ):
            assert label in shown
        assert "polished" not in " ".join(shown)
        assert axes.get_xlim()[1] < 120.0 and axes.get_ylim()[0] > 95.0  # C does not flatten it
        assert not front_axes(draw_design(excitation(two_link, wandering(two_link)), two_link))
        criteria = excitation(two_link, wandering(two_link)).criteria
        determinant, index = criteria.log10_det, criteria.coupling_index
        front = front_of([determinant - 3.0, determinant - 1.0], [index + 1.0, index + 3.0])
        knee = (determinant - 1.0, index + 3.0)
        figure, axes = self.page(two_link, front, knee=knee)
        shown = " ".join(texts(figure))
        assert "chosen, polished (" in shown
        assert f"grew from ({knee[0]:.1f}, {knee[1]:.1f})" in shown
        star = next(line for line in axes.lines if line.get_marker() == "*")
        assert (star.get_xdata(), star.get_ydata()) == (index, determinant)

    def test_no_legend_lies_on_the_front(self, two_link, ns16):
        names = ("A", "B", "C", "balanced", "an older one with a long name", "E")
        references = {name: (101.0 + k, 90.0) for k, name in enumerate(names)}
        front = front_of(np.linspace(100.0, 103.0, 60), np.linspace(70.0, 90.0, 60))
        for cell in (two_link, ns16):
            figure, axes = self.page(cell, front, chosen=20, references=references)
            renderer = laid_out(figure)
            legend = axes.get_legend().get_window_extent(renderer)
            matrix = next(a for a in figure.axes if a.get_xlabel().startswith("parameters"))
            assert not legend.overlaps(axes.get_window_extent(renderer))
            assert not legend.overlaps(matrix.get_tightbbox(renderer))
            assert legend.x1 < figure.bbox.x1

    def test_earlier_archives_are_labelled_apart_from_the_motion(self, two_link):
        front = front_of([100.0, 105.0], [70.0, 95.0])
        figure, axes = self.page(two_link, front, chosen=0, together=True)
        head = figure.texts[0].get_text()
        assert "including earlier archives, weighted" in head
        assert "I_c" not in head
        assert "not comparable" in figure.texts[1].get_text()
        assert "including earlier archives, weighted" in axes.get_xlabel()
        assert "including earlier archives" in axes.get_ylabel()
        assert "from this motion alone" in " ".join(texts(figure))


class TestPage:
    def test_positions_have_the_limits_and_angles_of_the_cell(self, ns16):
        figure = draw_design(excitation(ns16, wandering(ns16)), ns16)
        (position,) = (a for a in figure.axes if a.get_ylabel() == "joint_2")
        assert position.get_yticks() == pytest.approx([-50.0, 0.0, 95.0])  # as in the file
        assert "position [deg, controller angles]" in texts(figure)
        equal = [axes for axes in figure.axes if axes.get_aspect() == 1.0 and not axes.images]
        assert len(equal) == 2 * POSTURES  # each from the side and from above

    def test_names_of_joints_do_not_run_into_each_other(self, two_link):
        long = two_link.urdf.replace('name="shoulder"', 'name="shoulder_pan_and_lift_joint_1"')
        long = long.replace('name="elbow"', 'name="shoulder_pan_and_lift_joint_2"')
        assert long != two_link.urdf
        cell = Cell.from_texts(TWO_LINK_CELL, long, Path("cell.toml"))
        figure = draw_design(excitation(cell, wandering(cell)), cell)
        renderer = laid_out(figure)
        for axes in figure.axes:
            if axes.get_ylabel().startswith("shoulder"):
                label, own = axes.yaxis.label.get_window_extent(renderer), axes.bbox
                assert label.height < own.height * 1.05
                assert label.x0 > 0.0

    def test_what_was_not_checked_stands_in_red(self, two_link):
        designed = excitation(two_link, wandering(two_link))
        unchecked = ("floor", "walls", "the arm itself")
        page = draw_design(designed, two_link, unchecked=unchecked, complete=False)
        red = [text.get_text() for text in page.texts if text.get_color() == style.LIMIT]
        assert red == [
            "NOT CHECKED: floor, walls, the arm itself; not for a robot",
            "search interrupted: better motions may exist",
        ]
        margins = "current at most 71 % (motor of joint_2)"
        calm = draw_design(designed, two_link, margins=margins)
        assert not [text for text in calm.texts if text.get_color() == style.LIMIT]
        assert margins in texts(calm)
        assert "bars from joint to joint" in " ".join(texts(calm))  # its shapes are not known

    def test_the_same_motion_gives_the_same_bytes(self, two_link, tmp_path):
        frequency = np.array([[1.0, 2.0], [1.3, 2.9]])
        bare = FourierSeries(np.zeros(2), np.full((2, 2), 0.4), frequency, 6.0, 0.0)
        for motion in (wandering(two_link), bare):
            for name in ("a.png", "b.png"):
                figure = draw_design(excitation(two_link, motion), two_link, title="twice")
                save(figure, tmp_path / name)
            assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()

    @pytest.mark.parametrize("full", [False, True])
    @pytest.mark.parametrize("title", ["", "a $\\frac{title}{}$ <of> a person\n" * 3])
    def test_nothing_is_cut_and_no_text_lies_upon_another(self, ns16, title, full):
        nearest = "nearest 0.112 m (" + "a_link_with_a_long_name, " * 6 + "floor)"
        more = {
            "unchecked": ("floor", "walls", "the arm itself", "currents"),
            "complete": False,
            "together": True,
            "margins": f"current at most 71 % (motor of joint_2); {nearest}",
            "knee": (102.0, 70.0),
            "references": {"method B (kinematic)": (99.0, 118.2), "method A": (101.0, 500.0)},
        }
        figure = draw_design(
            excitation(ns16, wandering(ns16)),
            ns16,
            front=front_of([100.0, 105.0], [70.0, 95.0]),
            chosen=None if full else 0,
            title=title,
            **(more if full else {}),
        )
        with style.page():
            renderer = laid_out(figure)
            extent = figure.get_tightbbox(renderer)
            width, height = figure.get_size_inches()
            assert extent.x0 >= 0.0
            assert extent.y0 >= 0.0
            assert extent.x1 <= width
            assert extent.y1 <= height
            heads = [*figure.texts, *(axes.title for axes in figure.axes)]
            heads += [axes._left_title for axes in figure.axes]
            boxes = [
                (text.get_text(), text.get_window_extent(renderer))
                for text in heads
                if text.get_text()
            ]
        for (first, a), (second, b) in combinations(boxes, 2):
            assert not a.overlaps(b), f"{first!r} upon {second!r}"


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


@pytest.mark.parametrize("size", ["0.3 0.1 0.1", "0.3 0.1 0", "0.3 0 0", "0 0 0", "1e6 1e-9 1"])
def test_a_body_has_a_surface_however_flat_it_is(size: str) -> None:
    arm = Arm.from_urdf(URDF.replace("0.3 0.1 0.1", size))
    assert [solid.faces.shape for solid in arm.solids] == [(12, 3)] * 2
