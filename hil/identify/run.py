"""Estimate, validate, judge."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hil.campaign.folder import CampaignFolder
from hil.campaign.status import conduct_of
from hil.cell import Cell
from hil.errors import InputError
from hil.progress import Reporter
from hil.reading import lies_there
from hil.report import ReportSeries
from hil.results import FindingResult, JointJudgement, JudgementResult, ProfileResult, Results
from identification.errors import IdentificationError
from identification.estimators.least_squares import RepeatedEstimate
from identification.export.torque_parts import friction_curve, friction_torque, torque_parts
from identification.factor.phases import PhaseFactor
from identification.model.robot import RobotModel
from identification.selection.essential import EssentialChoice
from identification.signals.noise import spectrum
from identification.signals.samples import Samples
from identification.validation.consistency import ConsistencyCheck
from identification.validation.evidence import Evidence, gather
from identification.validation.prediction import for_figure
from identification.validation.residuals import Profile
from identification.validation.verdict import Verdict, judge

from .estimating import Estimation, estimate_with
from .options import Options
from .prepared import Prepared, prepare_sources
from .sources import gather_sources
from .summary import (
    consistency_of,
    consistency_reasons,
    consistency_warnings,
    essential_of,
    essential_warnings,
    moving_rows,
    summarise,
)
from .surroundings import nominal_of, surroundings_of

Array = NDArray[np.float64]

FIGURE_SAMPLES: Final = 4000
"""Rows of a time series behind a figure, at most."""
FRICTION_POINTS: Final = 600
"""Points per joint behind a friction curve."""
_RECORDINGS: Final = 4  # of those that were fitted: more say the same again
_MARGIN: Final = 1.0  # s of rest that is shown before and after the motion


def report_series(prepared: Prepared, estimate: RepeatedEstimate) -> ReportSeries:
    """The series of a report: the first motion that was fitted, the first that was held out."""
    sources, fitted, example = prepared.sources, prepared.fitted, prepared.held_out[0]
    model, values = sources.cell.model, estimate.pooled.values
    excitation, motion = fitted[0], fitted[0].motion
    shown, seen = _shown(prepared.training[0]), _shown(example)
    time = example.motion.time
    predicted = example.predicted_torque(model, values)
    parts = torque_parts(model, values, example)
    both = np.column_stack([example.torque, example.torque - predicted])
    frequency, density = spectrum(time, both, example.segments)
    speed, torque = _friction_data(model, values, fitted)
    curves = [
        friction_curve(
            model,
            values,
            joint,
            float(np.nanmin(speed[:, joint], initial=0.0)),
            float(np.nanmax(speed[:, joint], initial=0.0)),
        )
        for joint in range(model.n_joints)
    ]
    return ReportSeries(
        excitation_time=motion.time[shown] - excitation.origin,
        excitation_position=motion.position[shown],
        excitation_velocity=motion.velocity[shown],
        example_archive=sources.held_out[0].name,
        example_time=time[seen] - example.origin,
        example_measured=for_figure(time, example.torque)[seen],
        example_predicted=for_figure(time, predicted)[seen],
        excitation_fitted=excitation.usable[shown].astype(np.float64),
        example_used=example.usable[seen].astype(np.float64),
        example_inertia=for_figure(time, parts.inertia)[seen],
        example_coriolis=for_figure(time, parts.coriolis)[seen],
        example_gravity=for_figure(time, parts.gravity)[seen],
        example_friction=for_figure(time, parts.friction)[seen],
        friction_speed=speed,
        friction_torque=torque,
        law_speed=np.column_stack([curve.speed for curve in curves]),
        law_torque=np.column_stack([curve.sliding for curve in curves]),
        reversal_travel=np.column_stack([curve.travel for curve in curves]),
        reversal_torque=np.column_stack([curve.turning for curve in curves]),
        spectrum_frequency=frequency,
        spectrum_torque=density[:, : model.n_joints],
        spectrum_residual=density[:, model.n_joints :],
        motion_bandwidth=np.where(
            np.isfinite(example.position_bandwidth), example.position_bandwidth, np.nan
        ),
    )


def _shown(samples: Samples) -> slice:
    """Rows for a figure: the motion, and a little of the rest before and after it."""
    moving, time = moving_rows(samples), samples.motion.time
    if moving.start == moving.stop:
        return moving
    first = int(np.searchsorted(time, time[moving.start] - _MARGIN))
    last = int(np.searchsorted(time, time[moving.stop - 1] + _MARGIN, side="right"))
    return slice(first, last, max(1, (last - first) // FIGURE_SAMPLES))


def _friction_data(
    model: RobotModel, values: Array, fitted: tuple[Samples, ...]
) -> tuple[Array, Array]:
    """Speed and friction torque of fitted rows (FRICTION_POINTS, n), NaN where there are fewer."""
    some = fitted[:: -(-len(fitted) // _RECORDINGS)]
    speed = np.concatenate([samples.motion.velocity for samples in some])
    torque = np.concatenate([friction_torque(model, values, samples) for samples in some])
    usable = np.concatenate([samples.usable for samples in some])
    found = np.full((2, FRICTION_POINTS, model.n_joints), np.nan)
    for joint in range(model.n_joints):
        rows = np.flatnonzero(usable[:, joint])
        count = min(len(rows), FRICTION_POINTS)
        if count:
            chosen = rows[np.linspace(0, len(rows) - 1, count).round().astype(int)]
            found[:, :count, joint] = speed[chosen, joint], torque[chosen, joint]
    return found[0], found[1]


# Points of an autocorrelation that a figure needs.
_LAGS: Final = 150


def judgement_result(
    joint_names: Sequence[str], evidence: Evidence, verdict: Verdict, *, nominal: str | None = None
) -> JudgementResult:
    """What the verdict rests on.

    Args:
        joint_names: (n,).
        evidence: what was found.
        verdict: on it.
        nominal: what the nominal model is, in words.

    Raises:
        IdentificationError: the residuals were not checked.
    """
    checks = evidence.residuals
    if checks is None:
        raise IdentificationError("the evidence holds no checks of the residuals")
    colour, drift = checks.colour, checks.drift
    step = max(1, -(-len(colour.lag) // _LAGS))
    return JudgementResult(
        in_sample=evidence.in_sample,
        nominal=None if evidence.nominal is None else nominal,
        findings=[
            FindingResult.model_validate(finding, from_attributes=True)
            for finding in verdict.findings
        ],
        next_steps=list(verdict.next_steps),
        joints=_joints(joint_names, evidence),
        speed=_profiles(checks.speed),
        position=_profiles(checks.position),
        lag=colour.lag[::step].tolist(),
        autocorrelation=[_each(column) for column in colour.correlation[::step].T],
        effective_rows=np.nan_to_num(colour.effective_rows).tolist(),
        friction_over_time=None if drift is None else [_each(row) for row in drift.share.T],
    )


def _joints(joint_names: Sequence[str], evidence: Evidence) -> list[JointJudgement]:
    error, nominal = evidence.held_out, evidence.nominal
    controller, limit = evidence.surroundings.controller, evidence.surroundings.torque_limit
    explained, relative = error.explained, error.relative
    scale = evidence.surroundings.nominal_scale
    inertia = evidence.surroundings.controller_inertia
    return [
        JointJudgement(
            joint=name,
            unit="N·m" if evidence.revolute(j) else "N",
            rms=float(error.rms[j]),
            relative=_known(relative, j),
            fitted_relative=_known(evidence.training.relative, j),
            explained=_known(explained, j),
            limit=_known(limit, j),
            share_of_limit=_known(evidence.share_of_limit, j),
            nominal_relative=None if nominal is None else _known(nominal.relative, j),
            controller_relative=None if controller is None else _known(controller.relative, j),
            nominal_scale=None if scale is None else _known(scale.scale, j),
            controller_inertia=None if inertia is None else _known(inertia.ratio, j),
            controller_inertia_spread=None if inertia is None else _known(inertia.spread, j),
        )
        for j, name in enumerate(joint_names)
    ]


def _known(values: Array | None, index: int) -> float | None:
    return None if values is None or np.isnan(values[index]) else float(values[index])


def _each(values: Array) -> list[float | None]:
    return [_known(values, index) for index in range(len(values))]


def _profiles(profile: Profile) -> list[ProfileResult]:
    return [
        ProfileResult(centre=centre.tolist(), mean=_each(mean), std=_each(std))
        for centre, mean, std in zip(
            profile.centres, profile.bins.mean, profile.bins.std, strict=True
        )
    ]


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
    for warning in warnings:
        sources = sources.with_warning(warning)
    prepared = prepare_sources(sources, options, reporter)
    estimation = estimate_with(prepared, options, reporter)
    for warning in estimation.warnings:
        prepared = replace(prepared, sources=prepared.sources.with_warning(warning))
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
        for warning in (*consistency_warnings(consistency), *essential_warnings(essential)):
            sources = sources.with_warning(warning)
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
