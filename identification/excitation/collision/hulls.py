"""Positions, separations and curvature bounds of hulls at many samples.

Samples are the last axis of every array. Any direction n gives a lower bound of the signed distance
of two convex bodies, ``n · (c_a - c_b) - h_a(n) - h_b(n)`` with the support function h of each
about its centre c. A path with second derivative at most A deviates by at most A h²/8 from the
straight line between two of its points h apart in time.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.excitation.collision.bodies import Body
from identification.model.kinematics import Chain, skew

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

_CROSSING = 1e-9  # axes closer than this [m] intersect


class Frames(NamedTuple):
    """Base and joint frames at m samples: axes (1 + n, 3, 3, m), origins (1 + n, 3, m) [m]."""

    rotation: Array
    translation: Array


class Bodies(NamedTuple):
    """Hulls of b bodies at m samples."""

    centre: Array  # (3, b, m) [m]
    axis: Array  # unit vectors (3, b, m)


def frames(chain: Chain, q: Array) -> Frames:
    """Return base and joint frames at postures (m, n); Rodrigues' formula joint by joint."""
    m, n = q.shape
    rotation = np.empty((1 + n, 3, 3, m))
    translation = np.zeros((1 + n, 3, m))
    rotation[0] = np.eye(3)[:, :, None]
    sine, versine = np.sin(q.T), 1.0 - np.cos(q.T)
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


def joint_poses(chain: Chain, q: Array) -> tuple[Array, Array]:
    """Return base and joint frames at postures (m, n): (1 + n, m, 3, 3), (1 + n, m, 3) [m]."""
    rotation, translation = frames(chain, q)
    return rotation.transpose(0, 3, 1, 2), translation.transpose(0, 2, 1)


def placed(bodies: Sequence[Body], at: Frames) -> Bodies:
    """Return the positions of the hulls of bodies, which are sorted by joint."""
    centre, axis = np.empty((2, 3, len(bodies), at.translation.shape[2]))
    joints = np.array([body.joint for body in bodies])
    for joint in dict.fromkeys(joints.tolist()):
        rows = np.flatnonzero(joints == joint)
        hulls = [bodies[row].hull for row in rows.tolist()]
        centres = np.array([hull.centre for hull in hulls])
        axes = np.array([hull.axis for hull in hulls])
        if joint < 0:
            centre[:, rows], axis[:, rows] = centres.T[:, :, None], axes.T[:, :, None]
            continue
        part, rotation = slice(rows[0], rows[-1] + 1), at.rotation[joint + 1]
        np.matmul(centres, rotation, out=centre[:, part])
        centre[:, part] += at.translation[joint + 1][:, None]
        np.matmul(axes, rotation, out=axis[:, part])
    return Bodies(centre, axis)


def travel(bodies: Sequence[Body], at: Bodies, turning: Array) -> Array:
    """Bound the path length of any point of each body since the first sample, (b, m) [m].

    From sample to sample in straight lines, with `turning` of base and links (1 + n, m - 1) [rad].
    """
    half = np.array([body.hull.half_length for body in bodies])
    around = np.array([body.hull.radius + body.hull.ball for body in bodies])
    joints = np.array([body.joint + 1 for body in bodies])
    steps = _norm(np.diff(at.centre))
    steps += half[:, None] * _norm(np.diff(at.axis))
    steps += around[:, None] * turning[joints]
    total = np.zeros(at.centre.shape[1:])
    np.cumsum(steps, axis=1, out=total[:, 1:])
    return total


def turning(chain: Chain, q: Array) -> Array:
    """Bound the rotation of base and links between postures (m, n), (1 + n, m - 1) [rad]."""
    turned = np.abs(np.diff(q, axis=0)).T * chain.revolute[:, None]
    total = np.zeros((1 + chain.n_joints, len(q) - 1))
    for joint in range(chain.n_joints):
        total[joint + 1] = total[chain.parents[joint] + 1] + turned[joint]
    return total


