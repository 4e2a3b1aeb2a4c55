import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from identification import FrictionLaw, RobotModel
from identification.excitation.collision.bodies import Workspace
from identification.excitation.collision.checker import CollisionChecker
from identification.excitation.constraints import (
    Constraints,
    CurrentModel,
    check_motion,
    limit_violations,
    sampled,
)
from identification.excitation.violation import KINDS, excess_by_kind
from planner import FourierSeries, JointLimits, plan
from tests.identification.robots import joint, link, robot
from tests.identification.two_link import values_of

# Two links of 1 m that swing in a vertical plane: known to every textbook.
ROD = {
    "shape": '<cylinder radius="0.05" length="0.8"/>',
    "at": "0.5 0 0",
    "rpy": "0 1.5707963 0",
    "centre": "0.5 0 0",
    "inertia": (0.1, 0.1, 0.1),
}
URDF = robot(
    link("base", '<box size="0.1 0.1 0.1"/>'),
    link("upper", mass=2, **ROD),
    link("lower", mass=1, **ROD),
    joint("shoulder", "base", "upper", "0 -1 0", ends=3),
    joint("elbow", "upper", "lower", "0 -1 0", at="1 0 0", ends=3),
)

LIMITS = JointLimits([-3.0] * 2, [3.0] * 2, [3.0] * 2, [10.0] * 2, [100.0] * 2)
MOTOR_FROM_JOINT = np.array([[100.0, 0.0], [5.0, -80.0]])
TORQUE_CONSTANT = np.array([0.5, 0.25])


MODEL = RobotModel.from_urdf(URDF, friction=FrictionLaw(third=None))
VALUES = values_of(MODEL, [3.0, 1.0, 0.0, 0.0])


def make_currents(current_limit, values=VALUES, **more):
    limit = np.array(current_limit)
    return CurrentModel(MODEL, values, MOTOR_FROM_JOINT, TORQUE_CONSTANT, limit, **more)


@pytest.fixture(scope="module")
def swing():
    return plan([[0.0, 0.0], [1.5, -1.0], [0.0, 0.0]], LIMITS, fly=0.0)


