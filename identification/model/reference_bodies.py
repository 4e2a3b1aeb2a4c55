"""A possible body for every link, to hold on to where data leave its parameters open.

The nominal parameters of a description are often no body at all: left out, typed with a slip,
or of a rod without thickness. Each link keeps as much of them as is possible.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.model.pseudo_inertia import inertial_from_pseudo, pseudo_inertia

Array = NDArray[np.float64]

AS_GIVEN: Final = "nominal"
MADE_POSSIBLE: Final = "nominal, made possible"
ASSUMED: Final = "assumed: the nominal has no mass"

# Variance of the mass in its thinnest direction over that in its widest: a rod of steel tube with
# a thirtieth of its length as diameter has 1e-3. Thinner than that is a missing figure.
_THINNEST: Final = 1e-3
# Without any figure: a ball with a quarter of the mean distance of joints as its radius.
_BALL: Final = 0.25
_SMALLEST_BODY: Final = 0.01  # of that radius; smaller is a point, whose figures are missing
_SMALLEST_SIZE: Final = 0.05  # m
_SOME_MASS: Final = 1.0  # kg


class ReferenceBodies(NamedTuple):
    """Reference of n links.

    Attributes:
        inertial: parameters, consistent with room to spare (n, 10).
        frames: square roots C of the pseudo-inertias, ``J = C C'`` (n, 4, 4).
        words: where each comes from (n,).
    """

    inertial: Array
    frames: Array
    words: tuple[str, ...]


def reference_bodies(nominal: Array, translation: Array) -> ReferenceBodies:
    """Return a possible body per link, from nominal parameters as far as they are possible.

    Args:
        nominal: inertial parameters (n, 10).
        translation: origin of each joint in its parent's frame (n, 3) [m], for a size.
    """
    distances = np.linalg.norm(translation[1:], axis=1)
    distances = distances[distances > 0.0]
    size = max(float(distances.mean()) if len(distances) else 0.0, _SMALLEST_SIZE)
    masses = nominal[nominal[:, 9] > 0.0, 9]
    mass = float(np.median(masses)) if len(masses) else _SOME_MASS
    found = [_reference(link, mass, _BALL * size) for link in nominal]
    matrices = np.array([matrix for matrix, _ in found])
    return ReferenceBodies(
        inertial=inertial_from_pseudo(matrices),
        frames=np.linalg.cholesky(matrices),
        words=tuple(words for _, words in found),
    )


def _reference(inertial: Array, usual_mass: float, radius: float) -> tuple[Array, str]:
    """Return the pseudo-inertia (4, 4) of a possible body, and where it comes from."""
    matrix = pseudo_inertia(inertial)
    mass = matrix[3, 3]
    if not mass > 0.0:
        return usual_mass * np.diag([radius**2 / 5.0] * 3 + [1.0]), ASSUMED
    centre = matrix[:3, 3] / mass
    spread, axes = np.linalg.eigh(matrix[:3, :3] / mass - np.outer(centre, centre))
    ball = radius**2 / 5.0
    widest = spread[-1] if spread[-1] > _SMALLEST_BODY**2 * ball else ball
    if spread[0] >= _THINNEST * widest:
        return matrix, AS_GIVEN
    second = (axes * np.maximum(spread, _THINNEST * widest)) @ axes.T + np.outer(centre, centre)
    possible = np.empty((4, 4))
    possible[:3, :3] = mass * second
    possible[:3, 3] = possible[3, :3] = mass * centre
    possible[3, 3] = mass
    return possible, MADE_POSSIBLE
