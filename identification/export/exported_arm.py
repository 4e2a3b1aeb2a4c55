"""The identified arm as exports to simulators need it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from identification.arrays import Array
from identification.export.friction_curve import equivalent_coulomb
from identification.model.elements import TorsionSpring
from identification.model.joint_ranges import JointRanges
from identification.model.pseudo_inertia import Body, body
from identification.model.robot import RobotModel


@dataclass(frozen=True, eq=False)
class ExportedArm:
    """An arm with physically consistent parameters."""

    urdf: str  # text that the model was created from
    model: RobotModel
    standard: Array  # consistent standard parameters (s,)
    values: Array  # the corresponding parameters (p,) of the model
    ranges: JointRanges  # limits of its joints
    # torque of each gear (n,) [N·m, N] at which friction that grows with it is written, see
    # :func:`identification.export.friction_curve.median_load`; None: zero
    load: Array | None = field(default=None)
    #: whether bodies that cannot exist are changed by MuJoCo, for nominal arms
    balanced: bool = False

    @property
    def written_load(self) -> Array:
        """The `load` (n,), zero if None."""
        return np.zeros(self.model.n_joints) if self.load is None else self.load

    @property
    def friction(self) -> tuple[dict[str, float], ...]:
        """Coefficients by symbol of each joint, then of each coupled motor.

        Coulomb friction includes friction caused by the `load`.
        """
        coefficients = self.values[self.model.friction_part]
        return equivalent_coulomb(self.model, coefficients, self.written_load)

    @property
    def bodies(self) -> tuple[Body, ...]:
        """Body that each joint moves, the payload included (n,)."""
        inertial = self.standard[self.model.layout.links].copy()
        if self.model.payload is not None:
            joint, carried = self.model.payload.carried_by(self.model.chain)
            inertial[joint] += carried
        return tuple(body(parameters) for parameters in inertial)

    @property
    def rotors(self) -> Array:
        """Inertia matrix of the rotors in joint coordinates (n, n)."""
        return self.model.layout.rotor_matrix(self.standard)

    def spring(self, joint: int) -> tuple[float, float]:
        """Return stiffness [N·m/rad] and rest angle [rad] of all torsion springs of a joint."""
        stiffness = moment = 0.0
        for placed in self.model.elements.placed:
            if placed.joint == joint and isinstance(placed.element, TorsionSpring):
                coefficients = self.values[self.model.element_part][placed.part]
                k = float(coefficients[0]) if len(coefficients) else placed.element.stiffness or 0.0
                stiffness = stiffness + k
                moment = moment + k * placed.element.rest
        return stiffness, moment / stiffness if stiffness else 0.0

    def link(self, joint: int) -> str:
        """Return the name of the link that a joint moves, different from every joint's."""
        name = self.model.chain.link(joint) or "link"
        return f"{name}_link" if name in self.model.joint_names else name

    def fixed(self, joint: int) -> dict[str, tuple[Array, Array]]:
        """Return axes (3, 3) and origin (3,) of the links fixed to a joint's link, by name."""
        names = {self.link(joint), *self.model.joint_names}
        return {
            name: (frame.rotation, frame.translation)
            for name, frame in self.model.chain.frames.items()
            if frame.joint == joint and name not in names
        }
