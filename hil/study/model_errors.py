"""Errors of the model: torque that a rigid arm with the model's friction does not have.

A simulated arm follows the planned motion to a fraction of a milliradian, whatever its model lacks:
what an error changes is the motors' torque. So each motion is simulated once, without effects, and
the torque of each error along the plan is added to what was measured. A second size costs nothing
then, and noise is the same under every condition. `tests/hil/study/test_model_errors.py` compares
with the simulated arm that has ripple, drift, elastic gears and delay itself.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from math import exp, pi
from typing import Final, Literal, Self, get_args

import numpy as np
import pinocchio as pin
from scipy.signal import lfilter

from hil.base.arrays import Array
from hil.cell import Cell
from hil.control.planted_arm import planted_truth
from hil.control.simulated_cell import simulated_drive
from planner import FourierSeries, PiecewiseCubic
from sim_fixtures import PlantTruth, SimulatedDrive
from sim_fixtures.arm import HALF_WARM_SPEED, RIPPLES_PER_TURN, WARM_UP_TIME
from sim_fixtures.plant import DAMPING_RATIO, build_model, carry, joint_inertia
from sim_fixtures.settings import ServoSettings

ErrorName = Literal[
    "torque ripple",
    "friction drift",
    "elastic gears",
    "delay",
    "Stribeck friction",
    "friction with load",
    "link lengths",
    "torque constants",
]

#: Excess of dry friction at standstill, as a share of the Coulomb torque
STRIBECK_SHARE: Final = 0.2
#: Speed at which 37 % of it are left, as a share of the speed limit
STRIBECK_SPEED_SHARE: Final = 0.1
#: Dry friction that load adds, as a share of the torque of the gear
LOAD_FRICTION_SHARE: Final = 0.05
LENGTH_ERROR: Final = 0.001  #: Relative error of each coordinate of a joint's origin, random sign
TORQUE_CONSTANT_ERROR: Final = 0.03  #: Relative error of each torque constant, of random sign
ERROR_SIZES: Final = (1, 2)
"""Sizes of each error, as multiples of the values above and in the cell file."""
_SUBSTEPS: Final = 2  # of a cycle, for the oscillations of elastic gears
_SIGN_STREAM: Final = 4  # first number of the random stream of signs and phases


@dataclass(frozen=True)
class Condition:
    """One model error at one size, none, or all together."""

    error: ErrorName | Literal["none", "all"]
    size: int

    @property
    def key(self) -> str:
        """A name without spaces."""
        name = self.error.replace(" ", "-")
        return name if self.error in ("none", "all") else f"{name}-x{self.size}"

    @property
    def lengths(self) -> int:
        """Size of the error of the lengths in the model that is fitted."""
        return self.size if self.error in ("link lengths", "all") else 0


NONE: Final = Condition("none", 0)
ALL: Final = Condition("all", 1)


def conditions_of(cell: Cell, *, effects: bool) -> tuple[Condition, ...]:
    """Return the conditions of a study, without errors whose size is zero in the cell file."""
    if not effects:
        return (NONE,)
    simulation = cell.simulation
    sizes = {
        "torque ripple": simulation.torque_ripple,
        "friction drift": simulation.friction_drift,
        "elastic gears": max(simulation.elasticity, default=0.0),
        "delay": simulation.delay,
    }
    names = [name for name in get_args(ErrorName) if sizes.get(name, 1.0) > 0.0]
    return (NONE, *(Condition(name, size) for name in names for size in ERROR_SIZES), ALL)


@dataclass(frozen=True, eq=False)
class ModelErrors:
    """The errors of a simulated arm; `seed` draws signs and phases, which all motions share."""

    cell: Cell
    seed: int

    def fitted(self, condition: Condition) -> Cell:
        """Return the cell whose model is fitted: with true lengths, or with wrong ones."""
        if condition.lengths == 0:
            return self.cell
        error = condition.lengths * LENGTH_ERROR
        urdf = _with_wrong_lengths(self.cell.urdf, error, self._random("lengths"))
        return Cell.from_texts(self.cell.text, urdf, self.cell.path)

    def measured(
        self, condition: Condition, torque: Array, plan: PlannedTorque, time: Array, elapsed: float
    ) -> Array:
        """Return what is measured under a condition in place of a torque without errors.

        Args:
            condition: the error.
            torque: measured without errors (m, n) [N·m].
            plan: the motion.
            time: of the rows since the first set-point (m,) [s].
            elapsed: duration for which the arm has moved like this before [s].
        """
        named = condition.error
        added = [name for name in get_args(ErrorName) if named in (name, "all")]
        for name in added:
            along = self._along(name, condition.size, plan, elapsed)
            if along is not None:
                torque = torque + plan.at(time, along)
        return self._converted(torque, condition.size) if "torque constants" in added else torque

    def _along(
        self, name: ErrorName, size: int, plan: PlannedTorque, elapsed: float
    ) -> Array | None:
        """Return the torque of an error at the instants of a plan; None for other errors."""
        simulation = self.cell.simulation
        if name == "torque ripple":
            return plan.ripple(size * simulation.torque_ripple, self._phases, self._drive)
        if name == "friction drift":
            return plan.drift(size * simulation.friction_drift, elapsed)
        if name == "elastic gears":
            return plan.elasticity([size * compliance for compliance in simulation.elasticity])
        if name == "delay":
            return plan.delay(size * simulation.delay)
        if name == "Stribeck friction":
            return plan.stribeck(
                size * STRIBECK_SHARE, STRIBECK_SPEED_SHARE * self.cell.joint_limits.velocity
            )
        if name == "friction with load":
            return plan.load_friction(size * LOAD_FRICTION_SHARE)
        return None

    def _converted(self, torque: Array, size: int) -> Array:
        """Return torques (m, n) converted from their currents by wrong torque constants."""
        signs = self._random("constants").choice((-1.0, 1.0), torque.shape[1])
        currents = self._drive.currents(list(torque.T))  # elementwise, also of arrays
        wrong = [
            (1.0 + size * TORQUE_CONSTANT_ERROR * sign) * current
            for sign, current in zip(signs.tolist(), currents, strict=True)
        ]
        return np.column_stack(self._drive.joint_torques(wrong))

    @cached_property
    def _phases(self) -> Array:
        return self._random("ripple").uniform(0.0, 2.0 * pi, len(self.cell.joint_names))

    @cached_property
    def _drive(self) -> SimulatedDrive:
        return simulated_drive(self.cell)

    def _random(self, what: str) -> np.random.Generator:
        return np.random.default_rng([_SIGN_STREAM, self.seed, *what.encode()])


def _with_wrong_lengths(urdf: str, error: float, random: np.random.Generator) -> str:
    """Return a URDF in which each coordinate of a joint's origin is wrong by a relative error."""
    root = ET.fromstring(urdf)
    for origin in root.findall("joint/origin"):
        lengths = np.array([float(text) for text in origin.get("xyz", "0 0 0").split()])
        wrong = lengths * (1.0 + error * random.choice((-1.0, 1.0), 3))
        origin.set("xyz", " ".join(map(repr, wrong.tolist())))
    return ET.tostring(root, encoding="unicode")


