"""Lower bounds of the distances between the hulls of bodies, and how far steps of joints move them.

Arrays of positions of hulls have samples as their last axis. Any direction n gives a lower bound of
the signed distance of two convex bodies, ``n · (c_a - c_b) - h_a(n) - h_b(n)`` with the support
function h of each about its centre c.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array, Indices
from identification.excitation.collision_bodies import CollisionBody
from identification.model.kinematics import Chain, skew

_CROSSING_DISTANCE = 1e-9  # axes closer than this [m] intersect


class Frames(NamedTuple):
    """Base and joint frames at m samples: axes (1 + n, 3, 3, m), origins (1 + n, 3, m) [m]."""

    rotation: Array
    translation: Array


class BodyHulls(NamedTuple):
    """Hulls of b bodies at m samples."""

    centre: Array  # (3, b, m) [m]
    axis: Array  # unit vectors (3, b, m)


def frames(chain: Chain, q: Array) -> Frames:
    """Return base and joint frames at postures (m, n); Rodrigues' formula joint by joint."""
    m, n = q.shape
    rotation = np.empty((1 + n, 3, 3, m))
    translation = np.zeros((1 + n, 3, m))
    rotation[0] = np.eye(3)[:, :, None]
    sine = np.sin(q.T)
    versine = 1.0 - np.cos(q.T)
    for joint in range(n):
        before = rotation[chain.parents[joint] + 1]
        fixed = chain.rotation[joint]
        across = skew(chain.axis[joint])
        origin = translation[joint + 1]
        np.matmul(chain.translation[joint], before, out=origin)
        origin += translation[chain.parents[joint] + 1]
        turned = rotation[joint + 1]
        if chain.revolute[joint]:
            # before @ fixed @ (1 + sin K + (1 - cos) K²), its three terms by one product
            terms = np.concatenate((fixed, fixed @ across, fixed @ across @ across), axis=1).T
            placed = np.matmul(terms, before)
            np.multiply(placed[:, 3:6], sine[joint], out=turned)
            turned += placed[:, :3]
            placed[:, 6:] *= versine[joint]
            turned += placed[:, 6:]
        else:
            np.matmul(fixed.T, before, out=turned)
            origin += np.matmul(fixed @ chain.axis[joint], before) * q[:, joint]
    return Frames(rotation, translation)


def placed(bodies: Sequence[CollisionBody], at: Frames) -> BodyHulls:
    """Return the positions of the hulls of bodies, which are sorted by joint."""
    centre, axis = np.empty((2, 3, len(bodies), at.translation.shape[2]))
    joints = np.array([body.joint for body in bodies])
    for joint in dict.fromkeys(joints.tolist()):
        rows = np.flatnonzero(joints == joint)
        hulls = [bodies[row].hull for row in rows.tolist()]
        centres = np.array([hull.centre for hull in hulls])
        axes = np.array([hull.axis for hull in hulls])
        if joint < 0:
            centre[:, rows] = centres.T[:, :, None]
            axis[:, rows] = axes.T[:, :, None]
            continue
        part = slice(rows[0], rows[-1] + 1)
        rotation = at.rotation[joint + 1]
        np.matmul(centres, rotation, out=centre[:, part])
        centre[:, part] += at.translation[joint + 1][:, None]
        np.matmul(axes, rotation, out=axis[:, part])
    return BodyHulls(centre, axis)


