"""Tasks of a worker: decide settings, reduce archives to factors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hil.archive import Archive
from hil.errors import ArchiveError
from hil.files import json_digest
from hil.identify.options import Options
from hil.identify.prepared import (
    MAX_RECORDINGS,
    Settings,
    carried_over,
    decide,
    samples_of,
    validation_samples,
)
from hil.identify.sources import Source, all_fitted, known_warnings, source_of
from hil.progress import Silent
from identification.estimators.covariance import block_covariance
from identification.estimators.delay import rate_products
from identification.estimators.least_squares import fit_least_squares
from identification.factor.factor import Estimate, Factor, joint_weights
from identification.model.robot import RobotModel
from identification.signals.samples import Samples

from .cache import CacheLocation, cacheable, code_digest
from .discovery import ArchiveRef, cell_in, open_ref
from .workers import Unused, reason_of

Array = NDArray[np.float64]

BUNDLE: Final = 16
"""Archives in one entry of the cache: a summary of each and one sum, fifty times its size."""


@cacheable
@dataclass(frozen=True, eq=False)
class Summary:
    """Cached results of one archive, beside the sum of several."""

    ref: ArchiveRef
    total: Factor  #: its factor as one block
    #: the estimate from it alone, with cluster-robust covariance; None of a validation run
    fit: Estimate | None
    design_effect: float  #: ratio of its mean variance to that of white residuals
    warnings: tuple[str, ...] = ()  #: about the archive
    #: (n, p, p + 1), see :func:`identification.estimators.delay.rate_products`; None where the
    #: delay is known, or the archive is not fitted
    products: Array | None = None


@cacheable
@dataclass(frozen=True, eq=False)
class Bundle:
    """Results of several archives of one campaign."""

    summaries: tuple[Summary, ...] = ()  #: of the readable ones, in their order
    #: sum of the factors of those that are fitted; None if there are none
    total: Factor | None = None
    broken: tuple[Unused, ...] = ()  #: the others
    read: int = 0  #: number of archives that were read, broken ones included
    cached: int = 0  #: number of the others


def settings_digest(settings: Settings) -> str:
    """Return the digest of the settings that determine the factor of an archive."""
    entries = asdict(settings)
    for later in ("shrinkage", "choices"):  # of the estimate only
        del entries[later]
    return json_digest([entries, code_digest()])


def decision_digest(options: Options, arms: Settings | None, refs: Sequence[ArchiveRef]) -> str:
    """Return the digest of the inputs of a decision: options or the arm's settings, archives, code.

    Of the estimators only the automatic one influences the settings.
    """
    asked = asdict(options) | {"estimator": options.estimator == "auto"}
    known = None if arms is None else asdict(arms)
    return json_digest([asked, known, [ref.sha256 for ref in refs], code_digest()])


def sum_key(refs: Sequence[ArchiveRef], settings: Settings) -> str:
    """Return the key of the sum over archives, added in this order."""
    return json_digest(["sum", [ref.sha256 for ref in refs], settings_digest(settings)])


def load_source(ref: ArchiveRef, *, to_fit: bool = True) -> tuple[Archive, Source]:
    """Return an archive and its usable signals.

    Raises:
        HilError: it cannot be read, is damaged, was changed, or cannot be identified from.
    """
    archive = open_ref(ref)
    source = source_of(archive, cell_in(archive), to_fit=to_fit)
    if to_fit and source.recording.torque is None:
        raise ArchiveError(
            ref.location,
            "has motor currents and no torques",
            remedy="find the torque constants with `hil gains` and import it again",
        )
    return archive, source


# Settings


def archives_for_settings(
    refs: Sequence[ArchiveRef], arms: Settings | None
) -> tuple[ArchiveRef, ...]:
    """Return the archives that determine a campaign's settings, those at standstill first."""
    ordered = sorted(refs, key=lambda ref: ref.order)
    rest = [ref for ref in ordered if ref.use == "standstill"]
    fitted = [ref for ref in ordered if ref.use == "excitation"]
    return (*rest, *fitted[: 1 if arms is not None and rest else MAX_RECORDINGS])


def cached_settings(
    refs: Sequence[ArchiveRef], options: Options, arms: Settings | None, cache: CacheLocation
) -> Settings | None:
    """Return the settings that were decided from these archives before."""
    if not refs:
        return None
    return cache.get(refs[0].location, decision_digest(options, arms, refs), Settings)


