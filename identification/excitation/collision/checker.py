"""Collision checks along a motion.

A coarse bound of all pairs gives the candidates. A candidate is clear between two samples if the
travel of both bodies is too short to meet, or if a slab separates them at both samples and is
thicker than their deviation from straight lines. Intervals that remain open are divided.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Final, NamedTuple

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from identification.errors import ShapeError
from identification.excitation.collision.bodies import Workspace, floor_at, link_bodies, obstacles
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
from identification.excitation.joint_limits import rate_bounds
from identification.model.kinematics import Chain, chain_from_urdf
from identification.model.motion import Motion
from planner import FourierSeries, JointLimits, PiecewiseCubic

Array = NDArray[np.float64]

_DEPTH_RESOLUTION: Final = 0.005  # of the deepest contact [m]
# Only every k-th sample of a motion is checked, k at most _LONGEST_STRIDE, if no point of the arm
# deviates from the straight line between two of these by more than _BULGE [m].
_BULGE: Final = 0.02
_LONGEST_STRIDE: Final = 4
_PART: Final = 4000  # samples checked together
# Limit of the computed distances: for the deepest contact of a part, and between samples.
_MOST_DISTANCES: Final = 10_000
_MOST_PER_SAMPLE: Final = 5
# Samples per block of the coarse check, and parts into which an open interval is divided.
_BLOCK: Final = 8
_DIVISIONS: Final = 4
_MOST_GAPS: Final = 1000  # open intervals; with more the motion is not divided further
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


class Contact(NamedTuple):
    """A part of the arm closer to another body than the margin."""

    first: str  #: link
    second: str  #: link or obstacle ("floor", "wall 0", "box 1")
    sample: int  #: index of the posture
    time: float | None  #: [s], of a motion
    posture: tuple[float, ...]  #: joint positions there [rad]
    distance: float  #: [m], negative if they overlap


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


class CollisionChecker:
    """Distances between the collision shapes of a URDF, the floor, walls and boxes.

    Links that share a joint are not checked against each other, nor is the base against obstacles.
    Not checked either, if closer than the margin and 5 cm in each of 200 random postures: two
    shapes of the arm at most two joints apart (a wrist), and a shape of the first link at a
    constant distance from an obstacle (a rotating foot in the floor). One of the first two links
    that never has the margin from a floor or wall, but does not always touch it, is checked with
    the largest distance that it can have. `exceptions` reports all of these.

    Meshes of the robot description, in `mesh_folders` of `package://` paths, are replaced by their
    convex hulls. Random postures are within limits, if given, else ± half a turn.

    Attributes:
        separation: distance bounds of the p pairs.
        common_joint: (p,) last joint that moves both bodies of a pair, -1: the base.
        from_base, from_common_joint: bounds of the curvature of the pairs' motion seen from these.
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
        self.workspace, self.margin = workspace, workspace.margin
        self._chain = chain = chain_from_urdf(urdf)
        links = link_bodies(pin.buildModelFromXML(urdf), urdf, mesh_folders)
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
        self._tried = self.path(random_postures(chain.n_joints, limits))
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
            ValueError: a joint position is not finite.
        """
        if q.ndim != 2 or q.shape[1] != self._chain.n_joints:
            raise ShapeError("q", q.shape, f"(m, {self._chain.n_joints})")
        if not np.all(np.isfinite(q)):
            raise ValueError("positions of joints must be finite")
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
        near, samples = min(self.margin, _NEAR), np.arange(_N_POSTURES)
        checked: list[tuple[int, int]] = []
        unchecked, reduced = list[ClosePair](), list[ClosePair]()
        for pair in range(len(self.separation.first)):
            a, b = self.indices(pair)
            obstacle, plane = b >= self._n_links, self._bodies[b].normal is not None
            joints = self._joints_apart(a, b)
            least, most = -np.inf, np.inf
            if joints <= 2:
                repeated = np.full(_N_POSTURES, pair)
                bound, _ = self.separation.bound(self._tried.bodies, repeated, samples)
                if np.all(bound < near):
                    distances = self._distances(pair)
                    least, most = float(distances.min()), float(distances.max())
            names = self._bodies[a].shape_name, self._bodies[b].shape_name
            fixed = joints <= 1 and most - least <= _CONSTANT if obstacle else True
            if most < near and fixed:
                unchecked.append(ClosePair(*names, least, most))
                continue
            if plane and _SLACK < most < near:
                reduced.append(ClosePair(*names, least, most))
                height = float(self._bodies[b].hull.centre[2]) - (self.margin - most + _SLACK)
                self._bodies.append(floor_at(height))
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

    def deepest_contact(self, q: Array) -> Contact | None:
        """Return the deepest contact in postures (m, n), None if all are clear.

        Another contact may be deeper by up to 5 mm.
        """
        path = self.path(q)
        touch = _deepest(self, path, _candidates(self, path, np.zeros((2, 1, 1))))
        return None if touch is None else _contact(self, touch, q)

    def deepest_along(
        self,
        trajectory: PiecewiseCubic | FourierSeries,
        motion: Motion,
        *,
        between: bool = True,
    ) -> Contact | None:
        """Return the deepest contact along a trajectory, None if it is clear.

        `motion` are its samples, both ends included. If they are clear, the motion is checked
        continuously `between` them; an interval that division does not resolve counts as a
        contact. If samples touch, another contact may be deeper by up to 2.5 cm.
        """
        motion = motion.rows(_checked_samples(self, trajectory, motion))
        deepest: Contact | None = None
        for start in range(0, max(motion.n_samples - 1, 1), _PART):
            part = motion.rows(slice(start, start + _PART + 1))
            contact = self._deepest_in(trajectory, part, between)
            if deepest is None or (contact is not None and contact.distance < deepest.distance):
                deepest = contact
        return deepest

    def _deepest_in(
        self, trajectory: PiecewiseCubic | FourierSeries, motion: Motion, between: bool
    ) -> Contact | None:
        path = self.path(motion.position)
        bulges = _bulges_of(self, trajectory, motion) if between else np.zeros((2, 1, 1))
        candidates = _candidates(self, path, bulges)
        touch = _deepest(self, path, candidates)
        if touch is None:
            found = _touch_between(self, trajectory, motion, path, candidates) if between else None
            if found is None:
                return None
            touch, motion = found
        return _contact(self, touch, motion.position, motion.time)

    def clear(self, q: Array) -> NDArray[np.bool_]:
        """Return which of the postures (m, n) are clear, (m,)."""
        path = self.path(q)
        pairs, samples = np.indices((len(self.separation.first), len(q))).reshape(2, -1)
        lower, _ = self.separation.bound(path.bodies, pairs, samples)
        blocked = np.zeros(len(q), dtype=np.bool_)
        near = np.flatnonzero(~(lower >= self.margin))
        for k in near[np.argsort(lower[near], kind="stable")].tolist():
            pair, sample = int(pairs[k]), int(samples[k])
            if not blocked[sample]:
                blocked[sample] = not self.distance(pair, path, sample) >= self.margin
        return np.asarray(~blocked)


class Touch(NamedTuple):
    """A pair of bodies closer than the margin at a sample."""

    pair: int  # of the checker
    sample: int  # of the motion
    distance: float  # signed [m]


class Candidates(NamedTuple):
    """Pairs (k,) and samples (k,) that may touch, with bounds (k,) [m] and directions (3, k).

    In rows of `_BLOCK` + 1 consecutive samples, pair by pair. `bulge` (2, rows) [m] bounds the
    deviation of both bodies from straight lines between samples, seen from the base and from
    their common joint.
    """

    pair: Indices
    sample: Indices
    lower: Array
    normal: Array
    bulge: Array


def _contact(
    checker: CollisionChecker, touch: Touch, q: Array, time: Array | None = None
) -> Contact:
    sample = touch.sample
    return Contact(
        *checker.names(touch.pair),
        sample,
        None if time is None else float(time[sample]),
        tuple(q[sample].tolist()),
        touch.distance,
    )


def _checked_samples(
    checker: CollisionChecker, trajectory: PiecewiseCubic | FourierSeries, motion: Motion
) -> Indices:
    """Return the samples of a motion to check, both ends included."""
    last = motion.n_samples - 1
    velocity, acceleration, _ = rate_bounds(trajectory, motion.time[:1], motion.time[-1:])
    step = float(np.max(np.diff(motion.time), initial=0.0))
    bulges = checker.from_base.bulge(velocity, acceleration, motion.position, step)
    share = np.sqrt(_BULGE / np.max(bulges, initial=1e-9))
    stride = 1 if np.isnan(share) else int(np.clip(share, 1, _LONGEST_STRIDE))
    return np.append(np.arange(0, max(last, 1), stride), last)


def _deepest(checker: CollisionChecker, path: Path, candidates: Candidates) -> Touch | None:
    """Return the deepest contact at the samples by branch and bound."""
    near = np.flatnonzero(~(candidates.lower >= checker.margin))
    if len(near) == 0:
        return None
    pair, sample, lower = (column[near] for column in candidates[:3])
    exact = checker.separation.exact[pair]
    best, found = checker.margin, -1
    if np.any(exact):
        found = int(np.argmin(np.where(exact, lower, np.inf)))
        best = float(lower[found])
        lower[exact] = np.inf
    separation = checker.separation
    travel = path.travel[separation.first[pair], sample]
    travel += path.travel[separation.second[pair], sample]
    for _ in range(_MOST_DISTANCES):
        k = int(np.argmin(lower))
        if not lower[k] < best - (0.0 if found < 0 else _DEPTH_RESOLUTION):
            break
        distance = checker.distance(int(pair[k]), path, int(sample[k]))
        if distance < best:
            best, found = distance, k
        start, stop = np.searchsorted(pair, (pair[k], pair[k] + 1))
        reached = distance - np.abs(travel[start:stop] - travel[k])
        np.maximum(lower[start:stop], reached, out=lower[start:stop])
        lower[k] = np.inf
    else:
        if found < 0:  # not all candidates were checked: not clear
            best, found = float(np.nextafter(checker.margin, -1.0)), k
    if found < 0:
        return None
    return Touch(int(pair[found]), int(sample[found]), best)


def _bulges_of(
    checker: CollisionChecker, trajectory: PiecewiseCubic | FourierSeries, motion: Motion
) -> Array:
    """Bound the deviation of pairs from straight lines in blocks of samples, (2, p, rows) [m]."""
    starts = _starts(motion.n_samples)
    step = float(np.max(np.diff(motion.time), initial=0.0))
    ends = np.append(starts[1:], motion.n_samples - 1)
    _, change, jerk = rate_bounds(trajectory, motion.time[starts], motion.time[ends])

    def largest(rate: Array, slope: Array) -> Array:
        size = np.abs(rate.T)
        sampled = np.maximum(np.maximum.reduceat(size, starts, axis=1), size[:, ends])
        return np.asarray(sampled + slope * (step / 2.0))

    velocity = largest(motion.velocity, change)
    acceleration = largest(motion.acceleration, jerk)
    return np.array(
        [
            curvature.bulge(velocity, acceleration, motion.position, step)
            for curvature in (checker.from_base, checker.from_common_joint)
        ]
    )


def _candidates(checker: CollisionChecker, path: Path, bulges: Array) -> Candidates:
    """Return the pairs that may come closer than the margin at or next to a sample."""
    first, second = checker.separation.first, checker.separation.second
    last = len(path.q) - 1
    starts = _starts(len(path.q))
    grid = np.append(starts, last)
    bound = checker.separation.coarse(path.bodies, grid)
    travel = np.diff(path.travel[:, grid])
    least = (bound[:, :-1] + bound[:, 1:] - travel[first] - travel[second]) / 2.0 - bulges[0]
    pairs, blocks = np.nonzero(~(least >= checker.margin))
    bulge = np.broadcast_to(bulges, (2, *least.shape))[:, pairs, blocks]
    sample = np.minimum(starts[blocks][:, None] + np.arange(_BLOCK + 1), last)
    return _rows_of(checker, path, pairs, sample, bulge)


def _rows_of(
    checker: CollisionChecker, path: Path, pairs: Indices, sample: Indices, bulge: Array
) -> Candidates:
    """Return pairs (rows,) at samples (rows, `_BLOCK` + 1)."""
    pair = np.repeat(pairs, _BLOCK + 1)
    bound = checker.separation.bound(path.bodies, pair, sample.ravel())
    return Candidates(pair, sample.ravel(), *bound, bulge)


def _starts(samples: int) -> Indices:
    return np.arange(0, max(samples - 1, 1), _BLOCK)


_Distances = dict[int, tuple[float, Array]]  # and directions, by sample


class _Interval(NamedTuple):
    """A pair of bodies between two samples."""

    pair: int
    start: int
    stop: int
    bulge: float  # deviation from straight lines seen from the base [m]
    joint_bulge: float  # seen from the common joint

    def gap(self, left: int) -> _Interval:
        """Return the part between one sample and the next."""
        return self._replace(start=left, stop=left + 1)


def _touch_between(
    checker: CollisionChecker,
    trajectory: PiecewiseCubic | FourierSeries,
    motion: Motion,
    path: Path,
    candidates: Candidates,
) -> tuple[Touch, Motion] | None:
    """Return a touch between the samples, which are clear, and the finer samples it is at."""
    distances_left = max(_MOST_DISTANCES, _MOST_PER_SAMPLE * motion.n_samples)
    for division in range(_DIVISIONS + 1):
        gaps: list[_Interval] = []
        for interval in _open_intervals(checker, path, candidates):
            if division == 0 and checker.separation.sharp[interval.pair]:
                # for exact hulls division is cheaper than distances
                gaps += [interval.gap(k) for k in range(interval.start, interval.stop)]
                continue
            distances: _Distances = {}
            found = _open_gaps(checker, path, interval, distances)
            if isinstance(found, Touch):
                return found, motion
            gaps += found
            distances_left -= len(distances)
            if distances_left < 0:
                return _unresolved(checker, interval), motion
        if not gaps or division == _DIVISIONS or len(gaps) > _MOST_GAPS:
            break
        gaps.sort()
        pairs, left = (np.array([gap[column] for gap in gaps]) for column in (0, 1))
        time = np.linspace(motion.time[left], motion.time[left + 1], _BLOCK + 1, axis=1)
        motion = Motion(time.ravel(), *trajectory.sample(time.ravel()))
        path = checker.path(motion.position)
        bulge = np.array([(gap.bulge, gap.joint_bulge) for gap in gaps]).T / _BLOCK**2
        candidates = _rows_of(checker, path, pairs, np.arange(time.size).reshape(time.shape), bulge)
    return (_unresolved(checker, gaps[0]), motion) if gaps else None


def _unresolved(checker: CollisionChecker, interval: _Interval) -> Touch:
    """Return a touch just below the margin for an interval that was not resolved."""
    return Touch(interval.pair, interval.start, float(np.nextafter(checker.margin, -1.0)))


def _open_intervals(
    checker: CollisionChecker, path: Path, candidates: Candidates
) -> list[_Interval]:
    """Return intervals in which neither travel nor a slab proves the bodies to be clear."""
    rows = (-1, _BLOCK + 1)
    sample, lower = candidates.sample.reshape(rows), candidates.lower.reshape(rows)
    pair = candidates.pair.reshape(rows)[:, :-1].ravel()
    bulge, joint_bulge = np.repeat(candidates.bulge, _BLOCK, axis=1)
    before, after = sample[:, :-1].ravel(), sample[:, 1:].ravel()
    bound = lower[:, :-1].ravel(), lower[:, 1:].ravel()
    travel = path.travel
    a, b = checker.separation.first[pair], checker.separation.second[pair]
    length = travel[a, after] - travel[a, before] + travel[b, after] - travel[b, before]
    margin = checker.margin
    reach = (bound[0] + bound[1] - length) / 2.0 - bulge
    open_ = np.flatnonzero(~(reach >= margin) & (after > before))
    normals = candidates.normal.reshape(3, *rows)
    least = np.full(len(open_), -np.inf)
    for side, (here, there) in ((0, (before, after)), (1, (after, before))):
        normal = normals[:, :, side : side + _BLOCK].reshape(3, -1)[:, open_]
        thickness = _slab(checker, path, pair[open_], here[open_], there[open_], normal)
        np.maximum(least, np.minimum(bound[side][open_], thickness), out=least)
    intervals: list[_Interval] = []
    for k in open_[~(least - joint_bulge[open_] >= margin)].tolist():
        ends = int(pair[k]), int(before[k]), int(after[k])
        new = _Interval(*ends, float(bulge[k]), float(joint_bulge[k]))
        last = intervals[-1] if intervals else None
        if last is not None and (last.pair, last.stop) == (new.pair, new.start):
            bulges = max(last.bulge, new.bulge), max(last.joint_bulge, new.joint_bulge)
            intervals[-1] = _Interval(last.pair, last.start, new.stop, *bulges)
        else:
            intervals.append(new)
    return intervals


def _slab(
    checker: CollisionChecker,
    path: Path,
    pair: Indices,
    here: Indices,
    there: Indices,
    normal: Array,
) -> Array:
    """Return the thickness at samples `there` of slabs (k,) with normals at samples `here` [m]."""
    joint = checker.common_joint[pair] + 1
    local = np.einsum("kij,ik->jk", path.frames.rotation[joint, :, :, here], normal)
    turned = np.einsum("kij,jk->ik", path.frames.rotation[joint, :, :, there], local)
    return checker.separation.along(path.bodies, pair, there, turned)


def _open_gaps(
    checker: CollisionChecker, path: Path, interval: _Interval, distances: _Distances
) -> list[_Interval] | Touch:
    """Return gaps between neighbouring samples in which a pair may touch, or a touch at one."""
    a, b = checker.indices(interval.pair)
    margin = checker.margin
    gaps, stack = [], [(interval.start, interval.stop)]
    while stack:
        left, right = stack.pop()
        for sample in (left, right):
            if sample not in distances:
                distances[sample] = checker.distance(interval.pair, path, sample), checker.normal(b)
            if not distances[sample][0] >= margin:
                return Touch(interval.pair, sample, distances[sample][0])
        travel = path.travel[a, right] - path.travel[a, left]
        travel += path.travel[b, right] - path.travel[b, left]
        reach = (distances[left][0] + distances[right][0] - travel) / 2.0
        if reach - interval.bulge >= margin:
            continue
        if right - left > 1:
            middle = (left + right) // 2
            stack += [(middle, right), (left, middle)]
            continue
        ends = np.array([left, right])
        normal = np.array([distances[left][1], distances[right][1]]).T
        pair = np.full(2, interval.pair)
        here = checker.separation.along(path.bodies, pair, ends, normal)
        there = _slab(checker, path, pair, ends, ends[::-1], normal)
        if not np.max(np.minimum(here, there)) - interval.joint_bulge >= margin:
            gaps.append(interval.gap(left))
    return gaps


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
