"""Motions as cubic pieces of each joint: the form of every interpolated motion."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from planner.arrays import DAMAGED_DATA_ERRORS, Array, numbers
from planner.errors import InvalidTrajectory, LimitExceeded, NotSmooth
from planner.limits import Allowance, Bounds, jump_rounding, position_rounding

Mask = NDArray[np.bool_]
Rows = NDArray[np.intp]


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
    """Extremes of a trajectory per joint (n,), SI units; rates are magnitudes."""

    lower: Array
    upper: Array
    velocity: Array
    acceleration: Array
    jerk: Array


class WithExtrema(Protocol):
    """A motion whose extremes are known."""

    def extrema(self) -> Extrema:
        """Return the extremes over all time."""
        ...


@dataclass(frozen=True, eq=False)
class PiecewiseCubic:
    """A motion of piecewise constant jerk, with separate knots for each joint.

    Before time 0 and after `duration` the joints rest at the first and last position.

    Attributes:
        knots: Times (m_j + 1,) [s] per joint, from 0 to the common duration, not decreasing.
        coefficients: Per joint (m_j, 4): position [rad], velocity [rad/s], acceleration
            [rad/s²] at the start of each piece, and its jerk [rad/s³].
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
            # In place: temporaries of this size cost more than the arithmetic.
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
            state = after(pieces[piece], within - knots[piece])
            q[joint] = state[0]
            if within == t:
                qd[joint], qdd[joint] = state[1:]
        return q, qd, qdd

    @cached_property
    def _rows(self) -> list[tuple[list[float], list[list[float]]]]:
        """Knots and coefficients as floats, the fastest for a single look-up."""
        return [
            (knots.tolist(), coefficients.tolist())
            for knots, coefficients in zip(self.knots, self.coefficients, strict=True)
        ]

    def ends(self) -> tuple[Array, ...]:
        """Return position, velocity and acceleration at the end of each piece, (m_j, 3) each."""
        return tuple(
            np.stack(after(pieces.T, np.diff(knots)), axis=-1)
            for knots, pieces in zip(self.knots, self.coefficients, strict=True)
        )

    def extrema(self) -> Extrema:
        """Return the extremes over all time, from the roots of each piece."""
        return self._extrema

    @cached_property
    def _extrema(self) -> Extrema:
        first = np.cumsum([0, *(len(c) for c in self.coefficients[:-1])])
        pieces = np.concatenate(self.coefficients)
        reach = _reach(pieces, np.concatenate([np.diff(knots) for knots in self.knots]))
        largest = (np.maximum.reduceat(values, first) for values in reach[1:])
        return Extrema(np.minimum.reduceat(reach.lower, first), *largest)

    def to_dict(self) -> dict[str, Any]:
        """Return lists, from which `from_dict` restores the same bits, also through JSON."""
        return {
            "type": "piecewise_cubic",
            "knots": [knots.tolist() for knots in self.knots],
            "coefficients": [coefficients.tolist() for coefficients in self.coefficients],
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> PiecewiseCubic:
        """Restore a trajectory from `to_dict`.

        Raises:
            InvalidTrajectory: a field is missing or invalid.
        """
        try:
            if (kind := data["type"]) != "piecewise_cubic":
                raise InvalidTrajectory(f"type is {kind!r:.80}; expected 'piecewise_cubic'")
            knots = tuple(numbers(row, 1) for row in data["knots"])
            coefficients = tuple(numbers(row, 2) for row in data["coefficients"])
            _check_table(knots, coefficients)
        except InvalidTrajectory:
            raise
        except DAMAGED_DATA_ERRORS as error:
            raise InvalidTrajectory(f"not a table of cubic pieces: {error!r:.200}") from error
        return cls(knots, coefficients)


def _check_table(knots: Sequence[Array], coefficients: Sequence[Array]) -> None:
    if not knots or len(knots) != len(coefficients):
        raise InvalidTrajectory(
            f"knots of {len(knots)} joints and coefficients of {len(coefficients)}; "
            "expected as many of each, at least one"
        )
    for joint, (times, pieces) in enumerate(zip(knots, coefficients, strict=True)):
        if len(times) < 2 or pieces.shape != (len(times) - 1, 4):
            shapes = f"knots {times.shape}, coefficients {pieces.shape}"
            raise InvalidTrajectory(
                f"joint {joint}: {shapes}; expected (m + 1,) and (m, 4), m >= 1"
            )
        if not (np.all(np.isfinite(times)) and np.all(np.isfinite(pieces))):
            raise InvalidTrajectory(f"joint {joint}: knots and coefficients must be finite")
        if times[0] != 0.0 or np.any(np.diff(times) < 0.0) or times[-1] != knots[0][-1]:
            raise InvalidTrajectory(
                f"joint {joint}: knots must rise from 0 to the duration common to all joints"
            )


class Block(NamedTuple):
    """Cubic pieces of many motions, the same number m for every joint of each.

    `knots` (c, n, m + 1) [s] and `coefficients` (c, n, m, 4) are as of a `PiecewiseCubic`; `end` is
    position, velocity, acceleration at the end, (c, n, 3).
    """

    knots: Array
    coefficients: Array
    end: Array

    @classmethod
    def from_jerks(cls, start: Array, knots: Array, jerks: Array) -> Self:
        """Integrate constant jerks (c, n, m) between knots (c, n, m + 1) from states (c, n, 3)."""
        x = knots[..., 1:] - knots[..., :-1]
        states = np.empty((*knots.shape, 3))
        states[..., 0, :] = start
        # In the order of operations of `after`, so that pieces meet to the last bit.
        jx = jerks * x
        states[..., 1:, 2] = jx
        p, v, a = (states[..., i] for i in range(3))
        np.cumsum(a, axis=-1, out=a)
        v[..., 1:] = x * (a[..., :-1] + jx * 0.5)
        np.cumsum(v, axis=-1, out=v)
        p[..., 1:] = x * (v[..., :-1] + x * (a[..., :-1] * 0.5 + jx * (1.0 / 6.0)))
        np.cumsum(p, axis=-1, out=p)
        pieces = np.concatenate((states[..., :-1, :], jerks[..., None]), axis=-1)
        return cls(knots, pieces, states[..., -1, :])

    @classmethod
    def of_pieces(cls, knots: Array, coefficients: Array) -> Self:
        """Return a block of pieces, with its end computed."""
        last = np.moveaxis(coefficients[..., -1, :], -1, 0)
        end = np.stack(after(last, knots[..., -1] - knots[..., -2]), axis=-1)
        return cls(knots, coefficients, end)

    @property
    def durations(self) -> Array:
        """Length in time of each motion (c,) [s]."""
        last: Array = self.knots[:, 0, -1]
        return last

    def take(self, rows: Rows | Mask) -> Block:
        """Return motions by index or mask."""
        return Block(*(field[rows] for field in self))

    def satisfies(self, bounds: Allowance) -> Mask:
        """Whether each motion satisfies its bounds (c, n) at every instant, (c,)."""
        reach = _reach(self.coefficients, np.diff(self.knots, axis=-1))
        slack = position_rounding(bounds)
        within = reach.lower.min(axis=-1) >= bounds.lower - slack
        within &= reach.upper.max(axis=-1) <= bounds.upper + slack
        for largest, bound in zip(reach[2:], bounds[2:], strict=True):
            within &= largest.max(axis=-1) <= bound
        respected: Mask = within.all(axis=-1)
        return respected

    def smooth(self, bounds: Allowance) -> Mask:
        """Whether each motion is C2 and at rest at both ends within rounding, (c,)."""
        pieces = np.moveaxis(self.coefficients, -1, 0)
        ends = np.stack(after(pieces, np.diff(self.knots, axis=-1)), axis=-1)
        starts = self.coefficients[..., :3]
        jumps = np.abs(starts[..., 1:, :] - ends[..., :-1, :]).max(axis=-2, initial=0.0)
        end_rates = np.maximum(np.abs(starts[..., 0, 1:]), np.abs(ends[..., -1, 1:]))
        jumps[..., 1:] = np.maximum(jumps[..., 1:], end_rates)
        smooth: Mask = np.all(jumps <= jump_rounding(bounds, self.durations), axis=(1, 2))
        return smooth

    def tables(self) -> list[PiecewiseCubic]:
        """Return each motion, without pieces of zero length."""
        real = np.diff(self.knots, axis=-1) > 0.0
        real[..., 0] |= ~real.any(axis=-1)
        ends = np.cumsum(real.sum(axis=-1), axis=None).tolist()
        times = self.knots[..., 1:][real]
        pieces = self.coefficients[real]
        tables = []
        begin = 0
        n_joints = real.shape[1]
        for row in range(0, len(ends), n_joints):
            knots = []
            coefficients = []
            for end in ends[row : row + n_joints]:
                knots.append(np.concatenate(([0.0], times[begin:end])))
                coefficients.append(pieces[begin:end].copy())
                begin = end
            tables.append(PiecewiseCubic(tuple(knots), tuple(coefficients)))
        return tables


def after(piece: Any, x: Any) -> tuple[Any, Any, Any]:
    """Return position, velocity, acceleration a time `x` into one piece or pieces (4, ...)."""
    p, v, a, j = piece
    return (
        p + x * (v + x * (a * 0.5 + x * j * (1.0 / 6.0))),
        v + x * (a + x * j * 0.5),
        a + x * j,
    )


def pieces_from(motion: PiecewiseCubic, joint: int, times: Array) -> Array:
    """Return coefficients (m, 4) of one joint as of pieces that start at times (m,) [s]."""
    knots = motion.knots[joint]
    piece = np.searchsorted(knots[1:-1], times, side="right")
    pieces = motion.coefficients[joint][piece].T
    return np.stack((*after(pieces, times - knots[piece]), pieces[3]), axis=1)


def _reach(pieces: Array, length: Array) -> Extrema:
    """Return the extremes of pieces (..., 4) of lengths (...) [s], from their roots, (...) each."""
    p, v, a, j = parts = np.moveaxis(pieces, -1, 0)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        fastest = -a / j
        # Roots of v + a x + j x²/2 in the form that loses no digits when j is small.
        root = -(a + np.copysign(np.sqrt(a * a - 2.0 * j * v), a))
        times = np.stack((root / j, 2.0 * v / root, fastest, length))
    # A root that does not exist is replaced by a time inside the piece, which changes no extreme.
    times = np.fmax(np.fmin(times, length), 0.0)
    position, velocity, acceleration = after(parts, times)
    return Extrema(
        np.minimum(p, position.min(axis=0)),
        np.maximum(p, position.max(axis=0)),
        np.maximum(np.abs(v), np.abs(velocity).max(axis=0)),
        np.maximum(np.abs(a), np.abs(acceleration[2:]).max(axis=0)),
        np.abs(j),
    )


def check_limits(trajectory: WithExtrema, limits: Bounds) -> None:
    """Check analytically that a trajectory satisfies its limits at every instant.

    Raises:
        LimitExceeded: of the first quantity that breaks its limit, with its worst joint.
    """
    extrema = trajectory.extrema()
    slack = position_rounding(limits)
    for quantity, end, sign in (
        ("position", "lower", -1.0),
        ("position", "upper", 1.0),
        *((rate, rate, 1.0) for rate in ("velocity", "acceleration", "jerk")),
    ):
        value = getattr(extrema, end)
        bound = getattr(limits, end)
        excess = sign * (value - bound) - (slack if quantity == "position" else 0.0)
        if not np.all(excess <= 0.0):  # written so that NaN is refused too
            joint = int(np.argmax(excess))
            raise LimitExceeded(quantity, joint, float(value[joint]), float(bound[joint]))


def check_smooth(trajectory: PiecewiseCubic, limits: Bounds) -> None:
    """Check that a trajectory is C2 and at rest at both ends.

    Raises:
        NotSmooth: it is not.
    """
    scale = jump_rounding(limits, trajectory.duration)
    for joint, ends in enumerate(trajectory.ends()):
        starts = trajectory.coefficients[joint][:, :3]
        rest_before = [[starts[0, 0], 0.0, 0.0]]
        rest_after = [[ends[-1, 0], 0.0, 0.0]]
        jumps = np.abs(np.concatenate((starts, rest_after)) - np.concatenate((rest_before, ends)))
        if not np.all(jumps <= scale[joint]):
            knot, which = np.unravel_index(int(np.argmax(jumps / scale[joint])), jumps.shape)
            raise NotSmooth(
                ("position", "velocity", "acceleration")[which],
                joint,
                float(trajectory.knots[joint][knot]),
                float(jumps[knot, which]),
            )


def check_rest(trajectory: Trajectory, limits: Bounds) -> None:
    """Check that a trajectory of any kind is at rest at both ends.

    Raises:
        NotSmooth: it has a velocity or acceleration there.
    """
    scale = jump_rounding(limits, trajectory.duration)[:, 1:]
    times = np.array([0.0, trajectory.duration])
    _, *rates = trajectory.sample(times)
    left = np.abs(np.stack(rates, axis=2))  # (2, n, 2)
    if not np.all(left <= scale):  # written so that NaN is refused too
        end, joint, which = np.unravel_index(int(np.argmax(left / scale)), left.shape)
        raise NotSmooth(
            ("velocity", "acceleration")[which],
            int(joint),
            float(times[end]),
            float(left[end, joint, which]),
        )
