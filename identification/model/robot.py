"""A robot whose joint torques are linear in its dynamic parameters."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array, Indices
from identification.errors import ModelError, ShapeError
from identification.model.base_parameters import (
    DEPENDENCE_TOLERANCE,
    BaseParameters,
    select_base,
    share_left,
)
from identification.model.coupling import Coupling
from identification.model.elements import Element, ElementError, JointElements, PeriodicTorque
from identification.model.friction import OFFSET, FrictionLaw, JointFriction
from identification.model.kinematics import Chain, chain_from_urdf
from identification.model.known_payload import Load, Payload
from identification.model.link_wrenches import LINK_SYMBOLS, N_LINK
from identification.model.motion import Motion, joint_arrays
from identification.model.regressor import Regressor, RegressorPlan

_N_SINGLE_DIGITS = 9
_NO_ROTOR_RATIO = 1e-7  # of the largest parameter of the link: what a solver leaves of zero


@dataclass(frozen=True)
class StandardLayout:
    """The s standard parameters: per joint ten of the link and a rotor inertia, then couplings.

    A coupling inertia ``I45`` is the entry (4, 5) of the inertia matrix of the rotors in joint
    coordinates, due to motors that turn with several joints.
    """

    revolute: tuple[bool, ...]  # whether each of the n joints is revolute
    rotor_inertia: bool  # whether joints have rotor inertias
    pairs: tuple[tuple[int, int], ...] = ()  # joints (i, j), i < j from 0, with coupling inertia

    @property
    def n_joints(self) -> int:
        """Number n of joints."""
        return len(self.revolute)

    @property
    def width(self) -> int:
        """Parameters of one joint: ten, or eleven with a rotor."""
        return N_LINK + self.rotor_inertia

    @property
    def size(self) -> int:
        """Number s of standard parameters."""
        return self.n_joints * self.width + len(self.pairs)

    @cached_property
    def links(self) -> Indices:
        """Indices of the ten inertial parameters of each link (n, 10)."""
        return self._joint_blocks[:, :N_LINK]

    @cached_property
    def rotors(self) -> Indices:
        """Indices of the rotor inertias (n,), or (0,)."""
        return self._joint_blocks[:, N_LINK:].reshape(-1)

    @property
    def couplings(self) -> Indices:
        """Indices of the coupling inertias (c,), in the order of `pairs`."""
        return np.arange(self.n_joints * self.width, self.size)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names (s,): I3xy, mc2y, m4, I5m, I45."""
        symbols = LINK_SYMBOLS + (("Im",) if self.rotor_inertia else ())
        links = [_name(symbol, j) for j in range(1, self.n_joints + 1) for symbol in symbols]
        between = "" if self.n_joints <= _N_SINGLE_DIGITS else "_"
        return (*links, *(f"I{i + 1}{between}{j + 1}" for i, j in self.pairs))

    @cached_property
    def units(self) -> tuple[str, ...]:
        """Unit of each (s,)."""
        return tuple(self._unit(standard) for standard in range(self.size))

    def split(self, pivots: Sequence[int]) -> tuple[list[list[int]], list[bool], list[int]]:
        """Return the link symbols and rotors per joint, and the couplings, among `pivots`."""
        first = self.n_joints * self.width
        there = set(map(int, pivots))
        joints = range(0, first, self.width)
        links = [[k for k in range(N_LINK) if start + k in there] for start in joints]
        rotors = [self.rotor_inertia and start + N_LINK in there for start in joints]
        return links, rotors, sorted(k - first for k in there if k >= first)

    def rotors_at_bound(self, standard: Array) -> NDArray[np.bool_]:
        """Return whose rotor inertia is zero (n,) except for rounding, as no torque shows one."""
        values = self.checked(standard)
        if not self.rotor_inertia:
            return np.zeros(self.n_joints, dtype=np.bool_)
        inertia = np.abs(values[self.links]).max(axis=1)
        return np.asarray(values[self.rotors] <= _NO_ROTOR_RATIO * inertia)

    def rotor_matrix(self, standard: Array) -> Array:
        """Return the inertia matrix of the rotors in joint coordinates (n, n)."""
        values = self.checked(standard)
        matrix = np.zeros((self.n_joints, self.n_joints))
        if self.rotor_inertia:
            np.fill_diagonal(matrix, values[self.rotors])
        for (i, j), value in zip(self.pairs, values[self.couplings], strict=True):
            matrix[i, j] = matrix[j, i] = value
        return matrix

    def checked(self, standard: Array) -> Array:
        """Return standard parameters (s,) as float64.

        Raises:
            ShapeError: they have another shape.
        """
        values = np.asarray(standard, dtype=np.float64)
        if values.shape != (self.size,):
            raise ShapeError("standard", values.shape, f"({self.size},)")
        return values

    @property
    def _joint_blocks(self) -> Indices:
        return np.arange(self.n_joints * self.width).reshape(self.n_joints, self.width)

    def _unit(self, standard: int) -> str:
        if standard >= self.n_joints * self.width:
            i, j = self.pairs[standard - self.n_joints * self.width]
            sliding = (not self.revolute[i]) + (not self.revolute[j])
            return ("kg·m²", "kg·m", "kg")[sliding]
        joint, symbol = divmod(standard, self.width)
        if symbol == N_LINK:
            return "kg·m²" if self.revolute[joint] else "kg"
        return {"I": "kg·m²", "mc": "kg·m", "m": "kg"}[LINK_SYMBOLS[symbol].rstrip("xyz")]


