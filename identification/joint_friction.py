"""Friction of all joints of an arm, each by its own law, and of coupled motors."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.coupling import Coupling
from identification.errors import ShapeError
from identification.friction import OFFSET, SYMBOLS, FrictionLaw

Array = NDArray[np.float64]

# Of a coupled motor. Its share of any other term cannot be told from that of the joints.
_MOTOR_SYMBOLS = ("f0", "f1")


class FrictionTerm(NamedTuple):
    """One coefficient.

    Attributes:
        name: of the parameter: ``f0_3``, or ``f0_m6`` of a motor.
        symbol: which of :data:`identification.friction.SYMBOLS`.
        owner: which joint or motor, from 0.
        motor: whether it acts on the speed of a motor that several joints turn.
        unit: at the joint.
    """

    name: str
    symbol: str
    owner: int
    motor: bool
    unit: str


@dataclass(frozen=True, eq=False)
class JointFriction:
    """Friction of n joints: k coefficients, term by term (all f0, all f1, ...), then motors.

    Attributes:
        laws: of each joint (n,).
        revolute: whether each joint turns (n,), for units.
        coupling: motors that turn with several joints; None where each joint has its own.
    """

    laws: tuple[FrictionLaw, ...]
    revolute: tuple[bool, ...]
    coupling: Coupling | None = None

    @property
    def n_joints(self) -> int:
        """Number n of joints."""
        return len(self.laws)

    @cached_property
    def motors(self) -> tuple[int, ...]:
        """Motors, from 0, whose friction depends on the speeds of several joints."""
        if self.coupling is None or not self.coupling.friction:
            return ()
        return tuple(m for m in self.coupling.coupled_motors if self._motor_symbols(m))

    @cached_property
    def terms(self) -> tuple[FrictionTerm, ...]:
        """The k coefficients in the order of the parameters."""
        joints = [
            FrictionTerm(f"{symbol}_{j + 1}", symbol, j, False, self._unit(symbol, j))
            for symbol in SYMBOLS
            for j, law in enumerate(self.laws)
            if symbol in law.symbols
        ]
        motors = [
            FrictionTerm(f"{symbol}_m{m + 1}", symbol, m, True, self._unit(symbol, m))
            for symbol in _MOTOR_SYMBOLS
            for m in self.motors
            if symbol in self._motor_symbols(m)
        ]
        return (*joints, *motors)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the k parameters."""
        return tuple(term.name for term in self.terms)

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the k parameters."""
        return tuple(term.unit for term in self.terms)

    @property
    def symbols(self) -> tuple[str, ...]:
        """Symbols that any joint has, in order."""
        return tuple(s for s in SYMBOLS if any(s in law.symbols for law in self.laws))

    @property
    def standstill(self) -> Array:
        """Speed per joint (n,) [rad/s or m/s] below which it counts as standing."""
        return np.array([law.standstill for law in self.laws])

    @property
    def one_law(self) -> FrictionLaw | None:
        """The law of all joints, None where they differ."""
        return self.laws[0] if len(set(self.laws)) == 1 else None

    @property
    def dissipating(self) -> NDArray[np.bool_]:
        """Which of the k coefficients are friction (k,): all but the offset."""
        return np.array([term.symbol != OFFSET for term in self.terms], dtype=np.bool_)

    def motor_speeds(self) -> Array:
        """Speed of each of `motors` per joint speed, one for its own joint (len(motors), n)."""
        if self.coupling is None or not self.motors:
            return np.zeros((0, self.n_joints))
        return self.coupling.speeds[list(self.motors)]

    def direction(self, time: Array, position: Array, velocity: Array) -> Array:
        """Return the direction of dry friction (m, n + k), of joints and then of `motors`.

        Args:
            time: of m instants [s].
            position: of the joints along a motion (m, n) [rad or m].
            velocity: likewise (m, n).
        """
        joints = [
            law.direction(time, position[:, j], velocity[:, j]) for j, law in enumerate(self.laws)
        ]
        motors = [
            self.laws[motor].direction(time, position @ speed, velocity @ speed)
            for motor, speed in zip(self.motors, self.motor_speeds(), strict=True)
        ]
        return np.column_stack([*joints, *motors])

    def moving(self, velocity: Array) -> NDArray[np.bool_]:
        """Return where the row of a joint can be fitted (m, n), from joint speeds (m, n).

        The joint, and every motor whose friction it feels, has to be faster than standstill.
        """
        one = self.one_law
        if one is not None:
            moving = one.moving(velocity)
        else:
            rows = [law.moving(velocity[:, j]) for j, law in enumerate(self.laws)]
            moving = np.column_stack(rows)
        for motor, speed in zip(self.motors, self.motor_speeds(), strict=True):
            turning = self.laws[motor].moving(velocity @ speed)
            moving[:, speed != 0.0] &= turning[:, None]
        return moving

    def table(self, coefficients: Array) -> dict[str, Array]:
        """Return the joints' coefficients (k,) by symbol, each (n,); NaN where a joint has none.

        Raises:
            ShapeError: they are not (k,).
        """
        values = self._checked(coefficients)
        rows = {symbol: np.full(self.n_joints, np.nan) for symbol in self.symbols}
        for term, value in zip(self.terms, values, strict=True):
            if not term.motor:
                rows[term.symbol][term.owner] = value
        return rows

    def motor_table(self, coefficients: Array) -> dict[int, dict[str, float]]:
        """Return the coefficients of coupled motors by motor, from 0, and symbol."""
        rows: dict[int, dict[str, float]] = {motor: {} for motor in self.motors}
        for term, value in zip(self.terms, self._checked(coefficients), strict=True):
            if term.motor:
                rows[term.owner][term.symbol] = float(value)
        return rows

    def _checked(self, coefficients: Array) -> Array:
        values = np.asarray(coefficients, dtype=np.float64)
        if values.shape != (len(self.terms),):
            raise ShapeError("coefficients", values.shape, f"({len(self.terms)},)")
        return values

    def _motor_symbols(self, motor: int) -> tuple[str, ...]:
        return tuple(s for s in _MOTOR_SYMBOLS if s in self.laws[motor].symbols)

    def _unit(self, symbol: str, joint: int) -> str:
        return self.laws[joint].unit(symbol, revolute=self.revolute[joint])
