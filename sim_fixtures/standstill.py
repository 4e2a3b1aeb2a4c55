"""Dry friction in one time step: which joints slide, which rest, and what friction holds them.

A joint that could be stopped within the step by less than its Coulomb torque rests; any other
slides against the full torque. Joints push on each other through the inverse inertia A, so the
torques of all joints are found together:

    v = v_free - h A f,   |f_i| <= f0_i,   v_i != 0 only where f_i = f0_i sgn(v_i)

That is the optimality condition of a convex problem with bounds, solved joint by joint until
nothing changes. Every step is resolved by its own state: no small speed below which the law is
bent, hence no creep under load and no chatter.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MAX_SWEEPS = 200
TOLERANCE = 1e-6
"""Change of a torque that is no longer made, relative to the Coulomb torque."""


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
        free_velocity: velocities at the end of the step without dry friction, (n,) [rad/s].
        inverse_inertia: A, (n, n), symmetric, positive definite.
        coulomb: Coulomb torques f0, (n,) [N m].
        step: h [s].
        guess: torques to start from, (n,) [N m]; those of the step before.
    """
    coupling = inverse_inertia * step
    rows: list[list[float]] = coupling.tolist()
    torque = [max(-c, min(c, f)) for f, c in zip(guess, coulomb, strict=True)]
    velocity: list[float] = (np.array(free_velocity) - coupling @ torque).tolist()
    for _ in range(MAX_SWEEPS):
        settled = True
        for i, limit in enumerate(coulomb):
            held = torque[i]
            wanted = max(-limit, min(limit, held + velocity[i] / rows[i][i]))
            change = wanted - held
            if abs(change) > TOLERANCE * limit:
                torque[i] = wanted
                velocity = [v - a * change for v, a in zip(velocity, rows[i], strict=True)]
                settled = False
        if settled:
            break
    # a joint stands if friction had enough in hand to take away what is left of its velocity
    for i, limit in enumerate(coulomb):
        if abs(torque[i] + velocity[i] / rows[i][i]) < limit:
            velocity[i] = 0.0
    return DryFriction(velocity, torque)
