"""Gram matrices in standard parameters, for any direction of gravity.

The regressor is affine in gravity: W(g) = W0 + gx Wx + gy Wy + gz Wz. One pass over the samples
therefore says what any other gravity would have made of them. Standard parameters are used, since
which combinations of them are base parameters depends on gravity.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification.model.regressor import Regressor, RegressorPlan
from identification.model.robot import RobotModel
from identification.signals.samples import Samples

Array = NDArray[np.float64]

# Rows of one recording: what is asked is coarse, and neighbours say the same.
_MOST_ROWS: Final = 1000
# Singular values below this share of the largest are combinations that do not act.
_NEGLIGIBLE: Final = 1e-9


@dataclass(frozen=True, eq=False)
class StandardGram:
    """Sums over samples of products of [W0 | Wx | Wy | Wz | y], joint by joint.

    Attributes:
        gram: (n, 4 s + 1, 4 s + 1) for s columns: standard parameters, friction, then
            springs and balancers.
        rows: that were summed (n,).
    """

    gram: Array
    rows: Array

    @property
    def size(self) -> int:
        """Number s of columns."""
        return (int(self.gram.shape[1]) - 1) // 4

    def under(self, gravity: Array) -> Array:
        """Gram matrices of [W | y] under a gravity (3,) [m/s²]: (n, s + 1, s + 1)."""
        s, h = self.size, np.concatenate([[1.0], gravity])
        blocks = self.gram[:, : 4 * s, : 4 * s].reshape(-1, 4, s, 4, s)
        found = np.empty((len(self.gram), s + 1, s + 1))
        found[:, :s, :s] = np.einsum("a,jasbt,b->jst", h, blocks, h, optimize=True)
        found[:, :s, s] = np.einsum(
            "a,jas->js", h, self.gram[:, : 4 * s, 4 * s].reshape(-1, 4, s), optimize=True
        )
        found[:, s, :s] = found[:, :s, s]
        found[:, s, s] = self.gram[:, 4 * s, 4 * s]
        return found

    @classmethod
    def of(cls, model: RobotModel, recordings: Sequence[Samples]) -> StandardGram:
        """Sum over about a thousand usable rows of each recording."""
        plans = [_plan(model, gravity) for gravity in (np.zeros(3), *np.eye(3))]
        s = model.layout.size + len(model.friction.names) + len(model.elements.names)
        n = model.n_joints
        gram, rows = np.zeros((n, 4 * s + 1, 4 * s + 1)), np.zeros(n)
        for samples in recordings:
            rows_used = slice(None, None, max(1, len(samples.torque) // _MOST_ROWS))
            still, *pulled = (_rows(plan, samples, rows_used, s) for plan in plans)
            usable, torque = samples.usable[rows_used], samples.torque[rows_used]
            for joint in range(n):
                parts = [still[joint], *(one[joint] - still[joint] for one in pulled)]
                table = np.column_stack([*parts, torque[:, joint]])[usable[:, joint]]
                gram[joint] += table.T @ table
                rows[joint] += len(table)
        return cls(gram, rows)


def gravity_loads(model: RobotModel, position: Array) -> NDArray[np.bool_]:
    """Whether gravity can load each joint (n,) in some of the positions (m, n)."""
    still = np.zeros_like(position)
    plan = RegressorPlan.of_bodies(model.chain, model.gravity)
    blocks = plan.evaluate(position, still, still).blocks
    # Of a unit first moment the torque is g; rounding in the URDF's angles leaves far less.
    floor = 1e-3 * float(np.linalg.norm(model.gravity))
    return np.array([bool(np.abs(block).max(initial=0.0) > floor) for block in blocks])


def solve(gram: Array, weights: Array) -> Array:
    """Least squares on Gram matrices (n, s + 1, s + 1) weighted by joint: (s,), least norm."""
    total = np.tensordot(weights, gram, axes=1)
    length = np.sqrt(np.diag(total)[:-1])
    scale = np.where(length > 0.0, length, 1.0)
    values, vectors = np.linalg.eigh(total[:-1, :-1] / np.outer(scale, scale))
    rows_used = values > _NEGLIGIBLE * values[-1]
    into = vectors[:, rows_used].T @ (total[:-1, -1] / scale)
    return np.asarray((vectors[:, rows_used] @ (into / values[rows_used])) / scale)


def squared_errors(gram: Array, values: Array) -> Array:
    """Sum of squared errors of parameters (s,) on each joint (n,)."""
    augmented = np.append(-values, 1.0)
    errors = np.einsum("s,jst,t->j", augmented, gram, augmented, optimize=True)
    return np.asarray(np.maximum(errors, 0.0))


def _plan(model: RobotModel, gravity: Array) -> RegressorPlan:
    n = model.n_joints
    return RegressorPlan(
        model.chain,
        gravity,
        [list(range(10))] * n,
        [model.rotor_inertia] * n,
        model.friction,
        model.layout.pairs,
        model.elements,
    )


def _rows(plan: RegressorPlan, samples: Samples, rows_used: slice, s: int) -> list[Array]:
    """Rows of each joint with all s columns, as the torque channel records them."""
    motion = samples.motion
    filtered = samples.torque_bandwidth is not None
    part = slice(None) if filtered else rows_used
    found: Regressor = plan.evaluate(
        motion.position[part], motion.velocity[part], motion.acceleration[part]
    )
    rows = []
    for joint, (block, columns) in enumerate(zip(found.blocks, found.columns, strict=True)):
        if filtered:
            block = samples.as_measured(joint, block)[rows_used]
        full = np.zeros((len(block), s))
        full[:, columns] = block
        rows.append(full)
    return rows
