"""A payload with known mass properties, and its torque."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from identification.arrays import Array
from identification.errors import ModelError
from identification.model.kinematics import Chain
from identification.model.link_wrenches import N_INERTIA, N_LINK
from identification.model.motion import Motion
from identification.model.pseudo_inertia import Body, inertial_parameters, tensors
from identification.model.regressor import RegressorPlan

_INERTIA_ROUNDING = 1e-9  # relative to the largest principal moment
_MAX_MAGNITUDE = 1e9  # kg, m, kg·m²; products of larger numbers could overflow


@dataclass(frozen=True)
class Payload:
    """A body with known mass properties.

    Raises:
        ModelError: a negative mass, or a figure that is not finite or beyond 1e9.
    """

    mass: float  #: [kg]
    centre: tuple[float, float, float]  #: centre of mass in the frame (3,) [m]
    #: tensor about the centre of mass in the axes of the frame: xx, xy, xz, yy, yz, zz [kg·m²]
    inertia: tuple[float, float, float, float, float, float] = (0.0,) * 6
    #: link of the robot description, such as "tool0"; None: frame of the last joint
    frame: str | None = None

    def __post_init__(self) -> None:
        if not 0.0 <= self.mass <= _MAX_MAGNITUDE:
            raise ModelError(f"the payload weighs {self.mass!r} kg; give its mass, zero or more")
        if not all(abs(value) <= _MAX_MAGNITUDE for value in (*self.centre, *self.inertia)):
            raise ModelError(
                "the payload's centre or inertia has a number that is not finite or beyond"
                f" {_MAX_MAGNITUDE:g}"
            )

    @property
    def tensor(self) -> Array:
        """Inertia tensor about the centre of mass, in the axes of the frame (3, 3) [kg·m²]."""
        return tensors(np.array(self.inertia))

    @property
    def possible(self) -> bool:
        """Whether the inertia is physically consistent.

        Principal moments are not negative, and none exceeds the sum of the others.
        """
        least, middle, most = np.linalg.eigvalsh(self.tensor)
        return bool(
            least >= -_INERTIA_ROUNDING * most
            and most <= (1.0 + _INERTIA_ROUNDING) * (least + middle)
        )

    @property
    def parameters(self) -> Array:
        """Inertial parameters about the frame's origin, in its axes (10,); `LINK_SYMBOLS`."""
        return inertial_parameters(Body(self.mass, np.array(self.centre), self.tensor))

    def carried_by(self, chain: Chain) -> tuple[int, Array]:
        """Return the joint that carries it, from 0, and its parameters in that joint's frame (10,).

        Raises:
            ModelError: the description has no such link, or it is fixed to the base.
        """
        joint, rotation, translation = chain.frame(self.frame)
        centre = rotation @ np.array(self.centre) + translation
        tensor = rotation @ self.tensor @ rotation.T
        return joint, inertial_parameters(Body(self.mass, centre, tensor))


class Load:
    """Torque of a payload on a chain; gravity (3,) [m/s²] in base axes.

    Raises:
        ModelError: the payload's frame is not a moving link of the robot.
    """

    def __init__(self, chain: Chain, gravity: Array, payload: Payload) -> None:
        self.joint, self.parameters = payload.carried_by(chain)
        self._plan = RegressorPlan.of_bodies(chain, gravity, self.joint)

    def torque(self, motion: Motion) -> Array:
        """Return the joint torques (m, n) [N·m or N] that the payload requires.

        Raises:
            ShapeError: a motion of another arm.
        """
        return self._plan.torque(self.parameters, motion.checked(self._plan.chain.n_joints))

    def moment_columns(self, motion: Motion) -> tuple[Array, ...]:
        """Return the torque of each joint (m, 6) per moment of inertia [N·m or N per kg·m²].

        Moments in the axes of the joint that carries it, in the order of `LINK_SYMBOLS`.

        Raises:
            ShapeError: a motion of another arm.
        """
        blocks, columns = self._plan.evaluate(motion.checked(self._plan.chain.n_joints))
        full = [np.zeros((motion.n_samples, N_LINK)) for _ in blocks]
        for target, block, present in zip(full, blocks, columns, strict=True):
            target[:, present] = block
        return tuple(target[:, :N_INERTIA] for target in full)
