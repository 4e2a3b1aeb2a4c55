"""An arm among obstacles: its bodies, the pairs that may touch, and where they are."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Final, NamedTuple

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from identification.errors import ShapeError
from identification.excitation.collision.bodies import Workspace, link_bodies, obstacles, withdrawn
from identification.excitation.collision.hulls import (
    Bodies,
    Curvature,
    Frames,
    Indices,
    Separation,
    carrier,
    frames,
    placed,
    travel,
    turning,
)
from identification.excitation.errors import PostureError
from identification.model.kinematics import Chain, chain_from_urdf
from planner import JointLimits

Array = NDArray[np.float64]


# Shapes that are closer than the margin, and than this [m], in all postures tried are built that
# way; a wider margin must not check less.
NEAR: Final = 0.05
# A foot's distance from what it stands in changes by this [m] at most.
STILL: Final = 0.002
# A link that never keeps the margin keeps the farthest distance that was tried, less this [m].
SLACK: Final = 0.005
_N_POSTURES = 200
_SEED = 20140901
# Ranges below this [rad, m] count as ranges that nobody gave.
_NO_RANGE = 1e-6


class BuiltIn(NamedTuple):
    """Two shapes that are not checked against each other, because they are always too close.

    Attributes:
        first, second: the shapes' names (of a link: those that pinocchio gives them, the link's
            with a number), or an obstacle's.
        nearest, farthest: their distance in the postures tried [m], negative where they overlap.
    """

    first: str
    second: str
    nearest: float
    farthest: float

    def __str__(self) -> str:
        return f"{self.first} and {self.second} ({self.nearest:.3f} to {self.farthest:.3f} m)"


class Path(NamedTuple):
    """Where everything is at m samples."""

    q: Array  # the postures (m, n)
    frames: Frames  # of base and links
    bodies: Bodies  # their hulls
    gone: Array  # (b, m) how far each body has gone until there at most, in straight lines [m]


class Scene:
    """The bodies of an arm and of its workspace, in pairs that are to be clear of each other.

    Margins are in m; `separation` is of the p pairs, `carrier` (p,) the last joint that moves both
    bodies of each (-1: the base), from which and from the base `from_carrier` and `from_base` say
    how far pairs leave straight lines. `built_in` are shapes too close in every posture, `narrowed`
    links and planes that keep less than the margin for that reason. `arm_length` is the way along
    the arm from the base to its last joint [m]; 1 where there is none.

    Raises:
        CollisionModelError: the description has no collision shapes, or a mesh is missing.
        ModelError: the description is no open chain.
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
        self.built_in, self.narrowed = self._leave_out()
        first, second = self.separation.first, self.separation.second
        joints = np.array([body.joint for body in self._bodies], dtype=np.intp)
        self.carrier: Indices = np.array(
            [carrier(chain, *pair) for pair in zip(joints[first], joints[second], strict=True)],
            dtype=np.intp,
        )
        self.from_base, self.from_carrier = (
            Curvature(chain, self._bodies, first, second, frame)
            for frame in (np.full_like(self.carrier, -1), self.carrier)
        )
        self.arm_length = _length(chain)

    def __reduce__(self) -> tuple[object, ...]:
        return type(self), self._arguments

    @property
    def pairs(self) -> tuple[tuple[str, str], ...]:
        """Names of what is checked against what, without repetitions."""
        return tuple(dict.fromkeys(map(self.names, range(len(self.separation.first)))))

    @property
    def exceptions(self) -> str | None:
        """What is not checked, or with less than the margin, in a sentence; None for nothing."""
        left_out = "not checked for collisions, always too close by the way the arm is built"
        less = "checked with the largest distance that the mounting leaves instead of the margin"
        sentences = [
            f"{words}: {'; '.join(map(str, those))}"
            for words, those in ((left_out, self.built_in), (less, self.narrowed))
            if those
        ]
        return "; ".join(sentences) or None

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

    def _leave_out(self) -> tuple[tuple[BuiltIn, ...], tuple[BuiltIn, ...]]:
        """Leave out the pairs that are built in; a plane stands back from some others."""
        # Built in are two links two joints apart at most that are too close in every posture, and
        # an obstacle and a shape of the first link that are too close at the same distance in every
        # posture. A plane stands back for one of the two links next to the mounting that can never
        # keep the margin of it, and does not touch it in some postures.
        near = min(self.margin, NEAR)
        checked: list[tuple[int, int]] = []
        left_out, narrowed = list[BuiltIn](), list[BuiltIn]()
        for pair in range(len(self.separation.first)):
            a, b = self.indices(pair)
            obstacle, plane = b >= self._n_links, self._bodies[b].normal is not None
            joints = self._joints_apart(a, b)
            least, most = -np.inf, np.inf
            if joints <= 2 and self._may_be_near(pair, near):
                distances = self._distances(pair)
                least, most = float(distances.min()), float(distances.max())
            names = self._bodies[a].shape_name, self._bodies[b].shape_name
            fixed = joints <= 1 and most - least <= STILL if obstacle else True
            if most < near and fixed:
                left_out.append(BuiltIn(*names, least, most))
                continue
            if plane and SLACK < most < near:
                narrowed.append(BuiltIn(*names, least, most))
                self._bodies.append(withdrawn(self._bodies[b], self.margin - most + SLACK))
                b = len(self._bodies) - 1
            checked.append((a, b))
        self.separation = Separation(self._bodies, checked)
        return tuple(left_out), tuple(narrowed)

    def spread(self, first: str, second: str) -> tuple[float, float]:
        """Return the least and largest distance [m] of a pair (see `pairs`) in random postures.

        Raises:
            ValueError: they are no pair.
        """
        pairs = [k for k in range(len(self.separation.first)) if self.names(k) == (first, second)]
        self._tried = self.path(self._tried.q)  # planes may have been added since
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
        """Return the distances of a pair in the postures tried (k,) [m]."""
        return np.array([self.distance(pair, self._tried, k) for k in range(_N_POSTURES)])

    def _may_be_near(self, pair: int, near: float) -> bool:
        """Whether a pair may be closer than so much [m] in every posture tried."""
        samples = np.arange(_N_POSTURES)
        pairs = np.full(_N_POSTURES, pair)
        return bool(np.all(self.separation.bound(self._tried.bodies, pairs, samples)[0] < near))


