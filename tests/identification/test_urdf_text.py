"""Untrusted robot descriptions: refused with a message; writing of URDFs."""

import gc
import itertools
import math
import struct
import time
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
import pytest

from identification import FrictionLaw, ModelError, RobotModel, ShapeError
from identification.excitation import CollisionChecker, Workspace
from identification.excitation.errors import CollisionModelError
from identification.export.urdf import NotConsistentError, WriteBackError, write_urdf
from identification.model.kinematics import MOST_JOINTS, chain_from_urdf
from identification.model.urdf_text import LONGEST, MOST_LINKS, refusal, urdf_tree
from sim_fixtures.ns16 import urdf_text
from tests.identification.robots import robot_text, some_bodies
from tests.identification.two_link import URDF as TWO_LINK

INERTIAL = (
    '<inertial><mass value="6"/><origin xyz="0.2 0 0"/>'
    '<inertia ixx="0.02" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>'
)
SHAPE = '<collision><geometry><box size="0.3 0.1 0.1"/></geometry></collision>'
HINGE = (
    '<joint name="{0}" type="{1}"><parent link="{2}"/><child link="{3}"/><axis xyz="0 1 0"/>'
    '<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
)
ARM = (
    f'<robot name="r"><link name="base"/><link name="upper">{INERTIAL}{SHAPE}</link>'
    f"{HINGE.format('shoulder', 'revolute', 'base', 'upper')}</robot>"
)


def arm(old, new):
    """Return the arm with replaced text."""
    assert old in ARM
    return ARM.replace(old, new)


def chain(n, kind):
    """Return the arm with a chain of `n` more links."""
    links = ["upper", *(f"l{i}" for i in range(n))]
    more = "".join(
        f'<link name="{after}"/>{HINGE.format(f"j_{after}", kind, before, after)}'
        for before, after in itertools.pairwise(links)
    )
    return arm("</robot>", f"{more}</robot>")


def declaring(entity, used=""):
    return f"<!DOCTYPE robot [{entity}]>" + arm('name="r"', f'name="r{used}"')


def expanding():
    """Ten nested entities ("billion laughs")."""
    lines = [f'<!ENTITY e{i} "{f"&e{i - 1};" * 10}">' for i in range(1, 10)]
    return declaring('<!ENTITY e0 "ha">' + "".join(lines), "&e9;")


def without(old):
    return arm(old, "")


LINKS = '<link name="a"/><link name="b"/>'
LIMIT = '<limit lower="-1" upper="1" effort="1" velocity="1"/>'


def joint(kind, child="b", limit="", name="j"):
    return (
        f'<joint name="{name}" type="{kind}"><parent link="a"/><child link="{child}"/>'
        f'<axis xyz="0 0 1"/>{limit}</joint>'
    )


def robot(inside, head=' name="r"'):
    return f"<robot{head}>{inside}</robot>"


def xacro(text):
    return text.replace("<robot ", '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" ', 1)


UNEXPANDED = "it is a xacro file; expand it with: xacro FILE"
FAULTS = {
    "no xml": "not XML",
    "": "not XML",
    "<robot>": "not XML",
    "<sdf/>": "<sdf>",
    xacro(robot('<xacro:include filename="x"/>')): "expand it with: xacro",
    xacro(arm('value="6"', 'value="${m}"')): UNEXPANDED,
    xacro(arm('value="6"', 'value="$(arg m)"')): UNEXPANDED,
    xacro(arm(INERTIAL, '<inertial><xacro:box mass="6"/></inertial>')): UNEXPANDED,
    xacro(arm('type="revolute"', 'type="${kind}"')): UNEXPANDED,
    robot(LINKS, ""): "no name",
    robot(""): "no <link>",
    robot(LINKS): "'a', 'b' have no parent joint",
    robot(LINKS + '<link name="a"/>'): "2 of its links are called 'a'",
    robot(LINKS + joint("revolut", limit=LIMIT)): "'j' is of type 'revolut'",
    robot(LINKS + joint("revolute")): "'j' is revolute and has no <limit>",
    robot(LINKS + joint("revolute", "c", LIMIT)): "child link 'c'",
    robot(LINKS + '<joint name="j" type="fixed"><parent link="a"/></joint>'): "no <child",
    robot(LINKS + joint("fixed") + joint("fixed", name="k")): "child of 2 joints",
    **{
        arm('xyz="0.2 0 0"', f'xyz="0.2{blank}0 0"'): (
            "tab or line end in an attribute of the <origin>"
        )
        for blank in "\t\n"
    },
    **{
        arm('value="6"', f'value="{number}"'): f"'upper' has value={number!r} in the <mass>"
        for number in ("6 ", "nan", "1e999", "0x6", "1_0", "", "\u0663")
    },
    arm('value="6"', 'value="6&#10;"'): "'upper' has value='6\\n' in the <mass>",
    arm('value="6"', f'value="{"9" * 400}"'): "in the <mass>",
    arm('value="6"', 'value="-6"'): "'upper' has a mass of -6 kg",
}

