"""Laws of the set-points that a session sends, whatever link carries them."""

from __future__ import annotations

from typing import Protocol

import numpy as np

EPS = np.finfo(np.float64).eps


class Bounds(Protocol):
    """Limits (n,) of joint positions, rad, and of their derivatives, with the guard's factors."""

    lower: np.ndarray
    upper: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray
    jerk: np.ndarray
    override_acceleration: float
    override_jerk: float
    stop_acceleration: float
    stop_jerk: float


class SetPointLaws:
    """Bounds of the set-points sent one after the other, of which none moves uninvited.

    Attributes:
        limits: of the guard.
        period: s, the controller's cycle.
        entitled: a motion was requested and accepted, and has not ended.
        stopping: a stop was asked for in this interval, or losses are one.
        held: a hold, or its end, was asked for in this interval; the bounds are those of a stop.
        overridden: a change of override was accepted in this interval.
        without_jerk_bound: set-points for which jerk is not bounded: after a gap, or losses.
        sent: the last set-points, (n,) each, rad.
        tally: how often each law was applied.
    """

    limits: Bounds
    period: float
    entitled: bool
    stopping: bool
    held: bool
    overridden: bool
    without_jerk_bound: int
    sent: list[np.ndarray]
    tally: dict[str, int]

    def _count(self, what: str) -> None:
        self.tally[what] = self.tally.get(what, 0) + 1

    def _factors(self) -> tuple[float, float]:
        """Return the factors on acceleration and jerk."""
        limits = self.limits
        if self.stopping or self.held:
            return limits.stop_acceleration, limits.stop_jerk
        if self.overridden:
            return limits.override_acceleration, limits.override_jerk
        return 1.0, 1.0

    def _differences(self, rows: np.ndarray, first_order: int, noise: float = 0.0) -> None:
        """Of the last four rows of a position (first order 1) or of a velocity (0)."""
        factor_a, factor_j = self._factors()
        limits = self.limits
        bounds = (limits.velocity, factor_a * limits.acceleration, factor_j * limits.jerk)
        for k, (bound, name) in enumerate(
            zip(bounds, ("velocity", "acceleration", "jerk"), strict=True)
        ):
            order = first_order + k
            if name == "jerk" and self.without_jerk_bound:
                self.without_jerk_bound -= 1
                continue
            rates = np.abs(np.diff(rows, order, axis=0)[-1]) / self.period**order
            rounding = 2**order * (8 * EPS * np.abs(rows).max() + noise) / self.period**order
            assert (rates <= bound * (1 + 2e-6) + rounding).all(), (name, rates / bound)

    def _advance(self, row: np.ndarray, first_order: int, noise: float) -> None:
        self.sent.append(row)
        self._differences(np.array(self.sent[-4:]), first_order, noise)
        del self.sent[:-3]

    def _within(self, q: np.ndarray) -> None:
        """Check a set-point, the last of `sent`, against the range and those before."""
        if np.any(q != self.sent[-2]):
            assert self.entitled, "moved without a motion requested"
            self._count("moving")
        self._differences(np.array(self.sent[-4:]), first_order=1)
        span = 0.5 * (self.limits.upper - self.limits.lower)
        assert (q >= self.limits.lower - 2e-6 * span).all(), "position"
        assert (q <= self.limits.upper + 2e-6 * span).all(), "position"
