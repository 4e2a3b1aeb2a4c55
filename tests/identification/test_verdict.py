"""Verdicts on small campaigns of the NS 16 in which one sign is wrong on one side only."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from identification.estimation import Estimate
from identification.evidence import Evidence, gather
from identification.model import RobotModel
from identification.motion import Motion
from identification.plausibility import Implausible
from identification.preprocessing import Samples
from identification.repetitions import estimate_repetitions
from identification.validation import PredictionError
from identification.verdict import Thresholds, Verdict, judge
from sim_fixtures.ns16 import urdf_text

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
    angle = rate * time[:, None, None] + phase
    return Motion(
        time,
        centre + (amplitude * np.sin(angle)).sum(axis=1),
        (amplitude * rate * np.cos(angle)).sum(axis=1),
        (-amplitude * rate**2 * np.sin(angle)).sum(axis=1),
    )


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
    motion = Motion(motion.time, *(part @ seen for part in motion[1:]))
    return Samples(
        motion=motion,
        torque=(current * np.array(believed.constant)) @ believed.motor_from_joint,
        usable=model.moving(motion.velocity),
        segments=(slice(0, len(motion.time)),),
        origin=0.0,
        position_bandwidth=np.full(6, np.inf),
    )


def campaign(
    model: RobotModel,
    *,
    believed: Drive = Drive(),
    truth: Array | None = None,
    disturbance: Callable[[Motion, Array], Array] | None = None,
) -> tuple[Verdict, Evidence]:
    truth = parameters(model) if truth is None else truth

    def run(motion: Motion, seed: int) -> Samples:
        return executed(model, truth, motion, seed, believed=believed, disturbance=disturbance)

    training = [run(a_motion(17, duration=12.0), seed) for seed in range(2)]
    held_out = [run(a_motion(seed), 10 + seed) for seed in range(2)]
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
        assert evidence.gain_if_turned is not None
        assert evidence.gain_if_turned.argmin() in ((0, 3) if axis == 0 else (axis,))


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


def an_error(relative: Array | float, *, rows: int = 1000) -> PredictionError:
    """Prediction error of given relative size on torques of RMS 10 on each of two axes."""
    squared = rows * (10.0 * np.broadcast_to(relative, 2)) ** 2
    return PredictionError(
        rows=np.full(2, rows),
        absolute=np.sqrt(squared),
        signed=np.zeros(2),
        squared=squared,
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
        ({"training": an_error(0.05), "held_out": an_error(0.2)}, "grows 4.0 times"),
        ({"estimate": an_estimate(undetermined=("a",))}, "does not determine a"),
        ({"nominal": an_error(0.03)}, "nominal model predicts better"),
        ({"gain_if_turned": np.array([0.2, 5.0])}, "if one counts the other way round"),
        ({"gain_if_turned": np.array([0.21, 0.2])}, "if one or two counts the other way round"),
        ({"disagreement": np.array([0.2, 0.0])}, "repetitions disagree"),
        ({"implausible": Implausible(("m1 is negative",), ())}, "m1 is negative"),
    ],
)
def test_each_fault_turns_the_verdict_and_is_said(changes: dict[str, object], words: str) -> None:
    verdict = judge(AXES, evidence_with(**changes))
    assert not verdict.good
    assert any(words in reason for reason in verdict.reasons)
    assert verdict.reasons[0] in verdict.line


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
    assert verdict.doubts[0] == "I2m is negative"
    assert any("grows 5.0 times" in doubt for doubt in verdict.doubts)
    assert any("friction of two was 5% lower" in doubt for doubt in verdict.doubts)
