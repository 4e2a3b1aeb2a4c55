"""What simulators read is the identified arm, and what they cannot read is named."""

from __future__ import annotations

from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest

from identification import FrictionLaw, RobotModel
from identification.export.simulators import (
    AGREES,
    FORMATS,
    Arm,
    Ranges,
    compare,
    mjcf,
    random_states,
    sdf,
)
from identification.export.urdf import WriteBackError
from identification.model.coupling import Coupling
from identification.model.elements import Anchors, GasCylinder, TorqueRipple, TorsionSpring
from identification.model.payload import Payload
from sim_fixtures.ns16 import urdf_text
from tests.identification.robots import random_urdf, robot_text, some_bodies

LAW = FrictionLaw(asymmetric=True, stribeck=0.1, presliding=1e-3)
WRIST = np.eye(6)
WRIST[5, 4] = 0.5


def an_arm(urdf: str, **options: object) -> Arm:
    """Possible bodies that have nothing to do with the description, and friction of all kinds."""
    model = RobotModel.from_urdf(urdf, **options)  # type: ignore[arg-type]
    n = model.n_joints
    standard = np.zeros(model.layout.size)
    standard[: 11 * n] = some_bodies(n)
    for k, (i, j) in enumerate(model.layout.pairs):
        rotors = model.layout.rotors[[i, j]]
        standard[model.layout.couplings[k]] = 0.3 * np.sqrt(np.prod(standard[rotors]))
    others = np.random.default_rng(1).uniform(0.1, 2.0, model.n_parameters - model.base.rank)
    values = np.concatenate([model.base.grouping @ standard, others])
    infinite = np.full(n, np.inf)
    return Arm(urdf, model, standard, values, Ranges(-infinite, infinite, infinite, infinite))


def readable(form: str) -> None:
    if form == "mjcf":
        pytest.importorskip("mujoco", reason="the extra mujoco is not installed")


FORMS = pytest.mark.parametrize("form", FORMATS)


class TestReadBack:
    """Inverse dynamics of the file are those of the model, in what the format has room for."""

    @FORMS
    @pytest.mark.parametrize("seed", [1, 2, 3])
    def test_trees_of_any_joints(self, form: str, seed: int) -> None:
        readable(form)
        arm = an_arm(random_urdf(seed), friction=FrictionLaw(third="cubic"))
        text = FORMATS[form].write(arm, "random", [])
        assert compare(text, FORMATS[form], arm, random_states(arm, 20)).difference < AGREES

    @FORMS
    def test_a_published_description(self, form: str) -> None:
        """Its angles are rounded; locked joints are part of the links that carry them."""
        readable(form)
        arm = an_arm(robot_text("panda_description/urdf/panda.urdf"),
                     locked={"panda_finger_joint1": 0.02, "panda_finger_joint2": 0.02})  # fmt: skip
        text = FORMATS[form].write(arm, "panda", ["a -- remark"])
        assert compare(text, FORMATS[form], arm, random_states(arm, 20)).difference < AGREES

    @FORMS
    def test_everything_that_an_arm_can_have(self, form: str) -> None:
        readable(form)
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
                TorqueRipple("joint_1", (("joint_1", 100.0),), (1,)),
            ],
        )
        motion = random_states(arm, 200)
        found = compare(FORMATS[form].write(arm, "arm", []), FORMATS[form], arm, motion)
        left = set(found.left_out)
        everywhere = {"half the difference fd of viscous friction forwards and backwards",
                      "additional friction fs at low speed (Stribeck)", "a constant offset fo",
                      "TorqueRipple of joint_1", "GasCylinder of joint_3"}  # fmt: skip
        rotors = {"rotor inertias", "inertia of coupled motors", "friction of coupled motors"}
        assert left >= everywhere
        assert (left >= rotors) == (form != "mjcf")
        assert ("the payload" in left) == (form == "urdf")
        assert ("TorsionSpring of joint_2" in left) == (form == "urdf")
        assert ("a term f2 with the speed squared" in left) == (form != "mjcf")

    @FORMS
    def test_parts_left_out_have_their_own_torque(self, form: str) -> None:
        readable(form)
        arm = an_arm(urdf_text(), friction=FrictionLaw(offset=True), coupling=Coupling(WRIST))
        motion = random_states(arm, 50)
        found = compare(FORMATS[form].write(arm, "arm", []), FORMATS[form], arm, motion)
        offset = arm.friction[0]["fo"]
        np.testing.assert_allclose(found.left_out["a constant offset fo"][0], offset)
        if form != "mjcf":
            rms = np.sqrt(np.mean((motion.acceleration * np.diag(arm.rotors)) ** 2, axis=0))
            np.testing.assert_allclose(found.left_out["rotor inertias"], rms)

    @FORMS
    def test_another_text_is_refused(self, form: str) -> None:
        readable(form)
        arm = an_arm(urdf_text())
        other = replace(arm, standard=1.01 * arm.standard)
        text = FORMATS[form].write(other, "arm", [])
        with pytest.raises(WriteBackError, match="joint_"):
            compare(text, FORMATS[form], arm, random_states(arm, 5))


class TestTexts:
    """What stands in the files beside the inertia."""

    def test_limits_springs_and_names(self) -> None:
        arm = an_arm(urdf_text(), elements=[TorsionSpring("joint_2", 0.3, 50.0)])
        n = arm.model.n_joints
        ranges = Ranges(-np.ones(n), np.full(n, 2.0), np.full(n, 3.0), np.full(n, 40.0))
        arm = replace(arm, ranges=ranges)
        model = ElementTree.fromstring(mjcf(arm, "arm"))
        joint = model.find(".//joint[@name='joint_2']")
        assert joint is not None
        assert joint.get("range") == "-1.0 2.0"
        assert joint.get("actuatorfrcrange") == "-40.0 40.0"
        assert (joint.get("stiffness"), joint.get("springref")) == ("50.0", "0.3")
        assert [one.get("ctrlrange") for one in model.iter("motor")] == ["-40.0 40.0"] * n
        assert "gravcomp" not in mjcf(arm, "arm")
        limit = ElementTree.fromstring(sdf(arm, "arm")).find(".//joint[@name='joint_2']/axis/limit")
        assert limit is not None
        assert {one.tag: one.text for one in limit} == {
            "lower": "-1.0", "upper": "2.0", "velocity": "3.0", "effort": "40.0"}  # fmt: skip

    @FORMS
    def test_dry_friction_is_written_as_it_was_identified(self, form: str) -> None:
        arm = an_arm(urdf_text())
        f0 = [row["f0"] for row in arm.friction]
        root = ElementTree.fromstring(FORMATS[form].write(arm, "arm", []))
        if form == "sdf":
            found = [float(one.text or 0) for one in root.iter("friction")]
        else:
            where = {"mjcf": "frictionloss", "urdf": "friction"}[form]
            found = [float(one.get(where, 0)) for one in root.iter() if where in one.attrib]
        assert found == f0

    def test_a_link_does_not_share_its_name_with_a_joint(self) -> None:
        urdf = urdf_text().replace('"link_2"', '"joint_2"')
        root = ElementTree.fromstring(sdf(an_arm(urdf), "arm"))
        names = [one.get("name") for tag in ("link", "joint", "frame") for one in root.iter(tag)]
        assert len(names) == len(set(names))
