"""An arm and its obstacles: bodies, checked pairs, and their positions along a path."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Final, NamedTuple

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from identification.errors import ShapeError
from identification.excitation.collision.bodies import Workspace, link_bodies, moved_back, obstacles
from identification.excitation.collision.hulls import (
    Bodies,
    Curvature,
    Frames,
    Indices,
    Separation,
    common_joint,
    frames,
    placed,
    travel,
    turning,
)
from identification.excitation.errors import PostureError
from identification.model.kinematics import Chain, chain_from_urdf
from planner import JointLimits

Array = NDArray[np.float64]

# Pairs closer than this [m] (and than the margin) in all sampled postures are not checked; a wider
# margin does not exclude more.
_NEAR: Final = 0.05
# Largest variation [m] of the distance of a rotating foot from its obstacle.
_CONSTANT: Final = 0.002
# A link that never has the margin must have the largest sampled distance less this [m].
_SLACK: Final = 0.005
_N_POSTURES = 200
_SEED = 20140901
_NO_RANGE = 1e-6  # ranges below this [rad, m] are not limits


class ClosePair(NamedTuple):
    """Two shapes that are closer than the margin in all sampled postures.

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

    q: Array  # postures (m, n)
    frames: Frames  # of base and links
    bodies: Bodies  # hulls
    travel: Array  # (b, m) upper bound of the path length of each body's points [m]


