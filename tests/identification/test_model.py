"""The model: torque, regressor, base parameters, friction, couplings, springs, locked joints."""

import gc
import math
import weakref
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import identification
from identification.errors import ModelError, ShapeError
from identification.estimators.consistent import consistent_estimate
from identification.export.urdf import write_urdf
from identification.factor.estimate import estimate
from identification.factor.factor import Factor, joined
from identification.model.base_parameters import DEPENDENCE_TOLERANCE
from identification.model.coupling import Coupling
from identification.model.elements import (
    Anchors,
    ElementError,
    ExtensionSpring,
    GasCylinder,
    JointElements,
    PositionTorque,
    TorqueRipple,
    TorsionSpring,
)
from identification.model.friction import FrictionLaw, JointFriction, dissipation, presliding_state
from identification.model.kinematics import PINOCCHIO_ORDER, chain_from_urdf
from identification.model.messages import law_text, reversal_text
from identification.model.motion import Motion
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
from identification.model.regressor import SAMPLES_PER_CHUNK
from identification.model.robot import RobotModel, StandardLayout
from identification.selection.essential import eliminate
from identification.signals.recording import Recording
from identification.signals.samples import Preprocessing, prepare
from identification.validation.prediction import prediction_error
from sim_fixtures.ns16 import N_ESSENTIAL, TABLE2, urdf_text
from tests.identification import two_link
from tests.identification.robots import NS16_TURNS, one_joint, random_urdf, robot_text, some_bodies
from tests.identification.two_link import MODEL, a_motion, coloured, recording, truth
from tests.identification.two_link import URDF as TWO_LINK

TILTED = (2.0, -3.0, -9.0)


def inverse_dynamics(urdf, gravity, motion):
    """Return pinocchio's torques of the rigid bodies."""
    model = pin.buildModelFromXML(urdf)
    model.gravity.linear = np.array(gravity)
    data = model.createData()
    torque = np.empty(motion.position.shape)
    for sample, (q, qd, qdd) in enumerate(motion.states()):
        configuration = []
        for joint, angle in zip(list(model.joints)[1:], q, strict=True):
            # pinocchio writes a continuous joint as a point on the circle
            configuration += [np.cos(angle), np.sin(angle)] if joint.nq == 2 else [angle]
        torque[sample] = pin.rnea(model, data, np.array(configuration), qd, qdd)
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

        motion = Motion.of_states(q, qd, qdd)
        expected = inverse_dynamics(urdf, gravity, motion)
        expected += rotors * qdd + f0 * np.sign(qd) + f1 * qd + f2 * qd**3 + fo
        assert np.abs(model.torque(values, motion) - expected).max() < 1e-10

    def test_inertia_of_the_joints_is_pinocchios_plus_rotors(self):
        robot = pin.buildModelFromXML(urdf_text())
        robot.armature = np.linspace(0.1, 5.0, robot.nv)
        model = RobotModel.from_urdf(urdf_text(), friction=FrictionLaw(third="cubic", offset=True))
        standard = model.nominal.reshape(-1, 11)
        standard[:, 10] = robot.armature
        values = np.append(model.base.grouping @ standard.reshape(-1), np.ones(4 * robot.nv))
        positions = np.random.default_rng(5).uniform(-3.0, 3.0, (5, robot.nv))
        expected = [pin.crba(robot, robot.createData(), position) for position in positions]
        symmetric = [np.triu(each) + np.triu(each, 1).T for each in expected]
        np.testing.assert_allclose(model.joint_inertia(values, positions), symmetric, atol=1e-10)

    @pytest.mark.parametrize(
        ("text", "locked", "message"),
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
    def test_invalid_descriptions_are_refused(self, text, locked, message):
        with pytest.raises(ModelError, match=message) as caught:
            RobotModel.from_urdf(text, locked=locked)
        assert caught.value.joint == ("strange" if "'strange'" in message else caught.value.joint)

    def test_an_offset_equal_to_a_weight_is_no_parameter_of_its_own(self):
        law = FrictionLaw(offset=True)
        assert RobotModel.from_urdf(slider("0 0 1"), friction=law).n_parameters == 5
        # it is one without a rotor inertia, and across gravity
        assert (
            RobotModel.from_urdf(slider("0 0 1"), friction=law, rotor_inertia=False).n_parameters
            == 5
        )
        assert RobotModel.from_urdf(slider("1 0 0"), friction=law).n_parameters == 5

    def test_arrays_of_the_wrong_shape_are_refused_by_name(self):
        model = RobotModel.from_urdf(urdf_text())
        good = np.zeros((5, 6))
        short = np.zeros((4, 6))
        with pytest.raises(ShapeError, match=r"velocity has shape \(4, 6\), expected \(5, 6\)"):
            model.regressor(Motion.of_states(good, short, good))
        with pytest.raises(ShapeError, match=r"position has shape \(6,\), expected \(m, 6\)"):
            model.regressor(Motion.of_states(good[0], good, good))
        with pytest.raises(ShapeError, match=r"values has shape \(57,\), expected \(58,\)"):
            model.torque(np.zeros(57), Motion.at_rest(good))


PAIRS = ((0, 1), (1, 3))
LAYOUT = StandardLayout((True, False, True, False), rotor_inertia=True, pairs=PAIRS)


class TestStandardLayout:
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
        all_q[:, free] = q
        all_qd[:, free] = qd
        all_qdd[:, free] = qdd
        expected = whole.torque(values(whole), Motion.of_states(all_q, all_qd, all_qdd))[:, free]
        motion = Motion.of_states(q, qd, qdd)
        np.testing.assert_allclose(model.torque(values(model), motion), expected, atol=1e-9)

    def test_locked_links_are_merged_if_the_rest_is_inconsistent(self):
        urdf = panda()
        model = RobotModel.from_urdf(urdf, locked=FINGERS)
        standard = some_bodies(7)
        standard[model.layout.links[6]] *= 1e-3  # lighter than the fingers alone
        written = write_urdf(urdf, model, standard)
        (finger,) = ElementTree.fromstring(written).findall("link[@name='panda_leftfinger']")
        assert finger.find("inertial") is None
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
        rigid_body = body(inertial)
        expected = pin.Inertia(rigid_body.mass, rigid_body.centre, rigid_body.inertia)
        order = list(PINOCCHIO_ORDER)
        np.testing.assert_allclose(expected.toDynamicParameters()[order], inertial, atol=1e-12)
        np.testing.assert_allclose(inertial_parameters(rigid_body), inertial, atol=1e-12)


STEPS = np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.4]])


