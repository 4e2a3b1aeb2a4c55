"""Genomes, constraints, criteria and fronts of a search, and validation motions."""

import hashlib
import json
import math
import pickle
from dataclasses import asdict, replace
from functools import cache, partial
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from identification.excitation import CRITERIA, validation_motions
from identification.excitation.collision import CollisionChecker
from identification.excitation.constraints import (
    SAMPLE_PERIOD,
    Constraints,
    CurrentModel,
    check_motion,
    limit_violations,
    midpoints,
    sampled,
)
from identification.excitation.criteria import (
    Criteria,
    Objective,
    correlation,
    coupling_index,
    coupling_index_max,
    fitness_eq7,
    log10_det,
)
from identification.excitation.errors import DesignError, NoFeasibleMotionError
from identification.excitation.excitation import Excitation
from identification.excitation.genomes import SineGenome, ViaPointGenome
from identification.excitation.messages import subject_text, violation_text
from identification.excitation.searches.population import Front, Scores
from identification.excitation.validation_motions import random_validation_motions
from identification.excitation.violation import (
    KINDS,
    CloseBodies,
    JointQuantity,
    LoadedDrive,
    UsableShare,
    Violation,
    excess_by_kind,
)
from identification.model.friction import FrictionLaw
from identification.model.robot import RobotModel
from identification.model.workspace import Workspace
from planner import (
    FourierSeries,
    JointLimits,
    PlannerCrashed,
    WorkerProcess,
    check_limits,
    plan,
    plan_moves,
)
from sim_fixtures.ns16 import load_truth, urdf_text
from tests.identification.robots import joint, link, robot
from tests.identification.searching import NS16_HOME as HOME
from tests.identification.searching import NS16_LIMITS as LIMITS
from tests.identification.two_link import URDF, values_of

OPEN = ViaPointGenome(LIMITS, n_via=6, slowest=0.3)
CLOSED = ViaPointGenome(LIMITS, n_via=4, fly=0.7, slowest=0.2, range_share=0.9, home=HOME)
BARE = SineGenome(LIMITS, length=20.0)
RAMPED = SineGenome(
    LIMITS, length=15.0, harmonics=2, ramp=2.0, offset=HOME, fastest=np.full(6, 2.0)
)
GENOMES = pytest.mark.parametrize(
    "genome", [OPEN, CLOSED, BARE, RAMPED], ids=lambda g: repr(g)[:20]
)


def some_genes(genome, rows, seed=5):
    return np.random.default_rng(seed).random((rows, genome.n_genes))


def bits(motion):
    if isinstance(motion, FourierSeries):
        return motion.amplitude.tobytes() + motion.frequency.tobytes()
    return b"".join(array.tobytes() for array in motion.knots + motion.coefficients)


class TestGenomes:
    @pytest.mark.long
    @GENOMES
    def test_motions_do_not_depend_on_batch_and_process(self, genome):
        genes = some_genes(genome, 5)
        together = [bits(motion) for motion in genome.motions(genes)]
        assert [bits(genome.motions(genes[[k]])[0]) for k in range(5)] == together
        with WorkerProcess(timeout=60.0) as child:
            assert [bits(motion) for motion in child.call(genome.motions, genes)] == together


class TestViaPoints:
    @pytest.mark.parametrize("genome", [OPEN, CLOSED])
    def test_genes_reach_the_ends_of_range_and_speed(self, genome):
        lower = LIMITS.lower
        upper = LIMITS.upper
        spare = (1.0 - genome.range_share) / 2.0 * (upper - lower)
        free_points = slice(None) if genome.home is None else slice(1, -1)
        for gene, end, share in ((0.0, lower + spare, genome.slowest), (1.0, upper - spare, 1.0)):
            points, speed = genome.decode(np.full((1, genome.n_genes), gene))
            np.testing.assert_array_equal(points[0, free_points], np.tile(end, (genome.n_via, 1)))
            np.testing.assert_array_equal(speed, np.full((1, 6), share))

    @pytest.mark.parametrize("genome", [OPEN, CLOSED])
    def test_motions_are_those_of_the_planner(self, genome):
        genes = some_genes(genome, 6)
        for motion, points, speed in zip(genome.motions(genes), *genome.decode(genes), strict=True):
            check_limits(motion, LIMITS.scaled(velocity=speed))
            alone = plan(points, LIMITS, speed=speed, fly=genome.fly)
            times = np.linspace(0.0, alone.duration, 300)
            for ours, theirs in zip(motion.sample(times), alone.sample(times), strict=True):
                np.testing.assert_array_equal(ours, theirs)


