"""Servo, friction and rotor inertias from commanded and measured positions of a simulated arm."""

from dataclasses import replace

import numpy as np
import pytest
import scipy

from identification.export.exported_arm import ExportedArm, Ranges
from identification.export.simulators import mjcf
from identification.model.motion import Motion
from identification.rollout.servo_by_positions import NAMES, fit_servo
from identification.rollout.servo_by_torque import NoServoError, PositionServo
from identification.rollout.windows import Stretch, stretches_of
from tests.identification.two_link import MODEL, URDF, as_samples, four_sines

mujoco = pytest.importorskip("mujoco", reason="the extra mujoco is not installed")

N = MODEL.n_joints
NO_LIMITS = Ranges(*(np.full(N, limit) for limit in (-np.inf, np.inf, np.inf, np.inf)))
KP = np.array([2000.0, 500.0])
KD = np.array([60.0, 10.0])
DELAY = 0.012
ROTORS = np.array([0.4, 0.1])
DRY = np.array([3.0, 1.0])
VISCOUS = np.array([2.0, 0.5])
TRUE = np.column_stack([KP, KD, ROTORS, DRY, VISCOUS])
STEP = 0.005


def an_arm(rotors=ROTORS, dry=DRY, factor: float = 1.0) -> ExportedArm:
    """The arm with its friction; `factor` is that of its masses."""
    standard = factor * MODEL.nominal
    standard[MODEL.layout.rotors] = rotors
    by_symbol = {"f0": dry, "f1": VISCOUS}
    friction = [by_symbol[t.symbol][t.owner] if t.symbol in by_symbol else 0.0
                for t in MODEL.friction.terms]  # fmt: skip
    values = np.concatenate([MODEL.base.grouping @ standard, friction])
    return ExportedArm(URDF, MODEL, standard, values, NO_LIMITS)


def on_its_servo(
    arm: ExportedArm,
    disturbance: float = 0.0,
    seed: int = 1,
    duration: float = 20.0,
    step: float = 0.001,
    servo: PositionServo | None = None,
):
    """Time, positions, velocities and command of an arm that MuJoCo moves, each `step` [s].

    A coloured disturbance [N·m] with a time constant of 20 ms acts beside the servo.
    """
    servo = servo or PositionServo(KP, KD, DELAY)
    model = mujoco.MjModel.from_xml_string(mjcf(arm, "arm", step=step))
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_LIMIT
    data = mujoco.MjData(model)
    order = [int(model.joint(name).dofadr[0]) for name in arm.model.joint_names]
    time = np.arange(0.0, duration, step)
    command = four_sines(time, 0.5)
    late = [
        np.column_stack([np.interp(time - servo.delay, time, column) for column in values.T])
        for values in (command.position, command.velocity)
    ]
    white = np.random.default_rng(seed).standard_normal(command.position.shape)
    coloured = scipy.signal.lfilter([1.0], [1.0, -np.exp(-step / 0.02)], white, axis=0)
    torque = disturbance * coloured / coloured.std(axis=0)
    data.qpos[order] = late[0][0]
    data.qvel[order] = late[1][0]
    position, velocity = np.empty((2, *command.position.shape))
    for k in range(len(time)):
        position[k] = data.qpos[order]
        velocity[k] = data.qvel[order]
        error = late[0][k] - position[k]
        slip = late[1][k] - velocity[k]
        data.qfrc_applied[order] = servo.kp * error + servo.kd * slip + torque[k]
        mujoco.mj_step(model, data)
    settled = slice(round(0.5 / step), None)
    return time[settled], position[settled], velocity[settled], command.position[settled]


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
