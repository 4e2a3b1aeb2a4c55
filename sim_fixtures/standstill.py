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
TOLERANCE = 1e-7
"""Largest change of a torque in the last sweep, relative to the Coulomb torque."""


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
    n = len(coulomb)
    rows = (inverse_inertia * step).tolist()
    torque = [max(-c, min(c, f)) for f, c in zip(guess, coulomb, strict=True)]
    velocity = [
        v - sum(a * f for a, f in zip(row, torque, strict=True))
        for v, row in zip(free_velocity, rows, strict=True)
    ]
    for _ in range(MAX_SWEEPS):
        settled = True
        for i in range(n):
            limit = coulomb[i]
            wanted = torque[i] + velocity[i] / rows[i][i]
            wanted = max(-limit, min(limit, wanted))
            change = wanted - torque[i]
            if change != 0.0:
                torque[i] = wanted
                velocity = [v - a * change for v, a in zip(velocity, rows[i], strict=True)]
                settled = settled and abs(change) <= TOLERANCE * limit
        if settled:
            break
    resting = [abs(f) < c for f, c in zip(torque, coulomb, strict=True)]
    return DryFriction(
        [0.0 if rests else v for v, rests in zip(velocity, resting, strict=True)], torque
    )
