"""Verdicts on recordings of the NS 16 with one injected fault, and without."""

import warnings
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from identification.estimators.delay import UndeterminedDelay
from identification.estimators.least_squares import estimate_repetitions
from identification.estimators.prior import body_prior
from identification.factor.estimate import estimate
from identification.factor.factor import Factor
from identification.hypotheses import column_search
from identification.hypotheses.carried_load import CarriedLoad
from identification.hypotheses.column_search import find_columns_of_unseen
from identification.hypotheses.diagnosis import diagnose
from identification.hypotheses.explanation import ExplainedFit, Explanation
from identification.hypotheses.joint_changes import DISCRETE_MEANINGS, Change, Part
from identification.hypotheses.sizes import ScorePrior, estimated_size
from identification.hypotheses.torque_columns import ColumnSums
from identification.hypotheses.unseen_changes import UnseenChange
from identification.model.known_payload import Payload
from identification.model.robot import RobotModel
from identification.text import percentage
from identification.validation.evidence import gather
from identification.validation.finding import Thresholds
from identification.validation.finding_messages import LEFT_OPEN
from identification.validation.nominal_scale import NominalScale
from identification.validation.physical_signs import Implausible, TopSpeedFriction
from identification.validation.prediction import noise_floor
from identification.validation.purpose import Purpose
from identification.validation.residuals import FrictionDrift, Outliers, check_residuals
from identification.validation.ripple import Ripple
from identification.validation.verdict import judge
from sim_fixtures.ns16 import load_truth, urdf_text
from tests import messages
from tests.identification import two_link
from tests.identification.evidence import (
    LATE,
    NOTHING,
    an_error,
    an_estimate,
    caused,
    explained,
    found,
    judged,
    negative,
)
from tests.identification.robots import ns16_values
from tests.identification.two_link import as_samples, four_sines, sine_motion

pytestmark = pytest.mark.long

COULOMB, VISCOUS = map(np.array, (load_truth().coulomb, load_truth().viscous))
CURRENT_NOISE = 0.02  # A
MODEL = RobotModel.from_urdf(urdf_text())


def drive(wrong="", axis=0):
    """Return motor turns per joint turn (6, 6) and torque constants (6,), one sign wrong."""
    figures = {
        "gear": np.array([-116.0, 116.0, -106.0, -50.0, 51.5, -33.0]),
        "constant": np.array([1.10, 1.10, 0.75, 0.36, 0.42, 0.42]),
        "k54": 0.03,
        "k64": -0.02,
        "k65": 0.035,
    }
    if wrong.startswith("k"):
        figures[wrong] = -figures[wrong]
    elif wrong:
        figures[wrong][axis] *= -1.0
    coupling = np.eye(6)
    coupling[4, 3] = -figures["k54"]
    coupling[5, 3:5] = figures["k65"] * figures["k54"] - figures["k64"], -figures["k65"]
    return figures["gear"][:, None] * coupling, figures["constant"]


def a_motion(seed, *, duration=8.0, step=0.01):
    """Three sines on each joint."""
    rng = np.random.default_rng(seed)
    centre = np.array([0.0, -1.2, 2.0, 0.0, 0.0, 0.0])
    amplitude = np.array([0.7, 0.25, 0.5, 1.2, 0.7, 1.5]) * rng.uniform(0.5, 1.0, (3, 6))
    rate = np.array([1.6, 2.4, 2.2, 2.0, 2.6, 2.4]) * rng.uniform(0.4, 1.3, (3, 6))
    phase = rng.uniform(0.0, 2.0 * np.pi, (3, 6))
    return sine_motion(np.arange(0.0, duration, step), amplitude, rate, phase, centre)


def executed(model, truth, motion, seed, assumed, other):
    """Return the samples of a PC that assumes another drive train than the arm has."""
    (real, constant) = drive()
    torque = model.torque(truth, motion)
    torque = torque + other(motion, torque)
    current = np.linalg.solve(real.T, torque.T).T / constant
    current += CURRENT_NOISE * np.random.default_rng(seed).standard_normal(current.shape)
    seen = np.linalg.solve(assumed[0], real).T
    motion = motion.converted(lambda states: states @ seen)
    return as_samples(model, motion, (current * assumed[1]) @ assumed[0])


def nothing(motion, torque):
    return 0.0 * torque


def campaign(
    *, wrong=("", 0), truth=None, disturbance=nothing, unseen_disturbance=None, real=MODEL
):
    assumed = drive(*wrong)
    truth = ns16_values(real) if truth is None else truth
    training = a_motion(17, duration=12.0)
    unseen = unseen_disturbance or disturbance
    fitted = [executed(real, truth, training, k, assumed, disturbance) for k in range(2)]
    held_out = [executed(real, truth, a_motion(k), 10 + k, assumed, unseen) for k in range(2)]
    result = estimate_repetitions(MODEL, fitted)
    evidence = gather(MODEL, result, fitted, held_out, nominal=ns16_values(MODEL))
    return judge(MODEL.joint_names, evidence), evidence


class TestValidCampaign:
    def test_it_is_good_without_causes(self):
        verdict, evidence = campaign()
        assert verdict.good, verdict.reasons
        assert "predicts unseen motion well" in verdict.line
        assert percentage(evidence.held_out.overall, 1) in verdict.line
        assert evidence.systematic.max() < 0.5 * Thresholds().systematic
        assert not {"gravity", "load", "outliers"} & {finding.key for finding in verdict.findings}
        assert np.degrees(evidence.gravity.angle) < 0.5

    def test_unmodelled_effects_stay_good(self):
        def effects(motion, torque):
            motor = motion.position @ drive()[0].T
            ripple = 0.10 * COULOMB * np.sin(2.0 * motor + np.arange(6))
            friction = COULOMB * np.sign(motion.velocity) + VISCOUS * motion.velocity
            late = 0.0005 * np.gradient(torque, motion.time, axis=0)
            return np.asarray(ripple + 0.02 * friction - late)

        verdict, evidence = campaign(disturbance=effects)
        assert verdict.good, verdict.reasons
        assert evidence.systematic.max() > 0.005


class TestOneSidedErrors:
    """Wrong sign in the drive train of one side."""

    @pytest.mark.parametrize(
        ("what", "axis"),
        [
            *(("constant", axis) for axis in range(6)),
            *(("gear", axis) for axis in range(1, 6)),  # of the first the arm is a mirror image
            *((coupling, 4) for coupling in ("k54", "k64", "k65")),
        ],
    )
    def test_a_wrong_sign_is_the_only_cause(self, what, axis):
        """Neither gravity nor a load; large axes are named."""
        verdict, evidence = campaign(wrong=(what, axis))
        assert not verdict.good and "must not be relied on" in verdict.line
        assert evidence.load.explained < Thresholds().load or evidence.load.axes < 3
        assert not {"gravity", "load"} & {finding.key for finding in verdict.findings}
        if what == "gear" and axis < 3:
            first = evidence.diagnosis.steps[0]
            assert first.change.meaning == "axis sign" and first.change.joints == (axis,)
        if what.startswith("k"):
            assert any("joint_4" in reason or "joint_5" in reason for reason in verdict.reasons)

    def test_a_mirrored_arm_is_named_and_predicts(self):
        """With its first axis turned the arm is nearly its mirror image, as with the fourth."""
        verdict, evidence = campaign(wrong=("gear", 0))
        (step,) = evidence.diagnosis.steps
        assert step.change.meaning == "axis sign" and not step.is_adequate
        assert {step.change.joints, *(change.joints for change, _ in step.alike)} == {(0,), (3,)}
        assert "nearest" in {finding.key for finding in verdict.findings}

    @pytest.mark.parametrize(
        ("term", "axis"),
        [*(("coulomb", axis) for axis in (0, 2, 4)), *(("viscous", axis) for axis in (1, 3, 5))],
    )
    def test_negative_friction_is_named(self, term, axis):
        values = {"coulomb": COULOMB, "viscous": VISCOUS}[term].copy()
        values[axis] *= -1.0
        verdict, _ = campaign(truth=ns16_values(MODEL, **{term: values}))
        assert not verdict.good
        assert any(
            "friction" in reason and f"joint_{axis + 1}" in reason for reason in verdict.reasons
        )