def a_link(moments, mass=2.0):
    return inertial_parameters(Body(mass, np.array([0.1, 0.0, 0.2]), np.diag(moments)))


SOUND = (0.1, 0.1, 0.02)
FLAT = (0.001, 0.002, 0.02)
POINT = (0.0, 0.0, 0.0)


class TestReferenceBodies:
    @pytest.mark.parametrize(
        ("moments", "origin"), [(SOUND, AS_GIVEN), (FLAT, MADE_POSSIBLE), (POINT, MADE_POSSIBLE)]
    )
    def test_they_use_consistent_parts_of_a_link(self, moments, origin):
        """All of a consistent link, mass and centre of an inconsistent one."""
        links = np.array([a_link(moments), a_link(SOUND), np.zeros(10)])
        references = reference_bodies(links, STEPS)
        assert references.origins == (origin, AS_GIVEN, ASSUMED)
        possible = slice(None) if origin == AS_GIVEN else slice(6, None)
        np.testing.assert_allclose(references.inertial[0, possible], links[0, possible], atol=1e-14)
        np.testing.assert_allclose(references.inertial[1], links[1], atol=1e-14)
        assert np.all(margin(references.inertial) > 1e-6)
        assert references.inertial[2, 9] == 2.0

    @given(st.integers(0, 2**32 - 1))
    def test_they_are_consistent(self, seed):
        rng = np.random.default_rng(seed)
        links = rng.normal(size=(3, 10)) * 10.0 ** rng.uniform(-3, 3, (3, 1))
        links[rng.random(3) < 0.3] = 0.0
        references = reference_bodies(links, np.zeros((3, 3)))
        assert np.all(margin(references.inertial) > 0.0)
        squares = references.frames @ references.frames.transpose(0, 2, 1)
        np.testing.assert_allclose(
            squares, pseudo_inertia(references.inertial), rtol=1e-9, atol=1e-12
        )


@pytest.fixture(scope="module")
def ns16():
    return RobotModel.from_urdf(urdf_text())


ARMS = {
    "ur5": "ur_description/urdf/ur5_robot.urdf",
    "ur3 with a gripper": "ur_description/urdf/ur3_gripper.urdf",
    "panda, fingers sliding": "panda_description/urdf/panda.urdf",
    "kinova, continuous": "kinova_description/robots/kinova.urdf",
    "xarm7": "xarm_description/urdf/xarm7.urdf",
    "so100, joint named as its link": "so_arm_description/urdf/so100.urdf",
    "tiago, sliding torso": "tiago_description/robots/tiago_no_hand.urdf",
    "allegro hand, four branches": "allegro_hand_description/urdf/allegro_left_hand.urdf",
    "talos arm, mimicking": "talos_data/robots/talos_left_arm.urdf",
}


# Angles rounded in the file (1.5708) make singular values of up to 4e-5, real parameters of 1e-3.
ROUNDED = 1e-4


def rank_by_pinocchio(urdf):
    """Numerical rank of pinocchio's own regressor with a column per rotor."""
    model = pin.buildModelFromXML(urdf)
    data = model.createData()
    random = np.random.default_rng(11)
    rows = []
    for _ in range(20 + 2 * model.nv):
        q = pin.integrate(model, pin.neutral(model), random.uniform(-3.0, 3.0, model.nv))
        qd, qdd = random.uniform(-3.0, 3.0, (2, model.nv))
        links = pin.computeJointTorqueRegressor(model, data, q, qd, qdd)
        rows.append(np.hstack([links, np.diag(qdd)]))
    stacked = np.vstack(rows)
    length = np.linalg.norm(stacked, axis=0)
    felt = length > ROUNDED * length.max()
    singular = np.linalg.svd(stacked[:, felt] / length[felt], compute_uv=False)
    return int(np.count_nonzero(singular > ROUNDED * singular[0]))


