"""Identification: estimate, validate, verdict, results."""

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
from hil.reading import path_exists
from hil.report import ReportSeries
from hil.results import Results
from identification import Factor, IdentificationError, RobotModel, estimate
from identification.estimators.covariance import with_block_covariance
from identification.estimators.least_squares import RepeatedEstimate
from identification.export.friction import friction_curve, friction_torque
from identification.factor.factor import joint_weights
from identification.selection.essential import Elimination, choose_essential
from identification.signals.samples import Samples
from identification.validation.evidence import gather
from identification.validation.plausibility import ConsistencyCheck, check_consistency
from identification.validation.prediction import for_figure
from identification.validation.verdict import Verdict, judge

from .cell_context import cell_context_of, nominal_of
from .estimating import Estimation, estimate_with
from .options import Options
from .prepared import Prepared, prepare_sources
from .sources import gather_sources
from .summary import moving_rows, summarise

Array = NDArray[np.float64]

FIGURE_SAMPLES: Final = 4000
"""Maximum number of rows of a time series in a figure."""
FRICTION_POINTS: Final = 600
"""Points per joint in a friction figure."""
_RECORDINGS: Final = 4  # fitted recordings in a friction figure
_MARGIN: Final = 1.0  # time shown before and after the motion, s


@dataclass(frozen=True, eq=False)
class Identification:
    """An identification with everything it was computed from."""

    paths: tuple[Path, ...]  #: of the archives
    prepared: Prepared
    estimation: Estimation
    essential: Elimination | str  #: essential parameters, or the reason why there are none
    consistency: ConsistencyCheck | str  #: consistent parameters, or the reason why there are none
    verdict: Verdict
    results: Results  #: content of `results.json`
    series: ReportSeries  #: data of the report's figures

    @property
    def cell(self) -> Cell:
        """The cell of the archives."""
        return self.prepared.sources.cell

    @property
    def estimate(self) -> RepeatedEstimate:
        """Pooled and per repetition."""
        return self.estimation.result


def consistency_of(model: RobotModel, training: Factor, held_out: Factor) -> ConsistencyCheck | str:
    """Compare the consistent with the unconstrained estimate, or return why that failed."""
    try:
        weights = joint_weights(training)
        free = with_block_covariance(estimate(model, training, weights), training, weights)
        return check_consistency(model, training, held_out, free, weights=weights)
    except IdentificationError as error:
        return str(error)


def identify_sources(
    paths: Sequence[Path],
    reporter: Reporter,
    options: Options = Options(),
    *,
    predict: Sequence[Path] = (),
) -> Identification:
    """Identify from a campaign folder, a folder of archives, or archives.

    Raises:
        InputError: the folder contains neither, or is not the only path.
    """
    folder = next((path for path in paths if path.is_dir()), None)
    if folder is None:
        return identify_archives(paths, reporter, options, predict=predict)
    if len(paths) > 1:
        raise InputError(
            folder, "is a folder among files", remedy="give one campaign folder, or files only"
        )
    if path_exists(folder / "manifest.json"):
        return identify_campaign(folder, reporter, options, predict=predict)
    archives = sorted(folder.glob("*.mcap"))  # of `hil record`
    if not archives:
        remedy = "give a campaign folder (`hil design -o`), or archives (*.mcap)"
        raise InputError(folder, "contains neither a campaign nor archives", remedy=remedy)
    return identify_archives(archives, reporter, options, predict=predict)


