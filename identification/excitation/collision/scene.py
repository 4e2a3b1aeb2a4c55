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
from identification.excitation.collision.bodies import link_bodies, obstacles
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
from identification.excitation.collision.workspace import Workspace
from identification.kinematics import Chain, chain_from_urdf

Array = NDArray[np.float64]

# Shapes that are closer than the margin, and than this [m], in all of so many postures are built
# that way; a wider margin must not check less.
BUILT_IN = 0.05
_N_POSTURES = 200
_SEED = 20140901


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
    """The bodies of an arm and of its workspace, in pairs that are to be kept apart.

    Attributes:
        margin: least distance [m] of each pair.
        arm_length: way along the arm from the base to its last joint [m]; 1 where there is none.
        separation: of the p pairs.
        carrier: (p,) the last joint that moves both bodies of a pair, -1 for the base.
        from_base, from_carrier: how far pairs leave straight lines, seen from there.

    Raises:
        CollisionModelError: the description has no collision shapes, or a mesh is missing.
        ModelError: the description is no open chain.
    """

    def __init__(self, urdf: str, workspace: Workspace, mesh_folders: Sequence[str]) -> None:
        self.margin = workspace.margin
        self._chain = chain_from_urdf(urdf)
        model = pin.buildModelFromXML(urdf)
        links = link_bodies(model, urdf, mesh_folders)
        self._bodies = [*links, *obstacles(workspace)]
        self._request = coal.DistanceRequest()
        self._result = coal.DistanceResult()
        pairs = [
            (a, b)
            for a, b in combinations(range(len(self._bodies)), 2)
            if a < len(links) and self._joints_between(a, b) > (0 if b >= len(links) else 1)
        ]
        self.separation = Separation(self._bodies, pairs)
        built_in = self._built_in(_random_postures(model))
        kept = zip(self.separation.first, self.separation.second, built_in, strict=True)
        self.separation = Separation(self._bodies, [(a, b) for a, b, always in kept if not always])
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
        """
        if q.ndim != 2 or q.shape[1] != self._chain.n_joints:
            raise ShapeError("q", q.shape, f"(m, {self._chain.n_joints})")
        at = frames(self._chain, q)
        bodies = placed(self._bodies, at)
        return Path(q, at, bodies, travel(self._bodies, bodies, turning(self._chain, q)))

    def distance(self, pair: int, path: Path, sample: int) -> float:
        """Return the signed distance of a pair at a sample [m]."""
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
        return float(
            coal.distance(
                first.shape, poses[0], second.shape, poses[1], self._request, self._result
            )
        )

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

    def _built_in(self, postures: Array) -> list[bool]:
        """Return of each pair whether it is too close in all of these postures."""
        path = self.path(postures)
        near = min(self.margin, BUILT_IN)
        samples = np.arange(len(postures))
        built_in = []
        for pair in range(len(self.separation.first)):
            always = self._joints_between(*self.indices(pair)) <= 2
            if always:
                lower, _ = self.separation.bound(path.bodies, np.full(len(samples), pair), samples)
                always = bool(np.all(lower < near)) and all(
                    self.distance(pair, path, k) < near for k in samples.tolist()
                )
            built_in.append(always)
        return built_in

    def _joints_between(self, a: int, b: int) -> int:
        """Count the joints between two bodies."""
        trunks = [
            set(self._chain.ancestors(joint)) if joint >= 0 else set()
            for joint in (self._bodies[a].joint, self._bodies[b].joint)
        ]
        return len(trunks[0] ^ trunks[1])


def _length(chain: Chain) -> float:
    reach = np.zeros(1 + chain.n_joints)
    for joint, parent in enumerate(chain.parents):
        reach[joint + 1] = reach[parent + 1] + np.linalg.norm(chain.translation[joint])
    return float(reach.max()) or 1.0


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