class TestBaseParameters:
    @pytest.mark.parametrize("coupling", [None, Coupling(NS16_TURNS)])
    def test_the_groups_of_the_ns16_are_those_of_table_2(self, coupling):
        """Coupled motors add three inertias by themselves."""
        model = RobotModel.from_urdf(urdf_text(), coupling=coupling)
        rows = {row.pivot: row for row in TABLE2[:N_ESSENTIAL]}
        coupled_inertias = {"I45", "I46", "I56"} if coupling else set()
        assert set(model.base.names) == set(rows) | coupled_inertias
        assert model.base.largest_dropped < 1e-10 * model.base.smallest_pivot
        for name, group in zip(model.base.names, model.base.grouping, strict=True):
            # Rows 29 and 31 are printed for minus the pivot.
            terms, sign = (
                ({name: 1.0}, 1)
                if name in coupled_inertias
                else (rows[name].terms, rows[name].sign)
            )
            expected = np.zeros(len(model.layout.names))
            for standard, factor in terms.items():
                expected[model.layout.names.index(standard)] = sign * factor
            assert np.abs(group - expected).max() < 1e-10, name

    @pytest.mark.parametrize(
        ("gravity", "rotors", "rank"),
        [
            ((0.0, 0.0, -9.81), True, 40),
            ((0.0, 0.0, 9.81), True, 40),
            ((0.0, 0.0, -9.81), False, 36),
            ((3.0, 0.0, -9.0), True, 42),
        ],
    )
    def test_the_rank_of_the_ns16(self, gravity, rotors, rank):
        base = RobotModel.from_urdf(urdf_text(), gravity=gravity, rotor_inertia=rotors).base
        assert base.rank == len(base.names) == rank
        assert base.largest_dropped < 1e-10 * base.smallest_pivot
        assert base.smallest_pivot > 1000 * DEPENDENCE_TOLERANCE
        if gravity == (0.0, 0.0, 9.81):  # upside down it groups alike
            upright = RobotModel.from_urdf(urdf_text()).base
            assert np.allclose(base.grouping, upright.grouping, atol=1e-10)

    def test_angles_rounded_in_the_file_do_not_split_groups(self, ns16):
        text = urdf_text()
        assert "1.5707963267948966" in text
        rounded = RobotModel.from_urdf(text.replace("1.5707963267948966", "1.5708")).base
        assert rounded.names == ns16.base.names
        assert 1e-8 < rounded.largest_dropped < 1e-5 < rounded.smallest_pivot
        # Their traces are not printed as groups either.
        assert np.array_equal(rounded.grouping != 0.0, ns16.base.grouping != 0.0)

    def test_expressions_read_like_the_table_and_units_fit(self, ns16):
        expression = dict(zip(ns16.base.names, ns16.base.expressions(3), strict=True))
        assert expression["I1yy"] == (
            "I1yy + I1m + I2yy + 0.09 m2 + I3zz + 0.58 m3 + 0.614 m4 + 0.614 m5 + 0.614 m6"
        )
        assert expression["mc4z"] == "mc4z - mc5y"
        unit = dict(zip(ns16.parameter_names, ns16.units, strict=True))
        names = ("I1yy", "I3m", "mc2x", "f0_1", "f1_6")
        expected = ["kg·m²", "kg·m²", "kg·m", "N·m", "N·m·s/rad"]
        assert [unit[name] for name in names] == expected
        sliding = RobotModel.from_urdf(slider("1 0 0"))
        assert sliding.parameter_names == ("m1", "f0_1", "f1_1", "f2_1")
        assert sliding.units == ("kg", "N", "N·s/m", "N·s²/m²")
        assert sliding.base.expressions() == ("m1 + I1m",)

    def test_an_unclear_rank_is_reported(self, ns16):
        """The first axis a ten-thousandth of a radian off gravity: more is felt, but hardly."""
        assert ns16.base.explanation().startswith("40 of 66 standard parameters are independent")
        base = RobotModel.from_urdf(urdf_text().replace("1.5707963267948966", "1.5709")).base
        assert base.rank > ns16.base.rank
        assert base.smallest_pivot < 1e-4
        weakest = base.names[int(np.argmin(base.shares[base.pivots]))]
        assert f"{base.smallest_pivot:.1e} ({weakest})" in base.explanation()

    @pytest.mark.parametrize("arm", ARMS)
    def test_the_rank_is_that_of_pinocchios_regressor(self, arm):
        urdf = robot_text(ARMS[arm])
        base = RobotModel.from_urdf(urdf).base
        assert base.rank == rank_by_pinocchio(urdf)
        assert base.largest_dropped < 1e-4 * base.smallest_pivot


LAWS = st.builds(
    FrictionLaw,
    coulomb=st.booleans(),
    viscous=st.booleans(),
    third=st.sampled_from([None, "quadratic", "cubic"]),
    offset=st.booleans(),
    standstill=st.sampled_from([0.01, 0.2]),
    stribeck=st.sampled_from([None, 0.3]),
    asymmetric=st.booleans(),
    zone=st.sampled_from(["exclude", "linear"]),
)


def torque_of(law, coefficients, v):
    """Return the friction of one joint by the documented formula."""
    sign = np.sign(v)
    if law.zone == "linear" and abs(v) < law.standstill:
        sign = v / law.standstill
    terms = {
        "f0": sign,
        "f1": v,
        "fd": abs(v),
        "f2": v**3 if law.third == "cubic" else np.sign(v) * v**2,
        "fs": sign * np.exp(-((v / (law.stribeck or 1.0)) ** 2)),
        "fo": 1.0,
    }
    return float(sum(value * terms[symbol] for symbol, value in coefficients.items()))


def test_a_law_states_its_terms():
    assert (
        law_text(FrictionLaw(stribeck=0.1)) == "Coulomb, viscous, quadratic, Stribeck (0.1 rad/s)"
    )
    assert law_text(FrictionLaw(coulomb=False, viscous=False, third=None)) == "no friction"


def test_a_reversal_is_at_a_speed_over_a_displacement_or_at_once():
    assert reversal_text(tanh=0.05, presliding=0.0) == "tanh(v / 0.05 rad/s)"
    assert reversal_text(tanh=None, presliding=1e-3) == "presliding over 0.001 rad"
    assert reversal_text(tanh=None, presliding=0.0) == "sgn(v)"


