"""What may touch along a motion, and contacts between samples that are all clear.

A quick look at all pairs shows which are near (`Near`), a closer one whether they touch.

Two bodies are clear from one sample to the next if they cannot meet for the way they go, or if
one slab lies between them at both: their points leave straight lines by no more than is allowed
for. What that leaves open is divided.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.excitation.collision.scene import Path, Scene
from identification.excitation.collision.separation import Indices
from identification.excitation.joint_limits import rate_bounds
from identification.model.motion import Motion
from planner import FourierSeries, PiecewiseCubic

Array = NDArray[np.float64]

BLOCK: Final = 8
"""Samples between those at which all pairs are looked at."""


class Touch(NamedTuple):
    """A pair of bodies closer than the margin at a sample.

    Attributes:
        pair: of the scene.
        sample: of the motion that it was looked for in.
        distance: signed [m].
    """

    pair: int
    sample: int
    distance: float


class Near(NamedTuple):
    """Pairs (k,) and samples (k,) that may touch, with bounds (k,) [m] and directions (3, k).

    They come in rows of `BLOCK` + 1 samples one after the other, pair by pair. Between samples
    the two bodies leave straight lines by no more than `bulge` (2, rows) [m], seen from the base
    and from the frame that carries both.
    """

    pair: Indices
    sample: Indices
    lower: Array
    normal: Array
    bulge: Array


def bulges_of(scene: Scene, trajectory: PiecewiseCubic | FourierSeries, motion: Motion) -> Array:
    """Bound how far pairs leave straight lines in rows of `BLOCK` samples, (2, p, rows) [m].

    As seen from the base and from the frame that carries both bodies.

    Args:
        scene: the bodies.
        trajectory: the motion.
        motion: samples of it.
    """
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


def what_is_near(scene: Scene, path: Path, bulges: Array) -> Near:
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
    sample = np.minimum(starts[blocks][:, None] + np.arange(BLOCK + 1), last)
    return rows_of(scene, path, pairs, sample, bulge)


def rows_of(scene: Scene, path: Path, pairs: Indices, sample: Indices, bulge: Array) -> Near:
    """Return pairs (rows,) at samples (rows, `BLOCK` + 1)."""
    pair = np.repeat(pairs, BLOCK + 1)
    bound = scene.separation.bound(path.bodies, pair, sample.ravel())
    return Near(pair, sample.ravel(), *bound, bulge)


def _starts(samples: int) -> Indices:
    return np.arange(0, max(samples - 1, 1), BLOCK)


# What stays open between two samples is divided by BLOCK, so many times at most.
_DIVISIONS = 4
# A motion of which more stays open is not looked at any closer; motions that an arm can follow
# leave some dozens open.
_MOST_GAPS = 1000
# Distances that are computed at most before closer looking is given up: so many, or so many for
# each sample of a long motion.
_MOST_DISTANCES = 10_000
_MOST_PER_SAMPLE = 5


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
    bulge: float
    own_bulge: float

    def joined(self, other: _Stretch) -> _Stretch | None:
        """Return both together if the other one follows immediately."""
        if self.pair != other.pair or self.stop != other.start:
            return None
        bulges = max(self.bulge, other.bulge), max(self.own_bulge, other.own_bulge)
        return _Stretch(self.pair, self.start, other.stop, *bulges)

    def gap(self, left: int) -> _Stretch:
        """Return the part between one sample and the next."""
        return self._replace(start=left, stop=left + 1)


def touch_between(
    scene: Scene,
    trajectory: PiecewiseCubic | FourierSeries,
    motion: Motion,
    path: Path,
    near: Near,
) -> tuple[Touch, Motion] | None:
    """Return a touch between the samples, which are clear, and the samples that show it.

    Args:
        scene: the bodies.
        trajectory: the motion.
        motion: samples of it, both ends included.
        path: where the bodies are there.
        near: what may touch.
    """
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
        time = np.linspace(motion.time[left], motion.time[left + 1], BLOCK + 1, axis=1)
        motion = Motion(time.ravel(), *trajectory.sample(time.ravel()))
        path = scene.path(motion.position)
        bulge = np.array([(gap.bulge, gap.own_bulge) for gap in gaps]).T / BLOCK**2
        near = rows_of(scene, path, pairs, np.arange(time.size).reshape(time.shape), bulge)
    return (_untold(scene, gaps[0]), motion) if gaps else None


def _untold(scene: Scene, stretch: _Stretch) -> Touch:
    """Return what counts as a touch: too close to the margin to be determined, or too long."""
    return Touch(stretch.pair, stretch.start, float(np.nextafter(scene.margin, -1.0)))


def _open_stretches(scene: Scene, path: Path, near: Near) -> list[_Stretch]:
    """Return where neither the way that is gone nor a slab shows two bodies to be clear."""
    rows = (-1, BLOCK + 1)
    sample, lower = near.sample.reshape(rows), near.lower.reshape(rows)
    pair = near.pair.reshape(rows)[:, :-1].ravel()
    bulge, own_bulge = np.repeat(near.bulge, BLOCK, axis=1)
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
        normal = normals[:, :, side : side + BLOCK].reshape(3, -1)[:, open_]
        seen = _slab(scene, path, pair[open_], here[open_], there[open_], normal)
        np.maximum(least, np.minimum(bound[side][open_], seen), out=least)
    stretches: list[_Stretch] = []
    for k in open_[~(least - own_bulge[open_] >= margin)].tolist():
        ends = int(pair[k]), int(before[k]), int(after[k])
        stretch = _Stretch(*ends, float(bulge[k]), float(own_bulge[k]))
        joined = stretches[-1].joined(stretch) if stretches else None
        if joined is None:
            stretches.append(stretch)
        else:
            stretches[-1] = joined
    return stretches


def _slab(
    scene: Scene, path: Path, pair: Indices, here: Indices, there: Indices, normal: Array
) -> Array:
    """Return how thick slabs (k,) of samples `here` are `there`, [m].

    A slab's direction (3, k) goes with the frame that carries both bodies.
    """
    carrier = scene.carrier[pair] + 1
    local = np.einsum("kij,ik->jk", path.frames.rotation[carrier, :, :, here], normal)
    turned = np.einsum("kij,jk->ik", path.frames.rotation[carrier, :, :, there], local)
    return scene.separation.along(path.bodies, pair, there, turned)


def _open_gaps(scene: Scene, path: Path, stretch: _Stretch, seen: _Seen) -> list[_Stretch] | Touch:
    """Return where one pair may touch between neighbouring samples, or a touch at one.

    Divides the stretch until the bodies cannot meet for the way they go, or for the slab
    that lies between them at both ends. Every distance it computes is left in `seen`.
    """
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
