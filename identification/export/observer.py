"""Torque from outside, seen by the momentum of the identified arm.

De Luca and Mattone, Actuator failure detection and isolation using generalized momenta, 2003.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from identification.arrays import Array
from identification.errors import ModelError, ShapeError
from identification.export.controller.reference import pinocchio_bodies
from identification.export.controller.tables import (
    FRICTION_COLUMNS,
    ControlTables,
    control_tables,
)
from identification.export.exported_arm import ExportedArm
from identification.model.elements import PeriodicTorque


class MomentumObserver:
    """Low-passed torque from outside, one control cycle after the other.

    The estimate r follows the torque from outside with the time constant 1 / gain, without
    accelerations: r = gain (p - integral of (tau - friction - gravity + C' v + r)), p = M v. It
    acts on its own integral (implicit Euler), so every gain is stable. Friction follows the motion
    as in :meth:`FrictionLaw.direction`. The code of `hil export --to c` does the same.

    Args:
        arm: identified arm of n joints.
        gain: 1 over the time constant [1/s].
        dt: time between two cycles [s].

    Raises:
        ModelError: gain or dt is not positive.
    """

    def __init__(self, arm: ExportedArm, gain: float, dt: float) -> None:
        if not (gain > 0.0 and dt > 0.0):
            raise ModelError(f"an observer needs a positive gain and dt, not {gain:g} and {dt:g}")
        self.gain = gain
        self.dt = dt
        self._arm = arm
        self._pinocchio = pinocchio_bodies(arm)
        self._data = self._pinocchio.createData()
        self._neutral = pin.neutral(self._pinocchio)
        self._friction = SteppedFriction(control_tables(arm), dt)
        self._integral: Array | None = None
        self._external = np.zeros(arm.model.n_joints)

    def step(self, q: ArrayLike, v: ArrayLike, tau: ArrayLike) -> Array:
        """Return the torque from outside (n,) [N·m, N] after one more cycle.

        Positions and speeds (n,) are measured; tau (n,) is what the drives apply, measured or
        commanded. The first call starts the motion and returns zeros.

        Raises:
            ShapeError: an array has another shape.
        """
        position, speed, applied = (self._checked(name, x) for name, x in
                                    (("q", q), ("v", v), ("tau", tau)))  # fmt: skip
        impulse, drift, load = self._momentum(position, speed)
        if self._integral is None:
            self._friction.start(position, speed)
            self._integral = impulse
            return self._external.copy()
        known = applied - self._friction.step(position, speed, load) + drift
        total = self._integral + self.dt * known
        self._external = self.gain * (impulse - total) / (1.0 + self.gain * self.dt)
        self._integral = total + self.dt * self._external
        return self._external.copy()

    def _checked(self, name: str, values: ArrayLike) -> Array:
        array = np.asarray(values, dtype=np.float64)
        n = self._arm.model.n_joints
        if array.shape != (n,):
            raise ShapeError(name, array.shape, f"({n},)")
        return array

    def _momentum(self, q: Array, v: Array) -> tuple[Array, Array, Array]:
        """Return M v, C' v less gravity and elements, and the gears' load at no acceleration."""
        model = self._pinocchio
        data = self._data
        posture = pin.integrate(model, self._neutral, q)
        coriolis = pin.computeCoriolisMatrix(model, data, posture, v)
        upper = pin.crba(model, data, posture)
        inertia = np.triu(upper) + np.triu(upper, 1).T + self._arm.rotors
        gravity = pin.computeGeneralizedGravity(model, data, posture)
        ripple, springs = self._passive(q)
        load = gravity + springs + coriolis @ v
        return inertia @ v, coriolis.T @ v - gravity - springs - ripple, load

    def _passive(self, q: Array) -> tuple[Array, Array]:
        """Return the torques of ripples, and of springs and balancers (n,)."""
        elements = self._arm.model.elements
        torque = np.zeros((2, len(q)))
        values = self._arm.values[self._arm.model.element_part]
        for placed in elements.placed:
            row = q[None, :]
            found = placed.columns(row) @ values[placed.part] + placed.known_torque(row)
            kind = 0 if isinstance(placed.element, PeriodicTorque) else 1
            torque[kind, placed.joint] += float(found[0])
        return torque[0], torque[1]


class SteppedFriction:
    """Identified friction of n joints and k coupled motors, one cycle after the other."""

    def __init__(self, tables: ControlTables, dt: float) -> None:
        self._tables = tables
        self._dt = dt
        self._column = dict(zip(FRICTION_COLUMNS, tables.friction.T, strict=True))
        self._position = self._velocity = self._state = np.zeros(tables.n_axes)

    def start(self, q: Array, v: Array) -> None:
        """Begin a motion at positions and speeds (n,)."""
        self._position = self._axes(q)
        self._velocity = self._axes(v)
        self._state = self._slid(np.zeros(len(self._position)), self._velocity * self._dt)

    def step(self, q: Array, v: Array, load: Array) -> Array:
        """Return friction and offsets (n,) [N·m, N]; gears transmit `load` (n,)."""
        tables = self._tables
        position = self._axes(q)
        velocity = self._axes(v)
        before = self._velocity
        turning = before * velocity < 0.0
        span = np.where(turning, before - velocity, 1.0)
        # up to where the interpolated speed is zero, and on from there
        there = np.where(turning, 0.5 * before * self._dt * before / span, 0.0)
        state = self._slid(self._state, there)
        self._state = self._slid(state, position - self._position - there)
        self._position, self._velocity = position, velocity
        zone = tables.linear_zone
        jump = np.where(
            zone > 0.0,
            np.clip(velocity / np.where(zone > 0.0, zone, 1.0), -1.0, 1.0),
            np.sign(velocity),
        )
        direction = np.where(tables.presliding > 0.0, self._state, jump)
        loads = np.zeros(tables.n_axes)
        loads[: tables.n_joints] = np.abs(load)
        torque = self._torque(velocity, direction, loads)
        n = tables.n_joints
        return torque[:n] + torque[n:] @ tables.motor_turns

    def _axes(self, joints: Array) -> Array:
        return np.concatenate([joints, self._tables.motor_turns @ joints])

    def _slid(self, state: Array, displacement: Array) -> Array:
        """Return Dahl's state after displacements (n + k,), see `identification.model.friction`."""
        distance = self._tables.presliding
        s = np.sign(displacement)
        decay = np.exp(-np.abs(displacement) / np.where(distance > 0.0, distance, 1.0))
        return np.where(s == 0.0, state, s + (state - s) * decay)

    def _torque(self, v: Array, direction: Array, load: Array) -> Array:
        c = self._column
        speed = np.abs(v)
        low = np.exp(-((v / c["STRIBECK_SPEED"]) ** 2))
        dry = c["FRICTION_COULOMB"] + c["FRICTION_LOAD"] * load + c["FRICTION_STRIBECK"] * low
        fluid = c["FRICTION_VISCOUS"] + c["FRICTION_QUADRATIC"] * speed + c["FRICTION_CUBIC"] * v**2
        smooth = c["FRICTION_TANH"] * np.tanh(v / c["TANH_SPEED"])
        return np.asarray(
            dry * direction + smooth + fluid * v + c["FRICTION_ASYMMETRIC"] * speed
            + c["FRICTION_OFFSET"]
        )  # fmt: skip