class TestUnseenMotion:
    """Changes between fitted and unseen motion."""

    @pytest.mark.parametrize(
        "mounted",
        [(1.703, 0.0, -9.661), (0.0, 0.0, 9.81), (9.81, 0.0, 0.0), (0.0, -9.81, 0.0)],
        ids=["tilted by 10 degrees", "upside down", "on a wall", "on another wall"],
    )
    def test_wrong_gravity_is_named_first(self, mounted):
        verdict, evidence = campaign(real=RobotModel.from_urdf(urdf_text(), gravity=mounted))
        assert not verdict.good
        assert "with gravity (" in verdict.reasons[0]
        np.testing.assert_allclose(evidence.gravity.best, mounted, atol=0.1)
        option = verdict.next_steps[0].partition("`--gravity ")[2].partition("`")[0]
        np.testing.assert_allclose([float(each) for each in option.split()], mounted, atol=0.1)
        assert not any("gear ratio" in step or "jog" in step for step in verdict.next_steps)

    @pytest.mark.parametrize("mass", [4.0, 1.0])
    def test_a_load_is_named_with_its_mass(self, mass):
        carrying = RobotModel.from_urdf(urdf_text(), payload=Payload(mass, (0.0, 0.09, 0.12)))

        def load(motion, _):
            return carrying.load_torque(motion)

        verdict, evidence = campaign(unseen_disturbance=load)
        assert not verdict.good
        assert f"carried {mass:g} ± 0.0" in verdict.reasons[0]
        assert evidence.load.mass == pytest.approx(mass, rel=0.02)
        assert abs(evidence.load.mass - mass) < evidence.load.half_interval
        (step,) = verdict.next_steps
        assert step.startswith("record both with the same tool and payload")

    def test_changed_friction_is_measured(self):
        def warmer(motion, _):
            return 0.2 * (COULOMB * np.sign(motion.velocity) + VISCOUS * motion.velocity)

        verdict, _ = campaign(unseen_disturbance=warmer)
        assert not verdict.good
        assert "joint_1 +20 %" in verdict.reasons[0] and "temperature" in verdict.reasons[0]
        assert verdict.next_steps == (messages.WARM_THE_ARM_UP,)

    @pytest.mark.parametrize("share", [0.01, 0.001])
    def test_outliers_are_named(self, share):
        random = np.random.default_rng(3)

        def spikes(_, torque):
            hit = random.random(torque.shape) < share
            return hit * random.standard_normal(torque.shape) * 0.06 / share * torque.std(axis=0)

        verdict, _ = campaign(disturbance=spikes)
        assert not verdict.good
        assert "isolated outliers" in verdict.reasons[0]
        assert not any("gear ratio" in step for step in verdict.next_steps)
        assert "--estimator tukey" in verdict.next_steps[0]


# Verdicts on given evidence

BEGUN = Part("A.mcap from 3 s on", (False, True))
# Torque 10 ± 0.3 (constant gravity), error 0.5: 5 % of the torque, no variance explained.
HEAVY = replace(an_error(0.05), torque_sum=np.array([1000 * np.sqrt(100.0 - 0.09), 0.0]))
MANY = tuple(f"p{k}" for k in range(12))


def assert_figures(finding, figures):
    """Compare figures of a finding, or of the joints that it names."""
    known = {**finding.values, **finding.each}
    assert {name: known[name] for name in figures} == {
        name: pytest.approx(value) for name, value in figures.items()
    }


