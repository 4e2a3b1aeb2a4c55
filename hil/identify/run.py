"""Estimate, validate, judge."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from hil.campaign.conduct import conduct_of
from hil.campaign.folder import CampaignFolder
from hil.cell import Cell
from hil.errors import InputError
from hil.progress import Reporter
from hil.reading import lies_there
from hil.report import ReportSeries
from hil.results import Results
from identification.estimators.repetitions import RepeatedEstimate
from identification.factor.phases import PhaseFactor
from identification.selection.essential_choice import EssentialChoice
from identification.signals.samples import Samples
from identification.validation.consistency import ConsistencyCheck
from identification.validation.evidence import gather
from identification.validation.verdict import Verdict, judge

from .estimating import Estimation, estimate_with
from .judging import judgement_result
from .options import Options
from .prepared import Prepared, prepare_sources
from .series import report_series
from .sources import gather_sources
from .summary import (
    consistency_of,
    consistency_reasons,
    consistency_warnings,
    essential_of,
    essential_warnings,
    summarise,
)
from .surroundings import nominal_of, surroundings_of


@dataclass(frozen=True, eq=False)
class Identification:
    """What an identification found, and the series its figures need.

    Attributes:
        paths: the archives.
        prepared: their recordings as samples.
        estimation: the estimate, and what was computed beside it.
        essential: the essential parameters; in words why there are none.
        consistency: parameters that a machine can have; in words why there are none.
        verdict: on the estimate.
        results: as they go into `results.json`.
        series: for the figures of the report.
    """

    paths: tuple[Path, ...]
    prepared: Prepared
    estimation: Estimation
    essential: EssentialChoice | str
    consistency: ConsistencyCheck | str
    verdict: Verdict
    results: Results
    series: ReportSeries

    @property
    def cell(self) -> Cell:
        """Whose archives they are."""
        return self.prepared.sources.cell

    @property
    def unseen(self) -> tuple[Samples, ...]:
        """The recordings that were predicted; those that were fitted where none were."""
        return self.prepared.held_out

    @property
    def tested_on(self) -> str:
        """What these are, in words."""
        return self.prepared.sources.tested_on

    @property
    def estimate(self) -> RepeatedEstimate:
        """Pooled and per repetition."""
        return self.estimation.result


def identify_sources(
    paths: Sequence[Path],
    reporter: Reporter,
    options: Options = Options(),
    *,
    predict: Sequence[Path] = (),
) -> Identification:
    """Identify from one folder, of a campaign or of archives, or from archives.

    Raises:
        InputError: a folder holds neither, or stands among archives.
    """
    folder = next((path for path in paths if path.is_dir()), None)
    if folder is None:
        return identify_archives(paths, reporter, options, predict=predict)
    if len(paths) > 1:
        raise InputError(
            folder, "is a folder among archives", remedy="name one campaign folder, or files"
        )
    if lies_there(folder / "manifest.json"):
        return identify_campaign(folder, reporter, options, predict=predict)
    loose = sorted(folder.glob("*.mcap"))  # of `hil record`
    if not loose:
        raise InputError(
            folder,
            "holds neither a campaign nor archives",
            remedy="name the folder of a campaign (`hil design -o`), or archives (*.mcap)",
        )
    return identify_archives(loose, reporter, options, predict=predict)


def identify_campaign(
    root: Path,
    reporter: Reporter,
    options: Options = Options(),
    *,
    predict: Sequence[Path] = (),
) -> Identification:
    """Identify from the whole archives of a campaign folder, and predict others beside them.

    Raises:
        InputError: no whole excitation is in the folder.
    """
    folder = CampaignFolder(root)
    kinds = ("excitation", "validation")
    paths = [path for kind in kinds for path in folder.completed(kind)]
    if not paths:
        raise InputError(
            root,
            "its manifest.json names no completed excitation that is still whole",
            remedy="run the campaign, or name the archives themselves",
        )
    found = identify_archives(
        [*paths, *folder.completed("standstill")],
        reporter,
        options,
        predict=predict,
        name=root.resolve().name,
        warnings=folder.damaged(),
    )
    conduct = conduct_of(folder)
    return replace(found, results=found.results.model_copy(update={"conduct": conduct}))


def identify_archives(
    paths: Sequence[Path],
    reporter: Reporter,
    options: Options = Options(),
    *,
    predict: Sequence[Path] = (),
    name: str = "",
    warnings: Sequence[str] = (),
) -> Identification:
    """Identify from archives.

    Args:
        paths: what is fitted, predicted or rested at, according to what the archives say.
        reporter: of progress.
        options: how.
        predict: archives that are predicted and not fitted, whatever they say.
        name: of the result; that of the first archive if left out.
        warnings: what is known beforehand to be wrong with the archives.

    Raises:
        InputError: the archives cannot be used, or not together, or not by the chosen estimator.
    """
    sources = gather_sources(paths, options.split, predict, in_sample=options.in_sample)
    for doubt in warnings:
        sources = sources.with_doubt(doubt)
    prepared = prepare_sources(sources, options, reporter)
    estimation = estimate_with(prepared, options, reporter)
    for doubt in estimation.warnings:
        prepared = replace(prepared, sources=prepared.sources.with_doubt(doubt))
    return _judged(name or paths[0].stem, (*paths, *predict), prepared, estimation, reporter)


def _judged(
    name: str,
    paths: tuple[Path, ...],
    prepared: Prepared,
    estimation: Estimation,
    reporter: Reporter,
) -> Identification:
    """Compare, judge and sum up."""
    cell, result = prepared.sources.cell, estimation.result
    with reporter.task("validating", 3) as task:
        unseen = sum(estimation.held_out, PhaseFactor.zero(cell.model)).total
        consistency = consistency_of(cell.model, result.phase, unseen)
        if prepared.sources.in_sample and isinstance(consistency, ConsistencyCheck):
            consistency = replace(consistency, judged_on="in-sample")
        task.advance(1, "essential parameters")
        essential: EssentialChoice | str = "nothing was held out to choose them by"
        if not prepared.sources.in_sample:
            essential = essential_of(cell.model, result.phase, estimation.held_out)
        task.advance(1, "verdict")
        sources = prepared.sources
        for doubt in (*consistency_warnings(consistency), *essential_warnings(essential)):
            sources = sources.with_doubt(doubt)
        nominal = nominal_of(cell)
        evidence = gather(
            cell.model,
            result,
            prepared.training,
            prepared.held_out,
            same_motion=sources.same_motion,
            nominal=None if nominal is None else nominal.values,
            surroundings=surroundings_of(paths, prepared, result.pooled),
            in_sample=sources.in_sample,
            names=[source.name for source in sources.training],
        )
        impossible = (*evidence.implausible.impossible, *consistency_reasons(consistency))
        evidence = replace(
            evidence, implausible=evidence.implausible._replace(impossible=impossible)
        )
        verdict = judge(cell.model.joint_names, evidence, tested_on=sources.tested_on)
        task.advance(1)
    prepared = replace(prepared, sources=sources)
    results = summarise(name, prepared, estimation, verdict, essential, consistency)
    judgement = judgement_result(
        cell.model.joint_names,
        evidence,
        verdict,
        nominal=None if nominal is None else nominal.words,
    )
    return Identification(
        paths=paths,
        prepared=prepared,
        estimation=estimation,
        essential=essential,
        consistency=consistency,
        verdict=verdict,
        results=results.model_copy(update={"judgement": judgement}),
        series=report_series(prepared, result),
    )