@dataclass(frozen=True, eq=False)
class PlannedTorque:
    """Torque of the true arm along a planned motion, at k instants of a fixed step [s]."""

    truth: PlantTruth
    step: float
    position: Array  #: (k, n) [rad]
    velocity: Array  #: (k, n) [rad/s]
    acceleration: Array  #: (k, n) [rad/s²]
    gear: Array  #: torque that the gears transmit, without rotors and friction (k, n) [N·m]
    inertia: Array  #: of the bodies, without rotors (k, n, n) [kg·m²]
    damped: Array  #: inertia that the damping of a gear refers to: of bodies and rotor (n,)
    _stretched: dict[tuple[float, ...], Array] = field(default_factory=dict, init=False, repr=False)

    @classmethod
    def of(cls, cell: Cell, trajectory: PiecewiseCubic | FourierSeries) -> Self:
        """Compute it for the arm that a cell simulates."""
        truth = planted_truth(cell)
        count = round(trajectory.duration / cell.period) + 1
        states = trajectory.sample(cell.period * np.arange(count, dtype=np.float64))
        still = np.zeros(truth.n_joints)
        model = build_model(cell.urdf, cell.file.robot.gravity, still, truth.inertia_scale)
        carry(model, truth.carried)
        data = model.createData()
        gear = np.array([pin.rnea(model, data, *state) for state in zip(*states, strict=True)])
        inertia = np.array([joint_inertia(model, data, position) for position in states[0]])
        rotor = truth.rotor_inertia
        bodies = inertia[0].diagonal()
        damped = np.where(rotor > 0.0, rotor * bodies / (rotor + bodies), bodies)
        return cls(truth, cell.period, *states, gear, inertia, damped)

    def at(self, time: Array, values: Array) -> Array:
        """Return values (k, n) at times (m,) since the first set-point, reached a cycle later."""
        index = np.rint(time / self.step - 1.0).astype(np.intp)
        return np.asarray(values[np.clip(index, 0, len(values) - 1)])

    @property
    def _direction(self) -> Array:
        return np.sign(self.velocity)

    @property
    def _friction(self) -> Array:
        return self.truth.friction(self.velocity)

    def ripple(self, share: float, phases: Array, drive: SimulatedDrive) -> Array:
        """Return the torque of a ripple of a share of the Coulomb torque (`SimulatedRipple`)."""
        turns = np.column_stack(drive.motor_revolutions(list(self.position.T)))
        angle = 2.0 * pi * RIPPLES_PER_TURN * turns + phases
        return np.asarray(-share * self.truth.coulomb * np.sin(angle))

    def drift(self, share: float, elapsed: float) -> Array:
        """Return the torque of friction that falls with a joint's warmth (`SimulatedDrift`)."""
        speed = np.abs(self.velocity)
        final = speed / (speed + HALF_WARM_SPEED)
        start = final.mean(axis=0) * (1.0 - exp(-elapsed / WARM_UP_TIME))
        rate = self.step / WARM_UP_TIME
        warmth, _ = lfilter([rate], [1.0, rate - 1.0], final, axis=0, zi=(1.0 - rate) * start[None])
        return np.asarray(share * (0.5 - warmth) * self._friction)

    def elasticity(self, compliance: Sequence[float]) -> Array:
        """Return the torque of springs of a compliance (n,) [rad/(N·m)] behind the gears.

        Two masses at each joint, as of `ElasticPlant`, to first order about the plan: the rotor is
        y ahead of it, held by the loops of the servo, the body e ahead of the rotor:

            M (y'' + e'') = -K e - D e' - (torque of the gear along the plan)
            J y'' = -(servo torque) - (viscous friction) y' + K e + D e' + (the same torque)

        A model without springs, along the measured motion of the rotor, lacks M e''.
        """
        key = tuple(compliance)
        if key not in self._stretched:
            self._stretched[key] = self._elasticity(np.array(compliance))
        return self._stretched[key]

    def _elasticity(self, compliance: Array) -> Array:
        soft = np.flatnonzero(compliance > 0.0)
        rotor = self.truth.rotor_inertia[soft]
        viscous = self.truth.viscous[soft]
        stiffness = 1.0 / compliance[soft]
        damping = 2.0 * DAMPING_RATIO * np.sqrt(stiffness * self.damped[soft])
        servo = ServoSettings()
        bodies = self.inertia[:, soft[:, None], soft]
        mobility = np.linalg.inv(bodies)
        whole = np.diagonal(bodies, axis1=1, axis2=2) + rotor
        gains = np.minimum(servo.velocity_bandwidth * whole, servo.rotor_bandwidth * rotor)
        step = self.step / _SUBSTEPS
        stretch = -self.gear[0, soft] / stiffness
        stretching, ahead, speed, integral = np.zeros((4, len(soft)))
        accelerations = np.zeros((len(self.gear), len(soft)))
        for k, load in enumerate(self.gear[:, soft]):
            for _ in range(_SUBSTEPS):
                excess = stiffness * stretch + damping * stretching + load
                lag = speed + servo.position_gain * ahead
                of_rotor = (excess - gains[k] * (lag + integral) - viscous * speed) / rotor
                of_stretch = -(mobility[k] @ excess) - of_rotor
                integral = integral + step * servo.integral_rate * lag
                stretching = stretching + step * of_stretch  # semi-implicit Euler
                stretch = stretch + step * stretching
                speed = speed + step * of_rotor
                ahead = ahead + step * speed
                accelerations[k] += of_stretch / _SUBSTEPS
        return np.asarray(np.einsum("kij,kj->ki", self.inertia[:, :, soft], accelerations))

    def delay(self, late: float) -> Array:
        """Return the change of a torque that is recorded before it acts [s]."""
        rotors = self.truth.rotor_inertia * self.acceleration
        torque = self.gear + rotors + self._friction
        time = self.step * np.arange(len(torque))
        ahead = [np.interp(time + late, time, column) for column in torque.T]
        return np.column_stack(ahead) - torque

    def stribeck(self, share: float, speed: Array) -> Array:
        """Return additional dry friction that falls with the speed, e-fold squared at `speed`."""
        slow = np.exp(-((self.velocity / speed) ** 2))
        return np.asarray(share * self.truth.coulomb * slow * self._direction)

    def load_friction(self, share: float) -> Array:
        """Return dry friction of a share of the torque that the gears transmit."""
        return np.asarray(share * np.abs(self.gear) * self._direction)
