"""Robot descriptions: untrusted ones are refused; files for other tools restore every number."""

import csv
import gc
import itertools
import json
import math
import struct
import time
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
import pytest

from identification.errors import ModelError, ShapeError
from identification.estimators.consistent import consistent_estimate
from identification.excitation.collision import CollisionChecker
from identification.excitation.errors import CollisionModelError
from identification.export.friction_curve import friction_curve, median_load
from identification.export.parameter_files import (
    covariance_csv,
    estimate_in,
    parameters_csv,
    parameters_json,
)
from identification.export.parameter_table import parameter_table
from identification.export.simulators import (
    AGREEMENT_TOLERANCE,
    FORMATS,
    compare,
    mjcf,
    random_states,
    rigid_torque,
)
from identification.export.urdf import NotConsistentError, WriteBackError, not_in_urdf, write_urdf
from identification.factor.estimate import estimate
from identification.factor.estimation_method import EstimationMethod
from identification.factor.factor import Factor
from identification.model.coupling import Coupling
from identification.model.elements import Anchors, GasCylinder, TorqueRipple, TorsionSpring
from identification.model.friction import FrictionLaw
from identification.model.joint_ranges import JointRanges
from identification.model.kinematics import MAX_MOVING_JOINTS, chain_from_urdf
from identification.model.known_payload import Payload
from identification.model.motion import Motion
from identification.model.robot import RobotModel
from identification.model.urdf_text import MAX_CHARACTERS, MAX_LINKS, refusal, urdf_tree
from identification.model.workspace import Workspace
from identification.signals.noise import noiseless_above
from identification.signals.smoothing import LowPassShape, low_passed
from sim_fixtures.ns16 import urdf_text
from tests import messages
from tests.identification.exported_arm import WRIST, an_arm
from tests.identification.robots import random_urdf, robot_text, some_bodies
from tests.identification.two_link import URDF, as_samples, four_sines
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
    robot(LINKS + joint("fixed") + joint("fixed", "a", name="k")): "a closed chain",
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
    chain(20_000, "fixed"): f"{MAX_LINKS} links",
    chain(300, "revolute"): f"at most {MAX_MOVING_JOINTS}",
    arm("</robot>", "\n<gazebo:plugin/></robot>"): (
        'line 2 has an undeclared prefix; declare it, as in <robot xmlns:PREFIX="'
    ),
    " " * (MAX_CHARACTERS + 1): "characters",
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
    @pytest.mark.long
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