FAULTS |= {
    declaring('<!ENTITY x "y">', "&x;"): "declares the entity 'x'",
    expanding(): "declares the entity 'e0'",
    declaring('<!ENTITY x SYSTEM "file:///etc/passwd">', "&x;"): "declares the entity 'x'",
    declaring('<!ENTITY % x SYSTEM "http://127.0.0.1:9/x"> %x;'): "declares the entity 'x'",
    '<!DOCTYPE robot SYSTEM "x.dtd">' + arm("shoulder", "a&b;c"): "refers to 'x.dtd'",
    arm("shoulder", "a\x1b[31mb"): "not XML",
    arm("shoulder", "a\0b"): "not XML",
    arm("shoulder", "a\ud800b"): "not text",
    arm("shoulder", "a&#10;b"): "'a\\nb' has characters",
    arm("shoulder", "a\u202eb"): "cannot be printed",
    # two names to two readers
    arm('name="shoulder"', 'name="a\tb"'): "'a b' has a tab or line end",
    arm("</robot>", "<a>" * 100 + "</a>" * 100 + "</robot>"): "deep",
    arm("<robot ", "<robot " + "".join(f'a{i}="" ' for i in range(100_000))): "attributes",
    # overflows the reader's stack
    chain(20_000, "fixed"): f"{MOST_LINKS} links",
    chain(300, "revolute"): f"at most {MOST_JOINTS}",
    arm("</robot>", "\n<gazebo:plugin/></robot>"): (
        'line 2 has an undeclared prefix; declare it, as in <robot xmlns:PREFIX="'
    ),
    " " * (LONGEST + 1): "characters",
    # an incomplete inertia, of which the reader drops the tensor, sometimes mass and shapes
    **{
        without(old): f"link 'upper' has no {why}"
        for old, why in {
            '<mass value="6"/>': (
                "<mass> in its <inertial>; write one, or leave the <inertial> out"
            ),
            ' value="6"': 'value in the <mass> of its <inertial>; write value="..."',
            ' ixy="0" ixz="0" iyz="0"': (
                'ixy, ixz, iyz in the <inertia> of its <inertial>; write ixy="0" ixz="0" iyz="0"'
            ),
            ' iyz="0"': 'iyz in the <inertia> of its <inertial>; write iyz="0"',
            ' izz="0.1"': 'izz in the <inertia> of its <inertial>; write izz="..."',
            INERTIAL[INERTIAL.index("<inertia ") : -len("</inertial>")]: (
                "<inertia> in its <inertial>"
            ),
        }.items()
    },
}


def checker(urdf):
    return CollisionChecker(urdf, Workspace(floor=-1.0))


AWAY = r"more than 1e\+06 m away from its parent"
FAR = '<origin xyz="1e300 0 0"/>'


DRAKE = 'xmlns="http://drake.mit.edu"'


def drakes(text):
    return text.replace("<robot ", f"<robot {DRAKE} ")


