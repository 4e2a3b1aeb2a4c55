"""What a real arm does and the estimator does not model; each effect is off unless asked for.

| effect | default size | what it is |
|---|---|---|
| torque ripple | 0.10 | a torque of this share of the Coulomb torque, twice per motor turn |
| friction drift | 0.08 | friction falls by this share from a cold joint to one that keeps moving |
| elasticity | 0.5e-6, 0.5e-6, 1.25e-6 rad/(N m) on axes 1-3 | a spring between gear and link |
| delay | 0.5 ms | later effect of the target current, beyond the modelled lag |

On a fast motion of the NS 16 at these sizes, the torque of the true rigid model at the measured
positions misses the converted current (both low-passed at 30 Hz) by about: ripple 1-2 %, drift
1-4 % (a cold arm), elasticity 1.5 % on axis 1, delay under 0.3 %. The springs are at the stiff end
of what precision gears of this size have (580 and 230 N m per arc minute).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite, pi

import numpy as np
from numpy.typing import NDArray

from sim_fixtures.errors import SettingError

Array = NDArray[np.float64]

RIPPLES_PER_TURN = 2
WARM_UP_TIME = 600.0
"""Time constant of the friction drift [s]."""
WARM_SPEED = 0.5
"""Mean speed that warms a joint up half the way [rad/s]."""


@dataclass(frozen=True)
class UnmodelledEffects:
    """Sizes of the unmodelled effects; all zero is none.

    Attributes:
        torque_ripple: amplitude at the joint, as a share of the joint's Coulomb torque.
        friction_drift: relative fall of all friction between cold and hot. The planted friction
            is that of a joint that is half warm; a run starts cold.
        elasticity: compliance of each gear [rad/(N m)], (n,) or empty; 0 is rigid.
        delay: s, rounded to the plant's sub-steps.
    """

    torque_ripple: float = 0.0
    friction_drift: float = 0.0
    elasticity: tuple[float, ...] = ()
    delay: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "elasticity", tuple(float(c) for c in self.elasticity))
        sizes = (self.torque_ripple, self.friction_drift, self.delay, *self.elasticity)
        if not all(isfinite(size) and size >= 0.0 for size in sizes):
            raise SettingError("effects", sizes, "finite and not negative")
        if self.friction_drift >= 1.0:
            raise SettingError("friction_drift", self.friction_drift, "below 1")

    @classmethod
    def default_sizes(cls, n_joints: int) -> UnmodelledEffects:
        """Return all effects at their documented default sizes."""
        elasticity = (0.5e-6, 0.5e-6, 1.25e-6)[:n_joints]
        return cls(
            torque_ripple=0.10,
            friction_drift=0.08,
            elasticity=elasticity + (0.0,) * (n_joints - len(elasticity)),
            delay=0.0005,
        )

    @property
    def is_elastic(self) -> bool:
        """Whether any gear gives."""
        return any(self.elasticity)


class TorqueRipple:
    """A torque that comes and goes with the turning of each motor."""

    def __init__(self, amplitude: Array, rng: np.random.Generator) -> None:
        """Draw the phases; `amplitude` (n,) [N m] on the joint side."""
        self._amplitude = amplitude
        self._phase = rng.uniform(0.0, 2.0 * pi, size=amplitude.size)

    def torque(self, motor_revolutions: Sequence[float]) -> Array:
        """Return the joint torques (n,) [N m] at motor positions (n,)."""
        angle = (2.0 * pi * RIPPLES_PER_TURN) * np.array(motor_revolutions)
        torque: Array = self._amplitude * np.sin(angle + self._phase)
        return torque


class FrictionDrift:
    """Friction of joints that warm up by moving and cool down at rest."""

    def __init__(self, drift: float, n_joints: int) -> None:
        """Start cold; `drift` is the relative fall from cold to hot."""
        self._drift = drift
        self._warmth = np.zeros(n_joints)

    def scale(self, velocity: Array, duration: float) -> Array:
        """Return the factor on the friction (n,) after `duration` [s] at a velocity."""
        speed = np.abs(velocity)
        aim = speed / (speed + WARM_SPEED)
        self._warmth += (duration / WARM_UP_TIME) * (aim - self._warmth)
        factor: Array = 1.0 + self._drift * (0.5 - self._warmth)
        return factor
