"""From archives to factors: one alone, and several of a campaign added up.

Everything here is a pure function of the bytes of archives and of settings.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from hil.archive import Archive, open_archive
from hil.cell import Cell
from hil.cell.errors import CellError
from hil.errors import ArchiveError, HilError
from hil.identify.settings import Settings, judged_samples, samples_of, signals_of
from hil.identify.sources import Source, known_warnings, source_of
from hil.io import file_digest, json_digest
from identification import IdentificationError
from identification.estimators.covariance import block_covariance
from identification.estimators.delay import rate_products
from identification.estimators.least_squares import Weighting, fit_least_squares
from identification.factor.factor import joint_weights
from identification.factor.phases import PhaseFactor
from identification.model.robot import RobotModel
from identification.signals.samples import Samples

from .cache import Where, settings_digest, sum_key
from .remote import local_file
from .types import ArchiveRef, Broken, Bundle, ChangedError, FileStamp, Fit, Summary, TornError

BUNDLE: Final = 16
"""Archives of a campaign that are reduced together. Of each a summary is cached, of all of them one
sum, which is fifty times the size of a summary."""

WEIGHTINGS: Final[tuple[Weighting, ...]] = ("weighted", "ordinary")

_FIELDS: Final = (
    "cycle",
    "gap",
    "position",
    "torque",
    "target_current",
    "motor_current",
    "commanded_position",
)


def archive_factor(ref: ArchiveRef, settings: Settings) -> tuple[Summary, PhaseFactor]:
    """Reduce one archive: its summary, and its factor block by block of time.

    Raises:
        HilError: it cannot be read, is torn, was changed, or is not fit to be identified from.
        IdentificationError: there is not one usable row in it.
    """
    archive, source = source_in(ref)
    source = signals_of(source, settings)
    cell, fitted = cell_in(archive, settings), ref.use == "excitation"
    samples = (samples_of if fitted else judged_samples)(source, cell, settings)
    model = cell.model
    phase = PhaseFactor.from_samples(model, samples)
    summary = Summary(
        ref=ref,
        total=phase.merged(max(1, len(phase))),
        fits={kind: _fit(model, samples, phase, kind) for kind in WEIGHTINGS} if fitted else {},
        warnings=_warnings(archive, cell, source),
        products=rate_products(model, samples) if fitted and settings.delay_variance else None,
    )
    return summary, phase


def source_in(ref: ArchiveRef, *, to_fit: bool = True) -> tuple[Archive, Source]:
    """An archive, and what of it is of use.

    Raises:
        HilError: it cannot be read, is torn, was changed, or is not fit to be identified from.
    """
    with opened(ref) as archive:
        source = source_of(archive, cell_in(archive), to_fit=to_fit)
    if to_fit and source.recording.torque is None:
        raise ArchiveError(
            ref.location,
            "holds motor currents and no torques",
            remedy="find the torque constants with `hil gains` and import it again",
        )
    return archive, source


def bundles(refs: Sequence[ArchiveRef]) -> list[tuple[ArchiveRef, ...]]:
    """Archives of one campaign in canonical order, in runs that are reduced together."""
    ordered = sorted(refs, key=lambda ref: ref.order)
    return [tuple(ordered[k : k + BUNDLE]) for k in range(0, len(ordered), BUNDLE)]


def reduced(refs: Sequence[ArchiveRef], settings: Settings, where: Where) -> Bundle:
    """Reduce archives of one campaign, or those that are not in the cache, and cache the result.

    The sum goes from first to last, so that one that is known of the first ones can be continued.

    Args:
        refs: in their canonical order.
        settings: of the campaign.
        where: what is known of them is cached.

    Returns:
        With a reason for each archive that could not be used; nothing of it is in the sum.

    Raises:
        CacheError: the disk refuses.
    """
    store, used = where.store(refs[0].location), settings_digest(settings)
    counts = range(len(refs), 0, -1)
    begun = next(filter(None, (cached(refs[:count], settings, where) for count in counts)), None)
    known = 0 if begun is None else len(begun.refs)
    if begun is not None and known == len(refs):
        return begun
    found = begun or Bundle(())
    summaries, broken, phase, lasting = list(found.summaries), list(found.broken), found.phase, True
    for ref in refs[known:]:
        try:
            summary, own = archive_factor(ref, settings)
        except (HilError, IdentificationError) as error:
            broken.append(Broken(ref.location, str(error)))
            lasting &= _of_the_bytes(error)
        except Exception as error:  # a fault of ours: it costs this archive, not the batch
            broken.append(Broken(ref.location, f"{type(error).__name__}: {error}"))
            lasting = False
        else:
            summaries.append(summary)
            if ref.use == "excitation":
                phase = own if phase is None else phase + own
    read = len(refs) - known
    bundle = Bundle(tuple(refs), tuple(summaries), phase, tuple(broken), lasting, read)
    if lasting:
        for one in summaries:
            store.put(_summary_key(one.ref, used), one)
        reasons = dict(broken)
        for ref in refs:
            if ref.location in reasons:
                store.put(_summary_key(ref, used), reasons[ref.location])
        store.put(sum_key(refs, used), [phase])
        if known:
            store.remove(sum_key(refs[:known], used))  # part of a longer one now
    return bundle


def cached(refs: Sequence[ArchiveRef], settings: Settings, where: Where) -> Bundle | None:
    """Archives reduced earlier; None unless all of them are in the cache."""
    store, used = where.store(refs[0].location), settings_digest(settings)
    found = store.get(sum_key(refs, used), list)
    if found is None or len(found) != 1 or not isinstance(found[0], PhaseFactor | None):
        return None
    summaries, broken = [], []
    for ref in refs:
        match store.get(_summary_key(ref, used), object):
            case Summary() as one:  # of an archive that may lie elsewhere by now
                summaries.append(replace(one, ref=ref))
            case str() as reason:
                broken.append(Broken(ref.location, reason))
            case _:
                return None
    return Bundle(tuple(refs), tuple(summaries), found[0], tuple(broken))


def is_cached(refs: Sequence[ArchiveRef], settings: Settings, where: Where) -> bool:
    """Whether there is an entry of the sum of these archives; it may turn out to be damaged."""
    return where.store(refs[0].location).has(sum_key(refs, settings_digest(settings)))


def _summary_key(ref: ArchiveRef, settings: str) -> str:
    return json_digest(["summary", ref.sha256, settings])


def _of_the_bytes(error: HilError | IdentificationError) -> bool:
    """Whether an error will be met again as long as the bytes of the archive are the same."""
    if isinstance(error, ChangedError) or isinstance(error.__cause__, OSError):
        return False
    return isinstance(error, ArchiveError | CellError | IdentificationError)


@contextmanager
def opened(ref: ArchiveRef) -> Iterator[Archive]:
    """The archive with what identification reads, as long as its file is there.

    Raises:
        TornError: it is not whole.
        ChangedError: it is not the file that was found.
        ArchiveError: it cannot be read.
    """
    with local_file(ref.location) as path:
        _require_same(path, ref)
        try:
            archive = open_archive(path, fields=_FIELDS)
            if archive.header.controllers_own:
                archive = open_archive(path, fields=(*_FIELDS, "target_position", "status"))
        finally:
            if ref.stamp is not None:  # what was written meanwhile is no fault of the archive
                _require_same(path, ref)
        if archive.damage is not None:
            raise TornError(ref.location, str(archive.damage))
        yield archive


def _require_same(path: Path, ref: ArchiveRef) -> None:
    """Of a fetched copy only the bytes tell whether it is what was found."""
    if (digest_of(path) != ref.sha256) if ref.stamp is None else (stamp_of(path) != ref.stamp):
        raise ChangedError(ref.location)


def digest_of(path: Path) -> str:
    """SHA-256 of all bytes of a file.

    Raises:
        ArchiveError: it cannot be read.
    """
    try:
        return file_digest(path)
    except OSError as error:
        raise ArchiveError(path, f"cannot be read: {error.strerror}") from error


def stamp_of(path: Path) -> FileStamp:
    """What the file system says about a file.

    Raises:
        ArchiveError: there is none.
    """
    try:
        found = path.stat()
    except OSError as error:
        raise ArchiveError(path, f"cannot be read: {error.strerror}") from error
    return FileStamp(found.st_size, found.st_mtime_ns, found.st_ctime_ns, found.st_ino)


def cell_in(archive: Archive, settings: Settings | None = None) -> Cell:
    """The cell that travels in an archive, with the law of settings if there are any.

    Raises:
        ArchiveError: the archive carries no cell or no URDF, or one that is no text.
        CellError: the cell is not right.
    """
    friction = {} if settings is None else settings.friction
    return cell_from(archive.text("cell.toml"), archive.text("robot.urdf"), *friction.items())


@lru_cache(maxsize=8)
def cell_from(text: str, urdf: str, *friction: tuple[str, Any]) -> Cell:
    """The cell of these texts, with a friction law of these entries if there are any."""
    cell = Cell.from_texts(text, urdf, Path("cell.toml"))
    return cell.with_friction(**dict(friction)) if friction else cell


def _fit(model: RobotModel, samples: Samples, phase: PhaseFactor, weighting: Weighting) -> Fit:
    """With the mean ratio of the estimate's variances to those of white residuals."""
    found = fit_least_squares(model, [samples], weighting, phase=phase)
    weights = np.ones(phase.n_joints) if weighting == "ordinary" else joint_weights(phase.total)
    if found.undetermined:
        return Fit(found, block_covariance(phase, weights, found.values).design_effect)
    information = phase.total.weighted(weights).A
    trace = np.einsum("ij,ji->", information, found.covariance)
    return Fit(found, float(trace) / phase.n_parameters)


def _warnings(archive: Archive, cell: Cell, source: Source) -> tuple[str, ...]:
    warnings = [*known_warnings(cell, archive), *archive.header.findings.warnings]
    if source.merged:
        warnings.append(
            f"{source.merged} samples had the time stamp of the one before and were averaged "
            "with it"
        )
    if archive.outcome is not None and archive.outcome.repaired:
        warnings.append("it was repaired, and something is lost")
    return tuple(warnings)
