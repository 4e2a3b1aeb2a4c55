"""Collision checks along a motion, of shapes on the links of an arm with each other and obstacles.

Each body has a hull. Arrays of positions of hulls have samples as their last axis. Any direction n
gives a lower bound of the signed distance of two convex bodies, ``n · (c_a - c_b) - h_a(n) -
h_b(n)`` with the support function h of each about its centre c.

No distance of two bodies changes by more than the sum over the joints between them of reach times
step. Where the distances at two instants do not suffice, the interval between them is divided.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import combinations, product
from typing import Any, Final, NamedTuple

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from identification.errors import ShapeError
from identification.excitation.errors import CollisionModelError, MissingMeshError, WorkspaceError
from identification.model.kinematics import FARTHEST, Chain, chain_from_urdf, skew
from identification.model.urdf_text import urdf_tree
from planner import FourierSeries, JointLimits, PiecewiseCubic

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
        written = sum(
            max(1, len(collision.findall("geometry/*"))) for collision in link.findall("collision")
        )
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
        rotation = item.placement.rotation
        translation = item.placement.translation
        if not np.abs(translation).max() <= FARTHEST:
            raise CollisionModelError(
                f"collision shape {item.name!r} of the robot description is more than "
                f"{FARTHEST:g} m away from its parent"
            )
        shape = _convex(item.geometry, link)
        joint = item.parentJoint - 1
        pose = coal.Transform3s(rotation, translation)
        hull = _hull(shape, rotation, translation)
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
    bodies = []
    if workspace.floor is not None:
        normal = np.array([0.0, 0.0, 1.0])
        hull = Hull(normal * workspace.floor, normal, 0.0, 0.0, 0.0, exact=True)
        shape = coal.Halfspace(normal, workspace.floor)
        pose = coal.Transform3s.Identity()
        bodies.append(Body("floor", "floor", -1, shape, pose, hull, normal=normal))
    for i, box in enumerate(workspace.boxes):
        lower = np.array(box.lower, dtype=float)
        upper = np.array(box.upper, dtype=float)
        middle = (lower + upper) / 2.0
        half = (upper - lower) / 2.0
        shape = coal.Box(*(upper - lower))
        # separations use the half sides
        hull = Hull(middle, np.array([0.0, 0.0, 1.0]), 0.0, 0.0, 0.0, exact=False)
        pose = coal.Transform3s(np.eye(3), middle)
        bodies.append(Body(f"box {i}", f"box {i}", -1, shape, pose, hull, half_sides=half))
    return bodies


def _hull(shape: coal.CollisionGeometry, rotation: Array, translation: Array) -> Hull:
    centre = np.zeros(3)
    axis = np.array([0.0, 0.0, 1.0])
    half_length = radius = ball = 0.0
    exact = True
    if isinstance(shape, coal.Sphere):
        ball = shape.radius
    elif isinstance(shape, coal.Capsule):
        half_length = shape.halfLength
        ball = shape.radius
    elif isinstance(shape, coal.Cylinder):
        half_length = shape.halfLength
        radius = shape.radius
    else:
        centre, axis, half_length, radius = _around(_corners(shape))
        exact = False
    return Hull(translation + rotation @ centre, rotation @ axis, half_length, radius, ball, exact)


def _around(corners: Array) -> tuple[Array, Array, float, float]:
    """Return a cylinder around points (k, 3), along their longest extent."""
    lower = corners.min(axis=0)
    upper = corners.max(axis=0)
    centre = (lower + upper) / 2.0
    half = (upper - lower) / 2.0
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
        part = slice(rows[0], rows[-1] + 1)
        rotation = at.rotation[joint + 1]
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
        a = self.first[pair]
        b = self.second[pair]
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
        a = self.first[pair]
        b = self.second[pair]
        axis_a = _at(at.axis, a, sample)
        axis_b = _at(at.axis, b, sample)
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


# Another contact may be deeper by this: in given postures, and along a motion [m].
_DEPTH: Final = 0.005
_DEPTH_ALONG: Final = 0.02
_STEP: Final = 0.08  # of the first instants of a motion [s]
_SAMPLE_STEP: Final = 0.008  # of the last ones, if only instants are checked
_DIVISIONS: Final = 16  # of an interval; one that is still open counts as a contact
# Most open intervals, and distances that are computed; with more, the motion counts as a contact.
_MOST_OPEN: Final = 20_000
_MOST_DISTANCES: Final = 30_000
# Pairs closer than this [m] (and than the margin) in all sampled postures are not checked; a wider
# margin does not exclude more.
_NEAR: Final = 0.05
# Largest variation [m] of the distance of a rotating foot from its obstacle.
_CONSTANT: Final = 0.002
# A pair that never or hardly has the margin must have the largest sampled distance less this [m],
# or less half the margin if that is smaller.
_SLACK: Final = 0.005
_N_POSTURES = 200
_SEED = 20140901
_NO_RANGE = 1e-6  # ranges below this [rad, m] are not limits


class Contact(NamedTuple):
    """A part of the arm closer to another body than the margin."""

    first: str  #: link
    second: str  #: link or obstacle ("floor", "wall 0", "box 1")
    sample: int | None  #: index of the posture, if postures were given
    time: float | None  #: [s], of a motion
    posture: tuple[float, ...]  #: joint positions there [rad]
    distance: float  #: [m], negative if they overlap
    required: float  #: least distance of the two [m]


class ClosePair(NamedTuple):
    """Two shapes that never, or hardly, have the margin in the sampled postures.

    Shapes of links have pinocchio's names, the link's with a number.
    """

    first: str
    second: str
    nearest: float  # distance in the sampled postures [m], negative if they overlap
    farthest: float

    def __str__(self) -> str:
        return f"{self.first} and {self.second} ({self.nearest:.3f} to {self.farthest:.3f} m)"


class Path(NamedTuple):
    """Positions of all bodies at m samples."""

    frames: Frames  # of base and links
    bodies: Bodies  # hulls


class CollisionChecker:
    """Distances between the collision shapes of a URDF, the floor, walls and boxes.

    Links that share a joint are not checked against each other, nor is the base against obstacles.
    Not checked either, if closer than the margin and 5 cm in each of 200 random postures: two
    shapes of the arm at most two joints apart (a wrist), and a shape of the first link at a
    constant distance from an obstacle (a rotating foot in the floor). Two shapes at most two joints
    apart whose largest distance there is about the margin, or less and not excluded as above, but
    not a touch, are checked with that distance less 5 mm. `exceptions` reports all of these.

    Meshes of the robot description, in `mesh_folders` of `package://` paths, are replaced by their
    convex hulls. Random postures are within limits, if given, else ± half a turn.

    Attributes:
        separation: distance bounds of the p pairs.
        required: least distance of each pair (p,) [m].
        unchecked, reduced: pairs that are not checked, or with less than the margin.
        arm_length: length along the arm from the base to its last joint [m]; 1 if it is zero.

    Raises:
        CollisionModelError: the description has no collision shapes, or a mesh is missing.
        ModelError: the description is not an open chain.
    """

    def __init__(
        self,
        urdf: str,
        workspace: Workspace,
        limits: JointLimits | None = None,
        mesh_folders: Sequence[str] = (),
    ) -> None:
        self._arguments = urdf, workspace, limits, tuple(mesh_folders)
        self.workspace = workspace
        self.margin = workspace.margin
        self._chain = chain = chain_from_urdf(urdf)
        links = link_bodies(pin.buildModelFromXML(urdf), urdf, mesh_folders)
        self._bodies = [*links, *obstacles(workspace)]
        self._request = coal.DistanceRequest()
        self._result = coal.DistanceResult()
        if limits is not None and limits.n_joints != chain.n_joints:
            raise ShapeError("limits", (limits.n_joints,), f"({chain.n_joints},)")
        self._n_links = len(links)
        pairs = [
            (a, b)
            for a, b in combinations(range(len(self._bodies)), 2)
            if a < len(links) and self._joints_apart(a, b) > (0 if b >= len(links) else 1)
        ]
        self.separation = Separation(self._bodies, pairs)
        self._postures = random_postures(chain.n_joints, limits)
        self._tried = self.path(self._postures)
        self.required, self.unchecked, self.reduced = self._find_close_pairs()
        still = np.zeros(chain.n_joints)
        self._turning_reaches = reaches(chain, self._bodies, self.separation, still)
        self.arm_length = _length(chain)

    def __reduce__(self) -> tuple[object, ...]:
        return type(self), self._arguments

    @property
    def pairs(self) -> tuple[tuple[str, str], ...]:
        """Names of the checked pairs of bodies, without repetitions."""
        return tuple(dict.fromkeys(map(self.names, range(len(self.separation.first)))))

    @property
    def exceptions(self) -> str | None:
        """Message about pairs checked not at all or with less than the margin, None if none."""
        messages = {
            "not checked for collisions, always closer than the margin": self.unchecked,
            "checked with less than the margin, which they never or hardly have": self.reduced,
        }
        parts = [
            f"{text}: {'; '.join(map(str, pairs))}" for text, pairs in messages.items() if pairs
        ]
        return "; ".join(parts) or None

    def path(self, q: Array) -> Path:
        """Return the positions of all bodies at postures (m, n).

        Raises:
            ShapeError: postures of another arm.
            ValueError: a joint position is not finite.
        """
        if q.ndim != 2 or q.shape[1] != self._chain.n_joints:
            raise ShapeError("q", q.shape, f"(m, {self._chain.n_joints})")
        if not np.all(np.isfinite(q)):
            raise ValueError("positions of joints must be finite")
        at = frames(self._chain, q)
        return Path(at, placed(self._bodies, at))

    def reaches(self, largest: Array) -> Array:
        """Return `bodies.reaches` of the pairs (p, n) for postures up to `largest` |q| (n,)."""
        if np.all(self._chain.revolute):
            return self._turning_reaches
        return reaches(self._chain, self._bodies, self.separation, largest)

    def distance(self, pair: int, path: Path, sample: int) -> float:
        """Return the signed distance of a pair at a sample [m], -inf if it cannot be determined."""
        placed_shapes: list[object] = []
        for body in (self._bodies[i] for i in self.indices(pair)):
            pose = body.pose
            if body.joint >= 0:
                rotation = path.frames.rotation[body.joint + 1, :, :, sample]
                translation = path.frames.translation[body.joint + 1, :, sample]
                pose = coal.Transform3s(rotation, translation) * pose
            placed_shapes += [body.shape, pose]
        self._result.clear()
        distance = float(coal.distance(*placed_shapes, self._request, self._result))
        return -np.inf if np.isnan(distance) else distance

    def indices(self, pair: int) -> tuple[int, int]:
        """Return the two bodies of a pair."""
        return int(self.separation.first[pair]), int(self.separation.second[pair])

    def names(self, pair: int) -> tuple[str, str]:
        """Return the names of the two bodies of a pair."""
        a, b = self.indices(pair)
        return self._bodies[a].name, self._bodies[b].name

    def _find_close_pairs(self) -> tuple[Array, tuple[ClosePair, ...], tuple[ClosePair, ...]]:
        """Remove pairs that are always too close; return the least distances of the others."""
        # Removed: two links at most two joints apart that are too close in all postures, and an
        # obstacle and a shape of the first link at a constant distance below the margin.
        near = min(self.margin, _NEAR)
        samples = np.arange(_N_POSTURES)
        slack = min(_SLACK, near / 2.0)
        checked: list[tuple[int, int]] = []
        required: list[float] = []
        unchecked = list[ClosePair]()
        reduced = list[ClosePair]()
        for pair in range(len(self.separation.first)):
            a, b = self.indices(pair)
            joints = self._joints_apart(a, b)
            least = -np.inf
            most = np.inf
            if joints <= 2:
                repeated = np.full(_N_POSTURES, pair)
                bound = self.separation.bound(self._tried.bodies, repeated, samples)
                if np.all(bound < near + slack):
                    distances = self._distances(pair)
                    least = float(distances.min())
                    most = float(distances.max())
            close = ClosePair(self._bodies[a].shape_name, self._bodies[b].shape_name, least, most)
            fixed = joints <= 1 and most - least <= _CONSTANT if b >= self._n_links else True
            if most < near and fixed:
                unchecked.append(close)
                continue
            close_to_margin = slack < most < near + slack
            reduced += [close] if close_to_margin else []
            required.append(most - slack if close_to_margin else self.margin)
            checked.append((a, b))
        self.separation = Separation(self._bodies, checked)
        return np.array(required), tuple(unchecked), tuple(reduced)

    def spread(self, first: str, second: str) -> tuple[float, float]:
        """Return the least and largest distance [m] of one of `pairs` in random postures.

        Raises:
            ValueError: it is not one of `pairs`.
        """
        pairs = [k for k in range(len(self.separation.first)) if self.names(k) == (first, second)]
        distances = np.min([self._distances(pair) for pair in pairs], axis=0)
        return float(distances.min()), float(distances.max())

    def _joints_apart(self, a: int, b: int) -> int:
        """Count the joints between two bodies."""
        trunks = [
            set(self._chain.ancestors(joint)) if joint >= 0 else set()
            for joint in (self._bodies[a].joint, self._bodies[b].joint)
        ]
        return len(trunks[0] ^ trunks[1])

    def _distances(self, pair: int) -> Array:
        """Return the distances of a pair in the sampled postures (k,) [m]."""
        return np.array([self.distance(pair, self._tried, k) for k in range(_N_POSTURES)])

    def deepest_contact(self, q: Array) -> Contact | None:
        """Return the deepest contact in postures (m, n), None if all are clear.

        Another contact may be deeper by up to 5 mm.
        """
        nearest = _Nearest(self, _DEPTH)
        pair, sample = np.indices((len(self.separation.first), len(q))).reshape(2, -1)
        nearest.visit(q, np.arange(len(q), dtype=np.float64), pair, sample)
        if nearest.contact is None:
            return None
        return nearest.contact._replace(sample=int(nearest.contact.time or 0), time=None)

    def deepest_along(
        self, trajectory: PiecewiseCubic | FourierSeries, *, between: bool = True
    ) -> Contact | None:
        """Return the deepest contact along a trajectory, None if it is clear.

        It is checked at every instant, or, if not `between`, at instants up to 8 ms apart. An
        interval that division does not resolve counts as a contact. Another contact may be deeper
        by up to 2 cm.
        """
        nearest = _Nearest(self, _DEPTH_ALONG)
        time = np.linspace(0.0, trajectory.duration, 1 + _steps(trajectory.duration, _STEP))
        q = trajectory.sample(time)[0]
        beyond = acceleration_bound(trajectory, time[:1], time[-1:])[:, 0] * _STEP**2 / 8.0
        reach = self.reaches(np.abs(q).max(axis=0) + beyond)
        pair, node = np.indices((len(reach), len(time))).reshape(2, -1)
        distances = nearest.visit(q, time, pair, node).reshape(-1, len(time))
        ends = time[:-1], time[1:], q[:-1], q[1:]
        change = reach @ _passed(trajectory, *ends, between=between)
        least = (distances[:, :-1] + distances[:, 1:] - change) / 2.0
        pair, node = np.nonzero(~(least >= nearest.limit))
        start, stop, q0, q1 = (end[node] for end in ends)
        gaps = _Gaps(pair, start, stop, q0, q1, distances[pair, node], distances[pair, node + 1])
        for _ in range(_DIVISIONS):
            if not between:
                gaps = gaps.take(gaps.stop - gaps.start > _SAMPLE_STEP)
            many = len(gaps.pair) > _MOST_OPEN or nearest.distances > _MOST_DISTANCES
            if many or len(gaps.pair) == 0:
                break
            time, node = np.unique((gaps.start + gaps.stop) / 2.0, return_inverse=True)
            q = trajectory.sample(time)[0]
            gaps = gaps.divided(time[node], q[node], nearest.visit(q, time, gaps.pair, node))
            passed = _passed(trajectory, *gaps[1:5], between=between)
            change = np.einsum("kn,nk->k", reach[gaps.pair], passed)
            gaps = gaps.take(~((gaps.before + gaps.after - change) / 2.0 >= nearest.limit))
        if nearest.contact is None and len(gaps.pair) > 0:
            nearest.touch(
                int(gaps.pair[0]),
                float(np.nextafter(self.required[gaps.pair[0]], -1.0)),
                gaps.start[0],
                gaps.q0[0],
            )
        return nearest.contact

    def clear(self, q: Array, paths: Indices | None = None) -> NDArray[np.bool_]:
        """Return which of the postures (m, n) are clear, (m,).

        With `paths` (m,), the number of a path from 0 on for each posture, it is which of the paths
        are: the first contact of one decides, the other postures are not looked at.
        """
        paths = np.arange(len(q)) if paths is None else paths
        path = self.path(q)
        pairs, samples = np.indices((len(self.separation.first), len(q))).reshape(2, -1)
        lower = self.separation.bound(path.bodies, pairs, samples)
        blocked = np.zeros(paths.max(initial=-1) + 1, dtype=np.bool_)
        near = np.flatnonzero(~(lower >= self.required[pairs]))
        for k in near[np.argsort(lower[near], kind="stable")].tolist():
            pair = int(pairs[k])
            sample = int(samples[k])
            if not blocked[paths[sample]]:
                contact = not self.distance(pair, path, sample) >= self.required[pair]
                blocked[paths[sample]] = contact
        return np.asarray(~blocked)


class _Gaps(NamedTuple):
    """Pairs (k,) between two instants (k,) [s], with positions (k, n) and distances (k,) there."""

    pair: Indices
    start: Array
    stop: Array
    q0: Array
    q1: Array
    before: Array
    after: Array

    def take(self, rows: NDArray[np.bool_] | Indices) -> _Gaps:
        """Return gaps by index or mask."""
        columns: list[Any] = [column[rows] for column in self]
        return _Gaps(*columns)

    def divided(self, time: Array, q: Array, distance: Array) -> _Gaps:
        """Return both halves of each gap, by rising pair, divided at instants (k,)."""
        first = self._replace(stop=time, q1=q, after=distance)
        second = self._replace(start=time, q0=q, before=distance)
        order = np.argsort(np.concatenate((self.pair, self.pair)), kind="stable")
        columns: list[Any] = [
            np.concatenate(halves)[order] for halves in zip(first, second, strict=True)
        ]
        return _Gaps(*columns)


class _Nearest:
    """The deepest contact at the visited postures.

    Contacts deeper by less than `resolution` [m] are not looked for; `distances` counts those
    computed.
    """

    def __init__(self, checker: CollisionChecker, resolution: float) -> None:
        self._checker = checker
        self._resolution = resolution
        self.contact: Contact | None = None
        self._deepest = 0.0  # its distance beyond the required one [m]
        self.distances = 0

    @property
    def limit(self) -> float:
        """Distance beyond the required one [m] below which a contact would be the deepest."""
        if self.contact is None:
            return 0.0
        return self._deepest - self._resolution

    def visit(self, q: Array, time: Array, pair: Indices, sample: Indices) -> Array:
        """Return bounds of the distances beyond the required ones, at samples (k,) of q.

        Pairs (k,) are in rising order.
        """
        checker = self._checker
        path = checker.path(q)
        required = checker.required[pair]
        lower = checker.separation.bound(path.bodies, pair, sample) - required
        near = np.flatnonzero(~(lower >= self.limit))
        exact = checker.separation.exact[pair]
        for k in near[np.argsort(lower[near], kind="stable")].tolist():
            if lower[k] >= self.limit:
                break
            if not exact[k]:
                lower[k] = checker.distance(int(pair[k]), path, int(sample[k])) - required[k]
                self.distances += 1
            if lower[k] < self._deepest:
                distance = float(lower[k] + required[k])
                self.touch(int(pair[k]), distance, time[sample[k]], q[sample[k]])
        return lower

    def touch(self, pair: int, distance: float, time: float, posture: Array) -> None:
        """Set the deepest contact."""
        first, second = self._checker.names(pair)
        required = float(self._checker.required[pair])
        at = float(time), tuple(posture.tolist())
        self.contact = Contact(first, second, None, *at, distance, required)
        self._deepest = distance - required


def _steps(duration: float, step: float) -> int:
    return max(1, int(np.ceil(duration / step)))


def _passed(
    trajectory: PiecewiseCubic | FourierSeries,
    start: Array,
    stop: Array,
    q0: Array,
    q1: Array,
    *,
    between: bool,
) -> Array:
    """Bound the way of each joint from instants `start` to `stop` (k,), q0 to q1 (k, n): (n, k).

    With |qdd| up to A it is at most |q1 - q0| + A h²/4 in a time h; without `between` only the
    first term is returned.
    """
    change = np.abs(q1 - q0).T
    if not between:
        return change
    step = stop - start
    return np.asarray(change + acceleration_bound(trajectory, start, stop) * (step * step / 4.0))


def random_postures(n: int, limits: JointLimits | None) -> Array:
    """Return postures (k, n) within limits, or ± half a turn."""
    lower, upper = np.full((2, n), [[-np.pi], [np.pi]])
    if limits is not None:
        range_ = limits.upper - limits.lower
        limited = (range_ > _NO_RANGE) & (range_ < 2.0 * np.pi)
        lower, upper = np.where(limited, (limits.lower, limits.upper), (lower, upper))
    shares = np.random.default_rng(_SEED).random((_N_POSTURES, n))
    postures: Array = lower + shares * (upper - lower)
    return postures


def _length(chain: Chain) -> float:
    reach = np.zeros(1 + chain.n_joints)
    for joint, parent in enumerate(chain.parents):
        reach[joint + 1] = reach[parent + 1] + np.linalg.norm(chain.translation[joint])
    return float(reach.max()) or 1.0


def acceleration_bound(
    trajectory: PiecewiseCubic | FourierSeries, start: Array, stop: Array
) -> Array:
    """Return an upper bound of |qdd| in parts of a motion from `start` to `stop` [s], (n, g)."""
    if isinstance(trajectory, FourierSeries):
        ramp = trajectory.ramp
        length = trajectory.length
        between_ramps = (start >= ramp) & (stop <= length - ramp)
        without = trajectory.derivative_bound(2, ramps=False)[:, None]
        return np.where(between_ramps, without, trajectory.derivative_bound(2)[:, None])
    largest = trajectory.extrema().acceleration
    return np.broadcast_to(largest[:, None], (len(largest), len(start)))
