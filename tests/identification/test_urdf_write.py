from __future__ import annotations

import difflib
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st

from identification import FrictionLaw, ModelError, RobotModel, ShapeError
from identification.export.urdf import (
    NotConsistentError,
    WriteBackError,
    XmlSource,
    write_urdf,
)
from sim_fixtures.ns16 import urdf_text
from tests.identification.robots import robot_text, some_bodies

TWO_LINK = (Path(__file__).parent / "two_link.urdf").read_text()


ROBOTS = {
    "two_link": lambda: TWO_LINK,
    "ns16": urdf_text,
    "ur10": lambda: robot_text("ur_description/urdf/ur10_robot.urdf"),
    "panda": lambda: robot_text("panda_description/urdf/panda.urdf"),
}


@pytest.mark.parametrize("name", ROBOTS)
def test_pinocchio_reads_the_parameters_back(name: str) -> None:
    urdf = ROBOTS[name]()
    model = RobotModel.from_urdf(urdf, friction=FrictionLaw(offset=True))
    n = model.n_joints
    standard = some_bodies(n)
    friction = np.random.default_rng(1).uniform(0.1, 5.0, 4 * n)
    written = write_urdf(urdf, model, standard, friction)

    read = pin.buildModelFromXML(written)
    data = read.createData()
    rng = np.random.default_rng(2)
    base = model.base.grouping @ (standard.reshape(n, 11) * ([1.0] * 10 + [0.0])).reshape(-1)
    for _ in range(20):
        q, qd, qdd = rng.uniform(-2, 2, (3, n))
        expected = model.torque(
            np.concatenate([base, np.zeros(4 * n)]), q[None], qd[None], qdd[None]
        )[0]
        found = pin.rnea(read, data, pin.integrate(read, pin.neutral(read), q), qd, qdd)
        # The base parameters leave out what rounded angles make of a dependent column.
        np.testing.assert_allclose(found, expected, atol=2e-5 * np.abs(expected).max())
    np.testing.assert_array_equal(read.damping, friction[n : 2 * n])
    np.testing.assert_allclose(
        [inertia.mass for inertia in list(read.inertias)[1:]], standard[9::11], rtol=1e-12
    )


@pytest.mark.parametrize("name", ROBOTS)
def test_nothing_but_inertia_and_friction_changes(name: str) -> None:
    urdf = ROBOTS[name]()
    model = RobotModel.from_urdf(urdf)
    friction = np.ones(3 * model.n_joints)
    written = write_urdf(urdf, model, some_bodies(model.n_joints), friction)

    def without(text: str) -> list[str]:
        root = ElementTree.fromstring(text)
        for link in root.findall("link"):
            for inertial in link.findall("inertial"):
                link.remove(inertial)
        for joint in root.findall("joint"):
            for dynamics in joint.findall("dynamics"):
                joint.remove(dynamics)
        return [f"{e.tag} {e.attrib}" for e in root.iter()]

    assert without(written) == without(urdf)
    words = ("inert", "mass", "origin", "dynamics")
    for line in difflib.ndiff(urdf.splitlines(), written.splitlines()):
        assert line[0] in " ?" or any(word in line for word in words), line


@pytest.mark.parametrize("name", ["two_link", "ns16"])
def test_writing_what_is_there_changes_rounding_only(name: str) -> None:
    urdf = ROBOTS[name]()
    model = RobotModel.from_urdf(urdf)
    again = RobotModel.from_urdf(write_urdf(urdf, model, model.nominal))
    np.testing.assert_allclose(again.nominal, model.nominal, rtol=1e-12, atol=1e-12)


def test_friction_is_left_alone_if_none_is_given() -> None:
    urdf = ROBOTS["panda"]()
    model = RobotModel.from_urdf(urdf)
    before = [e.attrib for e in ElementTree.fromstring(urdf).iter("dynamics")]
    written = write_urdf(urdf, model, some_bodies(model.n_joints))
    assert [e.attrib for e in ElementTree.fromstring(written).iter("dynamics")] == before


