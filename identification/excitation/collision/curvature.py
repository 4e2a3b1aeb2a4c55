"""How far bodies leave the straight way between two of their places.

A path whose second derivative is at most A stays within A h²/8 of the straight line between two
points that it passes h apart in time. Seen from the base all joints count, seen from the frame
that carries both bodies of a pair only those beyond it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from identification.excitation.collision.bodies import Body
from identification.model.kinematics import Chain

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


class Curvature:
    """Bounds of the accelerations of pairs of bodies, seen from a frame of each pair's own.

    A point's derivative by joint k is z_k x r_k, r_k from the joint to the point, or z_k for a
    slide; that derived by a revolute joint j before it, or by k itself, is no longer. So its
    acceleration is bounded by the longest r_k and the rates of the joints, whatever the posture.

    Args:
        chain: the arm.
        bodies: all bodies on it and about it.
        first, second: (p,) indices of the pairs.
        frame: (p,) the joint that a pair is seen from, one that moves both; -1 for the base.
    """

    def __init__(
        self,
        chain: Chain,
        bodies: Sequence[Body],
        first: Indices,
        second: Indices,
        frame: Indices,
    ) -> None:
        self._chain = chain
        radius = np.array([_radius(body) for body in bodies])
        moved = [
            (bodies[a].joint, bodies[b].joint, int(seen_from))
            for a, b, seen_from in zip(first, second, frame, strict=True)
        ]
        # Pairs of shapes on the same two links differ in nothing but their radius.
        links = sorted(set(moved))
        self._class: Indices = np.array([links.index(pair) for pair in moved], dtype=np.intp)
        largest = np.zeros((len(links), 2))
        np.maximum.at(largest, self._class, np.stack((radius[first], radius[second]), axis=1))
        self._frames = [seen_from for _, _, seen_from in links]
        self._branches = [
            [
                (chain.ancestors(joint), largest[row, side])
                for side, joint in enumerate(pair[:2])
                if joint >= 0
            ]
            for row, pair in enumerate(links)
        ]
        self._before = np.array([_before(chain, seen_from) for seen_from in self._frames])
        self._before = self._before.reshape(-1, chain.n_joints, chain.n_joints)
        self._fixed_arms = self._arms(np.zeros(chain.n_joints))

    def bulge(self, velocity: Array, acceleration: Array, q: Array, step: float) -> Array:
        """Bound how far two bodies leave straight lines between samples together, (p, g) [m].

        Args:
            velocity: largest |qd| of the joints in each part of a motion (n, g).
            acceleration: largest |qdd| there (n, g).
            q: the samples (m, n).
            step: time between them [s].
        """
        arms = self._fixed_arms
        if not np.all(self._chain.revolute):
            # A slide may go beyond its samples by what it can swing between two of them.
            swing = acceleration.max(axis=1) * step**2 / 8.0
            arms = self._arms(np.abs(q).max(axis=0) + swing)
        own = np.where(self._chain.revolute[:, None], velocity, 0.0)
        turned = velocity * (own + 2.0 * (self._before @ velocity)) + acceleration
        bulges: Array = (arms[:, None] @ turned)[:, 0] * (step**2 / 8.0)
        return bulges[self._class]

    def _arms(self, slides: Array) -> Array:
        """Return how far points are from each joint at most, both bodies' together (c, n)."""
        chain = self._chain
        arms = np.zeros((len(self._branches), chain.n_joints))
        for row, branches in enumerate(self._branches):
            for joints, radius in branches:
                arm = radius
                for k in reversed(joints):
                    if k == self._frames[row]:
                        break
                    arm += 0.0 if chain.revolute[k] else slides[k]
                    arms[row, k] += arm if chain.revolute[k] else 1.0
                    arm += float(np.linalg.norm(chain.translation[k]))
        return arms


def _radius(body: Body) -> float:
    """Bound how far points of a body are from the origin of its joint's frame [m]."""
    hull = body.hull
    reach = np.hypot(hull.half_length, hull.radius) + hull.ball
    return float(np.linalg.norm(hull.centre) + reach)


def carrier(chain: Chain, a: int, b: int) -> int:
    """Return the last joint that moves both links a and b, -1 for the base."""
    if a < 0 or b < 0:
        return -1
    common = set(chain.ancestors(a)) & set(chain.ancestors(b))
    return max(common, default=-1)  # a parent has a lower number than its children


def _before(chain: Chain, frame: int) -> Array:
    """Return which revolute joints beyond a frame come before each joint, (n, n)."""
    before = np.zeros((chain.n_joints, chain.n_joints))
    inside = chain.ancestors(frame) if frame >= 0 else ()
    for k in range(chain.n_joints):
        for j in chain.ancestors(k)[:-1]:
            if j not in inside and chain.revolute[j]:
                before[k, j] = 1.0
    return before
