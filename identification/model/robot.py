"""A robot whose joint torques are linear in its dynamic parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from identification.errors import ModelError, ShapeError
from identification.model.base_parameters import TOLERANCE, BaseParameters, select_base, share_left
from identification.model.coupling import Coupling
from identification.model.elements import Element, ElementError, JointElements
from identification.model.friction import OFFSET, FrictionLaw, JointFriction
from identification.model.kinematics import Chain, chain_from_urdf
from identification.model.payload import Load, Payload
from identification.model.regressor import LINK_SYMBOLS, Regressor, RegressorPlan, joint_arrays

Array = NDArray[np.float64]
Places = NDArray[np.intp]

_N_LINK = len(LINK_SYMBOLS)
_N_SINGLE_DIGITS = 9


@dataclass(frozen=True)
class StandardLayout:
    """The s standard parameters: joint by joint ten of the link and a rotor, then couplings.

    A coupling inertia ``I45`` is the entry (4, 5) of the rotors' inertia matrix in joint
    coordinates: its column is the acceleration of joint 5 in the row of joint 4, and the other
    way round. Motors that turn with several joints make it.
    """

    revolute: tuple[bool, ...]  # whether each of the n joints turns
    rotor_inertia: bool  # whether joints have rotor inertias
    # joints (i, j), i < j from 0, that share a coupling inertia
    pairs: tuple[tuple[int, int], ...] = ()

    @property
    def n_joints(self) -> int:
        """Number n of joints."""
        return len(self.revolute)

    @property
    def width(self) -> int:
        """Parameters of one joint: ten, or eleven with a rotor."""
        return _N_LINK + self.rotor_inertia

    @property
    def size(self) -> int:
        """Number s of standard parameters."""
        return self.n_joints * self.width + len(self.pairs)

    @property
    def links(self) -> Places:
        """Places of the ten inertial parameters of each link (n, 10)."""
        return self._joint_blocks[:, :_N_LINK]

    @property
    def rotors(self) -> Places:
        """Places of the rotor inertias (n,), or (0,) without."""
        return self._joint_blocks[:, _N_LINK:].reshape(-1)

    @property
    def couplings(self) -> Places:
        """Places of the coupling inertias (c,), in the order of `pairs`."""
        return np.arange(self.n_joints * self.width, self.size)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names (s,), the joint's number where the field writes it: I3xy, mc2y, m4, I5m, I45."""
        symbols = LINK_SYMBOLS + (("Im",) if self.rotor_inertia else ())
        own = [_name(symbol, j) for j in range(1, self.n_joints + 1) for symbol in symbols]
        between = "" if self.n_joints <= _N_SINGLE_DIGITS else "_"
        return (*own, *(f"I{i + 1}{between}{j + 1}" for i, j in self.pairs))

    @cached_property
    def units(self) -> tuple[str, ...]:
        """Unit of each (s,)."""
        return tuple(self._unit(standard) for standard in range(self.size))

    def split(self, pivots: Sequence[int]) -> tuple[list[list[int]], list[bool], list[int]]:
        """Return what of each joint is among `pivots`: link symbols, rotor, and which couplings."""
        first, there = self.n_joints * self.width, set(map(int, pivots))
        joints = range(0, first, self.width)
        links = [[k for k in range(_N_LINK) if start + k in there] for start in joints]
        rotors = [self.rotor_inertia and start + _N_LINK in there for start in joints]
        return links, rotors, sorted(k - first for k in there if k >= first)

    def rotor_matrix(self, standard: Array) -> Array:
        """Return the rotors' inertia matrix in joint coordinates (n, n): positive if possible."""
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
    def _joint_blocks(self) -> Places:
        return np.arange(self.n_joints * self.width).reshape(self.n_joints, self.width)

    def _unit(self, standard: int) -> str:
        if standard >= self.n_joints * self.width:
            i, j = self.pairs[standard - self.n_joints * self.width]
            sliding = (not self.revolute[i]) + (not self.revolute[j])
            return ("kg m²", "kg m", "kg")[sliding]
        joint, symbol = divmod(standard, self.width)
        if symbol == _N_LINK:
            return "kg m²" if self.revolute[joint] else "kg"
        return {"I": "kg m²", "mc": "kg m", "m": "kg"}[LINK_SYMBOLS[symbol].rstrip("xyz")]