class TestJudgement:
    def test_a_recording_with_a_small_error_is_good(self):
        assert judged().good
        assert judged().line == (
            "The model predicts unseen motion well: torque error 5.0 % over all axes, 5.0 % at "
            "worst (one)."
        )

    @pytest.mark.parametrize(
        ("changes", "key", "joints", "figures"),
        [
            ({"held_out": an_error(0.2)}, "overall error", (), {"limit": 0.1}),
            (
                {"held_out": an_error(np.array([0.01, 0.4]))},
                "axis error on unseen motion alone",
                (1,),
                {"relative": (0.4,), "limit": 0.35},
            ),
            (
                {"training": an_error(0.05), "held_out": an_error(0.2)},
                "generalisation",
                (0, 1),
                {"growth": (4.0, 4.0), "relative": (0.2, 0.2)},
            ),
            (
                {
                    "training": replace(an_error(0.05), rows=np.array([100, 0])),
                    "held_out": an_error(np.array([0.01, 0.4])),
                },
                "joints not fitted",
                (1,),
                {},
            ),
            ({"moved": np.array([9.0, 0.4])}, "joints at rest", (1,), {"least": 0.5}),
            ({"held_out": HEAVY}, "nothing explained", (0,), {}),
            (
                {"estimate": an_estimate(undetermined=MANY)},
                "undetermined",
                (),
                {"parameters": MANY},
            ),
            (
                {"nominal": an_error(0.03)},
                "nominal model better",
                (),
                {"nominal": 0.03, "identified": 0.05},
            ),
            ({"diagnosis": caused("axis sign", 0)}, "axis sign", (0,), {"ratio": 0.4}),
            ({"diagnosis": caused("torque sign", 1)}, "torque sign", (1,), {}),
            ({"diagnosis": caused("torque order", 0, 1)}, "torque order", (0, 1), {}),
            ({"diagnosis": caused("joint order", 0, 1)}, "joint order", (0, 1), {}),
            (
                {"diagnosis": caused("delay")},
                "delay of the torque",
                (),
                {"size": 10.0, "half_interval": 2.0, "difference": 0.01},
            ),
            (
                {"diagnosis": caused("scale", 1)},
                "torque constant",
                (1,),
                {"size": 1.01, "half_interval": 0.002},
            ),
            (
                {"disagreement": np.array([0.2, 0.0])},
                "different repetitions",
                (0,),
                {"difference": (0.2,)},
            ),
            (
                {"implausible": Implausible((negative("m1"),), ())},
                "negative parameter",
                (),
                {"value": -1.0},
            ),
            (
                {"held_out": an_error(0.12), "noise_floor": np.full(2, 0.1), "diagnosis": NOTHING},
                "unexplained error",
                (),
                {"overall": 0.12, "floors": 12.0, "floor": 0.01},
            ),
        ],
    )
    def test_wrong_findings_are_reasons(self, changes, key, joints, figures):
        verdict = judged(**changes)
        assert not verdict.good
        finding = found(**changes)[key]
        assert (finding.level, finding.joints) == ("wrong", joints)
        assert_figures(finding, figures)
        (named,) = (each for each in verdict.findings if each.key == key)
        assert named.words in verdict.reasons
        assert verdict.reasons[0] in verdict.line

    @pytest.mark.parametrize(("floor", "good"), [(0.1, False), (0.8, True)])
    def test_an_error_above_a_tenth_is_good_within_twice_its_noise(self, floor, good):
        # the torque is 10 N·m: a noise of 0.8 N·m causes errors of 8 %
        verdict = judged(
            held_out=an_error(0.15), training=an_error(0.15), noise_floor=np.full(2, floor)
        )
        assert verdict.good is good

    def test_a_better_nominal_model_with_friction_is_a_reason(self):
        changes = {"nominal": an_error(0.5), "nominal_with_friction": an_error(0.03)}
        assert not judged(held_out=an_error(0.05), **changes).good
        changes["nominal_with_friction"] = an_error(0.2)
        assert judged(held_out=an_error(0.05), **changes).good

    def test_purposes_that_were_asked_for_decide(self):
        purposes = (
            Purpose("feed-forward", True, 0.15, 0.2, references={"none": 1.0}),
            Purpose("simulation", False, 0.02, 0.005, "m", references={"horizon": 0.2}),
        )
        large = {"held_out": an_error(0.15), "training": an_error(0.15)}
        assert not judged(**large, purposes=purposes).good
        assert judged(**large, purposes=purposes, asked=("feed-forward",)).good
        assert not judged(**large, purposes=purposes, asked=("feed-forward", "simulation")).good
        assert not judged(**large, purposes=purposes, asked=("contact",)).good
        unknown = (*purposes, Purpose.unknown("contact", "too short", "N"))
        refused = judged(**large, purposes=unknown, asked=("contact",))
        assert not refused.good
        assert "Not judged: contact detection (the unseen motion is too short)" in refused.line

    def test_what_is_wrong_is_said_first(self):
        purposes = (
            Purpose("feed-forward", True, 0.15, 0.2, references={"none": 1.0}),
            Purpose("simulation", False, 0.02, 0.005, "m", references={"horizon": 0.2}),
        )
        large = {"held_out": an_error(0.15), "training": an_error(0.15)}
        verdict = judged(**large, purposes=purposes)
        assert verdict.headline is not None
        named = verdict.findings[verdict.headline]
        assert named.level == "wrong"
        assert verdict.line == (
            f"Not good: {named.words}. Good only for feed-forward (15 % of the torque left). Not"
            " for simulation (flange 20 mm off after 0.2 s)."
        )
        refused = judged(**large, purposes=purposes, asked=("simulation",)).line
        assert refused.startswith("Not for simulation (flange 20 mm off after 0.2 s). Good only")

    def test_a_fault_comes_before_any_purpose(self):
        purposes = (Purpose("feed-forward", True, 0.05, 0.2, references={"none": 1.0}),)
        verdict = judged(
            diagnosis=caused("torque sign", 1), purposes=purposes, asked=("feed-forward",)
        )
        assert not verdict.good
        assert "torque of two probably has the wrong sign" in verdict.line
        assert "feed-forward" not in verdict.line

    @pytest.mark.parametrize(
        ("changes", "key", "joints", "figures"),
        [
            (
                {"diagnosis": caused("scale", 1, ratio=0.85)},
                "torque constant",
                (1,),
                {"size": 1.01},
            ),
            ({"controller": an_error(0.02)}, "controller's model better", (), {}),
            ({"saturated": np.array([0.0, 0.04])}, "saturation", (1,), {"saturated": (0.04,)}),
            ({"estimate": an_estimate(condition=450.0)}, "poor excitation", (), {}),
            (
                {"implausible": Implausible((), (negative("I2m"),))},
                "negative parameter",
                (),
                {"name": "I2m"},
            ),
            ({"training": an_error(0.01)}, "generalisation", (0, 1), {"growth": (5.0, 5.0)}),
            (
                {"friction_change": np.array([0.0, -0.05])},
                "slightly changed friction",
                (1,),
                {"change": (-0.05,)},
            ),
            (
                {"systematic": np.array([0.025, 0.0])},
                "systematic error",
                (0,),
                {"slow": (0.025,), "limit": 0.02},
            ),
            ({}, "no repetitions", (), {}),
        ],
    )
    def test_doubtful_findings_are_warnings(self, changes, key, joints, figures):
        verdict = judged(**changes)
        finding = found(**changes)[key]
        assert (finding.level, finding.joints) == ("doubtful", joints)
        assert_figures(finding, figures)
        (named,) = (each for each in verdict.findings if each.key == key)
        assert verdict.good and named.words in verdict.warnings

    @pytest.mark.parametrize(
        ("meaning", "part"),
        [
            *(
                (meaning, None)
                for meaning in (*DISCRETE_MEANINGS, "delay", "load friction", "scale")
            ),
            *((meaning, BEGUN) for meaning in ("payload", "scale", "friction", "arm")),
        ],
    )
    def test_each_explanation_has_a_message_and_a_step(self, meaning, part):
        verdict = judged(diagnosis=caused(meaning, 0, 1, part=part))
        (cause,) = (finding for finding in verdict.findings if finding.role == "cause")
        assert not {"{", "}"} & {*cause.words, *cause.next_step} and cause.next_step

    @pytest.mark.parametrize("meaning", ["delay", "drift", "load friction", "scale"])
    def test_an_uncertain_part_is_named_with_what_is_throughout(self, meaning):
        throughout = Change(meaning, () if meaning == "load friction" else (1,))
        load = Change("payload", part=BEGUN)
        uncertain = Explanation(load, 0.5, rivals=((load,),), others=(throughout,))
        diagnosis = caused("payload", part=BEGUN)
        verdict = judged(diagnosis=replace(diagnosis, explanations=(uncertain,)))
        (cause,) = (finding for finding in verdict.findings if finding.role == "cause")
        assert "another load with" in cause.words

    def test_one_error_has_one_line(self):
        """That nothing explains it, with the limit that it exceeds."""
        findings = found(held_out=an_error(0.12), noise_floor=np.full(2, 0.1), diagnosis=NOTHING)
        assert "overall error" not in findings
        assert findings["unexplained error"].level == "wrong"
        assert_figures(findings["unexplained error"], {"limit": 0.1})

    def test_a_constant_that_a_spring_explains_as_well_has_no_size(self):
        constant = explained(Change("scale", (1,)), 0.4, 0.1)
        (only,) = constant.explanations
        rivalled = only._replace(rivals=((Change("spring", (1,)),),))
        (cause,) = (
            finding
            for finding in found(diagnosis=replace(constant, explanations=(rivalled,))).values()
            if finding.role == "cause"
        )
        assert cause.key == "torque constant or spring"
        assert "size" not in cause.values

    @pytest.mark.parametrize("error", [0.05, 0.5])
    def test_steps_of_wrong_findings_replace_doubtful_ones(self, error):
        verdict = judged(held_out=an_error(error), estimate=an_estimate(condition=450.0))
        level = "doubtful" if verdict.good else "wrong"
        expected = {finding.next_step for finding in verdict.findings if finding.level == level}
        assert expected == set(verdict.next_steps) and "" not in expected

    def test_an_axis_of_little_torque_does_not_decide_alone(self):
        """A hundredth of the other's torque, or lost in noise, or small against its limit."""

        def axes(torque, **context):
            """Two axes with errors of 5 and 60 %; the torque of the second as a share of 10 N·m."""
            error = an_error(np.array([0.05, 0.6]))
            power = np.array([1.0, torque**2])
            error = replace(
                error, squared=error.squared * power, torque_squared=error.torque_squared * power
            )
            return {"held_out": error, "training": error, **context}

        assert not judged(**axes(0.03)).good
        assert judged(**axes(0.01)).good
        warning = found(**axes(0.01))["axis error of little torque"]
        assert (warning.level, warning.joints, warning.remedy) == ("doubtful", (1,), "move faster")
        assert_figures(warning, {"relative": (0.6,), "torque": (0.1,), "unit": ("N·m",)})
        assert judged(**axes(0.03, noise_floor=np.array([0.1, 0.2]))).good
        assert judged(**axes(0.03, torque_limit=np.array([30.0, 100.0]))).good

    @pytest.mark.parametrize("power", [1.0, 1e-8])
    def test_an_error_beyond_all_torque_is_no_noise(self, power):
        """567 times the torque: a faster motion would not help."""
        error = an_error(np.array([0.05, 567.38]))
        size = np.array([1.0, power])
        error = replace(
            error, squared=error.squared * size, torque_squared=error.torque_squared * size
        )
        findings = found(held_out=error, training=error)
        of_axis = [finding for finding in findings.values() if "relative" in finding.each]
        assert {finding.joints for finding in of_axis} == {(1,)}
        assert_figures(of_axis[0], {"relative": (567.38,)})
        assert {finding.remedy for finding in of_axis} <= {
            "check the drives",
            "check the drives and the unit",
        }
        assert "move faster" not in {finding.remedy for finding in findings.values()}

    def test_an_error_of_rounding_does_not_grow(self):
        findings = found(training=an_error(1e-7), held_out=an_error(1e-6))
        assert not {"generalisation", "outliers"} & findings.keys()

    def test_a_joint_several_times_worse_than_its_fit_is_not_good(self):
        changes = {"training": an_error(np.array([0.05, 0.015])), "held_out": an_error(0.1)}
        assert not judged(**changes).good
        finding = found(**changes)["generalisation"]
        assert finding.joints == (1,)
        assert_figures(finding, {"growth": (0.1 / 0.015,), "relative": (0.1,)})

    def test_nor_is_one_whose_share_grew_more_than_its_error(self):
        """Twice the error, of less torque."""
        fitted = an_error(np.array([0.04, 0.03]))
        unseen = an_error(np.array([0.04, 0.09]))
        less = np.array([1.0, 0.45])
        unseen = replace(
            unseen, squared=unseen.squared * less, torque_squared=unseen.torque_squared * less
        )
        assert len(judged(training=fitted, held_out=unseen).reasons) == 1
        finding = found(training=fitted, held_out=unseen)["generalisation"]
        assert (finding.level, finding.joints) == ("wrong", (1,))
        assert_figures(finding, {"growth": (3.0,), "relative": (0.09,)})
        still = replace(
            unseen, squared=unseen.squared / 4, torque_squared=unseen.torque_squared / 4
        )
        assert judged(training=fitted, held_out=still).good

    def test_nor_is_one_of_little_torque(self):
        """A hundredth of the other's; but one that is lost in noise is excused."""
        power = np.array([1.0, 1e-4])

        def small(relative):
            error = an_error(np.array(relative))
            return replace(
                error, squared=error.squared * power, torque_squared=error.torque_squared * power
            )

        changes = {"training": small([0.01, 0.013]), "held_out": small([0.01, 0.1])}
        assert not judged(**changes).good
        assert_figures(found(**changes)["generalisation"], {"growth": (0.1 / 0.013,)})
        assert judged(**changes, noise_floor=np.array([0.1, 0.1])).good

    @pytest.mark.parametrize(
        ("change", "error", "level"),
        [
            (UnseenChange("gain", 1, 0.91, 0.001, 0.01), 0.1, "wrong"),
            (UnseenChange("gain", 1, 0.95, 0.001, 0.01), 0.05, "doubtful"),
            (UnseenChange("friction", 0, 1.3, 0.01, 0.01), 0.1, "wrong"),
            (UnseenChange("friction", 0, 1.3, 0.01, 0.01), 0.03, "wrong"),
            (UnseenChange("friction", 0, 1.3, 0.01, 0.01), 0.01, "wrong"),
            (UnseenChange("friction", 0, 1.3, 0.01, 0.01), 0.004, "doubtful"),
            (UnseenChange("friction", 0, 0.92, 0.01, 0.01), 0.1, "doubtful"),
        ],
    )
    def test_what_changed_is_named(self, change, error, level):
        findings = found(changes=(change,), held_out=an_error(error), training=an_error(error))
        (cause,) = (finding for finding in findings.values() if finding.role == "cause")
        assert (cause.level, cause.joints) == (level, (change.joint,))
        if change.kind == "gain":
            assert cause.key == "changed torque"
            assert_figures(cause, {"factor": (change.ratio,), "half_interval": (0.002,)})
        else:
            wrong, slight = "changed friction", "slightly changed friction"
            assert cause.key == (wrong if level == "wrong" else slight)
            assert_figures(cause, {"change": (change.ratio - 1.0,)})

    def test_a_friction_within_the_limit_is_not_listed_beyond_it(self):
        changes = tuple(
            UnseenChange("friction", joint, ratio, 0.01, 0.01)
            for joint, ratio in enumerate((1.05, 1.3))
        )
        finding = found(changes=changes, held_out=an_error(0.1))["changed friction"]
        assert finding.joints == (1,)

    def test_friction_beyond_that_of_temperature_is_listed_alone(self):
        findings = found(
            systematic=np.array([0.01, 0.04]),
            systematic_without_friction=np.array([0.01, 0.01]),
            friction_change=np.array([0.07, 0.2]),
        )
        assert findings["changed friction"].joints == (1,)

    def test_torque_and_friction_that_are_alike_are_both_named(self):
        changes = (UnseenChange("friction", 1, 1.1001, 0.001, 0.01, alike=True),)
        (cause,) = (each for each in found(changes=changes).values() if each.role == "cause")
        assert cause.values["alike_joints"] == (1,)

    def test_a_gain_of_the_fitted_motion_alone_has_changed(self):
        """The fit shows it against the other axes, unseen motion shows that it is gone."""
        changes = (UnseenChange("gain", 1, 0.91, 0.001, 0.01),)
        diagnosis = explained(Change("scale", (1,)), 0.4, 0.1)
        assumed = {"scale_std": np.full(2, 0.03), "held_out": an_error(0.1)}
        findings = found(diagnosis=diagnosis, changes=changes, **assumed)
        assert findings["changed torque"].level == "wrong"

    @pytest.mark.parametrize(("changed", "named"), [(0, False), (1, True), (None, True)])
    def test_a_torque_that_changed_is_no_reference_of_constants(self, changed, named):
        """The constant of axis 1 is relative to axis 0."""
        changes = () if changed is None else (UnseenChange("gain", changed, 0.91, 0.001, 0.01),)
        diagnosis = caused("scale", 1, ratio=0.86)
        findings = found(diagnosis=diagnosis, changes=changes, held_out=an_error(0.1))
        assert named == ("torque constant" in findings)

    @pytest.mark.parametrize(
        ("size", "ratio", "error", "level"),
        [
            (0.1, 0.8, 0.1, "information"),
            (0.2, 0.8, 0.1, "wrong"),
            (0.2, 0.9, 0.1, "doubtful"),
            (0.2, 0.8, 0.05, "doubtful"),
        ],
    )
    def test_a_constant_within_the_assumed_scale_is_no_cause(self, size, ratio, error, level):
        """Three standard deviations of the ratio of two torques known to 3 % are 13 %.

        The scale of the other torque is in the deviation of the factor. The ratio is that of both
        axes: the error of the second is multiplied by its square.
        """
        diagnosis = explained(Change("scale", (1,)), ratio, size, 0.03)
        errors = {"held_out": an_error(error), "training": an_error(error)}
        findings = found(diagnosis=diagnosis, scale_std=np.full(2, 0.03), **errors)
        is_assumed = level == "information"
        key = "torque constant, as assumed" if is_assumed else "torque constant"
        assert findings[key].level == level
        assert ("torque constant" in findings) == (not is_assumed)

    def test_a_body_that_explains_the_error_is_not_unexplained(self):
        changes = {"held_out": an_error(0.1), "noise_floor": np.full(2, 0.1), "diagnosis": NOTHING}
        load = CarriedLoad(mass=2.0, explained=0.98, axes=2, half_interval=0.1)
        findings = found(**changes, load=load)
        assert findings["load"].level == "wrong" and "unexplained error" not in findings
        assert_figures(findings["load"], {"mass": 2.0, "explained": 0.98, "half_interval": 0.1})

    def test_a_load_for_a_part_of_the_time_has_no_mass(self):
        """The mass that fits all of the unseen motion is between that of the load and none."""
        changes = {"held_out": an_error(0.1), "noise_floor": np.full(2, 0.1), "diagnosis": NOTHING}
        load = CarriedLoad(1.1, 0.93, 2, half_interval=0.6, is_throughout=False)
        finding = found(**changes, load=load)["load"]
        assert_figures(finding, {"explained": 0.93})

    def test_a_motion_in_one_direction_is_doubtful(self):
        finding = found(one_way=np.array([False, True]))["one direction"]
        assert (finding.level, finding.joints) == ("doubtful", (1,))
        assert finding.remedy == "move in both directions"

    def test_springs_and_balancers_are_named_before_faults(self):
        findings = found(held_out=an_error(0.2), training=an_error(0.2))
        assert findings["overall error"].remedy == "describe elements, or check the drives"

    def test_it_explains_what_is_not_determined(self):
        estimate = an_estimate(undetermined=("f0_2", "fo_2", "m1"))
        findings = found(estimate=estimate, one_way=np.array([False, True]))
        direction, others = findings["undetermined in one direction"], findings["undetermined"]
        assert direction.level == others.level == "wrong"
        assert direction.joints == (1,)
        assert_figures(direction, {"coulomb": ("f0_2",), "offset": ("fo_2",)})
        assert direction.remedy == "move in both directions"
        assert_figures(others, {"parameters": ("m1",), "count": 1})
        assert "one direction" not in findings

    def test_joints_without_friction_are_named(self):
        estimate = an_estimate(undetermined=("m1", "f1_2"))
        finding = found(estimate=estimate)["undetermined"]
        assert_figures(finding, {"friction_joints": (1,), "count": 2})
        estimate = an_estimate(undetermined=("m1",))
        assert "friction_joints" not in found(estimate=estimate)["undetermined"].values

    def test_all_negated_torques_are_one_cause(self):
        """By the nominal model, or by friction that would drive every axis."""
        signs = Implausible((negative("m1"), negative("I2m")), ())
        nominal = NominalScale(np.full(2, -1.0), np.full(2, 0.1), np.zeros(2))
        driving = TopSpeedFriction(np.full(2, -3.0), np.full(2, 0.1))
        for symptom, key in (
            ({"nominal_scale": nominal}, "all torques opposite"),
            ({"dissipation": driving}, "all axes driven by friction"),
        ):
            findings = found(implausible=signs, diagnosis=caused("axis sign", 0), **symptom)
            (wrong,) = (each for each in findings.values() if each.level == "wrong")
            assert (wrong.key, wrong.remedy) == (key, "negate all torques")

    @pytest.mark.parametrize(("known", "named"), [(-0.25, True), (np.nan, False)])
    def test_a_balanced_arm_has_no_scale_of_its_masses(self, known, named):
        """Centres of mass that are uncertain by more than what the bodies lift say none."""
        diagnosis = replace(NOTHING, rigid=replace(NOTHING.rigid, scale=-0.25, std=0.1))
        scale = NominalScale(np.full(2, known), np.full(2, 0.1), np.full(2, 0.1))
        assert ("another arm" in found(diagnosis=diagnosis, nominal_scale=scale)) == named

    def test_one_negated_torque_is_named_by_the_nominal_model(self):
        scale = NominalScale(np.array([1.0, -1.0]), np.full(2, 0.1), np.zeros(2))
        findings = found(nominal_scale=scale)
        (wrong,) = (each for each in findings.values() if each.level == "wrong")
        assert (wrong.key, wrong.joints) == ("torque opposite", (1,))
        assert_figures(wrong, {"scale": (-1.0,)})

    def test_friction_that_drives_one_axis_is_not_all_torques(self):
        dissipation = TopSpeedFriction(np.array([3.0, -3.0]), np.full(2, 0.1))
        assert judged(dissipation=dissipation).good

    def test_a_worse_model_of_the_controller_is_good(self):
        comparison = found(controller=an_error(0.09))["controller's model worse"]
        assert comparison.level == "good"
        assert_figures(comparison, {"controller": 0.09, "identified": 0.05})

    def test_a_small_slow_error_is_no_finding(self):
        assert "systematic error" not in found(systematic=np.array([0.019, 0.0]))

    def test_a_delay_comes_before_torque_constants(self):
        verdict = judged(systematic=np.array([0.1, 0.1]), delays=LATE)
        assert not verdict.good
        assert "--delay auto" in verdict.next_steps[0]
        assert "torque constant of one, two" in verdict.next_steps[1]

    def test_a_delay_of_a_wide_interval_is_suspected(self):
        """It differs significantly, and was not applied."""
        wide = replace(LATE, delay=0.009, std=1e-3, reason=UndeterminedDelay.WIDE_INTERVAL)
        suspected = found(delays=wide)["suspected delay"]
        assert suspected.level == "doubtful"
        assert_figures(suspected, {"delay": 9.0, "half_interval": 2.0, "assumed": 0.0})
        for unsure in (replace(wide, significant=False), replace(wide, std=4e-3)):
            assert not any("delay" in key for key in found(delays=unsure))

    @pytest.mark.parametrize(("used", "figures"), [(0.0026, {"used": 2.6}), (0.003, {})])
    def test_a_delay_far_from_the_stated_one_is_doubtful(self, used, figures):
        """Also where the fit has one between the two."""
        finding = found(delays=LATE, assumed_delay=used)["compensated delay"]
        assert finding.level == "doubtful"
        assert_figures(finding, {"delay": 3.0, "half_interval": 0.2, "stated": 0.0} | figures)
        assert ("used" in finding.values) == bool(figures)

    def test_a_delay_near_the_stated_one_is_as_assumed(self):
        finding = found(delays=replace(LATE, delay=0.0005), assumed_delay=0.0004)["assumed delay"]
        assert finding.level == "good" and "tolerance" not in finding.values
        assert_figures(finding, {"delay": 0.5, "half_interval": 0.2, "stated": 0.0, "used": 0.4})

    def test_a_delay_outside_its_interval_is_not_as_assumed(self):
        """A difference of less than 60 % of a cycle does not matter, but it is one."""
        finding = found(delays=replace(LATE, delay=0.0004), assumed_delay=0.0)["assumed delay"]
        assert finding.level == "good"
        assert_figures(finding, {"delay": 0.4, "half_interval": 0.2, "tolerance": 0.6})

    def test_models_of_the_same_fit_that_predict_apart_are_named(self):
        large = an_error(0.2)
        left_open = found(held_out=large, open_share=0.25)[LEFT_OPEN]
        assert left_open.level == "doubtful"
        assert_figures(left_open, {"fitted": 0.04, "open": 0.25})
        for error, share in ((large, 0.15), (large, None), (an_error(0.05), 0.25)):
            assert LEFT_OPEN not in found(held_out=error, open_share=share)

    def test_undetermined_repetitions_are_not_compared(self):
        changes = {"estimate": an_estimate(undetermined=MANY), "disagreement": np.array([0.8, 0.1])}
        assert len(judged(**changes).reasons) == 1

    def test_joint_names_may_contain_braces(self):
        verdict = judged(("{one}", "<two>"), held_out=an_error(0.4), training=an_error(0.4))
        assert "{one} 40 %, <two> 40 %" in " ".join(verdict.reasons)
        assert any(
            "torque constant of {one}, <two>," in next_step for next_step in verdict.next_steps
        )