START = TWO_LINK.index("    <inertial>")
END = TWO_LINK.index("</inertial>\n") + 12
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
                np.concatenate([base, np.zeros(4 * n)]),
                Motion.of_states(q[None], qd[None], qdd[None]),
            )[0]
            torque = pin.rnea(read, data, pin.integrate(read, pin.neutral(read), q), qd, qdd)
            # The base parameters neglect the effect of rounded angles on dependent columns.
            np.testing.assert_allclose(torque, expected, atol=2e-5 * np.abs(expected).max())
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
        model = RobotModel.from_urdf(urdf)
        standard = some_bodies(2)
        written = write_urdf(urdf, model, standard)
        assert (ROTATED in written) == (ROTATED in urdf)
        again = RobotModel.from_urdf(written).nominal.reshape(2, 11)[:, :10]
        np.testing.assert_allclose(again, standard.reshape(2, 11)[:, :10], atol=1e-12)

    @pytest.mark.parametrize(
        ("standard", "friction", "error", "message"),
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
    def test_inconsistent_parameters_are_refused(self, standard, friction, error, message):
        model = RobotModel.from_urdf(TWO_LINK)
        values = model.nominal.copy()
        if standard is ...:
            values = values[:3]
        else:
            values[[*standard]] = [*standard.values()]
        with pytest.raises(error, match=message):
            write_urdf(TWO_LINK, model, values, *([friction] if len(friction) else []))

    @pytest.mark.parametrize(
        ("text", "model_text", "error", "message"),
        [
            (urdf_text(), TWO_LINK, WriteBackError, "no joint 'shoulder'"),
            (LONGER, TWO_LINK, WriteBackError, "differs by"),
            (TWO_LINK, FIXED, WriteBackError, "'elbow'"),
            ("no xml", TWO_LINK, ModelError, "not XML"),
        ],
    )
    def test_the_description_of_another_robot_is_refused(self, text, model_text, error, message):
        model = RobotModel.from_urdf(model_text)
        with pytest.raises(error, match=message):
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


PROVENANCE = {"recording": "run_1.mcap\nsha256 0a1b", "made by": "hil 0.1.0"}
DRY = FrictionLaw(third=None)


@pytest.fixture(scope="module")
def fit():
    model = RobotModel.from_urdf(URDF, friction=DRY)
    rng = np.random.default_rng(0)
    q, qd, qdd = rng.normal(size=(3, 300, 2))
    values = np.concatenate([model.base.grouping @ model.nominal, [4.0, 2.0, 1.5, 0.8]])
    motion = Motion(np.arange(300.0), q, qd, qdd)
    torque = model.torque(values, motion) + rng.normal(size=(300, 2))
    factor = Factor.from_samples(model, motion, torque)
    estimated = estimate(model, factor)
    return model, estimated, consistent_estimate(model, factor, estimated)


def table(text):
    return list(csv.DictReader(line for line in text.splitlines() if not line.startswith("#")))


class TestParameters:
    def test_json_restores_every_number(self, fit):
        model, estimated, consistent = fit
        text = parameters_json(model, estimated, consistent=consistent, provenance=PROVENANCE)
        read = json.loads(text)
        assert [p["value"] for p in read["parameters"]] == estimated.values.tolist()
        assert [p["std"] for p in read["parameters"]] == estimated.std.tolist()
        assert [p["unit"] for p in read["parameters"]] == list(estimated.units)
        np.testing.assert_array_equal(read["covariance"], estimated.covariance)
        assert read["provenance"] == PROVENANCE
        assert estimate_in(read).method == estimated.method
        assert read["parameters"][0]["expression"] == "I1yy + I1m + 0.25 m2"
        links = read["standard"]["links"]
        assert [link["joint"] for link in links] == ["shoulder", "elbow"]
        assert [link["rotor_inertia"] for link in links] == consistent.standard[[10, 21]].tolist()
        assert links[1]["friction"] == {"f0": consistent.friction[1], "f1": consistent.friction[3]}

    def test_an_earlier_file_does_not_state_how_it_was_made(self, fit):
        model, estimated, _ = fit
        read = json.loads(parameters_json(model, estimated))
        del read["estimation"]
        assert estimate_in(read).method == EstimationMethod()

    def test_json_has_texts_for_undetermined_values(self, fit):
        model, estimated, _ = fit
        covariance = estimated.covariance.copy()
        covariance[0, :] = covariance[:, 0] = 0.0
        covariance[0, 0] = np.inf
        unknown = replace(
            estimated, covariance=covariance, condition=np.inf, undetermined=("I1yy",)
        )
        read = json.loads(parameters_json(model, unknown))
        assert read["parameters"][0]["std"] == read["condition"] == "Infinity"
        assert (read["undetermined"], read["standard"]) == (["I1yy"], None)

    def test_csv_restores_values_and_intervals(self, fit):
        model, estimated, _ = fit
        text = parameters_csv(model, estimated, provenance=PROVENANCE)
        assert "# recording: run_1.mcap sha256 0a1b" in text.splitlines()
        rows = table(text)
        assert [row["name"] for row in rows] == list(estimated.names)
        assert [float(row["estimate"]) for row in rows] == estimated.values.tolist()
        half = estimated.interval_factor * estimated.std
        for column, ends in (("low", estimated.values - half), ("high", estimated.values + half)):
            np.testing.assert_allclose([float(row[column]) for row in rows], ends, rtol=1e-15)

    def test_covariance_has_a_file_of_its_own(self, fit):
        _, estimated, _ = fit
        rows = table(covariance_csv(estimated, provenance=PROVENANCE))
        assert [row["name"] for row in rows] == list(estimated.names)
        covariance = [[float(row[name]) for name in estimated.names] for row in rows]
        np.testing.assert_array_equal(covariance, estimated.covariance)

    def test_a_row_says_what_its_parameter_is_and_of_what(self, fit):
        model, estimated, _ = fit
        rows = {row.name: row for row in parameter_table(model, estimated)}
        inertia = rows["I1yy"]
        assert inertia.meaning == "moment of inertia about y and what moves like it"
        assert (inertia.body, inertia.joint) == (model.chain.link(0), "shoulder")
        friction = rows["f0_2"]
        assert friction.meaning == "Coulomb (dry) friction f0"
        assert (friction.body, friction.joint) == ("", "elbow")

    @pytest.mark.parametrize(
        ("share", "known"), [(0.1, "yes"), (0.11, "roughly"), (0.5, "roughly"), (0.51, "no")]
    )
    def test_known_is_a_standard_deviation_of_a_tenth(self, fit, share, known):
        model, estimated, _ = fit
        covariance = np.diag((share * estimated.values) ** 2)
        rows = parameter_table(model, replace(estimated, covariance=covariance))
        assert {row.known for row in rows} == {known}

    def test_what_is_not_determined_is_not_known(self, fit):
        model, estimated, _ = fit
        exact = replace(estimated, covariance=0.0 * estimated.covariance, undetermined=("I1yy",))
        rows = {row.name: row.known for row in parameter_table(model, exact)}
        assert rows.pop("I1yy") == "no"
        assert set(rows.values()) == {"yes"}

    def test_no_remark_is_a_formula_or_breaks_its_row(self, fit):
        model, estimated, _ = fit
        text = parameters_csv(model, estimated, provenance={"archives": "a,=1+1.mcap;@b, -3"})
        assert len(table(text)) == model.n_parameters
        assert "a,'=1+1.mcap;'@b, -3" in text


LAW = FrictionLaw(asymmetric=True, stribeck=0.1, presliding=1e-3)


def compared(form, arm, remarks=(), samples=20):
    """Compare the file of an arm with its model; skips without a reader of the form."""
    if form == "mjcf":
        pytest.importorskip("mujoco", reason="the extra mujoco is not installed")
    if form == "sdf":
        pytest.importorskip("pydrake", reason="the extra sdf is not installed")
    text = FORMATS[form].write(arm, "arm", list(remarks))
    return compare(text, FORMATS[form], arm, random_states(arm, samples))


FORMS = pytest.mark.parametrize("form", FORMATS)


def dry_friction(form, text):
    """Dry friction of each joint in the text of a form."""
    if form == "pinocchio":
        model = pin.Model()
        model.loadFromString(text)
        assert np.array_equal(model.upperDryFrictionLimit, -model.lowerDryFrictionLimit)
        return model.friction.tolist()
    root = ElementTree.fromstring(text)
    if form == "sdf":
        return [float(element.text) for element in root.iter("friction")]
    where = {"mjcf": "frictionloss", "urdf": "friction"}[form]
    return [float(element.get(where)) for element in root.iter() if where in element.attrib]


class TestReadBack:
    """Inverse dynamics of the file agree with the supported parts of the model."""

    @FORMS
    @pytest.mark.parametrize("seed", [1, 2])
    def test_trees_of_any_joints(self, form, seed):
        arm = an_arm(random_urdf(seed), friction=FrictionLaw(third="cubic"))
        assert compared(form, arm).difference < AGREEMENT_TOLERANCE

    @FORMS
    def test_a_published_description(self, form):
        """With rounded angles and locked joints."""
        locked = dict.fromkeys(("panda_finger_joint1", "panda_finger_joint2"), 0.02)
        arm = an_arm(robot_text("panda_description/urdf/panda.urdf"), locked=locked)
        assert compared(form, arm, ["a -- remark"]).difference < AGREEMENT_TOLERANCE

    @FORMS
    def test_everything_that_an_arm_can_have(self, form):
        arm = an_arm(
            urdf_text(),
            friction=LAW,
            gravity=(0.0, 3.0, -9.0),
            coupling=Coupling(WRIST),
            payload=Payload(4.0, (0.0, 0.1, 0.2)),
            elements=[
                TorsionSpring("joint_2", 0.3, 50.0),
                TorsionSpring("joint_2", -0.1, identified=True),
                GasCylinder("joint_3", Anchors(0.8, 0.2, 0.1), 0.6, 1e-3, 1e6, 1e-3),
                TorqueRipple("joint_1", (1,), (("joint_1", 100.0),)),
            ],
        )
        left = set(compared(form, arm, samples=200).left_out)
        everywhere = {"half the difference fd of viscous friction forwards and backwards",
                      "additional friction fs at low speed (Stribeck)", "a constant offset fo",
                      "the torque ripple of joint_1",
                      "the gas spring or balancer of joint_3"}  # fmt: skip
        rotors = {"rotor inertias", "inertia of coupled motors", "friction of coupled motors"}
        assert left >= everywhere
        expected = {"mjcf": set(), "pinocchio": rotors - {"rotor inertias"}}
        assert left & rotors == expected.get(form, rotors)
        gravity = "gravity of 0, 3, -9 m/s² in base axes, which the simulator must have"
        assert (gravity in left) == (form in ("urdf", "sdf"))
        assert ("the payload" in left) == (form != "mjcf")
        assert ("the torsion spring of joint_2" in left) == (form != "mjcf")
        assert ("a term f2 with the speed squared" in left) == (form != "mjcf")

    def test_what_gravity_adds_is_that_of_the_simulator(self):
        """By pinocchio, the written file lacks the torque that is listed; its header says so."""
        arm = an_arm(urdf_text(), gravity=(0.0, -4.9, -8.5))
        text = FORMATS["urdf"].write(arm, "arm", [])
        assert "Identified with a gravity of 0, -4.9, -8.5 m/s²" in text
        motion = random_states(arm, 20)
        model = pin.buildModelFromXML(text)
        model.armature[:] = 0.0
        loaded = np.array([pin.rnea(model, model.createData(), *at) for at in motion.states()])
        lacks = np.sqrt(np.mean((rigid_torque(arm, motion) - loaded) ** 2, axis=0))
        left = compare(text, FORMATS["urdf"], arm, motion).left_out
        (listed,) = [torque for name, torque in left.items() if name.startswith("gravity")]
        assert lacks.max() > 1.0
        np.testing.assert_allclose(listed, lacks, atol=1e-9)

    def test_the_usual_gravity_is_not_mentioned(self):
        arm = an_arm(urdf_text())
        assert "gravity" not in FORMATS["urdf"].write(arm, "arm", [])
        assert not any("gravity" in name for name in compared("urdf", arm).left_out)

    @FORMS
    def test_a_changed_text_is_refused(self, form):
        arm = an_arm(urdf_text())
        compared(form, arm)
        other = replace(arm, standard=1.01 * arm.standard)
        text = FORMATS[form].write(other, "arm", [])
        with pytest.raises(WriteBackError, match="joint_"):
            compare(text, FORMATS[form], arm, random_states(arm, 5))


class TestTexts:
    """Content of the files beside the inertia."""

    def test_limits_springs_and_names(self):
        arm = an_arm(urdf_text(), elements=[TorsionSpring("joint_2", 0.3, 50.0)])
        n = arm.model.n_joints
        ranges = JointRanges(-np.ones(n), np.full(n, 2.0), np.full(n, 3.0), np.full(n, 40.0))
        arm = replace(arm, ranges=ranges)
        model = ElementTree.fromstring(mjcf(arm, "arm"))
        joint = model.find(".//joint[@name='joint_2']")
        assert joint.get("range") == "-1.0 2.0"
        assert joint.get("actuatorfrcrange") == "-40.0 40.0"
        assert (joint.get("stiffness"), joint.get("springref")) == ("50.0", "0.3")
        assert [motor.get("ctrlrange") for motor in model.iter("motor")] == ["-40.0 40.0"] * n
        assert "gravcomp" not in mjcf(arm, "arm")

    @FORMS
    def test_dry_friction_is_written_as_it_was_identified(self, form):
        arm = an_arm(urdf_text())
        f0 = [row["f0"] for row in arm.friction]
        assert dry_friction(form, FORMATS[form].write(arm, "arm", [])) == f0


class TestLoadFriction:
    """Friction that grows with the load becomes Coulomb friction at one load."""

    LOAD = np.array([400.0, 300.0, 100.0, 20.0, 10.0, 5.0])

    @FORMS
    def test_coulomb_friction_is_that_at_the_load(self, form):
        arm = replace(an_arm(urdf_text(), friction=FrictionLaw(load=True)), load=self.LOAD)
        model = arm.model
        table = model.friction.table(arm.values[model.friction_part])
        expected = [
            row["f0"] + row["fl"] * load for row, load in zip(table, self.LOAD, strict=True)
        ]
        text = FORMATS[form].write(arm, "arm", ["a remark"])
        np.testing.assert_allclose(dry_friction(form, text), expected, rtol=1e-12)
        if form == "pinocchio":
            return  # it has no place for remarks
        assert "Coulomb friction is that at a load of joint_1 400 N·m, joint_2 300 N·m" in text

    @FORMS
    def test_what_is_left_out_is_the_friction_beyond_that_load(self, form):
        arm = replace(an_arm(urdf_text(), friction=FrictionLaw(load=True)), load=self.LOAD)
        motion = random_states(arm, 60)
        model = arm.model
        comparison = compared(form, arm, samples=60)
        beyond = [torque for name, torque in comparison.left_out.items() if "grows" in name]
        shares = np.array(
            [row["fl"] for row in model.friction.table(arm.values[model.friction_part])]
        )
        sizes = np.abs(model.gear_torque(arm.values, motion))
        expected = np.sqrt(np.mean((shares * (sizes - self.LOAD)) ** 2, axis=0))
        np.testing.assert_allclose(beyond, [expected], rtol=1e-6)
        assert comparison.difference < AGREEMENT_TOLERANCE

    def test_a_joint_at_rest_has_the_friction_of_its_description(self):
        arm = an_arm(urdf_text(), friction=FrictionLaw(load=True))
        friction = arm.values[arm.model.friction_part]
        names = arm.model.parameter_names[arm.model.friction_part]
        friction = np.where([name.endswith("_6") for name in names], np.nan, friction)
        text = write_urdf(arm.urdf, arm.model, arm.standard, friction, load=self.LOAD)
        joints = {
            element.get("name"): element for element in ElementTree.fromstring(text).iter("joint")
        }
        before = {
            element.get("name"): element
            for element in ElementTree.fromstring(arm.urdf).iter("joint")
        }
        last, described = (elements["joint_6"].find("dynamics") for elements in (joints, before))
        assert (None if last is None else last.attrib) == (
            None if described is None else described.attrib
        )

    def test_the_curve_has_the_friction_of_a_load(self):
        arm = an_arm(urdf_text(), friction=FrictionLaw(load=True))
        row = arm.model.friction.table(arm.values[arm.model.friction_part])[1]
        plain, loaded = (
            friction_curve(arm.model, arm.values, 1, -1.0, 1.0, load) for load in (0.0, 300.0)
        )
        added = row["fl"] * 300.0 * np.sign(plain.speed)
        np.testing.assert_allclose(loaded.torque - plain.torque, added, rtol=1e-9)

    def test_the_median_load_is_that_of_usable_rows(self):
        model = RobotModel.from_urdf(TWO_LINK, friction=FrictionLaw(load=True))
        motion = four_sines(np.arange(0.0, 2.0, 0.01))
        values = np.arange(1.0, model.n_parameters + 1.0)
        sizes = np.abs(model.gear_torque(values, motion))
        usable = np.zeros(sizes.shape, dtype=bool)
        usable[50:, 0] = True  # the other joint never moves
        run = as_samples(model, motion, sizes, usable=usable)
        expected = [np.median(sizes[50:, 0]), np.median(sizes[:, 1])]
        np.testing.assert_allclose(median_load(model, values, [run]), expected)

    def test_parameters_list_the_shares(self):
        model = RobotModel.from_urdf(TWO_LINK, friction=FrictionLaw(load=True))
        assert not_in_urdf(model)[-2:] == (
            "a term f2 with the speed squared",
            messages.FRICTION_GROWS,
        )


class TestNoise:
    """Measured torque has noise at every frequency, unless it is low-passed."""

    TIME = np.arange(4000) * 0.005
    SHAPE = LowPassShape(order=4)

    def torque(self, noise):
        slow = 20.0 * np.sin(2.0 * np.pi * np.array([0.3, 0.9]) * self.TIME[:, None])
        return np.asarray(slow + noise * np.random.default_rng(3).standard_normal(slow.shape))

    def above(self, torque):
        return noiseless_above(self.TIME, torque, [slice(0, len(torque))])

    def test_of_half_a_per_cent_is_seen(self):
        assert self.above(self.torque(0.1)) is None

    @pytest.mark.parametrize("bandwidth", [2.0, 5.0, 10.0])
    def test_ends_above_a_low_pass(self, bandwidth):
        frequency = self.above(low_passed(self.TIME, self.torque(0.5), bandwidth, self.SHAPE))
        assert bandwidth < frequency < 2.5 * bandwidth

    def test_of_one_joint_is_enough_for_the_channel(self):
        torque = self.torque(0.1)
        torque[:, 1] = low_passed(self.TIME, torque[:, 1:], 5.0, self.SHAPE)[:, 0]
        assert self.above(torque) is None
