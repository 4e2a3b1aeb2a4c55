"""From factors to estimates, by those estimators that need no sample."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.cell import Cell
from hil.errors import InputError
from hil.identify.cad_prior import cad_prior
from identification import IdentificationError
from identification.consistent import consistent_estimate
from identification.covariance import block_covariance, with_block_covariance
from identification.estimation import Estimate, estimate, nothing_usable
from identification.factor import Factor
from identification.least_squares import Weighting, weights_of
from identification.model import RobotModel
from identification.payload import Payload
from identification.phase_factor import PhaseFactor
from identification.prior import GaussianPrior, with_prior
from identification.qr_factor import QR_CONDITION

from .axis_figures import speed_rms
from .types import ArchiveRef, BatchEstimator, Level, LevelEstimate, Summary

Array = NDArray[np.float64]

Estimated = tuple[Estimate, tuple[str, ...]]
"""An estimate, and what a reader must know of it."""


class Estimator:
    """One of the estimators, for one arm.

    Args:
        name: of the estimator.
        cell: says what the arm is, and what is believed of it.

    Raises:
        InputError: the estimator needs a prior, and the cell has none.
    """

    def __init__(self, name: BatchEstimator, cell: Cell) -> None:
        self.name = name
        self.model: RobotModel = cell.model
        self._prior: GaussianPrior | None = None
        if name == "prior":
            prior = cad_prior(cell)
            if isinstance(prior, str):
                raise InputError(
                    cell.path,
                    f"there is no prior to be had: {prior}",
                    field="--estimator prior",
                    remedy="give inertias in the URDF, or use --estimator wls",
                )
            self._prior = prior

    def of_archive(self, summary: Summary) -> Estimated:
        """The estimate from one archive alone.

        Of the consistent estimator this is the free one, as in `hil identify`: the scatter of
        repetitions is about noise.
        """
        if self._prior is None:
            return summary.fits[self._weighting].estimate, ()
        free = summary.fits["weighted"]
        factor, wide = free.estimate.interval_factor, free.design_effect
        return self._posterior(summary.total.total, self._prior, wide, factor), ()

    def of_sum(self, phase: PhaseFactor) -> Estimated:
        """The estimate from a sum over archives.

        Raises:
            IdentificationError: there is not one usable row, or no consistent solution.
        """
        total = phase.total
        if not total.samples.any():
            raise IdentificationError(nothing_usable(self.model))
        if self._prior is not None:
            weights = self.weights(total)
            free = estimate(self.model, total, weights)
            wide = block_covariance(phase, weights, free.values)
            return _checked(
                self._posterior(total, self._prior, wide.design_effect, wide.interval_factor)
            )
        weighting = self._weighting
        weights = self.weights(total)
        free = with_block_covariance(
            estimate(self.model, total, weights), phase, weights, f"{weighting} least squares"
        )
        if self.name != "consistent":
            return _checked(free)
        return _checked(consistent_estimate(self.model, total, free).estimate)

    def weights(self, total: Factor) -> Array:
        """Weight of each joint's rows (n,)."""
        if self._weighting == "ordinary":
            return np.ones(self.model.n_joints)
        return weights_of(total)

    @property
    def _weighting(self) -> Weighting:
        return "ordinary" if self.name == "ols" else "weighted"

    def _posterior(
        self, total: Factor, prior: GaussianPrior, design_effect: float, interval_factor: float
    ) -> Estimate:
        """As :func:`identification.prior.fit_with_prior`, which may read samples."""
        weights, effect = self.weights(total), max(1.0, design_effect)
        found = with_prior(self.model, total, prior, weights, design_effect=effect)
        return replace(found.estimate, interval_factor=interval_factor)


def _checked(found: Estimate) -> Estimated:
    if found.undetermined or found.condition <= QR_CONDITION:
        return found, ()
    return found, (
        f"the scaled condition number is {found.condition:.2g}: the motion hardly tells some "
        "parameters apart, and sums of squares lose digits there; `hil identify` on these archives "
        "uses QR",
    )


