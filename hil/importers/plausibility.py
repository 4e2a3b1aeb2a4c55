"""Plausibility of an imported recording: units, signs and order of the joints.

Where another order fits better, its error is given with that of the map.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np
import scipy
from numpy.typing import NDArray

from hil.archive import ImportedSamples
from hil.base.arrays import Array
from hil.base.errors import SourceError
from hil.importers.conclusions import (
    Conclusion,
    ConstantPositions,
    ConstantTorque,
    Examined,
    FastJoint,
    JointRange,
    LargeTorque,
    LittleMotion,
    LockedJoints,
    NoTorque,
    OutsideLimits,
    RecordedClock,
    SameStamp,
    ScaledVelocity,
    StoppedJoint,
    TooFewSamples,
    TorqueSize,
    UnrelatedVelocity,
    UnusualRate,
    VelocityOrder,
    Within,
    ZeroTorque,
)
from hil.importers.messages import problem_of, remedy_of
from hil.importers.publishers import MIN_SAMPLE_DISTANCE, alternating_samples
from hil.importers.stamps import MAX_SAMPLING_RATE, MIN_SAMPLING_RATE
from identification.model.joint_ranges import JointRanges, urdf_limits
from identification.model.motion import Motion
from identification.model.urdf_text import position_units
from identification.signals.angle_wraps import (
    unwrap,
)
from identification.signals.recording import (
    MIN_MOVEMENT,
)
from identification.signals.sample_times import time_base

_LIMIT_TOLERANCE: Final = 0.05  # rad or m beyond a limit, for calibration and overshoot
_MIN_TRAVEL: Final = 0.1  # rad or m
_SCALE_TOLERANCE: Final = 0.1  # of velocity over slope of the position, for filters
MIN_CORRELATION: Final = 0.7
"""Correlation of a velocity with the slope of its position."""
MAX_LIMIT_RATIO: Final = 3.0
"""Times the URDF's limit of speed or torque; right logs of arms reach 1.7 of a stated torque."""
_OTHER_UNIT_RATIO: Final = 30.0  # between the errors of a nominal torque and a factor of 1000
_THOUSAND: Final = 1000.0
_BLOCK_SECONDS: Final = 0.05  # s, over which signals are averaged before they are differentiated
_MAX_BLOCKS: Final = 2000
_MIN_FINAL_REST_SHARE: Final = 0.1  # of the samples, at the end: a joint that stands for good
_MIN_BLOCKS: Final = 8  # in which a speed shows
_MIN_TORQUE_SHARE: Final = 0.01  # of the largest nominal torque

NominalTorque = Callable[[Motion], Array]
"""Torque (m, n) of the nominal inertias along a motion."""


def examine(
    samples: ImportedSamples,
    joint_names: Sequence[str],
    urdf: str,
    *,
    locked: Mapping[str, float] | None = None,
    nominal: NominalTorque | None = None,
    held_joints: Collection[str] = (),
) -> Examined:
    """Return the findings on samples of the joint side, in SI units.

    Args:
        samples: of a recording.
        joint_names: of its joints.
        urdf: text of the description.
        locked: positions [rad or m] of joints that are not in the model, by name.
        nominal: torque of the nominal inertias; None if the URDF has none.
        held_joints: that were clamped.
    """
    time = np.asarray((samples.stamp - samples.stamp[0]) * 1e-9)
    limits = urdf_limits(urdf, joint_names)
    units = np.array([*position_units(urdf, joint_names).values()])
    turning = units == "rad"
    position = in_turns(samples.position, limits, turning)
    held = (LockedJoints(locked, position_units(urdf, locked)),) if locked else ()
    if len(time) < 2:
        return Examined((TooFewSamples(len(time)), *held), ())
    base = time_base(time)
    ranges = map(_range, joint_names, position.T, turning, limits.lower, limits.upper)
    warnings: list[Conclusion] = []
    if not MIN_SAMPLING_RATE <= base.rate <= MAX_SAMPLING_RATE:
        warnings += [UnusualRate(base.rate)]
    several = _of_one_stamp(time, position, units) or alternating_samples(position, units)
    warnings += [several] if several else []
    warnings += _positions(time, position, joint_names, limits, turning, has_speed=not several)
    is_plausible = not warnings  # torques are compared only if the motion is plausible
    if samples.velocity is not None and not several:
        warnings += _velocities(time, position, samples.velocity, joint_names)
    warnings += _torques(samples, joint_names, turning, limits.effort)
    if is_plausible:
        warnings += _torque_size(samples, joint_names, limits.effort, nominal)
    warnings += _constant(position, joint_names, held_joints)
    warnings += _stopped(time, position, samples.commanded_position, joint_names, units)
    return Examined((RecordedClock(base), *held, *ranges), tuple(warnings))


