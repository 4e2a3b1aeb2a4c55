"""Thresholds of the residual for a monitor of contacts, from the error of the model itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from identification.arrays import Array
from identification.model.flange import flange_motion
from identification.model.robot import RobotModel
from identification.purposes.contact import residual_peaks, seen_force
from identification.purposes.quiet_torque import SlowResidual, once_in, once_in_interval
from identification.signals.block_mean import BLOCK_SECONDS

SHOWN_EXCEEDANCES: Final = 3.0
"""Times that unseen motion exceeds the threshold which it shows itself."""
FALSE_ALARM_PERIODS: Final = (60.0, 600.0, 3600.0)
"""Times for which a threshold is extrapolated [s]."""
_MAX_INTERVAL_RATIO: Final = 3.0  # upper over lower end of an extrapolated threshold, at most


@dataclass(frozen=True)
class ContactThreshold:
    """Torque that motion without contact exceeds once in a time, and what it lets be seen."""

    period: float  #: [s]
    shown: bool  #: by the unseen motion itself; else extrapolated from its largest residuals
    torque: tuple[float, ...]  #: of each joint (n,) [N·m or N]
    low: tuple[float, ...]  #: ends of its 95 % interval (n,)
    high: tuple[float, ...]
    #: force at the flange that exceeds the torque of a joint in 95 % of directions, in the middle
    #: of the joints' ranges [N]; infinite where no joint feels it
    force: float
    #: mass at the flange whose weight exceeds it there [kg]; infinite where gravity loads no joint
    mass: float


def contact_thresholds(
    model: RobotModel, residuals: Sequence[SlowResidual], middle: Array
) -> tuple[ContactThreshold, ...]:
    """Return the threshold that unseen motion shows, and the extrapolated ones.

    A longer time is left out where the residuals do not determine its threshold within a factor of
    three.

    Args:
        model: of an arm of n joints.
        residuals: of unseen motion without contact.
        middle: posture (n,) [rad or m] at which force and mass are stated.
    """
    if not residuals:
        return ()
    peaks = np.concatenate(residual_peaks(residuals))
    shown = len(peaks) * BLOCK_SECONDS / SHOWN_EXCEEDANCES
    found = []
    for period in (shown, *(longer for longer in FALSE_ALARM_PERIODS if longer > shown)):
        torque = once_in(period, peaks)
        if torque is None:
            break
        low, high = once_in_interval(period, peaks)
        if period > shown and not (high <= _MAX_INTERVAL_RATIO * low).all():
            break
        found.append(
            ContactThreshold(
                period=period,
                shown=period == shown,
                torque=tuple(torque.tolist()),
                low=tuple(low.tolist()),
                high=tuple(high.tolist()),
                force=seen_force(model, torque, middle[None]),
                mass=_seen_weight(model, torque, middle),
            )
        )
    return tuple(found)


def _seen_weight(model: RobotModel, torque: Array, posture: Array) -> float:
    """Return the mass [kg] at the flange whose weight exceeds the torque (n,) of some joint."""
    jacobian = flange_motion(model.chain, posture[None]).jacobian[0]
    known = np.where(torque > 0.0, torque, np.inf)
    share = float((np.abs(model.gravity @ jacobian) / known).max())
    return 1.0 / share if share > 0.0 else float("inf")
