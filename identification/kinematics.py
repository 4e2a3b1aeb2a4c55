"""The chain of joints, read from a URDF.

Every link is described in the frame of its own joint: origin on the joint axis, axes moving
with the link. Joints are numbered depth first, so a parent comes before its children.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from identification.errors import ModelError

Array = NDArray[np.float64]

# Where our ten parameters stand in pinocchio's order m, mcx, mcy, mcz, Ixx, Ixy, Iyy, Ixz, ...
FROM_PINOCCHIO = (4, 5, 7, 6, 8, 9, 1, 2, 3, 0)


@dataclass(frozen=True, eq=False)
class Chain:
    """A tree of n revolute and prismatic joints on a fixed base.

    Attributes:
        joint_names: n names, depth first.
        parents: index of the parent joint, -1 for the base, shape (n,).
        rotation: axes of joint frame i at q = 0 in its parent's frame, shape (n, 3, 3).
        translation: origin of joint frame i in its parent's frame [m], shape (n, 3).
        axis: unit joint axis in the joint's own frame, shape (n, 3).
        revolute: False where the joint is prismatic, shape (n,).
        inertial: the ten parameters per link (:data:`identification.wrench.LINK_SYMBOLS`) about
            the joint frame's origin in its axes, as the description gives them (the nominal, CAD
            values), shape (n, 10).
    """

    joint_names: tuple[str, ...]
    parents: NDArray[np.intp]
    rotation: Array
    translation: Array
    axis: Array
    revolute: NDArray[np.bool_]
    inertial: Array

    @property
    def n_joints(self) -> int:
        """Number n of joints."""
        return len(self.joint_names)

    def ancestors(self, joint: int) -> tuple[int, ...]:
        """Return the joints that move link `joint`, from the base to the joint itself."""
        path = [joint]
        while (parent := int(self.parents[path[-1]])) >= 0:
            path.append(parent)
        return tuple(reversed(path))


def chain_from_urdf(urdf: str) -> Chain:
    """Read a chain from URDF text; fixed joints are merged into the link they sit on.

    Raises:
        ModelError: the text is no URDF, has no moving joint, or has a joint that is neither
            revolute (or continuous) nor prismatic; the message names the joint.
    """
    try:
        model = pin.buildModelFromXML(urdf)
    except (ValueError, RuntimeError) as error:
        raise ModelError(f"the robot description is not a readable URDF: {error}") from error
    if model.njoints < 2:
        raise ModelError("the robot description has no revolute or prismatic joint")
    indices = range(1, model.njoints)
    axes, revolute = zip(*(_axis(model, i) for i in indices), strict=True)
    return Chain(
        joint_names=tuple(model.names[i] for i in indices),
        parents=np.array([model.parents[i] - 1 for i in indices], dtype=np.intp),
        rotation=np.array([model.jointPlacements[i].rotation for i in indices]),
        translation=np.array([model.jointPlacements[i].translation for i in indices]),
        axis=np.array(axes),
        revolute=np.array(revolute, dtype=np.bool_),
        inertial=np.array(
            [model.inertias[i].toDynamicParameters()[list(FROM_PINOCCHIO)] for i in indices]
        ),
    )


def _axis(model: pin.Model, index: int) -> tuple[Array, bool]:
    """Return the joint axis in the joint frame, and whether the joint turns about it."""
    joint = model.joints[index]
    kind = joint.shortname()
    name = model.names[index]
    if joint.nv != 1 or not kind.startswith(("JointModelR", "JointModelP")):
        raise ModelError(
            f"joint {name!r} is of type {kind.removeprefix('JointModel')}; "
            "only revolute, continuous, prismatic and fixed joints can be identified",
            joint=name,
        )
    data = joint.createData()
    joint.calc(data, pin.neutral(model))
    subspace = np.asarray(data.S, dtype=np.float64).reshape(6)
    linear, angular = subspace[:3], subspace[3:]
    revolute = bool(np.any(angular))
    return (angular if revolute else linear).copy(), revolute


def skew(vector: Array) -> Array:
    """Return the (3, 3) matrix of ``vector x``."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
