"""Collision bodies: shapes on the links of an arm, and the obstacles around it.

Each has a hull. Arrays of positions of hulls have samples as their last axis. Any direction n gives
a lower bound of the signed distance of two convex bodies, ``n · (c_a - c_b) - h_a(n) - h_b(n)``
with the support function h of each about its centre c.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import product
from typing import Final, NamedTuple

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from identification.excitation.errors import CollisionModelError, MissingMeshError, WorkspaceError
from identification.model.kinematics import FARTHEST, Chain, skew
from identification.model.urdf_text import urdf_tree

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Box:
    """A solid box with edges along the base axes, from corner `lower` to corner `upper` [m]."""

    lower: Vector
    upper: Vector

    def __post_init__(self) -> None:
        corners = np.array([self.lower, self.upper])
        if not np.all(np.isfinite(corners)) or not np.all(corners[0] < corners[1]):
            raise WorkspaceError(
                f"box from {self.lower} to {self.upper} m: every lower edge must be below the upper"
            )


@dataclass(frozen=True)
class Workspace:
    """Obstacles in the base frame of the URDF, and the clearance."""

    floor: float | None = 0.0  #: height of the floor [m]; None: no floor
    boxes: tuple[Box, ...] = ()  #: solid boxes
    margin: float = 0.05  #: least distance [m] between the arm and anything, itself included


def _unread_shapes(urdf: str, links: Iterable[str]) -> str | None:
    """Return a message if not all shapes of a link were read; `links` has the link of each."""
    read = Counter(links)
    for link in urdf_tree(urdf).findall("link"):
        name = link.get("name", "")
        written = sum(max(1, len(one.findall("geometry/*"))) for one in link.findall("collision"))
        if read[name] != written:
            return (
                f"of the {written} collision shapes of link {name!r} {read[name]} could be read; "
                "give each <collision> and <visual> element of the link one box, cylinder, sphere "
                "or mesh, with numbers separated by single spaces, a filename for a mesh, and a "
                "name for a material"
            )
    return None


_MISSING_MESH: Final = re.compile(r"Mesh (.+) could not be found")  # message of pinocchio


class Hull(NamedTuple):
    """Bounding volume of a shape: the Minkowski sum of a cylinder and a ball."""

    centre: Array  # of the cylinder, in the frame of the body's joint (3,) [m]
    axis: Array  # unit vector along it (3,)
    half_length: float  # of the cylinder [m]
    radius: float  # of the cylinder [m]
    ball: float  # radius of the ball [m]
    exact: bool  # whether it is the shape itself


@dataclass(frozen=True, eq=False)
class Body:
    """A convex shape that moves with a link, or an obstacle."""

    name: str  # of the link or obstacle
    shape_name: str  # of the shape; of an obstacle its name
    joint: int  # the joint that moves it, -1 for fixed bodies
    shape: coal.CollisionGeometry  # its geometry
    pose: coal.Transform3s  # in the frame of that joint
    hull: Hull  # its bounding volume
    normal: Array | None = None  # outward normal of a half-space (3,), else None
    half_sides: Array | None = None  # of a box along the base axes (3,) [m], else None


def described_shapes(model: pin.Model, urdf: str, mesh_folders: Sequence[str]) -> pin.GeometryModel:
    """Return the collision shapes of a robot description as pinocchio reads them.

    Raises:
        ValueError, RuntimeError: a mesh is missing, or a shape cannot be read.
    """
    # pinocchio 4.1 leaks a geometry model that it creates itself
    shapes = pin.GeometryModel()
    pin.buildGeomFromUrdfString(model, urdf, pin.GeometryType.COLLISION, shapes, list(mesh_folders))
    return shapes


def link_bodies(model: pin.Model, urdf: str, mesh_folders: Sequence[str]) -> list[Body]:
    """Return the collision bodies of a robot description by joint, meshes as convex hulls.

    Raises:
        MissingMeshError: a mesh is missing.
        CollisionModelError: a shape is unreadable or too far away, or no moving link has one.
    """
    try:
        shapes = described_shapes(model, urdf, mesh_folders)
    except (ValueError, RuntimeError) as error:
        missing = _MISSING_MESH.search(str(error))
        if missing:
            raise MissingMeshError(missing[1]) from error
        reason = " ".join(str(error).split())
        raise CollisionModelError(f"collision shapes cannot be loaded: {reason}") from error
    names = [model.frames[item.parentFrame].name for item in shapes.geometryObjects]
    if (unread := _unread_shapes(urdf, names)) is not None:
        raise CollisionModelError(unread)
    bodies = []
    for item, link in zip(shapes.geometryObjects, names, strict=True):
        rotation, translation = item.placement.rotation, item.placement.translation
        if not np.abs(translation).max() <= FARTHEST:
            raise CollisionModelError(
                f"collision shape {item.name!r} of the robot description is more than "
                f"{FARTHEST:g} m away from its parent"
            )
        shape, joint = _convex(item.geometry, link), item.parentJoint - 1
        pose, hull = coal.Transform3s(rotation, translation), _hull(shape, rotation, translation)
        bodies.append(Body(link, item.name, joint, shape, pose, hull))
    if not any(body.joint >= 0 for body in bodies):
        raise CollisionModelError("no moving link of the robot description has a collision shape")
    return sorted(bodies, key=lambda body: body.joint)


def _convex(shape: coal.CollisionGeometry, link: str) -> coal.CollisionGeometry:
    """Return the shape itself, or the convex hull of a mesh."""
    if isinstance(shape, coal.BVHModelBase):
        if np.all(np.abs(shape.vertices()) <= FARTHEST):
            with suppress(ValueError, RuntimeError):
                shape.buildConvexHull(True, "Qt")
                return shape.convex
        raise CollisionModelError(
            f"a collision mesh of link {link!r} has no volume, or vertices beyond {FARTHEST:g} m"
        )
    sides = [getattr(shape, name, 0.0) for name in ("halfSide", "radius", "halfLength")]
    if min(float(np.min(side)) for side in sides) < 0.0:
        raise CollisionModelError(f"a collision shape of link {link!r} has a negative size")
    if not max(float(np.max(side)) for side in sides) <= FARTHEST:
        raise CollisionModelError(
            f"a collision shape of link {link!r} is larger than {FARTHEST:g} m"
        )
    return shape


def obstacles(workspace: Workspace) -> list[Body]:
    """Return floor and boxes as bodies."""
    bodies = [] if workspace.floor is None else [floor_at(workspace.floor)]
    for i, box in enumerate(workspace.boxes):
        lower, upper = np.array(box.lower, dtype=float), np.array(box.upper, dtype=float)
        middle, half = (lower + upper) / 2.0, (upper - lower) / 2.0
        shape = coal.Box(*(upper - lower))
        # separations use the half sides
        hull = Hull(middle, np.array([0.0, 0.0, 1.0]), 0.0, 0.0, 0.0, exact=False)
        pose = coal.Transform3s(np.eye(3), middle)
        bodies.append(Body(f"box {i}", f"box {i}", -1, shape, pose, hull, half_sides=half))
    return bodies


def floor_at(height: float) -> Body:
    """Return a floor [m], solid below."""
    normal = np.array([0.0, 0.0, 1.0])
    hull = Hull(normal * height, normal, 0.0, 0.0, 0.0, exact=True)
    pose = coal.Transform3s(np.eye(3), np.zeros(3))
    return Body("floor", "floor", -1, coal.Halfspace(normal, height), pose, hull, normal=normal)


def _hull(shape: coal.CollisionGeometry, rotation: Array, translation: Array) -> Hull:
    centre, axis = np.zeros(3), np.array([0.0, 0.0, 1.0])
    half_length = radius = ball = 0.0
    exact = True
    if isinstance(shape, coal.Sphere):
        ball = shape.radius
    elif isinstance(shape, coal.Capsule):
        half_length, ball = shape.halfLength, shape.radius
    elif isinstance(shape, coal.Cylinder):
        half_length, radius = shape.halfLength, shape.radius
    else:
        centre, axis, half_length, radius = _around(_corners(shape))
        exact = False
    return Hull(translation + rotation @ centre, rotation @ axis, half_length, radius, ball, exact)


def _around(corners: Array) -> tuple[Array, Array, float, float]:
    """Return a cylinder around points (k, 3), along their longest extent."""
    lower, upper = corners.min(axis=0), corners.max(axis=0)
    centre, half = (lower + upper) / 2.0, (upper - lower) / 2.0
    longest = int(np.argmax(half))
    across = np.delete(corners - centre, longest, axis=1)
    radius = float(np.max(np.linalg.norm(across, axis=1)))
    return centre, np.eye(3)[longest], float(half[longest]), radius


def _corners(shape: coal.CollisionGeometry) -> Array:
    """Return points (k, 3) whose convex hull contains a shape, in its own frame."""
    if isinstance(shape, coal.ConvexBase):
        return np.asarray(shape.points(), dtype=np.float64).reshape(-1, 3)
    shape.computeLocalAABB()
    box = shape.aabb_local
    return np.array(list(product(*zip(box.min_, box.max_, strict=True))))


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


class Separation:
    """Lower bounds of the signed distances of pairs of bodies, an obstacle always second.

    Attributes:
        first, second: (p,) bodies of each pair: first pairs with a moving second body, then those
            with a box, then those with a plane.
        exact: (p,) whether the bounds are the distances themselves.
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
        self._half_sides = np.array(
            [np.zeros(3) if body.half_sides is None else body.half_sides for body in bodies]
        ).T
        exact = np.array([body.hull.exact for body in bodies])
        self.exact: NDArray[np.bool_] = exact[self.first] & (np.arange(len(pairs)) >= self._planes)

    def bound(self, at: Bodies, pair: Indices, sample: Indices) -> Array:
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

    def _along(self, at: Bodies, pair: Indices, sample: Indices, normal: Array) -> Array:
        """Return the bounds (k,) [m] of pairs (k,) at samples (k,) in directions (3, k)."""
        a, b = self.first[pair], self.second[pair]
        bound = _dot(normal, _at(at.centre, a, sample) - _at(at.centre, b, sample))
        bound -= self._support(a, _dot(normal, _at(at.axis, a, sample)))
        bound -= self._support(b, _dot(normal, _at(at.axis, b, sample)))
        if self._planes > self._boxes:
            bound -= _dot(np.abs(normal), self._half_sides[:, b])
        return bound

    def _above_plane(self, at: Bodies, pair: Indices, sample: Indices) -> Array:
        return self._along(at, pair, sample, _at(at.axis, self.second[pair], sample))

    def _support(self, body: Indices, cosine: Array) -> Array:
        """Return h of hulls in directions with this cosine to their axes."""
        across = np.sqrt(np.maximum(1.0 - cosine * cosine, 0.0))
        height: Array = self._half_length[body] * np.abs(cosine)
        height += self._radius[body] * across
        height += self._ball[body]
        return height

    def _between_axes(self, at: Bodies, pair: Indices, sample: Indices) -> Array:
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
        return bound

    def _from_box(self, at: Bodies, pair: Indices, sample: Indices) -> Array:
        """Use the best of three faces and of the direction from the box to the body's centre."""
        a, b = self.first[pair], self.second[pair]
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