def _name(symbol: str, joint: int) -> str:
    letters = "mc" if symbol.startswith("mc") else symbol[0]
    return f"{letters}{joint}{symbol[len(letters) :]}"


STANDARD_GRAVITY = (0.0, 0.0, -9.81)

_RANDOM_STATES: Final = 100  # each has a row for each joint, which has twelve columns at most
_SEED = 20140901
_NO_LAWS: Final[Mapping[str, FrictionLaw]] = MappingProxyType({})
_NOT_LOCKED: Final[Mapping[str, float]] = MappingProxyType({})


@dataclass(frozen=True, eq=False)
class RobotModel:
    """Torque of an open chain, tau = W(q, qd, qdd) pi: base parameters and joint friction.

    Create it with :meth:`from_urdf`. Parameter names number joints from 1. Inertial parameters
    are about the origin of the joint frame, in its axes: ``mc`` is mass times centre of mass,
    ``I`` the inertia tensor, ``I3m`` the rotor inertia of joint 3 on the link side, ``I45`` the
    coupling inertia of joints 4 and 5. The torque of a payload and of known springs and balancers
    is not part of W pi, see :meth:`load_torque`.
    """

    chain: Chain  #: geometry and nominal inertia of the URDF
    gravity: Array  #: acceleration of gravity in base axes [m/s²], shape (3,)
    layout: StandardLayout  #: of the s standard parameters
    friction: JointFriction  #: of all joints and coupled motors
    base: BaseParameters  #: the b base parameters and their grouping
    #: the p parameters: base, friction (all f0, all f1, ...), springs and balancers
    parameter_names: tuple[str, ...]
    units: tuple[str, ...]  #: unit of each parameter, shape (p,)
    plan: RegressorPlan = field(repr=False)  #: computes the regressor
    #: positions [rad or m] of joints of the description that are fixed
    locked: Mapping[str, float] = field(default_factory=dict)
    coupling: Coupling | None = None  #: of motors and joints, if any
    payload: Payload | None = None  #: carried by the arm, if any
    elements: JointElements = field(default_factory=JointElements)  #: springs and balancers
    _load: Load | None = field(default=None, repr=False)

    @classmethod
    def from_urdf(
        cls,
        urdf: str,
        *,
        gravity: Sequence[float] = STANDARD_GRAVITY,
        rotor_inertia: bool = True,
        friction: FrictionLaw = FrictionLaw(),  # noqa: B008 - frozen
        joint_friction: Mapping[str, FrictionLaw] = _NO_LAWS,
        locked: Mapping[str, float] = _NOT_LOCKED,
        coupling: Coupling | None = None,
        payload: Payload | None = None,
        elements: Sequence[Element] = (),
    ) -> RobotModel:
        """Create the model from URDF text.

        Args:
            urdf: text.
            gravity: (3,) [m/s²] in base axes.
            rotor_inertia: whether rotors have parameters.
            friction: law of the joints.
            joint_friction: laws of joints that differ, by name.
            locked: positions of joints to be fixed, by name [rad or m].
            coupling: of motors and joints.
            payload: known, at the flange.
            elements: springs, balancers and counterweights.

        Raises:
            ModelError: the text is not an open chain of revolute and prismatic joints, there is no
                joint of a name, or an element cannot be separated from other parameters.
        """
        chain = chain_from_urdf(urdf, locked)
        down = np.array(gravity, dtype=np.float64)
        laws = _laws(chain, friction, joint_friction)
        revolute = tuple(bool(turns) for turns in chain.revolute)
        pairs = coupling.pairs if coupling is not None and coupling.inertia else ()
        layout = StandardLayout(revolute, rotor_inertia, pairs if rotor_inertia else ())
        all_friction = JointFriction(laws, revolute, coupling)
        placed = JointElements.of(elements, chain.joint_names, revolute)
        base = _base_parameters(chain, down, layout, all_friction, placed)
        load = None if payload is None else Load(chain, down, payload)
        return cls(
            chain=chain,
            gravity=down,
            layout=layout,
            base=base,
            locked=dict(locked),
            coupling=coupling,
            payload=payload,
            _load=load,
            **_parameters(chain, down, layout, base, all_friction, placed),
        )

    def with_friction(self, **changes: Any) -> RobotModel:
        """Return the model with changed entries of the table `[robot.friction]` of each joint.

        Raises:
            ModelError: an invalid friction law.
        """
        return self.with_friction_laws([law.changed(changes) for law in self.friction.laws])

    def with_friction_laws(self, laws: Sequence[FrictionLaw]) -> RobotModel:
        """Return the model with these friction laws of its joints, in their order."""
        return self._with(replace(self.friction, laws=tuple(laws)), self.elements)

    def under_gravity(self, gravity: Sequence[float]) -> RobotModel:
        """Return the model with another acceleration of gravity (3,) in base axes [m/s²].

        It may have other base parameters: without gravity fewer are determined. A weaker or
        stronger gravity in the same direction determines the same.
        """
        down = np.array(gravity, dtype=np.float64)
        base = self.base
        if not _is_parallel(down, self.gravity):
            base = _base_parameters(self.chain, down, self.layout, self.friction, self.elements)
        load = None if self.payload is None else Load(self.chain, down, self.payload)
        parts = _parameters(self.chain, down, self.layout, base, self.friction, self.elements)
        return replace(self, base=base, _load=load, **{**parts, "gravity": down})

    def with_elements(self, more: Sequence[Element]) -> RobotModel:
        """Return the model with more elements, see :meth:`from_urdf`."""
        elements = JointElements.of(
            [*self.elements.elements, *more], self.joint_names, self.friction.revolute
        )
        return self._with(self.friction, elements)

    def _with(self, friction: JointFriction, elements: JointElements) -> RobotModel:
        base = self.base
        if not all(self.chain.revolute):  # an offset can change them
            base = _base_parameters(self.chain, self.gravity, self.layout, friction, elements)
        parts = self.chain, self.gravity, self.layout, base
        return replace(self, base=base, **_parameters(*parts, friction, elements))

    def expressions(self) -> tuple[str, ...]:
        """Return each of the p parameters as a formula of standard parameters."""
        others = map(self.base.expression, self.parameter_names[self.base.rank :])
        return (*self.base.expressions(), *others)

    @property
    def friction_columns(self) -> NDArray[np.bool_]:
        """Which of the p parameters are friction (p,), without offsets."""
        columns = np.zeros(self.n_parameters, dtype=np.bool_)
        columns[self.friction_part] = [
            friction_term.term.is_friction for friction_term in self.friction.terms
        ]
        return columns

    @property
    def friction_part(self) -> slice:
        """Slice of the k friction coefficients among the p parameters."""
        return slice(self.base.rank, self.base.rank + len(self.friction.terms))

    @property
    def element_part(self) -> slice:
        """Slice of the e parameters of springs and balancers among the p parameters."""
        return slice(self.friction_part.stop, self.n_parameters)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the n joints, in the order of all joint arrays."""
        return self.chain.joint_names

    @property
    def n_joints(self) -> int:
        """Number n of joints."""
        return self.chain.n_joints

    @property
    def n_parameters(self) -> int:
        """Number p of parameters."""
        return len(self.parameter_names)

    @property
    def nominal(self) -> Array:
        """Standard parameters of the URDF, rotors and couplings zero, shape (s,)."""
        values = np.zeros(self.layout.size)
        values[self.layout.links] = self.chain.inertial
        return values

    @property
    def nominal_values(self) -> Array:
        """Parameters (p,) of the URDF's bodies and of nominal springs, without friction."""
        values = np.zeros(self.n_parameters)
        values[: self.base.rank] = self.base.grouping @ self.nominal
        values[self.element_part] = self.elements.nominal
        return values

    def regressor(self, motion: Motion) -> Regressor:
        """Return W for m samples of motion; without a load, the URDF's bodies are the load.

        Raises:
            ShapeError: an array has another shape.
        """
        return self.plan.evaluate(self.with_gear_load(motion.checked(self.n_joints)))

    def chunks(
        self, motion: Motion, *, response: Array | None = None
    ) -> Iterator[tuple[slice, list[Array]]]:
        """Yield W in chunks, see :meth:`RegressorPlan.chunks`; the load as in :meth:`regressor`.

        Raises:
            ShapeError: an array has another shape.
        """
        motion = self.with_gear_load(motion.checked(self.n_joints))
        return self.plan.chunks(motion, response=response)

    def torque(self, values: Array, motion: Motion) -> Array:
        """Return the joint torques [N·m, N] of parameter values (p,), shape (m, n).

        Without :meth:`load_torque`; an unknown load of the motion is computed from the values.

        Raises:
            ShapeError: an array has another shape.
        """
        values = self._checked(values)
        motion = motion.checked(self.n_joints)
        if self.friction.has_load and motion.load is None:
            motion = replace(motion, load=self.gear_torque(values, motion))
        return self.plan.torque(values, motion)

    def joint_inertia(self, values: Array, q: Array) -> Array:
        """Return the inertia of the joints (m, n, n) by parameters (p,) at positions (m, n).

        Symmetric; positive definite for bodies and rotors that exist.

        Raises:
            ShapeError: an array has another shape.
        """
        rigid = self._checked(values).copy()
        rigid[self.base.rank :] = 0.0
        (q,) = joint_arrays(self.n_joints, q=q)
        rest = Motion.at_rest(q)
        weight = self.plan.torque(rigid, rest)
        columns = [
            self.plan.torque(rigid, replace(rest, acceleration=rest.acceleration + unit))
            for unit in np.eye(q.shape[1])
        ]
        return np.stack([column - weight for column in columns], axis=-1)

    def gear_torque(self, values: Array, motion: Motion) -> Array:
        """Return the torque [N·m, N] that the gears transmit, of parameters (p,), shape (m, n).

        That of the bodies, the payload, springs and balancers; without friction, offsets, torque
        ripple and the inertia of rotors, as far as it can be separated from the bodies.

        Raises:
            ShapeError: an array has another shape.
        """
        transmitted = np.where(self._transmitted, self._checked(values), 0.0)
        motion = motion.checked(self.n_joints).kinematics()
        return self.plan.torque(transmitted, motion) + self.load_torque(motion)

    def with_gear_load(self, motion: Motion) -> Motion:
        """Return the motion with the transmitted torque that load-dependent friction needs.

        A known load, else the load of the URDF's bodies and nominal springs and balancers.
        """
        if not self.friction.has_load or motion.load is not None:
            return motion
        return replace(motion, load=self.gear_torque(self.nominal_values, motion))

    def _checked(self, values: Array) -> Array:
        values = np.asarray(values, dtype=np.float64)
        if values.shape != (self.n_parameters,):
            raise ShapeError("values", values.shape, f"({self.n_parameters},)")
        return values

    @property
    def _transmitted(self) -> NDArray[np.bool_]:
        """Which parameters (p,) have a torque that the gears transmit."""
        drives = [*self.layout.rotors, *self.layout.couplings]
        transmitted = np.zeros(self.n_parameters, dtype=np.bool_)
        transmitted[: self.base.rank] = ~np.isin(self.base.pivots, drives)
        for placed in self.elements.identified:
            is_periodic = isinstance(placed.element, PeriodicTorque)
            transmitted[self.element_part][placed.part] = not is_periodic
        return transmitted

    @property
    def has_load(self) -> bool:
        """Whether a payload or an element has a known torque."""
        return self._load is not None or bool(self.elements.placed)

    def load_torque(self, motion: Motion) -> Array:
        """Return the known torque [N·m, N] of payload, springs and balancers (m, n).

        Raises:
            ShapeError: an array has another shape.
        """
        (position,) = joint_arrays(self.n_joints, position=motion.position)
        torque = self.elements.known_torque(position)
        return torque if self._load is None else torque + self._load.torque(motion)

    def moving(self, qd: Array) -> NDArray[np.bool_]:
        """Return which rows can be fitted, shape (m, n); see :meth:`JointFriction.moving`."""
        (qd,) = joint_arrays(self.n_joints, qd=qd)
        return self.friction.moving(qd)


