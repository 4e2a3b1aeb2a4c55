from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st

from identification import FrictionLaw, ModelError, RobotModel, ShapeError, write_urdf
from identification.model.kinematics import FROM_PINOCCHIO, chain_from_urdf
from identification.model.pseudo_inertia import (
    AS_GIVEN,
    ASSUMED,
    MADE_POSSIBLE,
    Body,
    body,
    inertial_parameters,
    margin,
    pseudo_inertia,
    reference_bodies,
)
from identification.model.robot import StandardLayout
from sim_fixtures.ns16 import urdf_text
from tests.identification.robots import one_joint, random_urdf, robot_text, some_bodies
from tests.identification.two_link import URDF as TWO_LINK

TILTED = (2.0, -3.0, -9.0)


def inverse_dynamics(urdf, gravity, q, qd, qdd):
    """Return pinocchio's torques of the rigid bodies."""
    model = pin.buildModelFromXML(urdf)
    model.gravity.linear = np.array(gravity)
    data = model.createData()
    torque = np.empty(q.shape)
    for sample in range(len(q)):
        configuration = []
        for joint, angle in zip(list(model.joints)[1:], q[sample], strict=True):
            # pinocchio writes a continuous joint as a point on the circle
            configuration += [np.cos(angle), np.sin(angle)] if joint.nq == 2 else [angle]
        torque[sample] = pin.rnea(model, data, np.array(configuration), qd[sample], qdd[sample])
    return torque


CASES = {
    "ns16": (urdf_text, (0.0, 0.0, -9.81)),
    "ns16 tilted": (urdf_text, TILTED),
    "ur10": (lambda: robot_text("ur_description/urdf/ur10_robot.urdf"), (0.0, 0.0, -9.81)),
    "panda with its fingers": (lambda: robot_text("panda_description/urdf/panda.urdf"), TILTED),
    **{f"random tree {seed}": ((lambda s=seed: random_urdf(s)), TILTED) for seed in range(4)},
}


def slider(axis):
    return one_joint("prismatic", axis)


def followed(urdf):
    """Return a description with another joint after its last link."""
    return urdf.replace("</robot>", "") + (
        '<link name="c"/><joint name="turns" type="continuous"><parent link="b"/>'
        '<child link="c"/><axis xyz="0 0 1"/></joint></robot>'
    )


STILL = {kind: followed(one_joint(kind, "0 0 0")) for kind in ("revolute", "prismatic")}
BOTH = {"shoulder": 0.0, "elbow": 0.0}


