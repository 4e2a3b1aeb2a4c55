"""How far apart bodies are at least, for many pairs and samples at once.

Two convex bodies are as far apart as the widest slab between them, and overlap as deeply as the
one with the least overlap. So any direction gives a lower bound of their signed distance,
``n · (c_a - c_b) - h_a(n) - h_b(n)`` with the support function h of each about its centre c; along
the shortest way between their axes it is seldom far from the truth.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from identification.excitation.collision.bodies import Body
from identification.excitation.collision.poses import Bodies

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

# Axes closer than this [m] cross: there is no way between them to speak of.
_CROSSING = 1e-9


class Separation:
    """Lower bounds of the signed distances of pairs of bodies.

    Attributes:
        first, second: (p,) the two bodies of each pair. Pairs with a moving second body come
            first, then those with a box, last those with a plane.
        exact: (p,) whether the bounds are the distances themselves.
        sharp: (p,) whether the hulls are the shapes themselves.

    Args:
        bodies: all of them.
        pairs: of their indices, an obstacle always second.
    """

    def __init__(self, bodies: Sequence[Body], pairs: Sequence[tuple[int, int]]) -> None:
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
        self._reach = np.hypot(self._half_length, self._radius) + self._ball
        self._half_sides = np.array(
            [np.zeros(3) if body.half_sides is None else body.half_sides for body in bodies]
        ).T
        exact = np.array([body.hull.exact for body in bodies])
        self.sharp: NDArray[np.bool_] = exact[self.first] & exact[self.second]
        self.exact: NDArray[np.bool_] = exact[self.first] & (np.arange(len(pairs)) >= self._planes)

    def coarse(self, at: Bodies, samples: Indices) -> Array:
        """Return a quick lower bound for every pair at some samples (g,), (p, g) [m]."""
        centre, axis = at.centre[:, :, samples], at.axis[:, :, samples]
        between = centre[:, self.first] - centre[:, self.second]
        bound = np.empty(between.shape[1:])
        apart = between[:, : self._planes]
        deep = np.zeros(apart.shape[1:])
        if self._planes > self._boxes:
            # from the nearest point of a box, or how deep inside; half sides of others are zero
            beyond = np.abs(apart) - self._half_sides[:, self.second[: self._planes], None]
            apart = np.maximum(beyond, 0.0)
            deep = np.minimum(beyond.max(axis=0), 0.0)
        reach = self._reach[self.first] + self._reach[self.second]
        bound[: self._planes] = _norm(apart) + deep - reach[: self._planes, None]
        normal = axis[:, self.second[self._planes :]]
        bodies = self.first[self._planes :]
        bound[self._planes :] = _dot(normal, between[:, self._planes :]) - self._support(
            bodies[:, None], _dot(normal, axis[:, bodies])
        )
        return bound

    def bound(self, at: Bodies, pair: Indices, sample: Indices) -> tuple[Array, Array]:
        """Return lower bounds (k,) [m] and their directions (3, k), from second to first body.

        Args:
            at: where the bodies are.
            pair: (k,), never falling.
            sample: (k,).
        """
        lower, normal = np.empty(len(pair)), np.empty((3, len(pair)))
        boxes, planes = np.searchsorted(pair, (self._boxes, self._planes)).tolist()
        for part, towards in (
            (slice(0, boxes), self._between_axes),
            (slice(boxes, planes), self._from_box),
        ):
            if part.stop > part.start:
                lower[part], normal[:, part] = towards(at, pair[part], sample[part])
        part = slice(planes, len(pair))
        normal[:, part] = _at(at.axis, self.second[pair[part]], sample[part])
        lower[part] = self.along(at, pair[part], sample[part], normal[:, part])
        return lower, normal

    def along(self, at: Bodies, pair: Indices, sample: Indices, normal: Array) -> Array:
        """Return the bounds (k,) [m] of pairs (k,) at samples (k,) in directions (3, k)."""
        a, b = self.first[pair], self.second[pair]
        between = _at(at.centre, a, sample) - _at(at.centre, b, sample)
        bound = _dot(normal, between)
        bound -= self._support(a, _dot(normal, _at(at.axis, a, sample)))
        bound -= self._support(b, _dot(normal, _at(at.axis, b, sample)))
        if self._planes > self._boxes:
            bound -= _dot(np.abs(normal), self._half_sides[:, b])
        return bound

    def _support(self, body: Indices, cosine: Array) -> Array:
        """Return h of hulls at directions that have this cosine with their axes."""
        across = np.sqrt(np.maximum(1.0 - cosine * cosine, 0.0))
        height: Array = self._half_length[body] * np.abs(cosine)
        height += self._radius[body] * across
        height += self._ball[body]
        return height

    def _between_axes(self, at: Bodies, pair: Indices, sample: Indices) -> tuple[Array, Array]:
        a, b = self.first[pair], self.second[pair]
        axis_a, axis_b = _at(at.axis, a, sample), _at(at.axis, b, sample)
        between = _at(at.centre, a, sample) - _at(at.centre, b, sample)
        way = _shortest_way(between, axis_a, self._half_length[a], axis_b, self._half_length[b])
        length = _norm(way)
        crossing = length < _CROSSING
        normal = way / np.where(crossing, 1.0, length)
        normal[:, crossing] = np.array([[0.0], [0.0], [1.0]])
        bound = _dot(normal, between)
        bound -= self._support(a, _dot(normal, axis_a))
        bound -= self._support(b, _dot(normal, axis_b))
        return bound, normal

    def _from_box(self, at: Bodies, pair: Indices, sample: Indices) -> tuple[Array, Array]:
        """Take the best of the six faces and of the way from the box to the body's middle."""
        a, b = self.first[pair], self.second[pair]
        between = _at(at.centre, a, sample) - _at(at.centre, b, sample)
        sides = self._half_sides[:, b]
        way = between - np.clip(between, -sides, sides)
        inside = ~np.any(way, axis=0)
        way[2, inside] = 1.0
        best = way / _norm(way)
        bound = self.along(at, pair, sample, best)
        for face in range(3):
            normal = np.zeros_like(between)
            normal[face] = np.where(between[face] < 0.0, -1.0, 1.0)
            other = self.along(at, pair, sample, normal)
            better = other > bound
            bound = np.where(better, other, bound)
            best = np.where(better, normal, best)
        return bound, best


