r"""Friction of joints, linear in its coefficients: terms, the law of a joint, and that of an arm.

.. math:: \tau_f = f_0\,\mathrm{sgn}(v) + f_1 v + f_d |v| + f_2\,\mathrm{sgn}(v)\,v^2
                   + f_s\,\mathrm{sgn}(v)\,e^{-(v/v_s)^2} + f_o

with the joint's speed v. Each summand is a :class:`FrictionTerm`, a row of :data:`TERMS`. Dry
friction does not jump at a reversal: over a displacement of some 1e-4 rad it reverses like a spring
(presliding). Dahl (1968) describes it by a state z in place of sgn(v),

.. math:: z \leftarrow s + (z - s)\,e^{-|dq| / d}, \qquad s = \mathrm{sgn}(dq)

so that the torque stays linear in the coefficients once the distance d is fixed, and friction at
rest is what was left of the motion before it.

The paper's equation (after its eq. 1: three coefficients per joint) could not be read; the third
term is quadratic in the same authors' later software, and cubic elsewhere: either may be chosen.
"""

# ruff: noqa: ARG005 - columns of all terms have the same arguments

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.errors import ModelError, ShapeError
from identification.model.coupling import Coupling

Array = NDArray[np.float64]
ThirdTerm = Literal["quadratic", "cubic"]
Zone = Literal["exclude", "linear"]
Pair = tuple[str, tuple[tuple[float, float], tuple[float, float]]]

_EXPONENT: Final = {1: "", 2: "²", 3: "³"}


@dataclass(frozen=True)
class FrictionTerm:
    """A coefficient times a column of speed and direction."""

    symbol: str  # of the coefficient; terms with the same one exclude each other
    option: str  # of `FrictionLaw`, and of `[robot.friction]`, that asks for it
    label: str  # of the term in a list; in lower case its name on the command line
    words: str  # what it is
    value: Callable[[Array, Array, float], Array]  # the column, of speeds, directions and `speed`
    rate: Callable[[Array, Array, float], Array]  # its derivative, of speeds, that of directions
    asked: Callable[[FrictionLaw], Any] | None = None  # setting, where not that of `option`
    basis: str = ""  # the column as a formula for people
    # the column in Python, as a factor of the coefficient; `v` is the speed, `sign` its direction,
    # `E` Euler's number and `LABEL_SPEED[joint]` the `speed`
    code: str = ""
    power: int = 0  # of the speed in the denominator of the coefficient's unit
    speed_symbol: str = ""  # of `speed`; empty for a column without it
    urdf: str = ""  # attribute of `<dynamics>` that holds the coefficient; empty for none
    of_motor: bool = False  # whether a coupled motor has one beside those of the joints
    is_friction: bool = True  # whether it cannot be the zero error of a sensor instead
    # whether only coefficients from zero on take energy; with a `pair` that holds of g, where
    # (coefficient of the other symbol, this one) = matrix @ g
    not_negative: bool = False
    pair: Pair | None = None  # that symbol and matrix
    speed: float = 1.0  # v_s of a column of v / v_s [rad/s, m/s]

    def __reduce__(self) -> tuple[object, ...]:
        return _term, (self.label, self.speed)

    @property
    def formula(self) -> str:
        """The term for people."""
        return f"{self.symbol} {self.basis}".rstrip()

    def of(self, law: FrictionLaw) -> FrictionTerm | None:
        """Return the term as a law has it, None where it has not."""
        match self.asked(law) if self.asked else getattr(law, self.option):
            case None | False:
                return None
            case str(label):
                return self if label == self.label else None
            case True:
                return self
            case speed:
                return replace(self, speed=speed)

    def column(self, v: Array, s: Array) -> Array:
        """Return the column (...) for speeds and directions of dry friction (...)."""
        return self.value(v, s, self.speed)

    def slope(self, v: Array, ds: Array) -> Array:
        """Return its derivative (...) with v, where that of the direction is `ds` (...)."""
        return self.rate(v, ds, self.speed)

    def unit(self, *, revolute: bool) -> str:
        """Return the unit of the coefficient of a revolute or a prismatic joint."""
        if self.power == 0:
            return "N·m" if revolute else "N"
        power = _EXPONENT[self.power]
        return f"N·m·s{power}/rad{power}" if revolute else f"N·s{power}/m{power}"