class TestRobotModel:
    @pytest.mark.parametrize("case", CASES)
    def test_torque_is_pinocchios_plus_rotors_plus_friction(self, case):
        make, gravity = CASES[case]
        urdf = make()
        law = FrictionLaw(third="cubic", offset="random" not in case)
        model = RobotModel.from_urdf(urdf, gravity=gravity, friction=law)
        n = model.n_joints
        random = np.random.default_rng(5)
        q, qd, qdd = random.uniform(-3.0, 3.0, (3, 40, n))
        rotors = random.uniform(0.1, 5.0, n)
        f0, f1, f2, fo = random.uniform(-3.0, 3.0, (4, n))
        fo *= law.offset

        standard = model.nominal.reshape(n, 11)
        standard[:, 10] = rotors
        friction = [f0, f1, f2, fo] if law.offset else [f0, f1, f2]
        values = np.concatenate([model.base.grouping @ standard.reshape(-1), *friction])

        expected = inverse_dynamics(urdf, gravity, q, qd, qdd)
        expected += rotors * qdd + f0 * np.sign(qd) + f1 * qd + f2 * qd**3 + fo
        assert np.abs(model.torque(values, q, qd, qdd) - expected).max() < 1e-10

    def test_the_ns16_has_40_base_and_18_friction_parameters(self):
        model = RobotModel.from_urdf(urdf_text())
        assert model.joint_names == tuple(f"joint_{i}" for i in range(1, 7))
        assert model.n_parameters == len(model.units) == 58
        assert model.parameter_names[:40] == model.base.names
        assert model.parameter_names[40:42] == ("f0_1", "f0_2")
        assert model.parameter_names[46] == "f1_1"
        assert model.parameter_names[57] == "f2_6"
        unit = dict(zip(model.parameter_names, model.units, strict=True))
        assert unit["I1yy"] == unit["I3m"] == "kg m²"
        assert unit["mc2x"] == "kg m"
        assert unit["f0_1"] == "N·m"
        assert unit["f1_6"] == "N·m·s/rad"

    def test_a_prismatic_joint_has_linear_units(self):
        model = RobotModel.from_urdf(slider("1 0 0"))
        assert model.parameter_names == ("m1", "f0_1", "f1_1", "f2_1")
        assert model.units == ("kg", "N", "N·s/m", "N·s²/m²")
        assert model.base.expressions() == ("m1 + I1m",)

    @pytest.mark.parametrize(
        ("text", "locked", "words"),
        [
            (one_joint("fixed"), {}, "no revolute or prismatic joint"),
            (TWO_LINK, BOTH, "no revolute or prismatic joint"),
            *(
                (one_joint(kind), {}, "joint 'strange' is of type")
                for kind in ("floating", "planar")
            ),
            (followed(one_joint("floating")), {"strange": 0.5}, "can only be locked at 0"),
            (TWO_LINK, {"wrist": 0.0}, "no moving joint 'wrist' .* shoulder, elbow"),
            (TWO_LINK, {"elbow": float("nan")}, "'elbow'.*finite number"),
            # Its placement would not be a rotation.
            *(
                (text, {"strange": 0.5}, "'strange' has an <axis> of length")
                for text in STILL.values()
            ),
        ],
    )
    def test_invalid_descriptions_are_refused(self, text, locked, words):
        with pytest.raises(ModelError, match=words) as caught:
            RobotModel.from_urdf(text, locked=locked)
        assert caught.value.joint == ("strange" if "'strange'" in words else caught.value.joint)

    def test_an_offset_equal_to_a_weight_is_refused(self):
        law = FrictionLaw(offset=True)
        with pytest.raises(ModelError, match=r"'strange'.*offset"):
            RobotModel.from_urdf(slider("0 0 1"), friction=law)
        # accepted without a rotor inertia, and across gravity
        assert (
            RobotModel.from_urdf(slider("0 0 1"), friction=law, rotor_inertia=False).n_parameters
            == 5
        )
        assert RobotModel.from_urdf(slider("1 0 0"), friction=law).n_parameters == 5

    def test_arrays_of_the_wrong_shape_are_refused_by_name(self):
        model = RobotModel.from_urdf(urdf_text())
        good, short = np.zeros((5, 6)), np.zeros((4, 6))
        with pytest.raises(ShapeError, match=r"qd has shape \(4, 6\), expected \(5, 6\)"):
            model.regressor(good, short, good)
        with pytest.raises(ShapeError, match=r"q has shape \(6,\), expected \(m, 6\)"):
            model.regressor(good[0], good, good)
        with pytest.raises(ShapeError, match=r"values has shape \(57,\), expected \(58,\)"):
            model.torque(np.zeros(57), good, good, good)


PAIRS = ((0, 1), (1, 3))
LAYOUT = StandardLayout((True, False, True, False), rotor_inertia=True, pairs=PAIRS)


