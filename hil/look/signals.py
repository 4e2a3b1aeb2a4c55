"""Rows of a look that need no masses: clock, units, slopes, rests, wraps and filters."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hil.cell import Cell
from hil.importers.commands import COMMANDED
from hil.importers.findings import against_position, outside_limits
from hil.importers.row_names import ORDER
from hil.look.result import Certainty, Row
from identification.signals.clock import time_base
from identification.signals.recording import STUCK_MOVEMENT, UNWRAPPED, Recording
from identification.signals.smoothing import noiseless_above

Array = NDArray[np.float64]

_FOLLOWS: Final = 0.7  # correlation of a velocity with the slope of its position
_CLOSE: Final = 0.1  # relative deviation of their ratio
_LONGEST_LAG: Final = 0.1  # s
_CLEAR_LAG: Final = 1.5  # sampling steps
_HIGHEST_CORRELATION: Final = 0.95


def rows(
    recording: Recording,
    lines: Sequence[str],
    notes: Sequence[str],
    cell: Cell,
    *,
    given: object,
) -> list[Row]:
    """Return the rows; `lines` say what the names of channels mean, `notes` what was concluded."""
    table = [_time(recording, lines, notes)]
    table += [_quantity(line, notes) for line in lines if not line.startswith(("not used", "t:"))]
    table = [row for row in table if row.aspect != "time" or row is table[0]]
    if recording.velocity is not None:
        table.append(_velocity(recording))
    table += [_rests(recording), _wraps(recording), _measured(recording, lines)]
    if given is not None:
        table.append(_range(recording, cell))
    return table


def _time(recording: Recording, lines: Sequence[str], notes: Sequence[str]) -> Row:
    base = time_base(recording.time, recording.gap_before)
    text = "; ".join(base.describe())
    stated = next((line for line in lines if ": time" in line), "")
    concluded = next((note for note in notes if "time" in note and "read as" in note), "")
    if concluded:
        match = re.search(r"read as (\w+)", concluded)
        unit = match[1] if match else "s"
        return Row("time", f"{unit}; {text}", "likely", "that unit gives a usual rate",
                   'state [time] unit = "..."')  # fmt: skip
    if not stated and not any("joint states" in line for line in lines):
        return Row("time", text, "sure", "at the rate that was given")
    if "joint states" in " ".join(lines):
        return Row("time", f"stamps of the messages; {text}", "sure", "by the message type")
    match = re.search(r"; (\w+) as the log states|: time, (\w+), as in", stated)
    unit = (match[1] or match[2]) if match else "s"
    reason = "by the name and the unit that is stated" if match else "by the name; a usual rate"
    return Row("time", f"{unit}; {text}", "sure", reason)


def _quantity(line: str, notes: Sequence[str]) -> Row:
    """Return the row of a group of channels."""
    channels, _, meaning = line.partition(": ")
    kind, _, reason = meaning.partition(", ")
    if channels == ORDER:
        return Row("joints", meaning, "sure", "in the order of the names in the rows")
    if not reason:
        return Row("channels", channels, "likely", meaning)
    concluded = next((note for note in notes if note.startswith(f"{kind}: ")), "")
    certainty: Certainty = "sure" if "as the log states" in reason else "likely"
    decide = ""
    if kind in ("position", "velocity") and "no unit stated" in reason:
        unit = "deg" if "degrees" in concluded else "rad"
        unit += "/s" if kind == "velocity" else ""
        reason = concluded.partition(": ")[2] or reason.partition(";")[0]
        certainty = "sure" if concluded else "likely"
        return Row(kind, f"{channels}: {unit}", certainty, reason, decide)
    return Row(kind.replace("_", " "), channels, certainty, reason, decide)


def _velocity(recording: Recording) -> Row:
    """Return what the velocity is of the slope of the position."""
    assert recording.velocity is not None
    moving = np.flatnonzero(np.ptp(recording.position, axis=0) > STUCK_MOVEMENT)
    if not moving.size:
        return Row("velocity", "not examined", "open", "no joint moves")
    factor, correlation = against_position(
        recording.time, recording.position[:, moving], recording.velocity[:, moving]
    )
    itself = np.diag(correlation)
    names = [recording.joint_names[joint] for joint in moving]
    if itself.min() < _FOLLOWS:
        bad = ", ".join(name for name, r in zip(names, itself, strict=True) if r < _FOLLOWS)
        decide = "check the order of the columns of both"
        return Row("velocity", f"not the slope of the position: {bad}", "sure",
                   f"correlation {itself.min():.2f}", decide)  # fmt: skip
    if np.all(np.abs(factor - 1.0) < _CLOSE):
        return Row("velocity", "slope of the position, same unit, sign and order", "sure",
                   f"slope over velocity {1.0 / np.mean(factor):.3f}")  # fmt: skip
    reasons = {57.2958: "deg/s beside rad", math.radians(1.0): "rad/s beside deg",
               -1.0: "negated", 9.5493: "rev/min beside rad/s"}  # fmt: skip
    explanations = [
        text for size, text in reasons.items() if np.all(np.abs(factor / size - 1.0) < _CLOSE)
    ]
    figures = ", ".join(f"{name} {size:.4g}" for name, size in zip(names, factor, strict=True))
    reading = explanations[0] if explanations else "times the slope of the position"
    return Row("velocity", reading, "sure", figures, "state unit, sign or gears of both")


def _rests(recording: Recording) -> Row:
    travel = np.ptp(recording.position, axis=0)
    rests = [
        name
        for name, size in zip(recording.joint_names, travel, strict=True)
        if size <= STUCK_MOVEMENT
    ]
    if not rests:
        return Row("motion", "every joint moves", "sure", f"at least {travel.min():.2g} rad or m")
    return Row("motion", f"never move: {', '.join(rests)}", "sure",
               f"less than {STUCK_MOVEMENT:g} rad or m",
               "record a motion of all joints, or fix these (--locked NAME)")  # fmt: skip


def _wraps(recording: Recording) -> Row:
    wrapped = recording.provenance.get(UNWRAPPED)
    if wrapped is None:
        return Row("wraps", "continuous, no wrap", "sure", "no step of a turn")
    return Row("wraps", f"wrapped by a turn, continued: {wrapped}", "sure", "steps of a turn")


def _range(recording: Recording, cell: Cell) -> Row:
    outside = outside_limits(recording.position, cell.joint_names, cell.urdf)
    if outside is None:
        return Row("range", "within the limits of the URDF", "sure", "every row of every joint")
    return Row("range", outside[0], "sure", "limits of the URDF", outside[1])


def _measured(recording: Recording, lines: Sequence[str]) -> Row:
    """Return whether positions are measured, by their noise and the lag of the velocity."""
    names = [line.partition(": ")[0] for line in lines if ": position" in line]
    if any(COMMANDED.search(name) for name in names):
        return Row("positions", "commanded", "likely", "by the name",
                   "record the measured ones if the controller has them")  # fmt: skip
    quiet = noiseless_above(recording.time, recording.position, recording.segments())
    lag = velocity_lag(recording)
    if lag is not None and lag > 0.0:
        return Row("positions", "commanded", "likely",
                   f"the velocity comes {1e3 * lag:.0f} ms after their slope",
                   "record the measured ones")  # fmt: skip
    if quiet is None:
        return Row("positions", "measured", "sure", "noise of an encoder at all frequencies")
    return Row("positions", f"low-passed below {quiet:.2g} Hz, or commanded", "open",
               "no noise above that frequency", "ask for the raw encoder positions")  # fmt: skip


def velocity_lag(recording: Recording) -> float | None:
    """Return by how much the velocity comes after the slope of the positions [s].

    None without a velocity, without a common lag, or if the two come together.
    """
    if recording.velocity is None or recording.n_samples < 32:
        return None
    step = float(np.median(np.diff(recording.time)))
    even = np.arange(recording.time[0], recording.time[-1], step)
    most = max(2, round(_LONGEST_LAG / step))
    if len(even) <= 4 * most or not step > 0.0:
        return None
    lags = []
    for position, velocity in zip(recording.position.T, recording.velocity.T, strict=True):
        if np.ptp(position) <= STUCK_MOVEMENT:
            continue
        q = np.interp(even, recording.time, position)
        moved = np.cumsum(np.interp(even, recording.time, velocity)) * step
        lags.append(_lag(q, moved, most))
    delays = np.array([lag for lag in lags if lag is not None]) * step
    if delays.size < 2:
        return None
    lag = float(np.median(delays))
    alike = np.abs(delays - lag) <= max(step, 0.25 * abs(lag))
    clear = abs(lag) > _CLEAR_LAG * step and np.mean(alike) > 0.5
    return lag if clear else None


def _lag(first: Array, second: Array, most: int) -> float | None:
    """Return the steps by which the second signal comes after the first; None if unlike."""
    inner = slice(most, len(first) - most)
    reference = first[inner] - first[inner].mean()
    scores = []
    for lag in range(-most, most + 1):
        moved = second[most + lag : len(second) - most + lag]
        moved = moved - moved.mean()
        size = np.linalg.norm(reference) * np.linalg.norm(moved)
        scores.append(float(reference @ moved / size) if size > 0.0 else 0.0)
    best = int(np.argmax(scores))
    if scores[best] < _HIGHEST_CORRELATION or best in (0, 2 * most):
        return None
    left, middle, right = scores[best - 1 : best + 2]
    bend = left - 2.0 * middle + right
    return best - most + (0.5 * (left - right) / bend if bend < 0.0 else 0.0)