def _term(label: str, speed: float) -> FrictionTerm:
    return next(replace(term, speed=speed) for term in TERMS if term.label == label)


COULOMB: Final = FrictionTerm(
    symbol="f0",
    option="coulomb",
    label="Coulomb",
    words="Coulomb (dry) friction f0",
    basis="sgn(v)",
    code=" * sign",
    value=lambda v, s, _: s,
    rate=lambda v, ds, _: ds,
    asked=lambda law: law.coulomb and law.tanh is None,
    urdf="friction",
    of_motor=True,
    not_negative=True,
)
TANH: Final = FrictionTerm(
    symbol="f0",
    option="tanh",
    label="tanh",
    words="Coulomb friction f0 with a smooth sign",
    basis="tanh(v/vt)",
    code=" * tanh(v / TANH_SPEED[joint])",
    value=lambda v, s, vt: np.tanh(v / vt),
    rate=lambda v, ds, vt: (1.0 - np.tanh(v / vt) ** 2) / vt,
    speed_symbol="vt",
    urdf="friction",
    of_motor=True,
    not_negative=True,
)
VISCOUS: Final = FrictionTerm(
    symbol="f1",
    option="viscous",
    label="viscous",
    words="viscous friction f1",
    basis="v",
    code=" * v",
    value=lambda v, s, _: v,
    rate=lambda v, ds, _: np.ones_like(v),
    power=1,
    urdf="damping",
    of_motor=True,
    not_negative=True,
)
# F1 + fd forwards, f1 - fd backwards.
ASYMMETRIC: Final = FrictionTerm(
    symbol="fd",
    option="asymmetric",
    label="asymmetric",
    words="half the difference fd of viscous friction forwards and backwards",
    basis="|v|",
    code=" * abs(v)",
    value=lambda v, s, _: np.abs(v),
    rate=lambda v, ds, _: np.sign(v),
    asked=lambda law: law.asymmetric and law.viscous,
    power=1,
    not_negative=True,
    pair=("f1", ((0.5, 0.5), (0.5, -0.5))),
)
QUADRATIC: Final = FrictionTerm(
    symbol="f2",
    option="third",
    label="quadratic",
    words="a term f2 with the speed squared",
    basis="sgn(v) v²",
    code=" * v * abs(v)",
    value=lambda v, s, _: np.abs(v) * v,
    rate=lambda v, ds, _: 2.0 * np.abs(v),
    power=2,
)
CUBIC: Final = FrictionTerm(
    symbol="f2",
    option="third",
    label="cubic",
    words="a term f2 with the third power of the speed",
    basis="v³",
    code=" * v**3",
    value=lambda v, s, _: v * v * v,
    rate=lambda v, ds, _: 3.0 * v**2,
    power=3,
)
# The slope is without the fall with speed, which hardly any step feels.
STRIBECK: Final = FrictionTerm(
    symbol="fs",
    option="stribeck",
    label="Stribeck",
    words="additional friction fs at low speed (Stribeck)",
    basis="sgn(v) exp(-(v/vs)²)",
    code=" * sign * E ** -((v / STRIBECK_SPEED[joint]) ** 2)",
    value=lambda v, s, vs: np.exp(-(v / vs) * (v / vs)) * s,
    rate=lambda v, ds, _: ds,
    speed_symbol="vs",
    not_negative=True,
    pair=("f0", ((1.0, 0.0), (-1.0, 1.0))),
)
# Also the zero error of a sensor.
OFFSET: Final = FrictionTerm(
    symbol="fo",
    option="offset",
    label="offset",
    words="a constant offset fo",
    value=lambda v, s, _: np.ones_like(v),
    rate=lambda v, ds, _: np.zeros_like(v),
    asked=lambda law: law.offset or (law.asymmetric and law.coulomb),
    is_friction=False,
)
TERMS: Final = (COULOMB, TANH, VISCOUS, ASYMMETRIC, QUADRATIC, CUBIC, STRIBECK, OFFSET)
"""All terms that a joint can have, in the order of the parameters."""
_SYMBOLS: Final = tuple(dict.fromkeys(kind.symbol for kind in TERMS))

