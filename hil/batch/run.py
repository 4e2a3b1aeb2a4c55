"""The batch: find archives, decide settings, reduce archives to factors, add and estimate."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, fields, replace
from itertools import groupby
from typing import Any, Final, Literal, TypeVar, cast, get_args

import numpy as np
from numpy.typing import NDArray

from hil.archive import Archive
from hil.cell import Cell
from hil.errors import ArchiveError, InputError
from hil.files import json_digest
from hil.identify.estimating import Posterior, fit_of, fit_with_transmitted_load
from hil.identify.options import Options
from hil.identify.prepared import (
    MAX_RECORDINGS,
    Settings,
    carried_over,
    decide,
    known_parameters,
    samples_of,
    validation_samples,
)
from hil.identify.sources import Source, Sources, all_fitted, known_warnings, source_of
from hil.progress import Reporter, Silent
from identification import IdentificationError
from identification.estimators.consistent import SolverError
from identification.estimators.covariance import solve_with_prior
from identification.estimators.delay import rate_products, with_uncertain_delay
from identification.estimators.least_squares import fit_least_squares, no_narrower
from identification.estimators.prior import ScoreScatter, body_prior
from identification.factor.factor import (
    QR_CONDITION,
    Estimate,
    Factor,
    require_rows,
)

from .cache import CacheLocation, cacheable, code_digest
from .discovery import (
    ArchiveRef,
    GroupKey,
    cell_from,
    cell_in,
    discover,
    open_only,
    open_ref,
)
from .workers import ArchiveTask, Unused, Workers, reason_of

Array = NDArray[np.float64]
T = TypeVar("T")
Advance = Callable[[float, str], None]

Level = Literal["repetition", "campaign", "pooled"]
BatchEstimator = Literal["auto", "wls", "consistent"]
"""Estimators that need factors only, and no samples."""

_NAMED: Final = 12  # different warnings that are listed

BUNDLE: Final = 16
"""Archives in one entry of the cache: a summary of each and one sum, fifty times its size."""

cacheable(ScoreScatter)


@cacheable
@dataclass(frozen=True, eq=False)
class Summary:
    """Cached results of one archive, beside the sum of several."""

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
    for later in ("strength", "choices"):  # of the estimate only
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
        settings = _with_loading(decide(sources, options, Silent()).settings, sources)
    else:
        settings = carried_over(arms, sources, options)
    if not broken:
        cache.put(refs[0].location, decision_digest(options, arms, refs), settings)
    return settings, broken


def _with_loading(settings: Settings, sources: Sources) -> Settings:
    """Return settings with the parameters that load the gears, if friction grows with the load.

    All archives of an arm have them, so that their factors can be added.
    """
    cell = settings.with_friction_law(sources.cell)
    if not cell.model.friction.has_load:
        return settings
    fitted = [samples_of(source, cell, settings) for source in sources.training[:MAX_RECORDINGS]]
    loaded = fit_with_transmitted_load(cell, fitted, settings.strength)
    return replace(settings, loading=tuple(loaded.result.values.tolist()))


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
    if settings.loading is not None:
        samples = samples.with_load(model, np.array(settings.loading))
    factor = Factor.by_time(model, samples)
    fit, scatter = None, None
    if fitted:
        fit = fit_least_squares(model, [samples], factor=factor)
        prior = body_prior(model, factor, known=known_parameters(cell))
        scatter = ScoreScatter.of(factor, prior.gaussian)
    warnings = [*known_warnings(cell, archive), *archive.header.findings.warnings]
    if source.merged:
        warnings.append(source.merged)
    if archive.outcome is not None and archive.outcome.repaired:
        warnings.append("it was repaired with loss")
    return Summary(
        ref=ref,
        total=factor.merged(max(1, len(factor))),
        fit=fit,
        scatter=scatter,
        warnings=tuple(warnings),
        products=rate_products(model, samples) if fitted and settings.delay_variance else None,
    ), factor


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


@dataclass(frozen=True, eq=False)
class Arm:
    """A robot by its digest, see :class:`GroupKey`, with one of its cells."""

    digest: str
    cell: Cell

    @property
    def name(self) -> str:
        """The cell's name with the begin of the digest, since names may be equal."""
        return f"{self.cell.name}-{self.digest[:8]}"


