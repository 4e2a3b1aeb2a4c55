"""Friction that only takes energy, as non-negative combinations of its coefficients."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.joint_friction import JointFriction

Array = NDArray[np.float64]

_NEVER_NEGATIVE = ("f0", "f1", "fd", "fs")


class Dissipation(NamedTuple):
    """Coefficients ``f = combine @ g``, of which some g may not be negative.

    Attributes:
        combine: (k, k), invertible.
        not_negative: which of the g (k,).
    """

    combine: Array
    not_negative: NDArray[np.bool_]


def dissipation(friction: JointFriction) -> Dissipation:
    """Return what friction needs to take energy in either direction and at low speed.

    - Coulomb friction f0, and with a Stribeck term its value at rest f0 + fs;
    - viscous friction, by direction f1 + fd and f1 - fd where it is asymmetric.

    Signs of the third term and of the offset, which may be a sensor's, are left open.
    """
    place = {(t.motor, t.owner, t.symbol): k for k, t in enumerate(friction.terms)}
    combine = np.eye(len(place))
    for (motor, index, symbol), k in place.items():
        if symbol == "fd":
            viscous = place[motor, index, "f1"]
            combine[np.ix_([viscous, k], [viscous, k])] = [[0.5, 0.5], [0.5, -0.5]]
        if symbol == "fs" and (motor, index, "f0") in place:
            combine[k, place[motor, index, "f0"]] = -1.0
    kinds = [term.symbol in _NEVER_NEGATIVE for term in friction.terms]
    return Dissipation(combine, np.array(kinds, dtype=np.bool_))
