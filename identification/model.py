"""A robot whose joint torques are linear in its dynamic parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from identification.base_parameters import TOLERANCE, BaseParameters, select_base, share_left
from identification.errors import ModelError, ShapeError
from identification.friction import FrictionLaw
from identification.kinematics import Chain, chain_from_urdf
from identification.regressor import Regressor, RegressorPlan, joint_arrays
from identification.wrench import LINK_SYMBOLS

Array = NDArray[np.float64]

STANDARD_GRAVITY = (0.0, 0.0, -9.81)

# States that excite every parameter of any arm; more than a few hundred change nothing.
_N_STATES = 300
_SEED = 20140901


@dataclass(frozen=True, eq=False)
class RobotModel:
    """Torque of an open chain, tau = W(q, qd, qdd) pi: base parameters and joint friction.

    Build it with :meth:`from_urdf`. Joints are numbered from 1 in parameter names; inertial
    parameters are about the joint frame's origin, in its axes, ``mc`` is mass times centre of
    mass, ``I`` the inertia tensor, ``I3m`` the rotor of joint 3 seen from the link side.

    Attributes:
        chain: geometry and nominal inertia as read from the URDF.
        gravity: acceleration of gravity in base axes [m/s²], shape (3,).
        rotor_inertia: whether every joint has a rotor inertia (column: its acceleration).
        friction: friction law of every joint.
        standard_names: the s standard parameters, link by link.
        base: the b base parameters and their grouping.
        parameter_names: the p parameters: base, then friction (all f0, all f1, ...).
        units: unit of each parameter, shape (p,).
        plan: how the regressor is made.
    """

    chain: Chain
    gravity: Array
    rotor_inertia: bool
    friction: FrictionLaw
    standard_names: tuple[str, ...]
    base: BaseParameters
    parameter_names: tuple[str, ...]
    units: tuple[str, ...]
    plan: RegressorPlan = field(repr=False)

    @classmethod
    def from_urdf(
        cls,
        urdf: str,
        *,
        gravity: Sequence[float] = STANDARD_GRAVITY,
        rotor_inertia: bool = True,
        friction: FrictionLaw = FrictionLaw(),  # noqa: B008 - frozen
    ) -> RobotModel:
        """Build the model from URDF text.

        Args:
            urdf: the text of the file, not its path.
            gravity: in base axes [m/s²].
            rotor_inertia: give every joint a rotor inertia.
            friction: friction law of every joint.

        Raises:
            ModelError: the text is no open chain of revolute and prismatic joints, gravity is
                not a finite vector, or a friction offset cannot be told from a weight.
        """
        chain = chain_from_urdf(urdf)
        down = np.array(gravity, dtype=np.float64)
        if down.shape != (3,) or not np.all(np.isfinite(down)):
            raise ModelError(f"gravity is {gravity!r}; it must be three finite numbers [m/s²]")
        names = _standard_names(chain.n_joints, rotor_inertia)
        base = _base_parameters(chain, down, rotor_inertia, friction, names)
        friction_units = (
            friction.unit(s, revolute=bool(r)) for s in friction.symbols for r in chain.revolute
        )
        return cls(
            chain=chain,
            gravity=down,
            rotor_inertia=rotor_inertia,
            friction=friction,
            standard_names=names,
            base=base,
            parameter_names=base.names + friction.names(chain.n_joints),
            units=tuple(_unit(chain, int(k), rotor_inertia) for k in base.kept)
            + tuple(friction_units),
            plan=_plan(chain, down, base.kept, rotor_inertia, friction),
        )

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
        """Standard parameters as the URDF gives them, rotors zero, shape (s,)."""
        width = _width(self.rotor_inertia)
        values = np.zeros((self.n_joints, width))
        values[:, : len(LINK_SYMBOLS)] = self.chain.inertial
        return values.reshape(-1)

    def regressor(self, q: Array, qd: Array, qdd: Array) -> Regressor:
        """Return W for m samples of motion, each array (m, n).

        Raises:
            ShapeError: an array does not have that shape.
        """
        q, qd, qdd = joint_arrays(self.n_joints, q=q, qd=qd, qdd=qdd)
        return self.plan.evaluate(q, qd, qdd)

    def torque(self, values: Array, q: Array, qd: Array, qdd: Array) -> Array:
        """Return the joint torques [N·m, N] for parameter values (p,), shape (m, n).

        Raises:
            ShapeError: an array does not have the shape it should have.
        """
        values = np.asarray(values, dtype=np.float64)
        if values.shape != (self.n_parameters,):
            raise ShapeError("values", values.shape, f"({self.n_parameters},)")
        q, qd, qdd = joint_arrays(self.n_joints, q=q, qd=qd, qdd=qdd)
        torque = np.empty(q.shape)
        weights = [values[columns] for columns in self.plan.columns]
        for part, rows in self.plan.chunks(q, qd, qdd):
            for joint, block in enumerate(rows):
                torque[part, joint] = weights[joint] @ block
        return torque

    def moving(self, qd: Array) -> NDArray[np.bool_]:
        """Return where each joint is faster than the friction law's standstill, shape (m, n)."""
        (qd,) = joint_arrays(self.n_joints, qd=qd)
        return self.friction.moving(qd)