@dataclass(frozen=True, eq=False, slots=True)
class LevelEstimate:
    """Parameters from one repetition, one campaign, or all campaigns of an arm.

    Fields of the same name are those of :class:`identification.factor.factor.Estimate`.
    """

    level: Level
    arm: str  #: digest of the arm, a key of `BatchResult.arms`
    campaign: str  #: folder; "" if pooled
    when: str  #: time of the (first) recording, ISO 8601, "" if unknown
    repetitions: int  #: archives that were fitted
    names: tuple[str, ...]
    units: tuple[str, ...]
    values: Array
    std: Array  #: (p,), infinite where undetermined
    covariance: Array | None  #: (p, p); None for a repetition, of which there may be very many
    interval_factor: float
    samples: NDArray[np.intp]
    noise_std: Array
    torque_rms: Array  #: of the fitted rows per joint (n,) [N·m or N]
    unseen_rms: Array  #: torque error per joint (n,) on the campaign's validation runs; NaN if none
    unseen_torque_rms: Array  #: torque per joint (n,) there; NaN if none
    condition: float
    undetermined: tuple[str, ...]
    method: str
    settings: str  #: digest of the settings; "" where campaigns with different ones are pooled
    warnings: tuple[str, ...] = ()  #: about the archives and the estimate
    #: payload and delay that the cell states, as text; "" if neither, or if campaigns with
    #: different ones are pooled
    setup: str = ""
    #: location and digest of the archive of a repetition; "" otherwise
    archive: str = ""
    sha256: str = ""

    @classmethod
    def of(cls, found: Estimate, **others: Any) -> LevelEstimate:
        """Return an estimate with `others`, which replace its fields."""
        names = [one.name for one in fields(cls) if hasattr(found, one.name)]
        return cls(**({name: getattr(found, name) for name in names} | others))


@dataclass(frozen=True, eq=False)
class BatchResult:
    """Result of a batch."""

    estimator: str
    arms: Mapping[str, Arm]  #: by digest
    repetitions: tuple[LevelEstimate, ...]  #: of all campaigns, in the order of `ArchiveRef.order`
    campaigns: tuple[LevelEstimate, ...]  #: in the same order
    pooled: tuple[LevelEstimate, ...]  #: one per arm
    broken: tuple[Unused, ...]  #: archives and campaigns (by folder) that could not be used
    skipped: tuple[Unused, ...]  #: archives that are not intended for fitting
    read: int  #: archives whose factor was computed
    cached: int  #: archives whose factor was cached
    code: str  #: digest of the programs


def reidentify(
    roots: Sequence[str],
    options: Options,
    workers: Workers,
    reporter: Reporter,
    *,
    cache: CacheLocation = CacheLocation(),  # noqa: B008 - frozen
    check: Callable[[Sequence[ArchiveRef]], None] = lambda _: None,
) -> BatchResult:
    """Identify every arm from all its archives: by repetition, by campaign, and pooled.

    The numbers are those of `hil identify` on the archives of a campaign with the same held out.
    They depend neither on the order in which archives are found nor on the workers.

    The roots are folders or archives. A single recording is never split. `check` receives the
    archives found, before samples are read, and may raise.

    Raises:
        InputError: a place does not exist, no archive can be fitted, or the estimator is not one of
            a batch.
        CacheError: the cache cannot be written.
    """
    if options.estimator not in (known := get_args(BatchEstimator)):
        problem, remedy = f"{options.estimator!r} reads samples", f"use {', '.join(known)}"
        raise InputError(None, problem, field="estimator", remedy=remedy)
    found = discover(roots, cache, workers, reporter)
    check(found.refs)
    batch = _Batch(options, workers, cache, reporter, [*found.broken])
    campaigns = batch.with_settings(
        [_Campaign(key, list(own)) for key, own in groupby(found.refs, lambda ref: ref.key)]
    )
    return batch.result(campaigns, found.skipped)


@dataclass(eq=False)
class _Campaign:
    """Archives of one group in progress."""

    key: GroupKey
    refs: list[ArchiveRef]
    settings: Settings | None = None  #: None until decided
    #: archives of each bundle, and whether it is in the cache
    bundles: list[tuple[tuple[ArchiveRef, ...], bool]] = field(default_factory=list)

    @property
    def ready(self) -> Settings:
        """The decided settings."""
        assert self.settings is not None
        return self.settings


