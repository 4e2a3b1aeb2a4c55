"""Signs of all joints together, and the arms that are mirror images of one another.

A chain of joints that a reflection of space maps onto itself moves alike with the positions and
torques of some joints negated and bodies reflected: of a planar arm, of all joints. Gravity must be
the same after it. Only the masses of the description may tell the two apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Final, NamedTuple

import numpy as np

from identification.arrays import Array
from identification.hypotheses.joint_changes import SIGNS, Axes, Change
from identification.model.kinematics import Chain

# Joints that are wrong one by one: of an explanation that needs more the recording is improbable.
_MAX_WRONG_JOINTS: Final = 3
_PARALLEL: Final = 0.9  # cosine of the angle between an axis and its image


class Signs(NamedTuple):
    """Signs that multiply recorded positions and torques of n joints."""

    position: Array  # (n,)
    torque: Array  # (n,)

    @classmethod
    def of(cls, axes: Axes) -> Signs:
        """Return the signs of axes."""
        return cls(axes.position_sign, axes.torque_sign)

    def flipped(self, joints: Sequence[int]) -> Signs:
        """Return them with positions and torques of joints negated."""
        sign = np.ones(len(self.position))
        sign[list(joints)] = -1.0
        return Signs(self.position * sign, self.torque * sign)

    @property
    def changes(self) -> tuple[Change, ...]:
        """One change for each joint that is negated, or for all if they are alike."""
        n = len(self.position)
        negated = {
            "axis sign": (self.position < 0.0) & (self.torque < 0.0),
            "torque sign": (self.position > 0.0) & (self.torque < 0.0),
            "position sign": (self.position < 0.0) & (self.torque > 0.0),
        }
        changes = []
        for meaning in SIGNS:
            joints = np.flatnonzero(negated[meaning]).tolist()
            if n > 1 and len(joints) == n:
                return (Change(meaning, tuple(joints)),)
            changes += [Change(meaning, (joint,)) for joint in joints]
        return tuple(sorted(changes, key=lambda change: change.joints))

    def agrees(self, other: Signs, joints: Sequence[int]) -> bool:
        """Return whether joints have the same signs in another explanation."""
        at = list(joints)
        return bool(
            np.array_equal(self.position[at], other.position[at])
            and np.array_equal(self.torque[at], other.torque[at])
        )

    @property
    def is_probable(self) -> bool:
        """Whether few joints are negated, or all of them alike, from one cause."""
        return len(self.changes) <= _MAX_WRONG_JOINTS


class SignRival(NamedTuple):
    """Signs that explain a recording as well as those that were found.

    Attributes:
        signs: of all joints.
        flipped: joints whose position and torque have the other sign than was found.
        error: over all joints, as a share of the torque.
    """

    signs: Signs
    flipped: tuple[int, ...]
    error: float


def mirror_images(chain: Chain, gravity: Array) -> tuple[tuple[int, ...], ...]:
    """Return the sets of joints that a mirror image of an arm negates together.

    By the directions of its axes at zero: whether lengths and masses allow it, a recording says.

    Args:
        chain: joints of the arm.
        gravity: in the base frame (3,) [m/s²].
    """
    frame = _frame(chain, gravity)
    found = []
    for signs in product((1.0, -1.0), repeat=3):
        image = frame @ np.diag(signs) @ frame.T
        if np.allclose(image @ gravity, gravity) and (joints := _negated(chain, image)):
            found.append(joints)
    return tuple(dict.fromkeys(found))


def _frame(chain: Chain, gravity: Array) -> Array:
    """Return directions of the base (3, 3), columns: the first axis, and one across to it."""
    rotations = np.empty((chain.n_joints, 3, 3))
    for joint, parent in enumerate(chain.parents):
        above = np.eye(3) if parent < 0 else rotations[parent]
        rotations[joint] = above @ chain.rotation[joint]
    axes = np.einsum("jik,jk->ji", rotations, chain.axis)
    first = axes[0]
    across = [each - first * (first @ each) for each in (gravity, *axes[1:], *np.eye(3))]
    lengths = [float(np.linalg.norm(each)) for each in across]
    scales = [max(float(np.linalg.norm(gravity)), 1.0), *[1.0] * (len(across) - 1)]
    second = next(
        each / length
        for each, length, scale in zip(across, lengths, scales, strict=True)
        if length > 0.1 * scale
    )
    return np.column_stack([first, second, np.cross(first, second)])


def _negated(chain: Chain, image: Array) -> tuple[int, ...]:
    """Return the joints that an image of the base negates; none if it is not one of the chain."""
    handedness = float(np.linalg.det(image))
    images = np.empty((chain.n_joints, 3, 3))
    joints = []
    for joint, parent in enumerate(chain.parents):
        rotation = chain.rotation[joint]
        images[joint] = rotation.T @ (image if parent < 0 else images[parent]) @ rotation
        along = float(chain.axis[joint] @ images[joint] @ chain.axis[joint])
        if abs(along) < _PARALLEL:
            return ()
        if (handedness if chain.revolute[joint] else 1.0) * along < 0.0:
            joints.append(joint)
    return tuple(joints)
