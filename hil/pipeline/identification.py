"""Identification: archives to samples, estimate, evidence, verdict and results."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType

from hil.archive import Archive, place_of
from hil.base.arrays import Array
from hil.base.progress import Reporter
from hil.base.threads import one_thread
from hil.cell import Cell
from hil.results.results import Results
from hil.results.series import ReportSeries
from identification.estimators.least_squares import RepeatedEstimate
from identification.hypotheses.diagnosis import TorqueDiagnosis
from identification.selection.essential import Elimination
from identification.validation.consistency import ConsistencyCheck
from identification.validation.verdict import Verdict

from .estimating import Estimation, estimate_with, with_transmitted_load
from .figure_series import report_series
from .notes import NotConsistent, Note, NotEssential
from .options import Options
from .prepared import Prepared, prepare_sources
from .sources import Source, gather_sources, payload_warnings
from .summary import summary
from .validation import Validation, validate


@dataclass(frozen=True, eq=False)
class Identification:
    """An identification with everything it was computed from."""

    paths: tuple[Path, ...]  #: of the archives
    prepared: Prepared
    estimation: Estimation
    validation: Validation
    results: Results  #: content of `results.json`

    @property
    def cell(self) -> Cell:
        """The cell of the archives."""
        return self.prepared.sources.cell

    @property
    def estimate(self) -> RepeatedEstimate:
        """Pooled and per repetition."""
        return self.estimation.result

    @property
    def values(self) -> Array:
        """Identified parameters (p,)."""
        return self.estimate.pooled.values

    @property
    def consistency(self) -> ConsistencyCheck | NotConsistent:
        """Consistent parameters, or why there are none."""
        return self.validation.consistency

    @property
    def essential(self) -> Elimination | NotEssential:
        """Essential parameters, or why there are none."""
        return self.validation.essential

    @property
    def verdict(self) -> Verdict:
        """Whether the model may be used."""
        return self.validation.verdict

    def moved(self, places: Mapping[Path, Path]) -> Identification:
        """Return the same with other paths of its archives."""

        def at(sources: Sequence[Source]) -> tuple[Source, ...]:
            return tuple(replace(each, path=places.get(each.path, each.path)) for each in sources)

        sources = self.prepared.sources
        sources = replace(sources, training=at(sources.training), held_out=at(sources.held_out))
        return replace(
            self,
            paths=tuple(places.get(path, path) for path in self.paths),
            prepared=replace(self.prepared, sources=sources),
        )

    @cached_property
    def series(self) -> ReportSeries:
        """Data of the report's figures."""
        return report_series(self.prepared, self.estimate)


@one_thread()
def identify_archives(
    archives: Sequence[Path | Archive],
    reporter: Reporter,
    options: Options = Options(),
    *,
    predict: Sequence[Path | Archive] = (),
    name: str = "",
    warnings: Sequence[Note] = (),
    diagnoses: Mapping[Path, TorqueDiagnosis] = MappingProxyType({}),
) -> Identification:
    """Identify from archives, files or in memory.

    The kind of the archives decides which are fitted. They are read as recordings
    (`gather_sources`), which become samples (`prepare_sources`), factors and an estimate
    (`estimate_with`), evidence and a verdict (`validate`), and results.

    Args:
        archives: of one arm.
        reporter: of progress.
        options: of the identification.
        predict: archives that are held out.
        name: of the results.
        warnings: that they begin with.
        diagnoses: what the torques of archives are, by path, where that was asked.

    Raises:
        InputError: the archives cannot be used, not together, or not by the chosen estimator.
    """
    sources = gather_sources(archives, options.split, predict, in_sample=options.in_sample)
    prepared = with_transmitted_load(prepare_sources(sources, options, reporter))
    estimation = estimate_with(prepared, options, reporter)
    validation = validate(prepared, estimation, options, reporter, diagnoses)
    warnings = (*warnings, *payload_warnings(prepared.sources.cell))
    prepared = prepared.warned(*warnings, *estimation.warnings, *validation.warnings)
    paths = tuple(map(place_of, (*archives, *predict)))
    results = summary(name or paths[0].stem, prepared, estimation, validation)
    return Identification(paths, prepared, estimation, validation, results)
