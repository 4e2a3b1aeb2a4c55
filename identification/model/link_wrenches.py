r"""Wrenches of a link, which are linear in its ten inertial parameters.

About the origin of the link's frame, in its axes (omega, alpha: angular velocity and acceleration;
a: acceleration of the origin minus gravity):

.. math:: n = I\alpha + \omega\times I\omega + mc\times a, \qquad
          f = m a + \alpha\times mc + \omega\times(\omega\times mc)

Every entry is a sum, with signs, of twelve quantities per sample, the *primitives*: the three
components of a, of alpha, of the squares :math:`\omega_x^2, \omega_y^2, \omega_z^2`, and of the
products :math:`\omega_y\omega_z, \omega_z\omega_x, \omega_x\omega_y`. The wrenches are a constant
matrix times the primitives.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from identification.arrays import Array

# Order of the ten inertial parameters of a link.
LINK_SYMBOLS = ("Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz", "mcx", "mcy", "mcz", "m")
N_LINK: Final = len(LINK_SYMBOLS)
MASS_INDEX: Final = LINK_SYMBOLS.index("m")
N_INERTIA = 6
N_PRIMITIVES = 12

# moments of inertia do not need the accelerations, which come first
_ACCELERATION_COLUMN = 0
_ALPHA_COLUMN = 3
_SQUARE_COLUMN = 6
_PRODUCT_COLUMN = 9
ROTATIONAL_COLUMNS = slice(_ALPHA_COLUMN, N_PRIMITIVES)
_TENSOR_INDICES = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def _wrench_matrix(symbol: int) -> Array:
    """Return the matrix (6, 12) of one of `LINK_SYMBOLS`, see `WRENCH_MATRICES`."""
    matrix = np.zeros((6, N_PRIMITIVES))
    if symbol < N_INERTIA:
        _add_inertia(matrix[:3], *_TENSOR_INDICES[symbol])
    elif symbol < N_INERTIA + 3:
        _add_first_moment(matrix[:3], matrix[3:], symbol - N_INERTIA)
    else:
        matrix[3:, _ACCELERATION_COLUMN : _ACCELERATION_COLUMN + 3] = np.eye(3)
    return matrix


def write_primitives(motion: Array, out: Array) -> None:
    """Compute primitives (n, 12, k) of all links from velocity and acceleration (n, 2, 2, 3, k)."""
    omega = motion[:, 0, 0]
    speed = motion[:, 0, 1]
    out[:, _ALPHA_COLUMN : _ALPHA_COLUMN + 3] = motion[:, 1, 0]
    np.multiply(omega, omega, out=out[:, _SQUARE_COLUMN : _SQUARE_COLUMN + 3])
    for c in range(3):
        a = (c + 1) % 3
        b = (c + 2) % 3
        np.multiply(omega[:, a], omega[:, b], out=out[:, _PRODUCT_COLUMN + c])
        # The origin's acceleration is the spatial one + omega x v.
        acceleration = out[:, _ACCELERATION_COLUMN + c]
        np.multiply(omega[:, a], speed[:, b], out=acceleration)
        acceleration -= omega[:, b] * speed[:, a]
        acceleration += motion[:, 1, 1, c]


def _product(a: int, b: int) -> int:
    """Return the primitive omega_a omega_b."""
    return _SQUARE_COLUMN + a if a == b else _PRODUCT_COLUMN + 3 - a - b


def _add_inertia(moment: Array, first: int, second: int) -> None:
    """Add I alpha + omega x I omega for a unit (symmetric) entry of I."""
    entries = {(first, second), (second, first)}
    for row, column in entries:  # I has a one at (row, column)
        a = (row + 1) % 3
        b = (row + 2) % 3
        moment[row, _ALPHA_COLUMN + column] += 1.0
        # omega x e_row = omega_b e_a - omega_a e_b, times omega_column
        moment[a, _product(b, column)] += 1.0
        moment[b, _product(a, column)] -= 1.0


def _add_first_moment(moment: Array, force: Array, c: int) -> None:
    """Add e_c x a to the moment, alpha x e_c + omega omega_c - e_c omega^2 to the force."""
    a = (c + 1) % 3
    b = (c + 2) % 3
    moment[a, _ACCELERATION_COLUMN + b] = -1.0
    moment[b, _ACCELERATION_COLUMN + a] = 1.0
    force[a, [_ALPHA_COLUMN + b, _product(a, c)]] = 1.0
    force[b, _ALPHA_COLUMN + a] = -1.0
    force[b, _product(b, c)] = 1.0
    force[c, [_SQUARE_COLUMN + a, _SQUARE_COLUMN + b]] = -1.0


WRENCH_MATRICES: Final = np.array([_wrench_matrix(symbol) for symbol in range(N_LINK)])
"""Wrenches (moment, then force) of unit `LINK_SYMBOLS` from the primitives (10, 6, 12)."""
WRENCH_MATRICES.flags.writeable = False
