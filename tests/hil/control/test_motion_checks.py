"""Limits of motions: messages in the angles of the cell file; torque, current, collision."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from hil.cell import AngleFrame, Cell, CellError
from hil.cell.toml_edits import with_values
from hil.control.messages import fixed_words, violation_text
from hil.control.motion_checks import MotionChecks, collision_checker, fixed_distance
from hil.control.motion_refusals import BrokenConstraint, FixedDistance
from hil.control.motions import rest
from hil.design import preset, problem_of
from hil.design.messages import NoExcitationError
from identification.excitation import CollisionChecker, Violation, Workspace, messages
from identification.excitation.violation import CloseBodies, JointQuantity, LoadedDrive
from identification.model.motion import Motion
from sim_fixtures.ns16 import CELL_PATH

# Two links two joints apart that a turn about their common axis leaves where they are.
WRIST = """<robot name="wrist"><link name="base"/>
{links}
<joint name="one" type="revolute"><parent link="base"/><child link="a"/><axis xyz="1 0 0"/>
<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
<joint name="two" type="revolute"><parent link="a"/><child link="b"/><origin xyz="0.2 0 0"/>
<axis xyz="1 0 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
<joint name="three" type="revolute"><parent link="b"/><child link="c"/><origin xyz="0.3 0 0"/>
<axis xyz="1 0 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>"""
LINK = """<link name="{name}"><inertial><mass value="1"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>{shape}</link>"""
BALL = '<collision><geometry><sphere radius="{radius}"/></geometry></collision>'
BARE_CELL = """[cell]
name = "wrist"
urdf = "wrist.urdf"
[limits]
frame = "urdf"
lower_deg = [-50, -50, -50]
upper_deg = [50, 50, 50]
velocity_deg = [50, 50, 50]
acceleration_deg = [100, 100, 100]
jerk_deg = [1000, 1000, 1000]
[workspace]
floor = "none"
"""


def wrist(*shapes: str) -> str:
    """The arm with these shapes on its links."""
    links = [LINK.format(name=name, shape=shape) for name, shape in zip("abc", shapes, strict=True)]
    return WRIST.format(links="\n".join(links))


@pytest.fixture
def cell() -> Cell:
    return Cell.load(CELL_PATH)


def test_postures_are_in_the_angles_of_the_teach_pendant(cell: Cell) -> None:
    text = AngleFrame.of(cell).text_of_angles(cell.home)
    assert text == "J1 0.0, J2 0.0, J3 -90.0, J4 0.0, J5 90.0, J6 0.0 deg, teach pendant angles"
    frame = AngleFrame("urdf", np.ones(2), np.zeros(2))
    assert frame.text_of_angles((0.5, -1.0)) == "J1 28.6, J2 -57.3 deg, angles of the URDF"
    high = cell.text.replace("floor = 0.0", "floor = 1.0")
    raised = Cell.from_texts(high, cell.urdf, cell.path)
    with pytest.raises(
        NoExcitationError, match=r"J3 -90\.0, .* deg, teach pendant angles"
    ) as refused:
        problem_of(raised, preset("b"))
    assert " rad" not in str(refused.value)


def test_a_joint_limit_is_in_the_angles_of_the_file(cell: Cell) -> None:
    frame = AngleFrame.of(cell)
    limits = cell.joint_limits
    # joint_sign of J3 is -1: the URDF's upper limit is the file's lower one, -170 deg.
    beyond = limits.upper.copy()
    beyond[2] += np.radians(5.0)
    position = Violation(
        "joint limit", JointQuantity("position", 2), beyond[2], limits.upper[2], 1.0, tuple(beyond)
    )
    text = violation_text(position, frame)
    assert "position of J3: -175 deg, must be at least -170 deg, at 1.000 s" in text
    assert "J3 -175.0" in text
    fast = Violation("joint limit", JointQuantity("velocity", 1), 3.0, np.radians(155.0), 0.5)
    assert "velocity of J2: 171.9 deg/s, must be at most 155 deg/s" in violation_text(fast, frame)
    # A rate is positive for J3 too, whose sign is reversed on the teach pendant.
    assert frame.sign[2] == -1.0
    backwards = Violation(
        "joint limit", JointQuantity("velocity", 2), 6.9726, np.radians(155.0), 0.5
    )
    text = violation_text(backwards, frame)
    assert "velocity of J3: 399.5 deg/s, must be at most 155 deg/s" in text
    assert (
        messages.violation_text(fast)
        == "joint limit of velocity of joint 1: 3, must be at most 2.705, at 0.500 s"
    )


def test_advice_on_a_margin_is_for_what_no_posture_parts(cell: Cell) -> None:
    urdf = wrist(BALL.format(radius=0.05), "", BALL.format(radius=0.437))
    checker = CollisionChecker(urdf, Workspace(floor=None, margin=0.005))
    assert checker.spread("a", "c") == pytest.approx((0.013, 0.013), abs=1e-6)
    contact = Violation("collision", CloseBodies("a", "c"), 0.013, 0.02, None, (0.0, 0.0, 0.0))
    fixed = fixed_distance(contact, checker)
    assert fixed is not None
    assert fixed == FixedDistance("a", "c", *checker.spread("a", "c"), required=0.02)
    assert "0.013 to 0.013 m apart in any posture; [workspace] margin must be" in fixed_words(fixed)
    at_home = replace(contact, subject=CloseBodies("a", "c", at_home=True))
    assert fixed_distance(at_home, checker) == fixed
    deep = CollisionChecker(
        wrist(BALL.format(radius=0.1), "", BALL.format(radius=0.437)),
        Workspace(floor=None, margin=0.0),
    )
    assert deep.pairs == ()  # left out: always in contact
    assert fixed_distance(contact, deep) is None
    checker = collision_checker(cell)
    contact = Violation(
        "collision", CloseBodies("link_5", "floor"), -0.1, 0.05, None, tuple(cell.home)
    )
    assert fixed_distance(contact, checker) is None


