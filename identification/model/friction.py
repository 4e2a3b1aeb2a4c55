r"""Friction of joints, linear in its coefficients: terms, law of a joint, friction of an arm.

.. math:: \tau_f = f_0\,\mathrm{sgn}(v) + f_1 v + f_d |v| + f_2\,\mathrm{sgn}(v)\,v^2
                   + f_s\,\mathrm{sgn}(v)\,e^{-(v/v_s)^2} + f_l\,\mathrm{sgn}(v)\,|\tau_g| + f_o

with the joint's speed v and the torque :math:`\tau_g` that its gear transmits. Each summand is a
:class:`FrictionTerm` in :data:`TERMS`. At a velocity reversal dry friction changes elastically over
a displacement of some 1e-4 rad (presliding). Dahl (1968) describes it by a state z in place of
sgn(v),

.. math:: z \leftarrow s + (z - s)\,e^{-|dq| / d}, \qquad s = \mathrm{sgn}(dq)

so that the torque remains linear in the coefficients for a fixed distance d.

Friction of gears grows with their load (Bittencourt and Gunnarsson, Static friction in a robot
joint, 2012; Wolf et al., Extending a dynamic friction model with nonlinear viscous and thermal
dependency, 2018). The transmitted torque depends on the inertial parameters, so the torque is
linear in the coefficients for a given load only, that of a previous estimate
(:mod:`identification.estimators.load_friction`).

The paper has three coefficients per joint (after its eq. 1); the third term is quadratic in its
authors' later software, and cubic elsewhere.
"""

# ruff: noqa: ARG005 - columns of all terms have the same arguments

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.errors import ModelError, ShapeError
from identification.model.coupling import Coupling
from identification.model.motion import Motion

ThirdTerm = Literal["quadratic", "cubic"]
Zone = Literal["exclude", "linear"]
Pair = tuple[str, tuple[tuple[float, float], tuple[float, float]]]

_EXPONENT: Final = {1: "", 2: "²", 3: "³"}


