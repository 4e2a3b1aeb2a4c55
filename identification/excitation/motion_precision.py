r"""Precision that a motion gives, compared with the precision that is wanted.

A motion leaves the parameters with the covariance :math:`C = (P + I)^{-1}`, with P the information
of prior and earlier recordings, and :math:`I = \sum_t \Delta t \sum_j \Phi_{tj}^T \Phi_{tj} / S_j`
that of the motion. S_j is the density of the torque error of joint j at low frequencies
[(N m)² s], which contains its correlation in time.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from identification.arrays import Array

INTERVAL_SIGMAS: Final = 2.0
"""Standard deviations in half a 95 % interval: Student's factor for some sixty blocks of time."""
_MIN_INFORMATION: Final = 1e-10  # information, relative, of what no row shows
# of the ratios in the criterion: the largest one dominates, and it is smooth
_NORM_POWER: Final = 16.0


class Spread(NamedTuple):
    """Variances of k wanted quantities, and their slopes."""

    variance: Array  # (k,)
    #: (k, p): the variance changes by ``-u' dI u`` for a change dI of the information
    slope: Array


@dataclass(frozen=True, eq=False)
class Quantities:
    """Linear functions of the parameters, and the precision that is wanted of each."""

    directions: Array  #: (k, p)
    allowed: Array  #: half of the 95 % intervals that are wanted (k,)

    def spread(self, information: Array) -> Spread:
        """Return the variances for an information (p, p) of prior and data."""
        scale = 1.0 / np.sqrt(np.diag(information))
        unit = information * scale[:, None] * scale
        moved = np.linalg.solve(unit, (self.directions * scale).T).T * scale
        return Spread(np.einsum("kp,kp->k", self.directions, moved), moved)


@dataclass(frozen=True, eq=False)
class Precision:
    """Wanted precision of an arm, its torque error, and what is known before the motion."""

    quantities: Quantities | LoadQuantities  #: what is wanted
    density: Array  #: of the torque error of each joint at low frequencies (n,) [(N m)² s]
    prior: Array  #: information of prior and earlier recordings (p, p)

    @property
    def has_offsets(self) -> bool:
        """Whether each recording has an unknown offset of every joint's torque.

        As it has where a payload is weighed (:mod:`identification.estimators.payload_estimate`).
        """
        return isinstance(self.quantities, LoadQuantities)

    def ratios(self, information: Array) -> Array:
        """Return predicted over wanted interval (k,) for the information (p, p) of a motion."""
        variance = self.spread(information).variance
        return np.asarray(INTERVAL_SIGMAS * np.sqrt(variance) / self.quantities.allowed)

    def criterion(self, information: Array) -> float:
        """Return a norm of the ratios in which the largest dominates."""
        return _norm(self.ratios(information))

    def slope(self, information: Array) -> Array:
        """Return the derivative (p, p) of -ln of the criterion by the information."""
        spread = self.spread(information)
        ratios = np.sqrt(spread.variance) / self.quantities.allowed
        share = (ratios / ratios.max()) ** _NORM_POWER
        weights = 0.5 * share / share.sum() / spread.variance
        return np.asarray((spread.slope * weights[:, None]).T @ spread.slope)

    def spread(self, information: Array) -> Spread:
        """Return the variances for the information (p, p) of a motion."""
        if isinstance(self.quantities, LoadQuantities):
            return self.quantities.spread(information)
        return self.quantities.spread(self.prior + information)


@dataclass(frozen=True, eq=False)
class LoadQuantities:
    r"""Linear functions of the ten parameters of a body at the flange.

    A body :math:`\beta` changes the parameters of the arm by :math:`D \beta`. The loaded recordings
    determine :math:`\pi + D \beta` with the information M, and :math:`\pi` is known with the
    covariance C, in which friction may have drifted: :math:`\mathrm{cov}\,\beta = (D^T (M^{-1} +
    C)^{-1} D)^{-1}`.
    """

    directions: Array  #: (k, 10)
    allowed: Array  #: half of the 95 % intervals that are wanted (k,)
    change: Array  #: D (p, 10)
    root: Array  #: L (p, p) with L L' = C

    def spread(self, information: Array) -> Spread:
        """Return the variances for an information (p, p) of the loaded recordings."""
        data = self.root.T @ information @ self.root
        change = np.linalg.solve(self.root, self.change)
        # (M^-1 + L L')^-1 = L^-T (1 - (1 + L' M L)^-1) L^-1
        left = np.linalg.solve(np.eye(len(data)) + data, np.column_stack([change, data @ change]))
        loads = self.change.shape[1]
        about = change.T @ left[:, loads:]
        # What the arm's motion does not show has a variance without bound, not zero.
        scale = 1.0 / np.sqrt(np.where(np.diag(about) > 0.0, np.diag(about), 1.0))
        unit = about * scale[:, None] * scale + _MIN_INFORMATION * np.eye(loads)
        covariance = np.linalg.inv(unit)
        moved = (self.directions * scale) @ covariance * scale
        slope = moved @ left[:, :loads].T @ self.root.T
        return Spread(np.einsum("kb,kb->k", self.directions, moved), slope)


def _norm(ratios: Array) -> float:
    largest = float(ratios.max())
    if not np.isfinite(largest) or largest <= 0.0:
        return np.inf
    return float(largest * np.sum((ratios / largest) ** _NORM_POWER) ** (1.0 / _NORM_POWER))