def test_the_package_lists_its_names():
    assert {*identification.__all__} <= {*dir(identification)}
    with pytest.raises(AttributeError, match="no attribute 'robot_model'"):
        _ = identification.robot_model


class TestLawsOfJoints:
    @given(st.lists(LAWS, min_size=6, max_size=6), st.integers(0, 2**16))
    @settings(max_examples=25, deadline=None)
    def test_they_can_differ(self, laws, seed):
        names = [f"joint_{j}" for j in range(1, 7)]
        model = RobotModel.from_urdf(
            urdf_text(),
            friction=laws[0],
            joint_friction=dict(zip(names[1:], laws[1:], strict=True)),
        )
        random = np.random.default_rng(seed)
        friction = random.normal(size=len(model.friction.terms))
        values = np.concatenate([np.zeros(model.base.rank), friction])
        qd = random.choice([-2.0, -0.5, -0.1, -1e-3, 0.0, 1e-3, 0.1, 0.5, 2.0], (30, 6))
        q, qdd = random.normal(size=(2, 30, 6))
        torque = model.torque(values, Motion.of_states(q, qd, qdd))
        coefficients = [{} for _ in names]
        for name, value in zip(model.parameter_names[model.base.rank :], friction, strict=True):
            symbol, joint = name.split("_")
            coefficients[int(joint) - 1][symbol] = value
        expected = [
            [torque_of(laws[j], coefficients[j], v) for j, v in enumerate(row)] for row in qd
        ]
        np.testing.assert_allclose(torque, expected, atol=1e-11)

    def test_parameters_are_ordered_by_term(self):
        model = RobotModel.from_urdf(
            TWO_LINK,
            friction=FrictionLaw(third=None),
            joint_friction={"elbow": FrictionLaw(viscous=False, third="cubic", stribeck=0.1)},
        )
        assert model.friction.names == ("f0_1", "f0_2", "f1_1", "f2_2", "fs_2")
        assert model.friction.units == ("N·m", "N·m", "N·m·s/rad", "N·m·s³/rad³", "N·m")
        table = model.friction.table(np.arange(5.0))
        assert table == ({"f0": 0.0, "f1": 2.0}, {"f0": 1.0, "f2": 3.0, "fs": 4.0})

    def test_rows_at_rest_are_excluded_only_with_that_zone(self):
        model = RobotModel.from_urdf(
            TWO_LINK,
            friction=FrictionLaw(standstill=0.1),
            joint_friction={"elbow": FrictionLaw(standstill=0.1, zone="linear")},
        )
        speeds = np.array([[0.0, 0.0], [0.1, 0.1], [-0.11, 0.0]])
        assert model.moving(speeds).tolist() == [[False, True], [False, True], [True, True]]
        np.testing.assert_array_equal(model.friction.standstill, [0.1, 0.1])

    def test_invalid_ones_are_refused(self):
        with pytest.raises(ModelError, match="standstill"):
            FrictionLaw(zone="linear", standstill=0.0)
        with pytest.raises(ModelError, match=r"no joint 'wrist'.*shoulder, elbow"):
            RobotModel.from_urdf(TWO_LINK, joint_friction={"wrist": FrictionLaw()})


class TestDissipation:
    @given(st.lists(LAWS, min_size=2, max_size=2), st.booleans(), st.integers(0, 2**16))
    @settings(max_examples=30, deadline=None)
    def test_dissipative_combinations_dissipate_energy(self, laws, coupled, seed):
        coupling = Coupling(np.array([[1.0, 0.0], [0.5, 1.0]])) if coupled else None
        friction = JointFriction(tuple(laws), (True, True), coupling)
        combine, not_negative = dissipation(friction)
        assert np.linalg.matrix_rank(combine) == len(friction.terms)
        g = np.random.default_rng(seed).exponential(size=len(friction.terms))
        g[~not_negative] = 0.0
        values = dict(zip(friction.names, combine @ g, strict=True))
        for joint, law in enumerate(laws, start=1):
            coefficients = {s: values[f"{s}_{joint}"] for s in law.symbols}
            for v in (-3.0, -0.01, 0.01, 3.0):
                assert torque_of(law, coefficients, v) * v >= -1e-12

    def test_all_dissipative_friction_is_allowed_and_no_other(self):
        law = FrictionLaw(third=None, asymmetric=True, stribeck=0.2)
        friction = JointFriction((law,), (True,))
        combine, not_negative = dissipation(friction)
        possible = {"f0": 2.0, "f1": 1.0, "fd": -0.9, "fs": -1.8, "fo": -5.0}
        for change in ({}, {"fd": -1.1}, {"fs": -2.1}, {"f0": -0.1}, {"fd": 1.1}):
            values = possible | change
            g = np.linalg.solve(combine, [values[term.symbol] for term in friction.terms])
            assert np.all(g[not_negative] >= 0.0) == (change == {}), change


steps = st.lists(st.sampled_from([-3e-4, -1e-5, 0.0, 1e-5, 2e-3]), min_size=2, max_size=60)
distances = st.sampled_from([1e-5, 1e-4, 1e-3])


class TestPreslidingState:
    @given(steps=steps, distance=distances)
    def test_it_is_dahls_recursion(self, steps, distance):
        """z <- s + (z - s) exp(-|dq| / d), from zero."""
        position = 0.3 + np.cumsum([0.0, *steps])
        state = 0.0
        expected = [0.0]
        for step in np.diff(position):
            state = np.sign(step) + (state - np.sign(step)) * np.exp(-abs(step) / distance)
            expected.append(state)
        states_of = presliding_state(position, distance)
        np.testing.assert_allclose(states_of, expected, atol=1e-12)
        assert np.all(np.abs(states_of) <= 1.0)


