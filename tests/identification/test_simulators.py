"""Files for simulators, friction curves, and noise."""

from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest

from identification import FrictionLaw, RobotModel
from identification.export.friction import friction_curve, friction_torque
from identification.export.simulators import (
    AGREES,
    FORMATS,
    Arm,
    Ranges,
    compare,
    mjcf,
    random_states,
)
from identification.export.urdf import WriteBackError
from identification.model.coupling import Coupling
from identification.model.elements import Anchors, GasCylinder, TorqueRipple, TorsionSpring
from identification.model.payload import Payload
from identification.signals.noise import noiseless_above
from identification.signals.smoothing import LowPassShape, low_passed
from sim_fixtures.ns16 import urdf_text
from tests.identification.robots import random_urdf, robot_text, some_bodies
from tests.identification.two_link import URDF, as_samples, one_sine, values_of

LAW = FrictionLaw(asymmetric=True, stribeck=0.1, presliding=1e-3)
WRIST = np.eye(6)
WRIST[5, 4] = 0.5


def an_arm(urdf, **options):
    """Random consistent bodies, and friction of all kinds."""
    model = RobotModel.from_urdf(urdf, **options)
    n = model.n_joints
    standard = np.zeros(model.layout.size)
    standard[: 11 * n] = some_bodies(n)
    standard[model.layout.rotors] += 1.0
    for k, (i, j) in enumerate(model.layout.pairs):
        rotors = model.layout.rotors[[i, j]]
        standard[model.layout.couplings[k]] = 0.3 * np.sqrt(np.prod(standard[rotors]))
    others = np.random.default_rng(1).uniform(0.5, 2.5, model.n_parameters - model.base.rank)
    values = np.concatenate([model.base.grouping @ standard, others])
    infinite = np.full(n, np.inf)
    return Arm(urdf, model, standard, values, Ranges(-infinite, infinite, infinite, infinite))


def compared(form, arm, remarks=(), samples=20):
    """Compare the file of an arm with its model; skips without a reader of the form."""
    if form == "mjcf":
        pytest.importorskip("mujoco", reason="the extra mujoco is not installed")
    text = FORMATS[form].write(arm, "arm", list(remarks))
    return compare(text, FORMATS[form], arm, random_states(arm, samples))


FORMS = pytest.mark.parametrize("form", FORMATS)


class TestReadBack:
    """Inverse dynamics of the file agree with the supported parts of the model."""

    @FORMS
    @pytest.mark.parametrize("seed", [1, 2])
    def test_trees_of_any_joints(self, form, seed):
        arm = an_arm(random_urdf(seed), friction=FrictionLaw(third="cubic"))
        assert compared(form, arm).difference < AGREES

    @FORMS
    def test_a_published_description(self, form):
        """With rounded angles and locked joints."""
        locked = dict.fromkeys(("panda_finger_joint1", "panda_finger_joint2"), 0.02)
        arm = an_arm(robot_text("panda_description/urdf/panda.urdf"), locked=locked)
        assert compared(form, arm, ["a -- remark"]).difference < AGREES

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
                TorqueRipple("joint_1", (("joint_1", 100.0),), (1,)),
            ],
        )
        left = set(compared(form, arm, samples=200).left_out)
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
        ranges = Ranges(-np.ones(n), np.full(n, 2.0), np.full(n, 3.0), np.full(n, 40.0))
        arm = replace(arm, ranges=ranges)
        model = ElementTree.fromstring(mjcf(arm, "arm"))
        joint = model.find(".//joint[@name='joint_2']")
        assert joint.get("range") == "-1.0 2.0"
        assert joint.get("actuatorfrcrange") == "-40.0 40.0"
        assert (joint.get("stiffness"), joint.get("springref")) == ("50.0", "0.3")
        assert [one.get("ctrlrange") for one in model.iter("motor")] == ["-40.0 40.0"] * n
        assert "gravcomp" not in mjcf(arm, "arm")

    @FORMS
    def test_dry_friction_is_written_as_it_was_identified(self, form):
        arm = an_arm(urdf_text())
        f0 = [row["f0"] for row in arm.friction]
        root = ElementTree.fromstring(FORMATS[form].write(arm, "arm", []))
        where = {"mjcf": "frictionloss", "urdf": "friction"}[form]
        found = [float(one.get(where, 0)) for one in root.iter() if where in one.attrib]
        assert found == f0


F0, F1, FO = np.array([4.0, 2.0]), np.array([1.5, 0.8]), np.array([0.5, -0.25])


def model_with(**law):
    return RobotModel.from_urdf(URDF, friction=FrictionLaw(third=None, offset=True, **law))


def planted(model):
    return values_of(model, np.concatenate([F0, F1, FO]), (0.4, 0.1))


def samples_of(model, bandwidth=None):
    motion = one_sine(np.arange(3000) * 2e-3, phase=(0.0, 0.0))
    samples = as_samples(
        model,
        motion,
        np.zeros((3000, 2)),
        usable=np.ones((3000, 2), dtype=np.bool_),
        position_bandwidth=np.full(2, 10.0),
        torque_bandwidth=None if bandwidth is None else np.full(2, bandwidth),
    ).with_friction_direction(model)
    return replace(samples, torque=samples.predicted_torque(model, planted(model)))


class TestFrictionCurve:
    """Friction of a joint over speed."""

    def test_jumps_at_zero_and_has_the_offset(self):
        model = model_with()
        curve = friction_curve(model, planted(model), 1, -2.0, 3.0)
        assert (curve.speed[0], curve.speed[-1]) == (-2.0, 3.0)
        ends = [-F0[1] - 2.0 * F1[1] + FO[1], F0[1] + 3.0 * F1[1] + FO[1]]
        np.testing.assert_allclose(curve.torque[[0, -1]], ends)
        middle = len(curve.speed) // 2
        jump = curve.torque[middle] - curve.torque[middle - 1]
        assert jump == pytest.approx(2.0 * F0[1], rel=1e-4)

    def test_agrees_with_the_data(self):
        """Torque minus the other parts is on the curve for a perfect model."""
        model = model_with()
        values, samples = planted(model), samples_of(model)
        speed = samples.motion.velocity[:, 0]
        curve = friction_curve(model, values, 0, float(speed.min()), float(speed.max()))
        on_it = np.interp(speed, curve.speed, curve.torque)
        sliding = np.abs(speed) > 1e-3
        data = friction_torque(model, values, samples)[:, 0]
        np.testing.assert_allclose(data[sliding], on_it[sliding], atol=1e-6)


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
        found = self.above(low_passed(self.TIME, self.torque(0.5), bandwidth, self.SHAPE))
        assert bandwidth < found < 2.5 * bandwidth

    def test_of_one_joint_is_enough_for_the_channel(self):
        torque = self.torque(0.1)
        torque[:, 1] = low_passed(self.TIME, torque[:, 1:], 5.0, self.SHAPE)[:, 0]
        assert self.above(torque) is None
