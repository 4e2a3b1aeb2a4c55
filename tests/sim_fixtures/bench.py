"""A cell, a smooth motion and the smallest PC that can play it, shared by the tests of the cell."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from math import pi, radians
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.c4g_packets import CyclicPacket, Mode, echo, is_init, next_number
from sim_fixtures import (
    ControllerSettings,
    PlantTruth,
    SimulatedController,
    SimulatedDrive,
    UnmodelledEffects,
    ns16,
)

Array = NDArray[np.float64]
PERIOD = 0.001


CELL: dict[str, Any] = tomllib.loads(ns16.CELL_PATH.read_text("utf-8"))


def make_drive(**changes: Any) -> SimulatedDrive:
    """The drive of the cell file, with these figures changed."""
    table = CELL["drive_train"]
    same = ("gear_ratio", "calibration", "joint_sign", "torque_constant", "current_limit")
    figures = {name: table[name] for name in (*same, "following_error", "k54", "k64", "k65")}
    figures["joint_offset"] = [radians(a) for a in table["joint_offset_deg"]]
    figures["encoder_counts"] = table["encoder_counts_per_revolution"]
    return SimulatedDrive(**(figures | changes))


def motor_matrix(drive: SimulatedDrive) -> Array:
    """Motor revolutions per radian of *controller* angle as a matrix, written from the formulas."""
    rows = np.eye(6)
    rows[4, 3] = -drive.k54
    rows[5, 3] = drive.k65 * drive.k54 - drive.k64
    rows[5, 4] = -drive.k65
    return np.diag(drive.gear_ratio) @ rows / (2.0 * pi)


DRIVE = make_drive()
_PLANTED = [CELL["simulation"][name] for name in ("rotor_inertia", "coulomb", "viscous", "third")]
TRUTH = PlantTruth(*map(np.array, _PLANTED))


def frictionless(rotor_inertia: Any) -> PlantTruth:
    rotors = np.array(rotor_inertia)
    return PlantTruth(rotors, *[np.zeros_like(rotors)] * 3)


FRICTIONLESS = frictionless(TRUTH.rotor_inertia)


def _smooth_motion() -> tuple[Array, Array]:
    """Three seconds within the NS 16's limits at up to about a third of its speeds."""
    duration = 3.0
    n = int(3.0 / PERIOD)
    s = np.arange(n + 1) * PERIOD / duration
    window = 30 * s**2 * (1 - s) ** 2 / duration  # dx/dt of the quintic from 0 to 1
    phase = 10 * s**3 - 15 * s**4 + 6 * s**5
    centre = np.radians([10.0, -100.0, 170.0, -30.0, 60.0, 20.0])
    swing = np.radians([40.0, 25.0, 30.0, 70.0, 40.0, 90.0])
    turns = np.array([2, 2, 2, 2, 3, 2]) * pi
    angle = phase[:, None] * turns
    return centre + swing * np.sin(angle), swing * turns * np.cos(angle) * window[:, None]


SMOOTH_Q, SMOOTH_QD = _smooth_motion()
"""Sinusoids with a soft start and end, all axes at once, DH angles: rad and rad/s, (m, 6)."""


@dataclass
class Log:
    """What a run left behind; index k of each array is the packet in which target k was sent."""

    axes: NDArray[np.void]
    q: Array
    qd: Array
    raw: list[bytes] = field(default_factory=list)


class MinimalPC:
    """Answers packets: echoes until every axis is open, then plays targets, then leaves."""

    def __init__(self, controller: SimulatedController, targets: Array, deltas: Array) -> None:
        self.controller = controller
        self.targets = targets
        self.deltas = deltas

    def run(self, settle: int = 100) -> Log:
        controller = self.controller
        n = self.targets.shape[1]
        axes = []
        q = []
        qd = []
        raw = []
        k = -settle
        while (packet := controller.next_packet()) is not None:
            raw.append(packet)
            if is_init(packet) or len(packet) == 732:
                controller.accept(echo(packet))
                continue
            received = CyclicPacket.decode(packet, n)
            reply = CyclicPacket.zeros(next_number(received.number), n)
            status = bytes(4)
            reply.axes["mode"] = received.axes["mode"]
            reply.axes["d"][:, 0] = received.axes["d"][:, 0]
            if (received.axes["mode"] == Mode.POSITION).all() and received.status[0] == 5:
                if 0 <= k < len(self.targets):
                    reply.axes["d"][:, 0] = self.targets[k]
                    reply.axes["d"][:, 1] = self.deltas[k]
                    axes.append(received.axes.copy())
                    q.append(controller.plant.position.copy())
                    qd.append(controller.plant.velocity.copy())
                elif k == len(self.targets) + settle:
                    status = bytes((1, 0, 0, 0))
                    controller.finish()
                k += 1
            controller.accept(CyclicPacket(reply.number, status, bytes(4), reply.axes).encode())
        return Log(np.array(axes), np.array(q), np.array(qd), raw)


def play(
    drive: SimulatedDrive,
    settings: ControllerSettings,
    *,
    seed: int = 7,
    effects: UnmodelledEffects | None = None,
) -> tuple[SimulatedController, Log]:
    """Play the smooth motion on a fresh NS 16; the controller and the log."""
    controller = SimulatedController(
        ns16.urdf_text(),
        drive,
        TRUTH,
        settings,
        seed=seed,
        effects=effects or UnmodelledEffects(),
        initial_position=SMOOTH_Q[0],
    )
    turn = motor_matrix(drive)
    angles = SMOOTH_Q * drive.joint_sign + drive.joint_offset
    targets = angles @ turn.T + drive.calibration
    deltas = (SMOOTH_QD * drive.joint_sign) @ turn.T * PERIOD
    return controller, MinimalPC(controller, targets, deltas).run()


def standard_parameters() -> dict[str, float]:
    """Return every standard parameter by name: m1, mc1x, ..., I1xx, ..., I6zz, then I1m ... I6m."""
    truth = ns16.load_truth()
    named: dict[str, float] = {}
    for i, link in enumerate(truth.links, start=1):
        named[f"m{i}"] = link.mass
        named |= {f"mc{i}{a}": v for a, v in zip("xyz", link.first_moment, strict=True)}
        named |= {f"I{i}{k}": v for k, v in zip(ns16.TENSOR_KEYS, link.tensor, strict=True)}
    named |= {f"I{i}m": value for i, value in enumerate(truth.rotor_inertia, start=1)}
    return named


def base_from_standard(standard: Mapping[str, float]) -> Array:
    """Return the 40 essential parameters of Table 2 (rows 1 ... 40) from standard parameters."""
    rows = ns16.TABLE2[: ns16.N_ESSENTIAL]
    return np.array([sum(f * standard[name] for name, f in row.terms.items()) for row in rows])