def ripple(size):
    """Return a ripple of the second joint, four per motor turn, of this rms."""
    has_ripple = np.array([False, size > 0.0])
    return Ripple("motor", np.array([1.0, 4.0]), np.array([0.0, size]), has_ripple)


def drift(*change):
    """Return a drift over ten parts with small scatter."""
    total = np.array(change)
    return FrictionDrift(np.linspace(0.0, 1.0, 10)[:, None] * total, total, np.full(2, 1e-4), 8)


@pytest.fixture(scope="module")
def clean():
    """Checks of the residual of two links with white noise, without ripple and drift."""
    model = two_link.MODEL
    values = two_link.truth()
    time = np.arange(3000) * 4e-3
    runs = [
        two_link.simulated(model, values, four_sines(time, seed=seed), two_link.NOISE, seed)
        for seed in range(6)
    ]
    checks = check_residuals(model, values, runs[:5], runs[5:])
    return replace(checks, drift=None, rms=np.full(2, 0.01))


def few_outliers(error, of_positions=(False, False)):
    where = np.array(of_positions)
    return Outliers(np.full(2, 0.001), np.full(2, 0.95), an_error(error), where)


class TestPatternsOfTheResidual:
    """Those that were found by chance alone are no finding, small ones no doubt."""

    def test_untested_ones_have_no_finding(self, clean):
        findings = found(residuals=clean)
        assert "correlated residual" in findings
        assert not [key for key in findings if "ripple" in key or "drift" in key]

    @pytest.mark.parametrize(("error", "named"), [(0.0004, False), (0.05, True)])
    def test_an_error_of_zero_has_no_outliers(self, clean, error, named):
        few = few_outliers(0.2 * error)
        findings = found(held_out=an_error(error), residuals=replace(clean, outliers=few))
        assert ("outliers" in findings) == named

    @pytest.mark.parametrize(
        ("of_positions", "remedy"),
        [
            ([False, False], "check the torque for spikes"),
            ([True, False], "check the torque for spikes"),
            ([True, True], "check the positions for steps"),
        ],
    )
    def test_outliers_are_looked_for_where_they_are(self, clean, of_positions, remedy):
        few = few_outliers(0.01, of_positions)
        findings = found(held_out=an_error(0.05), residuals=replace(clean, outliers=few))
        assert findings["outliers"].remedy == remedy

    @pytest.mark.parametrize(
        ("share", "key", "level"),
        [
            (0.0, "no ripple", "good"),
            (0.9, "usual ripple", "information"),
            (1.1, "large ripple", "doubtful"),
        ],
    )
    def test_large_ripple_is_doubtful(self, clean, share, key, level):
        size = share * Thresholds().ripple
        finding = found(residuals=replace(clean, ripple=ripple(size * clean.torque_rms[1])))[key]
        assert finding.level == level
        if share:
            assert finding.joints == (1,)
            assert_figures(finding, {"harmonic": (4,), "relative": (size,)})

    @pytest.mark.parametrize(("share", "level"), [(0.9, "information"), (1.1, "doubtful")])
    def test_ripple_over_the_angle_is_named_without_gears(self, clean, share, level):
        size = share * Thresholds().ripple
        rms = np.array([0.0, size]) * clean.torque_rms
        of_angle = Ripple("joint", np.array([np.nan, 200.0]), rms, rms > 0.0)
        finding = found(residuals=replace(clean, ripple=of_angle))["ripple over the angle"]
        assert finding.level == level
        assert finding.joints == (1,)
        assert_figures(finding, {"periods": (200.0,), "relative": (size,)})

    @pytest.mark.parametrize(
        ("change", "share", "key", "joints"),
        [
            ((1e-5, -1e-5), 1.0, "no friction drift", ()),
            ((0.02, 0.0), 1.0, "small friction drift", (0,)),
            ((0.1, 0.0), 0.2, "small friction drift", (0,)),
            ((0.02, -0.2), 1.0, "large friction drift", (1,)),
            ((-1.2, -0.2), 1.0, "large friction drift", (1,)),  # no friction falls below zero
        ],
    )
    def test_drift_is_judged_by_its_torque(self, clean, change, share, key, joints):
        changed = replace(clean, drift=drift(*change), friction_share=np.array([share, 1.0]))
        finding = found(residuals=changed)[key]
        assert finding.joints == joints
        assert finding.each.get("change", ()) == tuple(change[joint] for joint in joints)
        assert (finding.role == "cause") == (finding.level == "doubtful")
        if key.startswith("small"):
            assert_figures(finding, {"most": 0.02})