def _name(symbol: str, joint: int) -> str:
    letters = "mc" if symbol.startswith("mc") else symbol[0]
    return f"{letters}{joint}{symbol[len(letters) :]}"


STANDARD_GRAVITY = (0.0, 0.0, -9.81)

# States that excite every parameter of any arm; more than a few hundred change nothing.
_N_STATES = 300
_SEED = 20140901
_NO_LAWS: Final[Mapping[str, FrictionLaw]] = MappingProxyType({})
_NOT_LOCKED: Final[Mapping[str, float]] = MappingProxyType({})


@dataclass(frozen=True, eq=False)
class RobotModel:
    """Torque of an open chain, tau = W(q, qd, qdd) pi: base parameters and joint friction.

    Build it with :meth:`from_urdf`. Joints are numbered from 1 in parameter names; inertial
    parameters are about the joint frame's origin, in its axes, ``mc`` is mass times centre of
    mass, ``I`` the inertia tensor, ``I3m`` the rotor of joint 3 seen from the link side, ``I45``
    the coupling inertia of joints 4 and 5. A payload is known: its torque is no part of W pi, nor
    is that of springs and balancers of which the figures are given.
    """

    chain: Chain  #: geometry and nominal inertia as read from the URDF
    gravity: Array  #: acceleration of gravity in base axes [m/s²], shape (3,)
    layout: StandardLayout  #: where the s standard parameters stand
    friction: JointFriction  #: of every joint, and of coupled motors
    base: BaseParameters  #: the b base parameters and their grouping
    #: the p parameters: base, then friction (all f0, all f1, ...), then those of springs and
    #: balancers
    parameter_names: tuple[str, ...]
    units: tuple[str, ...]  #: unit of each parameter, shape (p,)
    plan: RegressorPlan = field(repr=False)  #: how the regressor is made
    #: position [rad or m] of joints of the description that are held
    locked: Mapping[str, float] = field(default_factory=dict)
    #: motors that turn with several joints; None where each joint has its own
    coupling: Coupling | None = None
    payload: Payload | None = None  #: what the arm carries; None for nothing
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
        """Build the model from URDF text.

        Args:
            urdf: the text of the file, not its path.
            gravity: in base axes [m/s²].
            rotor_inertia: give every joint a rotor inertia.
            friction: friction law of every joint.
            joint_friction: other laws for some joints, by name.
            locked: joints held at a position [rad or m], by name: no joints of the model.
            coupling: motors that turn with several joints, joints in the model's order.
            payload: a body of known mass that the arm carries.
            elements: springs and balancers.

        Raises:
            ModelError: the text is no open chain of revolute and prismatic joints, gravity is
                not a finite vector, a name is of no joint, the coupling is of another number of
                joints, or the torque of an offset or an element is that of other parameters.
        """
        chain = chain_from_urdf(urdf, locked)
        down = np.array(gravity, dtype=np.float64)
        if down.shape != (3,) or not np.all(np.isfinite(down)):
            raise ModelError(f"gravity is {gravity!r}; it must be three finite numbers [m/s²]")
        laws = _laws(chain, friction, joint_friction)
        if coupling is not None and coupling.n_joints != chain.n_joints:
            raise ModelError(
                f"the coupling is of {coupling.n_joints} joints, the robot has {chain.n_joints}"
            )
        revolute = tuple(bool(turns) for turns in chain.revolute)
        pairs = coupling.pairs if coupling is not None and coupling.inertia else ()
        layout = StandardLayout(revolute, rotor_inertia, pairs if rotor_inertia else ())
        all_friction = JointFriction(laws, revolute, coupling)
        beside = JointElements.of(elements, chain.joint_names, revolute)
        base = _base_parameters(chain, down, layout, all_friction, beside)
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
            **_parameters(chain, down, layout, base, all_friction, beside),
        )

    def with_friction(self, **changes: Any) -> RobotModel:
        """Return the model with other friction, as :class:`FrictionLaw` names its parts.

        Raises:
            ModelError: some joint's law would be none, see :class:`FrictionLaw`.
        """
        laws = tuple(replace(law, **changes) for law in self.friction.laws)
        return self._with(replace(self.friction, laws=laws), self.elements)

    def with_elements(self, more: Sequence[Element]) -> RobotModel:
        """Return the model with these elements behind its own, see :meth:`from_urdf`."""
        elements = JointElements.of(
            [*self.elements.elements, *more], self.joint_names, self.friction.revolute
        )
        return self._with(self.friction, elements)

    def _with(self, friction: JointFriction, elements: JointElements) -> RobotModel:
        own = self.chain, self.gravity, self.layout, self.base
        return replace(self, **_parameters(*own, friction, elements))

    def of_payload(self) -> RobotModel:
        """Return the model of what the arm carries: ten parameters about the last joint's frame.

        Everything else is known, and no part of the regressor.
        """
        return replace(
            self,
            parameter_names=LINK_SYMBOLS,
            units=tuple(self.layout.units[k] for k in self.layout.links[-1]),
            plan=RegressorPlan.of_bodies(self.chain, self.gravity, self.n_joints - 1),
        )

    @property
    def standard_names(self) -> tuple[str, ...]:
        """Names of the s standard parameters: link by link, then coupling inertias."""
        return self.layout.names

    @property
    def rotor_inertia(self) -> bool:
        """Whether every joint has a rotor inertia (column: its acceleration)."""
        return self.layout.rotor_inertia

    @property
    def friction_columns(self) -> NDArray[np.bool_]:
        """Which of the p parameters are friction (p,): all coefficients but offsets."""
        columns = np.zeros(self.n_parameters, dtype=np.bool_)
        columns[self.friction_part] = self.friction.dissipating
        return columns

    @property
    def friction_part(self) -> slice:
        """Where the k friction coefficients stand among the p parameters."""
        return slice(self.base.rank, self.base.rank + len(self.friction.terms))

    @property
    def element_part(self) -> slice:
        """Where the e parameters of springs and balancers stand among the p parameters."""
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
        """Standard parameters as the URDF gives them, rotors and couplings zero, shape (s,)."""
        values = np.zeros(self.layout.size)
        values[self.layout.links] = self.chain.inertial
        return values

    def regressor(
        self, q: Array, qd: Array, qdd: Array, direction: Array | None = None
    ) -> Regressor:
        """Return W for m samples of motion, each array (m, n).

        `direction` (m, n + k) is that of dry friction, see :attr:`Motion.direction`; without it
        the sign of the velocity.

        Raises:
            ShapeError: an array does not have that shape.
        """
        q, qd, qdd = joint_arrays(self.n_joints, q=q, qd=qd, qdd=qdd)
        return self.plan.evaluate(q, qd, qdd, direction)

    def torque(
        self,
        values: Array,
        q: Array,
        qd: Array,
        qdd: Array,
        direction: Array | None = None,
    ) -> Array:
        """Return the joint torques [N·m, N] for parameter values (p,), shape (m, n).

        Without what is known: see :meth:`load_torque`; `direction` as in :meth:`regressor`.

        Raises:
            ShapeError: an array does not have the shape it should have.
        """
        values = np.asarray(values, dtype=np.float64)
        if values.shape != (self.n_parameters,):
            raise ShapeError("values", values.shape, f"({self.n_parameters},)")
        q, qd, qdd = joint_arrays(self.n_joints, q=q, qd=qd, qdd=qdd)
        return self.plan.torque(values, q, qd, qdd, direction)

    @property
    def has_load(self) -> bool:
        """Whether a payload or an element has a known torque."""
        return self._load is not None or bool(self.elements.placed)

    def load_torque(self, q: Array, qd: Array, qdd: Array) -> Array:
        """Return the known torque [N·m, N] of payload, springs and balancers (m, n).

        Zero without any; it is no part of W pi.

        Raises:
            ShapeError: an array does not have the shape it should have.
        """
        (q,) = joint_arrays(self.n_joints, q=q)
        torque = self.elements.known(q)
        return torque if self._load is None else torque + self._load.torque(q, qd, qdd)

    def moving(self, qd: Array) -> NDArray[np.bool_]:
        """Return where each joint's friction law can be fitted, shape (m, n).

        Faster than its standstill, or anywhere in a linear zone.
        """
        (qd,) = joint_arrays(self.n_joints, qd=qd)
        return self.friction.moving(qd)


