import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from identification import Coupling, FrictionLaw, JointFriction, ModelError, RobotModel, ShapeError
from identification.model.friction import dissipation, presliding_state
from sim_fixtures.ns16 import urdf_text
from tests.identification.robots import NS16_TURNS
from tests.identification.two_link import MODEL, a_motion, truth
from tests.identification.two_link import URDF as TWO_LINK

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
        torque = model.torque(values, random.normal(size=(30, 6)), qd, random.normal(size=(30, 6)))
        own = [{} for _ in names]
        for name, value in zip(model.parameter_names[model.base.rank :], friction, strict=True):
            symbol, joint = name.split("_")
            own[int(joint) - 1][symbol] = value
        expected = [[torque_of(laws[j], own[j], v) for j, v in enumerate(row)] for row in qd]
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
        with pytest.raises(ShapeError):
            model.friction.table(np.arange(4.0))

    def test_rows_at_rest_are_excluded_only_with_that_zone(self):
        model = RobotModel.from_urdf(
            TWO_LINK,
            friction=FrictionLaw(standstill=0.1),
            joint_friction={"elbow": FrictionLaw(standstill=0.1, zone="linear")},
        )
        speeds = np.array([[0.0, 0.0], [0.1, 0.1], [-0.11, 0.0]])
        assert model.moving(speeds).tolist() == [[False, True], [False, True], [True, True]]
        np.testing.assert_array_equal(model.friction.standstill, [0.1, 0.1])

    def test_offsets_do_not_count_as_friction(self):
        model = RobotModel.from_urdf(TWO_LINK, friction=FrictionLaw(third=None, offset=True))
        friction = [
            n for n, f in zip(model.parameter_names, model.friction_columns, strict=True) if f
        ]
        assert friction == ["f0_1", "f0_2", "f1_1", "f1_2"]

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
            own = {s: values[f"{s}_{joint}"] for s in law.symbols}
            for v in (-3.0, -0.01, 0.01, 3.0):
                assert torque_of(law, own, v) * v >= -1e-12

    def test_all_dissipative_friction_is_allowed(self):
        law = FrictionLaw(third=None, asymmetric=True, stribeck=0.2)
        friction = JointFriction((law,), (True,))
        combine, not_negative = dissipation(friction)
        possible = {"f0": 2.0, "f1": 1.0, "fd": -0.9, "fs": -1.8, "fo": -5.0}
        g = np.linalg.solve(combine, [possible[term.symbol] for term in friction.terms])
        assert np.all(g[not_negative] >= 0.0)
        for beyond in ({"fd": -1.1}, {"fs": -2.1}, {"f0": -0.1}, {"fd": 1.1}):
            values = possible | beyond
            g = np.linalg.solve(combine, [values[term.symbol] for term in friction.terms])
            assert np.any(g[not_negative] < 0.0), beyond


steps = st.lists(st.sampled_from([-3e-4, -1e-5, 0.0, 1e-5, 2e-3]), min_size=2, max_size=60)
distances = st.sampled_from([1e-5, 1e-4, 1e-3])


class TestPreslidingState:
    @given(steps=steps, distance=distances)
    def test_it_is_dahls_recursion(self, steps, distance):
        """z <- s + (z - s) exp(-|dq| / d), from zero."""
        position = 0.3 + np.cumsum([0.0, *steps])
        state, expected = 0.0, [0.0]
        for step in np.diff(position):
            state = np.sign(step) + (state - np.sign(step)) * np.exp(-abs(step) / distance)
            expected.append(state)
        found = presliding_state(position, distance)
        np.testing.assert_allclose(found, expected, atol=1e-12)
        assert np.all(np.abs(found) <= 1.0)


class TestDirectionOfFriction:
    def test_without_presliding_it_is_the_sign(self):
        motion = a_motion()
        direction = MODEL.friction.direction(*motion[:3])
        np.testing.assert_array_equal(direction, np.sign(motion.velocity))

    def test_the_torque_uses_the_direction_of_a_motion(self):
        motion = a_motion()
        half = motion._replace(direction=0.5 * np.sign(motion.velocity))
        dry = np.zeros_like(truth())
        dry[MODEL.parameter_names.index("f0_1")] = 4.0
        dry[MODEL.parameter_names.index("f0_2")] = 2.0
        np.testing.assert_allclose(
            MODEL.torque(dry, *half[1:]), 0.5 * MODEL.torque(dry, *motion[1:]), atol=1e-12
        )