def identify_campaign(
    root: Path, reporter: Reporter, options: Options = Options(), *, predict: Sequence[Path] = ()
) -> Identification:
    """Identify from the complete archives of a campaign folder; `predict` adds held-out archives.

    Raises:
        InputError: the folder has no complete excitation.
    """
    folder = CampaignFolder(root)
    kinds = ("excitation", "validation")
    paths = [path for kind in kinds for path in folder.completed(kind)]
    if not paths:
        problem = "its manifest.json has no completed excitation with an intact archive"
        remedy = "run the campaign, or give the archives instead of the folder"
        raise InputError(root, problem, remedy=remedy)
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
    """Identify from archives; their kind decides what is fitted, `predict` is held out.

    Raises:
        InputError: the archives cannot be used, not together, or not by the chosen estimator.
    """
    sources = gather_sources(paths, options.split, predict, in_sample=options.in_sample)
    for warning in warnings:
        sources = sources.with_warning(warning)
    prepared = prepare_sources(sources, options, reporter)
    estimation = estimate_with(prepared, options, reporter)
    sources, result = prepared.sources, estimation.result
    for warning in estimation.warnings:
        sources = sources.with_warning(warning)
    cell = sources.cell
    with reporter.task("validating", 3) as task:
        unseen = sum(estimation.held_out, Factor.zero(cell.model))
        consistency = consistency_of(cell.model, result.factor, unseen)
        impossible: list[str] = []
        if isinstance(consistency, str):
            sources = sources.with_warning(
                f"no physically consistent parameters were found: {consistency}"
            )
        else:
            if sources.in_sample:
                consistency = replace(consistency, judged_on="in-sample")
            if consistency.impossible:  # no rigid bodies produce the predicted torque
                impossible.append(
                    f"{consistency.sentence}: check signs, torque constants, coupling and URDF"
                )
            elif consistency.costly:
                sources = sources.with_warning(consistency.sentence)
        task.advance(1, "essential parameters")
        essential: Elimination | str = "they are chosen on held-out data, and there is none"
        if not sources.in_sample:
            try:
                essential = choose_essential(cell.model, result.factor, estimation.held_out)
            except IdentificationError as error:
                essential = str(error)
        if isinstance(essential, str):
            sources = sources.with_warning(f"no essential parameters: {essential}")
        task.advance(1, "verdict")
        nominal = nominal_of(cell)
        evidence = gather(
            cell.model,
            result,
            prepared.training,
            prepared.held_out,
            same_motion=sources.same_motion,
            nominal=None if nominal is None else nominal.values,
            context=cell_context_of(prepared, result.pooled),
            in_sample=sources.in_sample,
            names=[source.name for source in sources.training],
        )
        implausible = evidence.implausible
        reasons = (*implausible.impossible, *impossible)
        evidence = replace(evidence, implausible=implausible._replace(impossible=reasons))
        verdict = judge(cell.model.joint_names, evidence, tested_on=sources.tested_on)
        task.advance(1)
    prepared = replace(prepared, sources=sources)
    return Identification(
        paths=(*paths, *predict),
        prepared=prepared,
        estimation=estimation,
        essential=essential,
        consistency=consistency,
        verdict=verdict,
        results=summarise(
            name or paths[0].stem,
            prepared,
            estimation,
            verdict,
            evidence,
            None if nominal is None else nominal.label,
            essential,
            consistency,
        ),
        series=report_series(prepared, result),
    )


def report_series(prepared: Prepared, estimate: RepeatedEstimate) -> ReportSeries:
    """Return the figure data of a report: the first fitted and the first held-out recording."""
    sources, fitted, example = prepared.sources, prepared.fitted, prepared.held_out[0]
    model, values = sources.cell.model, estimate.pooled.values
    excitation, motion = fitted[0], fitted[0].motion
    shown, seen = _shown(prepared.training[0]), _shown(example)
    time = example.motion.time
    predicted = example.predicted_torque(model, values)
    speed, torque = _friction_data(model, values, fitted)
    slowest, fastest = (end(speed, axis=0, initial=0.0) for end in (np.nanmin, np.nanmax))
    curves = [
        friction_curve(model, values, joint, float(slowest[joint]), float(fastest[joint]))
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
        friction_speed=speed,
        friction_torque=torque,
        law_speed=np.column_stack([curve.speed for curve in curves]),
        law_torque=np.column_stack([curve.torque for curve in curves]),
    )


def _shown(samples: Samples) -> slice:
    """Rows of a figure: the motion with a margin before and after it."""
    moving, time = moving_rows(samples), samples.motion.time
    if moving.start == moving.stop:
        return moving
    first = int(np.searchsorted(time, time[moving.start] - _MARGIN))
    last = int(np.searchsorted(time, time[moving.stop - 1] + _MARGIN, side="right"))
    return slice(first, last, max(1, (last - first) // FIGURE_SAMPLES))


def _friction_data(
    model: RobotModel, values: Array, fitted: tuple[Samples, ...]
) -> tuple[Array, Array]:
    """Speed and friction torque of fitted rows, each (FRICTION_POINTS, n), padded with NaN."""
    some = fitted[:: -(-len(fitted) // _RECORDINGS)]
    parts = [(one.motion.velocity, friction_torque(model, values, one), one.usable) for one in some]
    speed, torque, usable = (np.concatenate(column) for column in zip(*parts, strict=True))
    found = np.full((2, FRICTION_POINTS, model.n_joints), np.nan)
    for joint in range(model.n_joints):
        rows = np.flatnonzero(usable[:, joint])
        count = min(len(rows), FRICTION_POINTS)
        if count:
            chosen = rows[np.linspace(0, len(rows) - 1, count).round().astype(int)]
            found[:, :count, joint] = speed[chosen, joint], torque[chosen, joint]
    return found[0], found[1]
