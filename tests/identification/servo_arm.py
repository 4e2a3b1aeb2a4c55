"""An arm on its servo, simulated."""

import numpy as np
import pytest
import scipy

from identification.export.exported_arm import ExportedArm
from identification.export.simulators import mjcf
from identification.model.joint_ranges import JointRanges
from identification.rollout.servo_by_torque import PositionServo
from tests.identification.two_link import MODEL, URDF, four_sines

mujoco = pytest.importorskip("mujoco", reason="the extra mujoco is not installed")
N = MODEL.n_joints
NO_LIMITS = JointRanges(*(np.full(N, limit) for limit in (-np.inf, np.inf, np.inf, np.inf)))
KP = np.array([2000.0, 500.0])
KD = np.array([60.0, 10.0])
DELAY = 0.012
ROTORS = np.array([0.4, 0.1])
DRY = np.array([3.0, 1.0])
VISCOUS = np.array([2.0, 0.5])
TRUE = np.column_stack([KP, KD, ROTORS, DRY, VISCOUS])


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
    delays = np.broadcast_to(servo.delays, N)
    late = [
        np.column_stack(
            [np.interp(time - delay, time, column)
             for delay, column in zip(delays, values.T, strict=True)]
        )
        for values in (command.position, command.velocity)
    ]  # fmt: skip
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
