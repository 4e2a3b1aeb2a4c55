"""Where along a motion the arm comes too close to itself or to what stands around it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from identification.errors import ShapeError
from identification.excitation.errors import CollisionModelError
from identification.excitation.workspace import Workspace
from identification.kinematics import Chain, chain_from_urdf

Array = NDArray[np.float64]

# Shapes that are closer than the margin, and than this [m], in all of so many postures are built
# that way; a wider margin must not check less.
BUILT_IN = 0.05
_N_POSTURES = 200
_SEED = 20140901


@dataclass(frozen=True)
class Contact:
    """The arm closer to something than the margin.

    Attributes:
        first, second: the two links, or a link and an obstacle ("floor", "wall 0", "box 1").
        sample: index of the posture.
        distance: between them [m], negative where they overlap.
    """

    first: str
    second: str
    sample: int
    distance: float


class _Body(NamedTuple):
    """A convex shape that moves with a link, or an obstacle.

    Attributes:
        name: of the link or obstacle.
        joint: the joint that moves it, -1 for what stands still.
        shape: its geometry.
        rotation, translation: its pose in the frame of that joint, (3, 3) and (3,) [m].
        radius: of the sphere around its origin that holds it [m]; inf for a half-space.
    """

    name: str
    joint: int
    shape: coal.CollisionGeometry
    rotation: Array
    translation: Array
    radius: float


class _Path(NamedTuple):
    """Where one body is at m samples.

    Attributes:
        rotation, translation: its pose, (m, 3, 3) and (m, 3) [m].
        travel: bound on how far any of its points has moved since the first sample (m,) [m].
    """

    rotation: Array
    translation: Array
    travel: Array


class CollisionChecker:
    """Distances between the collision shapes of a URDF, the floor, walls and boxes.

    Links that share a joint are never checked against each other, nor is the base against what
    it stands among. Shapes two joints apart at most that are too close in every one of 200
    random postures, and closer than 5 cm, are taken to be built that way (a wrist, a sunken
    foot), and are left out too. Any pair farther apart along the arm is checked, even if it
    always touches.

    Args:
        urdf: text of the robot description; meshes are replaced by their convex hulls.
        workspace: obstacles and margin.
        mesh_folders: where `package://` paths of meshes begin.

    Raises:
        CollisionModelError: the description has no collision shapes, or a mesh is missing.
        ModelError: the description is no open chain.
    """

    def __init__(
        self, urdf: str, workspace: Workspace, *, mesh_folders: Sequence[str] = ()
    ) -> None:
        self.workspace = workspace
        self._chain = chain_from_urdf(urdf)
        model = pin.buildModelFromXML(urdf)
        links = _links(model, urdf, mesh_folders)
        obstacles = _obstacles(workspace)
        self._bodies = links + obstacles
        self._request = coal.DistanceRequest()
        self._result = coal.DistanceResult()
        self._pairs = [
            (a, b)
            for a, b in combinations(range(len(self._bodies)), 2)
            if a < len(links) and self._joints_between(a, b) > (0 if b >= len(links) else 1)
        ]
        postures = _random_postures(model)
        self._pairs = [pair for pair in self._pairs if not self._is_built_in(pair, postures)]

    @property
    def pairs(self) -> tuple[tuple[str, str], ...]:
        """Names of what is checked against what, without repetitions."""
        return tuple(
            dict.fromkeys((self._bodies[a].name, self._bodies[b].name) for a, b in self._pairs)
        )

    def first_contact(self, q: Array) -> Contact | None:
        """Return the first contact along postures (m, n), in time order; None if all are clear.

        Every posture is covered: distances are computed where two bodies are near, and not
        again before they can have moved by the distance that is left.
        """
        first: Contact | None = None
        paths = self._paths(q)
        for a, b in self._pairs:
            limit = len(q) if first is None else first.sample
            for sample, distance in self._contacts(a, b, paths, limit):
                first = Contact(self._bodies[a].name, self._bodies[b].name, sample, distance)
                break
        return first

    def clear(self, q: Array) -> NDArray[np.bool_]:
        """Return which of the unrelated postures (m, n) keep the margin, (m,)."""
        paths = self._paths(q)
        clear = np.ones(len(q), dtype=np.bool_)
        for a, b in self._pairs:
            near = self._lower_bound(a, b, paths) < self.workspace.margin
            for sample in np.flatnonzero(near & clear).tolist():
                clear[sample] = self._distance(a, b, paths, sample) >= self.workspace.margin
        return clear

    def _contacts(
        self, a: int, b: int, paths: list[_Path], limit: int
    ) -> Iterator[tuple[int, float]]:
        """Yield (sample, distance) of contacts before sample `limit`, in order."""
        margin = self.workspace.margin
        near = np.flatnonzero(self._lower_bound(a, b, paths)[:limit] < margin)
        travel = (paths[a].travel + paths[b].travel)[near]
        k = 0
        while k < len(near):
            distance = self._distance(a, b, paths, int(near[k]))
            if distance < margin:
                yield int(near[k]), distance
            clear_until = np.searchsorted(travel, travel[k] + max(distance - margin, 0.0))
            k = max(k + 1, int(clear_until))

    def _lower_bound(self, a: int, b: int, paths: list[_Path]) -> Array:
        """Return a lower bound of the distance at every sample, from enclosing spheres (m,)."""
        first, second = self._bodies[a], self._bodies[b]
        centre = paths[a].translation
        if isinstance(second.shape, coal.Halfspace):
            height: Array = centre @ second.shape.n - second.shape.d
            return height - first.radius
        apart: Array = np.linalg.norm(centre - paths[b].translation, axis=1)
        return apart - (first.radius + second.radius)

    def _distance(self, a: int, b: int, paths: list[_Path], sample: int) -> float:
        pose_a, pose_b = (
            coal.Transform3s(paths[i].rotation[sample], paths[i].translation[sample])
            for i in (a, b)
        )
        self._result.clear()
        return float(
            coal.distance(
                self._bodies[a].shape,
                pose_a,
                self._bodies[b].shape,
                pose_b,
                self._request,
                self._result,
            )
        )

    def _paths(self, q: Array) -> list[_Path]:
        if q.ndim != 2 or q.shape[1] != self._chain.n_joints:
            raise ShapeError("q", q.shape, f"(m, {self._chain.n_joints})")
        rotations, translations = joint_poses(self._chain, q)
        return [
            _path(body, rotations[body.joint + 1], translations[body.joint + 1])
            for body in self._bodies
        ]

    def _is_built_in(self, pair: tuple[int, int], postures: Array) -> bool:
        if self._joints_between(*pair) > 2:
            return False
        paths = self._paths(postures)
        near = min(self.workspace.margin, BUILT_IN)
        if np.any(self._lower_bound(*pair, paths) >= near):
            return False
        return all(self._distance(*pair, paths, k) < near for k in range(len(postures)))

    def _joints_between(self, a: int, b: int) -> int:
        """Count the joints between two bodies."""
        trunks = [
            set(self._chain.ancestors(joint)) if joint >= 0 else set()
            for joint in (self._bodies[a].joint, self._bodies[b].joint)
        ]
        return len(trunks[0] ^ trunks[1])


def joint_poses(chain: Chain, q: Array) -> tuple[Array, Array]:
    """Return the frames of base and joints at postures (m, n): (1 + n, m, 3, 3), (1 + n, m, 3).

    Rodrigues' formula joint by joint, vectorised over the postures; [m].
    """
    m, n = q.shape
    rotations = np.empty((1 + n, m, 3, 3))
    translations = np.zeros((1 + n, m, 3))
    rotations[0] = np.eye(3)
    for joint in range(n):
        before, origin = rotations[chain.parents[joint] + 1], translations[chain.parents[joint] + 1]
        axis, fixed = chain.axis[joint], chain.rotation[joint]
        placed = before @ fixed
        translations[joint + 1] = origin + before @ chain.translation[joint]
        if chain.revolute[joint]:
            angle = q[:, joint, None, None]
            across = np.cross(axis, np.eye(3)).T  # the matrix of axis x ...
            turn = np.eye(3) + np.sin(angle) * across + (1.0 - np.cos(angle)) * (across @ across)
            rotations[joint + 1] = placed @ turn
        else:
            rotations[joint + 1] = placed
            translations[joint + 1] += (placed @ axis) * q[:, joint, None]
    return rotations, translations


def _path(body: _Body, rotation: Array, translation: Array) -> _Path:
    turned = rotation @ body.rotation
    moved = translation + rotation @ body.translation
    travel = np.zeros(len(moved))
    if body.joint >= 0:
        # A point at distance r from the centre moves by at most |dc| + 2 sin(angle / 2) r, and
        # the change of the rotation matrix has the Frobenius norm 2 sqrt(2) sin(angle / 2).
        turning = np.linalg.norm(np.diff(turned, axis=0), axis=(1, 2)) / np.sqrt(2.0)
        steps = np.linalg.norm(np.diff(moved, axis=0), axis=1) + body.radius * turning
        np.cumsum(steps, out=travel[1:])
    return _Path(turned, moved, travel)


def _links(model: pin.Model, urdf: str, mesh_folders: Sequence[str]) -> list[_Body]:
    try:
        shapes = pin.buildGeomFromUrdfString(
            model, urdf, pin.GeometryType.COLLISION, None, list(mesh_folders)
        )
    except (ValueError, RuntimeError) as error:
        raise CollisionModelError(f"collision shapes cannot be loaded: {error}") from error
    bodies = []
    for item in shapes.geometryObjects:
        shape = item.geometry
        if isinstance(shape, coal.BVHModelBase):
            shape.buildConvexHull(True, "Qt")
            shape = shape.convex
        pose = item.placement
        bodies.append(
            _body(
                model.frames[item.parentFrame].name,
                item.parentJoint - 1,
                shape,
                pose.rotation,
                pose.translation,
            )
        )
    if not any(body.joint >= 0 for body in bodies):
        raise CollisionModelError("no moving link of the robot description has a collision shape")
    return bodies


def _obstacles(workspace: Workspace) -> list[_Body]:
    planes = [("floor", (0.0, 0.0, 1.0), workspace.floor)] if workspace.floor is not None else []
    planes += [(f"wall {i}", wall.normal, wall.offset) for i, wall in enumerate(workspace.walls)]
    bodies = []
    for name, normal, offset in planes:
        length = float(np.linalg.norm(normal))
        # coal fills the side opposite to the normal.
        shape = coal.Halfspace(np.array(normal) / length, offset / length)
        bodies.append(_Body(name, -1, shape, np.eye(3), np.zeros(3), np.inf))
    for i, box in enumerate(workspace.boxes):
        lower, upper = np.array(box.lower), np.array(box.upper)
        bodies.append(
            _body(f"box {i}", -1, coal.Box(*(upper - lower)), np.eye(3), (lower + upper) / 2.0)
        )
    return bodies


def _body(
    name: str, joint: int, shape: coal.CollisionGeometry, rotation: Array, translation: Array
) -> _Body:
    shape.computeLocalAABB()
    radius = float(shape.aabb_radius + np.linalg.norm(shape.aabb_center))
    return _Body(name, joint, shape, np.array(rotation), np.array(translation), radius)


def _random_postures(model: pin.Model) -> Array:
    """Return postures within the description's limits, half a turn where it has none (k, n)."""
    if model.nq != model.nv:  # a continuous joint counts as two numbers in pinocchio
        lower = np.full(model.nv, -np.pi)
        upper = np.full(model.nv, np.pi)
        for joint in range(1, model.njoints):
            if model.joints[joint].nq == 1:
                index, limit = model.joints[joint].idx_v, model.joints[joint].idx_q
                lower[index] = model.lowerPositionLimit[limit]
                upper[index] = model.upperPositionLimit[limit]
    else:
        lower, upper = model.lowerPositionLimit, model.upperPositionLimit
    lower, upper = np.maximum(lower, -np.pi), np.minimum(upper, np.pi)
    shares = np.random.default_rng(_SEED).random((_N_POSTURES, model.nv))
    postures: Array = lower + shares * (upper - lower)
    return postures