class TestDirectionOfFriction:
    def test_without_presliding_it_is_the_sign(self):
        motion = a_motion()
        direction = MODEL.friction.direction(motion)
        np.testing.assert_array_equal(direction, np.sign(motion.velocity))

    def test_the_torque_uses_the_direction_of_a_motion(self):
        motion = a_motion()
        half = replace(motion, direction=0.5 * np.sign(motion.velocity))
        dry = np.zeros_like(truth())
        dry[MODEL.parameter_names.index("f0_1")] = 4.0
        dry[MODEL.parameter_names.index("f0_2")] = 2.0
        np.testing.assert_allclose(
            MODEL.torque(dry, half), 0.5 * MODEL.torque(dry, motion), atol=1e-12
        )


@pytest.fixture(scope="module")
def coupled():
    return RobotModel.from_urdf(urdf_text(), coupling=Coupling(NS16_TURNS))


class TestCoupling:
    """Motors that turn with several joints."""

    def test_rotors_and_motor_friction_act_through_it(self, coupled):
        """tau = K' J K qdd + sum of c_m' f_m(c_m qd), computed from K here."""
        motion = some_states(40)
        inertia = np.random.default_rng(1).uniform(1e-4, 1e-3, 6)
        rotors = NS16_TURNS.T @ np.diag(inertia) @ NS16_TURNS
        standard = np.zeros(len(coupled.layout.names))
        standard[coupled.layout.rotors] = np.diag(rotors)
        standard[coupled.layout.couplings] = rotors[3, 4], rotors[3, 5], rotors[4, 5]
        np.testing.assert_allclose(coupled.layout.rotor_matrix(standard), rotors, atol=1e-12)

        friction = np.zeros(len(coupled.friction.terms))
        friction[-4:] = 2.0, 3.0, 0.5, 0.7
        values = np.concatenate([coupled.base.grouping @ standard, friction])
        expected = motion.acceleration @ rotors
        for motor, coulomb, viscous in ((4, 2.0, 0.5), (5, 3.0, 0.7)):
            c = NS16_TURNS[motor] / NS16_TURNS[motor, motor]
            speed = motion.velocity @ c
            expected += np.outer(coulomb * np.sign(speed) + viscous * speed, c)
        np.testing.assert_allclose(coupled.torque(values, motion), expected, atol=1e-9)

    def test_rows_need_moving_motors(self, coupled):
        qd = np.ones((1, 6))
        # Joint speeds at which motor 5 is at rest: c_5 qd = 0.
        qd[0, 4] = 0.2
        assert coupled.moving(qd).tolist() == [[True, True, True, False, False, True]]

    def test_uncoupled_motors_add_nothing(self):
        uncoupled = RobotModel.from_urdf(urdf_text())
        with_gears = RobotModel.from_urdf(
            urdf_text(), coupling=Coupling(np.diag(np.diag(NS16_TURNS)))
        )
        assert with_gears.parameter_names == uncoupled.parameter_names
        blocks = [model.regressor(some_states(40)).blocks for model in (with_gears, uncoupled)]
        assert all(map(np.array_equal, *blocks))

    @pytest.mark.parametrize(
        ("matrix", "message"),
        [
            (np.array([[0.0, 1.0], [1.0, 0.0]]), "motor 1 .* does not turn with joint 1"),
            (np.array([[1.0, 0.0], [16.0, 1e-308]]), "motor 2 .* does not turn with joint 2"),
            (np.ones((2, 2)), "singular"),
        ],
    )
    def test_an_invalid_one_is_refused(self, matrix, message):
        with pytest.raises(ModelError, match=message):
            Coupling(matrix)


ANCHORS = Anchors(base=0.8, link=0.2, angle=math.radians(5.0))
# A balancer of a heavy arm: 163 bar in 0.96 litres at a length of 0.6 m.
BALANCER = GasCylinder(
    "joint2",
    ANCHORS,
    length=0.6,
    area=math.pi * (0.055**2 - 0.03**2) / 4.0,
    pressure=1.01 * 296.8 * 328.0 * 2.0 * 0.0795 / (2.0 * 0.00048),
    volume=2.0 * 0.00048,
)
GAS_SPRING = GasCylinder("joint2", Anchors(0.5, 0.1, -0.7), 0.5, 5e-5, 8e6, 4e-5, pulls=False)
TORSION = TorsionSpring("joint2", rest=0.3, stiffness=40.0)
EXTENSION = ExtensionSpring("joint2", ANCHORS, free_length=0.4, stiffness=900.0, preload=60.0)
POSITIONS = np.linspace(-3.0, 3.0, 41)


def apart(anchors, q):
    """Return the distance of two points in a plane, one of which rotates with the joint."""
    base = np.array([anchors.base, 0.0])
    turned = q + anchors.angle
    link = anchors.link * np.column_stack([np.cos(turned), np.sin(turned)])
    return np.asarray(np.linalg.norm(link - base, axis=1))


def extension_energy(q):
    longer = apart(ANCHORS, q) - 0.4
    return np.asarray(0.5 * 900.0 * longer**2 + 60.0 * longer)


def gas_energy(cylinder, q):
    """Return the work on an isothermal gas, ``-p0 V0 log(V / V0)``."""
    longer = apart(cylinder.anchors, q) - cylinder.length
    volume = cylinder.volume - (longer if cylinder.pulls else -longer) * cylinder.area
    return np.asarray(-cylinder.pressure * cylinder.volume * np.log(volume / cylinder.volume))


