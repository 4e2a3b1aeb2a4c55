"""Whether held-out torque lies inside the intervals of its prediction."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from hil.results import CalibrationResult
from identification.errors import IdentificationError
from identification.estimators.shrinkage import Shrinkage, fitted_values
from identification.factor.factor import Factor
from identification.validation.calibration import Calibration, TorqueMeans, calibrate
from identification.validation.residual_blocks import BLOCK

from .estimating import Estimation
from .prepared import Prepared

Array = NDArray[np.float64]


def calibration_result(prepared: Prepared, estimation: Estimation) -> CalibrationResult | None:
    """Intervals of held-out torque; None without held-out motion, or too little fitted."""
    if prepared.sources.in_sample:
        return None
    model, result = prepared.sources.cell.model, estimation.result
    shrinkage = _fold_estimator(prepared, estimation)

    def refit(factor: Factor) -> Array:
        return fitted_values(model, factor, shrinkage)

    try:
        found = calibrate(
            result.pooled,
            result.phase,
            TorqueMeans.of(model, prepared.training),
            TorqueMeans.of(model, prepared.held_out),
            refit,
        )
    except IdentificationError:
        return None
    return None if math.isnan(found.overall) else _result(found)


def _fold_estimator(prepared: Prepared, estimation: Estimation) -> Shrinkage:
    """The estimator, as far as it works on factors alone.

    Folds are fitted by least squares where it is a robust loss, instruments or a prior from CAD.
    """
    if estimation.estimator == "consistent":
        return Shrinkage(strength=math.inf)
    return prepared.settings.shrinkage if estimation.estimator == "auto" else Shrinkage()


def _result(found: Calibration) -> CalibrationResult:
    return CalibrationResult(
        block=BLOCK,
        means=int(found.blocks.sum()),
        inside=found.overall,
        white_inside=found.white_overall,
        joint_inside=_known(found.inside),
        half_width=_known(found.half_width),
    )


def _known(values: Array) -> list[float | None]:
    return [None if math.isnan(value) else value for value in values.tolist()]