@dataclass(frozen=True, eq=False)
class Unseen:
    """What was recorded of motions that are not fitted: the sum of the totals; None if nothing."""

    total: PhaseFactor | None = None

    def __add__(self, other: Unseen) -> Unseen:
        if self.total is None or other.total is None:
            return self if other.total is None else other
        return Unseen(self.total + other.total)

    def errors(self, values: Array, n_joints: int) -> tuple[Array, Array]:
        """RMS per joint (n,) of the torque that is left, and of the torque; NaN if nothing."""
        if self.total is None:
            return np.full(n_joints, np.nan), np.full(n_joints, np.nan)
        return errors(self.total.total, values)


def errors(factor: Factor, values: Array) -> tuple[Array, Array]:
    """RMS per joint (n,) of the torque that is left by parameters (p,), and of the torque."""
    augmented = np.append(-values, 1.0)
    squares = np.einsum("i,jik,k->j", augmented, factor.gram, augmented)
    rows = np.where(factor.samples > 0, factor.samples, np.nan)
    return np.sqrt(np.maximum(squares, 0.0) / rows), _torque_rms(factor)


def _figures(found: Estimate) -> dict[str, Any]:
    return {
        name: getattr(found, name)
        for name in (
            "names",
            "units",
            "values",
            "std",
            "interval_factor",
            "samples",
            "noise_std",
            "condition",
            "undetermined",
            "method",
        )
    }


def _own(found: Estimate, model: RobotModel) -> dict[str, Any]:
    """Figures that keep nothing else in memory: of a batch there may be very many."""
    return {
        "names": model.parameter_names,
        "units": model.units,
        "values": found.values.copy(),
        "noise_std": found.noise_std.copy(),
        "samples": found.samples.copy(),
    }


def _torque_rms(factor: Factor) -> Array:
    rows = np.where(factor.samples > 0, factor.samples, np.nan)
    return np.asarray(np.sqrt(factor.gram[:, -1, -1] / rows))


def repetition_level(estimator: Estimator, summary: Summary, settings: str) -> LevelEstimate:
    """The estimate of one archive."""
    ref = summary.ref
    found, doubts = estimator.of_archive(summary)
    nothing = np.full(estimator.model.n_joints, np.nan)
    return LevelEstimate(
        level="repetition",
        arm=ref.arm,
        campaign=ref.campaign,
        archive=ref.location,
        sha256=ref.sha256,
        when=ref.when,
        repetitions=1,
        **(_figures(found) | _own(found, estimator.model)),
        covariance=None,
        torque_rms=_torque_rms(summary.total.total),
        unseen_rms=nothing,
        unseen_torque_rms=nothing,
        settings=settings,
        doubts=(*summary.doubts, *doubts),
        setup=ref.setup,
    )


def sum_level(
    level: Level,
    estimator: Estimator,
    refs: Sequence[ArchiveRef],
    phase: PhaseFactor,
    unseen: Unseen,
    settings: str,
    doubts: Sequence[str] = (),
    payload: Payload | None = None,
) -> LevelEstimate:
    """The estimate of a campaign, or of all campaigns of an arm.

    Args:
        level: which.
        estimator: of the arm.
        refs: archives that were fitted.
        phase: the sum of their factors.
        unseen: what is predicted.
        settings: digest, "" where campaigns have different ones.
        doubts: about the archives.
        payload: that the campaign's cell states.

    Raises:
        IdentificationError: there is no estimate.
    """
    found, own = estimator.of_sum(phase)
    total, setups = phase.total, {ref.setup for ref in refs}
    left, torque = unseen.errors(found.values, phase.n_joints)
    return LevelEstimate(
        level=level,
        arm=refs[0].arm,
        campaign=refs[0].campaign if level == "campaign" else "",
        archive="",
        sha256="",
        when=min((ref.when for ref in refs if ref.when), default=""),
        repetitions=len(refs),
        **_figures(found),
        covariance=found.covariance,
        torque_rms=_torque_rms(total),
        unseen_rms=left,
        unseen_torque_rms=torque,
        settings=settings,
        doubts=(*own, *doubts),
        speed_rms=speed_rms(estimator.model, total),
        information=total.weighted(estimator.weights(total)).A,
        setup=setups.pop() if len(setups) == 1 else "",
        payload=payload,
        unseen=None if unseen.total is None else unseen.total.total,
    )
