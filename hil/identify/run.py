"""Estimate, validate, judge."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hil.campaign.folder import CampaignFolder
from hil.errors import InputError
from hil.progress import Reporter
from hil.report import ReportSeries
from hil.results import Results
from identification.evidence import gather
from identification.preprocessing import Preprocessing, Samples, prepare
from identification.repetitions import RepeatedEstimate, estimate_repetitions
from identification.torque_channel import find_torque_bandwidth
from identification.validation import for_figure
from identification.verdict import Verdict, judge

from .options import Options
from .sources import Source, Sources, gather_sources
from .summary import moving_rows, summarise

Array = NDArray[np.float64]

FIGURE_SAMPLES = 4000
"""Rows of a time series that a figure is drawn from, at most."""


@dataclass(frozen=True, eq=False)
class Identification:
    """What an identification found, and the series its figures need."""

    estimate: RepeatedEstimate
    verdict: Verdict
    results: Results
    series: ReportSeries


def identify_campaign(
    root: Path, reporter: Reporter, options: Options = Options()
) -> Identification:
    """Identify from the whole archives of a campaign folder.

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
    return identify_archives(
        [*paths, *folder.completed("standstill")],
        reporter,
        options,
        name=root.resolve().name,
        doubts=folder.damaged(),
    )


def identify_archives(
    paths: Sequence[Path],
    reporter: Reporter,
    options: Options = Options(),
    *,
    name: str = "",
    doubts: Sequence[str] = (),
) -> Identification:
    """Identify from archives; `doubts` is what is known beforehand to be wrong with them.

    Raises:
        InputError: the archives cannot be used, or not together.
    """
    sources = gather_sources(paths, options.split)
    for doubt in doubts:
        sources = sources.with_doubt(doubt)
    model = sources.cell.model
    preprocessing = _preprocessing(sources, options)
    if options.torque_bandwidth == "auto" and preprocessing.torque_bandwidth is not None:
        sources = sources.with_doubt(
            "the recorded torque seems to have come through a low-pass of "
            f"{preprocessing.torque_bandwidth:.3g} Hz before it was recorded (found on what was "
            "fitted); the model is filtered alike"
        )
    total = len(sources.training) + len(sources.held_out)
    with reporter.task("smoothing recordings", total) as task:

        def ready(source: Source, how: Preprocessing) -> Samples:
            samples = prepare(
                source.recording,
                model,
                noise_variance=sources.noise_variance,
                torque_variance=sources.torque_variance,
                options=how,
                origin=source.origin,
            )
            task.advance(1, source.name)
            return samples

        fitted = [ready(source, preprocessing) for source in sources.training]
        # A verdict on smoothed torque would flatter: what is judged is the torque as recorded.
        judged = replace(preprocessing, smooth_torque=False)
        training = (
            fitted
            if judged == preprocessing
            else [ready(source, judged) for source in sources.training]
        )
        held_out = [ready(source, judged) for source in sources.held_out]
    with reporter.task("estimating", 2) as task:
        estimate = estimate_repetitions(model, fitted)
        task.advance(1, "validating")
        nominal = sources.cell.nominal_values() if sources.cell.file.nominal else None
        evidence = gather(
            model,
            estimate,
            training,
            held_out,
            same_motion=sources.same_motion,
            nominal=nominal,
        )
        verdict = judge(model.joint_names, evidence, tested_on=sources.tested_on)
        task.advance(1)
    results = summarise(
        name or paths[0].stem, sources, estimate, verdict, training=training, held_out=held_out
    )
    return Identification(
        estimate, verdict, results, _series(sources, estimate, training[0], held_out[0])
    )


def _preprocessing(sources: Sources, options: Options) -> Preprocessing:
    cell = sources.cell
    delay = options.delay
    if delay is None:
        controller = cell.file.controller
        delay = controller.current_delay_cycles * cell.period if controller else 0.0
    plain = Preprocessing(smooth_torque=options.method == "paper", torque_delay=delay)
    bandwidth = options.torque_bandwidth
    if bandwidth == "auto":
        recording = sources.training[0].recording
        bandwidth = None
        if not plain.smooth_torque and recording.motor_current is None:
            bandwidth = find_torque_bandwidth(
                recording, cell.model, noise_variance=sources.noise_variance, options=plain
            )
    return replace(plain, torque_bandwidth=bandwidth)


def _series(
    sources: Sources, estimate: RepeatedEstimate, excitation: Samples, example: Samples
) -> ReportSeries:
    model = sources.cell.model
    motion = excitation.motion
    shown = _thinned(moving_rows(excitation))
    time = example.motion.time
    predicted = example.predicted_torque(model, estimate.pooled.values)
    drawn = _thinned(moving_rows(example))
    return ReportSeries(
        excitation_time=motion.time[shown] - excitation.origin,
        excitation_position=motion.position[shown],
        excitation_velocity=motion.velocity[shown],
        example_archive=sources.held_out[0].name,
        example_time=time[drawn] - example.origin,
        example_measured=for_figure(time, example.torque)[drawn],
        example_predicted=for_figure(time, predicted)[drawn],
    )


def _thinned(rows: slice) -> slice:
    """Rows of the motion for a figure: at rest no model of sliding friction is right."""
    return slice(rows.start, rows.stop, max(1, (rows.stop - rows.start) // FIGURE_SAMPLES))
