"""Identification of a payload from loaded recordings and the model of the arm alone."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from hil.archive import open_archive
from hil.base.errors import ArchiveError, InputError
from hil.base.progress import Reporter
from hil.pipeline.estimating import Estimation, estimate_with
from hil.pipeline.options import Options
from hil.pipeline.other_meanings import require_weight
from hil.pipeline.prepared import Prepared, prepare_sources, samples_of
from hil.pipeline.sources import (
    Source,
    archives_in,
    gather_sources,
    refuse_duplicates,
)
from hil.pipeline.torque_scale import torque_scale
from identification.estimators.payload_problem import KnownArm, Run
from identification.hypotheses.gravity_direction import tilted_gravity

from .payload_found import BareCheck, PayloadFound
from .payload_run import (
    flange_of,
    require_one_arm,
    weighed,
    weight_per_mass,
)


def weigh_by_model(
    arm: Sequence[Path],
    loaded: Sequence[Path],
    reporter: Reporter,
    *,
    frame: str | None = None,
    options: Options | None = None,
) -> PayloadFound:
    """Identify the payload of loaded recordings against the posterior of the arm.

    Offsets and friction of the loaded recordings are free to scale, as between bare and loaded
    ones.

    Args:
        arm: campaign folders or archives of the bare arm, of any motion: they are identified with
            all automatic choices.
        loaded: archives with the payload.
        reporter: of progress.
        frame: of the payload.
        options: of the identification.

    Raises:
        InputError: archives cannot be used, are of two arms, or have no payload.
        IdentificationError: the recordings do not determine the mass.
    """
    options = options or Options()
    recorded = list(archives_in(arm))
    paths = list(archives_in(loaded))
    # What the folder of the arm only predicted may be what is weighed.
    fitted = [path for path in recorded if open_archive(path).header.purpose != "validation"]
    of_arm = fitted or recorded
    refuse_duplicates([*of_arm, *paths])
    sources = gather_sources(of_arm, options.split, in_sample=True)
    others = gather_sources(paths, options.split, in_sample=True)
    require_one_arm(sources.cell, others.cell, str(arm[0]), paths[0])
    _require_usable(sources.cell.file.robot.payload is not None, "carries a known payload", arm[0])
    # The loaded recordings have one bandwidth, and the arm must have the same.
    prepared = prepare_sources(sources, options, reporter).unhedged()
    cell = prepared.sources.cell
    _require_usable(cell.model.friction.has_load, "has friction that grows with the load", arm[0])
    known_arm = _known(estimate_with(prepared, options, reporter))
    frame = frame or flange_of(cell.model)
    runs = _reduced(others.training, prepared, frame, reporter)
    recordings = [source.recording for source in (*prepared.sources.training, *others.training)]
    simulated = sources.header.only_simulated and others.header.only_simulated
    scale = torque_scale(cell, recordings, simulated=simulated)
    sides = {False: of_arm, True: paths}
    of_both = (*prepared.sources.training, *others.training)
    meanings = require_weight(cell.model, prepared.fitted, of_both, of_arm[0])
    mounting = tilted_gravity(cell.model, prepared.fitted)
    check = BareCheck(tuple(cell.model.joint_names), mounting, meanings)
    estimate, body = weighed(
        cell.model, runs, scale, frame, sides, others.training, check, known_arm
    )
    return PayloadFound(
        estimate=estimate,
        body=body,
        frame=frame,
        gravity=weight_per_mass(cell.model),
        bare=(),
        loaded=tuple(source.name for source in others.training),
        scale=scale,
        bare_check=check,
        typed=((), tuple(loaded)),
        with_currents=all(recording.motor_current is not None for recording in recordings),
        warnings=(*prepared.sources.warnings, *others.warnings),
    )


def _known(arm: Estimation) -> KnownArm:
    """Return what the identification of the bare arm knows of its parameters."""
    posterior = arm.posterior
    information = posterior.prior.belief.gaussian.information
    return KnownArm.of(arm.result.factor, arm.result.pooled, information, posterior.design_effect)


def _reduced(
    loaded: Sequence[Source], prepared: Prepared, frame: str, reporter: Reporter
) -> list[Run]:
    """Return loaded recordings reduced with the settings of the arm's."""
    cell = prepared.sources.cell
    runs = []
    with reporter.task("reducing recordings", len(loaded)) as task:
        for source in loaded:
            if source.recording.torque is None:
                raise ArchiveError(source.path, "contains no joint torques", field="torque")
            samples = samples_of(source, cell, prepared.settings)
            runs.append(Run.of(source.name, cell.model, samples, frame, loaded=True))
            task.advance(1, source.name)
    return runs


def _require_usable(refused: bool, what: str, path: Path) -> None:
    if refused:
        remedy = "record the arm without the payload too: hil payload BARE --loaded LOADED"
        raise InputError(path, f"{what}, and is no model of the bare arm", remedy=remedy)
