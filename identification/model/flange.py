"""The flange of an arm: the last link of the description that its last joint moves."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from identification.arrays import Array
from identification.model.kinematics import Chain, skew


class FlangeMotion(NamedTuple):
    """Origin of the flange at m postures, and how fast it moves with the joints."""

    position: Array  # in base axes (m, 3) [m]
    jacobian: Array  # velocity of the origin by joint velocities (m, 3, n) [m/rad or 1]


def flange_name(chain: Chain) -> str:
    """Return the link's name, or without a link of its own the last joint's."""
    last = chain.last_joint
    names = [name for name, frame in chain.frames.items() if frame.joint == last]
    return names[-1] if names else chain.joint_names[last]


def flange_motion(chain: Chain, position: Array) -> FlangeMotion:
    """Return the flange at joint positions (m, n) [rad or m]."""
    count, n = position.shape
    rotation = np.broadcast_to(np.eye(3), (count, 3, 3))
    origin = np.zeros((count, 3))
    axes = np.zeros((n, count, 3))
    origins = np.zeros((n, count, 3))
    moving = chain.ancestors(chain.last_joint)
    for joint in moving:
        axis = chain.axis[joint]
        origin = origin + rotation @ chain.translation[joint]
        rotation = rotation @ chain.rotation[joint]
        axes[joint] = rotation @ axis
        if chain.revolute[joint]:
            origins[joint] = origin
            rotation = rotation @ _turned(axis, position[:, joint])
        else:
            origin = origin + axes[joint] * position[:, joint, None]
    name = flange_name(chain)
    place = chain.frame(name if name in chain.frames else None).translation
    origin = origin + rotation @ place
    jacobian = np.zeros((count, 3, n))
    for joint in moving:
        arm = origin - origins[joint]
        turns = chain.revolute[joint]
        jacobian[:, :, joint] = np.cross(axes[joint], arm) if turns else axes[joint]
    return FlangeMotion(origin, jacobian)


def _turned(axis: Array, angle: Array) -> Array:
    """Return rotations (m, 3, 3) by angles (m,) [rad] about a unit axis (Rodrigues)."""
    cross = skew(axis)
    sine = np.sin(angle)[:, None, None]
    versine = (1.0 - np.cos(angle))[:, None, None]
    return np.asarray(np.eye(3) + sine * cross + versine * (cross @ cross))