def reaches(chain: Chain, bodies: Sequence[Body], pairs: Separation, slides: Array) -> Array:
    """Return how far a step of each joint moves a pair's bodies against each other, (p, n).

    No distance changes by more than ``reaches @ |steps|`` [m]: a point's derivative by a revolute
    joint is no longer than its distance from the joint, by a prismatic one it is 1. Joints that
    move both bodies do not count. `slides` (n,) is the largest |q| of prismatic joints [m].
    """
    hulls = [body.hull for body in bodies]
    radius = [
        float(np.linalg.norm(hull.centre) + np.hypot(hull.half_length, hull.radius) + hull.ball)
        for hull in hulls
    ]
    found = np.zeros((len(pairs.first), chain.n_joints))
    for row, pair in enumerate(zip(pairs.first.tolist(), pairs.second.tolist(), strict=True)):
        branches = [
            chain.ancestors(bodies[body].joint) if bodies[body].joint >= 0 else () for body in pair
        ]
        for body, own, other in zip(pair, branches, reversed(branches), strict=True):
            arm = radius[body]
            for joint in reversed(own):
                if joint in other:
                    break
                arm += 0.0 if chain.revolute[joint] else slides[joint]
                found[row, joint] += arm if chain.revolute[joint] else 1.0
                arm += float(np.linalg.norm(chain.translation[joint]))
    return found