# Via points among obstacles


@pytest.fixture(scope="module")
def checker():
    return CollisionChecker(urdf_text(), Workspace(margin=0.05))


class TestObstacles:
    @pytest.mark.parametrize("home", [HOME, None], ids=["closed", "open"])
    def test_paths_of_a_first_population_are_free(self, checker, home):
        genome = ViaPointGenome(LIMITS, n_via=5, home=home, checker=checker)
        points, _ = genome.decode(genome.sample(np.random.default_rng(2), 12))
        for path in points:
            for start, end in pairwise(path):
                steps = int(np.ceil(np.max(np.abs(end - start)) / 0.1)) + 1
                assert checker.clear(np.linspace(start, end, steps + 1)).all()


class TestSines:
    def test_genes_at_their_ends_reach_the_papers_bounds(self):
        room = np.minimum(LIMITS.upper - HOME, HOME - LIMITS.lower)
        for gene, side, rates in (
            (0.0, -1.0, np.full(6, 2 * np.pi / 15.0)),
            (1.0, 1.0, np.full(6, 2)),
        ):
            amplitude, frequency = RAMPED.decode(np.full((1, RAMPED.n_genes), gene))
            for sine in range(2):
                np.testing.assert_array_equal(amplitude[0, :, sine], side * room / 2)
                np.testing.assert_array_equal(frequency[0, :, sine], rates)
        amplitude, frequency = BARE.decode(np.ones(BARE.n_genes))
        half = (LIMITS.upper - LIMITS.lower) / 2.0
        np.testing.assert_allclose(amplitude[0], np.tile(half[:, None] / 3.0, 3), rtol=1e-15)
        largest = np.sqrt(LIMITS.acceleration / half)
        np.testing.assert_allclose(frequency[0], np.tile(largest[:, None], 3), rtol=1e-15)
        np.testing.assert_allclose(BARE.frequency_range[0], 0.314, atol=5e-4)  # Table 1, for 20 s
        assert not np.any(RAMPED.motions(np.full((1, RAMPED.n_genes), 0.5))[0].amplitude)

    @pytest.mark.parametrize(
        ("name", "setting"),
        [
            ("harmonics", {"harmonics": 0}),
            ("offset", {"offset": LIMITS.lower}),
            ("offset", {"offset": HOME[:5]}),
            ("slowest", {"slowest": np.zeros(6)}),
            ("slowest", {"slowest": np.full(6, 5.0)}),
            ("slowest", {"slowest": np.full(6, np.nan)}),
            ("slowest", {"length": 1.0}),  # one period is faster than the limits allow
        ],
    )
    def test_settings_outside_their_range_are_refused(self, name, setting):
        with pytest.raises(DesignError) as refusal:
            SineGenome(LIMITS, **{"length": 20.0, **setting})
        assert refusal.value.name == name


ROOMY = JointLimits(
    lower=np.array([-2.0, -1.0, -3.0]),
    upper=np.array([2.0, 1.5, 3.0]),
    velocity=np.array([1.0, 2.0, 3.0]),
    acceleration=np.array([4.0, 5.0, 9.0]),
    jerk=np.array([40.0, 50.0, 90.0]),
)


def planned(seed, fly=0.5):
    random = np.random.default_rng(seed)
    points = random.uniform(ROOMY.lower, ROOMY.upper, (5, 3))
    speed = random.uniform(0.2, 1.0, 3)
    return Excitation(
        trajectory=plan(points, ROOMY, speed=speed, fly=fly),
        criteria=Criteria(*random.normal(size=3).tolist(), 700, 1e5, 12.25),
        method="b",
        seed=seed,
        tried=12,
        rejected={"duration": 3, "collision": 1},
        via_points=points,
        speed=speed,
        fly=fly,
    )


