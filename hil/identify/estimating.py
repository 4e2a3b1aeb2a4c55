"""Estimation of parameters from samples, and the prior from CAD."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hil.cell import Cell
from hil.errors import ArchiveError, InputError
from hil.progress import Reporter
from identification import IdentificationError, RobotModel
from identification.estimators.consistent import (
    Shrinkage,
    SolverError,
    consistent_estimate,
    fit_shrunk,
    fitted_values,
)
from identification.estimators.delay import rate_products, with_uncertain_delay
from identification.estimators.instrumental import (
    estimate_instrumental,
    planned_motion,
    same_plan,
)
from identification.estimators.least_squares import (
    Fit,
    RepeatedEstimate,
    Weighting,
    estimate_repetitions,
    fit_least_squares,
)
from identification.estimators.losses import Huber, Loss, Tukey
from identification.estimators.prior import (
    GaussianPrior,
    PosteriorEstimate,
    fit_with_prior,
    nominal_prior,
    with_prior,
)
from identification.estimators.robust import RobustEstimate, robust_estimate
from identification.factor.columns import instrument_factor
from identification.factor.factor import (
    QR_CONDITION,
    Estimate,
    Factor,
    no_rows_message,
    total_factor,
)
from identification.signals.samples import Samples
from identification.validation.calibration import Refit
from identification.validation.finding import joined

from .options import Estimator, Options
from .prepared import Prepared, samples_of

# Hz. A narrower smoother removes part of the motion from the regressor, a bias that instruments
# cannot correct. On simulated NS 16 logs with 100 to 1000 times the encoder noise, instrumental
# variables at the best bandwidth of least squares (7 to 14 Hz) were worse than least squares, and
# at 20 Hz always better.
MIN_IV_BANDWIDTH: Final = 20.0
# Difference between data and prior, in standard deviations, that is reported.
_MAX_PRIOR_DEVIATION: Final = 4.0
FRICTION_SHARE: Final = 0.5
"""Relative standard deviation of nominal friction, which varies by tens of per cent with
temperature, lubricant and wear (Bittencourt and Gunnarsson 2012)."""

Array = NDArray[np.float64]

# Time since the origin and commanded positions of a motion, and the lag of each axis, which is the
# same in every repetition.
_Plan = tuple[tuple[Array, Array], Array]


@dataclass(frozen=True, eq=False)
class Estimation:
    """An estimate with its tests and warnings."""

    estimator: Estimator
    result: RepeatedEstimate  #: pooled and per repetition
    held_out: tuple[Factor, ...]  #: one per held-out recording
    #: estimate with the prior from CAD, or the reason why there is none
    posterior: PosteriorEstimate | str
    refit: Refit  #: parameters by the estimator from a factor, to predict parts of the fitted rows
    warnings: tuple[str, ...]


def estimate_with(prepared: Prepared, options: Options, reporter: Reporter) -> Estimation:
    """Estimate the parameters by `options.estimator`, with all applicable tests.

    Raises:
        InputError: the archives lack data that the estimator needs.
        ArchiveError: a recording has no usable row.
    """
    cell, name = prepared.sources.cell, options.estimator
    model, variance = cell.model, prepared.settings.delay_variance
    for source, samples in zip(prepared.sources.training, prepared.fitted, strict=True):
        if not samples.usable.any():  # for example a truncated recording
            lasts = f"it lasts {np.ptp(samples.motion.time):.3g} s"
            raise ArchiveError(
                Path(source.name), f"{no_rows_message(model)} ({lasts})", remedy="leave it out"
            )
    with reporter.task("estimating", 4) as task:
        fitted = smoothed_for_instruments(model, prepared) if name == "iv" else prepared.fitted
        task.advance(1, name)
        prior = cad_prior(cell)
        if name == "iv":
            result, warnings = _instrumental(model, prepared, fitted)
        elif name in _LOSSES:
            result, warnings = _robust(model, fitted, name)
        else:
            result, warnings = _by_factor(model, fitted, name, prepared.settings.shrinkage, prior)
        if prepared.sources.same_motion:
            result = result.with_scatter()
        if variance:
            products = np.asarray(sum(rate_products(model, samples) for samples in fitted))
            pooled = with_uncertain_delay(result.pooled, result.factor, products, variance)
            result = replace(result, pooled=pooled)
        task.advance(1, "prior")
        posterior: PosteriorEstimate | str = ""
        try:
            posterior = fit_with_prior(model, fitted, require_prior(prior), factor=result.factor)
        except (IdentificationError, InputError) as error:
            posterior = prior if isinstance(prior, str) else str(error)
        if name == "prior" and isinstance(posterior, PosteriorEstimate):
            warnings += _prior_contradictions(model, posterior)
        task.advance(1, "held-out motion")
        held_out = tuple(Factor.by_time(model, one) for one in prepared.held_out)
        task.advance(1)
    pooled = result.pooled
    if not pooled.undetermined and pooled.condition > QR_CONDITION:
        warnings.append(
            f"the scaled condition number is {pooled.condition:.2g}: the motion separates some"
            " parameters poorly (solved by QR)"
        )
    refit = refit_of(model, name, prepared.settings.shrinkage, prior, posterior)
    return Estimation(name, result, held_out, posterior, refit, tuple(warnings))


def cad_prior(cell: Cell) -> GaussianPrior | str:
    """Return the prior from the URDF and `[nominal]`, or the reason why there is none."""
    model, table = cell.model, cell.file.nominal
    known: dict[str, tuple[float, float]] = {}  # mean and standard deviation
    if table is not None:
        share = table.uncertainty or FRICTION_SHARE
        known |= {
            f"I{j}m": (value, share * value) for j, value in enumerate(table.rotor_inertia, 1)
        }
        for name, term, owner, motor, _ in model.friction.terms:
            values = getattr(table, term.option, None)
            if values and not motor:
                known[name] = values[owner], FRICTION_SHARE * abs(values[owner])
    names = {*model.layout.names, *model.friction.names}
    known = {name: one for name, one in known.items() if one[0] != 0.0 and name in names}
    try:
        if table is None or table.uncertainty == 0.0:
            return nominal_prior(model, known=known)
        return nominal_prior(model, table.uncertainty, known)
    except IdentificationError as error:
        return str(error)


def require_prior(prior: GaussianPrior | str) -> GaussianPrior:
    """Return the prior of a cell.

    Raises:
        InputError: there is none.
    """
    if isinstance(prior, str):
        problem = f"there is no prior: {prior}"
        remedy = "give inertias in the URDF, or use --estimator wls"
        raise InputError(None, problem, field="--estimator prior", remedy=remedy)
    return prior


# Estimators


def fit_of(
    model: RobotModel,
    name: str,
    shrinkage: Shrinkage = Shrinkage(),  # noqa: B008 - frozen
    centre: Array | None = None,
    prior: GaussianPrior | None = None,
) -> Fit:
    """Return the fit function of an estimator that works on factors.

    `centre` (p,) is the consistent solution to shrink to, None for least squares; `prior` is that
    of the estimator "prior".
    """

    def fit(some: Sequence[Samples], factor: Factor) -> Estimate:
        if centre is not None:
            return fit_shrunk(model, some, shrinkage, centre=centre, factor=factor)
        if prior is not None:
            return fit_with_prior(model, some, prior, factor=factor).estimate
        weighting: Weighting = "ordinary" if name == "ols" else "weighted"
        found = fit_least_squares(model, some, weighting, factor=factor)
        if name == "consistent":
            found = consistent_estimate(model, factor, found).estimate
        return found

    return fit


def refit_of(
    model: RobotModel,
    name: Estimator,
    shrinkage: Shrinkage,
    prior: GaussianPrior | str,
    posterior: PosteriorEstimate | str,
) -> Refit:
    """Return the parameters (p,) by an estimator as a function of a factor.

    Robust losses and instruments need samples; weighted least squares represents them.
    """
    if name == "ols":
        return lambda factor: factor.solve(np.ones(model.n_joints)).values
    if name == "prior" and not isinstance(prior, str) and not isinstance(posterior, str):
        effect = posterior.design_effect
        return lambda factor: with_prior(model, factor, prior, design_effect=effect).estimate.values
    if name == "consistent":
        shrinkage = Shrinkage(strength=math.inf)
    elif name != "auto":
        shrinkage = Shrinkage()
    return lambda factor: fitted_values(model, factor, shrinkage)


def centre_of(
    model: RobotModel, total: Factor, shrinkage: Shrinkage
) -> tuple[Array | None, list[str]]:
    """Return the consistent solution (p,) that estimates are shrunk towards; and warnings."""
    try:
        found = consistent_estimate(model, total, prior_weight=shrinkage.prior_weight)
    except SolverError as error:
        return None, [f"least squares is reported because {error}"]
    return found.estimate.values, []


def _by_factor(
    model: RobotModel,
    fitted: Sequence[Samples],
    name: Estimator,
    shrinkage: Shrinkage,
    prior: GaussianPrior | str,
) -> tuple[RepeatedEstimate, list[str]]:
    centre, warnings = None, list[str]()
    if name == "auto" and shrinkage.strength > 0.0:
        centre, warnings = centre_of(model, total_factor(model, fitted), shrinkage)
    own = require_prior(prior) if name == "prior" else None
    fit = fit_of(model, name, shrinkage, centre, own)
    free = name == "consistent" or (centre is not None and math.isinf(shrinkage.strength))
    try:
        # The scatter over repetitions shows noise; least squares is enough for it.
        each = fit_of(model, "wls") if free else fit
        return estimate_repetitions(model, fitted, fit, each=each), warnings
    except IdentificationError as error:
        if name != "consistent":
            raise
        problem = f"no physically consistent parameters were found: {error}"
        remedy = "use --estimator wls and read the consistency in its verdict"
        raise InputError(None, problem, field="--estimator consistent", remedy=remedy) from error


_LOSSES: Final[dict[str, Loss]] = {"huber": Huber(), "tukey": Tukey()}


def _robust(
    model: RobotModel, fitted: Sequence[Samples], name: str
) -> tuple[RepeatedEstimate, list[str]]:
    fits: list[RobustEstimate] = []

    def fit(some: Sequence[Samples], total: Factor) -> Estimate:
        fits.append(robust_estimate(model, some, _LOSSES[name], total=total))
        return fits[-1].estimate

    result, found = estimate_repetitions(model, fitted, fit), fits[-1]  # the last: all samples
    warnings = [
        f"{found.outlying[joint]:.0%} of the rows of {model.joint_names[joint]} deviate by more "
        "than four standard deviations: an unmodelled effect rather than outliers, which a robust "
        "loss would hide; use --estimator wls"
        for joint in np.flatnonzero(found.doubtful)
    ]
    if not found.converged:
        warnings.append(f"the reweighting did not converge in {found.iterations} iterations")
    return result, warnings


def _prior_contradictions(model: RobotModel, posterior: PosteriorEstimate) -> list[str]:
    far = np.flatnonzero(np.abs(np.nan_to_num(posterior.normalized_change)) > _MAX_PRIOR_DEVIATION)
    if not far.size:
        return []
    return [
        f"data and prior of {joined([model.parameter_names[k] for k in far])} differ by more"
        f" than {_MAX_PRIOR_DEVIATION:g} standard deviations: correct the CAD values, or their"
        " uncertainty in [nominal]"
    ]


# Instruments


def smoothed_for_instruments(model: RobotModel, prepared: Prepared) -> tuple[Samples, ...]:
    """Return the fitted samples, smoothed with a bandwidth of at least `MIN_IV_BANDWIDTH`."""
    wide = prepared.settings.preprocessed(rigid_bandwidth=MIN_IV_BANDWIDTH)
    noiseless = replace(wide, noise_variance=(0.0,) * model.n_joints)
    return tuple(
        samples
        if float(samples.position_bandwidth.min()) >= MIN_IV_BANDWIDTH
        else samples_of(source, prepared.sources.cell, noiseless)
        for source, samples in zip(prepared.sources.training, prepared.fitted, strict=True)
    )


def _instrumental(
    model: RobotModel, prepared: Prepared, fitted: Sequence[Samples]
) -> tuple[RepeatedEstimate, list[str]]:
    """Fit with the commanded motion as instruments."""
    factors = []
    plans: list[_Plan] = []
    try:
        for samples, source in zip(fitted, prepared.sources.training, strict=True):
            commanded = source.recording.commanded_position
            if commanded is None:
                raise IdentificationError("the recordings hold no commanded positions")
            plan = samples.motion.time - samples.origin, commanded
            lag = next((known for one, known in plans if same_plan(one, plan)), None)
            planned = planned_motion(samples, commanded, lag=lag)
            if lag is None:
                plans.append((plan, planned.lag))
            factors.append(instrument_factor(model, samples, planned.motion, planned.usable))
        pooled = estimate_instrumental(model, sum(factors[1:], factors[0]))
        each = tuple(estimate_instrumental(model, factor).estimate for factor in factors)
    except IdentificationError as error:
        problem = f"there are no instruments: {error}"
        remedy = "record the commanded positions as well, or use --estimator wls"
        raise InputError(None, problem, field="--estimator iv", remedy=remedy) from error
    result = RepeatedEstimate.of(model, pooled.estimate, each, total_factor(model, fitted))
    return result, [
        f"the instruments are too weak for {joined(pooled.weak)}"
    ] if pooled.weak else []
