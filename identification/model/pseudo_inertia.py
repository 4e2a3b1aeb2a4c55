r"""The pseudo-inertia of a body: when ten numbers can be those of a distribution of mass.

For inertial parameters about a frame (tensor I, first moment h = mc, mass m)

.. math:: J = \begin{bmatrix} \Sigma & h \\ h^T & m \end{bmatrix}, \qquad
          \Sigma = \tfrac{1}{2}\,\mathrm{tr}(I)\,1 - I

is the matrix of second moments of the mass about the frame's origin. Some mass density has these
parameters if and only if J is positive (semi)definite (Wensing, Kim and Slotine 2018, who call
this full physical consistency): the mass is positive, the tensor about the centre of mass is
positive and obeys the triangle inequalities. J is linear in the parameters.

The ten parameters stand in the order of :data:`identification.model.wrench.LINK_SYMBOLS`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.errors import IdentificationError
from identification.model.kinematics import skew

Array = NDArray[np.float64]

# Rows and columns of a symmetric 3x3 matrix, in the order xx, xy, xz, yy, yz, zz.
_UPPER = (np.array([0, 0, 0, 1, 1, 2]), np.array([0, 1, 2, 1, 2, 2]))


class NoMassError(IdentificationError, ValueError):
    """A body without mass has no centre of mass."""


class Body(NamedTuple):
    """A rigid body as drawings give it.

    Attributes:
        mass: [kg].
        centre: centre of mass in the frame of the parameters [m], shape (3,).
        inertia: tensor about the centre of mass, axes of that frame [kg m²], shape (3, 3).
    """

    mass: float
    centre: Array
    inertia: Array


def pseudo_inertia(inertial: Array) -> Array:
    """Return the pseudo-inertias (..., 4, 4) of inertial parameters (..., 10)."""
    inertial = np.asarray(inertial, dtype=np.float64)
    tensor = _tensor(inertial[..., :6])
    matrix = np.empty((*inertial.shape[:-1], 4, 4))
    half_trace = 0.5 * np.trace(tensor, axis1=-2, axis2=-1)
    matrix[..., :3, :3] = half_trace[..., None, None] * np.eye(3) - tensor
    matrix[..., :3, 3] = matrix[..., 3, :3] = inertial[..., 6:9]
    matrix[..., 3, 3] = inertial[..., 9]
    return matrix


def inertial_from_pseudo(matrix: Array) -> Array:
    """Return the inertial parameters (..., 10) of pseudo-inertias (..., 4, 4)."""
    matrix = np.asarray(matrix, dtype=np.float64)
    second = matrix[..., :3, :3]
    trace = np.trace(second, axis1=-2, axis2=-1)
    tensor = trace[..., None, None] * np.eye(3) - second
    rows, columns = _UPPER
    return np.concatenate(
        [tensor[..., rows, columns], matrix[..., :3, 3], matrix[..., 3, 3][..., None]], axis=-1
    )


def pseudo_inertia_map() -> Array:
    """Return the pseudo-inertia of each unit parameter, shape (10, 4, 4)."""
    return pseudo_inertia(np.eye(10))


def margin(inertial: Array) -> Array:
    """Return the smallest eigenvalue of each pseudo-inertia (...): positive if consistent.

    In SI units (kg, kg m, kg m²), so of links of very different size compare the sign only.
    """
    return np.asarray(np.linalg.eigvalsh(pseudo_inertia(inertial))[..., 0])


def body(inertial: Array) -> Body:
    """Return mass, centre of mass and the tensor about it, of inertial parameters (10,).

    Raises:
        NoMassError: the mass is zero.
    """
    inertial = np.asarray(inertial, dtype=np.float64)
    mass = float(inertial[9])
    if mass == 0.0:
        raise NoMassError("a body without mass has no centre of mass")
    centre = inertial[6:9] / mass
    lever = skew(centre)
    return Body(mass, centre, _tensor(inertial[:6]) + mass * lever @ lever)


def inertial_parameters(body: Body) -> Array:
    """Return the inertial parameters (10,) of a body about its frame's origin (Steiner)."""
    lever = skew(body.centre)
    tensor = body.inertia - body.mass * lever @ lever
    return np.concatenate([tensor[_UPPER], body.mass * body.centre, [body.mass]])


def _tensor(six: Array) -> Array:
    """Return symmetric matrices (..., 3, 3) of xx, xy, xz, yy, yz, zz (..., 6)."""
    rows, columns = _UPPER
    tensor = np.empty((*six.shape[:-1], 3, 3))
    tensor[..., rows, columns] = six
    tensor[..., columns, rows] = six
    return tensor