class TestStandardLayout:
    def test_parameters_have_indices_and_units(self):
        """Joint by joint, couplings last; rotors of prismatic joints have mass."""
        assert LAYOUT.size == len(LAYOUT.names) == len(LAYOUT.units) == 46
        assert LAYOUT.names[22:33] == (
            "I3xx", "I3xy", "I3xz", "I3yy", "I3yz", "I3zz", "mc3x", "mc3y", "mc3z", "m3", "I3m",
        )  # fmt: skip
        assert LAYOUT.names[44:] == ("I12", "I24")
        assert LAYOUT.links[2].tolist() == list(range(22, 32))
        assert LAYOUT.rotors.tolist() == [10, 21, 32, 43]
        assert LAYOUT.couplings.tolist() == [44, 45]
        assert [LAYOUT.units[k] for k in LAYOUT.rotors] == ["kg m²", "kg", "kg m²", "kg"]
        # torque of a revolute joint per acceleration of a prismatic one; force per acceleration
        assert [LAYOUT.units[k] for k in LAYOUT.couplings] == ["kg m", "kg"]
        assert LAYOUT.split([0, 9, 10, 25, 45]) == (
            [[0, 9], [], [3], []], [True, False, False, False], [1],
        )  # fmt: skip
        many = StandardLayout((True,) * 12, rotor_inertia=True, pairs=((0, 11), (10, 11)))
        assert many.names[-2:] == ("I1_12", "I11_12")
        assert len(set(many.names)) == many.size

    def test_the_rotors_make_a_symmetric_matrix(self):
        matrix = LAYOUT.rotor_matrix(np.arange(46.0))
        assert np.array_equal(matrix, matrix.T)
        assert np.array_equal(np.diag(matrix), [10.0, 21.0, 32.0, 43.0])
        assert (matrix[0, 1], matrix[1, 3], np.count_nonzero(matrix)) == (44.0, 45.0, 8)
        bare = StandardLayout((True, True), rotor_inertia=False)
        assert (bare.size, len(bare.rotors), len(bare.couplings)) == (20, 0, 0)
        assert not bare.rotor_matrix(np.ones(20)).any()
        with pytest.raises(ShapeError):
            bare.rotor_matrix(np.ones(22))


FINGERS = {"panda_finger_joint1": 0.02, "panda_finger_joint2": 0.03}


def panda():
    return robot_text("panda_description/urdf/panda.urdf")


def text(element):
    return ElementTree.tostring(element, encoding="unicode")


def inertials(urdf):
    links = ElementTree.fromstring(urdf).findall("link")
    return {link.get("name", ""): link.find("inertial") for link in links}


class TestLockedJoints:
    @pytest.mark.parametrize("seed", range(3))
    def test_a_locked_joint_equals_one_at_rest(self, seed):
        """Torques of the other joints agree with constant positions of the locked ones."""
        urdf = random_urdf(seed)
        whole = RobotModel.from_urdf(urdf)
        random = np.random.default_rng(seed)
        held = {name: float(random.uniform(-2.0, 2.0)) for name in whole.joint_names[1::2]}
        model = RobotModel.from_urdf(urdf, locked=held)
        assert model.joint_names == tuple(n for n in whole.joint_names if n not in held)

        def values(of):
            return np.append(of.base.grouping @ of.nominal, np.zeros(len(of.friction.terms)))

        q, qd, qdd = random.uniform(-2.0, 2.0, (3, 20, model.n_joints))
        free = [whole.joint_names.index(name) for name in model.joint_names]
        all_q, all_qd, all_qdd = np.zeros((3, 20, whole.n_joints))
        for name, position in held.items():
            all_q[:, whole.joint_names.index(name)] = position
        all_q[:, free], all_qd[:, free], all_qdd[:, free] = q, qd, qdd
        expected = whole.torque(values(whole), all_q, all_qd, all_qdd)[:, free]
        np.testing.assert_allclose(model.torque(values(model), q, qd, qdd), expected, atol=1e-9)

    def test_locked_links_are_merged_if_the_rest_is_inconsistent(self):
        urdf = panda()
        model = RobotModel.from_urdf(urdf, locked=FINGERS)
        standard = some_bodies(7)
        standard[model.layout.links[6]] *= 1e-3  # lighter than the fingers alone
        written = write_urdf(urdf, model, standard)
        assert inertials(written)["panda_leftfinger"] is None
        again = chain_from_urdf(written, FINGERS).inertial
        np.testing.assert_allclose(again, standard[model.layout.links], atol=1e-8)

    def test_a_joint_may_have_the_name_of_a_link(self):
        """As in the gripper of the SO-100."""
        named = TWO_LINK.replace('joint name="elbow"', 'joint name="lower"')
        assert '<link name="lower"' in named
        model = RobotModel.from_urdf(named, locked={"lower": 0.4})
        same = RobotModel.from_urdf(TWO_LINK, locked={"elbow": 0.4})
        np.testing.assert_array_equal(model.nominal, same.nominal)
        assert set(model.chain.frames) == set(same.chain.frames)


