"""Where along a motion the arm comes too close to itself or to what stands around it.

A quick look at all pairs shows which are near (`Near`). These are clear from one sample to the next
if they cannot meet for the way they go, or if one slab lies between them at both and their points
leave straight lines by no more than is allowed for; what that leaves open is divided.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.excitation.collision.hulls import Indices
from identification.excitation.collision.scene import Path, Scene
from identification.excitation.joint_limits import rate_bounds
from identification.model.motion import Motion
from planner import FourierSeries, PiecewiseCubic

Array = NDArray[np.float64]

# How much deeper [m] than the contact that is reported another one may be.
_DEPTH_RESOLUTION: Final = 0.005
# Of the samples of a motion every so manieth is looked at, if no point of the arm leaves the
# straight line between two such by more than _BULGE [m].
_BULGE: Final = 0.02
_LONGEST_STRIDE: Final = 4
# Samples that are looked at together; longer motions are looked at part by part.
_PART: Final = 4000
# Distances that are computed at most to find the deepest contact of a part, and before closer
# looking between samples is given up: so many, or so many for each sample of a long motion.
_MOST_DISTANCES: Final = 10_000
_MOST_PER_SAMPLE: Final = 5
# Samples between those at which all pairs are looked at. What stays open between two samples is
# divided by it, so many times at most.
_BLOCK: Final = 8
_DIVISIONS: Final = 4
# A motion of which more stays open is not looked at any closer; motions that an arm can follow
# leave some dozens open.
_MOST_GAPS: Final = 1000


class Contact(NamedTuple):
    """The arm closer to something than the margin."""

    first: str  #: the two links, or a link and an obstacle ("floor", "wall 0", "box 1")
    second: str  #: the two links, or a link and an obstacle ("floor", "wall 0", "box 1")
    sample: int  #: index of the posture, among those that it was found in
    time: float | None  #: when [s]; None on a way that has no times
    posture: tuple[float, ...]  #: joint positions there [rad]
    #: between them [m], negative where they overlap: how far they would have to be moved to part
    distance: float


class CollisionChecker(Scene):
    """Distances between the collision shapes of a URDF, the floor, walls and boxes.

    Links that share a joint are never checked against each other, nor is the base against what
    it stands among. Two shapes of the arm, two joints apart at most, that are too close in every
    one of 200 random postures, and closer than 5 cm, are assumed to be built that way (a wrist) and
    left out too, as is a shape of the first link that is as close to an obstacle in all of them
    (a foot that turns in the floor). One of the two links next to the mounting that never has the
    margin of a floor or wall, but does not always touch it, gets the largest distance that it can
    have in its place; `exceptions` names all of these. Every other pair is checked, even if it
    always touches.

    Args:
        urdf: text of the robot description; meshes are replaced by their convex hulls.
        workspace: obstacles and margin.
        limits: joint limits in use, which random postures keep; None for those of the URDF, and
            half a turn where it has none.
        mesh_folders: where `package://` paths of meshes begin.

    Raises:
        CollisionModelError: the description has no collision shapes, or a mesh is missing.
        ModelError: the description is no open chain.
    """

    def deepest_contact(self, q: Array, time: Array | None = None) -> Contact | None:
        """Return the deepest contact along postures (m, n), at times (m,); None if all are clear.

        No posture is left out, though not all are looked at one by one: bodies that are far
        apart cannot meet before they have gone the distance. Another contact may be deeper by
        5 mm.

        Raises:
            ShapeError: postures of another arm.
            PostureError: a position that is no finite number.
        """
        path = self.path(q)
        if len(q) == 0:
            return None
        touch = _deepest(self, path, _what_is_near(self, path, np.zeros((2, 1, 1))))
        return None if touch is None else _contact(self, touch, q, time)

    def deepest_along(
        self,
        trajectory: PiecewiseCubic | FourierSeries,
        motion: Motion,
        *,
        between: bool = True,
    ) -> Contact | None:
        """Return the deepest contact along a trajectory, None if clear; samples hold both ends.

        Where all samples are clear, the motion is looked at `between` them too, without a gap; what
        even fine division cannot tell from a contact counts as one, and so does what would take too
        long to tell. Where samples touch, another contact may be deeper by 5 mm, and by what the
        arm bulges out between two samples, 2 cm at most.

        Raises:
            ShapeError: a motion of another arm.
            PostureError: a position that is no finite number.
        """
        motion = motion.rows(_looked_at(self, trajectory, motion))
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
        near = _what_is_near(self, path, bulges)
        touch = _deepest(self, path, near)
        if touch is None:
            found = _touch_between(self, trajectory, motion, path, near) if between else None
            if found is None:
                return None
            touch, motion = found
        return _contact(self, touch, motion.position, motion.time)

    def clear(self, q: Array) -> NDArray[np.bool_]:
        """Return which of the unrelated postures (m, n) keep the margin, (m,).

        Raises:
            ShapeError: postures of another arm.
            PostureError: a position that is no finite number.
        """
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

    pair: int  # of the scene
    sample: int  # of the motion that it was looked for in
    distance: float  # signed [m]


class Near(NamedTuple):
    """Pairs (k,) and samples (k,) that may touch, with bounds (k,) [m] and directions (3, k).

    They come in rows of `_BLOCK` + 1 samples one after the other, pair by pair. Between samples
    the two bodies leave straight lines by no more than `bulge` (2, rows) [m], seen from the base
    and from the frame that carries both.
    """

    pair: Indices
    sample: Indices
    lower: Array
    normal: Array
    bulge: Array


def _contact(scene: Scene, touch: Touch, q: Array, time: Array | None) -> Contact:
    sample = touch.sample
    return Contact(
        *scene.names(touch.pair),
        sample,
        None if time is None else float(time[sample]),
        tuple(q[sample].tolist()),
        touch.distance,
    )


def _looked_at(scene: Scene, trajectory: PiecewiseCubic | FourierSeries, motion: Motion) -> Indices:
    """Return which samples of a motion are looked at, both ends among them."""
    last = motion.n_samples - 1
    velocity, acceleration, _ = rate_bounds(trajectory, motion.time[:1], motion.time[-1:])
    step = float(np.max(np.diff(motion.time), initial=0.0))
    bulges = scene.from_base.bulge(velocity, acceleration, motion.position, step)
    share = np.sqrt(_BULGE / np.max(bulges, initial=1e-9))
    stride = 1 if np.isnan(share) else int(np.clip(share, 1, _LONGEST_STRIDE))
    return np.append(np.arange(0, max(last, 1), stride), last)


def _deepest(scene: Scene, path: Path, near: Near) -> Touch | None:
    """Return the deepest contact at the samples by branch and bound."""
    candidates = np.flatnonzero(~(near.lower >= scene.margin))
    if len(candidates) == 0:
        return None
    pair, sample, lower = (column[candidates] for column in near[:3])
    exact = scene.separation.exact[pair]
    best, found = scene.margin, -1
    if np.any(exact):
        found = int(np.argmin(np.where(exact, lower, np.inf)))
        best = float(lower[found])
        lower[exact] = np.inf
    separation = scene.separation
    gone = path.gone[separation.first[pair], sample]
    gone += path.gone[separation.second[pair], sample]
    for _ in range(_MOST_DISTANCES):
        k = int(np.argmin(lower))
        if not lower[k] < best - (0.0 if found < 0 else _DEPTH_RESOLUTION):
            break
        distance = scene.distance(int(pair[k]), path, int(sample[k]))
        if distance < best:
            best, found = distance, k
        start, stop = np.searchsorted(pair, (pair[k], pair[k] + 1))
        reached = distance - np.abs(gone[start:stop] - gone[k])
        np.maximum(lower[start:stop], reached, out=lower[start:stop])
        lower[k] = np.inf
    else:
        if found < 0:  # nothing was found, and not all was looked at: not clear
            best, found = float(np.nextafter(scene.margin, -1.0)), k
    if found < 0:
        return None
    return Touch(int(pair[found]), int(sample[found]), best)


def _bulges_of(scene: Scene, trajectory: PiecewiseCubic | FourierSeries, motion: Motion) -> Array:
    """Bound how far pairs leave straight lines in rows of `_BLOCK` samples, (2, p, rows) [m]."""
    starts = _starts(motion.n_samples)
    step = float(np.max(np.diff(motion.time), initial=0.0))
    ends = np.append(starts[1:], motion.n_samples - 1)
    _, change, jerk = rate_bounds(trajectory, motion.time[starts], motion.time[ends])

    def largest(rate: Array, slope: Array) -> Array:
        size = np.abs(rate.T)
        seen = np.maximum(np.maximum.reduceat(size, starts, axis=1), size[:, ends])
        found: Array = seen + slope * (step / 2.0)
        return found

    velocity = largest(motion.velocity, change)
    acceleration = largest(motion.acceleration, jerk)
    return np.array(
        [
            curvature.bulge(velocity, acceleration, motion.position, step)
            for curvature in (scene.from_base, scene.from_carrier)
        ]
    )


def _what_is_near(scene: Scene, path: Path, bulges: Array) -> Near:
    """Return what may come closer than the margin at or next to a sample."""
    first, second = scene.separation.first, scene.separation.second
    last = len(path.q) - 1
    starts = _starts(len(path.q))
    grid = np.append(starts, last)
    bound = scene.separation.coarse(path.bodies, grid)
    way = np.diff(path.gone[:, grid])
    least = (bound[:, :-1] + bound[:, 1:] - way[first] - way[second]) / 2.0 - bulges[0]
    pairs, blocks = np.nonzero(~(least >= scene.margin))
    bulge = np.broadcast_to(bulges, (2, *least.shape))[:, pairs, blocks]
    sample = np.minimum(starts[blocks][:, None] + np.arange(_BLOCK + 1), last)
    return _rows_of(scene, path, pairs, sample, bulge)


def _rows_of(scene: Scene, path: Path, pairs: Indices, sample: Indices, bulge: Array) -> Near:
    """Return pairs (rows,) at samples (rows, `_BLOCK` + 1)."""
    pair = np.repeat(pairs, _BLOCK + 1)
    bound = scene.separation.bound(path.bodies, pair, sample.ravel())
    return Near(pair, sample.ravel(), *bound, bulge)


def _starts(samples: int) -> Indices:
    return np.arange(0, max(samples - 1, 1), _BLOCK)


_Seen = dict[int, tuple[float, Array]]


class _Stretch(NamedTuple):
    """A pair from one sample to another, and how far it leaves straight lines between samples [m].

    Attributes:
        bulge: seen from the base.
        own_bulge: seen from the frame that carries both.
    """

    pair: int
    start: int
    stop: int
    bulge: float  # seen from the base
    own_bulge: float  # seen from the frame that carries both

    def gap(self, left: int) -> _Stretch:
        """Return the part between one sample and the next."""
        return self._replace(start=left, stop=left + 1)


def _touch_between(
    scene: Scene,
    trajectory: PiecewiseCubic | FourierSeries,
    motion: Motion,
    path: Path,
    near: Near,
) -> tuple[Touch, Motion] | None:
    """Return a touch between the samples, which are clear, and the samples that show it."""
    distances = max(_MOST_DISTANCES, _MOST_PER_SAMPLE * motion.n_samples)
    for division in range(_DIVISIONS + 1):
        gaps: list[_Stretch] = []
        for stretch in _open_stretches(scene, path, near):
            if division == 0 and scene.separation.sharp[stretch.pair]:
                # looking closer by slabs costs less than distances
                gaps += [stretch.gap(k) for k in range(stretch.start, stretch.stop)]
                continue
            seen: _Seen = {}
            found = _open_gaps(scene, path, stretch, seen)
            if isinstance(found, Touch):
                return found, motion
            gaps += found
            distances -= len(seen)
            if distances < 0:
                return _untold(scene, stretch), motion
        if not gaps or division == _DIVISIONS or len(gaps) > _MOST_GAPS:
            break
        gaps.sort()
        pairs, left = (np.array([gap[column] for gap in gaps]) for column in (0, 1))
        time = np.linspace(motion.time[left], motion.time[left + 1], _BLOCK + 1, axis=1)
        motion = Motion(time.ravel(), *trajectory.sample(time.ravel()))
        path = scene.path(motion.position)
        bulge = np.array([(gap.bulge, gap.own_bulge) for gap in gaps]).T / _BLOCK**2
        near = _rows_of(scene, path, pairs, np.arange(time.size).reshape(time.shape), bulge)
    return (_untold(scene, gaps[0]), motion) if gaps else None


def _untold(scene: Scene, stretch: _Stretch) -> Touch:
    """Return what counts as a touch: too close to the margin to be determined, or too long."""
    return Touch(stretch.pair, stretch.start, float(np.nextafter(scene.margin, -1.0)))


def _open_stretches(scene: Scene, path: Path, near: Near) -> list[_Stretch]:
    """Return where neither the way that is gone nor a slab shows two bodies to be clear."""
    rows = (-1, _BLOCK + 1)
    sample, lower = near.sample.reshape(rows), near.lower.reshape(rows)
    pair = near.pair.reshape(rows)[:, :-1].ravel()
    bulge, own_bulge = np.repeat(near.bulge, _BLOCK, axis=1)
    before, after = sample[:, :-1].ravel(), sample[:, 1:].ravel()
    bound = lower[:, :-1].ravel(), lower[:, 1:].ravel()
    gone = path.gone
    a, b = scene.separation.first[pair], scene.separation.second[pair]
    way = gone[a, after] - gone[a, before] + gone[b, after] - gone[b, before]
    margin = scene.margin
    reach = (bound[0] + bound[1] - way) / 2.0 - bulge
    open_ = np.flatnonzero(~(reach >= margin) & (after > before))
    normals = near.normal.reshape(3, *rows)
    least = np.full(len(open_), -np.inf)
    for side, (here, there) in ((0, (before, after)), (1, (after, before))):
        normal = normals[:, :, side : side + _BLOCK].reshape(3, -1)[:, open_]
        seen = _slab(scene, path, pair[open_], here[open_], there[open_], normal)
        np.maximum(least, np.minimum(bound[side][open_], seen), out=least)
    stretches: list[_Stretch] = []
    for k in open_[~(least - own_bulge[open_] >= margin)].tolist():
        ends = int(pair[k]), int(before[k]), int(after[k])
        stretch = _Stretch(*ends, float(bulge[k]), float(own_bulge[k]))
        last = stretches[-1] if stretches else None
        if last is not None and (last.pair, last.stop) == (stretch.pair, stretch.start):
            bulges = max(last.bulge, stretch.bulge), max(last.own_bulge, stretch.own_bulge)
            stretches[-1] = _Stretch(last.pair, last.start, stretch.stop, *bulges)
        else:
            stretches.append(stretch)
    return stretches


def _slab(
    scene: Scene, path: Path, pair: Indices, here: Indices, there: Indices, normal: Array
) -> Array:
    """Return how thick slabs (k,) of samples `here` are `there`, [m]."""
    carrier = scene.carrier[pair] + 1
    local = np.einsum("kij,ik->jk", path.frames.rotation[carrier, :, :, here], normal)
    turned = np.einsum("kij,jk->ik", path.frames.rotation[carrier, :, :, there], local)
    return scene.separation.along(path.bodies, pair, there, turned)


def _open_gaps(scene: Scene, path: Path, stretch: _Stretch, seen: _Seen) -> list[_Stretch] | Touch:
    """Return where one pair may touch between neighbouring samples, or a touch at one."""
    a, b = scene.indices(stretch.pair)
    margin = scene.margin
    gaps, stack = [], [(stretch.start, stretch.stop)]
    while stack:
        left, right = stack.pop()
        for sample in (left, right):
            if sample not in seen:
                seen[sample] = scene.distance(stretch.pair, path, sample), scene.normal(b)
            if not seen[sample][0] >= margin:
                return Touch(stretch.pair, sample, seen[sample][0])
        way = path.gone[a, right] - path.gone[a, left]
        way += path.gone[b, right] - path.gone[b, left]
        if (seen[left][0] + seen[right][0] - way) / 2.0 - stretch.bulge >= margin:
            continue
        if right - left > 1:
            middle = (left + right) // 2
            stack += [(middle, right), (left, middle)]
            continue
        ends = np.array([left, right])
        normal = np.array([seen[left][1], seen[right][1]]).T
        pair = np.full(2, stretch.pair)
        own = scene.separation.along(path.bodies, pair, ends, normal)
        other = _slab(scene, path, pair, ends, ends[::-1], normal)
        if not np.max(np.minimum(own, other)) - stretch.own_bulge >= margin:
            gaps.append(stretch.gap(left))
    return gaps
