"""Campaigns of one arm over months, made in memory: torques by pinocchio, estimates by ours."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from scipy.signal import lfilter

from hil.batch.run import LevelEstimate
from hil.cell import Cell
from identification import Motion, RobotModel
from identification.estimators.covariance import with_block_covariance
from identification.factor.factor import Factor, estimate, joint_weights
from identification.signals.samples import Samples
from sim_fixtures.ns16 import CELL_PATH, urdf_text

Array = NDArray[np.float64]

FRICTION = np.array([[20, 25, 15, 5, 5, 3], [15, 20, 10, 3, 3, 2], [1, 1, 1, 0.3, 0.3, 0.2]])
"""f0, f1, f2 of six joints."""

ROTORS = 2.0
NOISE = 0.03
"""Size of the noise as a share of the joint's torque without load."""


@dataclass(frozen=True, eq=False)
class Load:
    """A body in the frame of the last joint."""

    mass: float = 0.0
    centre: tuple[float, float, float] = (0.02, 0.0, 0.08)


@dataclass(frozen=True, eq=False)
class Condition:
    """What the arm is like in one campaign."""

    friction: Array = field(default_factory=lambda: FRICTION)
    load: Load = Load()


Life = Callable[[int, np.random.Generator], Condition]


def steady(_: int, random: np.random.Generator) -> Condition:
    """Nothing but the weather: friction of each coefficient within 1 %."""
    return Condition(friction=FRICTION * (1.0 + 0.01 * random.standard_normal(FRICTION.shape)))


def history(life: Life, count: int, seed: int) -> list[LevelEstimate]:
    """`count` campaigns, one a fortnight, of two repetitions each."""
    random = np.random.default_rng(seed)
    return [campaign(life(k, random), k, random) for k in range(count)]


@cache
def cell() -> Cell:
    return Cell.from_texts(CELL_PATH.read_text("utf-8"), urdf_text(), CELL_PATH)


def model() -> RobotModel:
    return cell().model


@cache
def motion() -> Motion:
    """Sixteen seconds of five sines per joint."""
    time = np.arange(0.0, 16.0, 0.02)
    random = np.random.default_rng(3)
    size, pulse, phase = (
        random.uniform(low, high, (5, 6)) for low, high in ((0.1, 0.35), (0.5, 5), (0, 6))
    )
    angle = pulse * time[:, None, None] + phase
    return Motion(
        time,
        (size * np.sin(angle)).sum(axis=1),
        (size * pulse * np.cos(angle)).sum(axis=1),
        (-size * pulse**2 * np.sin(angle)).sum(axis=1),
    )


def torque(condition: Condition) -> Array:
    """Of `motion` under a condition (m, 6), by recursive Newton-Euler of pinocchio."""
    arm = pin.buildModelFromXML(cell().urdf)
    load = condition.load
    body = pin.Inertia(load.mass, np.array(load.centre), 0.01 * load.mass * np.eye(3))
    arm.appendBodyToJoint(arm.njoints - 1, body, pin.SE3.Identity())
    data = arm.createData()
    q, qd, qdd = motion()[1:4]
    rigid = np.array([pin.rnea(arm, data, *state) for state in zip(q, qd, qdd, strict=True)])
    dry, viscous, third = condition.friction
    return rigid + ROTORS * qdd + np.sign(qd) * (dry + viscous * np.abs(qd) + third * qd**2)


@cache
def noise_size() -> Array:
    return NOISE * np.sqrt(np.mean(torque(Condition()) ** 2, axis=0))


def campaign(condition: Condition, k: int, random: np.random.Generator) -> LevelEstimate:
    arm, moved = model(), motion()
    clean, size = torque(condition), noise_size()
    phase = Factor.zero(arm)
    for _ in range(2):
        # Coloured: residuals of torque models remember some tenths of a second.
        noise = lfilter([0.6], [1.0, -0.8], random.standard_normal(clean.shape), axis=0)
        samples = Samples(
            motion=moved,
            torque=clean + size * noise,
            usable=arm.moving(moved.velocity),
            segments=(slice(0, len(clean)),),
            origin=0.0,
            position_bandwidth=np.full(6, np.inf),
        )
        phase = phase + Factor.by_time(arm, samples)
    weights = joint_weights(phase)
    found = with_block_covariance(estimate(arm, phase, weights), phase, weights)
    unknown = np.full(6, np.nan)
    return LevelEstimate(
        level="campaign",
        arm="digest",
        campaign=f"line/c{k:02d}",
        archive="",
        sha256="",
        when=f"2026-{1 + k // 2:02d}-{1 + 14 * (k % 2):02d}T08:00:00+00:00",
        repetitions=2,
        names=found.names,
        units=found.units,
        values=found.values,
        std=found.std,
        covariance=found.covariance,
        interval_factor=found.interval_factor,
        samples=found.samples,
        noise_std=found.noise_std,
        torque_rms=np.sqrt(phase.gram[:, -1, -1] / phase.samples),
        unseen_rms=unknown,
        unseen_torque_rms=unknown,
        condition=found.condition,
        undetermined=found.undetermined,
        method=found.method,
        settings="settings",
    )