def _constant(position: Array, names: Sequence[str], held: Collection[str]) -> Iterator[Conclusion]:
    """Yield a warning if joints have one reading throughout while others move."""
    ranges = np.ptp(position, axis=0)
    if np.all(ranges <= MIN_MOVEMENT):
        return
    constant = [name for name, size in zip(names, ranges, strict=True) if size == 0.0]
    constant = [name for name in constant if name not in held]
    if constant:
        yield ConstantPositions(tuple(constant), len(position))


def _stopped(
    time: Array,
    position: Array,
    commanded: Array | None,
    names: Sequence[str],
    units: NDArray[np.str_],
) -> Iterator[Conclusion]:
    """Yield a warning for each joint that moved, and at the end rests against its command."""
    if commanded is None:
        return
    for name, places, commands, unit in zip(names, position.T, commanded.T, units, strict=True):
        changes = np.flatnonzero(np.diff(places))
        first = int(changes[-1]) + 1 if len(changes) else len(places)
        if len(places) - first < _MIN_FINAL_REST_SHARE * len(places):
            continue
        known = commands[first:][np.isfinite(commands[first:])]
        travel = float(np.ptp(known)) if len(known) else 0.0
        if travel > MIN_MOVEMENT:
            yield StoppedJoint(name, float(time[first]), travel, str(unit))


def _turning(urdf: str, names: Sequence[str]) -> NDArray[np.bool_]:
    return np.array([unit == "rad" for unit in position_units(urdf, names).values()])


def _range(name: str, position: Array, turns: bool, lower: float, upper: float) -> JointRange:
    limits = (float(lower), float(upper)) if np.isfinite(lower) else None
    low = float(position.min())
    high = float(position.max())
    return JointRange(name, low, high, turns=bool(turns), limits=limits)


def _fits(position: Array, limits: JointRanges) -> NDArray[np.bool_]:
    """Return whether each column of positions fits the limits of each joint (joints, columns)."""
    above = limits.lower[:, None] - _LIMIT_TOLERANCE <= position.min(axis=0)
    return np.asarray(above & (position.max(axis=0) <= limits.upper[:, None] + _LIMIT_TOLERANCE))


def limit_excess(low: Array, high: Array, limits: JointRanges) -> Array:
    """Return how far ranges of positions leave the limits of each joint, negative within them."""
    return np.maximum(limits.lower - low, high - limits.upper)


def whole_turns(
    low: Array, high: Array, limits: JointRanges, turning: NDArray[np.bool_], most: int
) -> Array:
    """Return the whole turns [rad] that bring ranges nearest to the limits (n,).

    Args:
        low: lower ends of the ranges (n,) [rad or m].
        high: upper ends.
        limits: of the joints.
        turning: joints that turn (n,).
        most: largest number of turns; fewer where they bring a range as near.
    """
    counts = np.array(sorted(range(-most, most + 1), key=abs))
    turns = 2.0 * np.pi * counts[:, None] * turning
    excess = limit_excess(low + turns, high + turns, limits)
    nearest = np.maximum(excess - _LIMIT_TOLERANCE, 0.0).argmin(axis=0)
    return np.asarray(turns[nearest, np.arange(len(low))])


def in_turns(position: Array, limits: JointRanges, turning: NDArray[np.bool_]) -> Array:
    """Return positions (m, n) without wraps, a joint within its limits but for a turn within them.

    Angles of 0 to 360 degrees and of +-180 are two conventions of one posture; others keep their
    turn, and so does a joint that none brings within its limits.
    """
    low = position.min(axis=0) + _LIMIT_TOLERANCE
    high = position.max(axis=0) - _LIMIT_TOLERANCE
    usual = ((low > 0.0) & (high < 2.0 * np.pi)) | ((low > -np.pi) & (high < np.pi))
    continued, turns = _continued(position, limits, turning)
    nearest = continued + turns
    fits = limit_excess(nearest.min(axis=0), nearest.max(axis=0), limits) <= _LIMIT_TOLERANCE
    return np.where(fits & usual, nearest, continued)


def _continued(
    position: Array, limits: JointRanges, turning: NDArray[np.bool_]
) -> tuple[Array, Array]:
    """Return positions (m, n) without wraps, and the turn (n,) that brings each to its limits."""
    continued = position.copy()
    continued[:, turning] = unwrap(position[:, turning])
    low, high = continued.min(axis=0), continued.max(axis=0)
    return continued, whole_turns(low, high, limits, turning, 1)


