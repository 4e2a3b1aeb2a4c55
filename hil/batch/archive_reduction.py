"""Archives reduced to the sum of their rows and a summary of each, cached as `.npz`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from sys import intern
from typing import Any, Final, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from hil.archive import Archive
from hil.base.arrays import Array
from hil.base.errors import ArchiveError
from hil.base.files import json_digest
from hil.pipeline.notes import MergedSamples, Note, OtherMeaning, RepairedArchive, StatedText
from hil.pipeline.other_meanings import other_meanings
from hil.pipeline.prepared import known_parameters, reduction_of, versions_of
from hil.pipeline.sources import Source, known_warnings, source_of
from identification.estimators.elasticity import ElasticTorque
from identification.estimators.friction_drift import TREND_PIECES
from identification.estimators.least_squares import fit_least_squares
from identification.estimators.prior import ScoreScatter, body_prior
from identification.factor.estimate import Estimate
from identification.factor.estimation_method import EstimationMethod, TimeBlocks
from identification.factor.factor import Factor
from identification.hypotheses.diagnosis import diagnose
from identification.model.robot import RobotModel
from identification.reduction.reduction import MAX_UNMODELLED_REPETITIONS, Reduction, Unmodelled
from identification.selection.settings import Settings
from identification.signals.samples import Samples
from identification.validation.finding_messages import Naming, worded
from identification.validation.findings.diagnosis import of_diagnosis
from identification.validation.prediction import noise_floor

from .archive_discovery import JOINT_TEMPERATURE, ArchiveRef, cell_in, errors_of_origin, open_ref
from .cache import Arrays, CacheLocation, code_digest
from .cluster import SkippedArchive, reason_of
from .notes import note_as_json, note_of_json

Term = TypeVar("Term", Factor, Reduction)


@dataclass(frozen=True, eq=False)
class Summary:
    """Results of one archive, in addition to the sum of several."""

    ref: ArchiveRef
    #: its factor as one block, or as several parts if the archives are few
    total: Factor
    #: the estimate from it alone without prior, with cluster-robust covariance; None of a
    #: validation run
    fit: Estimate | None
    scatter: ScoreScatter | None  #: for the estimate with a prior; None of a validation run
    warnings: tuple[Note, ...] = ()  #: about the archive
    #: what else it has: mean temperature of each joint [°C], by name
    facts: Mapping[str, float] = field(default_factory=dict)

    @property
    def numbers(self) -> dict[str, float]:
        """What the archive and its log have in addition to the motion, numbers by name."""
        of_log = {name: value for name, value in self.ref.facts.items() if isinstance(value, float)}
        return {**self.facts, **of_log}


@dataclass(frozen=True, eq=False)
class ReducedArchives:
    """One archive, or several of one campaign, reduced."""

    summaries: tuple[Summary, ...] = ()  #: of the readable ones, in their order
    total: Reduction | None = None  #: sum over those that are fitted; None if there are none
    broken: tuple[SkippedArchive, ...] = ()  #: the others
    read: int = 0  #: number of archives that were read, broken ones included
    cached: int = 0  #: number of the others


def settings_digest(settings: Settings) -> str:
    """Return the digest of the settings that determine the factor of an archive."""
    entries = asdict(settings)
    for later in ("strength", "choices"):  # of the estimate only
        del entries[later]
    return json_digest([entries, code_digest()])


class ToReduce(NamedTuple):
    """An archive, and what its campaign needs from it."""

    ref: ArchiveRef
    unmodelled: bool = False  #: whether it is one of those that show what the model lacks
    examined: bool = False  #: whether to ask what it is other than stated
    parts: int = 1  #: parts of its own total, more of few archives, whose friction may drift


def to_reduce(refs: Sequence[ArchiveRef]) -> list[ToReduce]:
    """Return the archives of a campaign with what it needs of each.

    The first of each motion show what the model lacks; of unknown motions the first of all. What a
    recording is other than stated, repetitions of a motion have in common; logs have not.
    """
    fitted = [ref for ref in refs if ref.use == "excitation"]
    seen: Counter[str] = Counter()
    shown, examined = set(), set()
    for ref in fitted:
        if not seen[ref.motion] or ref.kind == "imported":
            examined.add(ref)
        seen[ref.motion] += 1
        if seen[ref.motion] <= MAX_UNMODELLED_REPETITIONS:
            shown.add(ref)
    # Some of them may turn out to be unusable.
    parts = TREND_PIECES if len(fitted) < 2 * TREND_PIECES else 1
    return [
        ToReduce(ref, ref in shown, ref in examined, parts if ref.use == "excitation" else 1)
        for ref in refs
    ]


def reduction_key(archives: Sequence[ToReduce], settings: Settings) -> str:
    """Return the key of archives that are reduced, and added in this order."""
    each = [(one.ref.sha256, one.unmodelled, one.examined, one.parts) for one in archives]
    return json_digest(["sum", each, settings_digest(settings)])


def load_source(ref: ArchiveRef, *, to_fit: bool = True) -> tuple[Archive, Source]:
    """Return an archive and its usable signals.

    Raises:
        HilError: it cannot be read, is damaged, was changed, or cannot be identified from.
    """
    archive = open_ref(ref)
    with errors_of_origin(ref):
        source = source_of(archive, cell_in(archive), to_fit=to_fit)
    if to_fit and source.recording.torque is None:
        raise ArchiveError(
            ref.origin,
            "has motor currents and no torques",
            remedy="find the torque constants with `hil torque-constants` and import it again",
        )
    return archive, source


def reduced_archive(wanted: ToReduce, settings: Settings) -> tuple[Summary, Reduction]:
    """Reduce one archive to its summary and its sums.

    Raises:
        HilError: it cannot be read, is damaged, was changed, or cannot be identified from.
        IdentificationError: it has no usable row.
    """
    ref = wanted.ref
    archive, source = load_source(ref)
    cell = cell_in(archive, settings)
    is_fitted = ref.use == "excitation"
    versions = versions_of(source, cell, settings, for_fit=is_fitted)
    model = cell.model
    how = settings if is_fitted else replace(settings, delay_variance=0.0)
    reduction = reduction_of(cell, how, versions, unmodelled=wanted.unmodelled)
    factor = reduction.factor
    fit = None
    scatter = None
    if is_fitted:
        fit = fit_least_squares(model, versions[:1], factor=factor)
        prior = body_prior(model, factor, stated=known_parameters(cell))
        scatter = ScoreScatter.of(factor, prior.gaussian)
    merged = [MergedSamples(source.merged)] if source.merged else []
    stated = map(StatedText, archive.header.findings.warnings)
    warnings: list[Note] = [*known_warnings(cell, archive), *stated, *merged]
    if wanted.examined and versions[0].usable.any():
        noise = None if fit is None else noise_floor(model, fit.values, versions[:1])
        warnings += _other_meanings(model, versions[0], source, ref.origin, noise)
    if archive.outcome is not None and archive.outcome.repaired:
        warnings.append(RepairedArchive())
    parts = factor.parts(wanted.parts)
    summary = Summary(ref, parts, fit, scatter, tuple(warnings), _temperatures(archive))
    return summary, reduction


def _other_meanings(
    model: RobotModel, samples: Samples, source: Source, origin: str, noise: Array | None
) -> tuple[OtherMeaning, ...]:
    """Return what a recording is other than stated, as a verdict and an import ask it.

    Args:
        model: of the arm.
        samples: of the recording.
        source: it.
        origin: where it comes from.
        noise: standard deviation of the torque noise (n,); None if it cannot be measured.

    Raises:
        ArchiveError: its torque as a whole is, so that no parameter follows from it.
    """
    found = diagnose(model, [samples], noise=noise)
    names = tuple(model.joint_names)
    if found.is_otherwise:
        finding = worded(of_diagnosis(found)[0], Naming(names))
        raise ArchiveError(origin, finding.words, field="torque", remedy=finding.next_step)
    return tuple(OtherMeaning(each, names) for each in other_meanings(found, [source]))


def _temperatures(archive: Archive) -> dict[str, float]:
    """Return the mean temperature of each joint that has one, by names numbered from 1."""
    column = archive.columns.get(JOINT_TEMPERATURE)
    if column is None:
        return {}
    means = {
        f"{JOINT_TEMPERATURE}{number}": values[np.isfinite(values)]
        for number, values in enumerate(column.T, 1)
    }
    return {name: float(values.mean()) for name, values in means.items() if len(values)}


def _summary_key(ref: ArchiveRef, settings: Settings) -> str:
    return json_digest(["summary", ref.sha256, settings_digest(settings)])


def has_summary(ref: ArchiveRef, settings: Settings, cache: CacheLocation) -> bool:
    """Return whether the header data of an archive are cached, so that it need not be read."""
    return cache.has(ref.origin, _summary_key(ref, settings))


def summarise(
    refs: Sequence[ArchiveRef], settings: Settings, cache: CacheLocation
) -> list[Summary | SkippedArchive]:
    """Return what each archive says by itself, or why it cannot be used.

    The sums of archives, a hundred times as large, are neither read nor cached.

    Raises:
        CacheError: the cache cannot be written.
    """
    summaries: list[Summary | SkippedArchive] = []
    for ref in refs:
        key = _summary_key(ref, settings)
        try:
            entry = cache.read(ref.origin, key)
            known = None if entry is None else _unpacked([ref], *entry)
        except (KeyError, ValueError, TypeError, IndexError):  # not an entry of this program
            known = None
        if known is None:
            try:
                wanted = ToReduce(ref, examined=ref.kind == "imported")
                summary = reduced_archive(wanted, settings)[0]
            except Exception as error:
                summaries.append(SkippedArchive(ref.origin, reason_of(error, ref.origin)))
                continue
            known = ReducedArchives((summary,))
            cache.write(ref.origin, key, *_packed(known))
        summaries += known.summaries
    return summaries


def reduce_archives(
    archives: Sequence[ToReduce], settings: Settings, cache: CacheLocation
) -> ReducedArchives:
    """Reduce archives of one campaign and add them up.

    Each is cached by itself; so is the sum, if all of them are usable.

    Raises:
        CacheError: the cache cannot be written.
    """
    cached = cached_reduction(archives, settings, cache)
    if cached is not None:
        return cached
    if len(archives) == 1:
        return _reduce_archive(archives[0], settings, cache)
    result = added(_reduce_archive(one, settings, cache) for one in archives)
    if not result.broken:
        _write(archives, result, settings, cache)
    return result


def _reduce_archive(archive: ToReduce, settings: Settings, cache: CacheLocation) -> ReducedArchives:
    cached = cached_reduction((archive,), settings, cache)
    if cached is not None:
        return cached
    ref = archive.ref
    try:
        summary, reduction = reduced_archive(archive, settings)
    except Exception as error:
        return ReducedArchives(
            broken=(SkippedArchive(ref.origin, reason_of(error, ref.origin)),), read=1
        )
    total = reduction if ref.use == "excitation" else None
    result = ReducedArchives((summary,), total, read=1)
    _write((archive,), result, settings, cache)
    return result


def ensure_reduced(archive: ToReduce, settings: Settings, cache: CacheLocation) -> None:
    """Reduce one archive, to find out whether that ends the process."""
    reduce_archives((archive,), settings, cache)


def added(parts: Iterable[ReducedArchives]) -> ReducedArchives:
    """Add reduced archives in their order."""
    result = ReducedArchives()
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
    """Return the sum of two terms; None counts as zero."""
    if first is None or second is None:
        return second if first is None else first
    return first + second


# Files

ELASTIC: Final = ("products", "squares", "measured", "lost", "compliance")
"""Arrays of the torque of elastic gears."""

FIT: Final = ("values", "covariance", "noise_std", "samples")
"""Arrays of an estimate. It outlives what it is read from, and so has copies of its own."""


def cached_reduction(
    archives: Sequence[ToReduce], settings: Settings, cache: CacheLocation
) -> ReducedArchives | None:
    """Return the cached reduction of exactly these archives, or None."""
    refs = [one.ref for one in archives]
    entry = cache.read(refs[0].origin, reduction_key(archives, settings))
    if entry is None:
        return None
    try:
        return _unpacked(refs, *entry)
    except (KeyError, ValueError, TypeError, IndexError):  # not an entry of this program
        return None


def _write(
    archives: Sequence[ToReduce],
    reduced: ReducedArchives,
    settings: Settings,
    cache: CacheLocation,
) -> None:
    place = archives[0].ref.origin
    cache.write(place, reduction_key(archives, settings), *_packed(reduced))


def _packed(reduced: ReducedArchives) -> tuple[dict[str, Any], Arrays]:
    """Return reduced archives as JSON data and arrays: each kind in one array for all archives."""
    summaries = reduced.summaries
    first = summaries[0].total
    arrays: Arrays = {
        "counts": np.concatenate([summary.total.counts for summary in summaries]),
        "totals": np.concatenate([_triangles(summary.total) for summary in summaries]),
    }
    fits = [summary.fit for summary in summaries if summary.fit is not None]
    stated_fits = iter(packed_estimates(fits, arrays))
    scatters = [summary.scatter for summary in summaries if summary.scatter is not None]
    if scatters:
        arrays["scatter"] = np.concatenate([scatter.rows for scatter in scatters])
    content: dict[str, Any] = {
        "parameters": first.parameter_names,
        "units": fits[0].units if fits else (),
        "columns": [columns.tolist() for columns in first.columns],
        "archives": [
            _entry(summary) | ({} if summary.fit is None else {"fit": next(stated_fits)})
            for summary in summaries
        ],
        "sum": None if reduced.total is None else _packed_sum(reduced.total, arrays),
    }
    return content, arrays


def packed_estimates(estimates: Sequence[Estimate], arrays: Arrays) -> list[dict[str, Any]]:
    """Add the arrays of estimates to others, and return what is no array as JSON data.

    Names and units of the parameters are not among it.
    """
    for name in FIT:
        arrays[name] = np.array([getattr(estimate, name) for estimate in estimates])
    return [
        {
            "method": estimate.method.as_json(),
            "condition": estimate.condition,
            "undetermined": estimate.undetermined,
            "interval_factor": estimate.interval_factor,
        }
        for estimate in estimates
    ]


def unpacked_estimates(
    stated: Sequence[Mapping[str, Any]],
    arrays: Arrays,
    names: tuple[str, ...],
    units: tuple[str, ...],
) -> list[Estimate]:
    """Return the estimates of :func:`packed_estimates`.

    Args:
        stated: what is no array.
        arrays: by name.
        names: of the parameters (p,).
        units: of the parameters (p,).
    """
    return [
        Estimate(
            names=names,
            units=units,
            **{name: arrays[name][number].copy() for name in FIT},
            method=EstimationMethod.of_json(each["method"]),
            condition=each["condition"],
            undetermined=tuple(each["undetermined"]),
            interval_factor=each["interval_factor"],
        )
        for number, each in enumerate(stated)
    ]


def _packed_sum(total: Reduction, arrays: Arrays) -> dict[str, Any]:
    """Add the arrays of a sum to others, and return what is no array as JSON data."""
    arrays["sum_counts"] = total.factor.counts
    arrays["sum"] = _triangles(total.factor)
    if total.rates is not None:
        arrays["rates"] = total.rates
    content: dict[str, Any] = {"block": total.factor.block}
    unmodelled = total.unmodelled
    if unmodelled is not None:
        forms = unmodelled.forms
        arrays["forms_counts"] = forms.counts
        arrays["forms"] = _triangles(forms)
        content["forms"] = {
            "names": forms.parameter_names,
            "columns": [columns.tolist() for columns in forms.columns],
            "block": forms.block,
        }
        if unmodelled.elastic is not None:
            for name in ELASTIC:
                arrays[name] = getattr(unmodelled.elastic, name)
            content["elastic"] = unmodelled.elastic.recordings
    return content


def _triangles(factor: Factor) -> Array:
    """Return the upper triangles of the Gram matrices, which are symmetric, side by side (B, k).

    Block by block in memory: :func:`_matrices` takes five times as long from another order.
    """
    joints = []
    for matrices in factor.matrices:
        width = matrices.shape[1]
        row, column = np.triu_indices(width)
        flat = matrices.reshape(len(matrices), -1)
        joints.append(np.take(flat, row * width + column, axis=1))
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
    """Return what is no array of an archive and no estimate, as JSON data."""
    scatter = summary.scatter
    entry: dict[str, Any] = {
        "warnings": [*map(note_as_json, summary.warnings)],
        "blocks": len(summary.total),
        "facts": dict(summary.facts),
    }
    if scatter is not None:
        entry["scatter"] = {
            "rows": len(scatter.rows),
            "interval_factor": scatter.interval_factor,
            "blocks": asdict(scatter.blocks),
        }
    return entry


def _unpacked(
    refs: Sequence[ArchiveRef], content: dict[str, Any], arrays: Arrays
) -> ReducedArchives | None:
    """Return the reduced archives of a file, which may have been moved since."""
    if len(content["archives"]) != len(refs):
        return None
    names = tuple(map(intern, content["parameters"]))
    units = tuple(map(intern, content["units"]))
    columns = tuple(np.array(joint, dtype=np.intp) for joint in content["columns"])
    totals = _matrices(arrays["totals"], columns)
    stated_fits = [entry["fit"] for entry in content["archives"] if "fit" in entry]
    fits = iter(unpacked_estimates(stated_fits, arrays, names, units))
    summaries = []
    scatter_begin = 0
    block_begin = 0
    for ref, entry in zip(refs, content["archives"], strict=True):
        rows = slice(block_begin, block_begin + entry["blocks"])
        block_begin = rows.stop
        fit = None
        scatter = None
        if "fit" in entry:
            fit = next(fits)
            scattered = entry["scatter"]
            scatter_end = scatter_begin + scattered["rows"]
            scatter = ScoreScatter(
                rows=arrays["scatter"][scatter_begin:scatter_end],
                interval_factor=scattered["interval_factor"],
                blocks=TimeBlocks(**scattered["blocks"]),
            )
            scatter_begin = scatter_end
        summaries.append(
            Summary(
                ref=ref,
                total=Factor(
                    tuple(grams[rows] for grams in totals), columns, arrays["counts"][rows], names
                ),
                fit=fit,
                scatter=scatter,
                warnings=tuple(map(note_of_json, entry["warnings"])),
                facts=entry["facts"],
            )
        )
    total = None
    if content["sum"] is not None:
        grams = _matrices(arrays["sum"], columns)
        block = content["sum"]["block"]
        factor = Factor(grams, columns, arrays["sum_counts"], names, block=block)
        unmodelled = _unmodelled(content["sum"], arrays)
        total = Reduction(factor, arrays.get("rates"), unmodelled)
    return ReducedArchives(tuple(summaries), total, cached=len(refs))


def _unmodelled(content: dict[str, Any], arrays: Arrays) -> Unmodelled | None:
    """Return the sums with what the model lacks of a file, None if it has none."""
    if "forms" not in content:
        return None
    stated = content["forms"]
    columns = tuple(np.array(joint, dtype=np.intp) for joint in stated["columns"])
    forms = Factor(
        _matrices(arrays["forms"], columns),
        columns,
        arrays["forms_counts"],
        tuple(map(intern, stated["names"])),
        block=stated["block"],
    )
    elastic = None
    if "elastic" in content:
        parts = {name: arrays[name] for name in ELASTIC}
        elastic = ElasticTorque(**parts, recordings=content["elastic"])
    return Unmodelled(forms, elastic)