@pytest.fixture(scope="module")
def model():
    return RobotModel.from_urdf(urdf_text(), coupling=Coupling(NS16_TURNS))


def states(m=40):
    return np.random.default_rng(4).uniform(-3.0, 3.0, (3, m, 6))


class TestCoupling:
    """Motors that turn with several joints."""

    def test_names_and_units_of_coupling_parameters(self, model):
        assert model.parameter_names[40:43] == ("I45", "I46", "I56")
        assert model.parameter_names[-4:] == ("f0_m5", "f0_m6", "f1_m5", "f1_m6")
        assert model.units[40:43] == ("kg m²",) * 3
        assert model.units[-4:] == ("N·m", "N·m", "N·m·s/rad", "N·m·s/rad")
        assert model.friction_columns.tolist() == [False] * 43 + [True] * 22

    def test_rotors_and_motor_friction_act_through_it(self, model):
        """tau = K' J K qdd + sum of c_m' f_m(c_m qd), computed from K here."""
        q, qd, qdd = states()
        inertia = np.random.default_rng(1).uniform(1e-4, 1e-3, 6)
        rotors = NS16_TURNS.T @ np.diag(inertia) @ NS16_TURNS
        standard = np.zeros(len(model.layout.names))
        standard[model.layout.rotors] = np.diag(rotors)
        standard[model.layout.couplings] = rotors[3, 4], rotors[3, 5], rotors[4, 5]
        np.testing.assert_allclose(model.layout.rotor_matrix(standard), rotors, atol=1e-12)

        friction = np.zeros(len(model.friction.terms))
        friction[-4:] = 2.0, 3.0, 0.5, 0.7
        values = np.concatenate([model.base.grouping @ standard, friction])
        expected = qdd @ rotors
        for motor, coulomb, viscous in ((4, 2.0, 0.5), (5, 3.0, 0.7)):
            c = NS16_TURNS[motor] / NS16_TURNS[motor, motor]
            speed = qd @ c
            expected += np.outer(coulomb * np.sign(speed) + viscous * speed, c)
        np.testing.assert_allclose(model.torque(values, q, qd, qdd), expected, atol=1e-9)

    def test_rows_need_moving_motors(self, model):
        qd = np.ones((1, 6))
        # Joint speeds at which motor 5 is at rest: c_5 qd = 0.
        qd[0, 4] = 0.2
        assert model.moving(qd).tolist() == [[True, True, True, False, False, True]]

    def test_either_part_can_be_left_out(self):
        for part, count in (("friction", 43 + 18), ("inertia", 40 + 22)):
            coupling = Coupling(NS16_TURNS, **{part: False})
            assert RobotModel.from_urdf(urdf_text(), coupling=coupling).n_parameters == count
        law = FrictionLaw(coulomb=False)
        viscous = RobotModel.from_urdf(urdf_text(), friction=law, coupling=Coupling(NS16_TURNS))
        assert viscous.parameter_names[-2:] == ("f1_m5", "f1_m6")

    def test_uncoupled_motors_add_nothing(self):
        uncoupled = RobotModel.from_urdf(urdf_text())
        with_gears = RobotModel.from_urdf(
            urdf_text(), coupling=Coupling(np.diag(np.diag(NS16_TURNS)))
        )
        assert with_gears.parameter_names == uncoupled.parameter_names
        blocks = [one.regressor(*states()).blocks for one in (with_gears, uncoupled)]
        assert all(map(np.array_equal, *blocks))

    @pytest.mark.parametrize(
        ("matrix", "words"),
        [
            (np.array([[0.0, 1.0], [1.0, 0.0]]), "motor 1 .* does not turn with joint 1"),
            (np.array([[1.0, 0.0], [16.0, 1e-308]]), "motor 2 .* does not turn with joint 2"),
            (np.ones((2, 2)), "singular"),
        ],
    )
    def test_an_invalid_one_is_refused(self, matrix, words):
        with pytest.raises(ModelError, match=words):
            Coupling(matrix)