def _outside(
    position: Array, names: Sequence[str], limits: JointRanges, turning: NDArray[np.bool_]
) -> OutsideLimits | None:
    """Return how positions leave the limits of the URDF, and how they would not."""
    recorded = position
    position = in_turns(recorded, limits, turning)
    fits = _fits(position, limits)
    joints = range(len(names))
    beyond = [joint for joint in joints if not fits[joint, joint]]
    if not beyond:
        return None
    low = position.min(axis=0)
    high = position.max(axis=0)
    ranges = {names[j]: (float(low[j]), float(high[j])) for j in beyond}
    outside = (position < limits.lower - _LIMIT_TOLERANCE) | (
        position > limits.upper + _LIMIT_TOLERANCE
    )
    fraction = float(outside.any(axis=1).mean())
    farthest = 3.0 * np.maximum(-limits.lower, limits.upper)
    far = (np.maximum(-low, high) > farthest)[beyond].any()
    columns = scipy.optimize.linear_sum_assignment(~fits + 1e-6 * (1.0 - np.eye(len(names))))[1]
    if far:
        radians = in_turns(np.where(turning, np.radians(recorded), recorded), limits, turning)
        if np.diag(_fits(radians, limits)).all():
            return OutsideLimits(fraction, ranges, Within.DEGREES)
    if fits[joints, columns].all():
        order = tuple(names[int(j)] for j in np.argsort(columns))
        return OutsideLimits(fraction, ranges, Within.ORDER, order)
    return OutsideLimits(fraction, ranges, Within.NOTHING)


def outside_limits(position: Array, names: Sequence[str], urdf: str) -> OutsideLimits | None:
    """Return how positions (m, n) leave the limits of the URDF; None if they do not."""
    return _outside(position, names, urdf_limits(urdf, names), _turning(urdf, names))


def check_positions(position: Array, names: Sequence[str], urdf: str, path: Path) -> None:
    """Check that at least one row of positions is within the limits of the URDF.

    Args:
        position: of the joints (m, n) [rad or m].
        names: of the joints.
        urdf: text of the description.
        path: of the recording, for the error.

    Raises:
        SourceError: none is.
    """
    outside = outside_limits(position, names, urdf)
    if outside is not None and outside.fraction == 1.0:
        remedy = f"{remedy_of(outside)}; if the limits are wrong: --outside-limits"
        raise SourceError(path, problem_of(outside), field="position", remedy=remedy)


def are_degrees(position: Array, converted: Array, names: Sequence[str], urdf: str) -> bool:
    """Return whether positions leave the limits by far, but not if they are degrees.

    Args:
        position: numbers of the recording (m, n).
        converted: the same numbers read as degrees (m, n) [rad].
        names: of the joints.
        urdf: text of the description.
    """
    limits = urdf_limits(urdf, names)
    turning = _turning(urdf, names)
    if not turning.all() or not len(position):
        return False
    if not (np.isfinite(position).all() and np.isfinite(converted).all()):
        return False
    # Radians that wrap anywhere, and may begin a turn away from the limits, are no degrees.
    position = np.add(*_continued(position, limits, turning))
    beyond = ~np.diag(_fits(position, limits))
    far = np.abs(position).max(axis=0) > 3.0 * np.maximum(-limits.lower, limits.upper)
    if not (far & beyond).any():
        return False
    fits = np.diag(_fits(in_turns(converted, limits, turning), limits))
    moves = np.ptp(converted, axis=0).max() >= _MIN_TRAVEL
    return bool(fits.all() and moves)


def has_degrees_per_second(time: Array, position: Array, velocity: Array) -> bool:
    """Return whether velocities (m, n) are the slopes of positions [rad] in degrees per second."""
    moving = np.ptp(position, axis=0) >= _MIN_TRAVEL
    if not moving.any():
        return False
    factor, correlation = against_position(time, position[:, moving], velocity[:, moving])
    per_degree = math.radians(1.0) * factor
    itself = np.diag(correlation)
    return bool(
        (itself >= MIN_CORRELATION).all() and (abs(per_degree - 1.0) < _SCALE_TOLERANCE).all()
    )


def command_size(position: Array, commanded: Array) -> float | None:
    """Return how far commands (m, n) move over how far positions do, the median of the joints.

    None where no joint moves with its command.
    """
    known = np.isfinite(commanded).all(axis=1)
    if np.count_nonzero(known) < 2:
        return None
    travels = [np.ptp(values[known], axis=0) for values in (commanded, position)]
    moving = np.min(travels, axis=0) > 0.0
    if not moving.any():
        return None
    return float(np.median(travels[0][moving] / travels[1][moving]))


