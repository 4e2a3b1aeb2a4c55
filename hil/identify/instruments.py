"""Instrumental variables for archives that hold what was commanded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification import IdentificationError, RobotModel
from identification.estimators.instrument_motion import planned_motion, same_plan
from identification.estimators.instrumental import InstrumentalEstimate, estimate_instrumental
from identification.factor.factor import Estimate
from identification.factor.instruments import InstrumentFactor
from identification.signals.samples import Samples
from identification.validation.endogeneity import EndogeneityTest, endogeneity_test

from .prepared import Prepared
from .settings import samples_of

# Hz. A narrower smoother takes part of the motion out of the regressor, which instruments cannot
# mend. On simulated NS 16 logs with a hundred to a thousand times the encoders' noise, instrumental
# variables at the bandwidth that suits least squares (7 to 14 Hz) were worse than least squares; at
# 20 Hz they were better throughout.
NARROWEST: Final = 20.0

Array = NDArray[np.float64]

# Time since the origin and commanded positions of a motion; and the lag of each axis in it, which
# is the same in every repetition.
_Plan = tuple[tuple[Array, Array], Array]


@dataclass(frozen=True, eq=False)
class InstrumentalFit:
    """Instrumental variables of all recordings, and of each.

    Attributes:
        pooled: from all.
        each: per recording.
        test: whether least squares was biased by noise in the regressor.
    """

    pooled: InstrumentalEstimate
    each: tuple[Estimate, ...]
    test: EndogeneityTest

    @property
    def bias_matters(self) -> bool:
        """Whether least squares is biased, and predicts other torques for it than it should."""
        return self.test.matters


def widely_smoothed(model: RobotModel, prepared: Prepared) -> tuple[Samples, ...]:
    """What is fitted, smoothed no narrower than `NARROWEST`, however noisy the positions are."""
    wide = prepared.settings.preprocessed(rigid_bandwidth=NARROWEST)
    noiseless = replace(wide, noise_variance=(0.0,) * model.n_joints)
    return tuple(
        samples
        if float(samples.position_bandwidth.min()) >= NARROWEST
        else samples_of(source, prepared.sources.cell, noiseless)
        for source, samples in zip(prepared.sources.training, prepared.fitted, strict=True)
    )


def fit_instrumental(
    model: RobotModel, prepared: Prepared, fitted: Sequence[Samples]
) -> InstrumentalFit | str:
    """Fit with the commanded motion as instruments; in words why that cannot be.

    Args:
        model: the robot.
        prepared: where the recordings and their commands are.
        fitted: the samples of these recordings.
    """
    factors = []
    plans: list[_Plan] = []
    try:
        for samples, commanded in zip(fitted, prepared.commanded, strict=True):
            if commanded is None:
                return "the recordings hold no commanded positions"
            plan = samples.motion.time - samples.origin, commanded
            lag = next((known for one, known in plans if same_plan(one, plan)), None)
            planned = planned_motion(samples, commanded, lag=lag)
            if lag is None:
                plans.append((plan, planned.lag))
            factors.append(
                InstrumentFactor.from_samples(model, samples, planned.motion, planned.usable)
            )
        total = factors[0]
        for factor in factors[1:]:
            total = total + factor
        pooled = estimate_instrumental(model, total)
        each = tuple(estimate_instrumental(model, factor).estimate for factor in factors)
    except IdentificationError as error:
        return str(error)
    return InstrumentalFit(pooled, each, endogeneity_test(model, total, pooled))
