"""A recording of the simulated NS 16, made by the smallest PC that can play targets to it."""

from __future__ import annotations

import tomllib
from math import radians
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.packets import CyclicPacket, Mode, echo, is_init, next_number
from identification.model.friction import FrictionLaw
from identification.model.robot import RobotModel
from identification.signals.recording import Recording
from sim_fixtures import ControllerSettings, PlantTruth, SimulatedController, SimulatedDrive, ns16

Array = NDArray[np.float64]
PERIOD = 0.001


def ns16_model() -> RobotModel:
    return RobotModel.from_urdf(ns16.urdf_text(), friction=FrictionLaw(third=None, standstill=0.1))


def smooth_motion(duration: float, speed: float = 1.0) -> tuple[Array, Array]:
    """Positions and velocities (m, 6), DH angles: sines in and out of rest."""
    t = np.arange(round(duration / PERIOD) + 1) * PERIOD
    window = np.clip(np.minimum(t, duration - t), 0.0, 1.0)
    soft = window**3 * (10.0 - 15.0 * window + 6.0 * window**2)
    slope = np.where(t < 1.0, 1.0, -1.0) * 30.0 * window**2 * (1.0 - window) ** 2
    slope[(t >= 1.0) & (t <= duration - 1.0)] = 0.0
    swing = np.radians([12.0, 8.0, 10.0, 22.0, 20.0, 25.0])
    rate = speed * np.array([4.1, 4.7, 5.5, 7.3, 8.1, 9.0])
    centre = np.radians([10.0, -100.0, 170.0, -30.0, 60.0, 20.0])
    angle = rate * t[:, None] + np.arange(6)
    wave = np.sin(angle) + 0.4 * np.sin(2.3 * angle)
    wave_slope = rate * (np.cos(angle) + 0.92 * np.cos(2.3 * angle))
    position = centre + swing * soft[:, None] * wave
    return position, swing * (soft[:, None] * wave_slope + slope[:, None] * wave)


def simulated_recording(
    duration: float, *, speed: float = 1.0, seed: int = 1
) -> tuple[Recording, float]:
    """Recording of a run on the simulated cell, and the delay of its currents [cycles]."""
    cell = tomllib.loads(ns16.CELL_PATH.read_text(encoding="utf-8"))
    drive, planted = _drive(cell["drive_train"]), cell["simulation"]
    truth = PlantTruth(*(planted[k] for k in ("rotor_inertia", "coulomb", "viscous", "third")))
    noise = {k: planted[k] for k in ("current_noise", "current_resolution")}
    position, velocity = smooth_motion(duration, speed)
    controller = SimulatedController(
        ns16.urdf_text(), drive, truth, ControllerSettings(**noise), seed=seed,
        initial_position=position[0],
    )  # fmt: skip
    targets = np.array([drive.motor_revolutions(q.tolist()) for q in position])
    deltas = _motor_speed(drive, velocity) * PERIOD
    axes = _play(controller, targets, deltas)
    motors, currents = axes["d"][:, :, 2].astype(float), axes["d"][:, :, 4].astype(float)
    turn = _turns(drive)
    rest = np.array(drive.motor_revolutions([0.0] * 6))
    recording = Recording(
        time=np.arange(len(motors)) * PERIOD,
        position=np.linalg.solve(turn, (motors - rest).T).T,
        joint_names=ns16_model().joint_names,
        torque=np.array([drive.joint_torques(i.tolist()) for i in currents]),
    )
    return recording, controller.current_delay_cycles


def _drive(table: dict[str, Any]) -> SimulatedDrive:
    same = ("gear_ratio", "calibration", "joint_sign", "torque_constant", "current_limit")
    return SimulatedDrive(
        **{k: table[k] for k in (*same, "following_error", "k54", "k64", "k65")},
        joint_offset=[radians(a) for a in table["joint_offset_deg"]],
        encoder_counts=table["encoder_counts_per_revolution"],
    )


def _turns(drive: SimulatedDrive) -> Array:
    """Motor revolutions per radian of joint angle, column by column."""
    rest = np.array(drive.motor_revolutions([0.0] * 6))
    return np.column_stack([drive.motor_revolutions(e) - rest for e in np.eye(6).tolist()])


def _motor_speed(drive: SimulatedDrive, velocity: Array) -> Array:
    return velocity @ _turns(drive).T


def _play(controller: SimulatedController, targets: Array, deltas: Array) -> NDArray[np.void]:
    axes, k, n = [], -50, targets.shape[1]
    while (packet := controller.next_packet()) is not None:
        if is_init(packet):
            controller.accept(echo(packet))
            continue
        received = CyclicPacket.decode(packet, n)
        reply = CyclicPacket.zeros(next_number(received.number), n)
        status = bytes(4)
        reply.axes["mode"] = received.axes["mode"]
        reply.axes["d"][:, 0] = received.axes["d"][:, 0]
        if (received.axes["mode"] == Mode.POSITION).all() and received.status[0] == 5:
            if 0 <= k < len(targets):
                reply.axes["d"][:, 0], reply.axes["d"][:, 1] = targets[k], deltas[k]
                axes.append(received.axes.copy())
            elif k == len(targets) + 50:
                status = bytes((1, 0, 0, 0))
                controller.finish()
            k += 1
        controller.accept(CyclicPacket(reply.number, status, bytes(4), reply.axes).encode())
    return np.array(axes)