def _is_parallel(a: Array, b: Array) -> bool:
    """Return whether two vectors (3,) have the same direction; zero has none."""
    sizes = float(np.linalg.norm(a) * np.linalg.norm(b))
    return sizes > 0.0 and float(a @ b) > (1.0 - 1e-12) * sizes


def _laws(
    chain: Chain, law: FrictionLaw, others: Mapping[str, FrictionLaw]
) -> tuple[FrictionLaw, ...]:
    """Return the friction law of each joint."""
    for name in others:
        if name not in chain.joint_names:
            raise ModelError(
                f"there is no joint {name!r} for a friction law; there are"
                f" {', '.join(chain.joint_names)}"
            )
    return tuple(others.get(name, law) for name in chain.joint_names)


def _parameters(
    chain: Chain,
    gravity: Array,
    layout: StandardLayout,
    base: BaseParameters,
    friction: JointFriction,
    elements: JointElements,
) -> dict[str, Any]:
    """Return the fields of a model that depend on friction and elements."""
    return {
        "friction": friction,
        "elements": elements,
        "parameter_names": base.names + friction.names + elements.names,
        "units": (*(layout.units[k] for k in base.pivots), *friction.units, *elements.units),
        "plan": _plan(chain, gravity, layout, base.pivots, friction, elements),
    }