class TestElementTorque:
    @pytest.mark.parametrize(
        ("element", "energy"),
        [
            (TORSION, lambda q: np.asarray(0.5 * 40.0 * (q - 0.3) ** 2)),
            (EXTENSION, extension_energy),
            (BALANCER, lambda q: gas_energy(BALANCER, q)),
            (GAS_SPRING, lambda q: gas_energy(GAS_SPRING, q)),
        ],
    )
    def test_is_the_derivative_of_an_energy(self, element, energy):
        """The torque of the drive is the derivative of the stored energy."""
        h = 1e-5
        slope = (energy(POSITIONS + h) - energy(POSITIONS - h)) / (2.0 * h)
        np.testing.assert_allclose(element.known_torque(POSITIONS), slope, rtol=1e-6, atol=1e-5)

    @pytest.mark.parametrize("element", [TORSION, BALANCER, GAS_SPRING])
    def test_is_columns_times_nominal_values(self, element):
        """An identified element with its nominal values has the torque of the known one."""
        free = replace(element, identified=True)
        nominal = JointElements.of([free], ["joint2"], [True]).nominal
        torque = free.columns(POSITIONS) @ nominal + free.known_torque(POSITIONS)
        np.testing.assert_allclose(torque, element.known_torque(POSITIONS), rtol=1e-12)

    def test_a_given_preload_stays_known(self):
        """The preload of an identified spring is a parameter unless it is given."""
        both = replace(EXTENSION, preload=None, identified=True)
        with_preload = replace(EXTENSION, identified=True)
        assert (both.symbols, with_preload.symbols) == (("spring", "preload"), ("spring",))
        assert JointElements.of([both], ["joint2"], [True]).units == ("N/m", "N")
        whole = EXTENSION.known_torque(POSITIONS)
        np.testing.assert_allclose(both.columns(POSITIONS) @ [900.0, 60.0], whole)
        np.testing.assert_allclose(
            with_preload.columns(POSITIONS)[:, 0] * 900 + with_preload.known_torque(POSITIONS),
            whole,
        )


DATA = Path(__file__).resolve().parents[3] / "shared" / "data"


@pytest.mark.skipif(not DATA.is_dir(), reason=f"there are no recordings in {DATA}")
class TestPublishedRecordings:
    TURNS = np.diag([32.0, 32.0, 45.0, -48.0, 45.0, 32.0])
    TURNS[5, 4] = TURNS[5, 5]  # joint 5 turns motor 6 along

    def test_a_balancer_is_reproduced(self):
        """A recording with and one without its balancer differ by the computed torque."""
        raw, off = (
            np.genfromtxt(DATA / "kr300" / name, delimiter=",", names=True)
            for name in ("A.csv", "Abal.csv")
        )
        np.testing.assert_allclose(
            BALANCER.known_torque(raw["q2"]), raw["tau2"] - off["tau2"], atol=1e-6
        )

    def fitted(self, coupling):
        """Return the least-squares estimate of the TX40, and its error."""
        motor, torque = (
            np.loadtxt(DATA / "tx40" / name, delimiter=",", skiprows=1)
            for name in ("pos_read_data.csv", "curr_data.csv")
        )
        recorded = Recording(
            time=np.arange(len(motor)) * 2e-4,
            position=motor @ np.linalg.inv(self.TURNS).T
            + np.pi / 2 * np.array([0, -1, 1, 0, 0, 0]),
            joint_names=tuple(f"joint_{j}" for j in range(1, 7)),
            torque=torque @ self.TURNS,
        )
        urdf = (DATA / "tx40" / "tx40_mdh_modified.urdf").read_text(encoding="utf-8")
        model = RobotModel.from_urdf(urdf, friction=FrictionLaw(offset=True), coupling=coupling)
        options = Preprocessing(smooth_torque=True, torque_bandwidth=40.0)
        samples = prepare(recorded, model, options=options)
        estimated = estimate(model, Factor.of(model, samples), np.ones(6))
        (error,) = prediction_error(model, estimated.values, [samples], all_rows=True)
        return estimated, error

    @pytest.mark.slow
    def test_a_coupled_wrist_follows_the_published_parameters(self):
        """Comparators: 10.9 % with, 14.3 % without; joint 5 19 and 53 %; Iam6, fsm6, fvm6."""
        _, without = self.fitted(None)
        estimated, coupled = self.fitted(Coupling(self.TURNS))
        assert coupled.overall <= 0.109 < 0.12 < without.overall
        assert coupled.relative[4] <= 0.19 < 0.45 < without.relative[4]
        values = [estimated.value(name) for name in ("I56", "f0_m6", "f1_m6")]
        assert values == pytest.approx([0.00964, 1.95, 0.616], rel=0.05)


class TestElementFigures:
    @pytest.mark.parametrize(
        ("make", "message"),
        [
            (lambda: TorsionSpring("a", 0.0), "neither a stiffness nor identified"),
            (lambda: Anchors(0.2, 0.2, 0.0), "distance is zero at one angle"),
            (lambda: replace(BALANCER, volume=5e-4), "the gas has -0.000168 m³ left"),
        ],
    )
    def test_invalid_values_are_refused(self, make, message):
        with pytest.raises(ModelError, match=message):
            make()

    def test_joint_must_exist_and_be_revolute(self):
        with pytest.raises(ModelError, match="no joint 'joint2'"):
            JointElements.of([TORSION], ["a"], [True])
        with pytest.raises(ModelError, match="prismatic"):
            JointElements.of([TORSION], ["joint2"], [False])