@dataclass(eq=False)
class _Batch:
    """State of a batch; estimates arm by arm with few bundles in memory at a time."""

    options: Options
    workers: Workers
    cache: CacheLocation
    reporter: Reporter
    broken: list[Unused]
    read: int = 0
    cached: int = 0
    stream: Iterator[Any] = field(default_factory=lambda: iter(()))

    # Settings

    def with_settings(self, campaigns: Sequence[_Campaign]) -> list[_Campaign]:
        """Decide the settings of campaigns; return those that have some.

        Those of an arm are decided on its first readable campaign; the others use them with their
        own noise: comparisons need one friction law, and sums the same columns.
        """
        arms: dict[str, Settings] = {}
        waiting = list(campaigns)
        while waiting:
            first = {one.key.arm: one for one in reversed(waiting) if one.key.arm not in arms}
            asked = list(first.values()) or waiting
            waiting = [one for one in waiting if one not in asked]
            while asked:
                asked = self._decide(asked, arms)
            arms |= {arm: one.settings for arm, one in first.items() if one.settings is not None}
        return [one for one in campaigns if one.settings is not None]

    def _decide(self, campaigns: Sequence[_Campaign], arms: dict[str, Settings]) -> list[_Campaign]:
        """Decide settings; return the campaigns to repeat without archives that are unusable."""
        asked = []
        for one in campaigns:
            own = arms.get(one.key.arm)
            refs = archives_for_settings(one.refs, own)
            one.settings = cached_settings(refs, self.options, own, self.cache)
            if one.settings is None:
                asked.append((one, (refs, self.options, own, self.cache)))
        tasks = [ArchiveTask(c.key.campaign, decide_settings, own) for c, own in asked]
        again = []
        results = self._results(tasks, "deciding settings")
        for (one, (refs, *_)), found in zip(asked, results, strict=True):
            if isinstance(found, Unused):  # perhaps an archive ends its process
                alone = [ArchiveTask(ref.location, open_only, (ref,)) for ref in refs]
                opened = self._results(alone, "opening archives one by one")
                broken, reason = [other for other in opened if other is not None], found.reason
            else:
                one.settings, broken = found
                some = any(ref.use == "excitation" for ref in refs)
                reason = "" if some else "it holds no excitation"
            self.broken += broken
            paths = {other.path for other in broken}
            one.refs = [ref for ref in one.refs if ref.location not in paths]
            if one.settings is None and broken and one.refs:
                again.append(one)
            elif one.settings is None and reason:
                self.broken.append(Unused(one.key.campaign, reason))
        return again

    def _results(self, tasks: Sequence[ArchiveTask[T]], title: str) -> list[T | Unused]:
        if not tasks:
            return []
        with self.reporter.task(title, len(tasks)) as progress:
            return list(self.workers.results(tasks, progress.advance))

    # Factors

    def _reducing(self, one: _Campaign, refs: tuple[ArchiveRef, ...]) -> ArchiveTask[Bundle]:
        return ArchiveTask(refs[0].location, reduce_bundle, (refs, one.ready, self.cache))

    def _reduced(self, one: _Campaign) -> Iterator[Bundle]:
        """Yield the bundles of a campaign; one that ends its process is repeated by archive."""
        for refs, known in one.bundles:
            found: Any = cached_bundle(refs, one.ready, self.cache) if known else next(self.stream)
            if found is None:  # damaged
                (found,) = self.workers.results([self._reducing(one, refs)])
            if isinstance(found, Bundle):
                yield found
                continue
            alone = [self._reducing(one, (ref,)) for ref in refs]
            for own in self.workers.results(alone):
                yield Bundle(broken=(own,), read=1) if isinstance(own, Unused) else own

    # Estimates

    def result(self, campaigns: Sequence[_Campaign], skipped: tuple[Unused, ...]) -> BatchResult:
        """Reduce and estimate everything; cache entries are read in this process."""
        tasks = []
        for one in campaigns:
            for refs in split_bundles([ref for ref in one.refs if ref.use != "standstill"]):
                known = self.cache.has(refs[0].location, sum_key(refs, one.ready))  # intact or not
                one.bundles.append((refs, known))
                tasks += [] if known else [self._reducing(one, refs)]
        self.stream = self.workers.results(tasks)
        arms: dict[str, Arm] = {}
        levels: list[LevelEstimate] = []
        archives = sum(len(refs) for one in campaigns for refs, _ in one.bundles)
        with self.reporter.task("reading archives and estimating", archives) as progress:
            for digest, own in groupby(campaigns, lambda one: one.key.arm):
                members = list(own)
                cell = members[0].ready.with_friction_law(self._cell(members[0].refs[0]))
                arms[digest] = Arm(digest, cell)
                levels += self._arm(arms[digest], members, progress.advance)
        # Some reasons begin with the path.
        reasons = (Unused(path, text.removeprefix(f"{path}: ")) for path, text in self.broken)
        broken = tuple(dict.fromkeys(reasons))
        found = {
            level: tuple(one for one in levels if one.level == level)
            for level in ("repetition", "campaign", "pooled")
        }
        if not found["repetition"]:
            problem = "there is no excitation and no imported recording that can be fitted"
            first = [f"{path} could not be used: {reason}" for path, reason in broken[:1]]
            raise InputError(None, "; ".join([problem, *first]))
        return BatchResult(
            estimator=self.options.estimator,
            arms=arms,
            repetitions=found["repetition"],
            campaigns=found["campaign"],
            pooled=found["pooled"],
            broken=broken,
            skipped=skipped,
            read=self.read,
            cached=self.cached,
            code=code_digest(),
        )

    def _arm(self, arm: Arm, members: Sequence[_Campaign], advance: Advance) -> list[LevelEstimate]:
        """Return the estimates of an arm: repetitions, campaigns, and the pooled one."""
        name = cast(BatchEstimator, self.options.estimator)
        estimator = Estimator(name, arm.cell, members[0].ready)
        everything, campaigns = Group(), list[LevelEstimate]()
        for one in members:
            group, found = self._campaign(one, estimator, advance)
            campaigns += found
            if group.total is not None:
                everything.add(group)
        levels = [*everything.repetitions, *campaigns]
        keys = {ref.key for ref in everything.refs}
        if len(keys) == 1:
            levels += [replace(one, level="pooled", campaign="") for one in campaigns]
        elif everything.total is not None:
            setups = sorted({key.setup or "nothing" for key in keys})
            text = "pooled over campaigns whose cells state different payloads or delays, which are"
            apart = [f"{text} compensated: {'; '.join(setups)}"] if len(setups) > 1 else []
            with self._failing(f"arm {arm.digest[:8]}"):
                posterior, notes = estimator.posterior(everything.total)
                notes = [*notes, *apart]
                levels.append(sum_level("pooled", estimator, everything, posterior, notes))
        return levels

    def _campaign(
        self, one: _Campaign, estimator: Estimator, advance: Advance
    ) -> tuple[Group, list[LevelEstimate]]:
        """Return the group of a campaign with its repetitions, and its estimate if any."""
        used = settings_digest(one.ready)
        group, summaries = Group(settings={used}), list[Summary]()
        for bundle in self._reduced(one):
            self.broken += bundle.broken
            self.read += bundle.read
            self.cached += bundle.cached
            group.add_bundle(bundle)
            summaries += [each for each in bundle.summaries if each.ref.use == "excitation"]
            advance(bundle.read + bundle.cached, one.key.campaign)
        levels: list[LevelEstimate] = []
        if group.total is not None:
            with self._failing(one.key.campaign):
                posterior, notes = estimator.posterior(group.total)
                share = 1.0 / len(summaries)
                group.repetitions = [
                    repetition_level(estimator, each, used, posterior, share) for each in summaries
                ]
                levels.append(sum_level("campaign", estimator, group, posterior, notes))
        return group, levels

    @contextmanager
    def _failing(self, name: str) -> Iterator[None]:
        """Report a failed estimate with its reason, and continue."""
        try:
            yield
        except IdentificationError as error:
            self.broken.append(Unused(name, str(error)))

    def _cell(self, ref: ArchiveRef) -> Cell:
        """Return the cell of an archive."""
        texts = self.cache.get(ref.location, ref.cell, list)
        if texts is None:
            return cell_in(open_ref(ref))
        return cell_from(*texts)