ABSENT: Final[Mapping[str, Any]] = {"third": "none", "stribeck": 0.0, "tanh": 0.0}
"""How a cell file writes None, by option."""


@dataclass(frozen=True)
class FrictionLaw:
    """Which friction terms a joint has."""

    coulomb: bool = True  #: ``f0 sgn(v)``
    viscous: bool = True  #: ``f1 v``
    #: ``f2 sgn(v) v**2`` ("quadratic"), ``f2 v**3`` ("cubic") or none
    third: ThirdTerm | None = "quadratic"
    offset: bool = False  #: constant ``fo``, also the zero error of a torque or current measurement
    #: speed [rad/s, m/s] below which a joint counts as at rest. Stiction can take any value
    #: there; see `zone`
    standstill: float = 0.01
    #: fixed speed v_s [rad/s, m/s] of a term ``fs sgn(v) exp(-(v / v_s)**2)``, by which friction
    #: is larger at low speed; none without it
    stribeck: float | None = None
    #: fixed speed v_t [rad/s, m/s] of ``f0 tanh(v / v_t)`` in place of ``f0 sgn(v)``; none for
    #: the latter
    tanh: float | None = None
    #: friction differs by direction, viscous by a term ``fd |v|``. Coulomb friction is f0 + fo
    #: forwards and f0 - fo backwards: its asymmetry is the constant column of the offset, which
    #: is there then too, and the two cannot be distinguished
    asymmetric: bool = False
    #: what becomes of rows slower than standstill. "exclude": they are not fitted, see
    #: :meth:`moving`. "linear": they are, with sgn(v) replaced by v / standstill
    zone: Zone = "exclude"
    #: displacement d [rad, m] over which dry friction reverses; zero for a jump
    presliding: float = 0.0

    def __post_init__(self) -> None:
        if self.third not in (None, "quadratic", "cubic"):
            raise ModelError(
                f'friction term third = {self.third!r}: "quadratic", "cubic" or None are known'
            )
        for name, value in (
            ("standstill speed", self.standstill),
            ("presliding displacement", self.presliding),
        ):
            if not (math.isfinite(value) and value >= 0.0):
                raise ModelError(
                    f"friction's {name} is {value!r}; it must be a finite number, zero or more"
                )
        for term in self.terms:
            if not (math.isfinite(term.speed) and term.speed > 0.0):
                raise ModelError(
                    f"friction's {term.label} speed is {term.speed!r}; it must be finite and"
                    " positive"
                )
        if self.zone not in ("exclude", "linear"):
            raise ModelError(f'friction zone = {self.zone!r}: "exclude" or "linear" are known')
        if self.zone == "linear" and self.standstill == 0.0:
            raise ModelError(
                "a linear friction zone needs a standstill speed above zero to be as wide as"
            )

    @classmethod
    def from_table(cls, table: Mapping[str, Any]) -> FrictionLaw:
        """Return the law of a table `[robot.friction]`.

        Raises:
            ModelError: there is no such law.
        """
        options: dict[str, Any] = {k: None if v == ABSENT.get(k) else v for k, v in table.items()}
        return cls(**options)

    def table(self) -> dict[str, Any]:
        """Return the table `[robot.friction]` of the law."""
        return {k: ABSENT[k] if v is None else v for k, v in asdict(self).items()}

    @property
    def terms(self) -> tuple[FrictionTerm, ...]:
        """The terms in the order of the parameters."""
        return tuple(term for kind in TERMS if (term := kind.of(self)) is not None)

    @property
    def symbols(self) -> tuple[str, ...]:
        """Their symbols."""
        return tuple(term.symbol for term in self.terms)

    def words(self) -> tuple[str, str]:
        """The terms, and what dry friction does at a reversal, in words."""
        joined = ", ".join(
            f"{term.label} ({term.speed:g} rad/s)" if term.speed_symbol else term.label
            for term in self.terms
        )
        reversal = f"presliding over {self.presliding:g} rad" if self.presliding else "sgn(v)"
        if self.tanh is not None:
            reversal = f"tanh(v / {self.tanh:g} rad/s)"
        return joined or "no friction", reversal

    def sign(self, velocity: Array, out: Array | None = None) -> Array:
        """Return the direction of motion: sgn(v), in a linear zone v / standstill.

        Otherwise it has no dead zone: sgn(0) = 0, everything else is ±1.
        """
        if self.zone == "exclude":
            return np.asarray(np.sign(velocity, out=out))
        scaled = np.divide(velocity, self.standstill, out=out)
        return np.asarray(np.clip(scaled, -1.0, 1.0, out=out))

    def direction(self, time: Array, position: Array, velocity: Array) -> Array:
        """Return the direction of dry friction (m,) along a motion: presliding state, or sign.

        Times [s], positions [rad, m] and velocities [rad/s, m/s] (m,) of joint or motor in joint
        units. A reversal between two instants divides the step where the velocity, linear between
        them, is zero.
        """
        if self.presliding == 0.0:
            return self.sign(velocity)
        steps, before = np.diff(time), velocity[:-1]
        share = before / np.where(before == velocity[1:], 1.0, before - velocity[1:])
        turning = np.flatnonzero(before * velocity[1:] < 0.0)
        turned = position[turning] + 0.5 * (before * steps * share)[turning]
        path = np.insert(position, turning + 1, turned)
        # What was before the first instant is not known: one step at its speed.
        start = position[0] - velocity[0] * (steps[0] if len(steps) else 0.0)
        state = presliding_state(np.insert(path, 0, start), self.presliding)[1:]
        return np.delete(state, turning + 1 + np.arange(len(turning)))

    def columns(self, velocity: Array, direction: Array) -> Array:
        """Return one row per coefficient (k, ...), for speeds and directions (...)."""
        rows = [term.column(velocity, direction) for term in self.terms]
        return np.reshape(rows, (len(rows), *np.shape(velocity)))

    def moving(self, velocity: Array) -> NDArray[np.bool_]:
        """Return where this law can be fitted: faster than standstill, or in a linear zone."""
        if self.zone == "linear":
            return np.ones(np.shape(velocity), dtype=np.bool_)
        return np.asarray(np.abs(velocity) > self.standstill)