def with_elements(*elements):
    return RobotModel.from_urdf(two_link.URDF, friction=FrictionLaw(third=None), elements=elements)


JOINTS = two_link.MODEL.joint_names
SPRING = TorsionSpring(JOINTS[0], rest=0.3, stiffness=40.0, identified=True)
GAS = replace(BALANCER, joint=JOINTS[1], pressure=4e5, identified=True)


class TestElementModel:
    def test_parameters_come_last(self):
        """Base parameters, friction, then elements in the order of the file."""
        model = with_elements(SPRING, GAS)
        assert model.parameter_names[two_link.P :] == ("spring_1", "balancer_2")
        assert model.units[two_link.P :] == ("N·m/rad", "1")
        assert model.parameter_names[model.friction_part] == model.friction.names
        assert model.parameter_names[model.element_part] == model.elements.names
        assert not model.friction_columns[model.element_part].any()

    def test_torque_adds_to_that_of_the_arm(self):
        """W pi with elements is W pi without them plus their torque."""
        model = with_elements(SPRING, GAS)
        motion = two_link.a_motion()
        values = np.concatenate([two_link.truth(), [35.0, 0.8]])
        expected = two_link.MODEL.torque(two_link.truth(), motion)
        expected[:, 0] += 35.0 * (motion.position[:, 0] - 0.3)
        expected[:, 1] += 0.8 * replace(GAS, identified=False).known_torque(motion.position[:, 1])
        np.testing.assert_allclose(model.torque(values, motion), expected, atol=1e-9)
        dense = model.regressor(motion).dense(model.n_parameters) @ values
        np.testing.assert_allclose(dense, expected, atol=1e-9)
        other = model.with_friction(coulomb=False)
        assert other.parameter_names[other.element_part] == model.elements.names

    def test_ripple_turns_with_the_motor(self):
        """Cosine and sine of each order of the angle of a coupled motor."""
        motor = tuple(zip(JOINTS, (20.0, -30.0), strict=True))
        model = with_elements(TorqueRipple(JOINTS[1], (1, 2), motor))
        motion = two_link.a_motion()
        assert model.parameter_names[model.element_part] == tuple(
            f"ripple_{wave}{order}_2" for order in (1, 2) for wave in ("cos", "sin")
        )
        values = np.concatenate([two_link.truth(), [0.0, 0.0, 0.3, 0.4]])
        angle = 20.0 * motion.position[:, 0] - 30.0 * motion.position[:, 1]
        expected = two_link.MODEL.torque(two_link.truth(), motion)
        expected[:, 1] += 0.5 * np.sin(2.0 * angle + np.arctan2(0.3, 0.4))
        np.testing.assert_allclose(model.torque(values, motion), expected, atol=1e-9)

    def test_a_position_torque_repeats_with_the_turn_of_its_joint(self):
        model = with_elements(PositionTorque(JOINTS[0]))
        motion = two_link.a_motion()
        q = motion.position[:, 0]
        assert model.parameter_names[model.element_part] == tuple(
            f"position_{wave}{order}_1" for order in (2, 3, 4) for wave in ("cos", "sin")
        )
        values = np.concatenate([two_link.truth(), [0.3, 0.0, 0.0, 0.2, 0.1, 0.0]])
        expected = two_link.MODEL.torque(two_link.truth(), motion)
        expected[:, 0] += 0.3 * np.cos(2.0 * q) + 0.2 * np.sin(3.0 * q) + 0.1 * np.cos(4.0 * q)
        np.testing.assert_allclose(model.torque(values, motion), expected, atol=1e-9)
        element = PositionTorque(JOINTS[0])
        assert element.columns(q[:0]).shape == (0, 6)  # of a joint that never moved

    def test_known_elements_are_load(self):
        sprung_model = with_elements(replace(SPRING, identified=False))
        motion = two_link.a_motion(1.0)
        assert sprung_model.parameter_names == two_link.MODEL.parameter_names
        load = sprung_model.load_torque(motion)
        np.testing.assert_allclose(load[:, 0], 40.0 * (motion.position[:, 0] - 0.3))
        assert not load[:, 1].any()
        assert sprung_model.has_load and not two_link.MODEL.has_load

    def test_equal_elements_are_refused(self):
        with pytest.raises(ElementError, match=r"spring_1b .* cannot be distinguished"):
            with_elements(SPRING, SPRING)

    def test_an_element_equal_to_a_weight_is_refused(self):
        """A spring with free length zero has the torque of a weight."""
        pendulum = one_joint("revolute", axis="1 0 0")
        spring = ExtensionSpring(
            "strange", Anchors(0.8, 0.2, 0.4), free_length=0.0, preload=0.0, identified=True
        )
        with pytest.raises(ElementError, match="such as a weight"):
            RobotModel.from_urdf(pendulum, elements=[spring])
        longer = replace(spring, free_length=0.3)
        assert RobotModel.from_urdf(pendulum, elements=[longer]).n_parameters > 0


@pytest.fixture(scope="module")
def identified():
    """A model with two elements, its true values, and the factor of a recording."""
    model = with_elements(SPRING, GAS)
    motion = two_link.a_motion()
    values = np.concatenate([two_link.truth(), [-35.0, 0.8]])
    samples = two_link.simulated(model, values, motion, two_link.NOISE, 3)
    return model, values, Factor.of(model, samples)


