"""Arm and drives of a simulated UR5e: torques by motor currents, friction, constants, temperatures.

What the controller believes (`stated_constant`, its rigid-body model and its friction law) differs
from what the arm is, as on a real one.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
import pinocchio as pin

from sim_fixtures.arm import SimulatedDrift, SimulatedRipple, UnmodelledEffects
from sim_fixtures.arrays import Array
from sim_fixtures.plant import Carried, ElasticPlant, Plant, PlantTruth, build_model, carry

CELL_PATH: Final = Path(__file__).with_name("cell.toml")
"""A cell file of the simulated UR5e."""
UR5E_URDF: Final = Path(__file__).with_name("ur5e.urdf").read_text("utf-8")
_ROOM_TEMPERATURE: Final = 25.0  # °C
_HEATING_PER_WATT: Final = 0.25  # °C per W of friction in the long run
_HEAT_TIME_CONSTANT: Final = 900.0  # s
_POSITION_BANDWIDTH: Final = 60.0  # of the position loop, rad/s
_FRICTION_SPEED: Final = 0.02  # of the controller's friction law at a reversal, rad/s
_LOOP_SECONDS: Final = 2e-3  # longest period of the position loop, s
_SUBSTEP_SECONDS: Final = 5e-4
"""Period of the position loop of an arm with effects that a model leaves out [s]: in front of
springs the loop moves the rotors alone, which are lighter, so it has to be faster."""
_MOTOR_PER_JOINT: Final = 101.0 / (2.0 * np.pi)  # revolutions per rad


def _array(*values: float) -> Array:
    return np.array(values)


@dataclass(frozen=True, eq=False)
class UrArmTruth:
    """What a simulated arm is, and what its controller believes; joint side, (6,) each.

    Attributes:
        plant: rotor inertias, friction and factors on the link inertias of the URDF.
        torque_constant: joint torque per motor current [N·m/A].
        stated_constant: the one by which the controller makes currents of its model's torques.
        coulomb, viscous, quadratic: the controller's friction law [N·m, N·m·s/rad, N·m·s²/rad²].
        current_noise: rms [A].
        position_step: of the encoders [rad].
        velocity_noise: of the velocity estimate, rms [rad/s].
    """

    plant: PlantTruth = field(
        default_factory=lambda: PlantTruth(
            rotor_inertia=_array(0.95, 0.98, 0.9, 0.14, 0.13, 0.12),
            coulomb=_array(7.9, 8.8, 5.1, 1.9, 2.2, 2.0),
            viscous=_array(11.0, 12.5, 7.4, 1.7, 1.5, 1.8),
            third=_array(-1.6, -1.9, -1.1, -0.2, -0.15, -0.2),
            inertia_scale=_array(1.05, 0.94, 1.08, 1.1, 0.95, 1.0),
        )
    )
    torque_constant: Array = field(
        default_factory=lambda: _array(10.43, 10.52, 10.28, 7.65, 7.9, 7.48)
    )
    stated_constant: Array = field(default_factory=lambda: _array(9.84, 9.84, 9.84, 7.4, 7.4, 7.4))
    coulomb: Array = field(default_factory=lambda: _array(7.0, 7.0, 5.0, 1.8, 1.8, 1.8))
    viscous: Array = field(default_factory=lambda: _array(12.0, 12.0, 8.0, 1.6, 1.6, 1.6))
    quadratic: Array = field(default_factory=lambda: _array(-2.0, -2.0, -1.5, -0.2, -0.2, -0.2))
    current_noise: float = 0.02
    position_step: float = 5e-6
    velocity_noise: float = 1e-3


class SimulatedUrArm:
    """The arm on its position controller, cycle by cycle.

    The state is that of `plant`, `current` [A] that acted in the last cycle, `target_moment` [N·m]
    and `target_current` [A] of the controller's model, and `temperature` [°C], (6,) each.

    Args:
        truth: what the arm is.
        position: where it begins (6,) [rad].
        period: of the controller [s].
        seed: of its noise.
        load: what its flange carries, and the controller does not know.
        entered: the payload that the controller knows; the flange carries it as well, unless
            `truth` says what it carries.
        urdf: of the arm, six joints.
        effects: that a model of it leaves out.
    """

    def __init__(
        self,
        truth: UrArmTruth,
        position: Array,
        period: float,
        *,
        seed: int = 0,
        load: Carried | None = None,
        entered: Carried | None = None,
        urdf: str = UR5E_URDF,
        effects: UnmodelledEffects | None = None,
    ) -> None:
        self.truth = truth
        self._effects = effects or UnmodelledEffects()
        self.plant = Plant(urdf, truth.plant, position=position)
        if any(self._effects.elasticity):
            self.plant = ElasticPlant(
                urdf, truth.plant, position=position, elasticity=self._effects.elasticity,
                step=_SUBSTEP_SECONDS,
            )  # fmt: skip
        # Without rotors: what the arm reports as its moment is that of rigid bodies alone.
        self._model = build_model(urdf, (0.0, 0.0, -9.81), np.zeros(6))
        carry(self.plant.model, load)
        carry(self.plant.model, entered if truth.plant.carried is None else None)
        carry(self._model, entered)
        self._data = self._model.createData()
        self._period = period
        self._is_ideal = self._effects == UnmodelledEffects()
        self._loops = math.ceil(period / (_LOOP_SECONDS if self._is_ideal else _SUBSTEP_SECONDS))
        self._loop_period = period / self._loops
        self._rng = np.random.default_rng(seed)
        amplitude = self._effects.torque_ripple * truth.plant.coulomb
        self._ripple = SimulatedRipple(amplitude, np.random.default_rng([seed, 1]))
        self._drift = SimulatedDrift(self._effects.friction_drift, 6)
        self._delayed = deque([np.zeros(6)] * round(self._effects.delay / self._loop_period))
        self.current: Array = np.zeros(6)
        self.target_moment: Array = np.zeros(6)
        self.target_current: Array = np.zeros(6)
        self.temperature: Array = np.full(6, _ROOM_TEMPERATURE + 2.0)

    def step(self, q: Array, qd: Array, qdd: Array) -> None:
        """Follow targets (6,) [rad, rad/s, rad/s²] for a cycle."""
        truth = self.truth
        rigid: Array = pin.rnea(self._model, self._data, q, qd, qdd)
        self.target_moment = rigid
        speed = np.abs(qd)
        friction = truth.coulomb * np.tanh(qd / _FRICTION_SPEED)
        friction = friction + (truth.viscous + truth.quadratic * speed) * qd
        self.target_current = (rigid + friction) / truth.stated_constant
        rotor = truth.plant.rotor_inertia
        inertia = np.diag(pin.crba(self._model, self._data, q)) + rotor
        drive = rotor * qdd
        commands: Array = np.zeros(6)
        for loop in range(self._loops):
            ahead = loop * self._loop_period
            error = q + ahead * (qd + 0.5 * ahead * qdd) - self.plant.motor_position
            rate = qd + ahead * qdd - self.plant.motor_velocity
            correction = inertia * _POSITION_BANDWIDTH * (_POSITION_BANDWIDTH * error + 2.0 * rate)
            command = self.target_current + (drive + correction) / truth.stated_constant
            commands += command
            self._advance(truth.torque_constant * command)
        self.current = commands / self._loops
        self._warm()

    def _advance(self, torque: Array) -> None:
        """Advance by a period of the position loop under motor torques (6,) [N·m]."""
        plant, period = self.plant, self._loop_period
        if not self._is_ideal:
            plant.scale_friction(self._drift.scale(plant.velocity, period))
            self._delayed.append(torque)
            motors = (_MOTOR_PER_JOINT * plant.motor_position).tolist()
            torque = self._delayed.popleft() + self._ripple.torque(motors)
        plant.step(torque, period)

    def rest(self) -> None:
        """Stay for a cycle with brakes engaged and without current."""
        self.current = self.target_moment = self.target_current = np.zeros(6)
        self.plant.set_state(self.plant.position, np.zeros(6))
        self.plant.time += self._period

    def _warm(self) -> None:
        power = np.abs(self.plant.friction_torque * self.plant.velocity)
        final = _ROOM_TEMPERATURE + 2.0 + _HEATING_PER_WATT * power
        self.temperature = self.temperature + self._period / _HEAT_TIME_CONSTANT * (
            final - self.temperature
        )

    def measured_current(self) -> Array:
        """Return the measured current of the last cycle (6,) [A]."""
        noise: Array = self._rng.normal(0.0, self.truth.current_noise, 6)
        return self.current + noise

    def measured_position(self) -> Array:
        """Return the reading of the encoders (6,) [rad]."""
        step = self.truth.position_step
        noise = self._rng.normal(0.0, 0.5, 6)
        return np.asarray(step * np.rint(self.plant.position / step + noise))

    def measured_velocity(self) -> Array:
        """Return the estimate of the velocity (6,) [rad/s]."""
        noise: Array = self._rng.normal(0.0, self.truth.velocity_noise, 6)
        return self.plant.velocity + noise