# Causes

NOISE = 0.02  # of each joint's torque
LOAD = 6.0  # kg
DELAY = 0.02  # s
ROWS_AS_ONE = 5.0
SLOW = 0.2  # rad/s; rows near a reversal are left out


def recorded(seed, load=None):
    """Return a motion with the paper's arm, a load (m,) [kg] on its flange, and noise."""
    motion = a_motion(seed, duration=10.0, step=8e-3)
    torque = MODEL.torque(ns16_values(MODEL), motion)
    if load is not None:
        torque = torque + load[:, None] * of_one_kilogram(motion)
    rng = np.random.default_rng(seed + 1000)
    torque = torque + NOISE * torque.std(axis=0) * rng.standard_normal(torque.shape)
    return as_samples(MODEL, motion, torque, usable=np.abs(motion.velocity) > SLOW)


def of_one_kilogram(motion):
    """Return the torque (pinocchio) of a sphere of 1 kg, 10 cm from the last joint."""
    bare = pin.buildModelFromXML(urdf_text())
    loaded = bare.copy()
    body = pin.Inertia.FromSphere(1.0, 0.05)
    loaded.inertias[6] += body.se3Action(pin.SE3(np.eye(3), np.array([0.0, 0.0, 0.1])))
    data = bare.createData(), loaded.createData()
    rows = motion.states()
    return np.array(
        [pin.rnea(loaded, data[1], *row) - pin.rnea(bare, data[0], *row) for row in rows]
    )


