"""Drive train of the simulated robot: motors, gears, wrist coupling.

Implemented per axis from the formulas of the controller, without code of the drive train of the PC,
so that a sign error on one side cannot cancel on the other. Motor 4 also turns axes 5 and 6, motor
5 also axis 6.

With the controller angles a = sign * q + offset, q the joint angles of the URDF:

    p_i = kr_i a_i / 2 pi + cal_i                                   all axes but 5 and 6
    p_5 = kr_5 (a_5 - k54 a_4) / 2 pi + cal_5
    p_6 = kr_6 (a_6 - k65 a_5 + (k65 k54 - k64) a_4) / 2 pi + cal_6

Joint torques follow from motor torques by the transposed coupling.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import pi

from sim_fixtures.settings import SettingError

_PER_AXIS = (
    "gear_ratio",
    "calibration",
    "joint_sign",
    "joint_offset",
    "torque_constant",
    "current_limit",
    "following_error",
)


@dataclass(frozen=True)
class SimulatedDrive:
    """Gears, calibration, coupling and motors of one arm; per-axis values are (n,) sequences.

    Raises:
        SettingError: coupling without a wrist.
    """

    gear_ratio: tuple[float, ...]  # signed motor revolutions per joint revolution
    calibration: tuple[float, ...]  # motor revolutions at controller angle zero
    joint_sign: tuple[float, ...]  # +1 or -1; controller angle = joint_sign * q + joint_offset
    joint_offset: tuple[float, ...]  # rad
    torque_constant: tuple[float, ...]  # N·m/A on the motor side
    current_limit: tuple[float, ...]  # A
    following_error: tuple[float, ...]  # threshold in motor revolutions
    encoder_counts: int  # per motor revolution
    k54: float = 0.0  # wrist coupling, 5 by 4; needs six axes
    k64: float = 0.0  # 6 by 4
    k65: float = 0.0  # 6 by 5
    _coupled: bool = field(init=False, repr=False)
    _k46: float = field(init=False, repr=False)
    _signed_ratio: tuple[float, ...] = field(init=False, repr=False)
    _motor_at_zero: tuple[float, ...] = field(init=False, repr=False)
    _joint_at_zero: tuple[float, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        for name in _PER_AXIS:
            object.__setattr__(self, name, tuple(float(v) for v in getattr(self, name)))
        coupling = (self.k54, self.k64, self.k65)
        if any(coupling) and self.n_axes < 6:
            raise SettingError("k54, k64, k65", coupling, "zero below six axes")
        object.__setattr__(self, "_coupled", any(coupling))
        # factor of angle 4 in the position of motor 6
        object.__setattr__(self, "_k46", self.k65 * self.k54 - self.k64)
        # motor revolutions per joint radian
        signed = tuple(
            s * kr / (2.0 * pi) for s, kr in zip(self.joint_sign, self.gear_ratio, strict=True)
        )
        object.__setattr__(self, "_signed_ratio", signed)
        signed_offset = [s * a for s, a in zip(self.joint_sign, self.joint_offset, strict=True)]
        geared = self.motor_speeds(signed_offset)
        at_zero = tuple(p + cal for p, cal in zip(geared, self.calibration, strict=True))
        object.__setattr__(self, "_motor_at_zero", at_zero)
        object.__setattr__(self, "_joint_at_zero", tuple(self.joint_speeds(at_zero)))

    @property
    def n_axes(self) -> int:
        """Number of axes."""
        return len(self.gear_ratio)

    def motor_revolutions(self, q: Sequence[float]) -> list[float]:
        """Return the motor positions, calibration included, of joint angles [rad]."""
        return [p + zero for p, zero in zip(self.motor_speeds(q), self._motor_at_zero, strict=True)]

    def motor_speeds(self, qd: Sequence[float]) -> list[float]:
        """Return motor speeds [rev/s] of joint speeds [rad/s]."""
        speeds = [ratio * v for ratio, v in zip(self._signed_ratio, qd, strict=True)]
        if self._coupled:
            # the coupling is defined for controller angles
            kr = self.gear_ratio
            sign = self.joint_sign
            a4 = sign[3] * qd[3]
            a5 = sign[4] * qd[4]
            speeds[4] -= kr[4] * self.k54 * a4 / (2.0 * pi)
            speeds[5] += kr[5] * (self._k46 * a4 - self.k65 * a5) / (2.0 * pi)
        return speeds

    def joint_angles(self, revolutions: Sequence[float]) -> list[float]:
        """Return joint angles [rad] of motor positions."""
        return [
            q - zero
            for q, zero in zip(self.joint_speeds(revolutions), self._joint_at_zero, strict=True)
        ]

    def joint_speeds(self, revolutions_per_second: Sequence[float]) -> list[float]:
        """Return joint speeds [rad/s] of motor speeds [rev/s]; also for accelerations."""
        speeds = [
            v / ratio for v, ratio in zip(revolutions_per_second, self._signed_ratio, strict=True)
        ]
        if self._coupled:
            sign = self.joint_sign
            a4 = sign[3] * speeds[3]
            own5 = sign[4] * speeds[4]
            speeds[4] += sign[4] * self.k54 * a4
            speeds[5] += sign[5] * (self.k65 * own5 + self.k64 * a4)
        return speeds

    def joint_torques(self, currents: Sequence[float]) -> list[float]:
        """Return joint torques [N m] of motor currents [A]."""
        motor = [kt * i for kt, i in zip(self.torque_constant, currents, strict=True)]
        torque = [2.0 * pi * ratio * m for ratio, m in zip(self._signed_ratio, motor, strict=True)]
        if self._coupled:
            # motors 5 and 6 also act on joint 4, motor 6 on joint 5
            kr = self.gear_ratio
            sign = self.joint_sign
            torque[3] += sign[3] * (kr[5] * self._k46 * motor[5] - kr[4] * self.k54 * motor[4])
            torque[4] -= sign[4] * kr[5] * self.k65 * motor[5]
        return torque

    def currents(self, torques: Sequence[float]) -> list[float]:
        """Return the motor currents [A] of joint torques [N m]."""
        motor = [
            t / (2.0 * pi * ratio) for t, ratio in zip(torques, self._signed_ratio, strict=True)
        ]
        if self._coupled:
            kr = self.gear_ratio
            motor[4] += kr[5] * self.k65 * motor[5] / kr[4]
            motor[3] += (kr[4] * self.k54 * motor[4] - kr[5] * self._k46 * motor[5]) / kr[3]
        return [m / kt for m, kt in zip(motor, self.torque_constant, strict=True)]

    def encoder(self, revolutions: Sequence[float], noise: Sequence[float]) -> list[float]:
        """Return the encoder readings of motor positions [rev], with `noise` in counts."""
        counts = self.encoder_counts
        return [round(p * counts + e) / counts for p, e in zip(revolutions, noise, strict=True)]
