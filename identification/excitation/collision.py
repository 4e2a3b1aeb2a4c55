"""Collision checks along a motion, of shapes on the links of an arm with each other and obstacles.

No distance of two bodies changes by more than the sum over the joints between them of reach times
step. Where the distances at two instants do not suffice, the interval between them is divided.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Any, Final, NamedTuple

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from identification.arrays import Array, Indices
from identification.errors import ShapeError
from identification.excitation.collision_bodies import link_bodies, obstacles
from identification.excitation.separation import (
    BodyHulls,
    Frames,
    Separation,
    frames,
    placed,
    reaches,
)
from identification.model.kinematics import Chain, chain_from_urdf
from identification.model.workspace import Workspace
from planner.fourier import FourierSeries
from planner.limits import JointLimits
from planner.piecewise_cubic import PiecewiseCubic

# Another contact may be deeper by this: in given postures, and along a motion [m].
_DEPTH_TOLERANCE: Final = 0.005
_MOTION_DEPTH_TOLERANCE: Final = 0.02
_FIRST_STEP_SECONDS: Final = 0.08  # of the first instants of a motion [s]
_LAST_STEP_SECONDS: Final = 0.008  # of the last ones, if only instants are checked
_MAX_DIVISIONS: Final = 16  # of an interval; one that is still open counts as a contact
# Most open intervals, and distances that are computed; with more, the motion counts as a contact.
_MAX_OPEN_INTERVALS: Final = 20_000
_MAX_DISTANCES: Final = 30_000
# Pairs closer than this [m] (and than the margin) in all sampled postures are not checked; a wider
# margin does not exclude more.
_NEAR_DISTANCE: Final = 0.05
# Largest variation [m] of the distance of a rotating foot from its obstacle.
_MAX_DISTANCE_VARIATION: Final = 0.002
# A pair that never or hardly has the margin must have the largest sampled distance less this [m],
# or less half the margin if that is smaller.
_DISTANCE_SLACK: Final = 0.005
_N_POSTURES = 200
_SEED = 20140901
_MIN_RANGE = 1e-6  # ranges below this [rad, m] are not limits


class Proximity(NamedTuple):
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


class PairExceptions(NamedTuple):
    """Pairs of bodies that are always, or nearly always, closer than the margin."""

    unchecked: tuple[ClosePair, ...] = ()
    reduced: tuple[ClosePair, ...] = ()  # checked with a smaller margin


class Path(NamedTuple):
    """Positions of all bodies at m samples."""

    frames: Frames  # of base and links
    bodies: BodyHulls  # hulls


class CollisionChecker:
    """Distances between the collision shapes of a URDF, the floor, walls and boxes.

    Links that share a joint are not checked against each other, nor is the base against obstacles.
    Not checked either, if closer than the margin and 5 cm in each of 200 random postures: two
    shapes of the arm at most two joints apart (a wrist), and a shape of the first link at a
    constant distance from an obstacle (a rotating foot in the floor). Two shapes at most two joints
    apart whose largest distance there is about the margin, or less and not excluded as above, but
    not a touch, are checked with that distance less 5 mm. `exceptions` has all of these.

    Meshes of the robot description are replaced by their convex hulls.

    Args:
        urdf: text of the robot description.
        workspace: floor, walls, boxes and margin.
        limits: of the joints; random postures are within them, else ± half a turn.
        mesh_folders: folders of `package://` paths.

    Attributes:
        separation: distance bounds of the p pairs.
        required: least distance of each pair (p,) [m].
        exceptions: pairs that are not checked, or with less than the margin.
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
        self.required, self.exceptions = self._find_close_pairs()
        still = np.zeros(chain.n_joints)
        self._turning_reaches = reaches(chain, self._bodies, self.separation, still)
        self.arm_length = _length(chain)

    def __reduce__(self) -> tuple[object, ...]:
        return type(self), self._arguments

    @property
    def pairs(self) -> tuple[tuple[str, str], ...]:
        """Names of the checked pairs of bodies, without repetitions."""
        return tuple(dict.fromkeys(map(self.names, range(len(self.separation.first)))))

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

    def _find_close_pairs(self) -> tuple[Array, PairExceptions]:
        """Remove pairs that are always too close; return the least distances of the others."""
        # Removed: two links at most two joints apart that are too close in all postures, and an
        # obstacle and a shape of the first link at a constant distance below the margin.
        near = min(self.margin, _NEAR_DISTANCE)
        samples = np.arange(_N_POSTURES)
        slack = min(_DISTANCE_SLACK, near / 2.0)
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
            fixed = (
                joints <= 1 and most - least <= _MAX_DISTANCE_VARIATION
                if b >= self._n_links
                else True
            )
            if most < near and fixed:
                unchecked.append(close)
                continue
            close_to_margin = slack < most < near + slack
            reduced += [close] if close_to_margin else []
            required.append(most - slack if close_to_margin else self.margin)
            checked.append((a, b))
        self.separation = Separation(self._bodies, checked)
        return np.array(required), PairExceptions(tuple(unchecked), tuple(reduced))

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

    def deepest_contact(self, q: Array) -> Proximity | None:
        """Return the deepest contact in postures (m, n), None if all are clear.

        Another contact may be deeper by up to 5 mm.
        """
        nearest = _Nearest(self, _DEPTH_TOLERANCE)
        pair, sample = np.indices((len(self.separation.first), len(q))).reshape(2, -1)
        nearest.visit(q, np.arange(len(q), dtype=np.float64), pair, sample)
        if nearest.contact is None:
            return None
        return nearest.contact._replace(sample=int(nearest.contact.time or 0), time=None)

    def deepest_along(
        self, trajectory: PiecewiseCubic | FourierSeries, *, between: bool = True
    ) -> Proximity | None:
        """Return the deepest contact along a trajectory, None if it is clear.

        It is checked at every instant, or, if not `between`, at instants up to 8 ms apart. An
        interval that division does not resolve counts as a contact. Another contact may be deeper
        by up to 2 cm.
        """
        nearest = _Nearest(self, _MOTION_DEPTH_TOLERANCE)
        time = np.linspace(
            0.0, trajectory.duration, 1 + _steps(trajectory.duration, _FIRST_STEP_SECONDS)
        )
        q = trajectory.sample(time)[0]
        beyond = (
            acceleration_bound(trajectory, time[:1], time[-1:])[:, 0] * _FIRST_STEP_SECONDS**2 / 8.0
        )
        reach = self.reaches(np.abs(q).max(axis=0) + beyond)
        pair, node = np.indices((len(reach), len(time))).reshape(2, -1)
        distances = nearest.visit(q, time, pair, node).reshape(-1, len(time))
        ends = time[:-1], time[1:], q[:-1], q[1:]
        change = reach @ _passed(trajectory, *ends, between=between)
        least = (distances[:, :-1] + distances[:, 1:] - change) / 2.0
        pair, node = np.nonzero(~(least >= nearest.limit))
        start, stop, q0, q1 = (end[node] for end in ends)
        gaps = _Gaps(pair, start, stop, q0, q1, distances[pair, node], distances[pair, node + 1])
        for _ in range(_MAX_DIVISIONS):
            if not between:
                gaps = gaps.take(gaps.stop - gaps.start > _LAST_STEP_SECONDS)
            many = len(gaps.pair) > _MAX_OPEN_INTERVALS or nearest.distances > _MAX_DISTANCES
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
        self.contact: Proximity | None = None
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
        self.contact = Proximity(first, second, None, *at, distance, required)
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
        limited = (range_ > _MIN_RANGE) & (range_ < 2.0 * np.pi)
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
