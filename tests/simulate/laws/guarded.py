"""Set-points satisfy the bounds of the guard, and are sent only where allowed.

Checked are differences of the float64 set-points in the records, and of the float32 numbers on the
wire with their rounding. The wider bounds of an override or a stop apply only after a request.

A set-point that the controller has not accepted is sent again with the same position and velocity,
so that no set-point is more than a step from the controller's target. Rates are those of the motion
without repetitions.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from drivers.events import AnswersLost, MotionEnded
from tests.simulate.observed import Observed

from .conversation import talks_of
from .open_mode import Stretch, stretches
from .wire import Array, Flags, Gears

_TOLERANCE: Final = 1e-6
"""Relative tolerance of limits (`docs/interpolator.md`, `drivers.guard`)."""
_EPS: Final = float(np.finfo(np.float64).eps)
_STANDSTILL: Final = 5e-4
"""Motor revolutions per cycle: two increments of a 12-bit encoder (`drivers.guard`)."""
_FLOAT32: Final = float(np.finfo(np.float32).eps)
"""Motor revolutions per cycle: rounding of a step in float32."""
_SLOW: Final = 4.0 * _STANDSTILL
"""Largest step of which several are allowed in one cycle (`drivers.open_mode`)."""
_FIRST: Final = 0.1
"""Largest initial difference of target and arm, as a share of the following-error threshold."""
_LEAP: Final = 0.25
"""Largest difference of the controller's target from the last set-point, as such a share."""
_SPREAD: Final = 2
"""Cycles per missed packet in which a motion returns to its path (`drivers.open_mode`)."""
_RETURN: Final = 0.03  # longest return [s]
_ORDERS: Final = ("velocity", "acceleration", "jerk")


def guard(observed: Observed) -> Iterator[str]:
    """Check the law of this module."""
    gears = Gears.of(observed.cell.drive_table)
    limits = _Limits.of(observed.cell)
    for talk in talks_of(observed):
        life = 1 + observed.runs.index(talk.life)
        for stretch in (part for whole in stretches(talk) for part in _parts(whole)):
            for text in _in_stretch(stretch, limits, gears, observed.cell.period):
                at = stretch.at
                yield f"life {life}, packets {at[0]} to {at[-1]}: {text}"


def _parts(stretch: Stretch) -> Iterator[Stretch]:
    """Split at long gaps during which the controller extrapolated the motion.

    The next part continues from the received target and its velocity, as if these had been sent.
    """
    most = int(stretch.talk.life.settings.get("max_gap", 2))
    moved = np.append(False, (stretch.step[:-1] != 0.0).any(axis=1))
    gaps = stretch.talk.records["gap"][stretch.rows].astype(np.intp)
    # Superseded packets in the gap count once; twice if the session received them with a corrupted
    # number, which is visible only if a set-point continues from the target or rests there.
    twice = _unanswered_before(stretch)
    once = np.maximum(gaps, twice - gaps)
    before = np.concatenate((stretch.sent[:1], stretch.sent[:-1]))
    begun = stretch.sent - stretch.step  # start of each step
    off_target = np.abs(begun - stretch.received[0]).max(axis=1)
    off_before = np.abs(begun - before).max(axis=1)
    rounding = np.spacing(np.abs(begun).max(axis=1).astype(np.float32))
    rests = (np.abs(stretch.step).max(axis=1) <= rounding) & (off_target <= rounding)
    led = rests | (off_target < off_before)
    missed = np.where((once <= most) & led & ~stretch.again, twice, once)
    cuts = np.flatnonzero((missed > most) & moved)
    cuts = cuts[cuts < stretch.leading]
    for first, last in pairwise((0, *cuts.tolist(), len(stretch.sent))):
        yield replace(
            stretch,
            rows=slice(stretch.rows.start + first, stretch.rows.start + last),
            leading=min(stretch.leading, last) - first,
            sent=stretch.sent[first:last],
            step=stretch.step[first:last],
            received=stretch.received[:, first:last],
            carried=int(missed[first]) if first else 0,
            before=stretch.sent[first - 1] if first else stretch.sent[0],
            step_before=stretch.step[first - 1] if first else stretch.step[0],
        )


