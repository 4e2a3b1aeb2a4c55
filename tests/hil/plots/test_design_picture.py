"""The page of a designed motion: what it shows is what the robot is going to do."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text

from hil.cell import Cell
from hil.plots import save
from hil.plots.design_picture import draw_design
from hil.report import picture_style as style
from identification.excitation import CRITERIA, Design, Objective
from identification.excitation.constraints import midpoints
from identification.excitation.criteria import Criterion, friction_of_excitation
from identification.excitation.excitation import Excitation
from identification.excitation.searches.population import Front
from planner import FourierSeries, Trajectory, plan
from sim_fixtures.ns16 import CELL_PATH

pytestmark = pytest.mark.long

TWO_LINK = Path(__file__).parents[2] / "identification" / "two_link.urdf"
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


@pytest.fixture(scope="module")
def ns16() -> Cell:
    return Cell.load(CELL_PATH)


@pytest.fixture(scope="module")
def two_link() -> Cell:
    return Cell.from_texts(TWO_LINK_CELL, TWO_LINK.read_text(), Path("cell.toml"))


OTHER = Criterion(lambda *_: 1.0, "κ", -1.0, "Spread of Φ", "of all", 3, relative=True)


def design_of(cell: Cell, trajectory: Trajectory, chosen: int | None = 1) -> Design:
    """A design with three motions on its front, of which the second is chosen or improved."""
    criteria = Objective(cell.model).criteria(trajectory, 0.008)
    excitation = Excitation(trajectory, criteria, "gradient", seed=1, tried=1, rejected={})
    measures = np.array([[100.0, 70.0], [105.7, 80.0], [108.0, 110.0]])
    return Design(
        genes=np.zeros(1),
        excitation=excitation,
        front=Front(np.zeros((3, 1)), measures, np.zeros(3), np.ones(3)),
        chosen=chosen,
        origin=1,
        origin_criteria=excitation.criteria,
        generations=1,
        complete=True,
        exhausted=False,
    )


def wandering(cell: Cell, points: int = 5) -> Trajectory:
    limits = cell.joint_limits
    middle = (limits.upper + limits.lower) / 2.0
    half = (limits.upper - limits.lower) / 2.0
    random = np.random.default_rng(4)
    via = middle + 0.4 * half * random.uniform(-1.0, 1.0, (points, limits.n_joints))
    return plan(via, limits, fly=0.5)


def texts(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.findobj(Text)]


class TestPage:
    def test_a_design_of_an_industrial_arm(self, ns16):
        """Correlations of its motion without friction; positions in angles of the cell."""
        design = design_of(ns16, wandering(ns16))
        figure = draw_design(design, ns16)
        (axes,) = (axes for axes in figure.axes if axes.get_xlabel().startswith("parameters"))
        (image,) = axes.images
        motion = midpoints(design.excitation.trajectory, 0.001)
        friction = friction_of_excitation(ns16.model)  # less of it below standstill
        motion = replace(motion, direction=friction.direction(motion))
        regressor = ns16.model.regressor(motion).dense(ns16.model.n_parameters)
        inverse = np.linalg.inv(np.einsum("mnp,mnq->pq", regressor, regressor))
        deviation = np.sqrt(np.diag(inverse))
        expected = np.abs(inverse / np.outer(deviation, deviation))[:40, :40]
        np.testing.assert_allclose(np.asarray(image.get_array()), expected, atol=1e-5)
        (position,) = (a for a in figure.axes if a.get_ylabel() == "joint_2")
        assert position.get_yticks() == pytest.approx([-50.0, 0.0, 95.0])  # as in the file
        assert "position [deg, controller angles]" in texts(figure)

    def test_an_improved_motion_is_not_on_the_front(self, two_link):
        design = design_of(two_link, wandering(two_link))
        assert "chosen (105.70, 80.0)" in texts(draw_design(design, two_link))
        figure = draw_design(replace(design, chosen=None), two_link)
        log10_det, index = design.excitation.criteria.measures
        assert f"chosen, improved ({log10_det:.2f}, {index:.1f})" in texts(figure)
        assert "grew from (105.70, 80.0)" in texts(figure)

    def test_the_axes_of_the_front_are_its_criteria(self, two_link, monkeypatch):
        """By name, with the words of `CRITERIA`, which the heading follows too."""
        design = design_of(two_link, wandering(two_link))
        monkeypatch.setitem(CRITERIA, "condition", OTHER)
        measures = np.column_stack((design.front.measures, [9.0, 8.0, 7.0]))
        names = ("condition", "coupling_index")
        front = Front(np.zeros((3, 1)), measures, np.zeros(3), np.ones(3), names)
        page_texts = texts(draw_design(replace(design, front=front), two_link))
        assert {"Spread of Φ (lower is better)", "chosen (8.000, 80.0)"} <= set(page_texts)
        assert any(f", κ {design.excitation.criteria.condition:.3f}" in text for text in page_texts)

    @pytest.mark.parametrize(("index", "line"), [(80.0, "-"), (120.0, "None")])
    def test_a_front_of_a_third_criterion_is_no_line(self, two_link, index, line):
        """As that of a required precision: its second motion is worse in both of these."""
        design = design_of(two_link, wandering(two_link))
        measures = np.array([[100.0, 70.0], [105.7, index], [108.0, 110.0]])
        front = Front(np.zeros((3, 1)), measures, np.arange(3.0), np.ones(3))
        figure = draw_design(replace(design, front=front), two_link)
        lines = [each for axes in figure.axes for each in axes.get_lines()]
        (front_line,) = (each for each in lines if str(each.get_label()).startswith("front, 3"))
        assert front_line.get_linestyle() == line

    def test_warnings_are_red(self, two_link):
        design = replace(design_of(two_link, wandering(two_link)), complete=False)
        page = draw_design(design, two_link, ("floor", "walls"))
        red = [text.get_text() for text in page.texts if text.get_color() == style.LIMIT]
        assert red == [
            "NOT CHECKED: floor, walls; not for a robot",
            "search interrupted: better motions may exist",
        ]
        page = draw_design(replace(design, complete=True), two_link)
        assert not [text for text in page.texts if text.get_color() == style.LIMIT]

    def test_one_motion_gives_the_same_bytes(self, two_link, tmp_path):
        frequency = np.array([[1.0, 2.0], [1.3, 2.9]])
        bare = FourierSeries(np.zeros(2), np.full((2, 2), 0.4), frequency, 6.0, 0.0)
        for motion in (wandering(two_link), bare):
            for name in ("a.png", "b.png"):
                save(draw_design(design_of(two_link, motion), two_link), tmp_path / name)
            assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()

    def test_no_text_of_a_small_arm_leaves_the_page(self, two_link):
        """With long names, which are broken after underscores, and a front of one motion."""
        urdf = two_link.urdf.replace('"shoulder"', '"shoulder_pan_joint"')
        cell = Cell.from_texts(two_link.text, urdf, two_link.path)
        design = design_of(cell, wandering(cell))
        front = Front(np.zeros((1, 1)), design.front.measures[:1], np.zeros(1), np.ones(1))
        figure = draw_design(replace(design, front=front, origin=0), cell)
        assert {"front, 1 motion", "shoulder_\npan_joint"} <= set(texts(figure))
        figure.draw_without_rendering()
        page = figure.bbox
        for text in figure.findobj(
            lambda artist: isinstance(artist, Text) and len(artist.get_text()) > 9
        ):
            box = text.get_window_extent()
            assert page.x0 <= box.x0 and box.x1 <= page.x1, text.get_text()
            assert page.y0 <= box.y0 and box.y1 <= page.y1, text.get_text()
