r"""Torque per current where no torque constant is known: from the masses of the description.

Motor m of a robot with motor angles M q obeys

.. math:: i_m = \kappa_m [M^{-T} \tau_{nom}]_m + J_m \ddot q_m + c_m \mathrm{sgn}\,\dot q_m
                + v_m \dot q_m + o_m, \qquad \kappa_m = 1 / K_m

with the nominal (CAD) torque of the links. It is linear, motor by motor; the weight of the links
is what fixes :math:`\kappa_m`. The gain is as right as the masses: every torque that is made with
it is in their units. A payload whose mass is known does better:
:mod:`identification.estimators.gains`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification.model.motion import Motion
from identification.model.robot import RobotModel
from identification.signals.masks import SHORTEST_STRETCH

Array = NDArray[np.float64]

WORST_RELATIVE_STD: Final = 0.1
_BLOCKS: Final = 20  # of time, left out one by one
_NO_LOAD: Final = 1e-9


@dataclass(frozen=True, eq=False)
class CurrentScale:
    """Torque per current of n motors, in units of the nominal masses.

    Attributes:
        values: (n,) [N·m/A or N/A, motor side], 1 where not determined.
        std: standard deviations given the masses, by leaving out blocks of time (n,); infinite
            where not determined.
        inertial: motors whose gain rests on inertia without a rotor's: weight does not load them
            enough (n,).
    """

    values: Array
    std: Array
    inertial: NDArray[np.bool_]

    @property
    def determined(self) -> NDArray[np.bool_]:
        """Which gains the data determine (n,)."""
        return np.isfinite(self.std)

    @property
    def turned(self) -> NDArray[np.bool_]:
        """Motors whose current has the opposite sign of the torque that the masses need (n,)."""
        return self.determined & (self.values < 0.0)


def scale_from_nominal(
    model: RobotModel,
    motions: Sequence[Motion],
    currents: Sequence[Array],
    motor_from_joint: Array | None = None,
) -> CurrentScale:
    """Gains of all motors from recordings of their currents.

    Args:
        model: with nominal inertias.
        motions: smoothed, of each recording.
        currents: in their rows (m, n) [A].
        motor_from_joint: motor angles per joint angle (n, n); identity: gains include the gears.
    """
    n = model.n_joints
    turns = np.eye(n) if motor_from_joint is None else np.asarray(motor_from_joint, np.float64)
    parts = [_columns(model, motion, turns) for motion in motions]
    columns = np.concatenate([part[0] for part in parts])  # (m, n, 5)
    moving = np.concatenate([part[1] for part in parts])
    current = np.concatenate(list(currents))
    values, std, inertial = np.ones(n), np.full(n, np.inf), np.zeros(n, dtype=np.bool_)
    for motor in range(n):
        rows = moving[:, motor]
        table, target = columns[rows, motor], current[rows, motor]
        for with_rotor in (True, False):
            used = table if with_rotor else np.delete(table, 1, axis=1)
            share, spread = _share(used, target)
            if spread <= WORST_RELATIVE_STD * abs(share):
                values[motor], std[motor] = 1.0 / share, spread / share**2
                inertial[motor] = not with_rotor
                break
    return CurrentScale(values, std, inertial)


def _columns(model: RobotModel, motion: Motion, turns: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Per motor [nominal torque, acceleration, sign, speed, 1] (m, n, 5), and rows that count."""
    values = np.zeros(model.n_parameters)
    values[: model.base.rank] = model.base.grouping @ model.nominal
    values[model.element_part] = model.elements.nominal
    torque = model.torque(values, *motion[1:]) + model.load_torque(*motion[1:4])
    speed, acceleration = motion.velocity @ turns.T, motion.acceleration @ turns.T
    motors = np.linalg.solve(turns.T, torque.T).T
    columns = np.stack([motors, acceleration, np.sign(speed), speed, np.ones_like(speed)], axis=2)
    moving = model.moving(motion.velocity)
    acting = turns != 0.0
    return columns, np.stack([moving[:, joints].all(axis=1) for joints in acting], axis=1)


def _share(table: Array, current: Array) -> tuple[float, float]:
    """Coefficient of the first column, and its standard deviation; (0, inf) without any."""
    if len(table) < _BLOCKS * SHORTEST_STRETCH:
        return 0.0, np.inf
    scale = np.sqrt(np.mean(table**2, axis=0))
    if scale[0] <= _NO_LOAD:
        return 0.0, np.inf
    table = table[:, scale > 0.0] / scale[scale > 0.0]
    blocks = np.array_split(np.arange(len(table)), _BLOCKS)
    grams = np.array([table[b].T @ table[b] for b in blocks])
    scores = np.array([table[b].T @ current[b] for b in blocks])
    total, right = grams.sum(axis=0), scores.sum(axis=0)
    if np.linalg.cond(total) > 1e10:
        return 0.0, np.inf
    best = float(np.linalg.solve(total, right)[0])
    without = [
        float(np.linalg.lstsq(total - gram, right - score, rcond=None)[0][0])
        for gram, score in zip(grams, scores, strict=True)
    ]
    # Jackknife over blocks: allows for noise that lasts.
    spread = np.sqrt((_BLOCKS - 1.0) / _BLOCKS * np.sum((np.array(without) - best) ** 2))
    return best / float(scale[0]), float(spread) / float(scale[0])