def presliding_state(position: Array, distance: float) -> Array:
    """Return Dahl's state z (m,) of positions (m,), zero at the first of them.

    Within a stretch of one direction it is ``s + (z0 - s) exp(-travel / distance)``.
    """
    steps = np.diff(position, prepend=position[:1])
    travel = np.cumsum(np.abs(steps))
    moved = np.flatnonzero(steps)
    state = np.zeros(len(position))
    if not moved.size:
        return state
    sign = np.sign(steps[moved])
    turns = np.append(0, np.flatnonzero(np.diff(sign)) + 1)
    starts, signs = moved[turns], sign[turns]
    stops = np.append(starts[1:], len(position))
    before, value = travel[starts - 1], 0.0
    for start, stop, s, origin in zip(starts, stops, signs, before, strict=True):
        stretch = s + (value - s) * np.exp((origin - travel[start:stop]) / distance)
        state[start:stop], value = stretch, stretch[-1]
    return state


class JointTerm(NamedTuple):
    """A term of one joint or motor."""

    name: str  # of the parameter: ``f0_3``, or ``f0_m6`` of a motor
    term: FrictionTerm  # which
    owner: int  # which joint or motor, from 0
    motor: bool  # whether it acts on the speed of a motor that several joints turn
    unit: str  # at the joint

    @property
    def symbol(self) -> str:
        """Of the coefficient."""
        return self.term.symbol