def test_a_robot_without_shapes_gets_the_file_and_a_remedy() -> None:
    cell = Cell.from_texts(BARE_CELL, wrist("", "", ""), Path("cell.toml"))
    with pytest.raises(CellError, match=r"cell\.toml: cell\.urdf.*no moving link.*collision = fal"):
        collision_checker(cell)


def test_a_missing_mesh_gets_file_mesh_and_remedy(tmp_path: Path) -> None:
    mesh = '<collision><geometry><mesh filename="package://arm/a.stl"/></geometry></collision>'
    urdf = wrist(mesh, "", BALL.format(radius=0.02))
    (tmp_path / "wrist.urdf").write_text(urdf, "utf-8")
    path = tmp_path / "cell.toml"
    path.write_text(BARE_CELL, "utf-8")
    with pytest.raises(CellError) as caught:
        collision_checker(Cell.load(path))
    for part in (str(path), "package://arm/a.stl", "wrist.urdf", "mesh_folders", "ROS_PACKAGE"):
        assert part in str(caught.value)
    folder = tmp_path / "meshes" / "arm"
    folder.mkdir(parents=True)
    corners = ("0 0 0", "0.1 0 0", "0 0.1 0", "0 0 0.1")
    facets = [
        " ".join(["facet normal 0 0 1 outer loop", *(f"vertex {corners[k]}" for k in face)])
        for face in ((0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3))
    ]
    solid = "".join(f"{facet} endloop endfacet\n" for facet in facets)
    (folder / "a.stl").write_text(f"solid a\n{solid}endsolid a\n", "utf-8")
    text = with_values(BARE_CELL, {"cell.mesh_folders": ["meshes"]})
    path.write_text(text, "utf-8")
    cell = Cell.load(path)
    assert ("a", "c") in collision_checker(cell).pairs
    # A copy elsewhere finds them too, and a list over several lines is replaced whole.
    path.write_text(text.replace('["meshes"]', '[\n  "meshes", # here\n]'), "utf-8")
    (tmp_path / "copy").mkdir()
    moved = Cell.load(path).with_urdf(tmp_path / "copy" / "cell.toml", "wrist.urdf")
    assert moved.file.cell.mesh_folders == ["../meshes"]
    assert collision_checker(moved).pairs == collision_checker(cell).pairs


HELD = 2
"""The joint that bears most at home: the forearm stands out level."""


def limited(cell: Cell, torque: list[float]) -> Cell:
    """The cell with these torque limits."""
    text = cell.text.replace("[limits]\n", f"[limits]\ntorque = {torque}\n", 1)
    return Cell.from_texts(text, cell.urdf, cell.path)


def held_torque(cell: Cell) -> float:
    """What the joint bears at home by the nominal model and its uncertainty, by pinocchio [N·m]."""
    model = pin.buildModelFromXML(cell.urdf)
    gravity = pin.computeGeneralizedGravity(model, model.createData(), cell.home)
    return (1.0 + cell.nominal.uncertainty) * abs(float(gravity[HELD]))


def test_gravity_beyond_a_torque_limit_is_refused(cell: Cell) -> None:
    """At home, and in a design."""
    assert cell.torque_limit is MotionChecks.of(cell).currents.torque_limit is None
    torque = [1e4] * 6
    for share in (1.02, 0.98):
        torque[HELD] = share * held_torque(cell)
        refusal = MotionChecks.of(limited(cell, torque)).refusal(rest(cell.home, 1.0))
        assert (refusal is None) == (share > 1.0)
    assert isinstance(refusal, BrokenConstraint)
    assert refusal.violation.subject == LoadedDrive(HELD, "joint_3", is_motor=False)
    assert refusal.violation.bound == pytest.approx(torque[HELD])
    torque[HELD] = 0.5 * held_torque(cell)
    with pytest.raises(NoExcitationError, match=r"torque of joint_3: .* N·m"):
        problem_of(limited(cell, torque), preset("b"))
    currents = problem_of(limited(cell, [1e4] * 6), preset("b")).constraints.currents
    np.testing.assert_array_equal(currents.torque_limit, [1e4] * 6)


def test_a_known_payload_counts_in_what_gravity_demands(cell: Cell) -> None:
    payload = "[robot.payload]\nmass = 8.0\ncentre = [0.05, 0.0, 0.1]\n"
    laden = Cell.from_texts(f"{cell.text}\n{payload}", cell.urdf, cell.path)
    model = pin.buildModelFromXML(cell.urdf)
    body = pin.Inertia(8.0, np.array([0.05, 0.0, 0.1]), np.zeros((3, 3)))
    model.appendBodyToJoint(model.njoints - 1, body, pin.SE3.Identity())
    gravity = pin.computeGeneralizedGravity(model, model.createData(), cell.home)
    still = np.zeros((1, 6))
    at_rest = Motion(np.zeros(1), cell.home[np.newaxis], still, still)
    torque = MotionChecks.of(laden).currents.torque(at_rest)[0]
    # The NS 16's model has no offset: at standstill there is nothing but gravity.
    np.testing.assert_allclose(
        torque, (1.0 + cell.nominal.uncertainty) * gravity, rtol=1e-9, atol=1e-9
    )
    bare = MotionChecks.of(cell).currents.torque(at_rest)[0]
    assert abs(torque[HELD] - bare[HELD]) > 50.0