def decide_settings(
    refs: Sequence[ArchiveRef], options: Options, arms: Settings | None, cache: CacheLocation
) -> tuple[Settings | None, list[Unused]]:
    """Decide a campaign's settings from `archives_for_settings` and cache them.

    They are those of the arm, if it has any, with the campaign's own noise. Returned with the
    archives that could not be read; None if no excitation is left.

    Raises:
        RecordingError: a recording cannot be prepared.
        IdentificationError: a delay was requested and there is no usable row.
    """
    broken: list[Unused] = []
    rest: Source | None = None
    fitted: list[tuple[Archive, Source]] = []
    for ref in refs:
        try:
            if ref.use != "standstill":
                fitted.append(load_source(ref))
            elif rest is None:
                rest = load_source(ref, to_fit=False)[1]
        except Exception as error:
            broken.append(Unused(ref.location, reason_of(error)))
    if not fitted:
        return None, broken
    standstill = None if rest is None else rest.recording
    sources = all_fitted(cell_in(fitted[0][0]), fitted, standstill)
    if arms is None:
        settings = decide(sources, options, Silent()).settings
    else:
        settings = carried_over(arms, sources, options)
    if not broken:
        cache.put(refs[0].location, decision_digest(options, arms, refs), settings)
    return settings, broken


# Factors


def archive_factor(ref: ArchiveRef, settings: Settings) -> tuple[Summary, Factor]:
    """Reduce one archive to its summary and its factor by blocks of time.

    Raises:
        HilError: it cannot be read, is damaged, was changed, or cannot be identified from.
        IdentificationError: it has no usable row.
    """
    archive, source = load_source(ref)
    cell, fitted = cell_in(archive, settings), ref.use == "excitation"
    samples = (samples_of if fitted else validation_samples)(source, cell, settings)
    model = cell.model
    factor = Factor.by_time(model, samples)
    fit, effect = _fit(model, samples, factor) if fitted else (None, 1.0)
    warnings = [*known_warnings(cell, archive), *archive.header.findings.warnings]
    if source.merged:
        warnings.append(source.merged)
    if archive.outcome is not None and archive.outcome.repaired:
        warnings.append("it was repaired with loss")
    return Summary(
        ref=ref,
        total=factor.merged(max(1, len(factor))),
        fit=fit,
        design_effect=effect,
        warnings=tuple(warnings),
        products=rate_products(model, samples) if fitted and settings.delay_variance else None,
    ), factor


def _fit(model: RobotModel, samples: Samples, factor: Factor) -> tuple[Estimate, float]:
    """Return the estimate, and the mean ratio of its variances to those of white residuals."""
    found = fit_least_squares(model, [samples], factor=factor)
    weights = joint_weights(factor)
    if found.undetermined:
        return found, block_covariance(factor, weights, found.values).design_effect
    information = factor.weighted(weights).A
    trace = np.einsum("ij,ji->", information, found.covariance)
    return found, float(trace) / factor.n_parameters


def split_bundles(refs: Sequence[ArchiveRef]) -> list[tuple[ArchiveRef, ...]]:
    """Divide the archives of one campaign into bundles, in the order of sums."""
    ordered = sorted(refs, key=lambda ref: ref.order)
    return [tuple(ordered[k : k + BUNDLE]) for k in range(0, len(ordered), BUNDLE)]


def reduce_bundle(refs: Sequence[ArchiveRef], settings: Settings, cache: CacheLocation) -> Bundle:
    """Reduce archives of one campaign, and cache the result if all of them are usable.

    Raises:
        CacheError: the cache cannot be written.
    """
    if (known := cached_bundle(refs, settings, cache)) is not None:
        return known
    summaries, broken, total = list[Summary](), list[Unused](), None
    for ref in refs:
        try:
            summary, own = archive_factor(ref, settings)
        except Exception as error:
            broken.append(Unused(ref.location, reason_of(error)))
        else:
            summaries.append(summary)
            if ref.use == "excitation":
                total = own if total is None else total + own
    found = Bundle(tuple(summaries), total)
    if not broken:
        cache.put(refs[0].location, sum_key(refs, settings), found)
    return replace(found, broken=tuple(broken), read=len(refs))


def cached_bundle(
    refs: Sequence[ArchiveRef], settings: Settings, cache: CacheLocation
) -> Bundle | None:
    """Return the cached bundle of these archives; None unless all are in the cache."""
    found = cache.get(refs[0].location, sum_key(refs, settings), Bundle)
    if found is None or len(found.summaries) != len(refs):
        return None
    pairs = zip(found.summaries, refs, strict=True)  # the archives may have been moved
    summaries = tuple(replace(one, ref=ref) for one, ref in pairs)
    return Bundle(summaries, found.total, cached=len(refs))


def is_cached(refs: Sequence[ArchiveRef], settings: Settings, cache: CacheLocation) -> bool:
    """Return whether there is a cache entry of these archives, intact or not."""
    return cache.has(refs[0].location, sum_key(refs, settings))
