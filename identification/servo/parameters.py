r"""Parameters of a joint that a position servo drives, and what is known of them before a fit.

.. math::
    \tau_m &= \mathrm{sat}(k_p\,\mathrm{dz}(s + o - q) + k_d (\dot s - \dot q)) \\
    I_a \ddot q + \tau_{bodies} &= \tau_m - f_1 \dot q - F \mathrm{sign}(\dot q)\\
    F &= f_0 + f_s e^{-(\dot q / v_s)^2} + \mu |\tau_{bodies}|

The set-point :math:`s` follows the command :math:`q_c(t-d)`, with limited acceleration where the
servo plans its way to each command, as bus servos do.

A fit works with every torque divided by :math:`k_p`, that is with position errors of the servo:
positions show these, and only gravity and the inertia of the bodies show the torque itself.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array


class Term(NamedTuple):
    """A parameter of each joint.

    Attributes:
        name: as results name it.
        unit, unit_along: of a joint that turns, of one that slides.
        torque: power of `kp` in it: 1 for torques, -1 for the compliance, 0 for what is none.
        positive: whether its logarithm is fitted.
        spread: standard deviation of the prior, of the logarithm if `positive`.
        always: whether it is in every model; others are in if they predict better.
    """

    name: str
    unit: str
    unit_along: str
    torque: int
    positive: bool
    spread: float
    always: bool


TERMS: Final = (
    Term("kp", "N·m/rad", "N/m", -1, True, 1.0, True),
    Term("armature", "kg·m²", "kg", 1, True, 2.0, True),
    Term("viscous", "N·m·s/rad", "N·s/m", 1, True, 2.0, True),
    Term("coulomb", "N·m", "N", 1, True, 1.5, True),
    Term("delay", "s", "s", 0, False, 0.003, True),
    Term("offset", "rad", "m", 0, False, 0.02, True),
    Term("load", "-", "-", 0, True, 1.5, False),
    Term("static", "N·m", "N", 1, True, 1.5, False),
    Term("speed", "rad/s", "m/s", 0, True, 1.0, False),
    Term("kd", "N·m·s/rad", "N·s/m", 1, True, 2.0, False),
    Term("limit", "N·m", "N", 1, True, 1.5, False),
    Term("dead_band", "rad", "m", 0, True, 1.5, False),
    Term("acceleration", "rad/s²", "m/s²", 0, True, 1.5, False),
)
"""Parameters of a joint, in the order of a row of :class:`Coordinates`."""
NAMES: Final = tuple(term.name for term in TERMS)
PLACE: Final = {name: place for place, name in enumerate(NAMES)}
OPTIONAL: Final = (
    *(("load",), ("static", "speed"), ("limit",), ("kd",), ("dead_band",)),
    ("acceleration",),
)
"""Terms that are chosen together, by prediction."""
POSITIVE: Final = np.array([term.positive for term in TERMS])
BUS_DELAY_SPREAD: Final = 0.03  # s, about zero: half of a normal distribution
ABSENT: Final = {"limit": np.inf, "speed": 1.0, "acceleration": np.inf}
"""Values of terms that are not in a model, where that is not zero."""


def natural(coordinates: Array) -> Array:
    """Return values without their unit of torque (..., P) of coordinates: logarithms undone."""
    return np.where(POSITIVE, np.exp(np.where(POSITIVE, coordinates, 0.0)), coordinates)


def without_absent(values: Array, present: NDArray[np.bool_]) -> Array:
    """Return values (..., n, P) in which absent terms have no effect."""
    absent = np.array([ABSENT.get(name, 0.0) for name in NAMES])
    return np.where(present, values, absent)


def in_units(values: Array) -> Array:
    """Return values (..., P) in SI units of values in position errors of the servo."""
    kp = 1.0 / values[..., :1]
    power = np.array([term.torque for term in TERMS])
    return np.where(power == 1, values * kp, np.where(power == -1, kp, values))


def in_errors(values: Array) -> Array:
    """Return values (..., P) in position errors of the servo, the inverse of `in_units`."""
    kp = values[..., :1]
    power = np.array([term.torque for term in TERMS])
    return np.where(power == 1, values / kp, np.where(power == -1, 1.0 / kp, values))