def _positions(
    time: Array,
    position: Array,
    names: Sequence[str],
    limits: JointRanges,
    turning: NDArray[np.bool_],
    *,
    has_speed: bool,
) -> Iterator[Conclusion]:
    """Yield warnings where positions or speeds are outside the limits of the URDF.

    Positions of several sources have no speed of the arm.
    """
    outside = _outside(position, names, limits, turning)
    if outside is not None:
        yield outside
    low = position.min(axis=0)
    high = position.max(axis=0)
    travel = high - low
    if travel.max() < _MIN_TRAVEL:
        farthest = int(travel.argmax())
        yield LittleMotion(float(travel[farthest]), turns=bool(turning[farthest]))
    # Longer steps, in which noise and late stamps are negligible.
    block = min(_BLOCK_SECONDS * len(time) / float(time[-1] - time[0]), len(time) / _MIN_BLOCKS)
    stride = max(1, len(time) // _MAX_BLOCKS, round(block))
    steps = np.diff(time[::stride])[:, None]
    whole = steps[:, 0] > 0.5 * np.median(steps)
    moved = np.abs(np.diff(position[::stride], axis=0))[whole]
    if not len(moved) or not has_speed:
        return
    usual = np.quantile(moved / steps[whole], 0.9, axis=0)
    for name, speed, limit in zip(names, usual, limits.velocity, strict=True):
        if speed > MAX_LIMIT_RATIO * limit:
            yield FastJoint(name, float(speed), float(limit))


def _of_one_stamp(time: Array, position: Array, units: NDArray[np.str_]) -> SameStamp | None:
    """Return how far apart positions (m, n) of one stamp are, None if they are near."""
    starts = np.flatnonzero(np.diff(time, prepend=time[0] - 1.0))
    highest = np.maximum.reduceat(position, starts)
    lowest = np.minimum.reduceat(position, starts)
    apart = (highest - lowest).max(axis=0)
    count = np.count_nonzero((highest - lowest).max(axis=1) > MIN_SAMPLE_DISTANCE)
    if not count:
        return None
    return SameStamp(float(apart.max()), int(count), str(units[apart.argmax()]))


def _velocities(
    time: Array, position: Array, velocity: Array, names: Sequence[str]
) -> Iterator[Conclusion]:
    """Yield warnings where velocities are not the slopes of the positions."""
    moving = [joint for joint in range(len(names)) if np.ptp(position[:, joint]) >= _MIN_TRAVEL]
    if not moving:
        return
    factor, correlation = against_position(time, position[:, moving], velocity[:, moving])
    itself = np.diag(correlation)
    if itself.min() < MIN_CORRELATION:
        columns = scipy.optimize.linear_sum_assignment(-correlation)[1]
        best = correlation[np.arange(len(moving)), columns]
        if best.min() >= MIN_CORRELATION:
            order = list(names)
            for joint, column in zip(moving, columns, strict=True):
                order[moving[column]] = names[joint]
            yield VelocityOrder(tuple(order), _missed(itself), _missed(best))
            return
    off = {}
    for k, joint in enumerate(moving):
        if itself[k] < MIN_CORRELATION:
            yield UnrelatedVelocity(names[joint], float(itself[k]))
        elif abs(factor[k] - 1.0) > _SCALE_TOLERANCE:
            off[names[joint]] = float(factor[k])
    if off:
        yield ScaledVelocity(off)


def _missed(correlation: Array) -> float:
    """Return the deviation of velocities from slopes for these correlations, at best scale [%]."""
    return 100.0 * float(np.sqrt(np.mean(1.0 - np.minimum(correlation, 1.0) ** 2)))


def against_position(time: Array, position: Array, velocity: Array) -> tuple[Array, Array]:
    """Return scales of the velocities (n,), and absolute correlations with positions (n, n).

    Rows are positions, columns velocities. Integrals are compared instead of slopes: less noise.
    """
    steps = np.diff(time)[:, None]
    usual = np.median(steps[steps > 0.0]) if (steps > 0.0).any() else 0.0  # stamps may repeat
    without_gap = steps <= 5.0 * usual  # the velocity in a gap is unknown
    moved = np.where(without_gap, 0.5 * (velocity[1:] + velocity[:-1]) * steps, 0.0).cumsum(axis=0)
    gone = np.where(without_gap, np.diff(position, axis=0), 0.0).cumsum(axis=0)
    moved = moved - moved.mean(axis=0)
    gone = gone - gone.mean(axis=0)
    product = gone.T @ moved
    squares = np.sum(gone * gone, axis=0), np.sum(moved * moved, axis=0)
    sizes = np.sqrt(np.outer(*squares))
    correlation = np.divide(np.abs(product), sizes, out=np.zeros_like(sizes), where=sizes > 0.0)
    factor = np.divide(
        np.diag(product), squares[0], out=np.zeros(len(sizes)), where=squares[0] > 0.0
    )
    return factor, correlation


def _torques(
    samples: ImportedSamples, names: Sequence[str], turning: NDArray[np.bool_], limits: Array
) -> Iterator[Conclusion]:
    if samples.torque is None and samples.motor_current is None:
        yield NoTorque(is_commanded=samples.commanded_position is not None)
    if samples.torque is None:
        return
    sizes = np.abs(samples.torque).max(axis=0)
    for name, turns, largest, limit in zip(names, turning, sizes, limits, strict=True):
        if largest == 0.0:
            yield ZeroTorque(name)
        elif largest > MAX_LIMIT_RATIO * limit:
            unit = "N·m" if turns else "N"
            yield LargeTorque(name, float(largest), float(limit), unit)
    yield from constant_torques(samples.position, samples.torque, names)


def constant_torques(
    position: Array, torque: Array, names: Sequence[str]
) -> tuple[ConstantTorque, ...]:
    """Return the joints that moved (m, n) under one torque (m, n) that is not zero."""
    moved = np.ptp(position, axis=0) > MIN_MOVEMENT
    is_constant = moved & (np.ptp(torque, axis=0) == 0.0) & (torque[0] != 0.0)
    return tuple(
        ConstantTorque(names[joint], float(torque[0, joint]))
        for joint in np.flatnonzero(is_constant).tolist()
    )


def _torque_size(
    samples: ImportedSamples, names: Sequence[str], limits: Array, nominal: NominalTorque | None
) -> Iterator[Conclusion]:
    """Yield a warning where torques have another order of magnitude than the arm needs.

    Compares root mean squares with nominal inertias over the same motion, without
    friction; without nominal inertias, the largest torques with the effort limits.
    """
    if samples.torque is None or not samples.torque.any():
        return
    expected = None if nominal is None else _nominal_rms(samples, nominal)
    by_masses = expected is not None and bool(expected.any())
    if expected is not None and by_masses:
        compared = expected >= _MIN_TORQUE_SHARE * expected.max()
        rms = np.sqrt(np.mean(np.square(samples.torque), axis=0))
        ratio = rms[compared] / expected[compared]
        lowest = _OTHER_UNIT_RATIO
    else:
        compared = np.isfinite(limits)
        if not compared.any():
            return
        ratio = np.abs(samples.torque).max(axis=0)[compared] / limits[compared]
        lowest = _THOUSAND / MAX_LIMIT_RATIO
    ratios = dict(zip(_those(names, compared), ratio.tolist(), strict=True))
    if ratio.max() < 1.0 / lowest:
        yield TorqueSize(ratios, by_masses, too_large=False)
    elif ratio.min() > _OTHER_UNIT_RATIO:
        yield TorqueSize(ratios, by_masses, too_large=True)


def _those(names: Sequence[str], which: NDArray[np.bool_]) -> list[str]:
    return [name for name, chosen in zip(names, which.tolist(), strict=True) if chosen]


def _nominal_rms(samples: ImportedSamples, nominal: NominalTorque) -> Array | None:
    """Return the root mean square of the nominal torque over the motion (n,); None if too short.

    Positions are averaged over blocks first, in which the noise of differences is small.
    """
    block = ((samples.stamp - samples.stamp[0]) // round(1e9 * _BLOCK_SECONDS)).astype(np.int64)
    _, index, count = np.unique(block, return_inverse=True, return_counts=True)
    mean = np.zeros((len(count), samples.position.shape[1]))
    np.add.at(mean, index, samples.position)
    mean /= count[:, None]
    if len(mean) < 3:
        return None
    time = np.zeros(len(count))
    np.add.at(time, index, (samples.stamp - samples.stamp[0]) * 1e-9)
    time /= count
    before = np.diff(time)[:-1, None]
    after = np.diff(time)[1:, None]
    slopes = np.diff(mean, axis=0) / np.diff(time)[:, None]
    velocity = (slopes[:-1] * after + slopes[1:] * before) / (before + after)
    acceleration = 2.0 * np.diff(slopes, axis=0) / (before + after)
    motion = Motion(time[1:-1], mean[1:-1], velocity, acceleration)
    torque = nominal(motion.rows(slice(None, None, -(-len(velocity) // _MAX_BLOCKS))))
    return np.asarray(np.sqrt(np.mean(np.square(torque), axis=0)))
