"""What is planted in the simulated plant: rotors, friction and inertias of links."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from sim_fixtures.errors import SettingError

Array = NDArray[np.float64]
_TENSOR_KEYS = ("xx", "xy", "yy", "xz", "yz", "zz")


@dataclass(frozen=True, eq=False)
class PlantTruth:
    """Rotor inertias, friction and inertias of links; every array (n,), on the joint side.

    Friction torque: coulomb sgn(qd) + viscous qd + third sgn(qd) qd^2 (or third qd^3).

    Attributes:
        rotor_inertia: kg m2.
        coulomb: N m.
        viscous: N m s/rad.
        third: N m s2/rad2 ("quadratic") or N m s3/rad3 ("cubic").
        third_law: which of the two.
        inertia_scale: mass, first moment and tensor of what each joint moves, over those of the
            URDF; (1,) for the same of all joints. Scaled alike, a possible body stays one.

    Raises:
        SettingError: arrays of different sizes, non-finite or (all but `third`) negative values,
            a scale that is not positive.
    """

    rotor_inertia: Array
    coulomb: Array
    viscous: Array
    third: Array
    third_law: Literal["quadratic", "cubic"] = "quadratic"
    inertia_scale: Array = field(default_factory=lambda: np.ones(1))
    _has_third: bool = field(init=False, repr=False, default=False)

    def __post_init__(self) -> None:
        n = np.size(self.rotor_inertia)
        if np.size(self.inertia_scale) == 1:
            object.__setattr__(self, "inertia_scale", np.full(n, self.inertia_scale))
        for name in ("rotor_inertia", "coulomb", "viscous", "third", "inertia_scale"):
            values = np.array(getattr(self, name), dtype=np.float64)
            if values.shape != (n,) or not np.isfinite(values).all():
                raise SettingError(name, values.tolist(), f"{n} finite numbers, one per joint")
            if name != "third" and values.min(initial=0.0) < 0.0:
                raise SettingError(name, values.tolist(), "not negative")
            if name == "inertia_scale" and not values.all():
                raise SettingError(name, values.tolist(), "greater than zero")
            values.setflags(write=False)
            object.__setattr__(self, name, values)
        object.__setattr__(self, "_has_third", bool(self.third.any()))

    @classmethod
    def frictionless(cls, rotor_inertia: ArrayLike) -> PlantTruth:
        """Return a truth without friction."""
        rotors = np.asarray(rotor_inertia, dtype=np.float64)
        zero = np.zeros_like(rotors)
        return cls(rotors, zero, zero, zero)

    @property
    def n_joints(self) -> int:
        """Number of joints."""
        return self.rotor_inertia.size

    def friction(self, velocity: ArrayLike) -> Array:
        """Return the friction torque [N m] at joint velocities (..., n); 0 at standstill."""
        v = np.asarray(velocity, dtype=np.float64)
        return self.coulomb * np.sign(v) + self.smooth_friction(v)

    def smooth_friction(self, velocity: Array) -> Array:
        """Return the part of the friction torque that vanishes with the velocity."""
        factor = self.viscous
        if self._has_third:
            shape = np.abs(velocity) if self.third_law == "quadratic" else velocity * velocity
            factor = factor + self.third * shape
        smooth: Array = factor * velocity
        return smooth


def standard_parameters(model: pin.Model, rotor_inertia: ArrayLike) -> dict[str, float]:
    """Return a model's standard parameters by name: m1, mc1x ..., I1xx ... I1zz, then I1m ....

    First moments [kg m] and tensors [kg m2] are about the origin of the joint frame, in its axes.
    """
    named: dict[str, float] = {}
    for i in range(1, model.njoints):
        values = model.inertias[i].toDynamicParameters()
        keys = [f"m{i}", *(f"mc{i}{a}" for a in "xyz"), *(f"I{i}{k}" for k in _TENSOR_KEYS)]
        named |= {key: float(value) for key, value in zip(keys, values, strict=True)}
    rotors = np.asarray(rotor_inertia, dtype=np.float64)
    named |= {f"I{i}m": float(value) for i, value in enumerate(rotors, start=1)}
    return named