def causes(recordings):
    """Return what explains the errors of a fit."""
    factors = (Factor.of(MODEL, samples) for samples in recordings)
    total = sum(factors, Factor.zero(MODEL))
    prior = ScorePrior(body_prior(MODEL, total).gaussian, ROWS_AS_ONE)
    values = estimate(MODEL, total).values
    names = [f"{k}.mcap" for k in range(len(recordings))]
    noise = noise_floor(MODEL, values, recordings)
    return diagnose(MODEL, recordings, ExplainedFit(values, noise, names, prior)).explanations


def first_rows(samples, stop):
    part = slice(0, stop)
    return replace(
        samples,
        motion=samples.motion.rows(part),
        torque=samples.torque[part],
        usable=samples.usable[part],
        segments=(part,),
    )


def late(samples):
    time = samples.motion.time
    torque = [np.interp(time - DELAY, time, column) for column in samples.torque.T]
    return replace(samples, torque=np.column_stack(torque))


def swapped(values):
    return values[:, [0, 2, 1, 3, 4, 5]]


def turned(values):
    return values * np.array([1.0, 1.0, -1.0, 1.0, 1.0, 1.0])


def moved(samples, change, *, torque=True):
    """Return samples with another motion, and with another torque by default."""
    motion = samples.motion.kinematics().converted(change)
    if not torque:
        return replace(samples, motion=motion)
    usable = np.abs(change(samples.usable.astype(np.float64))) > 0.0
    return replace(samples, motion=motion, torque=change(samples.torque), usable=usable)


