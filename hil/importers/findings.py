"""Plausibility of an imported recording: units, signs and order of the joints.

Where another order fits better, its error is given with that of the map.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from hil.archive import Findings, Samples
from hil.cell.text import UrdfLimits, urdf_limits
from hil.errors import SourceError
from identification.model.urdf_text import urdf_tree
from identification.signals.clock import time_base
from identification.signals.recording import unwrap

Array = NDArray[np.float64]

_SLOWEST: Final = 20.0  # Hz; a robot's dynamics need faster sampling
_FASTEST: Final = 20_000.0  # Hz
_NO_MOTION: Final = 10.0  # Hz; 5 kHz in ms, read as s, are 5 Hz
_TOLERANCE: Final = 0.05  # rad or m beyond a limit, for calibration and overshoot
_LEAST_TRAVEL: Final = 0.1  # rad or m
_SCALE_TOLERANCE: Final = 0.1  # of velocity over slope of the position, for filters
_CORRELATED: Final = 0.7
_TOO_FAST: Final = 3.0  # times the URDF's limit, of speed and of torque
_NO_LIMIT: Final = 1e4  # some URDFs have larger figures for "none"


def check_clock(stamp: NDArray[np.int64], path: Path) -> None:
    """Check that stamps (m,) [ns] of a file can be those of a motion.

    Raises:
        SourceError: they run backwards, are all the same, or are too far apart.
    """
    steps = np.diff(stamp)
    backward = np.flatnonzero(steps < 0)
    if backward.size:
        first = int(backward[0]) + 1
        problem = (
            f"sample {first} is {-1e-9 * steps[first - 1]:.3g} s older than the one before it "
            f"({backward.size} such steps)"
        )
        remedy = "cut the recording where its clock runs backwards, or name another time column"
        raise SourceError(path, problem, field="time", remedy=remedy)
    if steps.size and not steps.any():
        problem = f"all {len(stamp)} samples have the same time"
        remedy = "name the column of the time, or give sample_rate instead"
        raise SourceError(path, problem, field="time", remedy=remedy)
    rate = 1e9 / float(np.median(steps[steps > 0])) if steps.size else np.inf
    if rate < _NO_MOTION:
        problem = f"has {rate:.2g} samples per second, too few for a motion"
        remedy = (
            "check its unit ([time] unit, or sample_rate in Hz): milliseconds read as seconds "
            f"would give {1e3 * rate:.4g} samples per second; at least {_SLOWEST:g} are needed"
        )
        raise SourceError(path, problem, field="time", remedy=remedy)


def examine(
    samples: Samples,
    joint_names: Sequence[str],
    urdf: str,
    *,
    locked: Mapping[str, float] | None = None,
) -> Findings:
    """Return the findings on samples of the joint side, in SI units.

    `locked` are positions [rad or m] of joints that are not in the model, by name.
    """
    time, position = np.asarray((samples.stamp - samples.stamp[0]) * 1e-9), unwrap(samples.position)
    limits = limits_of(urdf, joint_names)
    kinds = {joint.get("name"): joint.get("type") for joint in urdf_tree(urdf).findall("joint")}
    turning = np.array([kinds[name] != "prismatic" for name in joint_names])
    held = [f"{name} at {place:.4g}" for name, place in (locked or {}).items()]
    lines = [f"locked, rad or m: {', '.join(held)}"] if held else []
    if len(time) < 2:
        return Findings(lines=(f"{len(time)} samples", *lines), warnings=())
    base = time_base(time)
    lines = [f"time: {'; '.join(base.describe())}", *lines]
    lines += map(_range, joint_names, position.T, turning, limits.lower, limits.upper)
    warnings = []
    if not _SLOWEST <= base.rate <= _FASTEST:
        warnings += [f"{base.rate:.3g} samples per second are unusual: check the unit of the time"]
    warnings += _positions(time, position, joint_names, limits, turning)
    if samples.velocity is not None:
        warnings += _velocities(time, position, samples.velocity, joint_names)
    warnings += _torques(samples, joint_names, limits.effort)
    return Findings(lines=tuple(lines), warnings=tuple(warnings))


def limits_of(urdf: str, names: Sequence[str]) -> UrdfLimits:
    """Return limits of joints; infinite where the range is empty or a figure means no limit."""
    lower, upper, velocity, effort = urdf_limits(urdf, names)
    bounded = lower < upper
    return UrdfLimits(
        np.where(bounded, lower, -np.inf),
        np.where(bounded, upper, np.inf),
        *(np.where((one > 0.0) & (one < _NO_LIMIT), one, np.inf) for one in (velocity, effort)),
    )


def _range(name: str, position: Array, turns: bool, lower: float, upper: float) -> str:
    low, high = float(position.min()), float(position.max())
    text = f"{name}: {low:.3f} .. {high:.3f} {'rad' if turns else 'm'}"
    if turns:
        text += f" ({math.degrees(low):.0f} .. {math.degrees(high):.0f} deg)"
    if np.isfinite(lower):
        text += f", limits of the URDF {lower:.3f} .. {upper:.3f}"
    return text


def _fits(position: Array, limits: UrdfLimits) -> NDArray[np.bool_]:
    """Return whether each column of positions fits the limits of each joint (joints, columns)."""
    above = limits.lower[:, None] - _TOLERANCE <= position.min(axis=0)
    return np.asarray(above & (position.max(axis=0) <= limits.upper[:, None] + _TOLERANCE))


def _positions(
    time: Array,
    position: Array,
    names: Sequence[str],
    limits: UrdfLimits,
    turning: NDArray[np.bool_],
) -> Iterator[str]:
    """Yield warnings where positions or speeds are outside the limits of the URDF."""
    fits, joints = _fits(position, limits), range(len(names))
    beyond = [joint for joint in joints if not fits[joint, joint]]
    low, high = position.min(axis=0), position.max(axis=0)
    if beyond:
        ranges = ", ".join(f"{names[j]}: {low[j]:.3g} .. {high[j]:.3g}" for j in beyond)
        outside = (position < limits.lower - _TOLERANCE) | (position > limits.upper + _TOLERANCE)
        text = (
            f"as mapped, {100.0 * float(np.mean(outside.any(axis=1))):.3g} % of the rows leave the "
            f"limits of the URDF ({ranges})"
        )
        radians = np.where(turning, np.radians(position), position)
        farthest = 3.0 * np.maximum(-limits.lower, limits.upper)
        far = (np.maximum(-low, high) > farthest)[beyond].any()
        columns = linear_sum_assignment(~fits + 1e-6 * (1.0 - np.eye(len(names))))[1]
        check = "check unit, sign and zero in the column map"
        if far and np.diag(_fits(radians, limits)).all():
            yield f'{text}; as degrees read as radians, none would: write unit = "deg"'
        elif fits[joints, columns].all():
            order = ", ".join(names[int(j)] for j in np.argsort(columns))
            yield (
                f"{text}; with the columns those of {order}, none would: check the order of the "
                f"joints, or {check}"
            )
        else:
            yield f"{text}: {check}"
    travel = float((high - low).max())
    if travel < _LEAST_TRAVEL:
        yield (
            f"no joint moves further than {travel:.2g} rad or m ({math.degrees(travel):.2g} if "
            "these were degrees): check the unit of the positions"
        )
    stride = max(1, len(time) // 2000)  # longer steps, in which noise is negligible
    steps = np.diff(time[::stride])[:, None]
    moved = np.abs(np.diff(position[::stride], axis=0))[steps[:, 0] > 0.0]
    if not len(moved):
        return
    usual = np.quantile(moved / steps[steps[:, 0] > 0.0], 0.9, axis=0)
    for name, speed, limit in zip(names, usual, limits.velocity, strict=True):
        if speed > _TOO_FAST * limit:
            yield (
                f"{name} would move at {speed:.3g} rad/s (or m/s), its limit in the URDF is "
                f"{limit:.3g}: check the units of position (degrees?) and time (milliseconds?)"
            )


def _velocities(
    time: Array, position: Array, velocity: Array, names: Sequence[str]
) -> Iterator[str]:
    """Yield warnings where velocities are not the slopes of the positions."""
    moving = [joint for joint in range(len(names)) if np.ptp(position[:, joint]) >= _LEAST_TRAVEL]
    if not moving:
        return
    factor, correlation = _against_position(time, position[:, moving], velocity[:, moving])
    itself = np.diag(correlation)
    columns = linear_sum_assignment(-correlation)[1]
    best = correlation[np.arange(len(moving)), columns]
    if itself.min() < _CORRELATED <= best.min():
        order = list(names)
        for joint, column in zip(moving, columns, strict=True):
            order[moving[column]] = names[joint]
        yield (
            "the velocities are in another order than the positions: as mapped they deviate from "
            f"the slopes by {_missed(itself):.0f} %, as those of {', '.join(order)} by "
            f"{_missed(best):.0f} %: name the columns of both in the same order"
        )
        return
    off = []
    for k, joint in enumerate(moving):
        if itself[k] < _CORRELATED:
            yield (
                f"the velocity of {names[joint]} does not follow its position (correlation "
                f"{itself[k]:.2f}): check the order of the joints"
            )
        elif abs(factor[k] - 1.0) > _SCALE_TOLERANCE:
            off.append(f"{factor[k]:.4g} for {names[joint]}")
    if off:
        yield (
            f"the velocity is the slope of the position times {', '.join(off)}: check units, signs "
            "and gears of both, and the unit of the time"
        )


def _missed(correlation: Array) -> float:
    """Return the deviation of velocities from slopes for these correlations, at best scale [%]."""
    return 100.0 * float(np.sqrt(np.mean(1.0 - np.minimum(correlation, 1.0) ** 2)))


def _against_position(time: Array, position: Array, velocity: Array) -> tuple[Array, Array]:
    """Return scales of the velocities (n,), and absolute correlations with positions (n, n).

    Rows are positions, columns velocities. Integrals are compared instead of slopes: less noise.
    """
    steps = np.diff(time)[:, None]
    known = steps <= 5.0 * np.median(steps)  # the velocity in a gap is unknown
    moved = np.where(known, 0.5 * (velocity[1:] + velocity[:-1]) * steps, 0.0).cumsum(axis=0)
    gone = np.where(known, np.diff(position, axis=0), 0.0).cumsum(axis=0)
    moved, gone = moved - moved.mean(axis=0), gone - gone.mean(axis=0)
    product = gone.T @ moved
    squares = np.sum(gone * gone, axis=0), np.sum(moved * moved, axis=0)
    sizes = np.sqrt(np.outer(*squares))
    correlation = np.divide(np.abs(product), sizes, out=np.zeros_like(sizes), where=sizes > 0.0)
    factor = np.divide(
        np.diag(product), squares[0], out=np.zeros(len(sizes)), where=squares[0] > 0.0
    )
    return factor, correlation


def _torques(samples: Samples, names: Sequence[str], limits: Array) -> Iterator[str]:
    if samples.torque is None and samples.motor_current is None:
        yield ("the log has neither torque nor motor current: nothing can be identified from it")
    if samples.torque is None:
        return
    for name, largest, limit in zip(names, np.abs(samples.torque).max(axis=0), limits, strict=True):
        if largest == 0.0:
            yield f"the torque of {name} is zero throughout"
        elif largest > _TOO_FAST * limit:
            yield (
                f"the torque of {name} reaches {largest:.3g}, its limit in the URDF is "
                f"{limit:.3g} N·m (or N): check its unit and side (motor or joint)"
            )