def _plan(
    chain: Chain,
    gravity: Array,
    layout: StandardLayout,
    pivots: NDArray[np.intp],
    friction: JointFriction | None,
    elements: JointElements | None = None,
) -> RegressorPlan:
    links, rotors, couplings = layout.split(pivots.tolist())
    pairs = [layout.pairs[k] for k in couplings]
    return RegressorPlan(chain, gravity, links, rotors, friction, pairs, elements)


def _base_parameters(
    chain: Chain,
    gravity: Array,
    layout: StandardLayout,
    friction: JointFriction,
    elements: JointElements,
) -> BaseParameters:
    bodies = _base_of_bodies(_Geometry(chain, gravity), layout)
    base = _without_carried_rotors(layout, friction, bodies)
    _require_separate_elements(friction, elements, bodies.rows[:, base.pivots], bodies.position)
    return base


class _Geometry:
    """A chain under a gravity, equal to chains with the same joints, whatever the links weigh."""

    def __init__(self, chain: Chain, gravity: Array) -> None:
        self.chain = chain
        self.gravity = gravity
        parts = (chain.parents, chain.rotation, chain.translation, chain.axis, chain.revolute)
        self._content = tuple(part.tobytes() for part in (*parts, gravity))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Geometry) and self._content == other._content

    def __hash__(self) -> int:
        return hash(self._content)


