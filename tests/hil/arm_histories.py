"""Campaigns of one arm over months, made in memory: torques by pinocchio, estimates by ours."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from scipy.signal import lfilter

from hil.batch.estimates import BatchEstimate
from hil.cell import Cell
from identification.estimators.covariance import with_block_covariance
from identification.factor.estimate import estimate, joint_weights
from identification.factor.factor import Factor
from sim_fixtures.ns16 import CELL_PATH, urdf_text
from tests.identification.two_link import as_samples, sine_motion

Array = NDArray[np.float64]

FRICTION = np.array([[20, 25, 15, 5, 5, 3], [15, 20, 10, 3, 3, 2], [1, 1, 1, 0.3, 0.3, 0.2]])
"""f0, f1, f2 of six joints."""

ROTORS = 2.0
NOISE = 0.03
"""Size of the noise as a share of the joint's torque without load."""
CENTRE = np.array([0.02, 0.0, 0.08])
"""Centre of the load, in the frame of the last joint."""


@dataclass(frozen=True, eq=False)
class Condition:
    """What the arm is like in one campaign: friction, and a load [kg] on its last joint."""

    friction: Array = field(default_factory=lambda: FRICTION)
    load: float = 0.0


def steady(_, random):
    """Nothing but the weather: friction of each coefficient within 1 %."""
    return Condition(friction=FRICTION * (1.0 + 0.01 * random.standard_normal(FRICTION.shape)))


def history(life, count, seed):
    """`count` campaigns, one a fortnight, of two repetitions each, in the conditions of a life."""
    random = np.random.default_rng(seed)
    return [campaign(life(k, random), k, random) for k in range(count)]


@cache
def cell():
    return Cell.from_texts(CELL_PATH.read_text("utf-8"), urdf_text(), CELL_PATH)


def model():
    return cell().model


@cache
def motion():
    """Sixteen seconds of five sines per joint."""
    random = np.random.default_rng(3)
    ranges = ((0.1, 0.35), (0.5, 5), (0, 6))
    sines = [random.uniform(low, high, (5, 6)) for low, high in ranges]
    return sine_motion(np.arange(0.0, 16.0, 0.02), *sines)


def torque(condition):
    """Of `motion` under a condition (m, 6), by recursive Newton-Euler of pinocchio."""
    arm = pin.buildModelFromXML(cell().urdf)
    load = condition.load
    body = pin.Inertia(load, CENTRE, 0.01 * load * np.eye(3))
    arm.appendBodyToJoint(arm.njoints - 1, body, pin.SE3.Identity())
    data = arm.createData()
    moved = motion()
    qd, qdd = moved.velocity, moved.acceleration
    rigid = np.array([pin.rnea(arm, data, *state) for state in moved.states()])
    dry, viscous, third = condition.friction
    return rigid + ROTORS * qdd + np.sign(qd) * (dry + viscous * np.abs(qd) + third * qd**2)


@cache
def noise_size():
    return NOISE * np.sqrt(np.mean(torque(Condition()) ** 2, axis=0))


def campaign(condition, k, random):
    arm = model()
    clean = torque(condition)
    size = noise_size()
    factor = Factor.zero(arm)
    for _ in range(2):
        # Coloured: residuals of torque models remember some tenths of a second.
        noise = lfilter([0.6], [1.0, -0.8], random.standard_normal(clean.shape), axis=0)
        factor = factor + Factor.by_time(arm, as_samples(arm, motion(), clean + size * noise))
    weights = joint_weights(factor)
    return BatchEstimate(
        estimate=with_block_covariance(estimate(arm, factor, weights), factor, weights),
        level="campaign",
        arm="digest",
        campaign=f"line/c{k:02d}",
        when=f"2026-{1 + k // 2:02d}-{1 + 14 * (k % 2):02d}T08:00:00+00:00",
        repetitions=2,
        torque_rms=np.sqrt(factor.gram[:, -1, -1] / factor.samples),
        unseen_rms=np.full(6, np.nan),
        unseen_torque_rms=np.full(6, np.nan),
        settings="settings",
    )