@dataclass(frozen=True)
class FrictionTerm:
    """A coefficient times a column, which is a function of speed and direction."""

    symbol: str  # of the coefficient; terms with the same symbol exclude each other
    option: str  # field of `FrictionLaw` and `[robot.friction]` that selects the term
    label: str  # name in lists; in lower case on the command line
    description: str
    value: Callable[[Array, Array, float], Array]  # column, of speeds, directions and `speed`
    selected: Callable[[FrictionLaw], Any] | None = None  # setting, if not that of `option`
    power: int = 0  # of the speed in the denominator of the coefficient's unit
    speed_symbol: str = ""  # of `speed`; empty for a column without it
    urdf: str = ""  # attribute of `<dynamics>` for the coefficient, if any
    of_motor: bool = False  # whether coupled motors have this term too
    of_load: bool = False  # whether the column is multiplied by the transmitted torque's size
    is_friction: bool = True  # False if it may be the zero error of a sensor
    # whether the coefficient must be non-negative for friction to dissipate energy; with a `pair`
    # (symbol, matrix) this is required of g, (coefficient of symbol, this one) = matrix @ g
    not_negative: bool = False
    pair: Pair | None = None
    speed: float = 1.0  # v_s of a column of v / v_s [rad/s, m/s]

    def __reduce__(self) -> tuple[object, ...]:
        return _term, (self.label, self.speed)

    def of(self, law: FrictionLaw) -> FrictionTerm | None:
        """Return the term with the settings of a law, None if the law does not have it."""
        match self.selected(law) if self.selected else getattr(law, self.option):
            case None | False:
                return None
            case str(label):
                return self if label == self.label else None
            case True:
                return self
            case speed:
                return replace(self, speed=speed)

    def column(self, v: Array, s: Array, load: Array | None = None) -> Array:
        """Return the column (...) at speeds, directions of dry friction and transmitted torques.

        Without a transmitted torque the column of a term that depends on it is zero.
        """
        column = self.value(v, s, self.speed)
        if not self.of_load:
            return column
        return np.zeros_like(column) if load is None else np.asarray(column * np.abs(load))

    def unit(self, *, revolute: bool) -> str:
        """Return the unit of the coefficient of a revolute or prismatic joint."""
        if self.of_load:
            return "1"
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
    description="Coulomb (dry) friction f0",
    value=lambda v, s, _: s,
    selected=lambda law: law.coulomb and law.tanh is None,
    urdf="friction",
    of_motor=True,
    not_negative=True,
)
TANH: Final = FrictionTerm(
    symbol="f0",
    option="tanh",
    label="tanh",
    description="Coulomb friction f0 with a smooth sign",
    value=lambda v, s, vt: np.tanh(v / vt),
    speed_symbol="vt",
    urdf="friction",
    of_motor=True,
    not_negative=True,
)
VISCOUS: Final = FrictionTerm(
    symbol="f1",
    option="viscous",
    label="viscous",
    description="viscous friction f1",
    value=lambda v, s, _: v,
    power=1,
    urdf="damping",
    of_motor=True,
    not_negative=True,
)
# f1 + fd for positive, f1 - fd for negative speed
ASYMMETRIC: Final = FrictionTerm(
    symbol="fd",
    option="asymmetric",
    label="asymmetric",
    description="half the difference fd of viscous friction forwards and backwards",
    value=lambda v, s, _: np.abs(v),
    selected=lambda law: law.asymmetric and law.viscous,
    power=1,
    not_negative=True,
    pair=("f1", ((0.5, 0.5), (0.5, -0.5))),
)
QUADRATIC: Final = FrictionTerm(
    symbol="f2",
    option="third",
    label="quadratic",
    description="a term f2 with the speed squared",
    value=lambda v, s, _: np.abs(v) * v,
    power=2,
)
CUBIC: Final = FrictionTerm(
    symbol="f2",
    option="third",
    label="cubic",
    description="a term f2 with the third power of the speed",
    value=lambda v, s, _: v * v * v,
    power=3,
)
STRIBECK: Final = FrictionTerm(
    symbol="fs",
    option="stribeck",
    label="Stribeck",
    description="additional friction fs at low speed (Stribeck)",
    value=lambda v, s, vs: np.exp(-(v / vs) * (v / vs)) * s,
    speed_symbol="vs",
    not_negative=True,
    pair=("f0", ((1.0, 0.0), (-1.0, 1.0))),
)
# Motors that turn several joints have no such term: it acts in the joint, with the joint's torque.
LOAD: Final = FrictionTerm(
    symbol="fl",
    option="load",
    label="load",
    description="friction that grows with the transmitted torque (share fl)",
    value=lambda v, s, _: s,
    of_load=True,
    not_negative=True,
)
OFFSET: Final = FrictionTerm(
    symbol="fo",
    option="offset",
    label="offset",
    description="a constant offset fo",
    value=lambda v, s, _: np.ones_like(v),
    selected=lambda law: law.offset or (law.asymmetric and law.coulomb),
    is_friction=False,
)
TERMS: Final = (COULOMB, TANH, VISCOUS, ASYMMETRIC, QUADRATIC, CUBIC, STRIBECK, LOAD, OFFSET)
"""All terms in the order of the parameters."""
_SYMBOLS: Final = tuple(dict.fromkeys(kind.symbol for kind in TERMS))

ABSENT: Final[Mapping[str, Any]] = {"third": "none", "stribeck": 0.0, "tanh": 0.0}
"""Values in a cell file that mean None, by option."""