@dataclass(frozen=True, eq=False)
class _Limits:
    """Limits of the cell file, (n,) each, and their (acceleration, jerk) factors."""

    lower: Array
    upper: Array
    rates: Array
    following: Array
    current: Array
    override: tuple[float, float]
    stop: tuple[float, float]

    @classmethod
    def of(cls, cell: Any) -> _Limits:
        limits, bounds, drives = cell.joint_limits, cell.file.bounds, cell.drive_table
        return cls(
            np.array(limits.lower),
            np.array(limits.upper),
            np.array([limits.velocity, limits.acceleration, limits.jerk]),
            np.array(drives.following_error, float),
            np.array(drives.current_limit, float),
            (bounds.override.acceleration, bounds.override.jerk),
            (bounds.stop.acceleration, bounds.stop.jerk),
        )

    def factors(self, stopping: Flags, overridden: Flags) -> Array:
        """(k, 3) on velocity, acceleration and jerk."""
        factors = np.ones((len(stopping), 3))
        factors[overridden, 1:] = self.override
        factors[stopping, 1:] = self.stop
        return factors


def _in_stretch(stretch: Stretch, limits: _Limits, gears: Gears, period: float) -> Iterator[str]:
    threshold = np.fmin(limits.following, stretch.talk.init.threshold)
    current = np.fmin(limits.current, stretch.talk.init.current)
    yield from _led_on(stretch, threshold) if stretch.carried else _first(stretch, threshold)
    yield from _feedback(stretch, threshold, current)
    led = slice(0, stretch.leading)
    factors = limits.factors(*_asked_for(stretch))
    q = recorded = stretch.talk.records["commanded_position"][stretch.rows][led]
    if not np.isfinite(q).all():
        yield "a set-point was sent, and its record has none"
        return
    yield from _sent_as_recorded(stretch, q, gears)
    span = 0.5 * (limits.upper - limits.lower) * _TOLERANCE
    if np.any(q > limits.upper + span) or np.any(q < limits.lower - span):
        yield f"a set-point outside the joints' range: {q.min(axis=0)} to {q.max(axis=0)}"
    fresh = ~stretch.again[led]
    q, factors = q[fresh], np.concatenate((factors[led][fresh], factors[stretch.leading :]))
    # The first held rows end the motion and must not be a jump.
    after = min(3, len(stretch.sent) - stretch.leading)
    held = np.concatenate((q, q[-1:].repeat(after, axis=0)))
    record_rounding = np.full_like(held, 8.0 * _EPS) * np.abs(held).max(axis=0)
    before = np.zeros((3, 1)) + held[:1]
    if stretch.carried:
        # Steps without acceleration; the motion returns to its path within a few cycles.
        factors[: min(_SPREAD * stretch.carried, round(_RETURN / period)) + 2, 2] = np.inf
        before = np.arange(2.0, -1.0, -1.0)[:, np.newaxis] * -stretch.received[1, 0]
        before = gears.joint(stretch.received[0, 0] + before)
    yield from _rates(before, held, limits.rates, factors, record_rounding, period, "recorded")
    motor = stretch.sent[led][fresh]
    wire = gears.joint(motor)
    ulps = 0.5 * np.spacing(np.abs(motor).astype(np.float32)).astype(np.float64)
    wire_rounding = ulps @ np.abs(np.linalg.inv(gears.matrix)).T
    before = before if stretch.carried else np.zeros((3, 1)) + wire[:1]
    yield from _rates(before, wire, limits.rates, factors, wire_rounding, period, "float32")
    yield from _only_when_requested(stretch, recorded)
    yield from _no_leap(stretch)
    yield from _after_long_gaps(stretch)
    yield from _held_at_the_end(stretch)


