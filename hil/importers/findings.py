"""What a recording looks like, so that a slip in its units is seen before anything is fitted."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from hil.archive import Samples, foreign_json
from identification.signals.clock import time_base
from identification.urdf_tree import urdf_tree

Array = NDArray[np.float64]

METADATA: Final = "findings"
"""Entry of an imported archive's metadata that holds them."""

SLOWEST: Final = 20.0  # Hz; nothing of a robot's dynamics is left below
FASTEST: Final = 20_000.0  # Hz
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
_FACTORS: Final = {
    180.0 / np.pi: "degrees read as radians",
    np.pi / 180.0: "radians read as degrees",
    30.0 / np.pi: "revolutions per minute read as radians per second",
    1.0 / (2.0 * np.pi): "revolutions read as radians",
    2.0 * np.pi: "radians read as revolutions",
    1e3: "milliseconds (or mrad, mm) read as the whole unit",
    1e-3: "the whole unit read as milliseconds (or mrad, mm)",
    -1.0: "a sign",
}


@dataclass(frozen=True)
class Findings:
    """What was found in a recording.

    Attributes:
        lines: the time base, and the range of each joint.
        doubts: what looks like a slip of the column map, in sentences.
    """

    lines: tuple[str, ...]
    doubts: tuple[str, ...]

    def text(self) -> str:
        """As an entry of an archive's metadata."""
        return json.dumps({"lines": self.lines, "doubts": self.doubts})

    @classmethod
    def of(cls, metadata: Mapping[str, str]) -> Findings:
        """From an archive's metadata; nothing where they have none."""
        if METADATA not in metadata:
            return cls((), ())
        stored = foreign_json.loads(metadata[METADATA])
        entries = stored if isinstance(stored, dict) else {}
        lines, doubts = (_sentences(entries.get(key)) for key in ("lines", "doubts"))
        if lines is None or doubts is None:
            return cls((), ("what its import found cannot be read",))
        return cls(lines, doubts)


def _sentences(stored: object) -> tuple[str, ...] | None:
    if not isinstance(stored, list) or not all(isinstance(line, str) for line in stored):
        return None
    return tuple(stored)


@dataclass(frozen=True)
class Limits:
    """Limits of a joint as its URDF gives them, infinite where it gives none."""

    lower: float = -np.inf
    upper: float = np.inf
    velocity: float = np.inf
    effort: float = np.inf
    revolute: bool = True


def examine(samples: Samples, joint_names: Sequence[str], urdf: str) -> Findings:
    """Look at samples on the joint side, in SI units, columns in the order of the names."""
    time = np.asarray((samples.stamp - samples.stamp[0]) * 1e-9)
    limits = [urdf_limits(urdf).get(name, Limits()) for name in joint_names]
    if len(time) < 2 or not np.any(np.diff(time) > 0.0):
        return Findings((f"{len(time)} samples",), ("the clock stands still",))
    base = time_base(time)
    lines = [f"time: {'; '.join(base.describe())}"]
    doubts = []
    if not SLOWEST <= base.rate <= FASTEST:
        doubts.append(
            f"{base.rate:.3g} samples a second is unusual: is the unit of the time right?"
        )
    if base.backward:
        doubts.append(f"the clock falls back {base.backward} times; cut the log where it does")
    for joint, name in enumerate(joint_names):
        position = samples.position[:, joint]
        lines.append(_range(name, position, limits[joint]))
        doubts += _outside(name, position, limits[joint])
    doubts += _motionless(samples.position)
    doubts += _speeds(time, samples, joint_names, limits)
    doubts += _torques(samples, joint_names, limits)
    return Findings(tuple(lines), tuple(doubts))


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


def _outside(name: str, position: Array, limits: Limits) -> list[str]:
    low, high = float(position.min()), float(position.max())
    lower, upper = limits.lower - _TOLERANCE, limits.upper + _TOLERANCE
    if lower <= low and high <= upper:
        return []
    slip = "check its unit, sign and zero in the column map"
    far = max(abs(low), abs(high)) > 3.0 * max(abs(limits.lower), abs(limits.upper))
    factor = 180.0 / np.pi
    if limits.revolute and far and lower <= low / factor and high / factor <= upper:
        slip = 'it looks like degrees read as radians: write unit = "deg"'
    return [f"{name} leaves the limits of the URDF, {low:.3g} .. {high:.3g}: {slip}"]


