"""Verdicts on small campaigns of the NS 16 in which one sign is wrong on one side only."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import get_args

import numpy as np
import pytest
from numpy.typing import NDArray

from identification.estimators.delay import DelayEstimate
from identification.estimators.least_squares import estimate_repetitions
from identification.factor.factor import Estimate
from identification.model.motion import Motion
from identification.model.payload import Payload
from identification.model.robot import RobotModel
from identification.signals.samples import Samples
from identification.validation.causes import Cause, Causes, Fault, Kind
from identification.validation.evidence import Evidence, Repeatability, Surroundings, gather
from identification.validation.plausibility import Implausible
from identification.validation.prediction import PredictionError
from identification.validation.verdict import Thresholds, Verdict, judge
from sim_fixtures.ns16 import urdf_text
from tests.identification.two_link import as_samples, sine_motion

Array = NDArray[np.float64]

ROTORS = [7.6465, 24.5955, 10.48, 0.253, 0.298, 0.12]
COULOMB = np.array([68.035, 108.777, 50.446, 9.248, 8.904, 5.148])
VISCOUS = np.array([41.196, 63.255, 39.248, 3.2659, 16.4439, 8.8808])
TORQUE_CONSTANT = np.array([1.10, 1.10, 0.75, 0.36, 0.42, 0.42])
CURRENT_NOISE = 0.02  # A


@dataclass(frozen=True)
class Drive:
    """Gear ratios, wrist coupling and torque constants, as one side believes them to be."""

    gear: tuple[float, ...] = (-116.0, 116.0, -106.0, -50.0, 51.5, -33.0)
    k54: float = 0.03
    k64: float = -0.02
    k65: float = 0.035
    constant: tuple[float, ...] = tuple(TORQUE_CONSTANT)

    @property
    def motor_from_joint(self) -> Array:
        coupling = np.eye(6)
        coupling[4, 3] = -self.k54
        coupling[5, 3:5] = self.k65 * self.k54 - self.k64, -self.k65
        return np.array(self.gear)[:, None] * coupling

    def with_turned(self, what: str, axis: int = 0) -> Drive:
        if what.startswith("k"):
            return replace(self, **{what: -getattr(self, what)})
        values = list(getattr(self, what))
        values[axis] *= -1.0
        return replace(self, **{what: tuple(values)})


@pytest.fixture(scope="module")
def model() -> RobotModel:
    return RobotModel.from_urdf(urdf_text())


def parameters(model: RobotModel, coulomb: Array = COULOMB, viscous: Array = VISCOUS) -> Array:
    standard = model.nominal.reshape(6, -1).copy()
    standard[:, -1] = ROTORS
    base = model.base.grouping @ standard.ravel()
    return np.concatenate([base, coulomb, viscous, np.zeros(6)])


def a_motion(seed: int, *, duration: float = 8.0, step: float = 0.01) -> Motion:
    time = np.arange(0.0, duration, step)
    rng = np.random.default_rng(seed)
    centre = np.array([0.0, -1.2, 2.0, 0.0, 0.0, 0.0])
    amplitude = np.array([0.7, 0.25, 0.5, 1.2, 0.7, 1.5]) * rng.uniform(0.5, 1.0, (3, 6))
    rate = np.array([1.6, 2.4, 2.2, 2.0, 2.6, 2.4]) * rng.uniform(0.4, 1.3, (3, 6))
    phase = rng.uniform(0.0, 2.0 * np.pi, (3, 6))
    return sine_motion(time, amplitude, rate, phase, centre)


def executed(
    model: RobotModel,
    truth: Array,
    motion: Motion,
    seed: int,
    *,
    believed: Drive,
    disturbance: Callable[[Motion, Array], Array] | None = None,
) -> Samples:
    """What a PC that believes in its drive train makes of the currents of the real arm."""
    real = Drive()
    torque = model.torque(truth, *motion[1:])
    if disturbance is not None:
        torque = torque + disturbance(motion, torque)
    current = np.linalg.solve(real.motor_from_joint.T, torque.T).T / np.array(real.constant)
    current += CURRENT_NOISE * np.random.default_rng(seed).standard_normal(current.shape)
    seen = np.linalg.solve(believed.motor_from_joint, real.motor_from_joint).T
    motion = Motion(motion.time, *(part @ seen for part in motion[1:4]))
    torque = (current * np.array(believed.constant)) @ believed.motor_from_joint
    return as_samples(model, motion, torque)


def campaign(
    model: RobotModel,
    *,
    believed: Drive = Drive(),
    truth: Array | None = None,
    disturbance: Callable[[Motion, Array], Array] | None = None,
    unseen_disturbance: Callable[[Motion, Array], Array] | None = None,
    real: RobotModel | None = None,
) -> tuple[Verdict, Evidence]:
    real = model if real is None else real
    truth = parameters(real) if truth is None else truth

    def run(motion: Motion, seed: int, other: Callable[[Motion, Array], Array] | None) -> Samples:
        return executed(real, truth, motion, seed, believed=believed, disturbance=other)

    training = [run(a_motion(17, duration=12.0), seed, disturbance) for seed in range(2)]
    held_out = [
        run(a_motion(seed), 10 + seed, unseen_disturbance or disturbance) for seed in range(2)
    ]
    result = estimate_repetitions(model, training)
    evidence = gather(model, result, training, held_out, nominal=parameters(model))
    return judge(model.joint_names, evidence), evidence


def test_a_campaign_without_a_fault_is_good(model: RobotModel) -> None:
    verdict, evidence = campaign(model)
    assert verdict.good, verdict.reasons
    assert verdict.reasons == ()
    assert "predicts unseen motion well" in verdict.line
    assert f"{evidence.held_out.overall:.1%}" in verdict.line
    assert evidence.systematic is not None
    assert evidence.systematic.max() < 0.5 * Thresholds().systematic


def test_small_effects_that_no_model_has_do_not_spoil_it(model: RobotModel) -> None:
    def effects(motion: Motion, torque: Array) -> Array:
        motor = motion.position @ Drive().motor_from_joint.T
        ripple = 0.10 * COULOMB * np.sin(2.0 * motor + np.arange(6))
        friction = COULOMB * np.sign(motion.velocity) + VISCOUS * motion.velocity
        late = 0.0005 * np.gradient(torque, motion.time, axis=0)
        return np.asarray(ripple + 0.02 * friction - late)

    verdict, evidence = campaign(model, disturbance=effects)
    assert verdict.good, verdict.reasons
    assert evidence.systematic is not None and evidence.systematic.max() > 0.005


@pytest.mark.parametrize("axis", range(6))
def test_a_gear_ratio_turned_on_one_side_is_found(model: RobotModel, axis: int) -> None:
    verdict, evidence = campaign(model, believed=Drive().with_turned("gear", axis))
    assert not verdict.good
    assert "must not be relied on" in verdict.line
    if axis < 3:
        assert evidence.causes is not None
        first = evidence.causes.found[0]
        assert first.fault.kind == "axis sign"
        assert first.fault.joints in (((0,), (3,)) if axis == 0 else ((axis,),))


@pytest.mark.parametrize("coupling", ["k54", "k64", "k65"])
def test_a_wrist_coupling_turned_on_one_side_is_found(model: RobotModel, coupling: str) -> None:
    verdict, _ = campaign(model, believed=Drive().with_turned(coupling))
    assert not verdict.good
    assert any("joint_4" in reason or "joint_5" in reason for reason in verdict.reasons)


@pytest.mark.parametrize("axis", range(6))
def test_a_torque_constant_turned_on_one_side_is_found(model: RobotModel, axis: int) -> None:
    verdict, _ = campaign(model, believed=Drive().with_turned("constant", axis))
    assert not verdict.good


@pytest.mark.parametrize(
    ("term", "axis"),
    [
        (term, axis)
        for term, first in (("coulomb", 0), ("viscous", 1))
        for axis in range(first, 6, 2)
    ],
)
def test_friction_that_drives_is_found_and_named(model: RobotModel, term: str, axis: int) -> None:
    values = {"coulomb": COULOMB, "viscous": VISCOUS}[term].copy()
    values[axis] *= -1.0
    verdict, _ = campaign(model, truth=parameters(model, **{term: values}))
    assert not verdict.good
    assert any("friction" in reason and f"joint_{axis + 1}" in reason for reason in verdict.reasons)


@pytest.mark.parametrize(
    "mounted",
    [(1.703, 0.0, -9.661), (0.0, 0.0, 9.81), (9.81, 0.0, 0.0), (0.0, -9.81, 0.0)],
    ids=["tilted by 10 degrees", "upside down", "on a wall", "on another wall"],
)
def test_gravity_that_pulls_another_way_is_named_first(
    model: RobotModel, mounted: tuple[float, float, float]
) -> None:
    verdict, evidence = campaign(model, real=RobotModel.from_urdf(urdf_text(), gravity=mounted))
    assert not verdict.good
    assert "gravity seems to pull along" in verdict.reasons[0]
    assert evidence.gravity is not None
    np.testing.assert_allclose(evidence.gravity.best, mounted, atol=0.1)
    assert "gravity of [robot]" in verdict.next_steps[0]
    assert not any("gear ratio" in step or "jog" in step for step in verdict.next_steps)


@pytest.mark.parametrize(
    ("what", "axis"), [*(("gear", axis) for axis in range(6)), ("constant", 1), ("k65", 0)]
)
def test_neither_gravity_nor_a_load_is_blamed_for_the_drive_train(
    model: RobotModel, what: str, axis: int
) -> None:
    _, evidence = campaign(model, believed=Drive().with_turned(what, axis))
    assert evidence.gravity is not None and evidence.load is not None
    assert not evidence.gravity.off(Thresholds().gravity, Thresholds().gravity_angle)
    assert evidence.load.explained < Thresholds().load or evidence.load.axes < 3


@pytest.mark.parametrize("mass", [4.0, 1.0])
def test_a_load_on_unseen_motion_only_is_named_and_weighed(model: RobotModel, mass: float) -> None:
    carrying = RobotModel.from_urdf(urdf_text(), payload=Payload(mass, (0.0, 0.09, 0.12)))

    def load(motion: Motion, _: Array) -> Array:
        return carrying.load_torque(*motion[1:4])

    verdict, evidence = campaign(model, unseen_disturbance=load)
    assert not verdict.good
    assert f"carried {mass:g} ± 0.0" in verdict.reasons[0]
    assert evidence.load is not None and evidence.load.mass == pytest.approx(mass, rel=0.02)
    assert abs(evidence.load.mass - mass) < evidence.load.half_interval
    assert verdict.next_steps[0].startswith("record both with the same tool and payload")
    assert len(verdict.next_steps) == 1


def test_changed_friction_is_given_in_full_as_the_reason(model: RobotModel) -> None:
    def warmer(motion: Motion, _: Array) -> Array:
        return 0.2 * (COULOMB * np.sign(motion.velocity) + VISCOUS * motion.velocity)

    verdict, _ = campaign(model, unseen_disturbance=warmer)
    assert not verdict.good
    assert "20% higher" in verdict.reasons[0] and "warm" in verdict.reasons[0]
    assert verdict.next_steps == ("warm the arm up by moving it before recording",)


@pytest.mark.parametrize("share", [0.01, 0.001])
def test_spikes_are_named_and_no_gear_ratio_is(model: RobotModel, share: float) -> None:
    random = np.random.default_rng(3)

    def spikes(_: Motion, torque: Array) -> Array:
        hit = random.random(torque.shape) < share
        return hit * random.standard_normal(torque.shape) * 0.06 / share * torque.std(axis=0)

    verdict, _ = campaign(model, disturbance=spikes)
    assert not verdict.good
    assert "single samples far outside" in verdict.reasons[0]
    assert not any("gear ratio" in step for step in verdict.next_steps)
    assert "--estimator tukey" in verdict.next_steps[0]


def test_a_sound_campaign_has_no_spikes_no_load_and_the_declared_gravity(
    model: RobotModel,
) -> None:
    verdict, evidence = campaign(model)
    assert not {"gravity", "load", "outliers"} & {one.check for one in verdict.findings}
    assert evidence.gravity is not None and np.degrees(evidence.gravity.angle) < 0.5
    np.testing.assert_array_equal(evidence.loaded, [False, *[True] * 5])


def an_error(relative: Array | float, *, rows: int = 1000) -> PredictionError:
    """Prediction error of given relative size on torques of RMS 10 on each of two axes."""
    squared = rows * (10.0 * np.broadcast_to(relative, 2)) ** 2
    return PredictionError(
        rows=np.full(2, rows),
        absolute=np.sqrt(squared),
        signed=np.zeros(2),
        squared=squared,
        torque_sum=np.zeros(2),
        torque_squared=np.full(2, rows * 100.0),
    )


def an_estimate(**changes: object) -> Estimate:
    estimate = Estimate(
        names=("a", "b"),
        units=("kg", "kg"),
        values=np.ones(2),
        covariance=np.eye(2),
        noise_std=np.ones(2),
        samples=np.full(2, 1000),
        method="",
        condition=10.0,
    )
    return replace(estimate, **changes)


def evidence_with(**changes: object) -> Evidence:
    good = Evidence(an_estimate(), held_out=an_error(0.05), training=an_error(0.04))
    return replace(good, **changes)


AXES = ("one", "two")


def caused(kind: Kind, *joints: int, ratio: float = 0.4) -> Causes:
    return Causes((Cause(Fault(kind, joints), ratio, 0.01, 0.001),), None, ())


def test_a_single_recording_with_a_small_error_is_good() -> None:
    verdict = judge(AXES, evidence_with())
    assert verdict.good
    assert verdict.line == (
        "The model predicts unseen motion well: torque error 5.0% over all axes, 5.0% at worst"
        " (one)."
    )


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"held_out": an_error(0.2)}, "over all axes, more than 12%"),
        ({"held_out": an_error(np.array([0.01, 0.4]))}, "torque error of two"),
        ({"training": an_error(0.05), "held_out": an_error(0.2)}, "one 4.0 times to 20.0%"),
        ({"estimate": an_estimate(undetermined=("a",))}, "does not determine a"),
        ({"nominal": an_error(0.03)}, "nominal model predicts better"),
        ({"causes": caused("axis sign", 0)}, "one seems to turn in the direction opposite"),
        ({"causes": caused("torque sign", 1)}, "torque of two seems to have the other sign"),
        (
            {"causes": caused("torque order", 0, 1)},
            "torques of one and two seem to be interchanged",
        ),
        ({"causes": caused("joint order", 0, 1)}, "positions and torques of one and two"),
        ({"causes": caused("delay")}, "of all axes lags the position by 10 ± 2 ms more"),
        ({"causes": caused("gain", 1)}, "the torque of two is 1.01 ± 0.002 times"),
        ({"disagreement": np.array([0.2, 0.0])}, "repetitions disagree"),
        ({"implausible": Implausible(("m1 is negative",), ())}, "m1 is negative"),
    ],
)
def test_each_fault_turns_the_verdict_and_is_said(changes: dict[str, object], words: str) -> None:
    verdict = judge(AXES, evidence_with(**changes))
    assert not verdict.good
    assert any(words in reason for reason in verdict.reasons)
    assert verdict.reasons[0] in verdict.line


@pytest.mark.parametrize("kind", get_args(Kind))
def test_each_kind_of_cause_has_a_statement_and_a_step(kind: Kind) -> None:
    verdict = judge(AXES, evidence_with(causes=caused(kind, 0, 1)))
    (finding,) = (one for one in verdict.findings if one.role == "cause")
    assert not {"{", "}"} & {*finding.words, *finding.next_step} and finding.next_step


def test_a_cause_of_little_error_is_doubtful() -> None:
    verdict = judge(AXES, evidence_with(causes=caused("gain", 1, ratio=0.85)))
    assert verdict.good
    assert any("torque of two is 1.01" in doubt for doubt in verdict.warnings)


def test_a_model_that_does_not_beat_the_mean_torque_is_not_good() -> None:
    # Torque 10 ± 0.3 (gravity that hardly varies), error 0.5: 5 % of the torque, and useless.
    heavy = replace(an_error(0.05), torque_sum=np.array([1000 * np.sqrt(100.0 - 0.09), 0.0]))
    verdict = judge(AXES, evidence_with(held_out=heavy))
    assert not verdict.good
    assert any("on one the model is no better than a constant" in r for r in verdict.reasons)
    assert not any("on two" in r for r in verdict.reasons)


@pytest.mark.parametrize("error", [0.05, 0.5])
def test_what_is_wrong_comes_with_a_next_step_and_before_what_is_doubtful(error: float) -> None:
    verdict = judge(
        AXES, evidence_with(held_out=an_error(error), estimate=an_estimate(condition=450.0))
    )
    level = "doubtful" if verdict.good else "wrong"
    expected = {finding.next_step for finding in verdict.findings if finding.level == level}
    assert expected == set(verdict.next_steps) and "" not in expected


def test_the_controllers_own_model_is_compared_with() -> None:
    worse = evidence_with(surroundings=Surroundings(controller=an_error(0.09)))
    verdict = judge(AXES, worse)
    assert any("misses by 9.0% where this one misses by 5.0%" in s for s in verdict.strengths)
    better = evidence_with(surroundings=Surroundings(controller=an_error(0.02)))
    verdict = judge(AXES, better)
    assert verdict.good
    assert any("controller's own dynamic model predicts better" in d for d in verdict.warnings)


def test_saturation_and_poor_excitation_are_said() -> None:
    verdict = judge(
        AXES,
        evidence_with(
            surroundings=Surroundings(saturated=np.array([0.0, 0.04])),
            estimate=an_estimate(condition=450.0),
        ),
    )
    assert any("two in 4.0% of its samples" in doubt for doubt in verdict.warnings)
    assert any("excites the parameters poorly" in doubt for doubt in verdict.warnings)


def test_what_is_only_doubtful_does_not_turn_the_verdict_but_is_said() -> None:
    verdict = judge(
        AXES,
        evidence_with(
            training=an_error(0.01),
            implausible=Implausible((), ("I2m is negative",)),
            friction_change=np.array([0.0, -0.05]),
        ),
    )
    assert verdict.good
    assert "I2m is negative" in verdict.warnings
    assert any("of one 5.0 times" in doubt for doubt in verdict.warnings)
    assert any("friction of two was 5% lower" in doubt for doubt in verdict.warnings)


def slowly_off(*shares: float) -> dict[str, object]:
    """Evidence of repetitions without noise and of slow errors as shares of the torque."""
    nothing = Repeatability(np.zeros(2), np.zeros(2), 2)
    return {
        "held_out_slow": an_error(np.array(shares)),
        "slow": nothing,
        "estimation_noise": np.zeros(2),
    }


def test_payloads_are_asked_for_only_where_gravity_loads_the_axis() -> None:
    verdict = judge(AXES, evidence_with(**slowly_off(0.025, 0.025), loaded=np.array([False, True])))
    (step,) = (step for step in verdict.next_steps if "torque constant" in step)
    assert "of two with a known payload" in step and "of one with the drive's data sheet" in step


def test_what_sound_models_reach_is_no_warning() -> None:
    verdict = judge(AXES, evidence_with(**slowly_off(0.019, 0.0)))
    assert not any("noise does not explain" in doubt for doubt in verdict.warnings)
    assert "beyond what noise explains 1.9% at worst" in verdict.line
    verdict = judge(AXES, evidence_with(**slowly_off(0.0, 0.0)))
    assert "beyond" not in verdict.line


def test_a_delay_that_stands_comes_before_torque_constants() -> None:
    late = DelayEstimate(
        joint_names=AXES,
        common=0.003,
        common_std=1e-4,
        deviations=np.zeros(2),
        deviation_std=np.zeros(2),
        assumed=0.0,
        cycle=0.001,
        interval_factor=2.0,
        reason=None,
        significant=True,
    )
    verdict = judge(
        AXES, evidence_with(**slowly_off(0.1, 0.1), surroundings=Surroundings(delays=late))
    )
    assert not verdict.good
    assert "--delay auto" in verdict.next_steps[0]
    assert "torque constant of one, two" in verdict.next_steps[1]


def test_repetitions_are_not_compared_where_the_motion_determines_too_little() -> None:
    many = tuple(f"p{k}" for k in range(12))
    verdict = judge(
        AXES,
        evidence_with(estimate=an_estimate(undetermined=many), disagreement=np.array([0.8, 0.1])),
    )
    assert len(verdict.reasons) == 1
    assert verdict.reasons[0].endswith(", ".join(many))


def test_axes_with_the_same_step_share_one_line() -> None:
    verdict = judge(AXES, evidence_with(held_out=an_error(0.4), training=an_error(0.4)))
    steps = [step for step in verdict.next_steps if "sign, gear ratio" in step]
    assert len(steps) == 1 and "one, two" in steps[0]


def test_an_undetermined_direction_is_information() -> None:
    verdict = judge(AXES, evidence_with(causes=Causes((), None, undecided=(0,))))
    assert verdict.good and not any("direction" in doubt for doubt in verdict.warnings)
    (finding,) = (one for one in verdict.findings if one.level == "information")
    assert finding.words.startswith("the data do not determine the direction of one:")


def test_locking_is_explained() -> None:
    still = replace(an_error(0.05), rows=np.array([1000, 3]))
    verdict = judge(AXES, evidence_with(held_out=still))
    assert "locked under [robot]" in verdict.next_steps[0] and "--held" in verdict.next_steps[0]