def sines(seed):
    random = np.random.default_rng(seed)
    amplitude, frequency = random.uniform(0.1, 1.0, (2, 3, 2))
    return Excitation(
        trajectory=FourierSeries(np.zeros(3), amplitude, frequency, 20.0, 2.0),
        criteria=Criteria(*random.normal(size=3).tolist(), 2501),
        method="a",
        seed=seed,
        tried=100,
        rejected={},
    )


class TestExcitation:
    @given(
        make=st.sampled_from([planned, lambda seed: planned(seed, 0.0), sines]),
        seed=st.integers(0, 2**32 - 1),
    )
    @settings(max_examples=30, deadline=None)
    def test_it_is_restored_bit_for_bit(self, make, seed):
        excitation = make(seed)
        restored = Excitation.from_dict(json.loads(json.dumps(excitation.to_dict())))
        assert restored.to_dict() == excitation.to_dict()
        assert restored.criteria == excitation.criteria
        assert type(restored.trajectory) is type(excitation.trajectory)
        assert bits(restored.trajectory) == bits(excitation.trajectory)
        if restored.via_points is not None:  # its moves plan to the motion bit for bit
            again = plan_moves(restored.via_points[0], restored.moves, ROOMY)
            assert again.trajectory.to_dict() == excitation.trajectory.to_dict()

    def test_data_without_method_are_restored(self):
        excitation = planned(5)
        old = excitation.to_dict()
        del old["method"]
        for name in ("condition", "scaled_condition"):
            del old["criteria"][name]
        restored = Excitation.from_dict(old)
        assert restored.method == "random"
        assert (restored.criteria.condition, restored.criteria.scaled_condition) == (None, None)
        assert restored.criteria.log10_det == excitation.criteria.log10_det
        np.testing.assert_array_equal(restored.via_points, excitation.via_points)

    @pytest.mark.parametrize(
        "damage",
        [
            {"trajectory": {"type": "fourier_series"}},
            {"trajectory": sines(1).trajectory.to_dict() | {"amplitude": [[10**400], [1]]}},
            {"criteria": {**sines(1).to_dict()["criteria"], "beauty": 1.0}},
            {"criteria": asdict(sines(1).criteria) | {"log10_det": "x"}},
            {"seed": "first"},
            {"rejected": {"limits": "many"}},
            {"via_points": None},
            {"via_points": [[0.0]]},
        ],
    )
    def test_invalid_data_are_refused(self, damage):
        with pytest.raises(ValueError, match="not an excitation"):
            Excitation.from_dict({**planned(1).to_dict(), **damage})


# Two links of 1 m that swing in a vertical plane: known to every textbook.
ROD = {
    "shape": '<cylinder radius="0.05" length="0.8"/>',
    "at": "0.5 0 0",
    "rpy": "0 1.5707963 0",
    "centre": "0.5 0 0",
    "inertia": (0.1, 0.1, 0.1),
}
ROD_URDF = robot(
    link("base", '<box size="0.1 0.1 0.1"/>'),
    link("upper", mass=2, **ROD),
    link("lower", mass=1, **ROD),
    joint("shoulder", "base", "upper", "0 -1 0", ends=3),
    joint("elbow", "upper", "lower", "0 -1 0", at="1 0 0", ends=3),
)

ROD_LIMITS = JointLimits([-3.0] * 2, [3.0] * 2, [3.0] * 2, [10.0] * 2, [100.0] * 2)
MOTOR_FROM_JOINT = np.array([[100.0, 0.0], [5.0, -80.0]])
TORQUE_CONSTANT = np.array([0.5, 0.25])


RODS = RobotModel.from_urdf(ROD_URDF, friction=FrictionLaw(third=None))
ROD_VALUES = values_of(RODS, [3.0, 1.0, 0.0, 0.0])


def make_currents(current_limit, values=ROD_VALUES, **more):
    limit = np.array(current_limit)
    return CurrentModel(RODS, values, MOTOR_FROM_JOINT, TORQUE_CONSTANT, limit, **more)


