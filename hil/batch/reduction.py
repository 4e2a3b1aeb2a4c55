"""Archives reduced to the sum of their factors and a summary of each, cached as `.npz`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from sys import intern
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from hil.archive import Archive
from hil.base.errors import ArchiveError
from hil.base.files import json_digest
from hil.pipeline.prepared import known_parameters, samples_of, validation_samples
from hil.pipeline.sources import Source, known_warnings, source_of
from identification.estimators.delay import rate_products
from identification.estimators.least_squares import fit_least_squares
from identification.estimators.prior import ScoreScatter, body_prior
from identification.factor.estimate import Estimate
from identification.factor.factor import Factor
from identification.selection.settings import Settings

from .cache import Arrays, CacheLocation, code_digest
from .cluster import SkippedArchive, reason_of
from .discovery import ArchiveRef, cell_in, open_ref

Array = NDArray[np.float64]
Term = TypeVar("Term", Factor, Array)


@dataclass(frozen=True, eq=False)
class Summary:
    """Results of one archive, beside the sum of several."""

    ref: ArchiveRef
    total: Factor  #: its factor as one block
    #: the estimate from it alone without prior, with cluster-robust covariance; None of a
    #: validation run
    fit: Estimate | None
    scatter: ScoreScatter | None  #: for the estimate with a prior; None of a validation run
    warnings: tuple[str, ...] = ()  #: about the archive
    #: (n, p, p + 1), see :func:`identification.estimators.delay.rate_products`; None where the
    #: delay is known, or the archive is not fitted
    products: Array | None = None


@dataclass(frozen=True, eq=False)
class Reduction:
    """One archive, or several of one campaign, reduced."""

    summaries: tuple[Summary, ...] = ()  #: of the readable ones, in their order
    #: sum of the factors, by time, of those that are fitted; None if there are none
    total: Factor | None = None
    broken: tuple[SkippedArchive, ...] = ()  #: the others
    read: int = 0  #: number of archives that were read, broken ones included
    cached: int = 0  #: number of the others


def settings_digest(settings: Settings) -> str:
    """Return the digest of the settings that determine the factor of an archive."""
    entries = asdict(settings)
    for later in ("strength", "choices"):  # of the estimate only
        del entries[later]
    return json_digest([entries, code_digest()])


def reduction_key(refs: Sequence[ArchiveRef], settings: Settings) -> str:
    """Return the key of archives that are reduced, and added in this order."""
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
            remedy="find the torque constants with `hil torque-constants` and import it again",
        )
    return archive, source


def archive_factor(ref: ArchiveRef, settings: Settings) -> tuple[Summary, Factor]:
    """Reduce one archive to its summary and its factor by blocks of time.

    Raises:
        HilError: it cannot be read, is damaged, was changed, or cannot be identified from.
        IdentificationError: it has no usable row.
    """
    archive, source = load_source(ref)
    cell = cell_in(archive, settings)
    is_fitted = ref.use == "excitation"
    samples = (samples_of if is_fitted else validation_samples)(source, cell, settings)
    model = cell.model
    if settings.loading is not None:
        samples = samples.with_load(model, np.array(settings.loading))
    factor = Factor.by_time(model, samples)
    fit = None
    scatter = None
    if is_fitted:
        fit = fit_least_squares(model, [samples], factor=factor)
        prior = body_prior(model, factor, stated=known_parameters(cell))
        scatter = ScoreScatter.of(factor, prior.gaussian)
    warnings = [*known_warnings(cell, archive), *archive.header.findings.warnings]
    if source.merged:
        warnings.append(source.merged)
    if archive.outcome is not None and archive.outcome.repaired:
        warnings.append("it was repaired with loss")
    has_products = is_fitted and settings.delay_variance
    return Summary(
        ref=ref,
        total=factor.merged(max(1, len(factor))),
        fit=fit,
        scatter=scatter,
        warnings=tuple(warnings),
        products=rate_products(model, samples) if has_products else None,
    ), factor


def reduce_archives(
    refs: Sequence[ArchiveRef], settings: Settings, cache: CacheLocation
) -> Reduction:
    """Reduce archives of one campaign and add them up.

    Each is cached by itself; so is the sum, if all of them are usable.

    Raises:
        CacheError: the cache cannot be written.
    """
    cached = cached_reduction(refs, settings, cache)
    if cached is not None:
        return cached
    if len(refs) == 1:
        return _reduce_archive(refs[0], settings, cache)
    result = added(_reduce_archive(ref, settings, cache) for ref in refs)
    if not result.broken:
        _write(result, settings, cache)
    return result


def _reduce_archive(ref: ArchiveRef, settings: Settings, cache: CacheLocation) -> Reduction:
    cached = cached_reduction((ref,), settings, cache)
    if cached is not None:
        return cached
    try:
        summary, factor = archive_factor(ref, settings)
    except Exception as error:
        return Reduction(broken=(SkippedArchive(ref.location, reason_of(error)),), read=1)
    result = Reduction((summary,), factor if ref.use == "excitation" else None, read=1)
    _write(result, settings, cache)
    return result


def ensure_reduced(ref: ArchiveRef, settings: Settings, cache: CacheLocation) -> None:
    """Reduce one archive, to find out whether that ends the process."""
    reduce_archives((ref,), settings, cache)


def added(parts: Iterable[Reduction]) -> Reduction:
    """Add reductions in their order."""
    result = Reduction()
    summaries = list[Summary]()
    broken = list[SkippedArchive]()
    for part in parts:
        summaries += part.summaries
        broken += part.broken
        result = replace(
            result,
            total=plus(result.total, part.total),
            read=result.read + part.read,
            cached=result.cached + part.cached,
        )
    return replace(result, summaries=tuple(summaries), broken=tuple(broken))


def plus(first: Term | None, second: Term | None) -> Term | None:
    """Return the sum of two terms, of which None is zero."""
    if first is None or second is None:
        return second if first is None else first
    return first + second


# Files

FIT: Final = ("values", "covariance", "noise_std", "samples")
"""Arrays of the estimate of an archive. It outlives the sum, and so has copies of its own."""


def cached_reduction(
    refs: Sequence[ArchiveRef], settings: Settings, cache: CacheLocation
) -> Reduction | None:
    """Return the cached reduction of exactly these archives; None if there is none."""
    entry = cache.read(refs[0].location, reduction_key(refs, settings))
    if entry is None:
        return None
    try:
        return _unpacked(refs, *entry)
    except (KeyError, ValueError, TypeError, IndexError):  # not an entry of this program
        return None


def _write(reduction: Reduction, settings: Settings, cache: CacheLocation) -> None:
    refs = [summary.ref for summary in reduction.summaries]
    cache.write(refs[0].location, reduction_key(refs, settings), *_packed(reduction))


def _packed(reduction: Reduction) -> tuple[dict[str, Any], Arrays]:
    """Return a reduction as JSON data and arrays: each kind in one array for all archives."""
    summaries = reduction.summaries
    first = summaries[0].total
    totals = [_triangles(summary.total) for summary in summaries]
    arrays: Arrays = {
        "counts": np.concatenate([summary.total.counts for summary in summaries]),
        "totals": np.concatenate(totals),
    }
    if reduction.total is not None:
        arrays["sum_counts"] = reduction.total.counts
        arrays["sum"] = _triangles(reduction.total)
    fits = [summary.fit for summary in summaries if summary.fit is not None]
    for name in FIT:
        arrays[name] = np.array([getattr(fit, name) for fit in fits])
    scatters = [summary.scatter for summary in summaries if summary.scatter is not None]
    if scatters:
        arrays["scatter"] = np.concatenate([scatter.rows for scatter in scatters])
    products = [summary.products for summary in summaries if summary.products is not None]
    if products:
        arrays["products"] = np.array(products)
    return {
        "parameters": first.parameter_names,
        "units": fits[0].units if fits else (),
        "columns": [columns.tolist() for columns in first.columns],
        "block": None if reduction.total is None else reduction.total.block,
        "archives": [_entry(summary) for summary in summaries],
    }, arrays


def _triangles(factor: Factor) -> Array:
    """Return the upper triangles of the Gram matrices, which are symmetric, side by side (B, k).

    Block by block in memory: :func:`_matrices` takes five times as long from another order.
    """
    joints = []
    for matrices in factor.matrices:
        row, column = np.triu_indices(matrices.shape[1])
        joints.append(matrices[:, row, column])
    return np.ascontiguousarray(np.concatenate(joints, axis=1))


def _matrices(triangles: Array, columns: Sequence[NDArray[np.intp]]) -> tuple[Array, ...]:
    """Return the Gram matrices of the joints (B, c_j + 1, c_j + 1) of :func:`_triangles`."""
    places = _places(tuple(len(joint_columns) + 1 for joint_columns in columns))
    return tuple(np.take(triangles, place, axis=1) for place in places)


@lru_cache(maxsize=8)
def _places(widths: tuple[int, ...]) -> tuple[NDArray[np.intp], ...]:
    """Return the places in triangles, side by side, of the entries of matrices of these widths."""
    places = []
    begin = 0
    for width in widths:
        place = np.zeros((width, width), dtype=np.intp)
        row, column = np.triu_indices(width)
        end = begin + len(row)
        place[row, column] = place[column, row] = np.arange(begin, end)
        places.append(place)
        begin = end
    return tuple(places)


def _entry(summary: Summary) -> dict[str, Any]:
    """Return what is no array of an archive, as JSON data."""
    fit = summary.fit
    scatter = summary.scatter
    entry: dict[str, Any] = {
        "warnings": summary.warnings,
        "products": summary.products is not None,
    }
    if fit is not None and scatter is not None:
        entry["fit"] = {
            "method": fit.method,
            "condition": fit.condition,
            "undetermined": fit.undetermined,
            "interval_factor": fit.interval_factor,
        }
        entry["scatter"] = {
            "rows": len(scatter.rows),
            "interval_factor": scatter.interval_factor,
            "description": scatter.description,
        }
    return entry


def _unpacked(
    refs: Sequence[ArchiveRef], content: dict[str, Any], arrays: Arrays
) -> Reduction | None:
    """Return the reduction of a file, whose archives may have been moved since."""
    if len(content["archives"]) != len(refs):
        return None
    names = tuple(map(intern, content["parameters"]))
    units = tuple(map(intern, content["units"]))
    columns = tuple(np.array(joint, dtype=np.intp) for joint in content["columns"])
    totals = _matrices(arrays["totals"], columns)
    summaries = []
    fit_number = 0
    scatter_begin = 0
    products_number = 0
    for number, (ref, entry) in enumerate(zip(refs, content["archives"], strict=True)):
        rows = slice(number, number + 1)
        fit = None
        scatter = None
        products = None
        if "fit" in entry:
            stated = entry["fit"]
            fit = Estimate(
                names=names,
                units=units,
                **{name: arrays[name][fit_number].copy() for name in FIT},
                method=intern(stated["method"]),
                condition=stated["condition"],
                undetermined=tuple(stated["undetermined"]),
                interval_factor=stated["interval_factor"],
            )
            scatter_end = scatter_begin + entry["scatter"].pop("rows")
            scatter_rows = arrays["scatter"][scatter_begin:scatter_end]
            scatter = ScoreScatter(scatter_rows, **entry["scatter"])
            fit_number += 1
            scatter_begin = scatter_end
        if entry["products"]:
            products = arrays["products"][products_number]
            products_number += 1
        summaries.append(
            Summary(
                ref=ref,
                total=Factor(
                    tuple(grams[rows] for grams in totals), columns, arrays["counts"][rows], names
                ),
                fit=fit,
                scatter=scatter,
                warnings=tuple(map(intern, entry["warnings"])),
                products=products,
            )
        )
    total = None
    if "sum_counts" in arrays:
        grams = _matrices(arrays["sum"], columns)
        total = Factor(grams, columns, arrays["sum_counts"], names, block=content["block"])
    return Reduction(tuple(summaries), total, cached=len(refs))
