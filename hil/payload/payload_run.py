"""Identification of a payload from archives recorded without and with it."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from hil.base.errors import ArchiveError, InputError
from hil.base.progress import Reporter
from hil.cell import Cell
from hil.cell.cell import FLANGES
from hil.pipeline.options import Options
from hil.pipeline.other_meanings import require_weight
from hil.pipeline.prepared import Prepared, prepare_sources, samples_of
from hil.pipeline.sources import (
    GRAVITY,
    Source,
    Sources,
    aligned,
    archives_in,
    arm_differences,
    gather_sources,
    refuse_duplicates,
)
from hil.pipeline.torque_scale import TorqueScale, torque_scale
from identification.estimators.payload_estimate import (
    PayloadEstimate,
    contradiction,
    identify_payload,
    reach,
)
from identification.estimators.payload_problem import KnownArm, Run
from identification.hypotheses.gravity_direction import tilted_gravity
from identification.model.pseudo_inertia import Body
from identification.model.robot import STANDARD_GRAVITY, RobotModel

from .payload_found import BareCheck, PayloadFound
from .payload_messages import certain_lines, mounting_words

_MIN_CENTRE_LIMIT: Final = 0.5  # m, of a hand tool on an arm that is shorter itself


def weight_per_mass(model: RobotModel) -> float:
    """Return the gravity [m/s²] that loads the flange, also where the torque is without it."""
    return float(np.linalg.norm(model.gravity if np.any(model.gravity) else STANDARD_GRAVITY))


def find_payload(
    bare: Sequence[Path],
    loaded: Sequence[Path],
    reporter: Reporter,
    *,
    frame: str | None = None,
    options: Options = Options(estimator="wls"),
) -> PayloadFound:
    """Identify the payload of the loaded recordings as their difference to the bare ones.

    Settings are chosen on the bare recordings; `[robot.payload]` of the cells is ignored.

    Args:
        bare: archives, folders of them, or campaign folders.
        loaded: likewise.
        reporter: of progress.
        frame: link of the payload; default: `flange_of`.
        options: of the identification.

    Raises:
        NoPayloadError: the loaded recordings show no payload.
        InputError: archives cannot be used, are of two arms, or hold torque without gravity.
        IdentificationError: the recordings do not determine the mass.
    """
    sides = _sides(bare, loaded)
    by_side = _sources_of(sides)
    training = (*by_side[False].training, *by_side[True].training)
    cell = by_side[False].cell.without_payload()
    if by_side[False].plan is None and by_side[True].plan is None:
        training, _ = aligned(training)
    first = training[: len(by_side[False].training)]
    last = training[len(by_side[False].training) :]
    sources = replace(by_side[False], cell=cell, training=first, held_out=first)
    prepared = prepare_sources(sources, options, reporter)
    cell = prepared.sources.cell
    meanings = require_weight(cell.model, prepared.fitted, training, first[0].path)
    frame = frame or flange_of(cell.model)
    runs = _runs(prepared, last, frame, reporter)
    simulated = all(side.header.only_simulated for side in by_side.values())
    recordings = [source.recording for source in training]
    scale = torque_scale(cell, recordings, simulated=simulated)
    with reporter.task("weighing", 2) as task:
        mounting = tilted_gravity(cell.model, prepared.fitted)
        task.advance(1)
        check = BareCheck(tuple(cell.model.joint_names), mounting, meanings)
        estimate, body = weighed(cell.model, runs, scale, frame, sides, training, check)
        task.advance(1)
    return PayloadFound(
        estimate=estimate,
        body=body,
        frame=frame,
        gravity=weight_per_mass(cell.model),
        bare=tuple(source.name for source in first),
        loaded=tuple(source.name for source in last),
        scale=scale,
        bare_check=check,
        typed=(tuple(bare), tuple(loaded)),
        with_currents=all(recording.motor_current is not None for recording in recordings),
        warnings=(*prepared.sources.warnings, *by_side[True].warnings),
    )


class NoPayloadError(InputError):
    """The recordings show no payload; more of them may."""


def _no_payload(
    estimate: PayloadEstimate, check: BareCheck, loaded: Sequence[Path]
) -> NoPayloadError:
    """Return the error of loaded recordings without a payload, which names the first of them."""
    low, high = estimate.intervals[0]
    others = f", like {len(loaded) - 1} more given as loaded" if len(loaded) > 1 else ""
    problem = f"shows no payload{others}: its mass is between {low:.3g} and {high:.3g} kg"
    remedy = "give recordings made with the payload here, and the ones without it as bare"
    if check.mounting is not None:
        problem += ", as the arm is stated to be mounted"
        remedy = f"the mounting is doubtful: {mounting_words(check.mounting)}; then {remedy}"
    if check.certain:
        problem += ", with the recordings as described"
        remedy = "; ".join([*certain_lines(check), f"then {remedy}"])
    return NoPayloadError(loaded[0], problem, remedy=remedy)


def _sides(bare: Sequence[Path], loaded: Sequence[Path]) -> dict[bool, list[Path]]:
    """Return the archives without (False) and with the payload."""
    sides = {False: list(archives_in(bare)), True: list(archives_in(loaded))}
    if not sides[False] or not sides[True]:
        problem = "recordings without and with the payload are needed"
        remedy = "give both: hil payload BARE... --loaded LOADED"
        raise InputError(None, problem, remedy=remedy)
    refuse_duplicates([*sides[False], *sides[True]])
    return sides


def _sources_of(sides: Mapping[bool, Sequence[Path]]) -> dict[bool, Sources]:
    """Return the bare (False) and the loaded recordings: of one arm, with torques."""
    sources = {
        kind: gather_sources(paths, Options().split, in_sample=True)
        for kind, paths in sides.items()
    }
    bare = sources[False].cell
    loaded = sources[True].cell
    require_one_arm(bare, loaded, str(bare.path), sides[True][0], "--loaded")
    for source in (*sources[False].training, *sources[True].training):
        if source.recording.torque is None:
            problem = "contains no joint torques"
            remedy = "give drive.torque_constant in the column map"
            raise ArchiveError(source.path, problem, field="torque", remedy=remedy)
    return sources


def require_one_arm(bare: Cell, loaded: Cell, name: str, path: Path, field: str = "") -> None:
    """Raise ArchiveError if cells differ.

    Args:
        bare: of the recordings without the payload.
        loaded: of those with it.
        name: of the bare recordings, for the error.
        path: of the first loaded one.
        field: that names them, if any.
    """
    differing = arm_differences(bare, loaded)
    if differing == [GRAVITY]:
        sides = (f"{cell.file.robot.gravity}" for cell in (loaded, bare))
        problem = f"is read with the gravity {' and not '.join(sides)} m/s², as {name} is"
        remedy = (
            "record the torques of both with the weight of the arm, or both without it, on an arm"
            " mounted alike"
        )
        raise ArchiveError(path, problem, field=field, remedy=remedy)
    if differing:
        problem = f"belongs to another arm than {name}: {' and '.join(differing)} differ"
        remedy = "give bare and loaded recordings of one arm"
        raise ArchiveError(path, problem, field=field, remedy=remedy)


def _runs(
    prepared: Prepared, loaded: Sequence[Source], frame: str, reporter: Reporter
) -> list[Run]:
    """Reduce the bare recordings, which are prepared, and the loaded ones."""
    cell = prepared.sources.cell
    bare = prepared.sources.training
    runs = []
    with reporter.task("reducing recordings", len(bare) + len(loaded)) as task:
        for source, samples in zip(bare, prepared.fitted, strict=True):
            runs.append(Run.of(source.name, cell.model, samples, frame, loaded=False))
            task.advance(1, source.name)
        for source in loaded:
            samples = samples_of(source, cell, prepared.settings)
            runs.append(Run.of(source.name, cell.model, samples, frame, loaded=True))
            task.advance(1, source.name)
    return runs


def weighed(
    model: RobotModel,
    runs: Sequence[Run],
    scale: TorqueScale,
    frame: str,
    sides: Mapping[bool, Sequence[Path]],
    training: Sequence[Source],
    check: BareCheck,
    arm: KnownArm | None = None,
) -> tuple[PayloadEstimate, Body]:
    """Return the payload of reduced recordings.

    Args:
        model: of the arm.
        runs: reduced recordings.
        scale: of torques.
        frame: of the payload.
        sides: the bare and the loaded archives.
        training: their recordings.
        check: of the bare recordings.
        arm: what is known of it.

    Raises:
        InputError: there is no payload, the recordings contradict each other, or no arm can carry
            what was found.
        IdentificationError: the recordings do not determine the mass.
    """
    estimate = identify_payload(model, runs, scale.std, arm)
    if estimate.body is None:
        raise _no_payload(estimate, check, sides[True])
    _require_agreement(model, runs, estimate, frame, sides, training, arm)
    positions = [np.abs(source.recording.position).max(axis=0) for source in training]
    travel = np.max(positions, axis=0)
    _require_within_reach(estimate, reach(model, frame, travel), frame)
    return estimate, estimate.body


def _require_agreement(
    model: RobotModel,
    runs: Sequence[Run],
    estimate: PayloadEstimate,
    frame: str,
    sides: Mapping[bool, Sequence[Path]],
    training: Sequence[Source],
    arm: KnownArm | None,
) -> None:
    """Raise InputError if two recordings carried different bodies."""
    weighings = contradiction(model, runs, estimate, arm)
    if weighings is None:
        return
    first, second = weighings
    loaded = next(run.loaded for run in runs if run.name == second.name)
    if not loaded:
        mass, low, high = second.mass
        heavier, lighter = (second, first) if mass > 0.0 else (first, second)
        low, high = (low, high) if mass > 0.0 else (-high, -low)
        raise InputError(
            None,
            f"the bare recordings contradict each other: {heavier.name} carries"
            f" {abs(mass):.3g} kg ({low:.3g} to {high:.3g} kg) more than {lighter.name}",
            remedy="give bare recordings with one tool, or none, on the flange",
        )
    phrases = []
    for weighing in weighings:
        mass, low, high = weighing.mass
        centre = ", ".join(
            f"{1e3 * part:.0f}" if np.isfinite(part) else "?" for part in weighing.centre
        )
        phrases.append(
            f"{weighing.name} weighs {mass:.4g} kg ({low:.4g} to {high:.4g} kg) with its centre at"
            f" ({centre}) mm in {frame}"
        )
    other = next(source.path for source in training if source.name == second.name)
    command = ["hil", "payload", *map(str, sides[False]), "--loaded", str(other)]
    raise InputError(
        None,
        f"the loaded recordings contradict each other: {phrases[0]}, {phrases[1]}",
        field="--loaded",
        remedy="a load that was turned, moved or changed is another payload; weigh each by itself:"
        f" {shlex.join(command)}",
    )


def _require_within_reach(estimate: PayloadEstimate, length: float, frame: str) -> None:
    """Raise InputError if the centre of mass is further from the flange than the arm is long.

    A load's moment about the base is then at least twice that of the same mass at the flange, which
    no maker's rating allows.
    """
    value, low, high = (part / estimate.parameters[9] for part in estimate.moment)
    if value <= max(length, _MIN_CENTRE_LIMIT):
        return
    mass = estimate.parameters[9]
    raise InputError(
        None,
        f"the estimated body ({mass:.3g} kg) cannot hang on this arm: its centre of mass would be"
        f" {value:.2g} m ({low:.2g} to {high:.2g} m) from {frame}, and the arm is"
        f" {length:.2g} m long",
        field="--loaded",
        remedy="record the same motion bare and loaded, with the wrist in many poses; check that"
        " torques of all joints have the right sign and unit, and that only the payload differs",
    )


def flange_of(model: RobotModel) -> str:
    """Return the flange link: `tool0`, `flange`, or the link of the last joint."""
    chain = model.chain
    last = {name: pose for name, pose in chain.frames.items() if pose.joint == chain.last_joint}
    named = next((name for name in FLANGES if name in last), None)
    return named or min(last, key=lambda name: float(np.abs(last[name].translation).sum()))
