"""Estimates from factors, by the estimators that need no samples."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from hil.identify.estimating import centre_of, fit_of
from hil.identify.settings import Settings
from identification import IdentificationError
from identification.estimators.consistent import Shrinkage, fit_shrunk
from identification.estimators.delay import with_uncertain_delay
from identification.estimators.least_squares import no_narrower
from identification.factor.factor import (
    QR_CONDITION,
    Estimate,
    Factor,
    joint_weights,
    mark_undetermined,
    no_rows_message,
    solve,
)
from identification.model.robot import RobotModel

from .types import ArchiveRef, BatchEstimator, Bundle, Level, LevelEstimate, Summary

Array = NDArray[np.float64]

_NAMED: Final = 12  # different warnings that are listed


@dataclass(eq=False)
class Group:
    """Archives that are fitted together, and the sums that predict and are predicted."""

    refs: list[ArchiveRef] = field(default_factory=list)  #: archives that were fitted
    total: Factor | None = None  #: sum of their factors; None if there are none
    repetitions: list[LevelEstimate] = field(default_factory=list)  #: estimates of each
    unseen: Factor | None = None  #: sum of the totals of validation runs; None if none
    #: sum of those of the archives, see :attr:`hil.batch.types.Summary.products`
    products: Array | None = None
    #: every archive, with the warnings about it
    warned: list[tuple[ArchiveRef, tuple[str, ...]]] = field(default_factory=list)
    settings: set[str] = field(default_factory=set)  #: digests

    def add_bundle(self, bundle: Bundle) -> None:
        """Add archives without their estimates."""
        self.total = plus(self.total, bundle.total)
        for summary in bundle.summaries:
            self.warned.append((summary.ref, summary.warnings))
            if summary.ref.use == "excitation":
                self.refs.append(summary.ref)
                self.products = plus(self.products, summary.products)
            else:
                self.unseen = plus(self.unseen, summary.total)

    def add(self, other: Group) -> None:
        """Add another group."""
        self.refs += other.refs
        self.total = plus(self.total, other.total)
        self.repetitions += other.repetitions
        self.unseen = plus(self.unseen, other.unseen)
        self.products = plus(self.products, other.products)
        self.warned += other.warned
        self.settings |= other.settings


def plus(one: Any, other: Any) -> Any:
    """Return the sum of two terms, of which None is zero."""
    return one if other is None else other if one is None else one + other


class Estimator:
    """An estimator for one arm; the model has the friction law of its settings."""

    def __init__(self, name: BatchEstimator, model: RobotModel, settings: Settings) -> None:
        self.name, self.model, self.delay_variance = name, model, settings.delay_variance
        self._shrinkage = settings.shrinkage if name == "auto" else Shrinkage()

    def centre(self, total: Factor) -> Array | None:
        """Return the centre of shrinkage of a sum and its archives (p,); None for none.

        Raises:
            IdentificationError: there is no usable row.
        """
        if not total.samples.any():
            raise IdentificationError(no_rows_message(self.model))
        if self._shrinkage.strength == 0.0:
            return None
        return centre_of(self.model, total, self._shrinkage)[0]

    def of_archive(self, summary: Summary, centre: Array | None) -> Estimate:
        """Return the estimate from one archive, shrunk towards the centre of all.

        That of the consistent estimator is unconstrained, as in `hil identify`. The covariance is
        that of the unconstrained estimate, shrunk by the same factor.
        """
        # A copy: the total itself does not cache what is computed here.
        own, total = summary.fit, replace(summary.total)
        assert own is not None, "it was fitted"
        if centre is None or math.isinf(self._shrinkage.strength):
            return own
        shrunk = fit_shrunk(self.model, (), self._shrinkage, centre=centre, factor=total)
        equations = total.weighted(joint_weights(total))
        prior = self._shrinkage.strength * np.diag(equations.A)
        solution = solve(equations._replace(A=equations.A + np.diag(prior)))
        share = solution.inverse @ equations.A
        known = np.where(np.isfinite(own.covariance), own.covariance, 0.0)
        covariance = share @ known @ share.T
        effect = max(1.0, summary.design_effect)
        covariance += effect * (solution.inverse * prior) @ solution.inverse
        mark_undetermined(covariance, solution.determined)
        intervals = own.method.partition(", ")[2]
        return replace(
            shrunk,
            covariance=covariance,
            interval_factor=own.interval_factor,
            method=f"weighted least squares, {self._shrinkage.describe()}; {intervals}",
        )

    def of_group(self, group: Group, centre: Array | None) -> Estimate:
        """Return the estimate from a sum over archives, shrunk towards its centre.

        Its intervals are at least as wide as the scatter of repetitions of one motion.

        Raises:
            IdentificationError: there is no consistent solution.
        """
        assert group.total is not None
        fit = fit_of(self.model, self.name, self._shrinkage, centre)
        found = fit((), group.total)
        motions = {ref.motion for ref in group.refs}
        if len(motions) == 1 and "" not in motions:
            values = np.array([one.values for one in group.repetitions])
            found = replace(found, covariance=no_narrower(found.covariance, values))
        if group.products is None:
            return found
        return with_uncertain_delay(found, group.total, group.products, self.delay_variance)


def warning_lines(warned: Sequence[tuple[ArchiveRef, Sequence[str]]]) -> tuple[str, ...]:
    """Return warnings with the archives they concern, most frequent first."""
    counts = Counter(text for _, warnings in warned for text in warnings)
    first = {text: ref for ref, warnings in reversed(warned) for text in warnings}
    found = []
    for text, count in counts.most_common(_NAMED):
        name = f"{first[text].campaign.rsplit('/', 1)[-1]}/{first[text].name}"
        some = f"{count} of {len(warned)} archives, such as {name}: {text}"
        found.append(text if count == len(warned) else some)
    if len(counts) > _NAMED:
        found.append(f"{len(counts) - _NAMED} more warnings are listed with the repetitions")
    return tuple(found)


def repetition_level(
    estimator: Estimator, summary: Summary, settings: str, centre: Array | None = None
) -> LevelEstimate:
    """Return the estimate of one archive, shrunk towards the centre of its group.

    Its arrays are copies: a batch may have very many.
    """
    ref, model = summary.ref, estimator.model
    found = estimator.of_archive(summary, centre)
    own = {name: getattr(found, name).copy() for name in ("values", "noise_std", "samples")}
    nothing = np.full(model.n_joints, np.nan)
    return LevelEstimate(
        level="repetition",
        arm=ref.arm,
        campaign=ref.campaign,
        archive=ref.location,
        sha256=ref.sha256,
        when=ref.when,
        repetitions=1,
        **(_figures(found) | own | {"names": model.parameter_names, "units": model.units}),
        covariance=None,
        torque_rms=_rms(replace(summary.total)),
        unseen_rms=nothing,
        unseen_torque_rms=nothing,
        settings=settings,
        warnings=summary.warnings,
        setup=ref.setup,
    )


def sum_level(
    level: Level,
    estimator: Estimator,
    group: Group,
    centre: Array | None,
    warnings: Sequence[str] = (),
) -> LevelEstimate:
    """Return the estimate of a campaign, or of all campaigns of an arm, for its centre if any.

    Raises:
        IdentificationError: there is no estimate.
    """
    assert group.total is not None
    refs, found = group.refs, estimator.of_group(group, centre)
    setups = {ref.setup for ref in refs}
    unseen = Factor.zero(estimator.model) if group.unseen is None else group.unseen
    if not found.undetermined and found.condition > QR_CONDITION:
        conditioning = (
            f"the scaled condition number is {found.condition:.2g}: the motion separates some"
            " parameters poorly, and sums of squares lose digits there; `hil identify` on these"
            " archives uses QR"
        )
        warnings = (conditioning, *warnings)
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
        torque_rms=_rms(group.total),
        unseen_rms=_rms(unseen, unseen.squared_errors(found.values)),
        unseen_torque_rms=_rms(unseen),
        settings=next(iter(group.settings)) if len(group.settings) == 1 else "",
        warnings=(*warnings, *warning_lines(group.warned)),
        setup=setups.pop() if len(setups) == 1 else "",
    )


def _rms(factor: Factor, squares: Array | None = None) -> Array:
    """Return the RMS per joint (n,) of sums over rows, by default of the torque; NaN of none."""
    squares = factor.gram[:, -1, -1] if squares is None else squares
    return np.asarray(np.sqrt(squares / np.where(factor.samples > 0, factor.samples, np.nan)))


def relative_error(error: Array, torque: Array, rows: NDArray[np.intp] | None = None) -> float:
    """Return the RMS error over the RMS torque of all joints; NaN where unknown.

    Both are given per joint (n,), for `rows` (n,) rows or equally many.
    """
    count = np.ones(len(error)) if rows is None else rows.astype(np.float64)
    known = (count > 0.0) & np.isfinite(error) & np.isfinite(torque)
    whole = float(count[known] @ torque[known] ** 2)
    return math.sqrt(float(count[known] @ error[known] ** 2) / whole) if whole > 0.0 else math.nan


def _figures(found: Estimate) -> dict[str, Any]:
    names = (
        *("names", "units", "values", "std", "interval_factor", "samples", "noise_std"),
        *("condition", "undetermined", "method"),
    )
    return {name: getattr(found, name) for name in names}