def test_other_attributes_of_dynamics_stay() -> None:
    urdf = ROBOTS["panda"]()
    model = RobotModel.from_urdf(urdf)
    n = model.n_joints
    written = write_urdf(urdf, model, some_bodies(n), np.arange(3.0 * n))
    first = next(ElementTree.fromstring(written).iter("dynamics")).attrib
    assert first["mu_viscous"] == "16"
    assert (float(first["friction"]), float(first["damping"])) == (0.0, float(n))


WITH_TOOL = TWO_LINK.replace(
    "</robot>",
    """  <link name="flange"/>
  <joint name="to_flange" type="fixed"><parent link="lower"/><child link="flange"/>
    <origin xyz="0 0 0.4" rpy="0.3 0 0"/></joint>
  <link name="tool">
    <inertial><origin xyz="0 0 0.1"/><mass value="1"/>
      <inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial>
  </link>
  <joint name="to_tool" type="fixed"><parent link="flange"/><child link="tool"/></joint>
</robot>""",
)


def test_what_is_fixed_to_a_link_is_counted_with_it_once() -> None:
    model = RobotModel.from_urdf(WITH_TOOL)
    assert model.nominal[20] == pytest.approx(4.0)  # 3 kg and 1 kg
    written = write_urdf(WITH_TOOL, model, model.nominal)
    masses = {
        link.get("name"): mass.get("value")
        for link in ElementTree.fromstring(written).findall("link")
        if (mass := link.find("inertial/mass")) is not None
    }
    assert {name: float(mass or 0) for name, mass in masses.items()} == {
        "upper": pytest.approx(6.0),
        "lower": pytest.approx(4.0),
    }
    assert "inertia is contained in lower" in written


def test_the_base_keeps_its_inertia() -> None:
    urdf = TWO_LINK.replace(
        '<link name="base"/>',
        '<link name="base"><inertial><mass value="50"/>'
        '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>',
    )
    model = RobotModel.from_urdf(urdf)
    assert '<mass value="50"/>' in write_urdf(urdf, model, some_bodies(2))


def test_a_turned_inertial_frame_stays_turned() -> None:
    urdf = TWO_LINK.replace('<origin xyz="0.02 0 0.25" rpy="0 0 0"/>', '<origin rpy="0.3 -1 2"/>')
    model = RobotModel.from_urdf(urdf)
    standard = some_bodies(2)
    written = write_urdf(urdf, model, standard)
    assert 'rpy="0.3 -1 2"' in written
    again = RobotModel.from_urdf(written).nominal.reshape(2, 11)[:, :10]
    np.testing.assert_allclose(again, standard.reshape(2, 11)[:, :10], atol=1e-12)


def test_a_link_without_inertia_gets_one() -> None:
    start, end = TWO_LINK.index("    <inertial>"), TWO_LINK.index("</inertial>\n") + 12
    urdf = TWO_LINK[:start] + TWO_LINK[end:]
    model = RobotModel.from_urdf(urdf)
    standard = some_bodies(2)
    again = RobotModel.from_urdf(write_urdf(urdf, model, standard)).nominal
    np.testing.assert_allclose(again.reshape(2, 11)[:, :10], standard.reshape(2, 11)[:, :10])


@pytest.mark.parametrize(
    ("place", "value", "words"),
    [
        (11 + 3, 0.0, "'elbow'"),  # I2yy about the joint: less than the centre of mass alone makes
        (10, -0.1, "'shoulder'"),
        (10, np.nan, "I1m"),
        (10, np.inf, "I1m"),
    ],
)
def test_bodies_and_rotors_that_cannot_be_are_refused(place: int, value: float, words: str) -> None:
    model = RobotModel.from_urdf(TWO_LINK)
    standard = model.nominal.copy()
    standard[place] = value
    with pytest.raises(NotConsistentError, match=words):
        write_urdf(TWO_LINK, model, standard)


@pytest.mark.parametrize("index", [1, 3])
def test_friction_that_would_drive_is_refused(index: int) -> None:
    model = RobotModel.from_urdf(TWO_LINK)
    friction = np.ones(6)
    friction[index] = -0.1
    with pytest.raises(NotConsistentError, match="'elbow'"):
        write_urdf(TWO_LINK, model, model.nominal, friction)


def test_a_third_friction_term_may_be_negative() -> None:
    model = RobotModel.from_urdf(TWO_LINK)
    write_urdf(TWO_LINK, model, model.nominal, np.array([1.0, 1, 1, 1, -0.1, -0.1]))