class TestReading:
    @pytest.mark.parametrize("left_out", [INERTIAL, '<origin xyz="0.2 0 0"/>', ' xyz="0.2 0 0"'])
    def test_optional_parts_may_be_missing(self, left_out):
        assert RobotModel.from_urdf(without(left_out)).n_joints == 1

    @pytest.mark.parametrize("encoding", ["UTF-32", "ISO-8859-1", "nonsense"])
    def test_the_declared_encoding_is_ignored(self, encoding):
        joint = "\N{GREEK CAPITAL LETTER ALPHA}"  # its bytes cannot be printed in ISO-8859-1
        text = f'<?xml version="1.0" encoding="{encoding}"?>{arm("shoulder", joint)}'
        model = RobotModel.from_urdf(text)
        assert model.joint_names == (joint,)
        assert CollisionChecker(text, Workspace(floor=-1.0))
        assert chain_from_urdf(write_urdf(text, model, model.nominal)).joint_names == (joint,)

    @pytest.mark.parametrize("number", [" 6", "+6", "6.", "0.6E+1", "006"])
    def test_accepted_numbers_are_read_correctly(self, number):
        model = RobotModel.from_urdf(arm('value="6"', f'value="{number}"'))
        mass = model.chain.inertial[0, list(model.layout.names).index("m1")]
        assert math.isclose(mass, 6.0)

    def test_attributes_may_be_on_separate_lines(self):
        assert refusal(ARM.replace('" i', '"\n\ti').replace('" value', '"\n value')) is None
        assert refusal("<!-- a > b -->\n" + arm("<mass ", "<mass\n\t")) is None

    @pytest.mark.parametrize("text", [ARM, ARM[:-1]])
    def test_a_description_of_20_mb_is_freed_after_reading(self, text):
        refusal(text)
        gc.collect()
        gc.disable()
        try:
            refusal(text)
            assert gc.collect() == 0
        finally:
            gc.enable()


class TestRefusals:
    @pytest.mark.parametrize(("text", "why"), FAULTS.items(), ids=range(len(FAULTS)))
    def test_they_are_quick_and_printable(self, text, why):
        began = time.process_time()
        with pytest.raises(ModelError) as caught:
            RobotModel.from_urdf(text)
        assert why in str(caught.value)
        assert str(caught.value).isprintable()
        assert time.process_time() - began < 2.0

    @pytest.mark.parametrize(
        ("size", "why"),
        [
            ("0.3\t0.1 0.1", "of the 1 collision shapes of link 'upper' 0 could be read"),
            ("nan 0.1 0.1", "of the 1 collision shapes of link 'upper' 0 could be read"),
            ("0.3 -0.1 0.1", "a collision shape of link 'upper' has a negative size"),
            ("0.3 1e308 0.1", r"a collision shape of link 'upper' is larger than 1e\+06 m"),
        ],
    )
    def test_unreadable_collision_shapes_are_refused(self, size, why):
        """A second, valid shape must not hide an invalid one."""
        urdf = arm(SHAPE, SHAPE.replace("0.3 0.1 0.1", size))
        both = chain(1, "revolute").replace(SHAPE, SHAPE.replace("0.3 0.1 0.1", size))
        both = both.replace('<link name="l0"/>', f'<link name="l0">{SHAPE}</link>')
        for text in (urdf, both):
            with pytest.raises(CollisionModelError, match=why):
                checker(text)
        assert RobotModel.from_urdf(urdf).n_joints == 1  # shapes do not affect an estimate

    @pytest.mark.parametrize("kind", ["revolute", "fixed"])
    def test_too_distant_parts_are_refused(self, kind):
        sound = chain(1, kind)
        joint = '<joint name="j_l0" type="' + kind + '">'
        assert joint in sound
        checker(sound)
        with pytest.raises(ModelError, match=f"'j_l0' .* {AWAY}"):
            chain_from_urdf(sound.replace(joint, joint + FAR))
        with pytest.raises(CollisionModelError, match=AWAY):
            checker(sound.replace("<collision>", "<collision>" + FAR, 1))
        slide = chain(1, "prismatic")
        chain_from_urdf(slide, {"j_l0": 1.0})
        with pytest.raises(ModelError, match=AWAY):
            chain_from_urdf(slide, {"j_l0": 1e200})

    @pytest.mark.parametrize("corner", [math.nan, 0.0])
    def test_a_mesh_without_volume_is_named(self, corner, tmp_path):
        """Four triangles in one point, or with invalid corners."""
        triangle = b"\0" * 12 + struct.pack("<9f", *[corner] * 9) + b"\0\0"
        mesh = tmp_path / "mesh.stl"
        mesh.write_bytes(b"\0" * 80 + struct.pack("<I", 4) + 4 * triangle)
        with pytest.raises(CollisionModelError) as caught:
            checker(arm('<box size="0.3 0.1 0.1"/>', f'<mesh filename="{mesh}"/>'))
        assert str(caught.value).isprintable()

    def test_faults_are_found_in_a_namespace_too(self):
        checker(drakes(ARM))
        second = arm("</robot>", f'<link name="l"/>{HINGE.format("j", "revolute", "upper", "l")}')
        second = second.replace('<link name="l"/>', f'<link name="l">{SHAPE}</link>') + "</robot>"
        with pytest.raises(CollisionModelError, match="of link 'upper' 0 could be read"):
            checker(drakes(second.replace("<box ", "<capsule ", 1)))
        closed = arm("</robot>", HINGE.format("again", "revolute", "base", "upper") + "</robot>")
        for text, why in (
            (closed, "child of 2 joints: a closed chain"),
            (arm('"revolute"', '"revolut"'), "'shoulder' is of type 'revolut'"),
        ):
            with pytest.raises(ModelError, match=why):
                RobotModel.from_urdf(drakes(text))


