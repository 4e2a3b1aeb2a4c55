"""What a recording looks like, so that a slip in its units is seen before anything is fitted.

Where two readings of a recording are possible (another unit, another order of joints), both are
given with their errors: how far a velocity misses the slope of its position, and in how many rows
a position is outside the limits of the URDF.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from hil.archive import Findings, Samples
from identification.model.urdf_text import urdf_tree
from identification.signals.clock import time_base

Array = NDArray[np.float64]

SLOWEST: Final = 20.0  # Hz; nothing of a robot's dynamics is left below
FASTEST: Final = 20_000.0  # Hz
# Hz, below which no motion can be seen: 5 kHz in ms, read as s, are 5 Hz.
_NO_MOTION: Final = 10.0
_TOLERANCE: Final = 0.05  # rad or m that calibration and overshoot may take beyond a limit
_HARDLY: Final = 0.1  # rad or m of travel, less than which excites nothing
# Between the velocity and the slope of the position: filters take a few per cent.
_ALIKE: Final = 0.1
_FOLLOWS: Final = 0.7  # correlation
_NOTHING_TO_FIT: Final = (
    "there is neither torque nor motor current in the log: it can be looked at, not identified from"
)
_TOO_FAST: Final = 3.0  # times the URDF's limit, of speed and of torque
_NO_LIMIT: Final = 1e4  # what some URDFs write for "none"
_DEGREE: Final = math.pi / 180.0


class _Slip(NamedTuple):
    """What makes velocities a factor too large, in words."""

    velocity: str
    position: str = ""
    time: str = ""


_SLIPS: Final = {
    1.0 / _DEGREE: _Slip("velocities in deg/s read as rad/s", "positions in rad read as deg"),
    _DEGREE: _Slip("velocities in rad/s read as deg/s", "positions in deg read as rad"),
    30.0 / math.pi: _Slip("velocities in rpm read as rad/s"),
    math.pi / 30.0: _Slip("velocities in rad/s read as rpm"),
    6.0: _Slip("velocities in deg/s read as rpm"),
    1.0 / 6.0: _Slip("velocities in rpm read as deg/s"),
    2.0 * math.pi: _Slip("velocities in rad/s read as rev/s", "positions in rev read as rad"),
    0.5 / math.pi: _Slip("velocities in rev/s read as rad/s", "positions in rad read as rev"),
    1e3: _Slip(
        "velocities in mm/s read as m/s", "positions in m (rad) read as mm (mrad)",
        "a time in ms read as s",
    ),
    1e-3: _Slip(
        "velocities in m/s read as mm/s", "positions in mm (mrad) read as m (rad)",
        "a time in s read as ms",
    ),
    -1.0: _Slip("the sign of the velocities", "the sign of the positions"),
}  # fmt: skip
"""By how many times too large the velocities then are."""


@dataclass(frozen=True)
class Limits:
    """Limits of a joint as its URDF gives them, infinite where it gives none."""

    lower: float = -np.inf
    upper: float = np.inf
    velocity: float = np.inf
    effort: float = np.inf
    revolute: bool = True


class ClockFault(NamedTuple):
    """Why a time base is that of no motion, and what would help."""

    problem: str
    remedy: str


def clock_fault(stamp: NDArray[np.int64]) -> ClockFault | None:
    """What forbids to use stamps (m,) [ns]; None where nothing does, or there is but one."""
    steps = np.diff(stamp)
    if not steps.size:
        return None
    backward = np.flatnonzero(steps < 0)
    if backward.size:
        first = int(backward[0]) + 1
        return ClockFault(
            f"sample {first} is {-1e-9 * steps[first - 1]:.3g} s older than the one before it "
            f"({backward.size} such steps)",
            "cut the recording where its clock runs backwards, or name another time column",
        )
    if not steps.any():
        return ClockFault(
            f"all {len(stamp)} samples have the same time",
            "name the column of the time, or give sample_rate in its place",
        )
    rate = 1e9 / float(np.median(steps[steps > 0]))
    if rate >= _NO_MOTION:
        return None
    return ClockFault(
        f"there would be {rate:.2g} samples a second, in which no motion can be seen",
        f"check its unit ([time] unit, or sample_rate in Hz): milliseconds read as seconds would "
        f"make it {1e3 * rate:.4g} samples a second; at least {SLOWEST:g} are needed",
    )


def examine(
    samples: Samples,
    joint_names: Sequence[str],
    urdf: str,
    *,
    locked: Mapping[str, float] | None = None,
) -> Findings:
    """Look at samples on the joint side, in SI units, columns in the order of the names.

    Args:
        samples: of the recording.
        joint_names: the joints.
        urdf: their description.
        locked: positions [rad or m] of joints that are none of the model, by name.
    """
    time = np.asarray((samples.stamp - samples.stamp[0]) * 1e-9)
    limits = [urdf_limits(urdf).get(name, Limits()) for name in joint_names]
    held = [f"{name} at {position:.4g}" for name, position in (locked or {}).items()]
    lines = [f"locked, rad or m: {', '.join(held)}"] if held else []
    if len(time) < 2:
        return Findings(lines=(f"{len(time)} samples", *lines), warnings=())
    base = time_base(time)
    lines = [f"time: {'; '.join(base.describe())}", *lines]
    warnings = []
    if not SLOWEST <= base.rate <= FASTEST:
        warnings.append(
            f"{base.rate:.3g} samples a second is unusual: is the unit of the time right?"
        )
    lines += [
        _range(name, samples.position[:, joint], limits[joint])
        for joint, name in enumerate(joint_names)
    ]
    warnings += _beyond_limits(samples.position, joint_names, limits)
    warnings += _motionless(samples.position, limits)
    warnings += _speeds(time, samples.position, joint_names, limits)
    if samples.velocity is not None:
        warnings += _velocities(
            time, base.rate, samples.position, samples.velocity, joint_names, limits
        )
    warnings += _torques(samples, joint_names, limits)
    return Findings(lines=tuple(lines), warnings=tuple(warnings))


def urdf_limits(urdf: str) -> dict[str, Limits]:
    """Limits by joint name."""
    found = {}
    for joint in urdf_tree(urdf).iter("joint"):
        kind, limit = joint.get("type"), joint.find("limit")
        if kind not in ("revolute", "continuous", "prismatic"):
            continue
        given = {} if limit is None else _numbers(limit)
        bounded = kind != "continuous" and given.get("lower", 0.0) < given.get("upper", 0.0)
        found[joint.get("name", "")] = Limits(
            lower=given["lower"] if bounded and "lower" in given else -np.inf,
            upper=given["upper"] if bounded and "upper" in given else np.inf,
            velocity=_real(given.get("velocity")),
            effort=_real(given.get("effort")),
            revolute=kind != "prismatic",
        )
    return found


def _numbers(limit: Element) -> dict[str, float]:
    """What of a limit is a number; what a macro left behind is none."""
    found = {}
    for key in ("lower", "upper", "velocity", "effort"):
        try:
            found[key] = float(limit.get(key, ""))
        except ValueError:
            continue
    return found


def _real(limit: float | None) -> float:
    """A limit, infinite where it is a placeholder."""
    return limit if limit is not None and 0.0 < limit < _NO_LIMIT else np.inf


def _range(name: str, position: Array, limits: Limits) -> str:
    low, high = float(position.min()), float(position.max())
    text = f"{name}: {low:.3f} .. {high:.3f} {'rad' if limits.revolute else 'm'}"
    if limits.revolute:
        text += f" ({math.degrees(low):.0f} .. {math.degrees(high):.0f} deg)"
    if np.isfinite(limits.lower):
        text += f", limits of the URDF {limits.lower:.3f} .. {limits.upper:.3f}"
    return text


def _outside(position: Array, limits: Sequence[Limits]) -> float:
    """Share of the rows (m, n) in which a joint is outside its limits [%]."""
    lower = np.array([one.lower for one in limits]) - _TOLERANCE
    upper = np.array([one.upper for one in limits]) + _TOLERANCE
    return 100.0 * float(np.mean(((position < lower) | (position > upper)).any(axis=1)))


def _beyond_limits(position: Array, names: Sequence[str], limits: Sequence[Limits]) -> list[str]:
    """Positions outside the limits, and whether another unit or order has none."""
    fits = _fits(position, limits)
    beyond = [joint for joint in range(len(names)) if not fits[joint, joint]]
    if not beyond:
        return []
    ranges = ", ".join(
        f"{names[j]}: {position[:, j].min():.3g} .. {position[:, j].max():.3g}" for j in beyond
    )
    text = (
        f"as mapped, {_outside(position, limits):.3g} % of the rows leave the limits of the URDF "
        f"({ranges})"
    )
    turning = np.array([one.revolute for one in limits])
    far = any(
        np.abs(position[:, j]).max() > 3.0 * max(abs(limits[j].lower), abs(limits[j].upper))
        for j in beyond
    )
    check = "check unit, sign and zero in the column map"
    if far and np.diag(_fits(np.where(turning, position * _DEGREE, position), limits)).all():
        return [f'{text}; as degrees read as radians, none would: write unit = "deg"']
    columns = linear_sum_assignment(~fits + 1e-6 * (1.0 - np.eye(len(names))))[1]
    if fits[np.arange(len(names)), columns].all():
        order = ", ".join(names[int(j)] for j in np.argsort(columns))
        return [
            f"{text}; with the columns those of {order}, none would: is that the order of the "
            f"joints? Otherwise {check}"
        ]
    return [f"{text}: {check}"]


def _fits(position: Array, limits: Sequence[Limits]) -> NDArray[np.bool_]:
    """Whether each column of the positions lies in the limits of each joint (joints, columns)."""
    low, high = position.min(axis=0), position.max(axis=0)
    return np.array(
        [(one.lower - _TOLERANCE <= low) & (high <= one.upper + _TOLERANCE) for one in limits]
    )


def _motionless(position: Array, limits: Sequence[Limits]) -> list[str]:
    travel = float(np.ptp(position, axis=0).max())
    if travel >= _HARDLY:
        return []
    text = f"no joint moves further than {travel:.2g} rad or m"
    larger = position / _DEGREE
    if travel / _DEGREE < _HARDLY:
        return [f"{text}: if one did, the unit of the positions is wrong"]
    return [
        f"{text}; were they radians read as degrees, the joints would move up to "
        f"{travel / _DEGREE:.2g} rad, and {_outside(larger, limits):.3g} % of the rows leave the "
        "limits of the URDF: is the unit of the positions right?"
    ]


def _speeds(
    time: Array, position: Array, names: Sequence[str], limits: Sequence[Limits]
) -> list[str]:
    """Whether a robot could move so."""
    usual = [_usual_speed(time, column) for column in position.T]
    ratio = [speed / one.velocity for speed, one in zip(usual, limits, strict=True)]
    worst = int(np.argmax(ratio))
    if ratio[worst] <= _TOO_FAST:
        return []
    others = sum(one > _TOO_FAST for one in ratio) - 1
    return [
        f"{names[worst]}{f' (and {others} more)' if others else ''} would move at "
        f"{usual[worst]:.3g} rad/s (or m/s), its limit in the URDF is "
        f"{limits[worst].velocity:.3g}; with degrees read as radians it would be "
        f"{usual[worst] * _DEGREE:.3g}, with seconds read as milliseconds "
        f"{usual[worst] * 1e-3:.3g}: is the unit of the position or of the time right?"
    ]


def _usual_speed(time: Array, position: Array) -> float:
    """A high but not the highest speed, over stretches long enough for noise not to matter."""
    stride = max(1, len(time) // 2000)
    steps = np.diff(time[::stride])
    if not np.any(steps > 0.0):
        return 0.0
    speed = np.abs(np.diff(position[::stride]))[steps > 0.0] / steps[steps > 0.0]
    return float(np.quantile(speed, 0.9))


def _velocities(
    time: Array,
    rate: float,
    position: Array,
    velocity: Array,
    names: Sequence[str],
    limits: Sequence[Limits],
) -> list[str]:
    """Whether the velocities are the slopes of the positions: in this order, in these units."""
    moving = [joint for joint in range(len(names)) if np.ptp(position[:, joint]) >= _HARDLY]
    if not moving:
        return []
    factor, correlation = _against_position(time, position[:, moving], velocity[:, moving])
    itself = np.diag(correlation)
    columns = linear_sum_assignment(-correlation)[1]
    best = correlation[np.arange(len(moving)), columns]
    if itself.min() < _FOLLOWS <= best.min():
        theirs = list(names)
        for joint, column in zip(moving, columns, strict=True):
            theirs[moving[column]] = names[joint]
        return [
            "the velocities are in another order than the positions: as mapped they miss their "
            f"slopes by {_missed(itself):.0f} %, as those of {', '.join(theirs)} by "
            f"{_missed(best):.0f} %: name the columns of both in the same order"
        ]
    follow = dict(zip(moving, itself, strict=True))
    factors = dict(zip(moving, factor, strict=True))
    warnings = [
        f"the velocity of {names[joint]} does not follow its position (correlation "
        f"{follow[joint]:.2f}): are the joints in the same order?"
        for joint in moving
        if follow[joint] < _FOLLOWS
    ]
    off: dict[float, list[int]] = {}
    for joint in moving:
        if follow[joint] >= _FOLLOWS and abs(factors[joint] - 1.0) > _ALIKE:
            off.setdefault(_nearest_slip(factors[joint]), []).append(joint)
    for slip, joints in off.items():
        subject = "every joint" if joints == moving else ", ".join(names[j] for j in joints)
        text = (
            f"the velocity of {subject} is {float(np.median([factors[j] for j in joints])):.4g} "
            "times the slope of the position"
        )
        if slip not in _SLIPS:
            warnings.append(f"{text}: check units and gears")
            continue
        changed = position.copy()
        changed[:, joints] *= slip
        words = _SLIPS[slip]
        readings = [
            f"{words.velocity} (with {_outside(position, limits):.3g} % of the rows outside the "
            "limits of the URDF)"
        ]
        if words.position:
            readings.append(f"{words.position} (with {_outside(changed, limits):.3g} %)")
        if words.time and joints == moving:
            readings.append(f"{words.time} (with {slip * rate:.3g} samples a second)")
        warnings.append(f"{text}: {', or '.join(readings)}?")
    return warnings


def _nearest_slip(factor: float) -> float:
    """The slip that makes about this factor; the factor itself where none does."""
    known = min(_SLIPS, key=lambda slip: abs(factor / slip - 1.0))
    return known if abs(factor / known - 1.0) < _ALIKE else factor


def _missed(correlation: Array) -> float:
    """How far velocities miss slopes with which they have these correlations, at best scale [%]."""
    return 100.0 * float(np.sqrt(np.mean(1.0 - np.minimum(correlation, 1.0) ** 2)))


def _against_position(time: Array, position: Array, velocity: Array) -> tuple[Array, Array]:
    """How many times too large each velocity is (n,), and the correlations without sign (n, n).

    Rows are positions, columns velocities. The integral is compared, not the slope: noise matters
    less.
    """
    steps = np.diff(time)[:, None]
    known = steps <= 5.0 * np.median(steps)  # over a gap nothing is known of the velocity
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


def _torques(samples: Samples, names: Sequence[str], limits: Sequence[Limits]) -> list[str]:
    if samples.torque is None:
        return [] if samples.motor_current is not None else [_NOTHING_TO_FIT]
    largest = np.abs(samples.torque).max(axis=0)
    warnings = [
        f"the torque of {name} reaches {largest[j]:.3g}, its limit in the URDF is "
        f"{limits[j].effort:.3g} N·m (or N): is its unit right, and its side (motor or joint)?"
        for j, name in enumerate(names)
        if largest[j] > _TOO_FAST * limits[j].effort
    ]
    for j, name in enumerate(names):
        if largest[j] == 0.0:
            warnings.append(f"the torque of {name} is zero throughout")
    return warnings