def _rates(
    before: Array,
    q: Array,
    rates: Array,
    factors: Array,
    rounding: Array,
    period: float,
    what: str,
) -> Iterator[str]:
    """Rates of set-points (k, n) with `rounding` (k, n) [rad], after three previous rows."""
    rows = np.concatenate((before, q))
    worst = rounding.max(axis=0)
    for order, (name, bound) in enumerate(zip(_ORDERS, rates, strict=True), 1):
        found = np.abs(np.diff(rows, order, axis=0)[3 - order :]) / period**order
        allowed = factors[: len(found), order - 1 : order] * bound * (1.0 + _TOLERANCE)
        if len(allowed) < len(found):  # rows held after the motion
            more = allowed[-1:].repeat(len(found) - len(allowed), axis=0)
            allowed = np.concatenate((allowed, more))
        over = found > allowed + 2.0**order * worst / period**order
        if over.any():
            row, joint = (int(index[0]) for index in np.nonzero(over))
            yield (
                f"{name} of joint {joint + 1} in the {what} set-points is {found[row, joint]:.9g}, "
                f"allowed is {allowed[row, joint]:.9g} (row {row})"
            )


def _asked_for(stretch: Stretch) -> tuple[Flags, Flags]:
    """Rows after a request of a stop or hold, and of an override, (k,) each.

    The session also stops after a long gap or lost answers.
    """
    life, talk, at = stretch.talk.life, stretch.talk, stretch.at
    requests = [a.before for a in life.acts if a.name == "request" and a.before <= at[-1]]
    begun = max(requests, default=0)
    stopping, overridden = np.zeros(len(at), np.bool_), np.zeros(len(at), np.bool_)
    for act in life.acts:
        if begun <= act.before:
            if act.name in ("stop", "hold", "resume"):
                stopping |= at >= act.before
            elif act.name == "override":
                overridden |= at >= act.before
    most = int(life.settings.get("max_gap", 2))
    stopping |= np.logical_or.accumulate(_unanswered_before(stretch) > most)
    lost = np.zeros(len(at))
    first = int(talk.records["cycle"][stretch.rows][0])
    for event in talk.events:
        if isinstance(event, AnswersLost) and event.cycle >= first:
            lost += np.where(at >= talk.at_cycle(event.cycle), event.count, 0)
    return stopping | (lost > most), overridden


def _unanswered_before(stretch: Stretch) -> NDArray[np.intp]:
    """(k,) packets before each that did not arrive or were not answered."""
    talk = stretch.talk
    gaps = talk.records["gap"][stretch.rows].astype(np.intp)
    start = stretch.rows.start
    before = talk.index[start - 1] if start else talk.at
    # Packets in between without a record were not answered.
    silent = np.diff(stretch.at, prepend=before) - 1
    return np.asarray(gaps + silent)


def _first(stretch: Stretch, threshold: Array) -> Iterator[str]:
    """The first set-point is the received target, at rest, at the arm."""
    target, velocity, actual, actual_velocity = stretch.received[:4, 0]
    if np.any(stretch.sent[0] != target) or np.any(stretch.step[0] != 0.0):
        yield "the first set-point is not the target received at zero velocity"
    if np.any(np.abs(target - actual) > _FIRST * threshold * (1.0 + _TOLERANCE)):
        yield f"the first set-point is {np.abs(target - actual)} off the arm"
    if np.any(np.abs(np.array((velocity, actual_velocity))) > _STANDSTILL):
        yield "the first set-point was sent to an arm or a target in motion"


def _led_on(stretch: Stretch, threshold: Array) -> Iterator[str]:
    """After a long gap a motion resumes only from where the controller extrapolated it."""
    target, velocity, actual, measured = stretch.received[:4, 0]
    step, slack = stretch.step_before, _FLOAT32 + _STANDSTILL
    ahead = stretch.before + np.arange(stretch.carried + 1)[:, np.newaxis] * step
    wide = threshold * (1.0 + 2.0 * _TOLERANCE)
    if not (np.abs(target - ahead) <= _FIRST * wide).all(axis=1).any():
        yield "a motion was resumed after a long gap from a target that is off its path"
    if np.any(np.abs(actual - target) > wide):
        yield "a motion was resumed after a long gap with an arm that does not follow"
    # At speeds below standstill, only the target shows whether it was held.
    led = np.abs(target - stretch.before) > np.spacing(np.abs(target).astype(np.float32))
    rests = np.all(np.abs(velocity) <= slack) and ((np.abs(step) > slack).any() or not led.any())
    if rests and np.any(np.abs(stretch.sent[0] - target) > slack):
        yield "a motion was resumed after a long gap though the controller had brought it to rest"
    off = np.abs(velocity - step) > np.maximum(0.5 * np.abs(step), slack)
    off |= (np.abs(measured) <= _STANDSTILL) & (np.abs(step) > 2.0 * slack)
    if off.any() and not rests:
        yield "a motion was resumed after a long gap though the controller had not extrapolated it"