class _BaseOfBodies(NamedTuple):
    """Base parameters of bodies and rotors, with what they were found by."""

    base: BaseParameters
    rows: Array  # regressor of standard parameters (m n, s) at random states
    position: Array  # of these states (m, n)
    constant: NDArray[np.bool_]  # joints (n,) of which they make any constant torque


@lru_cache(maxsize=32)  # one arm has models of several mountings, and of drives and friction
def _base_of_bodies(geometry: _Geometry, layout: StandardLayout) -> _BaseOfBodies:
    chain, gravity = geometry.chain, geometry.gravity
    everything = np.arange(layout.size, dtype=np.intp)
    random = np.random.default_rng(_SEED)
    shape = (_RANDOM_STATES, chain.n_joints)
    q = random.uniform(-np.pi, np.pi, shape)
    qd = random.uniform(-3.0, 3.0, shape)
    qdd = random.uniform(-10.0, 10.0, shape)
    states = Motion.of_states(q, qd, qdd)
    plan = _plan(chain, gravity, layout, everything, None)
    rows = plan.evaluate(states).dense(layout.size).reshape(-1, layout.size)
    base = select_base(rows, layout.names, layout.units)
    left = share_left(_offsets(rows, chain.n_joints), rows[:, base.pivots])
    return _BaseOfBodies(base, rows, q, left <= DEPENDENCE_TOLERANCE)


