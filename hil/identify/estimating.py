"""From samples to an estimate, by the estimator that was chosen."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hil.errors import ArchiveError, InputError
from hil.progress import Reporter
from identification import IdentificationError, RobotModel
from identification.estimators.consistent import SolverError, consistent_estimate
from identification.estimators.delay import rate_products, with_uncertain_delay
from identification.estimators.instrumental import (
    InstrumentalEstimate,
    estimate_instrumental,
    planned_motion,
    same_plan,
)
from identification.estimators.least_squares import (
    RepeatedEstimate,
    Weighting,
    estimate_repetitions,
    fit_least_squares,
)
from identification.estimators.losses import Huber, Loss, Tukey
from identification.estimators.prior import GaussianPrior, PosteriorEstimate, fit_with_prior
from identification.estimators.robust import RobustEstimate, robust_estimate
from identification.estimators.shrinkage import Shrinkage, consistent_centre, fit_shrunk
from identification.factor.factor import QR_CONDITION, Estimate, joint_weights, nothing_usable
from identification.factor.phases import PhaseFactor, instrument_factor, total_phase
from identification.signals.samples import Samples
from identification.validation.endogeneity import EndogeneityTest, endogeneity_test

from .cad_prior import cad_prior, required
from .options import Estimator, Options
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
            factors.append(instrument_factor(model, samples, planned.motion, planned.usable))
        total = factors[0]
        for factor in factors[1:]:
            total = total + factor
        pooled = estimate_instrumental(model, total)
        each = tuple(estimate_instrumental(model, factor).estimate for factor in factors)
    except IdentificationError as error:
        return str(error)
    return InstrumentalFit(pooled, each, endogeneity_test(model, total, pooled))


# Change by the data, in the deviations that the prior allows, beyond which one of the two is wrong.
_SURPRISING: Final = 4.0
_UNTESTED: Final = "Whether noise in the positions biases least squares could not be tested"


@dataclass(frozen=True, eq=False)
class Estimation:
    """An estimate, and what was computed beside it.

    Attributes:
        estimator: by name.
        result: pooled and per repetition.
        held_out: factors of what is predicted, one per recording.
        posterior: the estimate with the prior from CAD, which says of each parameter whether it
            was learned from the data; in words why there is none.
        endogeneity: whether noise in the regressor has biased least squares; in words why that
            could not be tested.
        warnings: what a reader must know of the estimate.
    """

    estimator: Estimator
    result: RepeatedEstimate
    held_out: tuple[PhaseFactor, ...]
    posterior: PosteriorEstimate | str
    endogeneity: EndogeneityTest | str
    warnings: tuple[str, ...]


class _Case:
    """What estimators read: the recordings, and what else is known of them."""

    def __init__(
        self,
        model: RobotModel,
        fitted: Sequence[Samples],
        prior: GaussianPrior | str,
        instrumental: InstrumentalFit | str,
        shrinkage: Shrinkage,
    ) -> None:
        self.model, self.fitted = model, fitted
        self.prior, self.instrumental, self.shrinkage = prior, instrumental, shrinkage


_Found = tuple[RepeatedEstimate, list[str]]


def estimate_with(prepared: Prepared, options: Options, reporter: Reporter) -> Estimation:
    """Estimate by `options.estimator`, and say beside it what can be said.

    Raises:
        InputError: the estimator needs something that the archives do not have.
        ArchiveError: a recording without a usable row.
    """
    model = prepared.sources.cell.model
    _require_usable(prepared, model)
    with reporter.task("estimating", 4) as task:
        # The test is of the very samples that least squares reads.
        fitted = prepared.fitted
        if options.estimator == "iv":
            fitted = widely_smoothed(model, prepared)
        instrumental = fit_instrumental(model, prepared, fitted)
        task.advance(1, options.estimator)
        prior = cad_prior(prepared.sources.cell)
        case = _Case(model, fitted, prior, instrumental, prepared.settings.shrinkage)
        result, warnings = _ESTIMATORS[options.estimator](case)
        if prepared.sources.same_motion:
            result = result.with_scatter()
        result = _with_delay_uncertainty(case, result, prepared.settings.delay_variance)
        task.advance(1, "prior")
        posterior = _posterior(case, result.phase)
        task.advance(1, "held-out motion")
        held_out = tuple(PhaseFactor.from_samples(model, one) for one in prepared.held_out)
        task.advance(1)
    return Estimation(
        estimator=options.estimator,
        result=result,
        held_out=held_out,
        posterior=posterior,
        endogeneity=(
            f"{_UNTESTED}: {instrumental}." if isinstance(instrumental, str) else instrumental.test
        ),
        warnings=(
            *warnings,
            *_conditioning(result.pooled),
            *_bias(options.estimator, instrumental),
        ),
    )


def _with_delay_uncertainty(
    case: _Case, result: RepeatedEstimate, variance: float
) -> RepeatedEstimate:
    """The result with what an uncertain delay of the torque adds to its intervals."""
    if variance == 0.0:
        return result
    products = sum(rate_products(case.model, samples) for samples in case.fitted)
    pooled = with_uncertain_delay(result.pooled, result.factor, np.asarray(products), variance)
    return replace(result, pooled=pooled)


def _require_usable(prepared: Prepared, model: RobotModel) -> None:
    """Refuse a recording of which nothing can be fitted, such as the beginning of a torn one."""
    for source, samples in zip(prepared.sources.training, prepared.fitted, strict=True):
        if not samples.usable.any():
            lasts = f"it lasts {np.ptp(samples.motion.time):.3g} s"
            raise ArchiveError(
                Path(source.name), f"{nothing_usable(model)} ({lasts})", remedy="leave it out"
            )


def _least_squares(weighting: Weighting) -> Callable[[_Case], _Found]:
    def run(case: _Case) -> _Found:
        def fit(some: Sequence[Samples], phase: PhaseFactor) -> Estimate:
            return fit_least_squares(case.model, some, weighting, phase=phase)

        return estimate_repetitions(case.model, case.fitted, fit), []

    return run


def _automatic(case: _Case) -> _Found:
    """Least squares, or drawn towards one consistent solution, that of all repetitions."""
    if case.shrinkage.strength == 0.0:
        return _least_squares("weighted")(case)
    total = total_phase(case.model, case.fitted).total
    try:
        centre = consistent_centre(
            case.model, total, joint_weights(total), case.shrinkage.prior_weight
        ).estimate.values
    except SolverError as error:
        found, warnings = _least_squares("weighted")(case)
        return found, [*warnings, f"least squares is reported, for {error}"]

    def fit(some: Sequence[Samples], phase: PhaseFactor) -> Estimate:
        return fit_shrunk(case.model, some, case.shrinkage, centre=centre, phase=phase)

    def free(some: Sequence[Samples], phase: PhaseFactor) -> Estimate:
        return fit_least_squares(case.model, some, phase=phase)

    each = free if math.isinf(case.shrinkage.strength) else fit
    return estimate_repetitions(case.model, case.fitted, fit, each=each), []


def _robust(loss: Loss) -> Callable[[_Case], _Found]:
    def run(case: _Case) -> _Found:
        fits: list[RobustEstimate] = []

        def fit(some: Sequence[Samples], phase: PhaseFactor) -> Estimate:
            fits.append(robust_estimate(case.model, some, loss, gram=phase.total))
            return fits[-1].estimate

        result = estimate_repetitions(case.model, case.fitted, fit)
        return result, _robust_warnings(case.model, fits[-1])  # the last is that of all

    return run


def _robust_warnings(model: RobotModel, found: RobustEstimate) -> list[str]:
    warnings = [
        f"{found.outlying[joint]:.0%} of the rows of {model.joint_names[joint]} lie beyond four "
        "deviations: that is no gross error but something the model leaves out, and a robust loss "
        "looks away from it; use --estimator wls"
        for joint in np.flatnonzero(found.doubtful)
    ]
    if not found.converged:
        warnings.append(f"the reweighting had not settled after {found.iterations} passes")
    return warnings


def _with_prior(case: _Case) -> _Found:
    prior = required(case.prior)
    fits: list[PosteriorEstimate] = []

    def fit(some: Sequence[Samples], phase: PhaseFactor) -> Estimate:
        fits.append(fit_with_prior(case.model, some, prior, phase=phase))
        return fits[-1].estimate

    result = estimate_repetitions(case.model, case.fitted, fit)
    surprise = np.nan_to_num(fits[-1].surprise)
    far = np.flatnonzero(np.abs(surprise) > _SURPRISING)
    if not far.size:
        return result, []
    names_far = ", ".join(case.model.parameter_names[k] for k in far[:6])
    more = f" and {far.size - 6} more" if far.size > 6 else ""
    return result, [
        f"data and prior contradict each other in {names_far}{more} (more than {_SURPRISING:g} "
        "deviations): the CAD figures, or their uncertainty in [nominal], are wrong"
    ]


def _consistent(case: _Case) -> _Found:
    def fit(some: Sequence[Samples], phase: PhaseFactor) -> Estimate:
        free = fit_least_squares(case.model, some, phase=phase)
        return consistent_estimate(case.model, phase.total, free).estimate

    def free(some: Sequence[Samples], phase: PhaseFactor) -> Estimate:
        return fit_least_squares(case.model, some, phase=phase)

    try:
        # The scatter over repetitions is about noise: no need of a program for each.
        return estimate_repetitions(case.model, case.fitted, fit, each=free), []
    except IdentificationError as error:
        raise InputError(
            None,
            f"no physically consistent parameters were found: {error}",
            field="--estimator consistent",
            remedy="use --estimator wls and read what its verdict says about consistency",
        ) from error


def _instrumental(case: _Case) -> _Found:
    found = case.instrumental
    if isinstance(found, str):
        raise InputError(
            None,
            f"there are no instruments: {found}",
            field="--estimator iv",
            remedy="record the commanded positions as well, or use --estimator wls",
        )
    phase = PhaseFactor.zero(case.model)
    for samples in case.fitted:
        phase = phase + PhaseFactor.from_samples(case.model, samples)
    result = RepeatedEstimate.of(case.model, found.pooled.estimate, found.each, phase)
    weak = found.pooled.weak
    if not weak:
        return result, []
    more = f" and {len(weak) - 6} more" if len(weak) > 6 else ""
    return result, [f"the instruments are too weak for {', '.join(weak[:6])}{more}"]


_ESTIMATORS: Final[dict[Estimator, Callable[[_Case], _Found]]] = {
    "auto": _automatic,
    "wls": _least_squares("weighted"),
    "ols": _least_squares("ordinary"),
    "huber": _robust(Huber()),
    "tukey": _robust(Tukey()),
    "prior": _with_prior,
    "consistent": _consistent,
    "iv": _instrumental,
}


def _posterior(case: _Case, phase: PhaseFactor) -> PosteriorEstimate | str:
    if isinstance(case.prior, str):
        return case.prior
    try:
        return fit_with_prior(case.model, case.fitted, case.prior, phase=phase)
    except IdentificationError as error:
        return str(error)


def _conditioning(pooled: Estimate) -> list[str]:
    if pooled.undetermined or pooled.condition <= QR_CONDITION:
        return []
    return [
        f"the scaled condition number is {pooled.condition:.2g}, so the fit was solved by QR: the "
        "motion hardly tells some parameters apart"
    ]


def _bias(estimator: Estimator, found: InstrumentalFit | str) -> list[str]:
    """That noise in the positions moves the result; figures of the test stand in the report."""
    if estimator == "iv" or isinstance(found, str) or not found.bias_matters:
        return []
    if found.pooled.estimate.undetermined:
        return []  # what the motion does not determine differs by any amount
    moved = float(np.max(found.test.predicted))
    return [
        "noise in the measured positions biases least squares: instrumental variables differ from"
        f" it by up to {moved:.1%} of an axis's torque; compare with --estimator iv, or measure"
        " positions with less noise"
    ]
