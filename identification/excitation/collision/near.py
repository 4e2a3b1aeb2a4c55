"""What may touch along a motion: a quick look at all pairs, a closer one where they are near."""

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
    bounds = rate_bounds(trajectory, motion.time[starts], motion.time[ends])

    def largest(rate: Array, change: Array) -> Array:
        size = np.abs(rate.T)
        seen = np.maximum(np.maximum.reduceat(size, starts, axis=1), size[:, ends])
        found: Array = seen + change * (step / 2.0)
        return found

    velocity = largest(motion.velocity, bounds.acceleration)
    acceleration = largest(motion.acceleration, bounds.jerk)
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