class Scene:
    """The bodies of an arm and of its workspace, in pairs that must not touch.

    Attributes:
        margin: least distance [m].
        separation: distance bounds of the p pairs.
        common_joint: (p,) last joint that moves both bodies of a pair, -1: the base.
        from_base, from_common_joint: bounds of the curvature of the pairs' motion seen from these.
        unchecked: pairs that are not checked because they are always too close.
        reduced: pairs of link and plane that are checked with less than the margin.
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
        self.workspace, self.margin = workspace, workspace.margin
        self._chain = chain = chain_from_urdf(urdf)
        model = pin.buildModelFromXML(urdf)
        links = link_bodies(model, urdf, mesh_folders)
        self._bodies = [*links, *obstacles(workspace)]
        self._request, self._result = coal.DistanceRequest(), coal.DistanceResult()
        if limits is not None and limits.n_joints != chain.n_joints:
            raise ShapeError("limits", (limits.n_joints,), f"({chain.n_joints},)")
        self._n_links = len(links)
        pairs = [
            (a, b)
            for a, b in combinations(range(len(self._bodies)), 2)
            if a < len(links) and self._joints_apart(a, b) > (0 if b >= len(links) else 1)
        ]
        self.separation = Separation(self._bodies, pairs)
        self._tried = self.path(random_postures(model, limits))
        self.unchecked, self.reduced = self._find_close_pairs()
        first, second = self.separation.first, self.separation.second
        joints = np.array([body.joint for body in self._bodies], dtype=np.intp)
        joint_pairs = zip(joints[first], joints[second], strict=True)
        self.common_joint: Indices = np.array(
            [common_joint(chain, *pair) for pair in joint_pairs], dtype=np.intp
        )
        self.from_base, self.from_common_joint = (
            Curvature(chain, self._bodies, first, second, frame)
            for frame in (np.full_like(self.common_joint, -1), self.common_joint)
        )
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
            "checked with the largest distance that the mounting allows instead of the margin": (
                self.reduced
            ),
        }
        parts = [
            f"{text}: {'; '.join(map(str, pairs))}" for text, pairs in messages.items() if pairs
        ]
        return "; ".join(parts) or None

    def path(self, q: Array) -> Path:
        """Return the positions of all bodies at postures (m, n).

        Raises:
            ShapeError: postures of another arm.
            PostureError: a joint position is not finite.
        """
        if q.ndim != 2 or q.shape[1] != self._chain.n_joints:
            raise ShapeError("q", q.shape, f"(m, {self._chain.n_joints})")
        if not np.all(np.isfinite(q)):
            sample, joint = np.argwhere(~np.isfinite(q))[0].tolist()
            value = float(q[sample, joint])
            raise PostureError(
                f"joint {joint} is at {value} rad in posture {sample}; it must be finite"
            )
        at = frames(self._chain, q)
        bodies = placed(self._bodies, at)
        return Path(q, at, bodies, travel(self._bodies, bodies, turning(self._chain, q)))

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

    def normal(self, second: int) -> Array:
        """Return the direction of the last computed distance, from second to first body."""
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

    def _find_close_pairs(self) -> tuple[tuple[ClosePair, ...], tuple[ClosePair, ...]]:
        """Remove pairs that are always too close, and move planes back for others."""
        # Removed: two links at most two joints apart that are too close in all postures, and an
        # obstacle and a shape of the first link at a constant distance below the margin. A plane
        # is moved back for one of the first two links that never has the margin from it, but does
        # not touch it in all postures.
        near = min(self.margin, _NEAR)
        checked: list[tuple[int, int]] = []
        unchecked, reduced = list[ClosePair](), list[ClosePair]()
        for pair in range(len(self.separation.first)):
            a, b = self.indices(pair)
            obstacle, plane = b >= self._n_links, self._bodies[b].normal is not None
            joints = self._joints_apart(a, b)
            least, most = -np.inf, np.inf
            if joints <= 2 and self._may_be_near(pair, near):
                distances = self._distances(pair)
                least, most = float(distances.min()), float(distances.max())
            names = self._bodies[a].shape_name, self._bodies[b].shape_name
            fixed = joints <= 1 and most - least <= _CONSTANT if obstacle else True
            if most < near and fixed:
                unchecked.append(ClosePair(*names, least, most))
                continue
            if plane and _SLACK < most < near:
                reduced.append(ClosePair(*names, least, most))
                self._bodies.append(moved_back(self._bodies[b], self.margin - most + _SLACK))
                b = len(self._bodies) - 1
            checked.append((a, b))
        self.separation = Separation(self._bodies, checked)
        return tuple(unchecked), tuple(reduced)

    def spread(self, first: str, second: str) -> tuple[float, float]:
        """Return the least and largest distance [m] of one of `pairs` in random postures.

        Raises:
            ValueError: it is not one of `pairs`.
        """
        pairs = [k for k in range(len(self.separation.first)) if self.names(k) == (first, second)]
        self._tried = self.path(self._tried.q)  # with the planes that were moved back
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

    def _may_be_near(self, pair: int, near: float) -> bool:
        """Whether a pair may be closer than `near` [m] in all sampled postures."""
        samples = np.arange(_N_POSTURES)
        pairs = np.full(_N_POSTURES, pair)
        return bool(np.all(self.separation.bound(self._tried.bodies, pairs, samples)[0] < near))


def random_postures(model: pin.Model, limits: JointLimits | None) -> Array:
    """Return postures (k, n) within limits, those of the description if None, or ± half a turn."""
    lower, upper = _described(model) if limits is None else (limits.lower, limits.upper)
    range_ = upper - lower
    limited = (range_ > _NO_RANGE) & (range_ < 2.0 * np.pi)  # False for nan and infinity
    lower, upper = np.where(limited, lower, -np.pi), np.where(limited, upper, np.pi)
    shares = np.random.default_rng(_SEED).random((_N_POSTURES, model.nv))
    postures: Array = lower + shares * (upper - lower)
    return postures


def _described(model: pin.Model) -> tuple[Array, Array]:
    """Return the limits of a description, (n,) each; 0 for continuous joints."""
    lower, upper = np.zeros((2, model.nv))
    for joint in range(1, model.njoints):
        if model.joints[joint].nq == 1:  # 2 for a continuous joint
            index, limit = model.joints[joint].idx_v, model.joints[joint].idx_q
            lower[index] = model.lowerPositionLimit[limit]
            upper[index] = model.upperPositionLimit[limit]
    return lower, upper


def _length(chain: Chain) -> float:
    reach = np.zeros(1 + chain.n_joints)
    for joint, parent in enumerate(chain.parents):
        reach[joint + 1] = reach[parent + 1] + np.linalg.norm(chain.translation[joint])
    return float(reach.max()) or 1.0
