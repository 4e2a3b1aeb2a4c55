"""A joint servo, identified from commanded and measured positions and the torque between them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

import numpy as np
import scipy

from identification.arrays import Array
from identification.errors import IdentificationError
from identification.rollout.windows import Stretch

CONSTANT_SECONDS: Final = 0.5
"""Time over which the sum of gravity, friction and integral action counts as constant [s]."""
MAX_SERVO_DELAY: Final = 0.04
"""Largest delay of the command that is tried [s]."""
_DELAY_STEP: Final = 1e-3  # s between delays that are compared


class NoServoError(IdentificationError):
    """The recordings do not show a servo."""


class UndeterminedGainError(NoServoError):
    """The gain of a joint is not determined."""


class PositionServo(NamedTuple):
    """Joint torque ``kp (q_c(t - delay) - q) + kd (v_c(t - delay) - v)`` plus a constant."""

    kp: Array  # (n,) [N·m/rad or N/m]
    kd: Array  # (n,) [N·m·s/rad or N·s/m]
    delay: float  # of the command [s]
    # what it adds to commands (n,) [rad or m]; None: the constant is the one that a window needs
    offset: Array | None = None
    lag: Array | float = 0.0  # of each joint in addition to the delay (n,) [s]

    @property
    def delays(self) -> Array | float:
        """Delay of the command of each joint (n,), or of all [s]."""
        return np.maximum(self.delay + self.lag, 0.0)


def lead_of(servo: PositionServo | None) -> float:
    """Return how long before a window the command of a servo must be known [s]."""
    return 0.0 if servo is None else max(float(np.max(servo.delays)), MAX_SERVO_DELAY)


def command_of(stretch: Stretch, delay: Array | float) -> tuple[Array, Array]:
    """Return the delayed command, and its rate half a step after each instant (g, n).

    Args:
        stretch: of a recording.
        delay: of the command of each joint (n,), or of all [s].

    Raises:
        NoServoError: the recording has no commanded positions.
    """
    if stretch.commanded is None:
        raise NoServoError("the recordings have no commanded positions")
    time = stretch.motion.time
    half = 0.5 * float(time[1] - time[0])
    delays = np.broadcast_to(delay, stretch.commanded.shape[1])
    position, later, earlier = (
        np.column_stack(
            [
                np.interp(time - late + shift, time, column)
                for late, column in zip(delays, stretch.commanded.T, strict=True)
            ]
        )
        for shift in (0.0, 2.0 * half, 0.0)
    )
    return position, (later - earlier) / (2.0 * half)


def identify_servo(
    stretches: Sequence[Stretch], step: float, joint_names: Sequence[str]
) -> PositionServo:
    """Return the servo of some stretches, by least squares for each delay; `step` is theirs [s].

    Raises:
        NoServoError: there are no commanded positions, or the torque does not follow the error.
    """
    delay = best_delay(lambda delay: _gains_at(stretches, delay, step)[0])
    _, servo = _gains_at(stretches, delay, step)
    if not (servo.kp > 0.0).all():
        joint = int(np.argmin(servo.kp))
        raise NoServoError(
            f"the torque of {joint_names[joint]} does not grow with its position error; state kp,"
            " kd and delay"
        )
    return servo


def best_delay(error: Callable[[float], float]) -> float:
    """Return the delay [s] of least error up to `MAX_SERVO_DELAY`."""
    delays = np.arange(0.0, MAX_SERVO_DELAY + 0.5 * _DELAY_STEP, _DELAY_STEP)
    coarse = delays[int(np.argmin([error(float(delay)) for delay in delays]))]
    ends = np.clip([coarse - _DELAY_STEP, coarse + _DELAY_STEP], 0.0, MAX_SERVO_DELAY)
    fine = scipy.optimize.minimize_scalar(
        error, bounds=ends, method="bounded", options={"xatol": 0.05 * _DELAY_STEP}
    )
    return float(fine.x)


def _gains_at(
    stretches: Sequence[Stretch], delay: float, step: float
) -> tuple[float, PositionServo]:
    """Return the share of the torque's variance that is left over, and the gains."""
    rows = round(CONSTANT_SECONDS / step)
    errors = []
    rates = []
    torques = []
    for stretch in stretches:
        position, _ = command_of(stretch, delay)
        rate = np.gradient(position, step, axis=0)
        # The same rows for every delay: those whose command is known.
        with_command = slice(round(MAX_SERVO_DELAY / step) + 1, -1)
        errors += without_means((position - stretch.motion.position)[with_command], rows)
        rates += without_means((rate - stretch.motion.velocity)[with_command], rows)
        torques += without_means(stretch.torque[with_command], rows)
    if not errors:
        raise NoServoError(f"no stretch lasts {CONSTANT_SECONDS:g} s")
    error, rate, torque = (np.concatenate(part) for part in (errors, rates, torques))
    n = error.shape[1]
    left = 0.0
    kp = np.zeros(n)
    kd = np.zeros(n)
    for joint in range(n):
        columns = np.column_stack([error[:, joint], rate[:, joint]])
        length = np.linalg.norm(columns, axis=0)
        length[length == 0.0] = 1.0
        gains = np.linalg.lstsq(columns / length, torque[:, joint], rcond=None)[0] / length
        kp[joint] = gains[0]
        kd[joint] = max(0.0, float(gains[1]))
        residual = torque[:, joint] - columns @ gains
        left += float(residual @ residual) / max(float(torque[:, joint] @ torque[:, joint]), 1e-300)
    return left, PositionServo(kp, kd, delay)


def without_means(values: Array, rows: int) -> list[Array]:
    """Return the blocks of some rows of values (g, n), each without its mean."""
    whole = len(values) // rows
    blocks = values[: whole * rows].reshape(whole, rows, -1)
    return list(blocks - blocks.mean(axis=1, keepdims=True))
