"""The table every interpolated motion becomes: cubic pieces per joint, exactly integrable."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, Protocol

import numpy as np

from planner.arrays import Array
from planner.checked_data import DAMAGED, numbers, rows
from planner.errors import InvalidTrajectory


class Trajectory(Protocol):
    """A motion of all joints as a function of time, at rest at both ends."""

    @property
    def duration(self) -> float:
        """Length in time [s]."""
        ...

    @property
    def n_joints(self) -> int:
        """Number of joints."""
        ...

    def sample(self, t: Array) -> tuple[Array, Array, Array]:
        """Return q [rad], qd [rad/s], qdd [rad/s²] at the times `t` (m,), each (m, n).

        Outside [0, duration] the joints rest at the nearer end.
        """
        ...


class Extrema(NamedTuple):
    """The farthest a trajectory goes, per joint (n,), SI units; rates are magnitudes."""

    lower: Array
    upper: Array
    velocity: Array
    acceleration: Array
    jerk: Array


@dataclass(frozen=True, eq=False)
class PiecewiseCubic:
    """A motion of constant jerks: per joint its own knots and cubic pieces between them.

    Before time 0 and after `duration` the joints are assumed to rest where the motion begins and
    ends: sampled there, the position is held and velocity and acceleration are zero.

    Attributes:
        knots: Per joint (m_j + 1,) times [s], from 0 to the common duration, never falling.
        coefficients: Per joint (m_j, 4): position [rad], velocity [rad/s], acceleration
            [rad/s²] at the start of each piece, and its constant jerk [rad/s³].
    """

    knots: tuple[Array, ...]
    coefficients: tuple[Array, ...]

    def __post_init__(self) -> None:
        for array in (*self.knots, *self.coefficients):
            array.setflags(write=False)

    @property
    def duration(self) -> float:
        """Length in time [s]."""
        return float(self.knots[0][-1])

    @property
    def n_joints(self) -> int:
        """Number of joints."""
        return len(self.knots)

    def sample(self, t: Array) -> tuple[Array, Array, Array]:
        """Return q [rad], qd [rad/s], qdd [rad/s²] at the times `t` (m,), each (m, n)."""
        t = np.asarray(t, dtype=np.float64)
        within = np.clip(t, 0.0, self.duration)
        q, qd, qdd = np.empty((3, self.n_joints, t.size))
        for joint, (knots, coefficients) in enumerate(
            zip(self.knots, self.coefficients, strict=True)
        ):
            piece = np.searchsorted(knots[1:-1], within, side="right")
            p, v, a, j, start = np.vstack((coefficients.T, knots[:-1])).take(piece, axis=1)
            # In place throughout: fresh temporaries of this size cost more than the arithmetic.
            x = np.subtract(within, start, out=start)
            half = np.multiply(j, x, out=j)
            half *= 0.5
            np.add(a, half, out=qd[joint])
            np.add(qd[joint], half, out=qdd[joint])
            qd[joint] *= x
            qd[joint] += v
            half *= 1.0 / 3.0
            a *= 0.5
            half += a
            half *= x
            half += v
            half *= x
            np.add(half, p, out=q[joint])
        outside = within != t
        if np.any(outside):
            qd[:, outside] = 0.0
            qdd[:, outside] = 0.0
        return q.T, qd.T, qdd.T

    def sample_one(self, t: float) -> tuple[Array, Array, Array]:
        """Return q [rad], qd [rad/s], qdd [rad/s²] at one time `t` [s], each (n,)."""
        within = min(max(t, 0.0), self.duration)
        q, qd, qdd = np.zeros((3, self.n_joints))
        for joint, (knots, pieces) in enumerate(self._rows):
            piece = min(bisect_right(knots, within), len(pieces)) - 1
            p, v, a, j = pieces[piece]
            x = within - knots[piece]
            q[joint] = p + x * (v + x * (a * 0.5 + x * j * (1.0 / 6.0)))
            if within == t:
                qd[joint] = v + x * (a + x * j * 0.5)
                qdd[joint] = a + x * j
        return q, qd, qdd

    @cached_property
    def _rows(self) -> list[tuple[list[float], list[list[float]]]]:
        """Knots and coefficients as floats, which a single look-up reads fastest."""
        return [
            (knots.tolist(), coefficients.tolist())
            for knots, coefficients in zip(self.knots, self.coefficients, strict=True)
        ]

    def ends(self) -> tuple[Array, ...]:
        """Return position, velocity and acceleration at the end of each piece, (m_j, 3) each."""
        return tuple(
            _state_after(coefficients, np.diff(knots))
            for knots, coefficients in zip(self.knots, self.coefficients, strict=True)
        )

    def extrema(self) -> Extrema:
        """Return the extremes over all time, from the roots of each piece, not from samples."""
        first = np.cumsum([0, *(len(c) for c in self.coefficients[:-1])])
        pieces = np.concatenate(self.coefficients)
        length = np.concatenate([np.diff(knots) for knots in self.knots])
        _, v, a, j = pieces.T
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            fastest = -a / j
            # Roots of v + a x + j x²/2 in the form that loses no digits when j is small.
            root = -(a + np.copysign(np.sqrt(a * a - 2.0 * j * v), a))
            times = np.stack((root / j, 2.0 * v / root, fastest, length, np.zeros_like(length)))
        # Any time inside its piece is a fair sample, so a root that does not exist may be that.
        states = _state_after(pieces, np.fmax(np.fmin(times, length), 0.0))
        low, high = states.min(axis=0), states.max(axis=0)
        largest = np.maximum.reduceat(np.maximum(-low, high), first)
        return Extrema(
            lower=np.minimum.reduceat(low[:, 0], first),
            upper=np.maximum.reduceat(high[:, 0], first),
            velocity=largest[:, 1],
            acceleration=largest[:, 2],
            jerk=np.maximum.reduceat(np.abs(j), first),
        )

    def restricted(self, start: float, stop: float) -> PiecewiseCubic:
        """Return the part between the times `start` <= `stop` [s], beginning at its own time 0."""
        knots, coefficients = [], []
        for times, pieces in zip(self.knots, self.coefficients, strict=True):
            first = int(np.clip(np.searchsorted(times, start, "right") - 1, 0, len(pieces) - 1))
            last = max(int(np.searchsorted(times, stop, "left")), first + 1)
            part = pieces[first:last].copy()
            part[0, :3] = _state_after(part[:1], start - times[first])[0]
            coefficients.append(part)
            knots.append(np.concatenate(([start], times[first + 1 : last], [stop])) - start)
        return PiecewiseCubic(tuple(knots), tuple(coefficients))

    def to_dict(self) -> dict[str, Any]:
        """Return lists; `from_dict` restores every bit, through JSON too."""
        return {
            "type": "piecewise_cubic",
            "knots": [knots.tolist() for knots in self.knots],
            "coefficients": [coefficients.tolist() for coefficients in self.coefficients],
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> PiecewiseCubic:
        """Restore a trajectory from `to_dict`.

        Raises:
            InvalidTrajectory: a field is missing, or is not the table that it should be.
        """
        try:
            kind = data.get("type")
            if kind != "piecewise_cubic":
                raise InvalidTrajectory(f"type is {kind!r:.80}; expected 'piecewise_cubic'")
            knots = tuple(numbers(row, 1) for row in rows(data["knots"]))
            coefficients = tuple(numbers(row, 2) for row in rows(data["coefficients"]))
        except InvalidTrajectory:
            raise
        except DAMAGED as error:
            raise InvalidTrajectory(f"not a table of cubic pieces: {error!r}") from error
        _check_table(knots, coefficients)
        return cls(knots, coefficients)

    @classmethod
    def from_jerks(cls, start: Array, knots: Array, jerks: Array) -> PiecewiseCubic:
        """Integrate constant jerks.

        Args:
            start: Position, velocity and acceleration at time 0, (n, 3).
            knots: Times from 0 at which each joint's jerk changes, (n, m + 1) [s].
            jerks: Constant jerks between them, (n, m) [rad/s³].
        """
        coefficients = []
        for state, times, row in zip(start.tolist(), knots.tolist(), jerks.tolist(), strict=True):
            p, v, a = state
            pieces = []
            for begin, end, j in zip(times, times[1:], row, strict=False):
                pieces.append((p, v, a, j))
                x = end - begin
                p += x * (v + x * (a * 0.5 + x * j * (1.0 / 6.0)))
                v += x * (a + x * j * 0.5)
                a += x * j
            coefficients.append(np.array(pieces))
        return cls(tuple(np.array(knots)), tuple(coefficients))


def concatenate(parts: Sequence[PiecewiseCubic]) -> PiecewiseCubic:
    """Return the parts, at least one, one after the other."""
    offsets = np.cumsum([0.0, *(part.duration for part in parts[:-1])])
    joints = range(parts[0].n_joints)
    return PiecewiseCubic(
        knots=tuple(
            np.concatenate(
                [
                    [0.0],
                    *(part.knots[j][1:] + t for part, t in zip(parts, offsets, strict=True)),
                ]
            )
            for j in joints
        ),
        coefficients=tuple(
            np.concatenate([part.coefficients[j] for part in parts]) for j in joints
        ),
    )


def _state_after(pieces: Array, x: Array) -> Array:
    """Return q, qd, qdd (..., m, 3) at times `x` (..., m) since the start of pieces (m, 4)."""
    p, v, a, j = pieces.T
    return np.stack(
        (
            p + x * (v + x * (a * 0.5 + x * j * (1.0 / 6.0))),
            v + x * (a + x * j * 0.5),
            a + x * j,
        ),
        axis=-1,
    )


def _check_table(knots: Sequence[Array], coefficients: Sequence[Array]) -> None:
    if not knots or len(knots) != len(coefficients):
        raise InvalidTrajectory(
            f"knots of {len(knots)} joints and coefficients of {len(coefficients)}; "
            "expected as many of each, at least one"
        )
    for joint, (times, pieces) in enumerate(zip(knots, coefficients, strict=True)):
        if times.ndim != 1 or len(times) < 2 or pieces.shape != (len(times) - 1, 4):
            raise InvalidTrajectory(
                f"joint {joint}: knots {times.shape} and coefficients {pieces.shape}; "
                "expected (m + 1,) and (m, 4) with m >= 1"
            )
        if not (np.all(np.isfinite(times)) and np.all(np.isfinite(pieces))):
            raise InvalidTrajectory(f"joint {joint}: knots and coefficients must be finite")
        if times[0] != 0.0 or np.any(np.diff(times) < 0.0) or times[-1] != knots[0][-1]:
            raise InvalidTrajectory(
                f"joint {joint}: knots must rise from 0 to the duration common to all joints"
            )