class TestIdentifiedElements:
    def test_least_squares_finds_them(self, identified):
        model, values, factor = identified
        estimated = estimate(model, factor)
        assert np.all(np.abs(estimated.values - values) <= 4.5 * estimated.std)

    def test_the_consistent_solution_leaves_them_free(self, identified):
        """A stiffness may be negative and has no prior."""
        model, values, factor = identified
        free = estimate(model, factor)
        element_columns = model.element_part
        consistent = consistent_estimate(model, factor, free)
        assert len(consistent.friction) == len(model.friction.terms)
        assert np.all(
            np.abs(consistent.estimate.values - values)[element_columns]
            <= 4.5 * free.std[element_columns]
        )


def some_states(m, seed=3):
    return Motion.of_states(*np.random.default_rng(seed).uniform(-3.0, 3.0, (3, m, 6)))


class TestRegressor:
    def test_blocks_have_only_columns_that_act_on_the_joint(self, ns16):
        regressor = ns16.regressor(some_states(50))
        both = zip(regressor.blocks, regressor.columns, strict=True)
        for number, (block, columns) in enumerate(both, start=1):
            names = [ns16.parameter_names[c] for c in columns]
            assert block.shape == (50, len(names))
            assert len(set(names)) == len(names)
            link = [int("".join(filter(str.isdigit, n.split("_")[-1]))) for n in names]
            assert min(link) >= number, "a link that the joint does not move"
            alone = [n for n in names if "_" in n or (n.endswith("m") and n[0] == "I")]
            assert all(str(number) in n for n in alone)
        # the last joint: link, rotor, friction
        assert len(regressor.columns[5]) == 8 + 3

    @pytest.mark.parametrize(
        "m",
        [
            0,
            1,
            2,
            63,
            65,
            SAMPLES_PER_CHUNK - 1,
            SAMPLES_PER_CHUNK,
            SAMPLES_PER_CHUNK + 1,
            2 * SAMPLES_PER_CHUNK + 77,
        ],
    )
    def test_samples_are_independent(self, ns16, m):
        motion = some_states(m)
        whole = ns16.regressor(motion)
        assert [len(block) for block in whole.blocks] == [m] * 6
        for t in {0, m // 2, m - 1} if m else ():
            alone = ns16.regressor(motion.rows(slice(t, t + 1)))
            for long, short in zip(whole.blocks, alone.blocks, strict=True):
                assert np.allclose(long[t], short[0], rtol=1e-13, atol=1e-13)

    def test_threads_do_not_share_working_arrays(self, ns16):
        first = some_states(300, seed=1)
        second = some_states(300, seed=2)
        alone = [np.concatenate([b.copy() for b in rows]) for _, rows in ns16.plan.chunks(first)]
        together = []
        for (_, rows), _ in zip(ns16.plan.chunks(first), ns16.plan.chunks(second), strict=True):
            together.append(np.concatenate([b.copy() for b in rows]))
        assert np.array_equal(np.hstack(alone), np.hstack(together))

    @pytest.mark.parametrize("angle", [0.0, np.pi / 2, np.pi, -np.pi, 1e4])
    def test_it_is_continuous_at_all_angles(self, ns16, angle):
        # tan(q / 2), from which the rotation is computed, has a pole at pi
        motion = some_states(3)
        motion.position[:] = angle
        nearby = ns16.regressor(replace(motion, position=motion.position + 1e-9))
        for at, near in zip(ns16.regressor(motion).blocks, nearby.blocks, strict=True):
            assert np.all(np.isfinite(at))
            assert np.allclose(at, near, atol=1e-6)

    def test_working_arrays_are_freed_with_the_model(self):
        """Without the cycle collector, which may run minutes later."""
        model = RobotModel.from_urdf(urdf_text())
        model.regressor(some_states(SAMPLES_PER_CHUNK))
        plan = weakref.ref(model.plan)
        gc.disable()
        try:
            del model
            assert plan() is None
        finally:
            gc.enable()


@pytest.fixture(scope="module")
def samples():
    motion = a_motion(5.0)
    return recording(coloured(np.random.default_rng(7), 1000, 5e-3, 0.02), motion)


class TestBlocksOfTime:
    def test_blocks_can_be_selected_joined_and_merged(self, samples):
        phase = Factor.by_time(MODEL, samples)
        half = len(phase) // 2
        again = joined([phase.blocks(slice(0, half)), phase.blocks(slice(half, None))])
        weights = np.array([0.5, 2.0])
        np.testing.assert_array_equal(again.by_block(weights), phase.by_block(weights))
        dense = np.tensordot(weights, phase.gram, axes=1)
        for length in (1, 3, len(phase)):
            merged = phase.merged(length)
            assert len(merged) == -(-len(phase) // length)
            np.testing.assert_allclose(merged.by_block(weights).sum(axis=0), dense, rtol=1e-12)
        order = np.array([5, 0, 3])
        place = np.append(order, MODEL.n_parameters)
        some = phase.restricted(order)
        assert some.parameter_names == tuple(MODEL.parameter_names[k] for k in order)
        np.testing.assert_allclose(
            some.by_block(weights), phase.by_block(weights)[:, place[:, None], place], rtol=1e-12
        )

    def test_blocks_without_rows_change_nothing(self, samples):
        late = replace(samples, origin=samples.origin - 3.0)
        phase, same = (Factor.by_time(MODEL, recording) for recording in (late, samples))
        assert len(phase) == len(same) + 24
        assert len(phase.occupied()) == len(same)
        training = eliminate(MODEL, phase, same).estimate
        assert training.names == eliminate(MODEL, same, same).estimate.names