@dataclass(frozen=True, eq=False)
class JointFriction:
    """Friction of n joints: k coefficients, term by term (all f0, all f1, ...), then motors."""

    laws: tuple[FrictionLaw, ...]  #: of each joint (n,)
    revolute: tuple[bool, ...]  #: whether each joint turns (n,), for units
    #: motors that turn with several joints; None where each joint has its own
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
        coupled = self.coupling.coupled_motors
        return tuple(m for m in coupled if any(term.of_motor for term in self.laws[m].terms))

    @cached_property
    def terms(self) -> tuple[JointTerm, ...]:
        """The k coefficients in the order of the parameters."""
        owners = [(j, False) for j in range(self.n_joints)], [(m, True) for m in self.motors]
        return tuple(
            JointTerm(
                f"{symbol}_{'m' if motor else ''}{owner + 1}",
                term,
                owner,
                motor,
                term.unit(revolute=self.revolute[owner]),
            )
            for part in owners
            for symbol in _SYMBOLS
            for owner, motor in part
            for term in self.laws[owner].terms
            # A motor's share of any other term cannot be distinguished from that of the joints.
            if term.symbol == symbol and (term.of_motor or not motor)
        )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the k parameters."""
        return tuple(term.name for term in self.terms)

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the k parameters."""
        return tuple(term.unit for term in self.terms)

    @property
    def all_laws(self) -> tuple[FrictionLaw, ...]:
        """Laws of the joints, then of `motors`."""
        return *self.laws, *(self.laws[motor] for motor in self.motors)

    @property
    def kinds(self) -> tuple[FrictionTerm, ...]:
        """Kinds of term that any joint has, in order."""
        return tuple(kind for kind in TERMS if any(kind.of(law) for law in self.laws))

    @property
    def standstill(self) -> Array:
        """Speed per joint (n,) [rad/s or m/s] below which it counts as at rest."""
        return np.array([law.standstill for law in self.laws])

    @property
    def one_law(self) -> FrictionLaw | None:
        """The law of all joints, None where they differ."""
        return self.laws[0] if len(set(self.laws)) == 1 else None

    @property
    def dissipating(self) -> NDArray[np.bool_]:
        """Which of the k coefficients are friction (k,): all but the offset."""
        return np.array([term.term.is_friction for term in self.terms], dtype=np.bool_)

    def motor_speeds(self) -> Array:
        """Speed of each of `motors` per joint speed, one for its own joint (len(motors), n)."""
        if self.coupling is None or not self.motors:
            return np.zeros((0, self.n_joints))
        return self.coupling.speeds[list(self.motors)]

    def direction(self, time: Array, position: Array, velocity: Array) -> Array:
        """Return the direction of dry friction (m, n + k), of joints and then of `motors`.

        At times (m,) [s], for positions [rad or m] and velocities of the joints (m, n).
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

    def place(self, term: JointTerm) -> int:
        """Return the place of a term's joint or motor among the joints, then `motors`."""
        return self.n_joints + self.motors.index(term.owner) if term.motor else term.owner

    def table(self, coefficients: Array) -> tuple[dict[str, float], ...]:
        """Return the coefficients (k,) by symbol of each joint, then of each of `motors`.

        Raises:
            ShapeError: they are not (k,).
        """
        values = np.asarray(coefficients, dtype=np.float64)
        if values.shape != (len(self.terms),):
            raise ShapeError("coefficients", values.shape, f"({len(self.terms)},)")
        rows: tuple[dict[str, float], ...] = tuple({} for _ in self.all_laws)
        for term, value in zip(self.terms, values.tolist(), strict=True):
            rows[self.place(term)][term.symbol] = value
        return rows


class Dissipation(NamedTuple):
    """Coefficients ``f = combine @ g``, of which some g may not be negative."""

    combine: Array  # (k, k), invertible
    not_negative: NDArray[np.bool_]  # which of the g (k,)


def dissipation(friction: JointFriction) -> Dissipation:
    """Return what friction needs to take energy in either direction and at low speed.

    - Coulomb friction f0, and with a Stribeck term its value at rest f0 + fs;
    - viscous friction, by direction f1 + fd and f1 - fd where it is asymmetric.

    Signs of the third term and of the offset, which may be a sensor's, are left open.
    """
    place = {(t.motor, t.owner, t.symbol): k for k, t in enumerate(friction.terms)}
    combine = np.eye(len(place))
    for k, (_, term, owner, motor, _) in enumerate(friction.terms):
        if term.pair is None:
            continue
        symbol, matrix = term.pair
        if (other := place.get((motor, owner, symbol))) is not None:
            combine[np.ix_([other, k], [other, k])] = matrix
    kinds = [joint_term.term.not_negative for joint_term in friction.terms]
    return Dissipation(combine, np.array(kinds, dtype=np.bool_))