def random_postures(model: pin.Model, limits: JointLimits | None) -> Array:
    """Return postures (k, n) within limits or, without them, those of the description.

    Half a turn to either side where there are none.
    """
    lower, upper = _described(model) if limits is None else (limits.lower, limits.upper)
    range_ = upper - lower
    # Written so that what is no number or infinite counts as no limit.
    limited = (range_ > _NO_RANGE) & (range_ < 2.0 * np.pi)
    lower, upper = np.where(limited, lower, -np.pi), np.where(limited, upper, np.pi)
    shares = np.random.default_rng(_SEED).random((_N_POSTURES, model.nv))
    postures: Array = lower + shares * (upper - lower)
    return postures


def _described(model: pin.Model) -> tuple[Array, Array]:
    """Return the limits of a description, (n,) each; 0 for joints that turn without end."""
    lower, upper = np.zeros((2, model.nv))
    for joint in range(1, model.njoints):
        if model.joints[joint].nq == 1:  # one without end counts as two numbers in pinocchio
            index, limit = model.joints[joint].idx_v, model.joints[joint].idx_q
            lower[index] = model.lowerPositionLimit[limit]
            upper[index] = model.upperPositionLimit[limit]
    return lower, upper


def _length(chain: Chain) -> float:
    reach = np.zeros(1 + chain.n_joints)
    for joint, parent in enumerate(chain.parents):
        reach[joint + 1] = reach[parent + 1] + np.linalg.norm(chain.translation[joint])
    return float(reach.max()) or 1.0
