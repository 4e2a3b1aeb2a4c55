"""An arm among obstacles: its bodies, the pairs that may touch, and where they are."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from identification.errors import ShapeError
from identification.excitation.collision.bodies import Workspace, link_bodies, obstacles, withdrawn
from identification.excitation.collision.built_in import (
    SLACK,
    BuiltIn,
    always_close,
    never_clear,
    random_postures,
)
from identification.excitation.collision.curvature import Curvature, carrier
from identification.excitation.collision.poses import (
    Bodies,
    Frames,
    frames,
    placed,
    travel,
    turning,
)
from identification.excitation.collision.separation import Indices, Separation
from identification.excitation.errors import PostureError
from identification.model.kinematics import Chain, chain_from_urdf
from planner import JointLimits

Array = NDArray[np.float64]


class Path(NamedTuple):
    """Where everything is at m samples.

    Attributes:
        q: the postures (m, n).
        frames: of base and links.
        bodies: their hulls.
        gone: (b, m) how far each body has gone until there at most, in straight lines [m].
    """

    q: Array
    frames: Frames
    bodies: Bodies
    gone: Array


class Scene:
    """The bodies of an arm and of its workspace, in pairs that are to be clear of each other.

    Attributes:
        margin: least distance [m] of each pair.
        arm_length: way along the arm from the base to its last joint [m]; 1 where there is none.
        separation: of the p pairs.
        carrier: (p,) the last joint that moves both bodies of a pair, -1 for the base.
        from_base, from_carrier: how far pairs leave straight lines, seen from there.
        built_in: shapes that are no pair, because they are always too close.
        narrowed: links and planes that keep less than the margin, because they never can.

    Args:
        urdf: of the arm.
        workspace: obstacles and margin.
        mesh_folders: where `package://` paths begin.
        limits: in use; None for those of the description.

    Raises:
        CollisionModelError: the description has no collision shapes, or a mesh is missing.
        ModelError: the description is no open chain.
    """

    def __init__(
        self,
        urdf: str,
        workspace: Workspace,
        mesh_folders: Sequence[str],
        limits: JointLimits | None = None,
    ) -> None:
        self.margin = workspace.margin
        self._chain = chain_from_urdf(urdf)
        model = pin.buildModelFromXML(urdf)
        links = link_bodies(model, urdf, mesh_folders)
        self._bodies = [*links, *obstacles(workspace)]
        self._request = coal.DistanceRequest()
        self._result = coal.DistanceResult()
        if limits is not None and limits.n_joints != self._chain.n_joints:
            raise ShapeError("limits", (limits.n_joints,), f"({self._chain.n_joints},)")
        self._n_links = len(links)
        pairs = [
            (a, b)
            for a, b in combinations(range(len(self._bodies)), 2)
            if a < len(links) and self._joints_apart(a, b) > (0 if b >= len(links) else 1)
        ]
        self.separation = Separation(self._bodies, pairs)
        self._tried = random_postures(model, limits)
        self.built_in, self.narrowed = self._leave_out(self._tried)
        first, second = self.separation.first, self.separation.second
        joints = [body.joint for body in self._bodies]
        self.carrier: Indices = np.array(
            [
                carrier(self._chain, joints[a], joints[b])
                for a, b in zip(first, second, strict=True)
            ],
            dtype=np.intp,
        )
        self.from_base, self.from_carrier = (
            Curvature(self._chain, self._bodies, first, second, frame)
            for frame in (np.full_like(self.carrier, -1), self.carrier)
        )
        self.arm_length = _length(self._chain)

    def path(self, q: Array) -> Path:
        """Return where everything is at postures (m, n).

        Raises:
            ShapeError: postures of another arm.
            PostureError: a position that is no finite number.
        """
        if q.ndim != 2 or q.shape[1] != self._chain.n_joints:
            raise ShapeError("q", q.shape, f"(m, {self._chain.n_joints})")
        if not np.all(np.isfinite(q)):
            sample, joint = np.argwhere(~np.isfinite(q))[0].tolist()
            raise PostureError(sample, joint, float(q[sample, joint]))
        at = frames(self._chain, q)
        bodies = placed(self._bodies, at)
        return Path(q, at, bodies, travel(self._bodies, bodies, turning(self._chain, q)))

    def distance(self, pair: int, path: Path, sample: int) -> float:
        """Return the signed distance of a pair at a sample [m], -inf if it cannot be determined."""
        poses = []
        for index in (self.separation.first[pair], self.separation.second[pair]):
            body = self._bodies[index]
            if body.joint < 0:
                poses.append(body.pose)
                continue
            rotation = path.frames.rotation[body.joint + 1, :, :, sample]
            translation = path.frames.translation[body.joint + 1, :, sample]
            poses.append(coal.Transform3s(rotation, translation) * body.pose)
        self._result.clear()
        first, second = (self._bodies[i] for i in self.indices(pair))
        distance = float(
            coal.distance(
                first.shape, poses[0], second.shape, poses[1], self._request, self._result
            )
        )
        return -np.inf if np.isnan(distance) else distance

    def normal(self, second: int) -> Array:
        """Return the direction of the distance computed last, from second to first body."""
        fixed = self._bodies[second].normal
        normal: Array = -self._result.normal if fixed is None else fixed
        return normal

    def indices(self, pair: int) -> tuple[int, int]:
        """Return the two bodies of a pair."""
        return int(self.separation.first[pair]), int(self.separation.second[pair])

    def names(self, pair: int) -> tuple[str, str]:
        """Return the names of the two bodies of a pair."""
        a, b = self.indices(pair)
        return self._bodies[a].name, self._bodies[b].name

    def _leave_out(self, postures: Array) -> tuple[tuple[BuiltIn, ...], tuple[BuiltIn, ...]]:
        """Leave out the pairs that are built in, as these postures (k, n) show.

        A plane stands back for a link that can never keep the margin of it.

        Returns:
            What is left out, and those links.
        """
        tried = _Tried(self, self.path(postures))
        checked: list[tuple[int, int]] = []
        left_out, narrowed = list[BuiltIn](), list[BuiltIn]()
        for pair in range(len(self.separation.first)):
            a, b = self.indices(pair)
            names = self._bodies[a].shape_name, self._bodies[b].shape_name
            plane = self._bodies[b].normal is not None
            if (always := always_close(tried, pair, self.margin)) is not None:
                left_out.append(BuiltIn(*names, *always))
                continue
            if plane and (range_ := never_clear(tried, pair, self.margin)) is not None:
                narrowed.append(BuiltIn(*names, *range_))
                self._bodies.append(
                    withdrawn(self._bodies[b], self.margin - narrowed[-1].farthest + SLACK)
                )
                b = len(self._bodies) - 1
            checked.append((a, b))
        self.separation = Separation(self._bodies, checked)
        return tuple(left_out), tuple(narrowed)

    def spread(self, first: str, second: str) -> tuple[float, float]:
        """Return the least and largest distance of two bodies in random postures [m].

        Raises:
            ValueError: they are no pair.
        """
        pairs = [k for k in range(len(self.separation.first)) if self.names(k) == (first, second)]
        tried = _Tried(self, self.path(self._tried))
        distances = np.min([tried.distances(pair) for pair in pairs], axis=0)
        return float(distances.min()), float(distances.max())

    def joints_between(self, pair: int) -> int:
        """Count the joints between the bodies of a pair."""
        return self._joints_apart(*self.indices(pair))

    def with_obstacle(self, pair: int) -> bool:
        """Whether the second body of a pair is an obstacle."""
        return bool(self.separation.second[pair] >= self._n_links)

    def _joints_apart(self, a: int, b: int) -> int:
        """Count the joints between two bodies."""
        trunks = [
            set(self._chain.ancestors(joint)) if joint >= 0 else set()
            for joint in (self._bodies[a].joint, self._bodies[b].joint)
        ]
        return len(trunks[0] ^ trunks[1])


class _Tried:
    """Pairs of a scene in the postures of a path."""

    def __init__(self, scene: Scene, path: Path) -> None:
        self._scene, self._path = scene, path
        self._samples = np.arange(len(path.q))
        self.joints_between, self.with_obstacle = scene.joints_between, scene.with_obstacle

    def lower_bounds(self, pair: int) -> Array:
        pairs = np.full(len(self._samples), pair)
        return self._scene.separation.bound(self._path.bodies, pairs, self._samples)[0]

    def distances(self, pair: int) -> Array:
        samples = self._samples.tolist()
        return np.array([self._scene.distance(pair, self._path, k) for k in samples])


def _length(chain: Chain) -> float:
    reach = np.zeros(1 + chain.n_joints)
    for joint, parent in enumerate(chain.parents):
        reach[joint + 1] = reach[parent + 1] + np.linalg.norm(chain.translation[joint])
    return float(reach.max()) or 1.0