def _offsets(rows: Array, joints: int) -> Array:
    """Return the columns of constant torques of the joints in rows of a regressor (m n, n)."""
    return np.tile(np.eye(joints), (len(rows) // joints, 1))


def _without_carried_rotors(
    layout: StandardLayout, friction: JointFriction, bodies: _BaseOfBodies
) -> BaseParameters:
    """Return the base parameters with each offset of friction independent of them.

    On a prismatic joint along gravity with a rotor inertia they are not: the weight M g of the
    carried mass M and the offset are one constant force. Such a rotor inertia I is lumped into the
    mass, M + I, and the offset is the rest of the force, fo - g I: both can have any value then.
    """
    with_offset = [OFFSET.symbol in law.symbols for law in friction.laws]
    joints = np.flatnonzero(bodies.constant & np.array(with_offset))
    if not joints.size:
        return bodies.base
    rows = bodies.rows
    offsets = _offsets(rows, friction.n_joints)
    rotors = [layout.names.index(f"I{joint + 1}m") for joint in joints]
    regressor = rows.copy()
    regressor[:, rotors] = 0.0
    base = select_base(regressor, layout.names, layout.units)
    names = [*base.names, *(f"{OFFSET.symbol}_{joint + 1}" for joint in joints)]
    columns = np.column_stack([regressor[:, base.pivots], offsets[:, joints]])
    factors = np.linalg.lstsq(columns, rows[:, rotors], rcond=None)[0]
    lumped: dict[str, list[tuple[float, str]]] = {}
    for row, column in zip(*np.nonzero(np.abs(factors) > DEPENDENCE_TOLERANCE), strict=True):
        term = float(factors[row, column]), layout.names[rotors[column]]
        lumped.setdefault(names[row], []).append(term)
    return replace(base, lumped=lumped)


def _require_separate_elements(
    friction: JointFriction, elements: JointElements, columns: Array, q: Array
) -> None:
    """Check that the columns of elements are independent of all others."""
    if not elements.identified:
        return
    m, n = q.shape
    offsets = [j for j, law in enumerate(friction.laws) if OFFSET.symbol in law.symbols]
    columns = np.column_stack([columns, np.tile(np.eye(n)[:, offsets], (m, 1))])
    for placed in elements.identified:
        values = placed.columns(q)
        owner = placed.element.joint
        for k, name in enumerate(elements.names[placed.part]):
            torque = np.zeros((m, n))
            torque[:, placed.joint] = values[:, k]
            column = torque.reshape(-1, 1)
            if share_left(column, columns)[0] <= DEPENDENCE_TOLERANCE:
                raise ElementError(
                    f"the torque of {name} on joint {owner!r} cannot be distinguished from that of"
                    " other parameters, such as a weight; state its values, with"
                    " identified = false",
                    joint=owner,
                )
            columns = np.column_stack([columns, column])