seeds = st.integers(0, 2**32 - 1)


def point_masses(seed, count=8):
    rng = np.random.default_rng(seed)
    return rng.uniform(0.1, 2.0, count), rng.normal(size=(count, 3))


def of_points(masses, places):
    """Return inertial parameters by definition: sums over point masses."""
    tensor = sum(
        m * ((p @ p) * np.eye(3) - np.outer(p, p)) for m, p in zip(masses, places, strict=True)
    )
    assert isinstance(tensor, np.ndarray)
    return np.concatenate([tensor[np.triu_indices(3)], masses @ places, [masses.sum()]])


class TestPseudoInertia:
    @given(seeds)
    def test_it_is_the_matrix_of_second_moments_of_the_mass(self, seed):
        masses, places = point_masses(seed)
        homogeneous = np.column_stack([places, np.ones(len(places))])
        expected = np.einsum("i,ij,ik->jk", masses, homogeneous, homogeneous)
        np.testing.assert_allclose(pseudo_inertia(of_points(masses, places)), expected, atol=1e-12)

    @given(seeds)
    def test_consistent_bodies_satisfy_the_triangle_inequalities(self, seed):
        """Of the tensor about the centre of mass."""
        rng = np.random.default_rng(seed)
        moments = rng.uniform(0.05, 1.0, 3)
        turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        some = Body(1.3, rng.normal(size=3), turn @ np.diag(moments) @ turn.T)
        possible = bool(np.all(moments.sum() - 2.0 * moments > 0.0))
        assert (margin(inertial_parameters(some)) > 0.0) == possible

    @given(seeds)
    def test_body_and_parameters_are_those_of_pinocchio(self, seed):
        inertial = of_points(*point_masses(seed))
        found = body(inertial)
        expected = pin.Inertia(found.mass, found.centre, found.inertia)
        order = list(FROM_PINOCCHIO)
        np.testing.assert_allclose(expected.toDynamicParameters()[order], inertial, atol=1e-12)
        np.testing.assert_allclose(inertial_parameters(found), inertial, atol=1e-12)


STEPS = np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.4]])


def a_link(moments, mass=2.0):
    return inertial_parameters(Body(mass, np.array([0.1, 0.0, 0.2]), np.diag(moments)))


SOUND, FLAT, POINT = (0.1, 0.1, 0.02), (0.001, 0.002, 0.02), (0.0, 0.0, 0.0)


class TestReferenceBodies:
    @pytest.mark.parametrize(
        ("moments", "words"), [(SOUND, AS_GIVEN), (FLAT, MADE_POSSIBLE), (POINT, MADE_POSSIBLE)]
    )
    def test_they_use_consistent_parts_of_a_link(self, moments, words):
        """All of a consistent link, mass and centre of an inconsistent one."""
        links = np.array([a_link(moments), a_link(SOUND), np.zeros(10)])
        found = reference_bodies(links, STEPS)
        assert found.origins == (words, AS_GIVEN, ASSUMED)
        possible = slice(None) if words == AS_GIVEN else slice(6, None)
        np.testing.assert_allclose(found.inertial[0, possible], links[0, possible], atol=1e-14)
        np.testing.assert_allclose(found.inertial[1], links[1], atol=1e-14)
        assert np.all(margin(found.inertial) > 1e-6)
        assert found.inertial[2, 9] == 2.0

    @given(st.integers(0, 2**32 - 1))
    def test_they_are_consistent(self, seed):
        rng = np.random.default_rng(seed)
        links = rng.normal(size=(3, 10)) * 10.0 ** rng.uniform(-3, 3, (3, 1))
        links[rng.random(3) < 0.3] = 0.0
        found = reference_bodies(links, np.zeros((3, 3)))
        assert np.all(margin(found.inertial) > 0.0)
        squares = found.frames @ found.frames.transpose(0, 2, 1)
        np.testing.assert_allclose(squares, pseudo_inertia(found.inertial), rtol=1e-9, atol=1e-12)