def _laws(
    chain: Chain, law: FrictionLaw, others: Mapping[str, FrictionLaw]
) -> tuple[FrictionLaw, ...]:
    """Return the friction law of each joint."""
    for name in others:
        if name not in chain.joint_names:
            raise ModelError(
                f"there is no joint {name!r} to have a friction law of its own; there are"
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
    """What of a model follows from its friction and elements."""
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
    everything = np.arange(layout.size, dtype=np.intp)
    random = np.random.default_rng(_SEED)
    shape = (_N_STATES, chain.n_joints)
    q = random.uniform(-np.pi, np.pi, shape)
    qd = random.uniform(-3.0, 3.0, shape)
    qdd = random.uniform(-10.0, 10.0, shape)
    plan = _plan(chain, gravity, layout, everything, None)
    rows = plan.evaluate(q, qd, qdd).dense(layout.size).reshape(-1, layout.size)
    base = select_base(rows, layout.names, layout.units)
    _refuse_weight_as_offset(chain, friction, rows[:, base.pivots])
    _refuse_known_shape(friction, elements, rows[:, base.pivots], q)
    return base


def _refuse_weight_as_offset(chain: Chain, friction: JointFriction, columns: Array) -> None:
    """Refuse an offset whose column, constant on one joint, the inertial columns contain."""
    n = chain.n_joints
    if OFFSET not in friction.kinds:
        return
    offsets = np.tile(np.eye(n), (len(columns) // n, 1))
    for joint, share in enumerate(share_left(offsets, columns)):
        if share <= TOLERANCE and OFFSET.symbol in friction.laws[joint].symbols:
            name = chain.joint_names[joint]
            raise ModelError(
                f"joint {name!r} slides along gravity and has a rotor inertia: the offset of its "
                "friction and the weight it carries cannot be distinguished; leave out the offset "
                "(asymmetric friction has one) or the rotor inertias",
                joint=name,
            )


def _refuse_known_shape(
    friction: JointFriction, elements: JointElements, columns: Array, q: Array
) -> None:
    """Refuse an element whose column the others contain, such as a weight's or an offset's."""
    m, n = q.shape
    offsets = [j for j, law in enumerate(friction.laws) if OFFSET.symbol in law.symbols]
    columns = np.column_stack([columns, np.tile(np.eye(n)[:, offsets], (m, 1))])
    for one in elements.identified:
        own, owner = one.columns(q), one.element.joint
        for k, name in enumerate(elements.names[one.part]):
            torque = np.zeros((m, n))
            torque[:, one.joint] = own[:, k]
            column = torque.reshape(-1, 1)
            if share_left(column, columns)[0] <= TOLERANCE:
                raise ElementError(
                    f"the torque of {name} on joint {owner!r} has the same form as that of"
                    " other parameters, such as a weight, and cannot be separated from it; give its"
                    " figures, with identified = false",
                    joint=owner,
                )
            columns = np.column_stack([columns, column])