def _feedback(stretch: Stretch, threshold: Array, current: Array) -> Iterator[str]:
    """Set-points are sent only while the arm follows and the controller accepts them."""
    led = slice(1, stretch.leading)
    target, _, actual, _, amperes = stretch.received[:, led]
    last = stretch.sent[: stretch.leading - 1]
    wide = threshold * (1.0 + 2.0 * _TOLERANCE)
    if np.any(np.abs(actual - target) > wide) or np.any(np.abs(actual - last) > wide):
        yield "a set-point was sent to an arm that does not follow"
    if np.any(np.abs(amperes) > current * (1.0 + 2.0 * _TOLERANCE)):
        yield "a set-point was sent to a motor beyond its current limit"
    if np.any(np.abs(target - last) > _LEAP * wide):
        yield "a set-point was sent although the controller's target is elsewhere"
    nearest = _distance_to_last(stretch)
    if np.any(nearest > _FIRST * wide):
        row = int(np.argmax((nearest > _FIRST * wide).any(axis=1)))
        yield f"a set-point was sent to a target that is none of the last (row {row + 1})"


def _after_long_gaps(stretch: Stretch) -> Iterator[str]:
    """After more than `max_gap` missed packets, set-points only if the controller extrapolated."""
    talk, k = stretch.talk, stretch.leading
    most = int(talk.life.settings.get("max_gap", 2))
    records = talk.records[stretch.rows][:k]
    long = np.flatnonzero(records["gap"][1:] > most) + 1
    if not long.size:
        return
    step, standstill = stretch.step[long - 1], _STANDSTILL
    allowed = np.maximum(0.5 * np.abs(step), standstill) * (1.0 + _TOLERANCE) + _FLOAT32
    _, velocity, _, measured, _ = stretch.received[:, long]
    stands = np.abs(measured) <= standstill
    held = np.abs(velocity - step) > allowed
    held |= stands & (np.abs(measured - step) > allowed)
    if held.any():
        yield "a motion was resumed after a long gap though the controller had not extrapolated it"


def _distance_to_last(stretch: Stretch) -> Array:
    """(k-1, n) distance of each received target from the nearest possible set-point."""
    depth = int(stretch.talk.life.settings.get("max_gap", 2)) + 1
    k = stretch.leading
    fresh = ~stretch.again[:k]
    first = stretch.received[0, :1] if stretch.carried else stretch.sent[:1]
    sent = np.concatenate((first, stretch.sent[:k][fresh]))
    target = stretch.received[0, 1:k]
    last = np.cumsum(fresh)[: k - 1]
    nearest = np.full(target.shape, np.inf)
    for back in range(depth):
        nearest = np.fmin(nearest, np.abs(target - sent[np.maximum(last - back, 0)]))
    missed = np.minimum(_unanswered_before(stretch)[1:k], depth - 1)
    step = sent[last] - sent[np.maximum(last - 1, 0)]
    for ahead in range(1, depth):
        carried = np.abs(target - (sent[last] + ahead * step))
        nearest = np.where((missed >= ahead)[:, np.newaxis], np.fmin(nearest, carried), nearest)
    return nearest