def test_the_description_of_another_robot_is_refused() -> None:
    model = RobotModel.from_urdf(TWO_LINK)
    with pytest.raises(WriteBackError, match="no joint 'shoulder'"):
        write_urdf(urdf_text(), model, model.nominal)
    longer = TWO_LINK.replace('<origin xyz="0 0 0.5" rpy="0 0 0"/>\n    <axis', "<axis")
    assert longer != TWO_LINK
    with pytest.raises(WriteBackError, match="other torques"):
        write_urdf(longer, model, model.nominal)


def test_a_joint_that_the_model_does_not_know_is_refused() -> None:
    fixed = TWO_LINK.replace('name="elbow" type="revolute"', 'name="elbow" type="fixed"')
    model = RobotModel.from_urdf(fixed)
    with pytest.raises(WriteBackError, match="'elbow'"):
        write_urdf(TWO_LINK, model, model.nominal)


def test_wrong_shapes_and_texts_are_refused() -> None:
    model = RobotModel.from_urdf(TWO_LINK)
    with pytest.raises(ShapeError):
        write_urdf(TWO_LINK, model, np.ones(3))
    with pytest.raises(ShapeError):
        write_urdf(TWO_LINK, model, model.nominal, np.ones(3))
    with pytest.raises(ModelError):
        write_urdf("no xml", model, model.nominal)


TEXT = """<?xml version="1.0"?>
<!-- a > comment with <mass value="9"/> in it -->
<robot name='café "x>y"'>
  <link name="a"  ><!-- kept --><mass   value = '1.5'/></link>
  <link name="b"/>
</robot>
"""


class TestXmlSource:
    """Bytes of an edit change, and no others."""

    def test_elements_are_found_where_they_stand(self) -> None:
        source, data = XmlSource(TEXT), TEXT.encode()
        first, second = source.root.named("link").values()
        assert data[first.start : first.inside] == b'<link name="a"  >'
        assert data[first.start : first.end].endswith(b"/></link>")
        assert data[second.start : second.end] == b'<link name="b"/>'
        assert source.root.attributes == {"name": 'café "x>y"'}
        assert source.edited([]) == TEXT

    def test_attributes_change_and_new_ones_come_last(self) -> None:
        source = XmlSource(TEXT)
        first, second = source.root.named("link").values()
        mass = first.child("mass")
        assert mass is not None
        assert source.edited([source.with_attributes(mass, {"value": "2.0"})]) == TEXT.replace(
            "'1.5'", '"2.0"'
        )
        new = (mass, {"unit": "kg"}), (second, {"x": "1"})
        edited = source.edited([source.with_attributes(*one) for one in new])
        assert "<mass   value = '1.5' unit=\"kg\"/>" in edited
        assert '<link name="b" x="1"/>' in edited

    @pytest.mark.parametrize(
        ("text", "edited"),
        [
            ("<a>\n\t<b/>\n</a>\n", "<a>\n\t<c/>\n\t<b/>\n</a>\n"),
            ("<a>\r\n  <b/>\r\n</a>\r\n", "<a>\r\n  <c/>\r\n  <b/>\r\n</a>\r\n"),
            ("  <a />\n", "  <a>\n    <c/>\n  </a>\n"),
        ],
    )
    def test_children_have_the_layout_of_their_siblings(self, text: str, edited: str) -> None:
        source = XmlSource(text)
        assert source.edited([source.with_first_child(source.root, ["<c/>"])]) == edited

    def test_a_name_that_ends_like_another_is_another(self) -> None:
        source = XmlSource('<dynamics mu_friction="7" friction="0"/>')
        edited = source.edited([source.with_attributes(source.root, {"friction": "3.0"})])
        assert edited == '<dynamics mu_friction="7" friction="3.0"/>'

    @given(st.text(st.characters(codec="utf-8", exclude_categories=("Cc", "Cs"))))
    def test_any_value_is_read_back(self, value: str) -> None:
        source = XmlSource(TEXT)
        second = source.root.named("link")["b"]
        edited = source.edited([source.with_attributes(second, {"name": value})])
        assert ElementTree.fromstring(edited)[1].attrib["name"] == value
