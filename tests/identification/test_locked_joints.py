from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
import pytest

from identification import ModelError, RobotModel
from identification.export.urdf import WriteBackError, write_urdf
from identification.model.kinematics import chain_from_urdf
from tests.identification.robots import one_joint, random_urdf, robot_text, some_bodies

TWO_LINK = (Path(__file__).parent / "two_link.urdf").read_text()
FINGERS = {"panda_finger_joint1": 0.02, "panda_finger_joint2": 0.03}


def panda() -> str:
    return robot_text("panda_description/urdf/panda.urdf")


@pytest.mark.parametrize("seed", range(6))
def test_a_locked_joint_is_one_that_never_moves(seed: int) -> None:
    """Torques of the other joints, with the locked ones held where they are."""
    urdf = random_urdf(seed)
    whole = RobotModel.from_urdf(urdf)
    random = np.random.default_rng(seed)
    held = {name: float(random.uniform(-2.0, 2.0)) for name in whole.joint_names[1::2]}
    model = RobotModel.from_urdf(urdf, locked=held)
    assert model.joint_names == tuple(n for n in whole.joint_names if n not in held)

    def values(of: RobotModel) -> np.ndarray:
        return np.append(of.base.grouping @ of.nominal, np.zeros(len(of.friction.terms)))

    q, qd, qdd = random.uniform(-2.0, 2.0, (3, 20, model.n_joints))
    free = [whole.joint_names.index(name) for name in model.joint_names]
    all_q, all_qd, all_qdd = np.zeros((3, 20, whole.n_joints))
    for name, position in held.items():
        all_q[:, whole.joint_names.index(name)] = position
    all_q[:, free], all_qd[:, free], all_qdd[:, free] = q, qd, qdd
    expected = whole.torque(values(whole), all_q, all_qd, all_qdd)[:, free]
    np.testing.assert_allclose(model.torque(values(model), q, qd, qdd), expected, atol=1e-9)


def test_the_panda_without_its_fingers_has_seven_axes() -> None:
    model = RobotModel.from_urdf(panda(), locked=FINGERS)
    assert model.n_joints == 7
    assert dict(model.locked) == FINGERS


def test_any_kind_of_joint_can_be_locked_at_zero() -> None:
    floating = one_joint("floating").replace("</robot>", "") + (
        '<link name="c"/><joint name="turns" type="continuous"><parent link="b"/>'
        '<child link="c"/><axis xyz="0 0 1"/></joint></robot>'
    )
    with pytest.raises(ModelError, match="'strange'"):
        RobotModel.from_urdf(floating)
    assert RobotModel.from_urdf(floating, locked={"strange": 0.0}).joint_names == ("turns",)
    with pytest.raises(ModelError, match="at 0 only"):
        RobotModel.from_urdf(floating, locked={"strange": 0.5})


def test_what_cannot_be_locked_is_refused_by_name() -> None:
    with pytest.raises(ModelError, match=r"no moving joint 'wrist' .* shoulder, elbow"):
        chain_from_urdf(TWO_LINK, {"wrist": 0.0})
    with pytest.raises(ModelError, match=r"'elbow'.*no number"):
        chain_from_urdf(TWO_LINK, {"elbow": float("nan")})
    with pytest.raises(ModelError, match="no revolute or prismatic joint"):
        chain_from_urdf(TWO_LINK, {"shoulder": 0.0, "elbow": 0.0})


@pytest.mark.parametrize("kind", ["revolute", "continuous", "prismatic"])
def test_no_joint_is_locked_about_an_axis_without_a_direction(kind: str) -> None:
    """Its placement would be no rotation: the cosine of the angle times the identity."""
    still = one_joint(kind, "0 0 0").replace("</robot>", "") + (
        '<link name="c"/><joint name="turns" type="continuous"><parent link="b"/>'
        '<child link="c"/><axis xyz="0 0 1"/></joint></robot>'
    )
    with pytest.raises(ModelError, match="'strange' has an <axis> without a direction"):
        chain_from_urdf(still, {"strange": 0.5})


def text(element: ElementTree.Element | None) -> str:
    assert element is not None
    return ElementTree.tostring(element, encoding="unicode")


def inertials(urdf: str) -> dict[str, ElementTree.Element | None]:
    links = ElementTree.fromstring(urdf).findall("link")
    return {link.get("name", ""): link.find("inertial") for link in links}


def test_written_back_locked_joints_stay_as_they_were() -> None:
    urdf = panda()
    model = RobotModel.from_urdf(urdf, locked=FINGERS)
    standard = model.nominal
    standard[model.layout.links] *= np.linspace(1.1, 1.5, 7)[:, None]
    written = write_urdf(urdf, model, standard)
    before, after = inertials(urdf), inertials(written)
    for finger in ("panda_leftfinger", "panda_rightfinger"):
        assert text(after[finger]) == text(before[finger])
    # The whole arm, read anew, carries what was identified with the fingers where they were.
    arm = pin.buildModelFromXML(written)
    assert arm.nv == 9
    again = chain_from_urdf(written, FINGERS).inertial
    np.testing.assert_allclose(again, standard[model.layout.links], atol=1e-8)
    # Fingers elsewhere move with it: their mass did not go into the hand.
    left = arm.inertias[arm.getJointId("panda_finger_joint1")].mass
    assert left == pin.buildModelFromXML(urdf).inertias[8].mass > 0.0


def test_where_nothing_possible_would_be_left_locked_links_are_merged() -> None:
    urdf = panda()
    model = RobotModel.from_urdf(urdf, locked=FINGERS)
    standard = some_bodies(7)
    standard[model.layout.links[6]] *= 1e-3  # lighter than the fingers alone
    written = write_urdf(urdf, model, standard)
    assert inertials(written)["panda_leftfinger"] is None
    again = chain_from_urdf(written, FINGERS).inertial
    np.testing.assert_allclose(again, standard[model.layout.links], atol=1e-8)


def test_a_joint_that_is_not_locked_is_still_asked_for() -> None:
    fixed = TWO_LINK.replace('name="elbow" type="revolute"', 'name="elbow" type="fixed"')
    model = RobotModel.from_urdf(fixed)
    with pytest.raises(WriteBackError, match="'elbow'"):
        write_urdf(TWO_LINK, model, model.nominal)


def test_a_joint_may_have_the_name_of_a_link() -> None:
    """The gripper of the SO-100 does."""
    named = TWO_LINK.replace('joint name="elbow"', 'joint name="lower"')
    assert '<link name="lower"' in named
    model = RobotModel.from_urdf(named, locked={"lower": 0.4})
    same = RobotModel.from_urdf(TWO_LINK, locked={"elbow": 0.4})
    np.testing.assert_array_equal(model.nominal, same.nominal)
    assert set(model.chain.frames) == set(same.chain.frames)