def _motionless(position: Array) -> list[str]:
    travel = float(np.ptp(position, axis=0).max())
    if travel >= _HARDLY:
        return []
    return [
        f"no joint moves further than {travel:.2g} rad or m: if it did, the unit of "
        "the positions is wrong"
    ]


def _speeds(
    time: Array, samples: Samples, names: Sequence[str], limits: Sequence[Limits]
) -> list[str]:
    """Whether the velocity is the slope of the position, and whether a robot could move so."""
    doubts = []
    for joint, name in enumerate(names):
        position = samples.position[:, joint]
        usual = _usual_speed(time, position)
        if usual > _TOO_FAST * limits[joint].velocity:
            doubts.append(
                f"{name} would move at {usual:.3g} rad/s (or m/s), its limit in the URDF is "
                f"{limits[joint].velocity:.3g}: is the unit of the time or of the position right?"
            )
        if samples.velocity is None or np.ptp(position) < _HARDLY:
            continue
        factor, correlation = _against_position(time, position, samples.velocity[:, joint])
        if correlation < _FOLLOWS:
            doubts.append(
                f"the velocity of {name} does not follow its position (correlation "
                f"{correlation:.2f}): are the joints in the same order?"
            )
        elif abs(factor - 1.0) > _ALIKE:
            doubts.append(
                f"the velocity of {name} is {factor:.4g} times the slope of its position"
                f"{_named(factor)}"
            )
    return doubts


def _usual_speed(time: Array, position: Array) -> float:
    """A high but not the highest speed, over stretches long enough for noise not to matter."""
    stride = max(1, len(time) // 2000)
    steps = np.diff(time[::stride])
    if not np.any(steps > 0.0):
        return 0.0
    speed = np.abs(np.diff(position[::stride]))[steps > 0.0] / steps[steps > 0.0]
    return float(np.quantile(speed, 0.9))


def _against_position(time: Array, position: Array, velocity: Array) -> tuple[float, float]:
    """How many times too large a velocity is, and the correlation (without sign) that says so.

    The integral is compared, not the slope: noise matters less.
    """
    steps = np.diff(time)
    usual = np.median(steps)
    # Over a gap nothing is known of the velocity.
    moved = np.where(steps <= 5.0 * usual, 0.5 * (velocity[1:] + velocity[:-1]) * steps, 0.0)
    gone = np.where(steps <= 5.0 * usual, np.diff(position), 0.0)
    travelled, there = np.cumsum(moved), np.cumsum(gone)
    travelled, there = travelled - travelled.mean(), there - there.mean()
    squares = float(there @ there), float(travelled @ travelled)
    if min(squares) == 0.0:
        return 0.0, 0.0
    product = float(travelled @ there)
    return product / squares[0], abs(product) / float(np.sqrt(squares[0] * squares[1]))


def _named(factor: float) -> str:
    for known, words in _FACTORS.items():
        if abs(factor / known - 1.0) < _ALIKE:
            return f": {words}?"
    return ": check units and gears"


def _torques(samples: Samples, names: Sequence[str], limits: Sequence[Limits]) -> list[str]:
    if samples.torque is None:
        return [] if samples.motor_current is not None else [_NOTHING_TO_FIT]
    largest = np.abs(samples.torque).max(axis=0)
    doubts = [
        f"the torque of {name} reaches {largest[j]:.3g}, its limit in the URDF is "
        f"{limits[j].effort:.3g} N·m (or N): is its unit right, and its side (motor or joint)?"
        for j, name in enumerate(names)
        if largest[j] > _TOO_FAST * limits[j].effort
    ]
    for j, name in enumerate(names):
        if largest[j] == 0.0:
            doubts.append(f"the torque of {name} is zero throughout")
    return doubts
