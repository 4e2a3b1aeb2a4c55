"""Springs and balancers with known and identified parameters."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from identification import Factor, RobotModel, consistent_estimate, estimate
from identification.errors import ModelError
from identification.model.elements import (
    Anchors,
    ElementError,
    ExtensionSpring,
    GasCylinder,
    JointElements,
    TorqueRipple,
    TorsionSpring,
)
from identification.model.friction import FrictionLaw
from tests.identification import two_link
from tests.identification.robots import one_joint

KR300 = Path(__file__).resolve().parents[3] / "shared" / "data" / "kr300"
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


def torsion_energy(q):
    return np.asarray(0.5 * 40.0 * (q - 0.3) ** 2)


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
            (TORSION, torsion_energy),
            (EXTENSION, extension_energy),
            (BALANCER, lambda q: gas_energy(BALANCER, q)),
            (GAS_SPRING, lambda q: gas_energy(GAS_SPRING, q)),
        ],
    )
    def test_is_the_derivative_of_an_energy(self, element, energy):
        """The torque of the drive is the derivative of the stored energy."""
        h = 1e-5
        slope = (energy(POSITIONS + h) - energy(POSITIONS - h)) / (2.0 * h)
        np.testing.assert_allclose(element.known(POSITIONS), slope, rtol=1e-6, atol=1e-5)

    @pytest.mark.parametrize("element", [TORSION, BALANCER, GAS_SPRING])
    def test_is_columns_times_nominal_values(self, element):
        """An identified element with its nominal values has the torque of the known one."""
        free = replace(element, identified=True)
        nominal = JointElements.of([free], ["joint2"], [True]).nominal
        torque = free.columns(POSITIONS) @ nominal + free.known(POSITIONS)
        np.testing.assert_allclose(torque, element.known(POSITIONS), rtol=1e-12)

    def test_a_given_preload_stays_known(self):
        """The preload of an identified spring is a parameter unless it is given."""
        both = replace(EXTENSION, preload=None, identified=True)
        one = replace(EXTENSION, identified=True)
        assert (both.symbols, one.symbols) == (("spring", "preload"), ("spring",))
        assert JointElements.of([both], ["joint2"], [True]).units == ("N/m", "N")
        whole = EXTENSION.known(POSITIONS)
        np.testing.assert_allclose(both.columns(POSITIONS) @ [900.0, 60.0], whole)
        np.testing.assert_allclose(one.columns(POSITIONS)[:, 0] * 900 + one.known(POSITIONS), whole)

    def test_a_published_balancer_is_reproduced(self):
        """A recording with and one without its balancer differ by the computed torque."""
        if not KR300.is_dir():
            pytest.skip(f"there is no recording {KR300}")
        raw, off = (
            np.genfromtxt(KR300 / name, delimiter=",", names=True) for name in ("A.csv", "Abal.csv")
        )
        np.testing.assert_allclose(BALANCER.known(raw["q2"]), raw["tau2"] - off["tau2"], atol=1e-6)


class TestElementFigures:
    @pytest.mark.parametrize(
        ("make", "words"),
        [
            (lambda: TorsionSpring("a", 0.0), "neither a stiffness nor identified"),
            (lambda: Anchors(0.2, 0.2, 0.0), "distance is zero at one angle"),
            (lambda: replace(BALANCER, volume=5e-4), "the gas has -0.000168 m³ left"),
        ],
    )
    def test_invalid_values_are_refused(self, make, words):
        with pytest.raises(ModelError, match=words):
            make()

    def test_joint_must_exist_and_be_revolute(self):
        with pytest.raises(ModelError, match="no joint 'joint2'"):
            JointElements.of([TORSION], ["a"], [True])
        with pytest.raises(ModelError, match="prismatic"):
            JointElements.of([TORSION], ["joint2"], [False])

    def test_names_of_two_on_one_joint_differ(self):
        free = [replace(TORSION, identified=True), replace(EXTENSION, identified=True)]
        assert JointElements.of(free, ["joint1", "joint2"], [True] * 2).names == (
            "spring_2",
            "spring_2b",
        )


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
        model, motion = with_elements(SPRING, GAS), two_link.a_motion()
        values = np.concatenate([two_link.truth(), [35.0, 0.8]])
        expected = two_link.MODEL.torque(two_link.truth(), *motion[1:])
        expected[:, 0] += 35.0 * (motion.position[:, 0] - 0.3)
        expected[:, 1] += 0.8 * replace(GAS, identified=False).known(motion.position[:, 1])
        np.testing.assert_allclose(model.torque(values, *motion[1:]), expected, atol=1e-9)
        dense = model.regressor(*motion[1:]).dense(model.n_parameters) @ values
        np.testing.assert_allclose(dense, expected, atol=1e-9)
        other = model.with_friction(coulomb=False)
        assert other.parameter_names[other.element_part] == model.elements.names

    def test_ripple_turns_with_the_motor(self):
        """Cosine and sine of each order of the angle of a coupled motor."""
        motor = tuple(zip(JOINTS, (20.0, -30.0), strict=True))
        model, motion = with_elements(TorqueRipple(JOINTS[1], motor, (1, 2))), two_link.a_motion()
        assert model.parameter_names[model.element_part] == tuple(
            f"ripple_{wave}{order}_2" for order in (1, 2) for wave in ("cos", "sin")
        )
        values = np.concatenate([two_link.truth(), [0.0, 0.0, 0.3, 0.4]])
        angle = 20.0 * motion.position[:, 0] - 30.0 * motion.position[:, 1]
        expected = two_link.MODEL.torque(two_link.truth(), *motion[1:])
        expected[:, 1] += 0.5 * np.sin(2.0 * angle + np.arctan2(0.3, 0.4))
        np.testing.assert_allclose(model.torque(values, *motion[1:]), expected, atol=1e-9)

    def test_known_elements_are_load(self):
        known = with_elements(replace(SPRING, identified=False))
        motion = two_link.a_motion(1.0)
        assert known.parameter_names == two_link.MODEL.parameter_names
        load = known.load_torque(*motion[1:4])
        np.testing.assert_allclose(load[:, 0], 40.0 * (motion.position[:, 0] - 0.3))
        assert not load[:, 1].any()
        assert known.has_load and not two_link.MODEL.has_load

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
    model, motion = with_elements(SPRING, GAS), two_link.a_motion()
    values = np.concatenate([two_link.truth(), [-35.0, 0.8]])
    samples = two_link.simulated(model, values, motion, two_link.NOISE, 3)
    return model, values, Factor.of(model, samples)


class TestIdentifiedElements:
    def test_least_squares_finds_them(self, identified):
        model, values, factor = identified
        found = estimate(model, factor)
        assert np.all(np.abs(found.values - values) <= 4.5 * found.std)

    def test_the_consistent_solution_leaves_them_free(self, identified):
        """A stiffness may be negative and has no prior."""
        model, values, factor = identified
        free, own = estimate(model, factor), model.element_part
        found = consistent_estimate(model, factor, free)
        assert len(found.friction) == len(model.friction.terms)
        assert np.all(np.abs(found.estimate.values - values)[own] <= 4.5 * free.std[own])