def _width(rotor_inertia: bool) -> int:
    return len(LINK_SYMBOLS) + rotor_inertia


def _standard_names(n_joints: int, rotor_inertia: bool) -> tuple[str, ...]:
    symbols = LINK_SYMBOLS + (("Im",) if rotor_inertia else ())
    return tuple(_name(symbol, joint) for joint in range(1, n_joints + 1) for symbol in symbols)


def _name(symbol: str, joint: int) -> str:
    """Put the joint number where the field writes it: I3xy, mc2y, m4, I5m."""
    letters = "mc" if symbol.startswith("mc") else symbol[0]
    return f"{letters}{joint}{symbol[len(letters) :]}"


def _unit(chain: Chain, standard: int, rotor_inertia: bool) -> str:
    joint, symbol = divmod(standard, _width(rotor_inertia))
    if symbol == len(LINK_SYMBOLS):
        return "kg m²" if chain.revolute[joint] else "kg"
    name = LINK_SYMBOLS[symbol]
    return {"I": "kg m²", "mc": "kg m", "m": "kg"}[name.rstrip("xyz")]


def _plan(
    chain: Chain,
    gravity: Array,
    kept: NDArray[np.intp],
    rotor_inertia: bool,
    friction: FrictionLaw | None,
) -> RegressorPlan:
    links: list[list[int]] = [[] for _ in range(chain.n_joints)]
    rotors = [False] * chain.n_joints
    for standard in kept:
        joint, symbol = divmod(int(standard), _width(rotor_inertia))
        if symbol < len(LINK_SYMBOLS):
            links[joint].append(symbol)
        else:
            rotors[joint] = True
    return RegressorPlan(chain, gravity, links, rotors, friction)


def _base_parameters(
    chain: Chain,
    gravity: Array,
    rotor_inertia: bool,
    friction: FrictionLaw,
    names: tuple[str, ...],
) -> BaseParameters:
    everything = np.arange(len(names), dtype=np.intp)
    random = np.random.default_rng(_SEED)
    shape = (_N_STATES, chain.n_joints)
    q = random.uniform(-np.pi, np.pi, shape)
    qd = random.uniform(-3.0, 3.0, shape)
    qdd = random.uniform(-10.0, 10.0, shape)
    plan = _plan(chain, gravity, everything, rotor_inertia, None)
    rows = plan.evaluate(q, qd, qdd).dense(len(names)).reshape(-1, len(names))
    units = [_unit(chain, standard, rotor_inertia) for standard in range(len(names))]
    base = select_base(rows, names, units)
    if friction.offset:
        _refuse_weight_as_offset(chain, rows[:, base.kept])
    return base


def _refuse_weight_as_offset(chain: Chain, columns: Array) -> None:
    """Refuse an offset whose column, constant on one joint, the inertial columns contain."""
    n = chain.n_joints
    offsets = np.tile(np.eye(n), (len(columns) // n, 1))
    for joint, share in enumerate(share_left(offsets, columns)):
        if share <= TOLERANCE:
            name = chain.joint_names[joint]
            raise ModelError(
                f"joint {name!r} slides along gravity and has a rotor inertia: the offset of its "
                "friction and the weight it carries cannot be told apart; leave out the offset "
                "or the rotor inertias",
                joint=name,
            )