def _shortest_way(between: Array, u: Array, half_u: Array, v: Array, half_v: Array) -> Array:
    """Return the shortest way (3, k) from segments along v to segments along u.

    Args:
        between: from the middle of the second to the middle of the first (3, k).
        u: unit vectors (3, k).
        half_u: half lengths along them (k,).
        v: unit vectors (3, k).
        half_v: half lengths along them (k,).
    """
    cosine, along_u, along_v = _dot(u, v), _dot(u, between), _dot(v, between)
    across = 1.0 - cosine * cosine
    with np.errstate(divide="ignore", invalid="ignore"):
        s = (cosine * along_v - along_u) / across
    s = np.where(across > 1e-12, s, 0.0)  # parallel ones are everywhere equally far apart
    s = np.clip(s, -half_u, half_u)
    t = np.clip(cosine * s + along_v, -half_v, half_v)
    s = np.clip(cosine * t - along_u, -half_u, half_u)
    way: Array = between + s * u
    way -= t * v
    return way


def _at(table: Array, body: Indices, sample: Indices) -> Array:
    """Return columns (3, k) of a table (3, b, m)."""
    columns: Array = table.reshape(3, -1).take(body * table.shape[2] + sample, axis=1)
    return columns


def _dot(a: Array, b: Array) -> Array:
    total: Array = a[0] * b[0]
    total += a[1] * b[1]
    total += a[2] * b[2]
    return total


def _norm(vectors: Array) -> Array:
    length: Array = np.sqrt(_dot(vectors, vectors))
    return length