class Separation:
    """Lower bounds of the signed distances of pairs of bodies, an obstacle always second.

    Attributes:
        first, second: (p,) bodies of each pair: first pairs with a moving second body, then those
            with a box, then those with a plane.
        exact: (p,) whether the bounds are the distances themselves.
        sharp: (p,) whether the hulls are the shapes themselves.
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
        """Return a coarse lower bound for every pair at samples (g,), (p, g) [m]."""
        centre, axis = at.centre[:, :, samples], at.axis[:, :, samples]
        between = centre[:, self.first] - centre[:, self.second]
        bound = np.empty(between.shape[1:])
        apart = between[:, : self._planes]
        deep = np.zeros(apart.shape[1:])
        if self._planes > self._boxes:
            # from the nearest point of a box, or the depth inside; other half sides are zero
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
        """Return lower bounds (k,) [m] and directions (3, k) of pairs (k,) in rising order."""
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
        """Return h of hulls in directions with this cosine to their axes."""
        across = np.sqrt(np.maximum(1.0 - cosine * cosine, 0.0))
        height: Array = self._half_length[body] * np.abs(cosine)
        height += self._radius[body] * across
        height += self._ball[body]
        return height

    def _between_axes(self, at: Bodies, pair: Indices, sample: Indices) -> tuple[Array, Array]:
        a, b = self.first[pair], self.second[pair]
        axis_a, axis_b = _at(at.axis, a, sample), _at(at.axis, b, sample)
        between = _at(at.centre, a, sample) - _at(at.centre, b, sample)
        shortest = _between_segments(
            between, axis_a, self._half_length[a], axis_b, self._half_length[b]
        )
        length = _norm(shortest)
        crossing = length < _CROSSING
        normal = shortest / np.where(crossing, 1.0, length)
        normal[:, crossing] = np.array([[0.0], [0.0], [1.0]])
        bound = _dot(normal, between)
        bound -= self._support(a, _dot(normal, axis_a))
        bound -= self._support(b, _dot(normal, axis_b))
        return bound, normal

    def _from_box(self, at: Bodies, pair: Indices, sample: Indices) -> tuple[Array, Array]:
        """Use the best of the six faces and of the direction from the box to the body's centre."""
        a, b = self.first[pair], self.second[pair]
        between = _at(at.centre, a, sample) - _at(at.centre, b, sample)
        sides = self._half_sides[:, b]
        outward = between - np.clip(between, -sides, sides)
        inside = ~np.any(outward, axis=0)
        outward[2, inside] = 1.0
        best = outward / _norm(outward)
        bound = self.along(at, pair, sample, best)
        for face in range(3):
            normal = np.zeros_like(between)
            normal[face] = np.where(between[face] < 0.0, -1.0, 1.0)
            other = self.along(at, pair, sample, normal)
            better = other > bound
            bound = np.where(better, other, bound)
            best = np.where(better, normal, best)
        return bound, best


def _between_segments(between: Array, u: Array, half_u: Array, v: Array, half_v: Array) -> Array:
    """Return the shortest vectors (3, k) from segments along v to segments along u."""
    cosine, along_u, along_v = _dot(u, v), _dot(u, between), _dot(v, between)
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


class Curvature:
    """Bounds of the accelerations of pairs of bodies, seen from a frame of each pair.

    A point's derivative by joint k is z_k x r_k (r_k from the joint to the point), or z_k for a
    prismatic joint; its derivative by k or by a revolute joint before it is no longer. So the
    longest r_k and the joint rates bound its acceleration in all postures. `first` and `second`
    are the bodies of the pairs (p,), `frame` a joint that moves both, -1: the base.
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
        hulls = [body.hull for body in bodies]
        reach = [np.hypot(hull.half_length, hull.radius) + hull.ball for hull in hulls]
        radius = np.array([np.linalg.norm(hull.centre) for hull in hulls]) + reach
        joints = [
            (bodies[a].joint, bodies[b].joint, int(seen_from))
            for a, b, seen_from in zip(first, second, frame, strict=True)
        ]
        # pairs of shapes on the same two links share the largest radius
        links = sorted(set(joints))
        self._class: Indices = np.array([links.index(pair) for pair in joints], dtype=np.intp)
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
        """Bound the deviation of both bodies from straight lines between samples, (p, g) [m].

        `velocity` and `acceleration` (n, g) are the largest |qd| and |qdd| in each part of a
        motion, q its samples (m, n), `step` their period [s].
        """
        arms = self._fixed_arms
        if not np.all(self._chain.revolute):
            deviation = acceleration.max(axis=1) * step**2 / 8.0
            arms = self._arms(np.abs(q).max(axis=0) + deviation)
        revolute = np.where(self._chain.revolute[:, None], velocity, 0.0)
        turned = velocity * (revolute + 2.0 * (self._before @ velocity)) + acceleration
        bulges: Array = (arms[:, None] @ turned)[:, 0] * (step**2 / 8.0)
        return bulges[self._class]

    def _arms(self, slides: Array) -> Array:
        """Return the largest distance of points from each joint, sum of both bodies (c, n)."""
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


def common_joint(chain: Chain, a: int, b: int) -> int:
    """Return the last joint that moves both links a and b, -1 for the base."""
    if a < 0 or b < 0:
        return -1
    common = set(chain.ancestors(a)) & set(chain.ancestors(b))
    return max(common, default=-1)  # a parent has a lower number than its children


def _before(chain: Chain, frame: int) -> Array:
    """Return which revolute joints after a frame are ancestors of each joint, (n, n)."""
    before = np.zeros((chain.n_joints, chain.n_joints))
    inside = chain.ancestors(frame) if frame >= 0 else ()
    for k in range(chain.n_joints):
        for j in chain.ancestors(k)[:-1]:
            if j not in inside and chain.revolute[j]:
                before[k, j] = 1.0
    return before