@dataclass(eq=False)
class Group:
    """Archives that are fitted together, and the sums that predict and are predicted."""

    refs: list[ArchiveRef] = field(default_factory=list)  #: archives that were fitted
    total: Factor | None = None  #: sum of their factors; None if there are none
    repetitions: list[LevelEstimate] = field(default_factory=list)  #: estimates of each
    unseen: Factor | None = None  #: sum of the totals of validation runs; None if none
    #: sum of those of the archives, see :attr:`hil.batch.Summary.products`
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
    """An estimator for one arm; the cell has the friction law of its settings."""

    def __init__(self, name: BatchEstimator, cell: Cell, settings: Settings) -> None:
        self.name, self.cell, self.model = name, cell, cell.model
        self._delay_variance, self._strength = settings.delay_variance, settings.strength

    def posterior(self, total: Factor) -> tuple[Posterior | None, list[str]]:
        """Return the posterior of a sum and its archives, and notes; None: there is no prior.

        Raises:
            IdentificationError: there is no usable row.
        """
        require_rows(self.model, total)
        if self.name != "auto":
            return None, []
        prior = Posterior.of(self.cell, total, self.name, self._strength)
        posterior, _, notes = prior.solved(total)
        return posterior, notes

    def of_archive(self, summary: Summary, posterior: Posterior | None, share: float) -> Estimate:
        """Return the estimate from one archive, this share of those of the posterior.

        That of the consistent estimator is unconstrained, as in `hil identify`. The scatter of the
        scores is that of the archive by itself.
        """
        fit, scatter = summary.fit, summary.scatter
        assert fit is not None and scatter is not None, "it was fitted"
        if posterior is None:
            return fit
        # A copy: the total itself does not cache what is computed here.
        total = replace(summary.total)
        try:
            result = posterior.fit(total, share)
        except SolverError:
            result = posterior.free(total, share)
        found = result.estimate
        precision = share * posterior.precision
        weights = posterior.weights(total, share)
        solution = solve_with_prior(total.weighted(weights), precision)
        return replace(
            found,
            covariance=scatter.covariance(solution.root, precision, result.design_effect),
            interval_factor=scatter.interval_factor,
            method=f"{found.method.partition('; ')[0]}; {scatter.words}",
        )

    def of_group(self, group: Group, posterior: Posterior | None) -> Estimate:
        """Return the estimate from a sum over archives, with the posterior of that sum.

        Its intervals are at least as wide as the scatter of repetitions of one motion.

        Raises:
            IdentificationError: there is no consistent solution.
        """
        assert group.total is not None
        if posterior is None:
            found = fit_of(self.model, self.name)((), group.total)
        else:
            found = posterior.fit(group.total).estimate
        motions = {ref.motion for ref in group.refs}
        if len(motions) == 1 and "" not in motions:
            values = np.array([one.values for one in group.repetitions])
            found = replace(found, covariance=no_narrower(found.covariance, values))
        if group.products is None:
            return found
        precision = None if posterior is None else posterior.precision
        return with_uncertain_delay(
            found, group.total, group.products, self._delay_variance, precision
        )


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
    estimator: Estimator,
    summary: Summary,
    settings: str,
    posterior: Posterior | None = None,
    share: float = 1.0,
) -> LevelEstimate:
    """Return the estimate of one archive, this share of its group, with the group's posterior.

    Its arrays are copies: a batch may have very many.
    """
    ref, model = summary.ref, estimator.model
    found = estimator.of_archive(summary, posterior, share)
    own = {name: getattr(found, name).copy() for name in ("values", "noise_std", "samples")}
    nothing = np.full(model.n_joints, np.nan)
    return LevelEstimate.of(
        found,
        **own,
        level="repetition",
        arm=ref.arm,
        campaign=ref.campaign,
        archive=ref.location,
        sha256=ref.sha256,
        when=ref.when,
        repetitions=1,
        names=model.parameter_names,
        units=model.units,
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
    posterior: Posterior | None,
    warnings: Sequence[str] = (),
) -> LevelEstimate:
    """Return the estimate of a campaign, or of all campaigns of an arm, with its posterior if any.

    Raises:
        IdentificationError: there is no estimate.
    """
    assert group.total is not None
    refs, found = group.refs, estimator.of_group(group, posterior)
    setups = {ref.setup for ref in refs}
    unseen = Factor.zero(estimator.model) if group.unseen is None else group.unseen
    poor = not found.undetermined and found.condition > QR_CONDITION
    if posterior is None and poor:
        conditioning = (
            f"the scaled condition number is {found.condition:.2g}: the motion separates some"
            " parameters poorly, and sums of squares lose digits there; `hil identify` on these"
            " archives uses QR"
        )
        warnings = (conditioning, *warnings)
    return LevelEstimate.of(
        found,
        level=level,
        arm=refs[0].arm,
        campaign=refs[0].campaign if level == "campaign" else "",
        when=min((ref.when for ref in refs if ref.when), default=""),
        repetitions=len(refs),
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
