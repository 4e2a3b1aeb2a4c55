"""Where the frames and bodies of an arm are in many postures at once.

The samples stand last in every array, so that each step is one product of a small matrix with a
long one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.excitation.collision.bodies import Body
from identification.model.kinematics import Chain, skew

Array = NDArray[np.float64]


class Frames(NamedTuple):
    """Base and joint frames at m samples: axes (1 + n, 3, 3, m), origins (1 + n, 3, m) [m]."""

    rotation: Array
    translation: Array


class Bodies(NamedTuple):
    """Hulls of b bodies at m samples.

    Attributes:
        centre: (3, b, m) [m].
        axis: unit vectors (3, b, m).
    """

    centre: Array
    axis: Array


def frames(chain: Chain, q: Array) -> Frames:
    """Return base and joint frames at postures (m, n); Rodrigues' formula joint by joint."""
    m, n = q.shape
    rotation = np.empty((1 + n, 3, 3, m))
    translation = np.zeros((1 + n, 3, m))
    rotation[0] = np.eye(3)[:, :, None]
    sine, versine = np.sin(q.T), 1.0 - np.cos(q.T)
    for joint in range(n):
        before = rotation[chain.parents[joint] + 1]
        fixed = chain.rotation[joint]
        across = skew(chain.axis[joint])
        origin = translation[joint + 1]
        np.matmul(chain.translation[joint], before, out=origin)
        origin += translation[chain.parents[joint] + 1]
        turned = rotation[joint + 1]
        if chain.revolute[joint]:
            # before @ fixed @ (1 + sin K + (1 - cos) K²), its three terms by one product
            terms = np.concatenate((fixed, fixed @ across, fixed @ across @ across), axis=1).T
            placed = np.matmul(terms, before)
            np.multiply(placed[:, 3:6], sine[joint], out=turned)
            turned += placed[:, :3]
            placed[:, 6:] *= versine[joint]
            turned += placed[:, 6:]
        else:
            np.matmul(fixed.T, before, out=turned)
            origin += np.matmul(fixed @ chain.axis[joint], before) * q[:, joint]
    return Frames(rotation, translation)


def joint_poses(chain: Chain, q: Array) -> tuple[Array, Array]:
    """Return base and joint frames at postures (m, n): (1 + n, m, 3, 3), (1 + n, m, 3) [m]."""
    rotation, translation = frames(chain, q)
    return rotation.transpose(0, 3, 1, 2), translation.transpose(0, 2, 1)


def placed(bodies: Sequence[Body], at: Frames) -> Bodies:
    """Return where the hulls of bodies are, those that one joint moves next to each other."""
    m = at.translation.shape[2]
    centre, axis = np.empty((2, 3, len(bodies), m))
    start = 0
    while start < len(bodies):
        joint = bodies[start].joint
        stop = start
        while stop < len(bodies) and bodies[stop].joint == joint:
            stop += 1
        hulls = [body.hull for body in bodies[start:stop]]
        if joint < 0:
            centre[:, start:stop] = np.array([hull.centre for hull in hulls]).T[:, :, None]
            axis[:, start:stop] = np.array([hull.axis for hull in hulls]).T[:, :, None]
        else:
            rotation = at.rotation[joint + 1]
            where = np.array([hull.centre for hull in hulls])
            np.matmul(where, rotation, out=centre[:, start:stop])
            centre[:, start:stop] += at.translation[joint + 1][:, None]
            np.matmul(np.array([hull.axis for hull in hulls]), rotation, out=axis[:, start:stop])
        start = stop
    return Bodies(centre, axis)


def travel(bodies: Sequence[Body], at: Bodies, turning: Array) -> Array:
    """Bound how far any point of each body has gone since the first sample, (b, m) [m].

    From sample to sample in a straight line: a point of the hull goes with its centre, with its
    axis, and about that by the turning at most.

    Args:
        bodies: b bodies.
        at: where they are.
        turning: (1 + n, m - 1) how far base and links turn from sample to sample at most [rad].
    """
    half = np.array([body.hull.half_length for body in bodies])
    around = np.array([body.hull.radius + body.hull.ball for body in bodies])
    joints = np.array([body.joint + 1 for body in bodies])
    steps = _norm(np.diff(at.centre))
    steps += half[:, None] * _norm(np.diff(at.axis))
    steps += around[:, None] * turning[joints]
    gone = np.zeros(at.centre.shape[1:])
    np.cumsum(steps, axis=1, out=gone[:, 1:])
    return gone


def turning(chain: Chain, q: Array) -> Array:
    """Bound how far base and links turn between neighbouring postures (m, n), (1 + n, m - 1)."""
    turned = np.abs(np.diff(q, axis=0)).T * chain.revolute[:, None]
    total = np.zeros((1 + chain.n_joints, len(q) - 1))
    for joint in range(chain.n_joints):
        total[joint + 1] = total[chain.parents[joint] + 1] + turned[joint]
    return total


def _norm(vectors: Array) -> Array:
    x, y, z = vectors
    length: Array = np.sqrt(x * x + y * y + z * z)
    return length
