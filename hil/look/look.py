"""A look at a recording: names and units, clock, slopes, limits, then the torque's physics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from hil.archive import open_archive
from hil.archive.imported import TORQUE_SIDE, UNDECIDED
from hil.archive.schema import CYCLE
from hil.base.errors import ArchiveError, SourceError
from hil.cell import Cell
from hil.importers.conclusions import (
    Certainty,
    ChannelMeaning,
    ConcludedUnit,
    Examined,
    NameBasis,
    UnitBasis,
)
from hil.importers.excerpt import MAX_EXCERPT_ROWS
from hil.importers.log_files import LogFiles
from hil.importers.recording_import import (
    ImportedRecording,
    ImportOptions,
    ImportRequest,
    RobotOf,
    read_recording,
)
from hil.importers.required_signals import require_motion
from hil.importers.units import Kind
from hil.look import physics, signals
from hil.look.corrected_map import with_entries
from hil.look.explanations import explained_rows
from hil.look.other_arm import Contradictions
from hil.look.readings import (
    Basis,
    ErrorExplained,
    Evidence,
    Fact,
    NextStep,
    NoJointTorque,
    StillUnexplained,
    Vector,
)
from hil.look.result import Aspect, Look, ParameterGroup, Row
from hil.look.servo_load import may_be_load, servo_load, torques_without_sign, without_torque
from hil.look.torque_sample import (
    SETTINGS,
    SUSPECT_ERROR,
    TorqueSample,
    explained,
    explained_by_springs,
    prepared,
)
from hil.look.undescribed import undescribed_robot
from hil.pipeline.sources import Source, cell_of, source_of
from hil.pipeline.torque_scale import torque_scale
from identification.errors import IdentificationError
from identification.estimators.delay import DelayEstimate, estimate_delay
from identification.hypotheses.diagnosis import UNEXPLAINED, TorqueDiagnosis, few_rows, torque_of
from identification.hypotheses.gravity_direction import tilted_gravity
from identification.hypotheses.inertia_scale import retimed
from identification.hypotheses.joint_changes import Axes
from identification.hypotheses.readings import Readings
from identification.hypotheses.scores import EXPLAINED_ERROR, LARGE_REDUCTION, Score, score_of
from identification.hypotheses.search import find_readings
from identification.hypotheses.torque_low_pass import TorqueLowPass, torque_low_pass
from identification.model.robot import RobotModel
from identification.signals.recording import RIGID_RATE, Recording, RecordingError
from identification.signals.samples import Samples

# of the torque, predicted from other parts, above which the direction of gravity is asked
_TILT_ERROR: Final = 0.05
_GRAVITY_DECIMALS: Final = 3  # of m/s², as finely as an arm is levelled
_DELAY_SAMPLES: Final = 20_000
# Both motion and torque are limited to a twelfth of it before a delay is estimated.
_DELAY_RATE: Final = 125.0  # Hz
_COLUMNS: Final[tuple[tuple[str, Kind, str], ...]] = (
    ("position", "position", "rad"),
    ("torque", "torque", "N·m"),
    ("target_current", "motor_current", "A"),
)
"""Columns of an archive of `hil` that are looked at: what they are, and their unit."""


def look_at(source: Path, robot_of: RobotOf | None, options: ImportOptions) -> Look:
    """Return what a recording contains and, with its robot, what its torque can determine.

    An archive has its robot in it, unless another is given, and states what its channels are.

    Raises:
        SourceError: it cannot be read, or its names leave a quantity open.
    """
    imported = None if robot_of is not None else _archived(source)
    described = robot_of is not None or imported is not None
    if imported is not None:
        return _look(source, imported, described=True)
    files = LogFiles(longest=MAX_EXCERPT_ROWS)
    robot = robot_of or (lambda _: undescribed_robot(source, options, files))
    lenient = replace(options, outside_limits=True)
    imported = read_recording(source, robot, lenient, files=files)
    require_motion(imported.archive, source)
    reason = _load(imported, options, described=described)
    if reason is None:
        look = _look(source, imported, described=described)
        is_open = may_be_load(imported, options)
        if not is_open or (look.error or 0.0) <= UNEXPLAINED or explained(imported.archive):
            return look
        reason = NoJointTorque(look.error)
    without = without_torque(imported, robot, reason)
    return _look(source, without, described=described)


def _load(
    imported: ImportedRecording, options: ImportOptions, *, described: bool
) -> NoJointTorque | None:
    """Return why a torque is none of the joints by sign or name, as an identification concludes."""

    def sample() -> TorqueSample | None:
        return TorqueSample.of(imported.archive) if described else None

    if may_be_load(imported, options):
        return servo_load(imported, sample)
    if imported.is_stated or "torque" in options.chosen:
        return None
    return NoJointTorque() if torques_without_sign(imported.archive, sample) else None


def _look(source: Path, imported: ImportedRecording, *, described: bool) -> Look:
    """Return what a recording contains, of a described robot or not."""
    require_motion(imported.archive, source)
    cell = cell_of(imported.archive)
    try:
        recorded = source_of(imported.archive, cell, to_fit=False)
        recorded.recording.checked(cell.joint_names)
    except (RecordingError, SourceError) as error:
        raise SourceError(source, str(error)) from error
    rows = signals.rows(recorded, imported, cell if described else None)
    loads = (each for each in imported.concluded if isinstance(each, NoJointTorque))
    load = next(loads, None)
    if described and recorded.recording.torque is None:
        rows.append(physics.without_torque(recorded.recording, load))
        look = Look(source.name, tuple(rows), (), (), imported.map_text)
    elif described:
        look = _with_torque(source, recorded, imported, cell, rows)
    else:
        rows.append(_without_robot(recorded.recording, load))
        look = Look(source.name, tuple(rows), (), (), imported.map_text)
    return replace(look, bag_text=None if imported.bag is None else imported.bag.text)


def _by_numbers(rows: Sequence[Row], evidence: Evidence) -> list[Row]:
    """Return rows whose units the numbers alone say, which are not certain for a reason.

    One joint in another unit than the others leaves the limits of the URDF as all of them do.
    """
    return [
        physics.no_longer_certain(row, evidence)
        if row.aspect in ("position", "velocity")
        and any(isinstance(each, ConcludedUnit) for each in row.evidence)
        else row
        for row in rows
    ]


def _archived(source: Path) -> ImportedRecording | None:
    """Return an archive of `hil` as what an import would give; None of any other file."""
    try:
        archive = open_archive(source)
    except ArchiveError:
        return None  # the import says what it is, and whether it can be read
    if not {"cell.toml", "robot.urdf"} <= archive.attachments.keys():
        return None
    concluded = tuple(
        ChannelMeaning(f"{CYCLE}/{column}", kind, NameBasis.MESSAGE, unit, UnitBasis.MESSAGE)
        for column, kind, unit in _COLUMNS
        if np.isfinite(archive.columns.get(column, np.nan)).any()
    )
    request = ImportRequest(source, source)
    return ImportedRecording(request, archive, (source,), None, concluded, Examined((), ()))


def _without_robot(recording: Recording, load: NoJointTorque | None) -> Row:
    if recording.torque is None and recording.motor_current is None:
        return physics.without_torque(recording, load)
    quantity: Aspect = "torque" if recording.torque is not None else "motor current"
    evidence = (Basis.NO_GEOMETRY,)
    open_ = Certainty.UNDETERMINED
    return Row(quantity, Fact.TORQUE_UNEXAMINED, open_, evidence, NextStep.GIVE_URDF)


def _with_torque(
    source: Path, recorded: Source, imported: ImportedRecording, cell: Cell, rows: list[Row]
) -> Look:
    recording = recorded.recording
    samples, torque = _diagnosed(cell, recording)
    found = explained(imported.archive) if torque.error > SUSPECT_ERROR else None
    finding = _finding(
        source, imported, cell, recording, samples, torque, is_explained=found is not None
    )
    if found is None and torque.error > SUSPECT_ERROR:
        rows_as_read = few_rows([samples])
        found = explained_by_springs(cell.model, rows_as_read, score_of(cell.model, rows_as_read))
    if found is not None:
        least = (1.0 - LARGE_REDUCTION) * found.score.overall
        if finding.readings.score.overall > least:
            if _is_beyond(found.score, finding):
                stated = few_rows([prepared(recording, cell.model)])
                finding = finding.as_stated(stated, found.score)
            finding = finding.or_explained(ErrorExplained(found.score.overall, found.how))
    delay, low_pass = _channel(finding.axes.read(recording), finding.readings.model)
    channel = list(physics.channel_rows(delay, low_pass))
    if recorded.retimed:
        channel = [physics.by_estimated_times(row) for row in channel]
    groups = physics.determined(finding.readings)
    score = finding.readings.score
    of_torque = finding.rows(groups)
    unexplained = StillUnexplained(score.overall)
    if score.overall > EXPLAINED_ERROR or finding.fits_badly:
        rows = _by_numbers(rows, unexplained)
    if score.overall > EXPLAINED_ERROR:
        channel = [physics.no_longer_certain(row, unexplained) for row in channel]
    if (scales := finding.other_scales) is not None:
        # Such as numbers of a servo from -100 to 100, with a range of its own for each joint.
        rows = _by_numbers(rows, scales)
        of_torque = [
            physics.no_longer_certain(row, scales) if row.aspect == "angle unit" else row
            for row in of_torque
        ]
    scale = torque_scale(cell, [recording], simulated=imported.archive.header.only_simulated)
    rows = [*rows, *of_torque, *explained_rows(finding, scale.std), *channel]
    contradictions = Contradictions.of(
        cell, finding.readings.model, finding.readings.samples, score, score.overall
    )
    if contradictions.is_doubtful:
        rows.append(contradictions.row)
    return _look_of(finding, rows, groups)


def _is_beyond(score: Score, finding: physics.TorqueFindings) -> bool:
    """Return whether a score of rows as read is much better than one with all that was found."""
    least = (1.0 - LARGE_REDUCTION) * finding.readings.score.overall
    return finding.torque.time is None and score.overall < least


def look_at_joints(source: Path, imported: ImportedRecording) -> Look:
    """Return only what the torque of an imported recording shows about its joints.

    Whether the arm is another one is left to the caller.

    Raises:
        SourceError: the recording cannot be used.
    """
    cell = cell_of(imported.archive)
    recording = source_of(imported.archive, cell).recording
    finding = _finding(source, imported, cell, recording, *_diagnosed(cell, recording))
    return _look_of(finding, finding.rows(), ())


def _diagnosed(cell: Cell, recording: Recording) -> tuple[Samples, TorqueDiagnosis]:
    """Return samples of a recording, at the times that the torque shows, and what the torque is."""
    samples = prepared(recording, cell.model)
    rows = few_rows([samples])
    torque = torque_of(cell.model, [samples], rows, score_of(cell.model, rows))
    if torque.time is not None:
        samples = retimed(cell.model, samples, torque.time)
    return samples, torque


def _finding(
    source: Path,
    imported: ImportedRecording,
    cell: Cell,
    recording: Recording,
    samples: Samples,
    torque: TorqueDiagnosis,
    *,
    is_explained: bool = False,
) -> physics.TorqueFindings:
    """Return how the torque is to be read; see `find_readings` for `is_explained`."""
    gravities: Mapping[str, Vector] = physics.MOUNTINGS

    def read() -> Readings:
        return find_readings(
            cell.model,
            samples,
            mountings=mountings(cell, gravities),
            unit_is_open=_is_unit_open(imported),
            is_explained=is_explained,
        )

    readings = read()
    is_open = readings.score.overall > _TILT_ERROR and not torque.is_otherwise
    if is_open and (tilted := tilted_gravity(cell.model, [samples])) is not None:
        gravity = tuple((np.round(tilted.best, _GRAVITY_DECIMALS) + 0.0).tolist())
        gravities = {**gravities, physics.tilt_name(tilted.angle): gravity}
        readings = read()
    axes = Axes.of((step.change for step in readings.steps), cell.model.n_joints)
    return physics.TorqueFindings(
        cell,
        recording,
        torque,
        readings,
        axes,
        imported.map_text,
        source,
        imported.request.files,
        gravities,
        is_side_open=_is_side_open(imported),
    )


def _is_side_open(imported: ImportedRecording) -> bool:
    """Return whether nothing states that a torque acts on the joints, not on the motors.

    A map of the user states it, so does the message of a bag, and an archive unless its log was
    imported without.
    """
    if imported.map_text is None:
        return imported.archive.header.entries.get(TORQUE_SIDE) == UNDECIDED
    return not imported.is_stated


def _look_of(
    finding: physics.TorqueFindings, rows: Sequence[Row], groups: tuple[ParameterGroup, ...]
) -> Look:
    text = finding.map_text
    if text is not None:
        text = with_entries(text, finding.entries())
    return Look(
        finding.source.name,
        tuple(rows),
        finding.questions(),
        groups,
        text,
        finding.gravity(),
        finding.readings.score.overall,
        no_better=finding.no_better,
    )


def _is_unit_open(imported: ImportedRecording) -> bool:
    """Return whether the numbers alone say the unit of the positions."""
    return not any(
        each.kind == "position" and each.unit_basis is not UnitBasis.NUMBERS
        for each in imported.concluded
        if isinstance(each, ChannelMeaning)
    )


def mountings(
    cell: Cell, gravities: Mapping[str, Vector] = physics.MOUNTINGS
) -> dict[str, RobotModel]:
    """Return models of a cell with another gravity [m/s²], by the mounting."""
    return {
        name: cell.model.under_gravity(gravity)
        for name, gravity in gravities.items()
        if not np.allclose(gravity, cell.model.gravity)
    }


def _channel(
    recording: Recording, model: RobotModel
) -> tuple[DelayEstimate | None, TorqueLowPass | None]:
    """Return delay and low-pass of the torque; None where the motion does not say."""
    some = recording.between(0, min(recording.n_samples, _DELAY_SAMPLES)).averaged(RIGID_RATE)
    try:
        delay = estimate_delay(some.averaged(_DELAY_RATE), model, options=SETTINGS)
        delay = replace(delay, cycle=float(np.median(np.diff(recording.time))))
        return delay, torque_low_pass(some, model, SETTINGS)
    except IdentificationError:
        return None, None