class Separation:
    """Lower bounds of the signed distances of pairs of bodies, an obstacle always second.

    Attributes:
        first, second: (p,) bodies of each pair: first pairs with a moving second body, then those
            with a box, then those with a plane.
        exact: (p,) whether the bounds are the distances themselves.
    """

    def __init__(self, bodies: Sequence[CollisionBody], pairs: Sequence[tuple[int, int]]) -> None:
        kinds = [
            2 if bodies[b].normal is not None else 1 if bodies[b].half_sides is not None else 0
            for _, b in pairs
        ]
        order = np.argsort(kinds, kind="stable")
        table = np.array(pairs, dtype=np.intp).reshape(-1, 2)[order]
        self.first: Indices = table[:, 0]
        self.second: Indices = table[:, 1]
        self._boxes, self._planes = np.searchsorted(np.array(kinds)[order], (1, 2)).tolist()
        self._half_length, self._radius, self._ball = np.array(
            [(body.hull.half_length, body.hull.radius, body.hull.ball) for body in bodies]
        ).T
        self._half_sides = np.array(
            [np.zeros(3) if body.half_sides is None else body.half_sides for body in bodies]
        ).T
        exact = np.array([body.hull.exact for body in bodies])
        self.exact: NDArray[np.bool_] = exact[self.first] & (np.arange(len(pairs)) >= self._planes)

    def bound(self, at: BodyHulls, pair: Indices, sample: Indices) -> Array:
        """Return lower bounds (k,) [m] of pairs (k,) in rising order, at samples (k,)."""
        lower = np.empty(len(pair))
        boxes, planes = np.searchsorted(pair, (self._boxes, self._planes)).tolist()
        for part, bound in (
            (slice(0, boxes), self._between_axes),
            (slice(boxes, planes), self._from_box),
            (slice(planes, len(pair)), self._above_plane),
        ):
            if part.stop > part.start:
                lower[part] = bound(at, pair[part], sample[part])
        return lower

    def _along(self, at: BodyHulls, pair: Indices, sample: Indices, normal: Array) -> Array:
        """Return the bounds (k,) [m] of pairs (k,) at samples (k,) in directions (3, k)."""
        a = self.first[pair]
        b = self.second[pair]
        bound = _dot(normal, _at(at.centre, a, sample) - _at(at.centre, b, sample))
        bound -= self._support(a, _dot(normal, _at(at.axis, a, sample)))
        bound -= self._support(b, _dot(normal, _at(at.axis, b, sample)))
        if self._planes > self._boxes:
            bound -= _dot(np.abs(normal), self._half_sides[:, b])
        return bound

    def _above_plane(self, at: BodyHulls, pair: Indices, sample: Indices) -> Array:
        return self._along(at, pair, sample, _at(at.axis, self.second[pair], sample))

    def _support(self, body: Indices, cosine: Array) -> Array:
        """Return h of hulls in directions with this cosine to their axes."""
        across = np.sqrt(np.maximum(1.0 - cosine * cosine, 0.0))
        height: Array = self._half_length[body] * np.abs(cosine)
        height += self._radius[body] * across
        height += self._ball[body]
        return height

    def _between_axes(self, at: BodyHulls, pair: Indices, sample: Indices) -> Array:
        a = self.first[pair]
        b = self.second[pair]
        axis_a = _at(at.axis, a, sample)
        axis_b = _at(at.axis, b, sample)
        between = _at(at.centre, a, sample) - _at(at.centre, b, sample)
        shortest = _between_segments(
            between, axis_a, self._half_length[a], axis_b, self._half_length[b]
        )
        length = _norm(shortest)
        crossing = length < _CROSSING_DISTANCE
        normal = shortest / np.where(crossing, 1.0, length)
        normal[:, crossing] = np.array([[0.0], [0.0], [1.0]])
        bound = _dot(normal, between)
        bound -= self._support(a, _dot(normal, axis_a))
        bound -= self._support(b, _dot(normal, axis_b))
        return bound

    def _from_box(self, at: BodyHulls, pair: Indices, sample: Indices) -> Array:
        """Use the best of three faces and of the direction from the box to the body's centre."""
        a = self.first[pair]
        b = self.second[pair]
        between = _at(at.centre, a, sample) - _at(at.centre, b, sample)
        sides = self._half_sides[:, b]
        outward = between - np.clip(between, -sides, sides)
        outward[2, ~np.any(outward, axis=0)] = 1.0
        bound = self._along(at, pair, sample, outward / _norm(outward))
        for face in range(3):
            normal = np.zeros_like(between)
            normal[face] = np.where(between[face] < 0.0, -1.0, 1.0)
            np.maximum(bound, self._along(at, pair, sample, normal), out=bound)
        return bound


def _between_segments(between: Array, u: Array, half_u: Array, v: Array, half_v: Array) -> Array:
    """Return the shortest vectors (3, k) from segments along v to segments along u."""
    cosine = _dot(u, v)
    along_u = _dot(u, between)
    along_v = _dot(v, between)
    across = 1.0 - cosine * cosine
    with np.errstate(divide="ignore", invalid="ignore"):
        s = (cosine * along_v - along_u) / across
    s = np.where(across > 1e-12, s, 0.0)  # parallel
    s = np.clip(s, -half_u, half_u)
    t = np.clip(cosine * s + along_v, -half_v, half_v)
    s = np.clip(cosine * t - along_u, -half_u, half_u)
    shortest: Array = between + s * u
    shortest -= t * v
    return shortest


def _at(table: Array, body: Indices, sample: Indices) -> Array:
    """Return columns (3, k) of a table (3, b, m)."""
    return np.asarray(table.reshape(3, -1).take(body * table.shape[2] + sample, axis=1))


def _dot(a: Array, b: Array) -> Array:
    total: Array = a[0] * b[0]
    total += a[1] * b[1]
    total += a[2] * b[2]
    return total


def _norm(vectors: Array) -> Array:
    return np.asarray(np.sqrt(_dot(vectors, vectors)))


def reaches(
    chain: Chain, bodies: Sequence[CollisionBody], pairs: Separation, slides: Array
) -> Array:
    """Return how far a step of each joint moves a pair's bodies against each other, (p, n).

    No distance changes by more than ``reaches @ |steps|`` [m]: a point's derivative by a revolute
    joint is no longer than its distance from the joint, by a prismatic one it is 1. Joints that
    move both bodies do not count.

    Args:
        chain: of the arm.
        bodies: hulls.
        pairs: p pairs of them.
        slides: largest |q| of prismatic joints (n,) [m].
    """
    hulls = [body.hull for body in bodies]
    radius = [
        float(np.linalg.norm(hull.centre) + np.hypot(hull.half_length, hull.radius) + hull.ball)
        for hull in hulls
    ]
    reach = np.zeros((len(pairs.first), chain.n_joints))
    for row, pair in enumerate(zip(pairs.first.tolist(), pairs.second.tolist(), strict=True)):
        branches = [
            chain.ancestors(bodies[body].joint) if bodies[body].joint >= 0 else () for body in pair
        ]
        for body, branch, other in zip(pair, branches, reversed(branches), strict=True):
            arm = radius[body]
            for joint in reversed(branch):
                if joint in other:
                    break
                arm += 0.0 if chain.revolute[joint] else slides[joint]
                reach[row, joint] += arm if chain.revolute[joint] else 1.0
                arm += float(np.linalg.norm(chain.translation[joint]))
    return reach
