r"""Recorded torques through a model forwards in time: how far the arm would have gone astray.

.. math:: (M(q) + R)\,\ddot q = \tau + \tau_f - h(q, \dot q) - f(\dot q)

with the rotors' inertia R and a feedback :math:`\tau_f` on the recorded motion, a spring and damper
of `FEEDBACK` on each joint: without one any two models part, the farther the longer the motion. In
steps of at most `STEP`. Dry friction is an impulse that at most stops its joint, and so can hold.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from identification.model.pseudo_inertia import body
from identification.model.robot import RobotModel
from identification.signals.samples import Samples

Array = NDArray[np.float64]

STEP: Final = 1e-3
"""s; longer steps between two samples are divided."""
FEEDBACK: Final = 1.0
"""Hz, of each joint at its inertia in the first posture, critically damped."""
# Of impulses of dry friction, joint after joint; one that changes by so small a share is found.
_ROUNDS: Final = 200
_FOUND: Final = 1e-9


class Simulated(NamedTuple):
    """A model with its parameters.

    Attributes:
        model: the robot.
        standard: standard parameters (s,); every link with a mass, or held by rotors.
        values: parameters (p,), of which friction, springs and balancers are read.
    """

    model: RobotModel
    standard: Array
    values: Array


def replay(arm: Simulated, samples: Samples, gains_of: Simulated | None = None) -> Array:
    """Return simulated less recorded positions (m, n) [rad or m]; NaN between stretches.

    Args:
        arm: what is simulated, from the first recorded state of each stretch on.
        samples: recorded motion and torque, without that of a payload and known elements.
        gains_of: the arm whose inertia the feedback belongs to; by default the same.

    Raises:
        numpy.linalg.LinAlgError: a joint moves nothing that has inertia.
    """
    dynamics = _Dynamics(arm)
    ruler = dynamics if gains_of is None else _Dynamics(gains_of)
    error = np.full(samples.motion.position.shape, np.nan)
    rate = 2.0 * math.pi * FEEDBACK
    for stretch in samples.segments:
        motion, torque = samples.motion.rows(stretch), samples.torque[stretch]
        if not motion.n_samples:
            continue
        inertia = np.diag(ruler.inertia(motion.position[0]))
        q, v = motion.position[0].copy(), motion.velocity[0].copy()
        found = error[stretch]
        for k in range(motion.n_samples):
            found[k] = q - motion.position[k]
            if k + 1 == motion.n_samples:
                break
            duration = float(motion.time[k + 1] - motion.time[k])
            steps = max(1, math.ceil(duration / STEP - 1e-6))
            for step in range(steps):
                share = (step + 0.5) / steps
                aim, speed, given = (
                    (1.0 - share) * one[k] + share * one[k + 1]
                    for one in (motion.position, motion.velocity, torque)
                )
                given = given + inertia * (rate**2 * (aim - q) + 2.0 * rate * (speed - v))
                q, v = dynamics.advanced(q, v, given, duration / steps)
        error[stretch] = found
    return error


class SlowResidual(NamedTuple):
    """Torque that a model leaves out, averaged over a period of the feedback, joint by joint.

    Attributes:
        rms: (n,) [N·m or N].
        constant: (n,) share of its square that a constant torque explains.
        friction: (n,) what one in the direction of motion explains beyond that.
    """

    rms: Array
    constant: Array
    friction: Array


def slow_residual(arm: Simulated, recordings: Sequence[Samples]) -> SlowResidual:
    """Return what makes a replay drift: faster residuals average out.

    Args:
        arm: the model.
        recordings: motion and torque.
    """
    slow, turns = [], []
    for samples in recordings:
        residual = samples.torque - samples.predicted_torque(arm.model, arm.values)
        turning = np.sign(samples.motion.velocity) * arm.model.moving(samples.motion.velocity)
        for stretch in samples.segments:
            period = (samples.motion.time[stretch] * FEEDBACK).astype(np.intp)
            for one in np.split(np.arange(stretch.start, stretch.stop), _steps(period)):
                slow.append(residual[one].mean(axis=0))
                turns.append(turning[one].mean(axis=0))
    means, direction = np.array(slow), np.array(turns)
    power = np.mean(means**2, axis=0)
    constant = np.mean(means, axis=0)
    rest = means - constant
    aside = direction - direction.mean(axis=0)
    along = (aside * rest).sum(axis=0) ** 2
    size = (aside**2).sum(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        explained = np.nan_to_num(along / size) / len(means)
        return SlowResidual(
            np.sqrt(power), np.nan_to_num(constant**2 / power), np.nan_to_num(explained / power)
        )


def _steps(period: NDArray[np.intp]) -> NDArray[np.intp]:
    return np.flatnonzero(np.diff(period)) + 1


class _Dynamics:
    """Equations of motion of one arm."""

    def __init__(self, arm: Simulated) -> None:
        chain, self._model = arm.model.chain, arm.model
        self._arm = pin.Model()
        self._arm.gravity.linear = arm.model.gravity
        for joint, inertial in enumerate(arm.standard[arm.model.layout.links]):
            kind = "Revolute" if chain.revolute[joint] else "Prismatic"
            place = pin.SE3(chain.rotation[joint], chain.translation[joint])
            own = self._arm.addJoint(
                int(chain.parents[joint]) + 1,
                getattr(pin, f"JointModel{kind}Unaligned")(chain.axis[joint]),
                place,
                chain.joint_names[joint],
            )
            if inertial[-1] > 0.0:
                one = body(inertial)
                mass = pin.Inertia(one.mass, one.centre, one.inertia)
                self._arm.appendBodyToJoint(own, mass, pin.SE3.Identity())
        self._data = self._arm.createData()
        self._rotors = arm.model.layout.rotor_matrix(arm.standard)
        friction, n = arm.model.friction, arm.model.n_joints
        coefficients = friction.table(arm.values[arm.model.friction_part])
        self._turns = np.vstack([np.eye(n), friction.motor_speeds()])  # of joints, then motors
        self._terms = [
            (term, row.get(term.symbol, 0.0), owner)
            for owner, (law, row) in enumerate(zip(friction.all_laws, coefficients, strict=True))
            for term in law.terms
        ]
        self._elements = arm.values[arm.model.element_part]

    def inertia(self, q: Array) -> Array:
        """Return the inertia matrix (n, n) at positions (n,)."""
        upper = np.triu(pin.crba(self._arm, self._data, q))
        return np.asarray(upper + np.triu(upper, 1).T + self._rotors)

    def advanced(self, q: Array, v: Array, torque: Array, duration: float) -> tuple[Array, Array]:
        """Return position and velocity (n,) after a duration [s] under a torque (n,)."""
        smooth, slope, dry = self._friction(v)
        rest = torque - smooth - pin.nonLinearEffects(self._arm, self._data, q, v)
        if self._elements.size:
            rest = rest - self._model.elements.torque(self._elements, q[None])[0]
        response = np.asarray(np.linalg.inv(self.inertia(q) + duration * slope), dtype=np.float64)
        moved = self._slowed(v, v + duration * (response @ rest), response, duration * dry)
        return q + duration * moved, moved

    def _slowed(self, before: Array, free: Array, response: Array, most: Array) -> Array:
        """Return the speeds (n,) that dry friction leaves of those without it.

        Args:
            before: speeds before the step (n,).
            free: speeds after it without dry friction (n,).
            response: speeds per impulse (n, n).
            most: largest impulse of dry friction of each joint and coupled motor (n + k,).
        """
        turns = self._turns
        directions = np.sign(turns @ before)
        columns = response @ turns.T
        impulse = -most * directions
        moved = free + columns @ impulse
        if np.array_equal(np.sign(turns @ moved), directions):
            return np.asarray(moved)
        # Some change direction or rest: each as much as stops it, at most what it has.
        own = np.einsum("kn,nk->k", turns, columns)
        for _ in range(_ROUNDS):
            changed = False
            for k in np.flatnonzero(most):
                wanted = impulse[k] - (turns[k] @ moved) / own[k]
                change = min(max(wanted, -most[k]), most[k]) - impulse[k]
                if abs(change) > _FOUND * most[k]:
                    impulse[k] += change
                    moved = moved + columns[:, k] * change
                    changed = True
            if not changed:
                break
        return np.asarray(moved)

    def _friction(self, v: Array) -> tuple[Array, Array, Array]:
        """Return what friction depends on speed alone, its slope, and what depends on direction.

        Of all joints (n,), with their speeds (n, n), and of joints and then motors (n + k,).
        """
        turns, zero = self._turns, np.zeros(())
        speeds = turns @ v
        smooth, slope, dry = np.zeros((3, len(speeds)))
        for term, coefficient, owner in self._terms:
            speed = speeds[owner]
            still = float(term.column(speed, zero))
            smooth[owner] += coefficient * still
            dry[owner] += coefficient * (float(term.column(speed, zero + 1.0)) - still)
            slope[owner] += coefficient * float(term.slope(speed, zero))
        resisting = (turns.T * np.maximum(slope, 0.0)) @ turns
        return turns.T @ smooth, resisting, np.maximum(dry, 0.0)