def _no_leap(stretch: Stretch) -> Iterator[str]:
    """A set-point is at most its step from the one nearest to the target.

    Not checked after missed packets, in which the controller may extrapolate, and during stops;
    several slow steps are allowed.
    """
    k, depth = stretch.leading, int(stretch.talk.life.settings.get("max_gap", 2)) + 1
    fresh = ~stretch.again[:k]
    sent = stretch.sent[:k][fresh]
    last = np.cumsum(fresh)[: k - 1] - 1
    rows = np.maximum(last - np.arange(depth + 1)[:, np.newaxis], 0)
    off = np.abs(sent[rows] - stretch.received[0, 1:k])
    target = np.take_along_axis(sent[rows], off.argmin(axis=0)[np.newaxis], axis=0)[0]
    away = np.abs(stretch.sent[1:k] - target)
    allowed = np.abs(stretch.step[1:k]).max(axis=1) + depth * _SLOW
    free = _asked_for(stretch)[0][1:k] | (_unanswered_before(stretch)[1:k] > 0)
    leaps = (away > allowed[:, np.newaxis]).any(axis=1) & ~free
    if leaps.any():
        row = int(np.argmax(leaps))
        yield f"a set-point is {away[row].max():.4g} from the target (row {row + 1})"


def _sent_as_recorded(stretch: Stretch, q: Array, gears: Gears) -> Iterator[str]:
    """D1 is the recorded set-point, D2 the step from the previous one, within rounding."""
    motor = gears.motor(q)
    # Rounding of two conversions, each a sum of n products.
    rounding = 8.0 * _EPS * np.maximum(1.0, np.abs(motor))
    low, high = np.float32(motor - rounding), np.float32(motor + rounding)
    sent = stretch.sent[: len(q)]
    if np.any(sent < low) or np.any(sent > high):
        yield "the set-point on the wire is not the recorded one"
    # A repeated set-point has its previous step.
    fresh = ~stretch.again[: len(q)]
    motor, rounding, stated = motor[fresh], rounding[fresh], stretch.step[: len(q)][fresh]
    first = stretch.received[0, :1] if stretch.carried else motor[:1]
    step = np.diff(motor, axis=0, prepend=first)
    slack = 3.0 * rounding + np.spacing(np.abs(stated).astype(np.float32))
    if stretch.carried:  # a motion at rest resumes from its own set-point
        slack[0] += np.spacing(np.abs(first[0]).astype(np.float32))
    if np.any(np.abs(stated - step) > slack):
        yield "D2 is not the step from one set-point to the next"


def _only_when_requested(stretch: Stretch, q: Array) -> Iterator[str]:
    """Set-points move only during a requested motion."""
    moves = np.flatnonzero((np.diff(q, axis=0, prepend=q[:1]) != 0.0).any(axis=1))
    if not moves.size:
        return
    at = stretch.at[moves]
    talk, acts = stretch.talk, stretch.talk.life.acts
    requests = np.array([a.before for a in acts if a.name == "request"], np.intp)
    cycles = [event.cycle for event in talk.events if isinstance(event, MotionEnded)]
    ends = np.array([talk.at_cycle(cycle) for cycle in cycles], np.intp)
    asked = np.searchsorted(requests, at, side="right") - 1
    if (asked < 0).any():
        yield "set-points move before any motion was requested"
        return
    last_end = np.searchsorted(ends, at, side="left") - 1
    ended = (last_end >= 0) & (ends[last_end] >= requests[asked]) if len(ends) else asked < 0
    if ended.any():
        yield f"set-points move after the motion had ended (packet {int(at[np.argmax(ended)])})"


def _held_at_the_end(stretch: Stretch) -> Iterator[str]:
    """While open mode is left, axes still open have the last set-point at zero velocity."""
    talk, led = stretch.talk, stretch.leading
    if led == len(stretch.sent):
        return
    slots = list(talk.init.slots or ())
    rows = slice(stretch.rows.start + led, stretch.rows.stop)
    mode = int(talk.life.settings.get("mode", 4))
    still_open = np.logical_and.accumulate(talk.received.mode[rows][:, slots] == mode, axis=0)
    moved = (stretch.sent[led:] != stretch.sent[led - 1]) | (stretch.step[led:] != 0.0)
    if np.any(still_open & moved):
        yield "an axis is not held while open mode is being left"
