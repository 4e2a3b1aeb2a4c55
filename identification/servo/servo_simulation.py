"""Joints on position servos, simulated forward with their bodies along a reference motion.

Each joint is simulated alone: the other joints move along a reference. Where that is the simulated
motion itself, as after some repetitions, nothing is neglected (waveform relaxation).

Velocities are half a step before and after the instants of the positions (Störmer and Verlet, of
second order). The stiffness k acts on the mean of the positions before and after a step, which to a
step is an inertia :math:`k h^2 / 2`: no gain makes it unstable. Dry friction is implicit, so that a
joint comes to rest exactly.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array


@dataclass(frozen=True, eq=False)
class JointInputs:
    """What acts on c joints over K steps, those of several windows side by side.

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
    count, joints = inputs.bias.shape
    compliance, armature, viscous, coulomb, delay, offset, load, static, speed, kd, limit, dead = (
        np.ascontiguousarray(np.moveaxis(values, -1, 0))
    )
    place, part, stop = _places(inputs, delay)
    command = inputs.command.ravel()
    decay = 1.0 / speed**2
    has_static, has_kd, has_load = (bool(each.any()) for each in (static, kd, load))
    parts = _Parts(bool(dead.any()), has_kd, bool(np.isfinite(limit).any()))
    position = np.broadcast_to(inputs.position, part.shape).copy()
    velocity = np.broadcast_to(inputs.velocity, part.shape).copy()
    change: Array | float = 0.0
    positions = np.empty((-(-count // every), *part.shape))
    earlier = command[place - joints] * (1.0 - part) + command[place - 2 * joints] * part
    wanted = command[place] * (1.0 - part) + command[place - joints] * part
    for k in range(count):
        if k % every == 0:
            positions[k // every] = position
        place += joints
        ahead = np.minimum(place, stop - 1)
        later = command[ahead] * (1.0 - part) + command[place - joints] * part
        rate = (later - earlier) / (2.0 * h) - velocity if has_kd else 0.0
        motor, stiff = _motor(wanted + offset - position, rate, kd, limit, dead, parts)
        earlier, wanted = wanted, later
        bodies = compliance * (inputs.bias[k] + inputs.slope[k] * (position - inputs.reference[k]))
        inertia = compliance * inputs.inertia[k]
        friction = coulomb
        if has_load:
            friction = friction + load * np.abs(bodies + inertia * change)
        if has_static:
            friction = friction + static * np.exp(-decay * velocity * velocity)
        own = armature + inertia
        remaining = own + (0.5 * h * h) * stiff
        braking = h * viscous
        # Half of the damping acts on the velocity before, unless it would turn that round.
        share = np.minimum(0.5 * braking, remaining)
        push = (remaining - share) * velocity + h * (motor - bodies)
        held = remaining + braking - share
        if has_kd:
            # The motor has it at the velocity before; half of it belongs to the one after.
            half = (0.5 * h) * kd * stiff
            push = push + half * velocity
            held = held + half
        push = push - np.clip(push, -h * friction, h * friction)
        new = push / held
        if has_load:
            change = (new - velocity) / h
        velocity = new
        position = position + h * velocity
    return positions


def _places(inputs: JointInputs, delay: Array) -> tuple[NDArray[np.intp], Array, int]:
    """Return where in all commands a delayed one is at the start, and its part before (V, c).

    And how many commands there are.
    """
    joints = inputs.bias.shape[1]
    late = np.clip(delay / inputs.step, 0.0, inputs.lead - 2.01)
    whole = np.floor(late).astype(np.intp)
    return (inputs.lead - whole) * joints + np.arange(joints), late - whole, inputs.command.size


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
        inside = np.clip(error, -dead, dead)
        stiff = inside != error
        error = error - inside
    if parts.kd:
        error = error + kd * rate
    if parts.limit:
        limited = np.clip(error, -limit, limit)
        stiff = stiff * (limited == error)
        error = limited
    return error, stiff