def panda():
    return robot_text("panda_description/urdf/panda.urdf")


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
).replace(
    '<link name="base"/>',
    '<link name="base"><inertial><mass value="50"/>'
    '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>',
)


START, END = TWO_LINK.index("    <inertial>"), TWO_LINK.index("</inertial>\n") + 12
ROTATED = 'rpy="0.3 -1 2"'
NOTHING = (
    '<inertial><mass value="0"/>'
    '<inertia ixx="0" ixy="0" ixz="0" iyy="0" iyz="0" izz="0"/></inertial>'
)


LONGER = TWO_LINK.replace('<origin xyz="0 0 0.5" rpy="0 0 0"/>\n    <axis', "<axis")
assert LONGER != TWO_LINK
FIXED = TWO_LINK.replace('name="elbow" type="revolute"', 'name="elbow" type="fixed"')


REST = """<?xml version="1.0"?>
<!-- a > comment with <robot> in it -->
<robot name='café "x>y"' xmlns:gazebo="x"><!-- first -->
  <link name="base"/>
  <link name="upper"  ><!-- second --><mass   value = '1.5'/></link>{}
  <gazebo:link gazebo:name="c">1 &lt; 2</gazebo:link>
</robot >
<!-- last -->
"""


class TestWriting:
    @pytest.mark.parametrize(
        "path", ["ur_description/urdf/ur10_robot", "panda_description/urdf/panda"]
    )
    def test_pinocchio_reads_the_parameters_back(self, path):
        urdf = robot_text(f"{path}.urdf")
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
            # The base parameters neglect the effect of rounded angles on dependent columns.
            np.testing.assert_allclose(found, expected, atol=2e-5 * np.abs(expected).max())
        np.testing.assert_array_equal(read.damping, friction[n : 2 * n])
        np.testing.assert_allclose(
            [inertia.mass for inertia in list(read.inertias)[1:]], standard[9::11], rtol=1e-12
        )

    def test_friction_not_given_and_other_attributes_stay(self):
        urdf = panda()
        model = RobotModel.from_urdf(urdf)
        n = model.n_joints
        before = [e.attrib for e in ElementTree.fromstring(urdf).iter("dynamics")]
        written = write_urdf(urdf, model, some_bodies(n))
        assert [e.attrib for e in ElementTree.fromstring(written).iter("dynamics")] == before
        written = write_urdf(urdf, model, some_bodies(n), np.arange(3.0 * n))
        first = next(ElementTree.fromstring(written).iter("dynamics")).attrib
        assert first["mu_viscous"] == "16"
        assert (float(first["friction"]), float(first["damping"])) == (0.0, float(n))

    def test_fixed_links_are_included_once(self):
        """In the link that carries them; the base keeps its inertia."""
        model = RobotModel.from_urdf(WITH_TOOL)
        assert model.nominal[20] == pytest.approx(4.0)  # 3 kg and 1 kg
        written = write_urdf(WITH_TOOL, model, model.nominal)
        masses = {
            link.get("name"): float(mass.get("value"))
            for link in ElementTree.fromstring(written).findall("link")
            if (mass := link.find("inertial/mass")) is not None
        }
        assert masses == pytest.approx({"base": 50.0, "upper": 6.0, "lower": 4.0})
        assert '<mass value="50"/>' in written
        assert "inertia is contained in lower" in written

    @pytest.mark.parametrize(
        "urdf",
        [
            TWO_LINK.replace('<origin xyz="0.02 0 0.25" rpy="0 0 0"/>', f"<origin {ROTATED}/>"),
            TWO_LINK[:START] + TWO_LINK[END:],
            TWO_LINK.replace(TWO_LINK[START:END], NOTHING),
        ],
        ids=["rotated frame", "no inertia", "no origin"],
    )
    def test_inertia_is_written_in_its_frame(self, urdf):
        """A rotated inertial frame stays; a link without inertia gets one."""
        model, standard = RobotModel.from_urdf(urdf), some_bodies(2)
        written = write_urdf(urdf, model, standard)
        assert (ROTATED in written) == (ROTATED in urdf)
        again = RobotModel.from_urdf(written).nominal.reshape(2, 11)[:, :10]
        np.testing.assert_allclose(again, standard.reshape(2, 11)[:, :10], atol=1e-12)

    @pytest.mark.parametrize(
        ("standard", "friction", "error", "words"),
        [
            # I2yy about the joint: less than the share of the centre of mass
            ({14: 0.0}, (), NotConsistentError, "'elbow'"),
            ({10: -0.1}, (), NotConsistentError, "'shoulder'"),
            *(({10: value}, (), NotConsistentError, "I1m") for value in (np.nan, np.inf)),
            *(
                ({}, np.where(np.arange(6) == index, -0.1, 1.0), NotConsistentError, "'elbow'")
                for index in (1, 3)
            ),
            ({}, np.ones(3), ShapeError, "coefficients"),
            (..., (), ShapeError, "standard"),
        ],
    )
    def test_inconsistent_parameters_are_refused(self, standard, friction, error, words):
        model = RobotModel.from_urdf(TWO_LINK)
        values = model.nominal.copy()
        if standard is ...:
            values = values[:3]
        else:
            values[[*standard]] = [*standard.values()]
        with pytest.raises(error, match=words):
            write_urdf(TWO_LINK, model, values, *([friction] if len(friction) else []))

    @pytest.mark.parametrize(
        ("text", "own", "error", "words"),
        [
            (urdf_text(), TWO_LINK, WriteBackError, "no joint 'shoulder'"),
            (LONGER, TWO_LINK, WriteBackError, "differs by"),
            (TWO_LINK, FIXED, WriteBackError, "'elbow'"),
            ("no xml", TWO_LINK, ModelError, "not XML"),
        ],
    )
    def test_the_description_of_another_robot_is_refused(self, text, own, error, words):
        model = RobotModel.from_urdf(own)
        with pytest.raises(error, match=words):
            write_urdf(text, model, model.nominal)

    def test_other_elements_and_comments_are_unchanged(self):
        """White space and quotes inside tags may change."""
        urdf = REST.format("\n  " + HINGE.format("shoulder", "revolute", "base", "upper"))
        model = RobotModel.from_urdf(urdf)
        written = write_urdf(urdf, model, some_bodies(1), np.ones(3), ["a -- remark", "another"])
        robot = urdf.index("<robot name")
        assert written.startswith(
            urdf[:robot] + "<!--\n  a - - remark\n  another\n-->\n<robot name="
        )
        assert written.endswith(
            urdf[urdf.index("  <gazebo:link") :].replace("</robot >", "</robot>")
        )
        for text in ("<!-- first -->\n  <link", "<!-- second --><mass value=", "x&gt;y"):
            assert text in written
        assert [e.get("name") for e in urdf_tree(written)] == [
            e.get("name") for e in urdf_tree(urdf)
        ]
