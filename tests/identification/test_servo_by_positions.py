"""Servo, friction and rotor inertias from commanded and measured positions of a simulated arm."""

from dataclasses import replace

import numpy as np
import pytest

from identification.export.exported_arm import ExportedArm
from identification.model.motion import Motion
from identification.rollout.servo_by_positions import NAMES, fit_servo
from identification.rollout.servo_by_torque import NoServoError
from identification.rollout.windows import Stretch, stretches_of
from tests.identification.servo_arm import DELAY, KP, TRUE, VISCOUS, an_arm, on_its_servo
from tests.identification.two_link import MODEL, as_samples

STEP = 0.005


def stretches(arm: ExportedArm, disturbance: float = 0.0, seed: int = 1) -> list[Stretch]:
    time, position, velocity, command = on_its_servo(arm, disturbance, seed)
    motion = Motion(time, position, velocity, np.gradient(velocity, time, axis=0))
    nothing = np.zeros_like(position)
    return stretches_of(as_samples(MODEL, motion, nothing), nothing, STEP, command)


@pytest.fixture(scope="module")
def disturbed() -> list[Stretch]:
    return stretches(an_arm(), disturbance=0.3)


def test_gains_rotors_and_dry_friction_are_determined() -> None:
    fit = fit_servo(an_arm(), stretches(an_arm()), STEP)
    assert fit.values[:, :4] == pytest.approx(TRUE[:, :4], rel=0.07)
    assert fit.determined[:, :4].all()
    assert fit.servo.delay == pytest.approx(DELAY, abs=2.0 * fit.delay_deviation)


def test_viscous_friction_resembles_a_later_command(disturbed: list[Stretch]) -> None:
    """kp times the interval of the delay is as large as the friction: its interval says so."""
    fit = fit_servo(an_arm(), disturbed, STEP)
    deviations = fit.deviations[:, NAMES.index("f1")]
    assert (deviations > VISCOUS).all()
    assert (deviations > 0.5 * KP * fit.delay_deviation).all()


def test_what_a_joint_does_not_have_is_not_determined() -> None:
    """An elbow without dry friction and without rotor."""
    arm = an_arm(rotors=(0.4, 0.0), dry=(3.0, 0.0))
    fit = fit_servo(arm, stretches(arm, disturbance=0.3), STEP)
    shoulder, elbow = (dict(zip(NAMES, row.tolist(), strict=True)) for row in fit.determined)
    assert elbow["kp"]
    assert not elbow["Im"]
    assert not elbow["f0"]
    assert shoulder["f0"]


@pytest.mark.long
def test_intervals_hold_the_servo() -> None:
    inside = []
    for seed in range(6):
        fit = fit_servo(an_arm(), stretches(an_arm(), disturbance=0.3, seed=seed), STEP)
        inside.append(np.abs(fit.values - TRUE) <= 2.0 * fit.deviations)
    assert np.mean(inside) >= 0.88


def test_positions_determine_ratios_to_the_masses_only(disturbed: list[Stretch]) -> None:
    """A third more mass in the description is a third more of everything else."""
    fit, heavier = (fit_servo(an_arm(factor=k), disturbed, STEP) for k in (1.0, 4.0 / 3.0))
    assert heavier.values == pytest.approx(4.0 / 3.0 * fit.values, rel=1e-4)
    assert heavier.servo.delay == pytest.approx(fit.servo.delay)


def test_a_joint_that_ignores_its_command_is_named(disturbed: list[Stretch]) -> None:
    parts = [
        replace(stretch, commanded=2.0 * stretch.motion.position - stretch.commanded)
        for stretch in disturbed
    ]
    with pytest.raises(NoServoError, match=r"gain of .* does not follow its commanded position"):
        fit_servo(an_arm(), parts, STEP)


def test_no_command_is_no_servo(disturbed: list[Stretch]) -> None:
    parts = [replace(stretch, commanded=None) for stretch in disturbed]
    with pytest.raises(NoServoError, match="no commanded positions"):
        fit_servo(an_arm(), parts, STEP)
