"""What has to pass before a correction, or feed-forward, leaves.

A velocity fed forward and an offset from the controller's target are held to the same three sets
of bounds as set-points, by their differences from one answer to the next: the differences of a
velocity are mean accelerations and jerks, those of an offset one order further up. An offset is
held to those of a velocity as well, as if the controller added it up cycle by cycle; so is the
target together with it. A current has a limit and, per cycle, a largest step. Nothing is clamped.
"""

from __future__ import annotations

from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from drivers.checks import report, require, require_finite
from drivers.errors import (
    AccelerationLimit,
    CommandedCurrentLimit,
    CommandedCurrentStep,
    CorrectionNotCarriedOn,
    CorrectionNotEnded,
    GuardError,
    JerkLimit,
    PositionLimit,
    VelocityLimit,
)
from drivers.guard import RELATIVE_TOLERANCE, Guard
from drivers.guard_limits import RANK, BoundsInForce
from drivers.motion_source import BoundsName

Array = NDArray[np.float64]

_CHECKS: Final[tuple[type[GuardError], ...]] = (VelocityLimit, AccelerationLimit, JerkLimit)
_UNIT: Final = {"velocity": "rad/s", "offset": "rad"}


class CorrectionGuard:
    """Checks corrections of one arm, cycle by cycle, from zero to zero.

    Args:
        guard: whose limits and period apply.
        kind: what the motion part is: a "velocity" rad/s, or an "offset" rad of positions.
    """

    def __init__(self, guard: Guard, kind: Literal["velocity", "offset"]) -> None:
        self._guard = guard
        self._is_velocity = kind == "velocity"
        self._unit = _UNIT[kind]
        limits, T = guard.limits, guard.period
        n = limits.n_joints
        self._every = np.ones(n, dtype=np.bool_)
        first = np.array([0.0, 0.0, -1.0, 1.0])
        second = np.array([0.0, 1.0, -2.0, 1.0])
        third = np.array([-1.0, 3.0, -3.0, 1.0])
        itself = np.array([0.0, 0.0, 0.0, 1.0])
        as_velocity = np.array([itself, first / T, second / T**2])
        as_position = np.array([first / T, second / T**2, third / T**3])
        self._differences = (
            as_velocity if kind == "velocity" else np.vstack([as_position, as_velocity / T])
        )
        self._checks = _CHECKS * (len(self._differences) // 3)
        self._sets = {rank: self._bounds(rank) for rank in RANK.values()}
        self._in_force = BoundsInForce()
        self._history = np.zeros((4, n))
        self._quantities = np.zeros((len(self._differences), n))
        self._current = np.zeros(n)
        self._target = self._offset = self._sent_in = np.zeros(n)
        self._rise = T / limits.current_rise
        # What rounding leaves of a zero: a millionth of a limit, for an offset of one step.
        step = T if kind == "offset" else 1.0
        self._nothing = RELATIVE_TOLERANCE * limits.velocity * step

    def _bounds(self, rank: int) -> Array:
        limits = self._guard.limits
        factor_a, factor_j = limits.factors(rank)
        bounds = np.array([limits.velocity, factor_a * limits.acceleration, factor_j * limits.jerk])
        allowed = np.tile(bounds, (len(self._differences) // 3, 1))
        return allowed * (1.0 + RELATIVE_TOLERANCE)

    def begin(self) -> None:
        """Zero was sent."""
        self._history[...] = 0.0
        self._current[...] = 0.0
        self._in_force.reset()

    def check_motion(self, motion: Array, bounds: BoundsName, cycle: int) -> None:
        """The next velocity or offset (n,); if it passes, it counts as sent.

        Raises:
            NotFinite, VelocityLimit, AccelerationLimit, JerkLimit: it must not be sent.
        """
        history = self._history
        history[:3] = history[1:]
        history[3] = motion
        found = self._quantities
        np.matmul(self._differences, history, out=found)
        allowed = self._sets[self._in_force.take(bounds)]
        magnitude = np.abs(found)
        if not (magnitude <= allowed).all():
            report(magnitude, found, allowed, self._checks, cycle)

    @property
    def resting(self) -> bool:
        """Whether the velocities sent last are zero, or the offsets the same."""
        history = self._history
        rates = history if self._is_velocity else np.diff(history, axis=0)
        return bool((np.abs(rates) <= self._nothing).all())

    def note_target(self, target: Array, offset: Array, sent_in: Array) -> None:
        """The controller's target (n,) rad, the offset from it, the cycle each joint's is of."""
        self._target, self._offset, self._sent_in = target, offset, sent_in

    def check_target(
        self, target: Array, offset: Array, sent_in: Array, rounding: Array, cycle: int
    ) -> None:
        """How fast target and offset move the arm; if they pass, they are noted.

        Args:
            target: (n,) rad, received.
            offset: (n,) rad, to be sent.
            sent_in: (n,) cycle in which each target was sent.
            rounding: (n,) rad, of a step of the target.
            cycle: for the error.

        Raises:
            NotFinite, VelocityLimit: too fast, the offset being a position or a step.
        """
        T = self._guard.period
        elapsed = T * np.maximum(sent_in - self._sent_in, 1.0)
        speed = (target - self._target) / elapsed
        bound = self._guard.limits.velocity * (1.0 + RELATIVE_TOLERANCE) + rounding / elapsed
        for step in (offset - self._offset, offset):
            require(self._every, np.abs(speed + step / T), bound, VelocityLimit, cycle)
        self.note_target(target, offset, sent_in)

    def check_current(self, current: Array, servo: Array | None, cycle: int) -> None:
        """The next current (n,) A; if it passes, it counts as sent.

        Args:
            current: fed forward, or added to the servo's own.
            servo: (n,) A, the servo's own in the latter case.
            cycle: for the error.

        Raises:
            NotFinite, CommandedCurrentLimit, CommandedCurrentStep: it must not be sent.
        """
        total = current if servo is None else current + servo
        bound = self._guard.current * (1.0 + RELATIVE_TOLERANCE)
        require(self._every, np.abs(total), bound, CommandedCurrentLimit, cycle)
        step, largest = np.abs(current - self._current), bound * self._rise
        require(self._every, step, largest, CommandedCurrentStep, cycle)
        self._current[...] = current

    def check_position(self, q: Array, cycle: int) -> None:
        """Where the correction leads the arm, (n,) rad.

        Raises:
            NotFinite, PositionLimit: outside the range of a joint.
        """
        limits = self._guard.limits
        require_finite(q, self._every, cycle)
        reach = RELATIVE_TOLERANCE * 0.5 * (limits.upper - limits.lower)
        outside = (q > limits.upper + reach) | (q < limits.lower - reach)
        if outside.any():
            joint = int(np.argmax(outside))
            limit = limits.upper if q[joint] > limits.upper[joint] else limits.lower
            raise PositionLimit(joint, float(q[joint]), float(limit[joint]), cycle)

    def check_end(self, cycle: int) -> None:
        """The source says that it is finished.

        Raises:
            CorrectionNotEnded: what it gave last is not zero.
        """
        self._require_zero(CorrectionNotEnded, cycle)

    def check_after_gap(self, cycle: int) -> None:
        """After a long gap, whether the controller applied a correction cannot be seen.

        Raises:
            CorrectionNotCarriedOn: the one sent last is not zero.
        """
        self._require_zero(CorrectionNotCarriedOn, cycle)

    def _require_zero(self, kind: type[GuardError], cycle: int) -> None:
        no_current = RELATIVE_TOLERANCE * self._guard.current
        require(self._every, np.abs(self._history[3]), self._nothing, kind, cycle, self._unit)
        require(self._every, np.abs(self._current), no_current, kind, cycle, "A")
