"""Simulated arm without code of the project: pinocchio, numpy and scipy only.

Only the NS 16's URDF is shared, so that errors of the project's model, smoothing or sampling are
not reproduced.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
import scipy
from numpy.typing import NDArray

Array = NDArray[np.float64]

ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True, eq=False)
class SimulatedArm:
    """A rigid arm of n joints with rotors and dry and viscous friction."""

    urdf: str
    model: pin.Model  # with rotor inertias as armature
    locked: dict[str, float]  # positions of joints of the URDF that do not belong to the arm
    speed: Array  # largest joint speeds (n,) [rad/s]
    centre: Array  # posture about which it moves (n,) [rad]
    room: Array  # largest excursion from there (n,) [rad]
    coulomb: Array  # (n,) [N·m]
    viscous: Array  # (n,) [N·m·s/rad]

    @property
    def joint_names(self):
        return tuple(self.model.names[1:])

    def torque(self, q, qd, qdd):
        """Joint torque (m, n) [N·m]."""
        data = self.model.createData()
        rigid = np.array([pin.rnea(self.model, data, *row) for row in zip(q, qd, qdd, strict=True)])
        return rigid + self.coulomb * np.tanh(qd / 1e-3) + self.viscous * qd


def ns16():
    """Return a COMAU NS 16, with more friction than inertia in the wrist."""
    urdf = (ROOT / "sim_fixtures" / "ns16" / "ns16.urdf").read_text(encoding="utf-8")
    model = pin.buildModelFromXML(urdf)
    model.armature = np.array([7.6, 24.6, 10.5, 0.25, 0.30, 0.12])
    return SimulatedArm(
        urdf=urdf,
        model=model,
        locked={},
        speed=np.array([2.7, 2.7, 2.9, 6.2, 6.1, 9.5]),
        centre=np.array([0.0, -1.2, 2.0, 0.0, 1.0, 0.0]),
        room=np.array([1.5, 0.7, 0.9, 2.0, 0.9, 2.5]),
        coulomb=np.array([68.0, 108.0, 50.0, 9.2, 8.9, 5.1]),
        viscous=np.array([41.0, 63.0, 39.0, 3.3, 16.4, 8.9]),
    )


def panda():
    """Return a Franka Emika Panda without fingers; skips without its description."""
    try:
        package = distribution("example-robot-data")
    except PackageNotFoundError:
        pytest.skip("the example-robot-data package is not installed")
    path = "cmeel.prefix/share/example-robot-data/robots/panda_description/urdf/panda.urdf"
    urdf = Path(str(package.locate_file(path))).read_text(encoding="utf-8")
    whole = pin.buildModelFromXML(urdf)
    fingers = ("panda_finger_joint1", "panda_finger_joint2")
    held = [whole.getJointId(name) for name in fingers]
    model = pin.buildReducedModel(whole, held, pin.neutral(whole))
    model.armature = np.array([0.6, 0.6, 0.5, 0.5, 0.2, 0.2, 0.2])
    return SimulatedArm(
        urdf=urdf,
        model=model,
        locked=dict.fromkeys(fingers, 0.0),
        speed=np.array([2.17, 2.17, 2.17, 2.17, 2.6, 2.6, 2.6]),
        centre=np.array([0.0, 0.0, 0.0, -1.6, 0.0, 1.8, 0.0]),
        room=np.array([1.5, 1.2, 1.5, 1.2, 1.5, 1.4, 1.5]),
        coulomb=np.array([0.8, 0.9, 0.7, 0.8, 0.6, 0.4, 0.5]),
        viscous=np.array([1.2, 1.4, 1.0, 1.1, 0.6, 0.5, 0.4]),
    )


@dataclass(frozen=True, eq=False)
class Sines:
    """Joint motion as sums of sines about a posture."""

    centre: Array
    size: Array  # (k, n)
    rate: Array  # (k, n), rad/s
    phase: Array  # (k, n)

    def __call__(self, time):
        """Position, velocity and acceleration (m, n)."""
        angle = self.rate * time[:, None, None] + self.phase
        wave = self.size * np.sin(angle)
        slope = (self.size * self.rate * np.cos(angle)).sum(axis=1)
        return self.centre + wave.sum(axis=1), slope, -(wave * self.rate**2).sum(axis=1)


def motion(arm, seed, pace):
    """Return five sines per joint, 0.1 to 1 Hz at pace 1, up to 60 % of the largest speeds."""
    rng = np.random.default_rng([seed, 1])
    shape = (5, len(arm.centre))
    rate = 2.0 * np.pi * rng.uniform(0.1, 1.0, shape)
    size = rng.standard_normal(shape) / rate
    found = Sines(arm.centre, size, rate, rng.uniform(0.0, 2.0 * np.pi, shape))
    q, qd, _ = found(np.arange(0.0, 60.0, 0.01))
    fastest = np.abs(qd).max(axis=0) / (0.6 * arm.speed)
    farthest = np.abs(q - arm.centre).max(axis=0) / arm.room
    return Sines(arm.centre, size / np.maximum(fastest, farthest), pace * rate, found.phase)


def record(arm, seed, *, delay, pace, noise, duration, level=0.014, rate=250.0):
    """Return time (m,), position and torque (m, n), the torque logged a delay [s] later.

    The noise of the torque has a standard deviation of `level` times that of the torque; it is
    white, or half of its power autoregressive with 50 ms. `duration` in s, `rate` in Hz.
    """
    moves = motion(arm, seed, pace)
    rng = np.random.default_rng([seed, 2])
    time = np.arange(round(duration * rate)) / rate
    torque = arm.torque(*moves(time - delay))
    draw = rng.standard_normal(torque.shape)
    if noise == "coloured":
        keep = np.exp(-1.0 / (0.05 * rate))
        slow = scipy.signal.lfilter(
            [np.sqrt(1.0 - keep**2)], [1.0, -keep], rng.standard_normal(torque.shape), axis=0
        )
        draw = np.sqrt(0.5) * (draw + slow)
    torque += level * torque.std(axis=0) * draw
    position = moves(time)[0] + 1e-5 * rng.standard_normal(torque.shape)
    return time, position, torque
