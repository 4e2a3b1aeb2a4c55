r"""The pseudo-inertia of a body, which is positive definite for consistent inertial parameters.

For inertial parameters about a frame (tensor I, first moment h = mc, mass m; in the order of
:data:`identification.model.link_wrenches.LINK_SYMBOLS`)

.. math:: J = \begin{bmatrix} \Sigma & h \\ h^T & m \end{bmatrix}, \qquad
          \Sigma = \tfrac{1}{2}\,\mathrm{tr}(I)\,1 - I

is linear in the parameters, and positive semidefinite if and only if a mass distribution with them
exists (Wensing, Kim and Slotine 2018).
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from identification.arrays import Array
from identification.errors import IdentificationError
from identification.model.kinematics import skew

# Rows and columns of a symmetric 3x3 matrix, in the order xx, xy, xz, yy, yz, zz.
_UPPER_TRIANGLE = (np.array([0, 0, 0, 1, 1, 2]), np.array([0, 1, 2, 1, 2, 2]))


class NoMassError(IdentificationError, ValueError):
    """A body without mass has no centre of mass."""


class Body(NamedTuple):
    """Mass properties of a rigid body."""

    mass: float  # [kg]
    centre: Array  # centre of mass in the frame of the parameters [m], shape (3,)
    inertia: Array  # tensor about the centre of mass, axes of that frame [kg·m²], shape (3, 3)


def pseudo_inertia(inertial: Array) -> Array:
    """Return the pseudo-inertias (..., 4, 4) of inertial parameters (..., 10)."""
    inertial = np.asarray(inertial, dtype=np.float64)
    tensor = tensors(inertial[..., :6])
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
    rows, columns = _UPPER_TRIANGLE
    return np.concatenate(
        [tensor[..., rows, columns], matrix[..., :3, 3], matrix[..., 3, 3][..., None]], axis=-1
    )


def pseudo_inertia_map() -> Array:
    """Return the pseudo-inertia of each unit parameter, shape (10, 4, 4)."""
    return pseudo_inertia(np.eye(10))


def margin(inertial: Array) -> Array:
    """Return the smallest eigenvalue of each pseudo-inertia (...), positive if consistent."""
    return np.asarray(np.linalg.eigvalsh(pseudo_inertia(inertial))[..., 0])


def body(inertial: Array) -> Body:
    """Return the mass properties of inertial parameters (10,).

    Raises:
        NoMassError: the mass is zero.
    """
    inertial = np.asarray(inertial, dtype=np.float64)
    mass = float(inertial[9])
    if mass == 0.0:
        raise NoMassError("the mass is zero, the centre of mass undefined")
    centre = inertial[6:9] / mass
    lever = skew(centre)
    return Body(mass, centre, tensors(inertial[:6]) + mass * lever @ lever)


def inertial_parameters(body: Body) -> Array:
    """Return the inertial parameters (10,) of a body about its frame's origin (Steiner)."""
    lever = skew(body.centre)
    tensor = body.inertia - body.mass * lever @ lever
    return np.concatenate([tensor[_UPPER_TRIANGLE], body.mass * body.centre, [body.mass]])


def tensors(six: Array) -> Array:
    """Return symmetric matrices (..., 3, 3) of xx, xy, xz, yy, yz, zz (..., 6)."""
    rows, columns = _UPPER_TRIANGLE
    tensor = np.empty((*six.shape[:-1], 3, 3))
    tensor[..., rows, columns] = six
    tensor[..., columns, rows] = six
    return tensor


AS_GIVEN: Final = "nominal"
MADE_POSSIBLE: Final = "nominal, made possible"
ASSUMED: Final = "assumed: the nominal has no mass"

# Smallest ratio of the variances of the mass in two directions; that of a steel tube with a
# diameter of 1/30 of its length.
_MIN_VARIANCE_RATIO: Final = 1e-3
# Without nominal parameters: a ball with this fraction of the mean joint distance as its radius.
_BALL_RADIUS_SHARE: Final = 0.25
_MIN_BODY_SHARE: Final = 0.01  # fraction of that radius; smaller nominal bodies are ignored
_MIN_JOINT_DISTANCE: Final = 0.05  # m
_DEFAULT_MASS: Final = 1.0  # kg


class ReferenceBodies(NamedTuple):
    """Reference bodies of n links."""

    inertial: Array  # consistent parameters (n, 10)
    frames: Array  # square roots C of the pseudo-inertias, ``J = C C'`` (n, 4, 4)
    origins: tuple[str, ...]  # of each (n,)


def reference_bodies(nominal: Array, translation: Array) -> ReferenceBodies:
    """Return a consistent body per link, close to its nominal parameters (n, 10).

    Origins of the joints in their parents' frames (n, 3) [m] give the size of unknown bodies.
    """
    distances = np.linalg.norm(translation[1:], axis=1)
    distances = distances[distances > 0.0]
    size = max(float(distances.mean()) if len(distances) else 0.0, _MIN_JOINT_DISTANCE)
    masses = nominal[nominal[:, 9] > 0.0, 9]
    mass = float(np.median(masses)) if len(masses) else _DEFAULT_MASS
    references = [_reference(link, mass, _BALL_RADIUS_SHARE * size) for link in nominal]
    matrices = np.array([matrix for matrix, _ in references])
    return ReferenceBodies(
        inertial=inertial_from_pseudo(matrices),
        frames=np.linalg.cholesky(matrices),
        origins=tuple(origin for _, origin in references),
    )


def _reference(inertial: Array, usual_mass: float, radius: float) -> tuple[Array, str]:
    """Return the pseudo-inertia (4, 4) of a consistent body, and its origin."""
    matrix = pseudo_inertia(inertial)
    mass = matrix[3, 3]
    if not mass > 0.0:
        return usual_mass * np.diag([radius**2 / 5.0] * 3 + [1.0]), ASSUMED
    centre = matrix[:3, 3] / mass
    spread, axes = np.linalg.eigh(matrix[:3, :3] / mass - np.outer(centre, centre))
    ball = radius**2 / 5.0
    widest = spread[-1] if spread[-1] > _MIN_BODY_SHARE**2 * ball else ball
    if spread[0] >= _MIN_VARIANCE_RATIO * widest:
        return matrix, AS_GIVEN
    second = (axes * np.maximum(spread, _MIN_VARIANCE_RATIO * widest)) @ axes.T + np.outer(
        centre, centre
    )
    possible = np.empty((4, 4))
    possible[:3, :3] = mass * second
    possible[:3, 3] = possible[3, :3] = mass * centre
    possible[3, 3] = mass
    return possible, MADE_POSSIBLE
