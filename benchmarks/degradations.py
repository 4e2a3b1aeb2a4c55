"""What goes wrong between an arm and its log: copies of a log with one fault each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from benchmarks.joint_log import JointLog
from benchmarks.plain_fit import filtered_motion, low_passed

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Expectation:
    """What a verdict has to say of a fault.

    Attributes:
        checks: names of findings; any of them is right.
        silence: whether it is as right to say nothing where the held-out error is not raised, or
            where what the fitted motion leaves open decides it: parameters of the Gen3, 4.7 s in
            which one joint moves in one direction only, that were fitted at 1 kHz and at 94 Hz fit
            the recording alike, and predict the other motion apart. The verdict says by how much.
    """

    checks: frozenset[str]
    silence: bool = False


def _named(*checks: str, silence: bool = False) -> Expectation:
    return Expectation(frozenset(checks), silence)


EXPECTED: Final = {
    "jittered stamps": _named("clock"),
    "lost rows": _named("clock", silence=True),
    "94 Hz": _named("sampling rate", silence=True),
    "12 bits": _named("resolution", silence=True),
    "delayed torque": _named("delay"),
    "filtered torque": _named("torque bandwidth"),
    "exchanged joints": _named("order of joints"),
    "turned sign": _named("direction of axes"),
    "payload in half": _named("sameness", "load"),
    "filtered positions": _named("position bandwidth", silence=True),
}
CAUSES: Final = frozenset[str]().union(
    {
        "position jumps",
        "outliers",
        "gravity",
        "friction",
        "friction over load",
        "scale of the torque",
        "torque constant",
    },
    *(expectation.checks for expectation in EXPECTED.values()),
)
"""Findings that blame something; all others say how large an error is, or where."""
HARMLESS: Final = 1.05
"""Ratio of held-out errors up to which a fault has not raised them."""

JITTER: Final = 0.15  # of a step, standard deviation
LOST: Final = 0.02  # of all rows
SLOW_RATE: Final = 94.0  # Hz
BITS: Final = 12
DELAY: Final = 0.010  # s
TORQUE_BANDWIDTH: Final = 5.0  # Hz
POSITION_BANDWIDTH: Final = 20.0  # Hz
PAYLOAD_SHARE: Final = 0.1  # of the rated payload
EXCHANGED: Final = (1, 2)  # joints, from 0
TURNED: Final = 2  # joint, from 0
_PAYLOAD_OFFSET: Final = np.array([0.0, 0.0, 0.1])  # m, centre of mass in the last joint's frame
_PAYLOAD_RADIUS: Final = 0.05  # m
_MOTION_BANDWIDTH: Final = 10.0  # Hz, of the motion from which the payload's torque is computed


def jittered_stamps(log: JointLog) -> JointLog:
    """Stamps that are early or late at random, never in another order."""
    half = np.sqrt(3.0) * JITTER * _step(log)
    late = np.random.default_rng(1).uniform(-half, half, log.n_rows)
    return replace(log, time=log.time + late)


def lost_rows(log: JointLog) -> JointLog:
    """Single rows missing at random; the stamps of the others are right."""
    return log.rows(np.random.default_rng(2).random(log.n_rows) >= LOST)


def resampled(log: JointLog) -> JointLog:
    """Logged at a lower rate, without a filter against aliases."""
    step = max(1.0 / SLOW_RATE, _step(log))
    time = np.arange(log.time[0], log.time[-1], step)
    return replace(
        log,
        time=time,
        position=_at(time, log.time, log.position),
        velocity=None if log.velocity is None else _at(time, log.time, log.velocity),
        torque=_at(time, log.time, log.torque),
    )


def quantised_positions(log: JointLog) -> JointLog:
    """Positions in steps of their range over 2 to the number of bits."""
    step = np.ptp(log.position, axis=0) / 2**BITS
    step[step == 0.0] = 1.0
    return replace(log, position=np.rint(log.position / step) * step)


def delayed_torque(log: JointLog) -> JointLog:
    """Torque that is logged late."""
    return replace(log, torque=_at(log.time - DELAY, log.time, log.torque))


def filtered_torque(log: JointLog) -> JointLog:
    """Torque through a low-pass without phase."""
    return replace(log, torque=_low_passed(log, log.torque, TORQUE_BANDWIDTH))


def filtered_positions(log: JointLog) -> JointLog:
    """Positions through a low-pass without phase; measured velocities are as they were."""
    return replace(log, position=_low_passed(log, log.position, POSITION_BANDWIDTH))


def exchanged_joints(log: JointLog) -> JointLog:
    """The torques of two neighbouring joints in each other's column."""
    order = np.arange(log.torque.shape[1])
    order[list(EXCHANGED)] = EXCHANGED[::-1]
    return replace(log, torque=log.torque[:, order])


def turned_sign(log: JointLog) -> JointLog:
    """The torque of one joint with the other sign."""
    torque = log.torque.copy()
    torque[:, TURNED] *= -1.0
    return replace(log, torque=torque)


def payload_in_second_half(log: JointLog) -> JointLog:
    """A sphere on the flange during the second half, not stated in the cell."""
    bare = log.pinocchio_model()
    loaded = log.pinocchio_model()
    body = pin.Inertia.FromSphere(PAYLOAD_SHARE * log.rated_payload, _PAYLOAD_RADIUS)
    loaded.inertias[loaded.njoints - 1] += body.se3Action(pin.SE3(np.eye(3), _PAYLOAD_OFFSET))
    motion = filtered_motion(log.measured, _MOTION_BANDWIDTH)
    torque = log.torque.copy()
    neutral = pin.neutral(bare)
    data = bare.createData(), loaded.createData()
    for row in range(log.n_rows // 2, log.n_rows):
        state = pin.integrate(bare, neutral, motion[0][row]), motion[1][row], motion[2][row]
        torque[row] += pin.rnea(loaded, data[1], *state) - pin.rnea(bare, data[0], *state)
    return replace(log, torque=torque)


def _step(log: JointLog) -> float:
    return float(np.median(np.diff(log.time)))


def _at(time: Array, stamps: Array, values: Array) -> Array:
    """Values (m, n) at other times, straight lines between rows."""
    return np.column_stack([np.interp(time, stamps, column) for column in values.T])


def _low_passed(log: JointLog, values: Array, bandwidth: float) -> Array:
    """The values (m, n) as they are where the log is too slow to hold more than the bandwidth."""
    if bandwidth >= 0.5 / _step(log):
        return values
    return low_passed(log.time, values, bandwidth)


DEGRADATIONS: Final[dict[str, Callable[[JointLog], JointLog]]] = {
    "jittered stamps": jittered_stamps,
    "lost rows": lost_rows,
    "94 Hz": resampled,
    "12 bits": quantised_positions,
    "delayed torque": delayed_torque,
    "filtered torque": filtered_torque,
    "exchanged joints": exchanged_joints,
    "turned sign": turned_sign,
    "payload in half": payload_in_second_half,
    "filtered positions": filtered_positions,
}
"""Each fault by the name that `EXPECTED` has it under."""
FITTED_ONLY: Final = {"payload in half"}
"""Faults of the motion and not of the logger: what is predicted has none of them."""
