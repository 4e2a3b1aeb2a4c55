"""Joints on position servos, simulated forward with their bodies along a reference motion.

Each joint is simulated alone: the other joints move along a reference. Where that is the simulated
motion itself, as after some repetitions, nothing is neglected (waveform relaxation).

Velocities are half a step before and after the instants of the positions (Störmer and Verlet, of
second order). The stiffness k acts on the mean of the positions before and after a step, which to a
step is an inertia :math:`k h^2 / 2`: no gain makes it unstable. Dry friction is implicit, so that a
joint comes to rest exactly.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from identification.arrays import Array
from identification.servo.parameters import NAMES

_SIMULATED: Final = (
    *("kp", "armature", "viscous", "coulomb", "delay", "offset", "load", "static", "speed"),
    *("kd", "limit", "dead_band"),
)
_UNLIMITED_ACCELERATION: Final = 1e6  # rad/s² or m/s²


@dataclass(frozen=True, eq=False)
class JointInputs:
    """What acts on c joints over K steps, several windows side by side.

    Attributes:
        step: time step [s].
        command: at the instants (L + K, c), of which the first L precede the window.
        lead: L.
        bias: torque of the bodies along the reference but for the joint's own inertia (K, c).
        inertia: that the bodies have at the joint (K, c).
        slope: of the torque of the bodies by the position of the joint (K, c).
        reference: position along which these are (K, c).
        position, velocity: at the start (c,).
    """

    step: float
    command: Array
    lead: int
    bias: Array
    inertia: Array
    slope: Array
    reference: Array
    position: Array
    velocity: Array

    def mapped(self, values: Callable[[str], Array]) -> JointInputs:
        """Return inputs with other arrays, by the names of these."""
        return JointInputs(
            self.step,
            values("command"),
            self.lead,
            *(values(name) for name in ("bias", "inertia", "slope", "reference")),
            *(values(name) for name in ("position", "velocity")),
        )


def simulate(inputs: JointInputs, values: Array, every: int = 1) -> Array:
    """Return positions (K / every, V, c) for V sets of values.

    Args:
        inputs: what acts.
        values: parameters in position errors of the servo (V, c, P), see
            :func:`identification.servo.parameters.in_errors`.
        every: steps between the instants that are returned.
    """
    h = inputs.step
    count = len(inputs.bias)
    by_name = dict(zip(NAMES, np.ascontiguousarray(np.moveaxis(values, -1, 0)), strict=True))
    compliance, armature, viscous, coulomb, delay, offset, load, static, speed, kd, limit, dead = (
        by_name[name] for name in _SIMULATED
    )
    commands = _delayed(inputs, delay)
    slower = -1.0 / speed**2
    has_static, has_kd, has_load = (bool(each.any()) for each in (static, kd, load))
    parts = _Parts(bool(dead.any()), has_kd, bool(np.isfinite(limit).any()))
    at_zero = inputs.bias - inputs.slope * inputs.reference
    braking = h * viscous
    half_braking = 0.5 * braking
    damped = (0.5 * h) * kd
    position = np.broadcast_to(inputs.position, delay.shape).copy()
    velocity = np.broadcast_to(inputs.velocity, delay.shape).copy()
    change: Array | float = 0.0
    positions = np.empty((-(-count // every), *delay.shape))
    planner = _SetPoint.of(by_name["acceleration"], h)
    earlier, wanted = next(commands), next(commands)
    for k in range(count):
        if k % every == 0:
            positions[k // every] = position
        later = next(commands)
        if planner is None:
            target, pace = wanted, (later - earlier) / (2.0 * h) if has_kd else 0.0
        else:
            target, pace = planner.moved(wanted, later)
        rate = pace - velocity if has_kd else 0.0
        motor, stiff = _motor(target + offset - position, rate, kd, limit, dead, parts)
        earlier, wanted = wanted, later
        bodies = compliance * (at_zero[k] + inputs.slope[k] * position)
        inertia = compliance * inputs.inertia[k]
        friction = coulomb
        if has_load:
            friction = friction + load * np.abs(bodies + inertia * change)
        if has_static:
            friction = friction + static * np.exp(slower * velocity * velocity)
        remaining = armature + inertia + (0.5 * h * h) * stiff
        # Half of the damping acts on the velocity before, unless it would turn that round.
        share = np.minimum(half_braking, remaining)
        left = remaining - share
        push = left * velocity + h * (motor - bodies)
        held = left + braking
        if has_kd:
            # The motor has it at the velocity before; half of it belongs to the one after.
            half = damped * stiff
            push = push + half * velocity
            held = held + half
        friction = h * friction
        new = (push - _limited(push, friction)) / held
        if has_load:
            change = (new - velocity) / h
        velocity = new
        position = position + h * velocity
    return positions


def _limited(values: Array, most: Array) -> Array:
    """Return values within plus or minus `most`; `np.clip` takes twice the time."""
    return np.minimum(np.maximum(values, -most), most)


def _delayed(inputs: JointInputs, delay: Array) -> Iterator[Array]:
    """Yield commands (V, c) after delays (V, c), from the instant before the first step on."""
    joints = inputs.bias.shape[1]
    late = np.clip(delay / inputs.step, 0.0, inputs.lead - 2.01)
    steps = np.floor(late).astype(np.intp)
    part = late - steps
    whole = 1.0 - part
    command = np.concatenate([inputs.command, inputs.command[-1:]]).ravel()
    place = (inputs.lead - steps - 2) * joints + np.arange(joints)
    newest = command[place]
    while True:
        place += joints
        before, newest = newest, command.take(place, mode="clip")
        yield newest * whole + before * part


@dataclass(eq=False)
class _SetPoint:
    """The set-point that a servo plans to its command, with limited acceleration (V, c).

    It brakes so as to stand where the command is, and stands there where it can within a step.

    Attributes:
        step: time step [s].
        most: the largest acceleration.
        position, velocity: of the set-point.
    """

    step: float
    most: Array
    position: Array | None = None
    velocity: Array | float = 0.0

    @classmethod
    def of(cls, acceleration: Array, step: float) -> _SetPoint | None:
        """Return it at rest; None if no joint has a limit."""
        if np.isinf(acceleration).all():
            return None
        return cls(step, np.minimum(acceleration, _UNLIMITED_ACCELERATION))

    def __post_init__(self) -> None:
        self._twice = 2.0 * self.most
        self._change = self.step * self.most
        self._half = 0.5 * self._change
        self._square = self._half**2

    def moved(self, command: Array, later: Array) -> tuple[Array, Array]:
        """Return position and velocity at an instant, and move on to the next.

        Args:
            command: at this instant.
            later: at the next.
        """
        if self.position is None:
            self.position = command
        here, before = self.position, self.velocity
        # The velocity of a step fits the distance in the middle of it, but passes no command.
        root = np.sqrt(self._twice * np.abs(0.5 * (command + later) - here) + self._square)
        away = (later - here) / self.step
        braked = np.copysign(np.minimum(root - self._half, np.abs(away)), away)
        self.velocity = before + _limited(braked - before, self._change)
        self.position = here + self.step * self.velocity
        return here, 0.5 * (before + self.velocity)


class _Parts(NamedTuple):
    """Which parts of a motor's torque some joint has."""

    dead_band: bool
    kd: bool
    limit: bool


def _motor(
    error: Array, rate: Array | float, kd: Array, limit: Array, dead: Array, parts: _Parts
) -> tuple[Array, Array | float]:
    """Return the torque of motors over their stiffness, and where it follows the error (V, c)."""
    stiff: Array | float = 1.0
    if parts.dead_band:
        inside = _limited(error, dead)
        stiff = inside != error
        error = error - inside
    if parts.kd:
        error = error + kd * rate
    if parts.limit:
        limited = _limited(error, limit)
        stiff = stiff * (limited == error)
        error = limited
    return error, stiff