@dataclass(frozen=True)
class FrictionLaw:
    """Friction terms of a joint."""

    coulomb: bool = True  #: ``f0 sgn(v)``
    viscous: bool = True  #: ``f1 v``
    #: ``f2 sgn(v) v**2`` ("quadratic"), ``f2 v**3`` ("cubic") or none
    third: ThirdTerm | None = "quadratic"
    offset: bool = False  #: constant ``fo``, also the zero error of a torque or current measurement
    #: speed [rad/s, m/s] below which a joint counts as at rest (undefined stiction); see `zone`
    standstill: float = 0.01
    #: fixed speed v_s [rad/s, m/s] of ``fs sgn(v) exp(-(v / v_s)**2)``, friction at low speed
    stribeck: float | None = None
    #: fixed speed v_t [rad/s, m/s] of ``f0 tanh(v / v_t)`` in place of ``f0 sgn(v)``
    tanh: float | None = None
    #: friction depends on the direction: a term ``fd |v|``, and an offset fo, so that Coulomb
    #: friction is f0 + fo and f0 - fo; the zero error of a sensor cannot be distinguished from fo
    asymmetric: bool = False
    #: ``fl sgn(v) |load|``: dry friction grows by a share fl of the torque that the gear transmits
    load: bool = False
    #: rows slower than standstill: "exclude": not fitted, see :meth:`moving`; "linear": fitted
    #: with v / standstill in place of sgn(v)
    zone: Zone = "exclude"
    #: displacement d [rad, m] over which dry friction reverses; zero for a jump
    presliding: float = 0.0

    def __post_init__(self) -> None:
        if self.zone == "linear" and self.standstill == 0.0:
            raise ModelError("a linear friction zone needs a standstill speed above zero")

    @classmethod
    def from_table(cls, table: Mapping[str, Any]) -> FrictionLaw:
        """Return the law of a table `[robot.friction]`.

        Raises:
            ModelError: invalid settings.
        """
        return cls().changed(table)

    def changed(self, entries: Mapping[str, Any]) -> FrictionLaw:
        """Return the law with other entries of its table `[robot.friction]`.

        Raises:
            ModelError: invalid settings.
        """
        fields: dict[str, Any] = {k: None if v == ABSENT.get(k) else v for k, v in entries.items()}
        return replace(self, **fields)

    def table(self) -> dict[str, Any]:
        """Return the table `[robot.friction]` of the law."""
        return {k: ABSENT[k] if v is None else v for k, v in asdict(self).items()}

    @cached_property
    def terms(self) -> tuple[FrictionTerm, ...]:
        """The terms in the order of the parameters."""
        return tuple(term for kind in TERMS if (term := kind.of(self)) is not None)

    @property
    def symbols(self) -> tuple[str, ...]:
        """Symbols of the terms."""
        return tuple(term.symbol for term in self.terms)

    def sign(self, velocity: Array, out: Array | None = None) -> Array:
        """Return the direction of motion: sgn(v), or in a linear zone v / standstill."""
        if self.zone == "exclude":
            return np.asarray(np.sign(velocity, out=out))
        scaled = np.divide(velocity, self.standstill, out=out)
        return np.asarray(np.clip(scaled, -1.0, 1.0, out=out))

    def direction(self, time: Array, position: Array, velocity: Array) -> Array:
        """Return the direction of dry friction (m,) along a motion: presliding state, or sign.

        Times [s], positions [rad, m] and velocities [rad/s, m/s] (m,). A reversal between two
        instants is where the linearly interpolated velocity is zero.
        """
        if self.presliding == 0.0:
            return self.sign(velocity)
        steps = np.diff(time)
        before = velocity[:-1]
        share = before / np.where(before == velocity[1:], 1.0, before - velocity[1:])
        turning = np.flatnonzero(before * velocity[1:] < 0.0)
        turned = position[turning] + 0.5 * (before * steps * share)[turning]
        path = np.insert(position, turning + 1, turned)
        # assumed before the first instant: one step at its speed
        start = position[0] - velocity[0] * (steps[0] if len(steps) else 0.0)
        state = presliding_state(np.insert(path, 0, start), self.presliding)[1:]
        return np.delete(state, turning + 1 + np.arange(len(turning)))

    def columns(self, velocity: Array, direction: Array, load: Array | None = None) -> Array:
        """Return the columns of the k coefficients (k, ...) at speeds and directions (...).

        `load` is the transmitted torque (...) [N·m, N], see :meth:`FrictionTerm.column`.
        """
        rows = [term.column(velocity, direction, load) for term in self.terms]
        return np.reshape(rows, (len(rows), *np.shape(velocity)))

    def moving(self, velocity: Array) -> NDArray[np.bool_]:
        """Return which rows can be fitted: faster than standstill, or all in a linear zone."""
        if self.zone == "linear":
            return np.ones(np.shape(velocity), dtype=np.bool_)
        return np.asarray(np.abs(velocity) > self.standstill)


def presliding_state(position: Array, distance: float) -> Array:
    """Return Dahl's state z (m,) at positions (m,), zero at the first of them.

    In one direction it is ``s + (z0 - s) exp(-travel / distance)``.
    """
    steps = np.diff(position, prepend=position[:1])
    travel = np.cumsum(np.abs(steps))
    moved = np.flatnonzero(steps)
    state = np.zeros(len(position))
    if not moved.size:
        return state
    sign = np.sign(steps[moved])
    turns = np.append(0, np.flatnonzero(np.diff(sign)) + 1)
    starts = moved[turns]
    signs = sign[turns]
    stops = np.append(starts[1:], len(position))
    before = travel[starts - 1]
    value = 0.0
    for start, stop, s, origin in zip(starts, stops, signs, before, strict=True):
        part = s + (value - s) * np.exp((origin - travel[start:stop]) / distance)
        state[start:stop] = part
        value = part[-1]
    return state