def with_axis_2(values):
    """Axis 3 relative to the base."""
    return values + np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0]) * values[:, [1]]


def relieved(samples):
    """Rods drive axis 3 from the base: motor 2 does not carry its torque."""
    torque = samples.torque - np.array([0.0, 1.0, 0.0, 0.0, 0.0, 0.0]) * samples.torque[:, [2]]
    return replace(samples, torque=torque)


GAIN = np.array([1.0, 1.15, 1.0, 1.0, 1.0, 1.0])
FAULTS = {
    "delay": ((), late),
    "scale": ((1,), lambda samples: replace(samples, torque=GAIN * samples.torque)),
    "torque sign": ((2,), lambda samples: replace(samples, torque=turned(samples.torque))),
    "torque order": ((1, 2), lambda samples: replace(samples, torque=swapped(samples.torque))),
    "axis sign": ((2,), lambda samples: moved(samples, turned)),
    "position order": ((1, 2), lambda samples: moved(samples, swapped, torque=False)),
    "joint order": ((1, 2), lambda samples: moved(samples, swapped)),
    "angle sum": ((2, 1), lambda samples: moved(samples, with_axis_2, torque=False)),
    "drive sum": ((2, 1), lambda samples: relieved(moved(samples, with_axis_2, torque=False))),
}
SIZES = {"delay": DELAY, "scale": 0.15}


class TestCausesOfWholeRecordings:
    """Faults of all recordings."""

    @pytest.mark.parametrize("seed", range(8))
    def test_valid_recordings_have_none(self, seed):
        assert causes([recorded(seed)]) == ()

    @pytest.mark.parametrize("kind", FAULTS)
    @pytest.mark.parametrize("seed", [1, 2])
    def test_a_single_fault_is_named(self, kind, seed):
        """With its size within four standard deviations."""
        joints, spoil = FAULTS[kind]
        (cause,) = causes([spoil(recorded(seed))])
        assert (cause.change.meaning, cause.change.joints) == (kind, joints)
        if size := SIZES.get(kind):
            assert cause.size == pytest.approx(size, abs=4.0 * cause.std + 0.02 * size)

    @pytest.mark.parametrize("seed", [1, 3])
    def test_impossible_bodies_do_not_hide_a_turned_torque(self, seed):
        """Two seconds leave them open; the prior of the estimate does not."""
        _, turn = FAULTS["torque sign"]
        short = first_rows(recorded(seed), 250)
        assert causes([short]) == ()
        (cause,) = causes([turn(short)])
        assert (cause.change.meaning, cause.change.joints) == ("torque sign", (2,))


CONSTANT = 1.5  # of a motor, wrong by this factor


def of_another_constant(samples, joint, factor=CONSTANT, first=0):
    """Return samples whose torque of one joint is multiplied, from a row on."""
    torque = samples.torque.copy()
    torque[first:, joint] *= factor
    return replace(samples, torque=torque)


def misfit(samples, joint, factor):
    """Return the weighted error of an ordinary fit with the torque of a joint divided by a factor.

    The errors of that joint count as those of the torque as it was.
    """
    scale = np.ones(6)
    scale[joint] = factor
    blocks, columns = samples.regressor(MODEL)
    noise = NOISE * np.array([np.std(samples.torque[:, j]) for j in range(6)]) / scale
    rows = []
    target = []
    for j, (block, used) in enumerate(zip(blocks, columns, strict=True)):
        table = np.zeros((len(block), MODEL.n_parameters))
        table[:, used] = block
        some = samples.usable[:, j]
        rows.append(table[some] / noise[j])
        target.append(samples.torque[some, j] / scale[j] / noise[j])
    rows, target = np.concatenate(rows), np.concatenate(target)
    size = np.linalg.norm(rows, axis=0)
    solution = np.linalg.lstsq(rows / size, target, rcond=1e-9)[0]
    return np.sum((target - rows / size @ solution) ** 2)


def size_of(fault, samples, **known):
    """Return the size that is estimated of a fault."""
    values = estimate(MODEL, Factor.of(MODEL, samples)).values
    tables = ColumnSums.of(MODEL, [samples], values, divided=4)
    return estimated_size(fault, tables, MODEL, values, **known)


