"""The dynamic model inside the simulated controller: the maker's figures, a little wrong."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from sim_fixtures.plant import build_model, scale_bodies
from sim_fixtures.truth import PlantTruth

Array = NDArray[np.float64]

COULOMB_SPEED = 0.02
"""Speed over which the model's Coulomb torque turns its sign [rad/s]."""


class NominalModel:
    """Inverse dynamics with link inertias, rotors and friction off by a few per cent.

    A link's mass, first moment and tensor are scaled together, so that it stays a possible body.
    """

    def __init__(
        self,
        urdf: str,
        truth: PlantTruth,
        *,
        gravity: ArrayLike,
        error: tuple[float, float],
        rng: np.random.Generator,
    ) -> None:
        """Draw the errors.

        Args:
            urdf: URDF text of the arm.
            truth: its rotor inertias and friction, and how far its links are those of the URDF.
            gravity: m/s2 in the base frame.
            error: smallest and largest relative error of each figure.
            rng: where magnitudes and signs of the errors come from.
        """
        n = truth.n_joints

        def factors() -> Array:
            signs: Array = rng.choice((-1.0, 1.0), size=n)
            return 1.0 + rng.uniform(*error, size=n) * signs

        self.rotor_inertia = truth.rotor_inertia * factors()
        self._model = build_model(urdf, gravity, self.rotor_inertia, truth.inertia_scale)
        scale_bodies(self._model, factors())
        self._data = self._model.createData()
        self._coulomb = truth.coulomb * factors()
        self._viscous = truth.viscous * factors()

    def torque(self, q: Array, qd: Array, qdd: Array) -> Array:
        """Return the joint torques (n,) [N m] that a motion should take."""
        torque: Array = pin.rnea(self._model, self._data, q, qd, qdd) + self._viscous * qd
        torque += self._coulomb * np.tanh(qd * (1.0 / COULOMB_SPEED))
        return torque

    def diagonal_inertia(self, q: Array) -> Array:
        """Return the diagonal of the joint-space inertia matrix (n,) [kg m2], rotors included."""
        diagonal: Array = pin.crba(self._model, self._data, q).diagonal()
        return diagonal
