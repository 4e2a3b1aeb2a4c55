r"""Forward simulation of a model under recorded torques: divergence from the recorded motion.

.. math:: (M(q) + R)\,\ddot q = \tau + \tau_f - h(q, \dot q) - f(\dot q)

with rotor inertias R and a spring and damper :math:`\tau_f` on the recorded motion. Dry friction is
an impulse that at most stops its joint. All arms are branches of one pinocchio model.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from identification.model.friction import FrictionTerm
from identification.model.pseudo_inertia import body
from identification.model.robot import RobotModel
from identification.signals.samples import Samples

Array = NDArray[np.float64]

STEP: Final = 1e-3
"""Longest integration step, s."""
FEEDBACK: Final = 1.0
"""Hz; critically damped at the inertia of the first posture."""
# Iterations for impulses of dry friction, and relative change at which they end.
_ROUNDS: Final = 200
_FOUND: Final = 1e-9


class Simulated(NamedTuple):
    """Model with parameters of V arms."""

    model: RobotModel
    standard: Array  # standard parameters (V, s); every joint moves inertia
    values: Array  # parameters (V, p), for friction, springs and balancers


def replay(arms: Simulated, samples: Samples) -> Array:
    """Return simulated minus recorded positions (V, m, n) [rad or m]; NaN between segments.

    Starts at the first recorded state of each segment, under the torque without payload and known
    elements, with the feedback inertia of the first arm.

    Raises:
        numpy.linalg.LinAlgError: a joint without inertia.
    """
    dynamics = _Dynamics(arms)
    found = np.full((len(arms.standard), *samples.motion.position.shape), np.nan)
    rate = 2.0 * math.pi * FEEDBACK
    for stretch in samples.segments:
        motion, torque = samples.motion.rows(stretch), samples.torque[stretch]
        if not motion.n_samples:
            continue
        q, v = (np.tile(one[0], (len(found), 1)) for one in (motion.position, motion.velocity))
        inertia = np.diag(dynamics.inertia(q)[0])
        path = found[:, stretch]
        path[:, 0] = q
        duration = np.diff(motion.time)
        steps = np.maximum(1, np.ceil(duration / STEP - 1e-6)).astype(np.intp)
        sample = np.repeat(np.arange(len(steps)), steps)
        step = np.arange(len(sample)) - (np.cumsum(steps) - steps)[sample]
        share = ((step + 0.5) / steps[sample])[:, None]
        between = (
            (1.0 - share) * one[sample] + share * one[sample + 1]
            for one in (motion.position, motion.velocity, torque)
        )
        for k, period, aim, speed, given in zip(
            sample + 1, (duration / steps)[sample].tolist(), *between, strict=True
        ):
            pull = inertia * (rate**2 * (aim - q) + 2.0 * rate * (speed - v))
            q, v = dynamics.step(q, v, given + pull, period)
            path[:, k] = q
    return found - samples.motion.position


class SlowResidual(NamedTuple):
    """Torque residual averaged over a period of the feedback, per joint."""

    rms: Array  # (n,) [N·m or N]
    constant: Array  # (n,) share of its square that a constant explains
    friction: Array  # (n,) additional share that a torque in the direction of motion explains


def slow_residual(arm: Simulated, recordings: Sequence[Samples]) -> SlowResidual:
    """Return the slow torque residual of the first arm, which makes a simulation diverge."""
    slow: list[Array] = []
    turns: list[Array] = []
    for samples in recordings:
        velocity = samples.motion.velocity
        residual = samples.torque - samples.predicted_torque(arm.model, arm.values[0])
        turning = np.sign(velocity) * arm.model.moving(velocity)
        for stretch in samples.segments:
            period = (samples.motion.time[stretch] * FEEDBACK).astype(np.intp)
            cuts = np.flatnonzero(np.diff(period)) + 1
            for found, values in ((slow, residual), (turns, turning)):
                found += [part.mean(axis=0) for part in np.split(values[stretch], cuts)]
    means, direction = np.array(slow), np.array(turns)
    power, constant = np.mean(means**2, axis=0), np.mean(means, axis=0)
    aside = direction - direction.mean(axis=0)
    along = (aside * (means - constant)).sum(axis=0) ** 2
    with np.errstate(divide="ignore", invalid="ignore"):
        explained = np.nan_to_num(along / (aside**2).sum(axis=0)) / len(means)
        shares = np.nan_to_num([constant**2 / power, explained / power])
    return SlowResidual(np.sqrt(power), shares[0], shares[1])


class _Dynamics:
    """Equations of motion of V arms of one model."""

    def __init__(self, arms: Simulated) -> None:
        self._model, n = arms.model, arms.model.n_joints
        self._arms = _branches(arms)
        self._data = self._arms.createData()
        self._rotors = np.array([arms.model.layout.rotor_matrix(one) for one in arms.standard])
        friction = arms.model.friction
        tables = [friction.table(one[arms.model.friction_part]) for one in arms.values]
        self._turns = np.vstack([np.eye(n), friction.motor_speeds()])  # joints, then motors
        owners: dict[FrictionTerm, list[int]] = {}
        for owner, law in enumerate(friction.all_laws):
            for term in law.terms:
                owners.setdefault(term, []).append(owner)
        self._terms = [
            (term, own, np.array([[one[k].get(term.symbol, 0.0) for k in own] for one in tables]))
            for term, own in owners.items()
        ]
        self._elements = arms.values[:, arms.model.element_part]

    def inertia(self, q: Array) -> Array:
        """Return the inertia matrices (V, n, n) at positions (V, n)."""
        shape = (*q.shape, *q.shape)
        upper = np.triu(
            np.einsum("anam->anm", pin.crba(self._arms, self._data, q.ravel()).reshape(shape))
        )
        return np.asarray(upper + np.triu(upper, 1).swapaxes(1, 2) + self._rotors)

    def step(self, q: Array, v: Array, torque: Array, duration: float) -> tuple[Array, Array]:
        """Return position and velocity (V, n) after a duration [s] under torques (V, n)."""
        smooth, slope, dry = self._friction(v)
        bias = pin.nonLinearEffects(self._arms, self._data, q.ravel(), v.ravel())
        rest = torque - smooth - bias.reshape(q.shape)
        for one in self._model.elements.identified:
            columns = one.columns(q)
            rest[:, one.joint] -= np.einsum("ac,ac->a", columns, self._elements[:, one.part])
        held = self.inertia(q) + duration * slope
        response = np.asarray(np.linalg.inv(held), dtype=np.float64)
        free = v + duration * np.einsum("anm,am->an", response, rest)
        moved = self._with_dry_friction(v, free, response, duration * dry)
        return q + duration * moved, moved

    def _with_dry_friction(self, before: Array, free: Array, response: Array, most: Array) -> Array:
        """Apply dry friction to the speeds `free` (V, n) after a step."""
        turns = self._turns
        directions = np.sign(before @ turns.T)
        columns = response @ turns.T
        impulse = -most * directions
        moved = free + np.einsum("ank,ak->an", columns, impulse)
        turned = np.any(np.sign(moved @ turns.T) != directions, axis=1)
        if not turned.any():
            return np.asarray(moved)
        # Joints that reverse or rest: the impulse that stops them, within its limit.
        columns, impulse, most, speeds = (one[turned] for one in (columns, impulse, most, moved))
        own = np.einsum("kn,ank->ak", turns, columns)
        for _ in range(_ROUNDS):
            changed = False
            for k in np.flatnonzero(most.any(axis=0)):
                wanted = impulse[:, k] - (speeds @ turns[k]) / own[:, k]
                change = np.clip(wanted, -most[:, k], most[:, k]) - impulse[:, k]
                change[np.abs(change) <= _FOUND * most[:, k]] = 0.0
                if change.any():
                    impulse[:, k] += change
                    speeds += columns[:, :, k] * change[:, None]
                    changed = True
            if not changed:
                break
        moved[turned] = speeds
        return np.asarray(moved)

    def _friction(self, v: Array) -> tuple[Array, Array, Array]:
        """Return viscous friction (V, n), its slope (V, n, n), and dry friction (V, n + k)."""
        turns, zero = self._turns, np.zeros(())
        speeds = v @ turns.T
        smooth, slope, dry = np.zeros((3, *speeds.shape))
        for term, owners, coefficients in self._terms:
            speed = speeds[:, owners]
            still = term.column(speed, zero)
            smooth[:, owners] += coefficients * still
            dry[:, owners] += coefficients * (term.column(speed, zero + 1.0) - still)
            slope[:, owners] += coefficients * term.slope(speed, zero)
        resisting = (turns.T * np.maximum(slope, 0.0)[:, None]) @ turns
        return smooth @ turns, resisting, np.maximum(dry, 0.0)


def _branches(arms: Simulated) -> pin.Model:
    """Return all arms side by side on one base."""
    chain, found = arms.model.chain, pin.Model()
    found.gravity.linear = arms.model.gravity
    for arm, standard in enumerate(arms.standard):
        base = found.njoints - 1
        for joint, inertial in enumerate(standard[arms.model.layout.links]):
            kind = "Revolute" if chain.revolute[joint] else "Prismatic"
            parent = int(chain.parents[joint])
            own = found.addJoint(
                0 if parent < 0 else base + parent + 1,
                getattr(pin, f"JointModel{kind}Unaligned")(chain.axis[joint]),
                pin.SE3(chain.rotation[joint], chain.translation[joint]),
                f"{arm}/{chain.joint_names[joint]}",
            )
            if inertial[-1] > 0.0:
                one = body(inertial)
                mass = pin.Inertia(one.mass, one.centre, one.inertia)
                found.appendBodyToJoint(own, mass, pin.SE3.Identity())
    return found