class TestCurrents:
    def test_static_currents_agree_with_the_textbook(self, swing):
        motion = sampled(swing, 0.008)
        currents, unsure = make_currents([1.0, 1.0]), make_currents([1.0, 1.0], uncertainty=0.2)
        torque = currents.torque(motion)
        # At rest and level at the very start: elbow 1 kg at 0.5 m, shoulder 2 kg at 0.5 m more.
        np.testing.assert_allclose(
            torque[0], 9.81 * np.array([2 * 0.5 + 1 * 1.5, 1 * 0.5]), rtol=1e-9
        )
        joint_speed = np.array([0.7, -0.3])  # the same power on both sides of the gears
        power = (currents.current(torque) * TORQUE_CONSTANT) @ (MOTOR_FROM_JOINT @ joint_speed)
        np.testing.assert_allclose(power, torque @ joint_speed, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(unsure.torque(motion), 1.2 * torque)

    def test_a_current_beyond_its_limit_is_named(self, swing):
        """With value, bound, instant, and the share of the limit that may be used."""
        motion = sampled(swing, 0.008)
        generous = make_currents([100.0, 100.0])
        assert check_motion(swing, LIMITS, currents=generous) == ()
        current = np.abs(generous.current(generous.torque(motion)))[:, 1]
        for share, remedy in ((1.0, ""), (0.8, "a motion may use 80% of the motor's limit")):
            tight = make_currents([100.0, 0.9 / share * current.max()], usable=share)
            (violation,) = check_motion(swing, LIMITS, currents=tight)
            assert (violation.kind, violation.subject) == ("current", "motor of elbow")
            assert violation.value == pytest.approx(current.max())
            assert violation.bound == pytest.approx(0.9 * current.max())
            assert violation.excess == pytest.approx(1 / 0.9 - 1)
            assert violation.time == motion.time[current.argmax()]
            assert violation.remedy == remedy
            for word in ("current", "motor of elbow", "A", f"{violation.time:.3f} s", remedy):
                assert word in str(violation)

    def test_a_prediction_that_is_not_finite_violates_every_limit(self, swing):
        broken = make_currents([1e9, 1e9], VALUES * np.nan)
        violations = check_motion(swing, LIMITS, currents=broken)
        assert [violation.excess for violation in violations] == [np.inf, np.inf]


def series(seed, *, ramp, scale=1.0):
    random = np.random.default_rng(seed)
    return FourierSeries(
        offset=random.uniform(-0.5, 0.5, 2),
        amplitude=scale * random.uniform(-0.8, 0.8, (2, 3)),
        frequency=random.uniform(0.3, 2.5, (2, 3)),
        length=random.uniform(6.0, 12.0),
        ramp=ramp,
    )


class TestJointLimits:
    def test_every_joint_and_quantity_beyond_is_named(self, swing):
        slow = JointLimits([-3.0, -0.5], [1.0, 3.0], [1.0, 3.0], [10.0, 4.0], [100.0, 30.0])
        violations = {v.subject: v for v in check_motion(swing, slow)}
        assert set(violations) == {
            "position of joint 0",
            "position of joint 1",
            "velocity of joint 0",
            "acceleration of joint 1",
            "jerk of joint 1",
        }
        lowest = violations["position of joint 1"]
        assert (lowest.value, lowest.bound) == (pytest.approx(-1.0), -0.5)
        assert "at least -0.5" in str(lowest)
        assert lowest.excess == pytest.approx(0.5 / 3.5)  # of the range
        assert lowest.posture == pytest.approx([1.5, -1.0], abs=1e-3)
        fastest = violations["velocity of joint 0"]
        assert abs(swing.sample_one(fastest.time)[1][0]) == pytest.approx(fastest.value, rel=1e-3)
        assert fastest.excess == pytest.approx(fastest.value - 1.0)

    @given(
        seed=st.integers(0, 10**6),
        ramp=st.sampled_from([0.0, 0.01, 1.0, 3.0]),
        quantity=st.sampled_from(["position", "velocity", "acceleration", "jerk"]),
        joint=st.integers(0, 1),
        share=st.sampled_from([0.9, 1 - 1e-8, 1 + 1e-8, 1.1]),
    )
    @settings(max_examples=60, deadline=None)
    def test_limits_of_sines_are_checked(self, seed, ramp, quantity, joint, share):
        motion = series(seed, ramp=ramp)
        reached = motion.extrema()
        bounds = {
            "lower": np.full(2, -50.0),
            "upper": np.full(2, 50.0),
            "velocity": np.full(2, 1e9),
            "acceleration": np.full(2, 1e9),
            "jerk": np.full(2, 1e9),
        }
        name = "upper" if quantity == "position" else quantity
        bounds[name][joint] = getattr(reached, name)[joint] * share
        violations = limit_violations(motion, JointLimits(**bounds), sampled(motion))
        if share > 1.0:
            assert violations == []
        else:
            (violation,) = violations
            assert violation.subject == f"{quantity} of joint {joint}"
            assert violation.bound < violation.value == getattr(reached, name)[joint]

    def test_sines_without_a_ramp_are_refused_with_a_remedy(self):
        bare, gentle = (series(3, ramp=ramp, scale=0.1) for ramp in (0.0, 2.0))
        (violation,) = check_motion(bare, LIMITS)
        assert violation.kind == "joint limit"
        assert "velocity of joint" in violation.subject
        assert "start" in violation.subject or "end" in violation.subject
        assert violation.excess > 0.0
        assert "ramp" in str(violation)
        assert not check_motion(gentle, LIMITS)
        # A design may look at one all the same.
        lenient = Constraints(LIMITS, at_rest=False)
        assert lenient.violations(bare, sampled(bare)) == ()


class TestViolations:
    def test_the_deepest_contact_is_reported_with_pair_and_instant(self):
        checker = CollisionChecker(URDF, Workspace(floor=-0.5, margin=0.1))
        down = plan([[0.0, 0.0], [-0.6, 0.0], [0.3, 0.0]], LIMITS, fly=0.0)
        (violation,) = check_motion(down, LIMITS, checker=checker)
        assert (violation.kind, violation.subject) == ("collision", "lower and floor")
        assert violation.bound == 0.1
        q = down.sample_one(violation.time)[0]
        np.testing.assert_allclose(q, [-0.6, 0.0], atol=2e-3)
        # the end of the lower link, 1.9 m out, its edge 0.05 m below the centre line
        height = 1.9 * np.sin(q[0]) - 0.05 * np.cos(q[0])
        assert height == pytest.approx(-0.5 + violation.value, abs=1e-6)
        np.testing.assert_allclose(violation.posture, q, atol=1e-9)
        # 1 m from shoulder to elbow: that much too close would be an excess of 1
        assert violation.excess == pytest.approx(0.1 - violation.value)
        text = str(violation)
        assert text.startswith(
            f"collision of lower and floor: {violation.value:.4g} m, must be at least 0.1 m"
        )
        assert f"at {violation.time:.3f} s" in text
        assert "joints at (-0." in text

    @pytest.mark.parametrize(
        ("shortest", "longest", "side"), [(5.0, 9.0, "least"), (0.0, 1.0, "most")]
    )
    def test_a_motion_too_short_or_too_long_is_named(self, swing, shortest, longest, side):
        constraints = Constraints(LIMITS, min_duration=shortest, max_duration=longest)
        (violation,) = constraints.violations(swing, sampled(swing))
        bound = shortest or longest
        assert (violation.kind, violation.value, violation.bound) == (
            "duration",
            swing.duration,
            bound,
        )
        assert violation.excess == pytest.approx(abs(swing.duration / bound - 1.0))
        assert f"at {side} {bound:g} s" in str(violation)

    def test_excess_by_kind_is_the_largest(self, swing):
        constraints = Constraints(
            LIMITS.scaled(velocity=0.5),
            max_duration=1.0,
            checker=CollisionChecker(URDF, Workspace(floor=0.01, margin=0.06)),
            currents=make_currents([0.1, 0.1], torque_limit=np.ones(2)),
        )
        motion = sampled(swing)
        violations = constraints.violations(swing, motion)
        assert pickle.loads(pickle.dumps(constraints)).violations(swing, motion) == violations
        excess = excess_by_kind(violations)
        assert [kind for kind, e in zip(KINDS, excess, strict=True) if e > 0] == list(KINDS[1:])
        for kind, worst in zip(KINDS, excess, strict=True):
            assert worst == max((v.excess for v in violations if v.kind == kind), default=0.0)
        assert not excess_by_kind(()).any()