@pytest.fixture(scope="module")
def swing():
    return plan([[0.0, 0.0], [1.5, -1.0], [0.0, 0.0]], ROD_LIMITS, fly=0.0)


class TestCurrents:
    def test_static_currents_agree_with_the_textbook(self, swing):
        motion = sampled(swing, 0.008)
        currents = make_currents([1.0, 1.0])
        unsure = make_currents([1.0, 1.0], uncertainty=0.2)
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
        assert check_motion(swing, ROD_LIMITS, currents=generous) == ()
        current = np.abs(generous.current(generous.torque(motion)))[:, 1]
        usable = UsableShare(0.8), "a motion may use 80 % of the motor's limit"
        for share, remedy, words in ((1.0, None, ""), (0.8, *usable)):
            tight = make_currents([100.0, 0.9 / share * current.max()], usable=share)
            (violation,) = check_motion(swing, ROD_LIMITS, currents=tight)
            assert (violation.kind, subject_text(violation.subject)) == (
                "current",
                "motor of elbow",
            )
            assert violation.value == pytest.approx(current.max())
            assert violation.bound == pytest.approx(0.9 * current.max())
            assert violation.excess == pytest.approx(1 / 0.9 - 1)
            assert violation.time == motion.time[current.argmax()]
            assert violation.remedy == remedy
            for word in ("current", "motor of elbow", "A", f"{violation.time:.3f} s", words):
                assert word in violation_text(violation)

    @pytest.mark.parametrize(
        ("remedy", "words"),
        [
            ("set a ramp", "a sum of sines without a ramp starts and ends at speed; set a ramp"),
            ("rest at both ends", "a motion must start and end at rest"),
        ],
    )
    def test_a_motion_that_is_not_at_rest_at_an_end_gets_a_remedy(self, remedy, words):
        subject = JointQuantity("velocity", 0, "start")
        violation = Violation("joint limit", subject, 0.5, 0.0, 0.0, remedy=remedy)
        assert violation_text(violation).endswith(f"; {words}")

    def test_a_prediction_that_is_not_finite_violates_every_limit(self, swing):
        broken = make_currents([1e9, 1e9], ROD_VALUES * np.nan)
        violations = check_motion(swing, ROD_LIMITS, currents=broken)
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
        violations = {subject_text(v.subject): v for v in check_motion(swing, slow)}
        assert set(violations) == {
            "position of joint 0",
            "position of joint 1",
            "velocity of joint 0",
            "acceleration of joint 1",
            "jerk of joint 1",
        }
        lowest = violations["position of joint 1"]
        assert (lowest.value, lowest.bound) == (pytest.approx(-1.0), -0.5)
        assert "at least -0.5" in violation_text(lowest)
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
            assert violation.subject == JointQuantity(quantity, joint)
            assert violation.bound < violation.value == getattr(reached, name)[joint]

    def test_sines_without_a_ramp_are_refused_with_a_remedy(self):
        bare, gentle = (series(3, ramp=ramp, scale=0.1) for ramp in (0.0, 2.0))
        (violation,) = check_motion(bare, ROD_LIMITS)
        assert violation.kind == "joint limit"
        assert isinstance(violation.subject, JointQuantity)
        assert violation.subject.quantity == "velocity" and violation.subject.end is not None
        assert violation.excess > 0.0
        assert "ramp" in violation_text(violation)
        assert not check_motion(gentle, ROD_LIMITS)
        # A design may look at one all the same.
        lenient = Constraints(ROD_LIMITS, at_rest=False)
        assert lenient.violations(bare, sampled(bare)) == ()


