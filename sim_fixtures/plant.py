"""Simulated arm: rigid bodies of a URDF, rotor inertias, friction with stiction.

Forward dynamics are pinocchio's articulated-body algorithm with the rotor inertias as armature
(link side, diagonal). One step is

    q_mid = q + h/2 v;   v' = v + h a(q_mid, v + h/2 a_before, torque);   q' = q_mid + h/2 v'

It is exact for constant acceleration, symplectic for constant inertia, and of second order
otherwise, with one evaluation of the dynamics.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass, field
from operator import mul
from typing import Literal, NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from sim_fixtures.arrays import Array
from sim_fixtures.settings import PlantDiverged, SettingError


class Carried(NamedTuple):
    """A body that a joint carries in addition to its link, in the frame of the joint."""

    joint: int  # from 0
    mass: float  # kg
    centre: Array  # (3,) m
    inertia: Array  # about the centre (3, 3) kg m2


@dataclass(frozen=True, eq=False)
class PlantTruth:
    """True rotor inertias, friction and link inertias; arrays (n,), on the joint side.

    Friction torque: coulomb sgn(qd) + viscous qd + third sgn(qd) qd^2 (or third qd^3). The factor
    `inertia_scale` applies to mass, first moment and tensor of each link of the URDF; (1,) for one
    factor of all. The controller does not know what is `carried` unless it is entered.

    Raises:
        SettingError: a negative value, except of `third`.
    """

    rotor_inertia: Array  # kg m2
    coulomb: Array  # N m
    viscous: Array  # N m s/rad
    third: Array  # N m s2/rad2 ("quadratic") or N m s3/rad3 ("cubic")
    third_law: Literal["quadratic", "cubic"] = "quadratic"
    inertia_scale: Array = field(default_factory=lambda: np.ones(1))
    carried: Carried | None = None
    _has_third: bool = field(init=False, repr=False, default=False)

    def __post_init__(self) -> None:
        n = np.size(self.rotor_inertia)
        if np.size(self.inertia_scale) == 1:
            object.__setattr__(self, "inertia_scale", np.full(n, self.inertia_scale))
        for name in ("rotor_inertia", "coulomb", "viscous", "third", "inertia_scale"):
            values = np.array(getattr(self, name), dtype=np.float64)
            if name != "third" and values.min(initial=0.0) < 0.0:
                raise SettingError(name, values.tolist(), "not negative")
            values.setflags(write=False)
            object.__setattr__(self, name, values)
        object.__setattr__(self, "_has_third", bool(self.third.any()))

    @property
    def n_joints(self) -> int:
        """Number of joints."""
        return self.rotor_inertia.size

    def friction(self, velocity: ArrayLike) -> Array:
        """Return the friction torque [N m] at joint velocities (..., n); 0 at standstill."""
        v = np.asarray(velocity, dtype=np.float64)
        return self.coulomb * np.sign(v) + self.smooth_friction(v)

    def smooth_friction(self, velocity: Array) -> Array:
        """Return the friction torque without its Coulomb part."""
        factor = self.viscous
        if self._has_third:
            shape = np.abs(velocity) if self.third_law == "quadratic" else velocity * velocity
            factor = factor + self.third * shape
        smooth: Array = factor * velocity
        return smooth


MAX_SWEEPS = 200
FRICTION_TOLERANCE = 1e-6  # of friction torques, relative to the Coulomb torque


class DryFriction(NamedTuple):
    """Velocities at the end of the step [rad/s] and friction torques during it [N m], (n,)."""

    velocity: list[float]
    torque: list[float]


def resolve_dry_friction(
    free_velocity: Sequence[float],
    inverse_inertia: Array,
    coulomb: Sequence[float],
    step: float,
    guess: Sequence[float],
) -> DryFriction:
    """Return the friction torques of one step and the velocities they leave.

    Args:
        free_velocity: velocities without dry friction (n,) [rad/s].
        inverse_inertia: of the arm (n, n).
        coulomb: Coulomb torques (n,) [N·m].
        step: duration [s].
        guess: torques from which the iteration starts (n,) [N·m].
    """
    coupling = inverse_inertia * step
    rows: list[list[float]] = coupling.tolist()
    torque = [max(-c, min(c, f)) for f, c in zip(guess, coulomb, strict=True)]
    velocity: list[float] = (np.array(free_velocity) - coupling @ torque).tolist()
    for _ in range(MAX_SWEEPS):
        converged = True
        for i, limit in enumerate(coulomb):
            previous = torque[i]
            wanted = max(-limit, min(limit, previous + velocity[i] / rows[i][i]))
            change = wanted - previous
            if abs(change) > FRICTION_TOLERANCE * limit:
                torque[i] = wanted
                velocity = [v - a * change for v, a in zip(velocity, rows[i], strict=True)]
                converged = False
        if converged:
            break
    # a joint sticks if its Coulomb torque suffices to remove the rest of its velocity
    for i, limit in enumerate(coulomb):
        if abs(torque[i] + velocity[i] / rows[i][i]) < limit:
            velocity[i] = 0.0
    return DryFriction(velocity, torque)


def build_model(
    urdf: str, gravity: ArrayLike, armature: ArrayLike, inertia_scale: ArrayLike = 1.0
) -> pin.Model:
    """Return pinocchio's model of a URDF text.

    Args:
        urdf: text.
        gravity: (3,) [m/s²].
        armature: of each joint (n,) [kg·m²].
        inertia_scale: by which inertias of the links are multiplied.

    Raises:
        SettingError: there is not one armature per joint, or a joint is not revolute.
    """
    model = pin.buildModelFromXML(_as_revolute(urdf))
    inertias = np.asarray(armature, dtype=np.float64)
    if not model.nq == model.nv == inertias.size:
        raise SettingError(
            "urdf", f"{model.nv} degrees of freedom", f"{inertias.size} joints with one angle each"
        )
    model.gravity.linear = np.asarray(gravity, dtype=np.float64)
    model.armature = inertias
    scale_bodies(model, inertia_scale)
    return model


def scale_bodies(model: pin.Model, factor: ArrayLike) -> None:
    """Scale mass, first moment and tensor of each link in place; `factor` (n,)."""
    for i, scale in enumerate(np.broadcast_to(factor, model.nv).tolist(), start=1):
        body = model.inertias[i]
        model.inertias[i] = pin.Inertia(scale * body.mass, body.lever, scale * body.inertia)


def carry(model: pin.Model, carried: Carried | None) -> None:
    """Add a body to a joint of a model in place; None adds nothing."""
    if carried is not None:
        joint, mass, centre, inertia = carried
        load = pin.Inertia(mass, np.asarray(centre), np.asarray(inertia))
        model.appendBodyToJoint(joint + 1, load, pin.SE3.Identity())


def _as_revolute(urdf: str) -> str:
    """Return the URDF with continuous joints as revolute, which have one angle in pinocchio."""
    root = ET.fromstring(urdf)
    # pinocchio ignores a namespace; ET would write it before every name.
    namespace = root.tag[: root.tag.rfind("}") + 1]
    for element in root.iter():
        element.tag = element.tag.removeprefix(namespace)
    continuous = root.findall("joint[@type='continuous']")
    if not continuous:
        return urdf
    for joint in continuous:
        joint.set("type", "revolute")
        limit = joint.find("limit")
        if limit is None:
            limit = ET.SubElement(joint, "limit", effort="0", velocity="0")
        limit.attrib |= {"lower": "-1e9", "upper": "1e9"}
    return ET.tostring(root, encoding="unicode")


def joint_inertia(model: pin.Model, data: pin.Data, q: Array) -> Array:
    """Return the joint-space inertia matrix (n, n) [kg m2], armature included."""
    upper = np.triu(pin.crba(model, data, q))
    full: Array = upper + np.triu(upper, 1).T
    return full


class Plant:
    """A rigid arm under joint torques, initially at rest.

    The state is `position`, `velocity` and `acceleration` (n,) [rad, rad/s, rad/s2], the last one a
    mean over the last step, and `time` [s].

    Args:
        urdf: URDF text.
        truth: rotor inertias, friction and link inertias.
        gravity: m/s2 in the base frame.
        position: joint angles [rad]; zero by default.
        brake_torque: dry friction of the closed brake of each joint [N m].
    """

    def __init__(
        self,
        urdf: str,
        truth: PlantTruth,
        *,
        gravity: ArrayLike = (0.0, 0.0, -9.81),
        position: ArrayLike | None = None,
        brake_torque: ArrayLike = 0.0,
    ) -> None:
        n = truth.n_joints
        self.truth = truth
        self.model = build_model(urdf, gravity, truth.rotor_inertia, truth.inertia_scale)
        carry(self.model, truth.carried)
        self.data = self.model.createData()
        start = np.zeros(n) if position is None else position
        self.position: Array = np.array(start, dtype=np.float64)
        self.velocity: Array = np.zeros(n)
        self.acceleration: Array = np.zeros(n)
        self.time = 0.0
        self._brake: Array = np.broadcast_to(np.asarray(brake_torque, dtype=np.float64), (n,))
        self._braked = False
        self._scale: Array | None = None
        self._jam: Array | None = None
        self._coulomb: Array = truth.coulomb
        self._dry: Array = np.zeros(n)
        self._smooth: Array = np.zeros(n)
        self._no_friction: Array = np.zeros(n)
        self._trend: Array = np.zeros(n)
        self._holding: Array | None = None

    @property
    def n_joints(self) -> int:
        """Number of joints."""
        return self.truth.n_joints

    @property
    def friction_torque(self) -> Array:
        """Friction during the last step, (n,) [N m], positive at positive speed."""
        return self._dry + self._smooth

    @property
    def motor_position(self) -> Array:
        """Motor positions as joint angles (n,) [rad]; with rigid gears, the joint positions."""
        return self.position

    @property
    def motor_velocity(self) -> Array:
        """Motor velocities as joint velocities (n,) [rad/s]."""
        return self.velocity

    def set_state(self, position: ArrayLike, velocity: ArrayLike) -> None:
        """Set position (n,) [rad] and velocity (n,) [rad/s]."""
        self.position = np.array(position, dtype=np.float64)
        self.velocity = np.array(velocity, dtype=np.float64)
        self.acceleration = self._trend = np.zeros(self.n_joints)
        self._holding = None

    def close_brakes(self, closed: bool) -> None:
        """Close or release the brakes of all joints."""
        if closed is not self._braked:
            self._braked = closed
            self._set_coulomb()

    def scale_friction(self, factor: Array) -> None:
        """Set the factor on all friction except brakes, (n,)."""
        self._scale = factor
        self._set_coulomb()

    @property
    def friction_scale(self) -> Array:
        """Present factor on the friction (n,)."""
        n = self.model.nv
        return np.ones(n) if self._scale is None else self._scale.copy()

    def jam(self, torque: Array | None) -> None:
        """Set additional dry friction, (n,) [N m], or None."""
        self._jam = torque
        self._set_coulomb()

    def _set_coulomb(self) -> None:
        """Update the Coulomb torque of each joint [N m]."""
        coulomb = self.truth.coulomb
        if self._scale is not None:
            coulomb = coulomb * self._scale
        if self._jam is not None:
            coulomb = coulomb + self._jam
        self._coulomb = coulomb + self._brake if self._braked else coulomb

    def energy(self) -> float:
        """Return kinetic (rotors included) plus potential energy [J]."""
        # The kinetic energy of pinocchio 4.1 omits armatures of joints about axes not +x, +y or +z.
        momentum = joint_inertia(self.model, self.data, self.position) @ self.velocity
        potential = pin.computePotentialEnergy(self.model, self.data, self.position)
        return float(0.5 * self.velocity @ momentum + potential)

    def step(self, torque: Array, step: float) -> None:
        """Advance by `step` [s] under constant joint torques (n,) [N m].

        Raises:
            PlantDiverged: the state is not finite.
        """
        self.time += step
        if self._rests_on(torque):
            return
        half = 0.5 * step
        middle = self.position + half * self.velocity
        predicted = self.velocity + half * self._trend
        smooth = self._smooth_friction(predicted)
        self._advance(torque - smooth, self._coulomb, middle, predicted, step)
        self._smooth = smooth
        self.position = middle + half * self.velocity

    def _smooth_friction(self, velocity: Array) -> Array:
        """Return the scaled friction without its Coulomb part [N m]."""
        smooth = self.truth.smooth_friction(velocity)
        return smooth if self._scale is None else smooth * self._scale

    def _rests_on(self, torque: Array) -> bool:
        """Whether an arm at rest under gravity torque `_holding` stays at rest."""
        if self._holding is None:
            return False
        friction = torque - self._holding
        if (np.abs(friction) <= self._coulomb).all():
            self._dry = friction
            self._smooth = self._no_friction
            return True
        self._holding = None
        return False

    def _advance(
        self, torque: Array, coulomb: Array, middle: Array, predicted: Array, step: float
    ) -> None:
        """Update velocity, acceleration and dry friction from torques without dry friction."""
        before = self.velocity.tolist()
        if 0.0 not in before:
            sliding = np.copysign(coulomb, self.velocity)
            a = pin.aba(self.model, self.data, middle, predicted, torque - sliding)
            after = self.velocity + step * a
            if min(map(mul, before, after.tolist())) > 0.0:
                self._dry = sliding
                self.velocity = after
                self.acceleration = self._trend = a
                return
        self._stop_or_turn(torque, coulomb, middle, predicted, step)

    def _stop_or_turn(
        self, torque: Array, coulomb: Array, middle: Array, predicted: Array, step: float
    ) -> None:
        """Do so if a joint rests, starts, stops or reverses within the step."""
        free = pin.aba(self.model, self.data, middle, predicted, torque)
        inverse = pin.computeMinverse(self.model, self.data, middle)
        result = resolve_dry_friction(
            (self.velocity + step * free).tolist(),
            inverse,
            coulomb.tolist(),
            step,
            self._dry.tolist(),
        )
        after = np.array(result.velocity)
        if not np.isfinite(after).all():
            joint = int(np.argmin(np.isfinite(after)))
            raise PlantDiverged(joint, self.time)
        if not after.any() and not self.velocity.any():
            gravity = pin.computeGeneralizedGravity(self.model, self.data, self.position)
            self._holding = np.array(gravity)
        self.acceleration = (after - self.velocity) / step
        # a joint that has just stopped does not decelerate further
        self._trend = np.where(after == 0.0, 0.0, self.acceleration)
        self.velocity = after
        self._dry = np.array(result.torque)


DAMPING_RATIO = 0.05
MAX_STEP_ANGLE = 1.0  # largest natural frequency times step [rad] of a stable integration


class ElasticPlant(Plant):
    """A plant with springs behind the gears of some axes, initially loaded by gravity.

    `elasticity` is the compliance of each gear (n,) [rad/(N m)], 0 for a rigid one; `step` that of
    the simulation [s]. The other arguments are as of `Plant`.

    Raises:
        SettingError: an elastic axis without a rotor, or a resonance too fast for `step`.
    """

    def __init__(
        self,
        urdf: str,
        truth: PlantTruth,
        *,
        elasticity: Sequence[float],
        step: float,
        gravity: ArrayLike = (0.0, 0.0, -9.81),
        position: ArrayLike | None = None,
        brake_torque: ArrayLike = 0.0,
    ) -> None:
        super().__init__(urdf, truth, gravity=gravity, position=position, brake_torque=brake_torque)
        compliance = np.asarray(elasticity, dtype=np.float64)
        soft = compliance > 0.0
        if (truth.rotor_inertia[soft] <= 0.0).any():
            raise SettingError("rotor_inertia", truth.rotor_inertia.tolist(), "> 0 if elastic")
        self._soft = soft
        self._rigid = ~soft
        self._stiffness: Array = np.where(soft, 1.0 / np.where(soft, compliance, 1.0), 0.0)
        self._rotor: Array = np.where(soft, truth.rotor_inertia, 1.0)
        # rotors of elastic axes are separate bodies
        self.model.armature = np.where(soft, 0.0, truth.rotor_inertia)
        self._damping: Array = self._damping_within(step)
        gravity_torque = pin.computeGeneralizedGravity(self.model, self.data, self.position)
        self._motor: Array = self.position + compliance * gravity_torque
        self._motor_velocity: Array = np.zeros(self.n_joints)
        self._motor_trend: Array = np.zeros(self.n_joints)

    def _damping_within(self, step: float) -> Array:
        """Return the damping of each spring [N m s/rad]; SettingError if `step` is too long."""
        inertia = joint_inertia(self.model, self.data, self.position).diagonal()
        reduced = 1.0 / (1.0 / self._rotor + 1.0 / inertia)
        fastest = float(np.sqrt(self._stiffness / reduced).max())
        if fastest * step > MAX_STEP_ANGLE:
            bound = f"resonances below {MAX_STEP_ANGLE / step:.0f} rad/s"
            raise SettingError("elasticity", f"one with {fastest:.0f} rad/s", bound)
        damping: Array = 2.0 * DAMPING_RATIO * np.sqrt(self._stiffness * reduced) * self._soft
        return damping

    @property
    def motor_position(self) -> Array:
        """Motor positions as joint angles (n,) [rad]."""
        return np.where(self._soft, self._motor, self.position)

    @property
    def motor_velocity(self) -> Array:
        """Motor velocities as joint velocities (n,) [rad/s]."""
        return np.where(self._soft, self._motor_velocity, self.velocity)

    def energy(self) -> float:
        """Return kinetic, potential and spring energy [J]."""
        stretch = self._motor - self.position
        springs = 0.5 * self._stiffness @ stretch**2
        rotors = 0.5 * (self._rotor * self._soft) @ self._motor_velocity**2
        return super().energy() + float(springs + rotors)

    def step(self, torque: Array, step: float) -> None:
        """Advance by `step` [s] under motor torques (n,) [N m] on the joint side."""
        coulomb = self._coulomb
        self.time += step
        half = 0.5 * step
        middle = self.position + half * self.velocity
        predicted = self.velocity + half * self._trend
        motor_middle = self._motor + half * self._motor_velocity
        motor_predicted = self._motor_velocity + half * self._motor_trend
        spring = self._stiffness * (motor_middle - middle)
        spring += self._damping * (motor_predicted - predicted)

        rotor_friction = self._turn_rotors(torque - spring, motor_predicted, coulomb, step)
        smooth = self._smooth_friction(predicted) * self._rigid
        load = np.where(self._soft, spring, torque - smooth)
        self._advance(load, coulomb * self._rigid, middle, predicted, step)
        self._smooth = smooth + rotor_friction
        self.position = middle + half * self.velocity
        self._motor = motor_middle + half * self._motor_velocity

    def _turn_rotors(self, torque: Array, predicted: Array, coulomb: Array, step: float) -> Array:
        """Accelerate the rotors of the elastic axes and return their friction (n,) [N m]."""
        smooth = self._smooth_friction(predicted)
        free = self._motor_velocity + step * (torque - smooth) / self._rotor
        # a rotor is coupled to no other, so the friction that stops it is explicit
        momentum = self._rotor / step
        dry = np.minimum(np.maximum(free * momentum, -coulomb), coulomb)
        after = np.where(np.abs(dry) < coulomb, 0.0, free - dry / momentum) * self._soft
        # a rotor that has just stopped does not decelerate further
        self._motor_trend = np.where(after == 0.0, 0.0, (after - self._motor_velocity) / step)
        self._motor_velocity = after
        friction: Array = (smooth + dry) * self._soft
        return friction
