"""Contact and payload: the smallest force and mass at the flange that residuals would show."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from identification.arrays import Array
from identification.model.flange import flange_motion, flange_name
from identification.model.known_payload import Load, Payload
from identification.model.robot import RobotModel
from identification.purposes.quiet_torque import (
    FALSE_ALARM_PERIOD,
    SlowResidual,
    once_in,
    whole_blocks,
)

FORCE_DIRECTIONS: Final = 100
COVERED_SHARE: Final = 0.95
"""Fraction of directions and postures in which the force is noticed."""
_SEED: Final = 20140902
_LEVER_ROUNDING: Final = 1e-9  # m, of a lever
_MIN_LEVERAGE: Final = 0.1  # of the median; below it a mass is indistinguishable from the residual


class ContactLevel(NamedTuple):
    """What motion without contact exceeds once in `FALSE_ALARM_PERIOD`, and the force that does."""

    torque: Array  # of each joint (n,) [N·m or N]
    force: float  # at the flange [N]; infinite where no joint feels it


def contact(
    model: RobotModel, residuals: Sequence[SlowResidual], postures: Array
) -> ContactLevel | None:
    """Return thresholds and force at postures (m, n); None of too little unseen motion."""
    peaks = residual_peaks(residuals)
    torque = once_in(FALSE_ALARM_PERIOD, np.concatenate(peaks)) if peaks else None
    if torque is None:
        return None
    return ContactLevel(torque, seen_force(model, torque, postures))


def residual_peaks(residuals: Sequence[SlowResidual]) -> list[Array]:
    """Return the largest residual in each whole block of time of each part (B, n)."""
    return [_summed(np.maximum, part, np.abs(part.torque)) for part in residuals]


def seen_force(model: RobotModel, torque: Array, postures: Array) -> float:
    """Return the force [N] at the flange that exceeds the torque (n,) of some joint.

    In `COVERED_SHARE` of directions and postures (m, n), at rest. A joint without residual did not
    move, and its threshold is not known.
    """
    known = np.where(torque > 0.0, torque, np.inf)
    if not np.isfinite(known).any():
        return float("inf")
    random = np.random.default_rng(_SEED)
    direction = random.normal(size=(FORCE_DIRECTIONS, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    jacobian = flange_motion(model.chain, postures).jacobian
    shares = np.abs(direction @ jacobian) / known
    largest = shares.max(axis=2).ravel()
    weakest = float(np.quantile(largest, 1.0 - COVERED_SHARE))
    return 1.0 / weakest if weakest > _LEVER_ROUNDING / float(torque.max()) else float("inf")


def seen_mass(model: RobotModel, residuals: Sequence[SlowResidual]) -> float | None:
    """Return the mass [kg] at the flange that is seen in half a second (`BLOCK_SECONDS`).

    The residual of each block is fitted by the torque of a kilogram at the flange, with all joints
    weighted by their residual; motion without another payload exceeds the mass once in
    `FALSE_ALARM_PERIOD`. None of too little unseen motion, or where gravity does not load a joint.
    """
    if not residuals:
        return None
    name = flange_name(model.chain)
    frame = name if name in model.chain.frames else None
    load = Load(model.chain, model.gravity, Payload(1.0, (0.0, 0.0, 0.0), frame=frame))
    every = np.concatenate([part.torque for part in residuals])
    variance = np.mean(every**2, axis=0)
    variance = np.where(variance > 0.0, variance, np.inf)  # a joint that did not move shows nothing
    sums = [_by_block(part, load.torque(part.motion), variance) for part in residuals]
    product, square = np.concatenate(sums).T
    median = float(np.median(square)) if len(square) else 0.0
    if median == 0.0:
        return None
    seen = square > _MIN_LEVERAGE * median
    limit = once_in(FALSE_ALARM_PERIOD, np.abs(product[seen] / square[seen]))
    return None if limit is None else float(limit)


def _summed(operation: np.ufunc, part: SlowResidual, rows: Array) -> Array:
    """Return rows (m, ...) of a part, reduced over each whole block of time (B, ...)."""
    edges, end = whole_blocks(part.motion.time)
    if not len(edges):
        return np.zeros((0, *rows.shape[1:]))
    return np.asarray(operation.reduceat(rows[:end], edges, axis=0))


def _by_block(part: SlowResidual, unit: Array, variance: Array) -> Array:
    """Return residual times torque of a kilogram (m, n), and its square, by block (B, 2)."""
    weighted = unit / variance
    products = [(part.torque * weighted).sum(axis=1), (unit * weighted).sum(axis=1)]
    return _summed(np.add, part, np.column_stack(products))