class TestViolations:
    @pytest.mark.parametrize(
        ("shortest", "longest", "side"), [(5.0, 9.0, "least"), (0.0, 1.0, "most")]
    )
    def test_a_motion_too_short_or_too_long_is_named(self, swing, shortest, longest, side):
        constraints = Constraints(ROD_LIMITS, min_duration=shortest, max_duration=longest)
        (violation,) = constraints.violations(swing, sampled(swing))
        bound = shortest or longest
        named = (violation.kind, violation.value, violation.bound)
        assert named == ("duration", swing.duration, bound)
        assert violation.excess == pytest.approx(abs(swing.duration / bound - 1.0))
        assert f"at {side} {bound:g} s" in violation_text(violation)

    def test_excess_by_kind_is_the_largest(self, swing):
        constraints = Constraints(
            ROD_LIMITS.scaled(velocity=0.5),
            max_duration=1.0,
            checker=CollisionChecker(ROD_URDF, Workspace(floor=0.01, margin=0.06)),
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

    def test_the_deepest_contact_is_reported_with_pair_and_instant(self):
        checker = CollisionChecker(ROD_URDF, Workspace(floor=-0.5, margin=0.1))
        down = plan([[0.0, 0.0], [-0.6, 0.0], [0.3, 0.0]], ROD_LIMITS, fly=0.0)
        (violation,) = check_motion(down, ROD_LIMITS, checker=checker)
        assert (violation.kind, violation.subject) == ("collision", CloseBodies("lower", "floor"))
        assert violation.bound == 0.1
        q = down.sample_one(violation.time)[0]
        np.testing.assert_allclose(q, [-0.6, 0.0], atol=2e-3)
        # the end of the lower link, 1.9 m out, its edge 0.05 m below the centre line
        height = 1.9 * np.sin(q[0]) - 0.05 * np.cos(q[0])
        assert height == pytest.approx(-0.5 + violation.value, abs=1e-6)
        np.testing.assert_allclose(violation.posture, q, atol=1e-9)
        # 1 m from shoulder to elbow: that much too close would be an excess of 1
        assert violation.excess == pytest.approx(0.1 - violation.value)
        text = violation_text(violation)
        assert text.startswith(
            f"collision of lower and floor: {violation.value:.4g} m, must be at least 0.1 m"
        )
        assert f"at {violation.time:.3f} s" in text
        assert "joints at (-0." in text


ARM_LIMITS = JointLimits([-2.5] * 2, [2.5] * 2, [3.0] * 2, [10.0] * 2, [100.0] * 2)
MODEL = RobotModel.from_urdf(URDF)
P = MODEL.n_parameters
seeds = st.integers(0, 999)


def some_motion(seed, n_via=5):
    via = np.random.default_rng(seed).uniform(-2.4, 2.4, (n_via, 2))
    return plan(via, ARM_LIMITS, fly=0.5)


def rows_of(motion):
    """Phi of one motion: a row per sample and joint, with less dry friction below standstill."""
    direction = np.clip(motion.velocity / MODEL.friction.standstill, -1.0, 1.0)
    return MODEL.regressor(replace(motion, direction=direction)).dense(P).reshape(-1, P)


def assert_measures(criteria, columns, n_samples):
    """Eqs. 9 and 5 from numpy's QR of Phi itself, which squares no condition number."""
    r = np.linalg.qr(columns, mode="r")
    determinant = 2.0 * np.log10(np.abs(np.diag(r))).sum() - r.shape[1] * math.log10(n_samples)
    inverse = np.linalg.inv(r)
    psi = inverse @ inverse.T
    deviation = np.sqrt(np.diag(psi))
    index = np.abs(np.triu(psi / deviation / deviation[:, None], 1)).sum()
    assert criteria["log10_det"] == pytest.approx(determinant, abs=1e-8)
    assert criteria["coupling_index"] == pytest.approx(index, rel=1e-8, abs=1e-12)


class TestSamples:
    @given(seed=seeds, period=st.floats(1e-3, 5e-2))
    @settings(max_examples=50, deadline=None)
    def test_they_are_uniform_at_ends_or_in_the_middle(self, seed, period):
        trajectory = some_motion(seed)
        ends = sampled(trajectory, period)
        middles = midpoints(trajectory, period)
        steps = np.diff(ends.time)
        assert (ends.time[0], ends.time[-1]) == (0.0, trajectory.duration)
        np.testing.assert_allclose(steps, steps[0], rtol=1e-9)
        assert steps[0] <= period * (1.0 + 1e-6)
        assert steps[0] > period * (1.0 - 1.0 / len(steps)) - 1e-12  # no denser than needed
        np.testing.assert_allclose(middles.time, 0.5 * (ends.time[1:] + ends.time[:-1]), rtol=1e-12)
        assert np.all(middles.velocity[[0, -1]] != 0.0)  # neither end, where nothing moves
        for motion in (ends, middles):
            sampled_states = motion.position, motion.velocity, motion.acceleration
            for series, expected in zip(
                sampled_states, trajectory.sample(motion.time), strict=True
            ):
                np.testing.assert_array_equal(series, expected)


HAND = np.array([[2.0, 1.0], [1.0, 3.0]])  # det = 5, inverse [[3, -1], [-1, 2]] / 5


class TestCriteria:
    def test_a_small_case_by_hand(self):
        criteria = Criteria.of_gram(HAND, 10)
        assert criteria.log10_det == pytest.approx(math.log10(5.0 / 10.0**2), abs=1e-14)
        assert criteria.coupling_index == pytest.approx(1.0 / math.sqrt(6.0), abs=1e-14)
        equation_7 = 0.7 * math.log10(5.0 / 100.0) + 0.3 * 1.0 * math.sqrt(6.0)
        assert criteria.fitness == pytest.approx(equation_7, rel=1e-13)
        assert fitness_eq7(*criteria.measures, 2, (1.0, 0.0)) == pytest.approx(criteria.log10_det)
        assert criteria.measures == (log10_det(HAND, 10), coupling_index(HAND))
        assert tuple(CRITERIA) == ("log10_det", "coupling_index")

    def test_a_determinant_beyond_floats_has_a_logarithm(self):
        gram = np.diag(np.full(58, 1e9))
        with np.errstate(over="ignore"):
            assert np.linalg.det(gram) == np.inf
        assert log10_det(gram, 1) == pytest.approx(9.0 * 58)

    @pytest.mark.parametrize(
        "gram",
        [
            np.diag([1.0, 0.0, 2.0]),  # a parameter without excitation
            np.array([[4.0, 2.0, 2.0], [2.0, 1.0, 1.0], [2.0, 1.0, 1.0]]),  # two equal columns
            np.full((3, 3), np.nan),
        ],
    )
    def test_a_singular_matrix_ranks_last(self, gram):
        expected = Criteria(-np.inf, np.inf, -np.inf, 10, np.inf, np.inf)
        assert Criteria.of_gram(gram, 10) == expected
        assert np.isnan(correlation(gram)).all()

    @given(seed=st.integers(0, 99))
    def test_the_coupling_index_sums_the_correlations(self, seed):
        random = np.random.default_rng(seed)
        columns = random.normal(size=(40, 5)) @ random.normal(size=(5, 5))
        gram = columns.T @ columns
        matrix = correlation(gram)
        assert np.array_equal(matrix, matrix.T)
        assert np.array_equal(np.diag(matrix), np.ones(5))
        assert np.abs(matrix).max() <= 1.0
        index = np.abs(np.triu(matrix, 1)).sum()
        assert coupling_index(gram) == pytest.approx(index, rel=1e-14)
        assert index <= coupling_index_max(5)


class TestMeasures:
    @given(seed=seeds, chosen=st.sets(st.integers(0, P - 1), min_size=1))
    @settings(max_examples=20, deadline=None)
    def test_they_are_of_the_chosen_columns(self, seed, chosen):
        motion = midpoints(some_motion(seed))
        random = np.random.default_rng(seed)
        order = random.permutation(sorted(chosen))
        columns = rows_of(motion)
        objective = Objective(MODEL, parameters=order)
        assert objective.n_parameters == len(chosen)
        assert_measures(objective.measures(motion), columns[:, order], motion.n_samples)
        assert_measures(Objective(MODEL).measures(motion), columns, motion.n_samples)

    def test_the_sign_of_a_rounded_speed_shows_no_friction(self):
        """A joint that holds its place while the other moves has speeds of rounding."""
        motion = midpoints(some_motion(3))
        rests = np.arange(motion.n_samples) > motion.n_samples // 2
        velocity = np.where(rests[:, None] & [False, True], 0.0, motion.velocity)
        still = replace(motion, velocity=velocity)
        rounded = replace(still, velocity=velocity + 1e-12)
        expected = Objective(MODEL).measures(still)
        assert Objective(MODEL).measures(rounded) == pytest.approx(expected, rel=1e-6)

    def test_criteria_are_the_measures_and_more(self):
        trajectory = some_motion(3)
        motion = midpoints(trajectory)
        criteria = Objective(MODEL).criteria(trajectory, SAMPLE_PERIOD)
        assert criteria.measures == tuple(Objective(MODEL).measures(motion).values())
        assert criteria.n_samples == motion.n_samples
        columns = rows_of(motion)
        unit = columns / np.linalg.norm(columns, axis=0)
        assert criteria.condition == pytest.approx(np.linalg.cond(columns), rel=1e-6)
        assert criteria.scaled_condition == pytest.approx(np.linalg.cond(unit), rel=1e-6)


def scores_of(log10_det, coupling_index, *, duration=5.0, excess=0.0):
    """Scores with one excess, of collisions."""
    measures = np.array([log10_det, coupling_index], dtype=float).T.reshape(-1, 2)
    broken = np.zeros((len(measures), len(KINDS)))
    broken[:, KINDS.index("collision")] = excess
    lasting = np.full(len(measures), duration, dtype=float)
    return Scores(measures, np.zeros(len(measures)), lasting, broken)


def front_of(log10_det, coupling_index):
    genes = np.arange(len(log10_det), dtype=float)[:, None]
    return Front.of(genes, scores_of(log10_det, coupling_index))


def same_front(a, b):
    return all(map(np.array_equal, vars(a).values(), vars(b).values()))


# Few different values, so that ties and duplicates are the rule: log10 det, coupling index,
# duration, two genes, and whether it is feasible.
motions = st.lists(
    st.tuples(
        *(st.integers(*ends) for ends in ((0, 5), (0, 5), (1, 2), (0, 2), (0, 2))), st.booleans()
    ),
    max_size=40,
)


def front_of_motions(rows):
    table = np.array(rows, dtype=float).reshape(-1, 6)
    size, coupled, duration, *_, feasible = table.T
    scores = scores_of(size, coupled, duration=duration, excess=np.where(feasible > 0, 0.0, 0.1))
    return Front.of(table[:, 3:5], scores)


class TestFront:
    @given(motions)
    def test_it_is_what_brute_force_finds(self, rows):
        feasible = [row for row in rows if row[5]]
        nondominated = {
            (c, d)
            for d, c, *_ in feasible
            if not any((e >= d and f <= c) and (e > d or f < c) for e, f, *_ in feasible)
        }
        expected = [
            min((t, g, h) for d, c, t, g, h, _ in feasible if (c, d) == pair)
            for pair in sorted(nondominated)
        ]
        front = front_of_motions(rows)
        measures = zip(front.measure("coupling_index"), front.measure("log10_det"), strict=True)
        assert list(measures) == sorted(nondominated)
        assert [tuple(row) for row in np.column_stack((front.duration, front.genes))] == expected

    @given(motions, motions, motions, st.randoms(use_true_random=False))
    def test_it_does_not_depend_on_order(self, a, b, c, random):
        shuffled = a + b + c
        random.shuffle(shuffled)
        whole = front_of_motions(shuffled)
        parts = [front_of_motions(part) for part in (a, b, c)]
        assert same_front(parts[0].merge(parts[1]).merge(parts[2]), whole)
        assert same_front(parts[2].merge(parts[0].merge(parts[1])), whole)
        assert same_front(whole.merge(whole), whole)
        assert same_front(whole.merge(Front.empty(2)), whole)

    def test_motions_without_excitation_are_left_out(self):
        assert front_of([-np.inf, 50.0], [np.inf, 100.0]).measures.tolist() == [[50.0, 100.0]]


NS16 = RobotModel.from_urdf(urdf_text())
CHECKER = CollisionChecker(urdf_text(), Workspace(margin=0.05))
motions_of = partial(random_validation_motions, LIMITS, home=HOME)


def currents(share):
    """Currents of the nominal arm, with this share of the motors' limits."""
    truth = load_truth()
    return CurrentModel(
        model=NS16,
        values=values_of(NS16, np.concatenate((truth.coulomb, truth.viscous, np.zeros(6)))),
        motor_from_joint=np.diag([116.0, 116.0, 106.0, 50.0, 51.5, 33.0]),
        torque_constant=np.array([1.1, 1.1, 0.75, 0.36, 0.42, 0.42]),
        current_limit=share * np.array([16.5, 22.0, 9.5, 3.5, 7.0, 10.0]),
    )


@cache
def found():
    return motions_of(seed=3, count=6, checker=CHECKER, currents=currents(1))


class TestValidationMotions:
    def test_they_are_feasible_wide_and_different(self):
        motions = [each.trajectory for each in found()]
        for motion in motions:
            assert not check_motion(motion, LIMITS, checker=CHECKER, currents=currents(1))
            ends, rates, _ = motion.sample(np.array([0.0, motion.duration]))
            np.testing.assert_allclose(ends, [HOME, HOME], atol=1e-12)
            np.testing.assert_allclose(rates, 0.0, atol=1e-9)
        assert len({motion.duration for motion in motions}) == 6
        low = np.min([motion.extrema().lower for motion in motions], axis=0)
        high = np.max([motion.extrema().upper for motion in motions], axis=0)
        assert np.all((high - low) / (LIMITS.upper - LIMITS.lower) > 0.7)

    def test_their_moves_plan_to_them_bit_for_bit(self):
        for motion in found()[:2]:
            again = plan_moves(motion.via_points[0], motion.moves, LIMITS)
            assert again.trajectory.to_dict() == motion.trajectory.to_dict()

    def test_those_of_a_seed_never_change(self):
        """Recorded with the first campaigns; plans of old archives name these seeds."""
        text = json.dumps(
            [[m.via_points.tolist(), m.speed.tolist()] for m in motions_of(seed=7, count=2)]
        )
        digest = "81044cb7520ca0aff3077b96846fdaf58ac975ee6ca4b7021a38891c0c794bf7"
        assert hashlib.sha256(text.encode()).hexdigest() == digest

    def test_they_satisfy_the_current_limits(self):
        modest = currents(0.5)
        for how, satisfied in (({}, False), ({"currents": modest}, True)):
            motions = motions_of(seed=3, count=6, checker=CHECKER, **how)
            beyond = [check_motion(m.trajectory, LIMITS, currents=modest) for m in motions]
            assert any(beyond) != satisfied

    def test_a_motion_that_crashes_its_planner_is_skipped(self, monkeypatch):
        first, second = motions_of(seed=3, count=2)
        calls = []

        def crash_once(*args, **kwargs):
            calls.append(1)
            if len(calls) == 1:
                raise PlannerCrashed(-11)
            return plan(*args, **kwargs)

        monkeypatch.setattr(validation_motions, "plan_in_child", crash_once)
        other, same = motions_of(seed=3, count=2)
        assert not np.array_equal(other.via_points, first.via_points)
        np.testing.assert_array_equal(same.via_points, second.via_points)


class TestRefusal:
    def refusal(self, **options):
        with pytest.raises(NoFeasibleMotionError) as caught:
            motions_of(count=1, **options)
        return caught.value

    @pytest.mark.long
    def test_it_names_the_violated_constraints(self, monkeypatch):
        error = self.refusal(seed=3, currents=currents(0.01))
        assert error.rejected == {"current": 100}
        mildest = error.nearest["current"]
        assert isinstance(mildest.subject, LoadedDrive) and mildest.subject.is_motor
        assert mildest.value > mildest.bound
        assert violation_text(mildest) in str(error)
        monkeypatch.setattr(validation_motions, "_MAX_DURATION", 2.0)
        error = self.refusal(seed=1)
        assert error.rejected == {"duration": 100}
        assert error.nearest["duration"].bound == 2.0

    def test_a_home_posture_in_collision_is_named_with_its_pair(self):
        low = CollisionChecker(urdf_text(), Workspace(floor=1.2, margin=0.0))
        error = self.refusal(seed=1, checker=low)
        assert "floor at home" in str(error)
        assert error.nearest["collision"].value < 0.0