class TestPrintedSizes:
    """A size in a verdict is one to correct the recording by."""

    @pytest.mark.parametrize("joint", [0, 1, 2])
    def test_dividing_by_the_printed_factor_heals_the_recording(self, joint):
        spoilt = of_another_constant(recorded(1), joint)
        cause = causes([spoilt])[0]
        assert (cause.change.meaning, cause.change.joints) == ("scale", (joint,))
        factor = 1.0 + cause.size
        assert factor == pytest.approx(CONSTANT, abs=cause.half_interval)
        assert cause.half_interval < 0.15
        # No better one is beyond the interval.
        near = factor + cause.half_interval * np.array([-1.0, 0.0, 1.0])
        errors = [misfit(spoilt, joint, each) for each in near]
        assert np.argmin(errors) == 1
        assert causes([of_another_constant(spoilt, joint, 1.0 / factor)]) == ()

    def test_the_interval_of_a_factor_is_that_of_noise(self):
        """Its deviation over the claimed one, of 16 motions: a chi-square of 16."""
        fault = Change("scale", (1,))
        deviations = []
        for seed in range(16):
            found = size_of(fault, of_another_constant(recorded(seed), 1))
            deviations.append((1.0 + found.size - CONSTANT) / found.std)
        assert 0.6 < np.sqrt(np.mean(np.square(deviations))) < 1.5

    def test_the_interval_of_a_factor_is_that_of_the_other_torques(self):
        """They are known to 3 %, which is more than the noise."""
        fault = Change("scale", (1,))
        deviations = []
        for seed in range(16):
            samples = recorded(seed)
            scale = 1.0 + 0.03 * np.random.default_rng([seed, 5]).standard_normal(6)
            scale[1] = CONSTANT
            samples = replace(samples, torque=scale * samples.torque)
            found = size_of(fault, samples, scale_std=np.full(6, 0.03))
            deviations.append((1.0 + found.size - CONSTANT) / found.std)
        assert 0.6 < np.sqrt(np.mean(np.square(deviations))) < 1.5

    def test_a_factor_of_a_part_is_that_of_the_part(self):
        part = Part("later", (False,) * 6 + (True,) * 4)
        # Rows of blocks, of which there are ten.
        spoilt = of_another_constant(recorded(1), 1, first=750)
        found = size_of(Change("scale", (1,), part=part), spoilt)
        half = found.interval_factor * found.std
        assert 1.0 + found.size == pytest.approx(CONSTANT, abs=half)
        assert half < 0.02

    def test_what_the_motion_leaves_open_has_no_size(self):
        """A torque that is friction alone, of a joint that moves alone."""
        motion = a_motion(1, duration=10.0, step=8e-3)
        for array in (motion.position, motion.velocity, motion.acceleration):
            array[:, :5] = 0.0
        motion.position[:, :5] = 0.3
        torque = MODEL.torque(ns16_values(MODEL), motion)
        usable = np.zeros(torque.shape, dtype=np.bool_)
        usable[:, 5] = True
        samples = as_samples(MODEL, motion, torque, usable=usable)
        assert size_of(Change("scale", (5,)), samples) is None


class TestErrorsWithoutCause:
    def test_a_load_whose_interval_contains_zero_is_none(self, monkeypatch):
        loaded = [recorded(1, LOAD * (np.arange(1250) >= 625))]
        (cause,) = causes(loaded)
        assert cause.change.meaning == "payload"
        monkeypatch.setattr(column_search, "rough_size", lambda *_: (cause.size, cause.size))
        assert not any(each.change.meaning == "payload" for each in causes(loaded))

    def test_a_joint_that_stands_is_not_interchanged(self):
        """Not with joint 5, whose torque is small noise, either."""
        motion = a_motion(1, duration=10.0, step=8e-3)
        motion.position[:, 4] = 0.3
        motion.velocity[:, 4] = 0.0
        motion.acceleration[:, 4] = 0.0
        torque = MODEL.torque(ns16_values(MODEL), motion)
        torque += (
            NOISE * torque.std(axis=0) * np.random.default_rng(3).standard_normal(torque.shape)
        )
        torque[:, 1] = np.random.default_rng(4).permutation(torque[:, 1])
        samples = as_samples(MODEL, motion, torque, usable=np.ones(torque.shape, dtype=np.bool_))
        assert not any(4 in cause.change.joints for cause in causes([samples]))

    @pytest.mark.parametrize("seed", [1, 2])
    def test_friction_that_grows_with_the_load_is_named(self, seed):
        """By a tenth of the rigid torque; no torque constant and no turned axis."""
        samples = recorded(seed)
        rigid = np.where(MODEL.friction_columns, 0.0, ns16_values(MODEL))
        direction = np.sign(samples.motion.velocity)
        load = np.abs(MODEL.torque(rigid, replace(samples.motion, direction=direction)))
        (cause,) = causes([replace(samples, torque=samples.torque + 0.2 * load * direction)])
        assert cause.change.meaning == "load friction"
        assert cause.size == pytest.approx(0.2, abs=0.03)

    @pytest.mark.long
    @pytest.mark.parametrize("factors", [{0: 0.8, 2: 1.3}, {0: 1.3, 1: 0.8}, {1: 1.25, 2: 0.8}])
    def test_two_constants_have_their_sizes_given_each_other(self, factors):
        samples = recorded(1)
        scale = np.array([factors.get(joint, 1.0) for joint in range(6)])
        found = causes([replace(samples, torque=samples.torque * scale)])
        assert {each.change.joints[0] for each in found} == {*factors}
        for each in found:
            (joint,) = each.change.joints
            assert abs(1.0 + each.size - factors[joint]) < each.half_interval

    def test_an_error_that_no_fault_explains_has_none(self):
        """A spring on one axis that the model lacks."""
        samples = recorded(1)
        torque = samples.torque.copy()
        torque[:, 2] += 400.0 * np.sin(3.0 * samples.motion.position[:, 2])
        assert causes([replace(samples, torque=torque)]) == ()

    def test_extreme_torques_raise_no_warning(self):
        """In a block without rows, and with torques near the limits of numbers."""
        samples = recorded(1)
        torque = samples.torque * np.where(np.arange(6) == 5, 1e-150, 1.0)
        usable = samples.usable & (np.arange(len(torque)) > 300)[:, None]
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            causes([replace(samples, torque=torque, usable=usable)])


def test_a_load_that_begins_within_unseen_motion_is_named():
    """From its third second on, which the fitted motion does not show."""
    seen = [recorded(1)]
    values = estimate(MODEL, Factor.of(MODEL, seen[0])).values
    unseen = [recorded(2, LOAD * (np.arange(1250) >= 375))]
    fitted = ExplainedFit(values, noise_floor(MODEL, values, seen))
    (found,) = find_columns_of_unseen(MODEL, seen, unseen, fitted)
    assert found.change.meaning == "payload"
    assert found.change.part.name == "unseen motion from 3 s on"
    assert found.size == pytest.approx(LOAD, abs=4.0 * found.std + 0.1)
    assert find_columns_of_unseen(MODEL, seen, [recorded(2)], fitted) == ()


class TestCausesOfParts:
    """Faults of some recordings."""

    @pytest.mark.parametrize("count", [1, 4])
    def test_a_changed_load_is_measured(self, count):
        """In the second half of one recording, or in two of four."""
        part_name = "0.mcap from 5 s on" if count == 1 else "1.mcap, 3.mcap"
        half = LOAD * (np.arange(1250) >= 625)
        whole = np.full(1250, LOAD)
        runs = [recorded(1, half)]
        if count == 4:
            runs = [recorded(k, whole if k in (1, 3) else None) for k in range(4)]
        (cause,) = causes(runs)
        assert cause.change.meaning == "payload"
        assert cause.change.part.name == part_name
        assert cause.size == pytest.approx(LOAD, abs=4.0 * cause.std + 0.1)

    def test_friction_of_one_recording(self):
        runs = [recorded(k) for k in range(3)]
        velocity = runs[1].motion.velocity[:, 1]
        runs[1].torque[:, 1] += 0.4 * (COULOMB[1] * np.sign(velocity) + VISCOUS[1] * velocity)
        (cause,) = causes(runs)
        assert (cause.change.meaning, cause.change.joints) == ("friction", (1,))
        assert cause.change.part.name == "1.mcap"
        assert cause.size == pytest.approx(0.4, abs=0.05)

    def test_another_arm_in_the_second_half(self):
        runs = [recorded(k) for k in range(4)]
        scale = np.array([1.4, 0.8, 1.3, 0.7, 1.5, 0.8])
        runs[2:] = [replace(samples, torque=scale * samples.torque) for samples in runs[2:]]
        first = causes(runs)[0]
        assert first.change.meaning == "arm"
        assert first.change.part.name == "2.mcap and what follows it"