class JointTerm(NamedTuple):
    """A term of one joint or motor."""

    name: str  # of the parameter: ``f0_3``, or ``f0_m6`` of a motor
    term: FrictionTerm
    owner: int  # joint or motor, from 0
    motor: bool  # whether it depends on the speed of a coupled motor
    unit: str  # at the joint

    @property
    def symbol(self) -> str:
        """Of the coefficient."""
        return self.term.symbol


@dataclass(frozen=True, eq=False)
class JointFriction:
    """Friction of n joints: k coefficients, term by term (all f0, all f1, ...), then motors."""

    laws: tuple[FrictionLaw, ...]  #: of each joint (n,)
    revolute: tuple[bool, ...]  #: whether each joint is revolute (n,), for units
    coupling: Coupling | None = None  #: of motors and joints, if any

    @property
    def n_joints(self) -> int:
        """Number n of joints."""
        return len(self.laws)

    @cached_property
    def motors(self) -> tuple[int, ...]:
        """Motors, from 0, with friction that depends on the speeds of several joints."""
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
            # other terms of a motor cannot be distinguished from those of the joints
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
        """Terms that any joint has, in order."""
        return tuple(kind for kind in TERMS if any(kind.of(law) for law in self.laws))

    @cached_property
    def has_load(self) -> bool:
        """Whether the friction of a joint depends on the torque that its gear transmits."""
        return any(law.load for law in self.laws)

    @property
    def standstill(self) -> Array:
        """Speed of each joint (n,) [rad/s or m/s] below which it counts as at rest."""
        return np.array([law.standstill for law in self.laws])

    @property
    def one_law(self) -> FrictionLaw | None:
        """The law of all joints, None if they differ."""
        return self.laws[0] if len(set(self.laws)) == 1 else None

    def motor_speeds(self) -> Array:
        """Return the speed of each of `motors` per joint speed (len(motors), n)."""
        if self.coupling is None or not self.motors:
            return np.zeros((0, self.n_joints))
        return self.coupling.speeds[list(self.motors)]

    def direction(self, motion: Motion) -> Array:
        """Return the direction of dry friction (m, n + k) of joints, then of `motors`."""
        time, position, velocity = motion.time, motion.position, motion.velocity
        joints = [
            law.direction(time, position[:, j], velocity[:, j]) for j, law in enumerate(self.laws)
        ]
        motors = [
            self.laws[motor].direction(time, position @ speed, velocity @ speed)
            for motor, speed in zip(self.motors, self.motor_speeds(), strict=True)
        ]
        return np.column_stack([*joints, *motors])

    def moving(self, velocity: Array) -> NDArray[np.bool_]:
        """Return which rows can be fitted (m, n), from joint speeds (m, n).

        The joint and every coupled motor that acts on it must be faster than standstill.
        """
        common_law = self.one_law
        if common_law is not None:
            moving = common_law.moving(velocity)
        else:
            rows = [law.moving(velocity[:, j]) for j, law in enumerate(self.laws)]
            moving = np.column_stack(rows)
        for motor, speed in zip(self.motors, self.motor_speeds(), strict=True):
            turning = self.laws[motor].moving(velocity @ speed)
            moving[:, speed != 0.0] &= turning[:, None]
        return moving

    def place(self, term: JointTerm) -> int:
        """Return the index of a term's joint or motor among the joints, then `motors`."""
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
    """Coefficients ``f = combine @ g`` with constraints on g."""

    combine: Array  # (k, k), invertible
    not_negative: NDArray[np.bool_]  # which g (k,) must not be negative


def dissipation(friction: JointFriction) -> Dissipation:
    """Return the conditions for friction to dissipate energy.

    f0, f0 + fs (value at rest of a Stribeck term), f1, or f1 + fd and f1 - fd, and fl are not
    negative. The third term and the offset, which may be a sensor's, can have any sign.
    """
    column = {(t.motor, t.owner, t.symbol): k for k, t in enumerate(friction.terms)}
    combine = np.eye(len(column))
    for k, (_, term, owner, motor, _) in enumerate(friction.terms):
        if term.pair is None:
            continue
        symbol, matrix = term.pair
        if (other := column.get((motor, owner, symbol))) is not None:
            combine[np.ix_([other, k], [other, k])] = matrix
    kinds = [joint_term.term.not_negative for joint_term in friction.terms]
    return Dissipation(combine, np.array(kinds, dtype=np.bool_))
