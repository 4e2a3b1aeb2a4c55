"""The simulated arm with springs in some of its gears.

An elastic axis has two masses: its rotor with the friction (which sits in motor and gear), and the
link, joined by a spring with 5 % damping. The other axes are rigid as in `Plant`. Meant for the
main axes: there the resonances lie at some ten Hz, far below the integration rate, while those of a
wrist lie above it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from sim_fixtures.errors import SettingError
from sim_fixtures.plant import Plant, joint_inertia
from sim_fixtures.truth import PlantTruth

Array = NDArray[np.float64]

DAMPING_RATIO = 0.05
MAX_STEP_ANGLE = 1.0
"""Largest natural frequency times step [rad] that the integration is trusted with."""


class ElasticPlant(Plant):
    """A plant whose links hang on springs behind the gears of some axes."""

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
        """Put the arm at rest, the springs loaded by gravity.

        Args:
            urdf: URDF text.
            truth: rotor inertias, friction, and how far the links are those of the URDF.
            gravity: m/s2 in the base frame.
            position: joint angles [rad]; the URDF's zero if not given.
            brake_torque: dry friction of each joint's closed brake [N m].
            elasticity: compliance of each gear (n,) [rad/(N m)]; 0 is rigid.
            step: the step that will be used [s].

        Raises:
            SettingError: no elastic axis, one without a rotor, or a resonance too fast for `step`.
        """
        super().__init__(urdf, truth, gravity=gravity, position=position, brake_torque=brake_torque)
        compliance = np.asarray(elasticity, dtype=np.float64)
        if compliance.shape != (self.n_joints,) or not (compliance > 0.0).any():
            raise SettingError("elasticity", tuple(elasticity), f"{self.n_joints} compliances")
        soft = compliance > 0.0
        if (truth.rotor_inertia[soft] <= 0.0).any():
            raise SettingError("rotor_inertia", truth.rotor_inertia.tolist(), "> 0 if elastic")
        self._soft = soft
        self._rigid = ~soft
        self._stiffness: Array = np.where(soft, 1.0 / np.where(soft, compliance, 1.0), 0.0)
        self._rotor: Array = np.where(soft, truth.rotor_inertia, 1.0)
        # the rotors of elastic axes are bodies of their own
        self.model.armature = np.where(soft, 0.0, truth.rotor_inertia)
        self._damping: Array = self._damping_within(step)
        gravity_torque = pin.computeGeneralizedGravity(self.model, self.data, self.position)
        self._motor: Array = self.position + compliance * gravity_torque
        self._motor_velocity: Array = np.zeros(self.n_joints)
        self._motor_trend: Array = np.zeros(self.n_joints)

    def _damping_within(self, step: float) -> Array:
        """Return each spring's damper [N m s/rad]; SettingError if `step` is too long for one."""
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
        """Where the motors stand, as joint angles (n,) [rad]."""
        return np.where(self._soft, self._motor, self.position)

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
        # alone on its axis, a rotor is stopped by the friction that takes its free speed away
        momentum = self._rotor / step
        dry = np.minimum(np.maximum(free * momentum, -coulomb), coulomb)
        after = np.where(np.abs(dry) < coulomb, 0.0, free - dry / momentum) * self._soft
        # a rotor that has just been stopped does not go on decelerating
        self._motor_trend = np.where(after == 0.0, 0.0, (after - self._motor_velocity) / step)
        self._motor_velocity = after
        friction: Array = (smooth + dry) * self._soft
        return friction
