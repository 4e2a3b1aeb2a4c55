"""What an identification or an import concludes from a log, by the same search as a look."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from hil.archive import Archive
from hil.archive.imported import TORQUE_SIDE, UNDECIDED, with_entry
from hil.base.errors import RefusedRecordingError, SourceError, UndecidedError
from hil.base.safe_input import parse_toml
from hil.base.terminal_text import typed
from hil.cell import Cell
from hil.importers.conclusions import Certainty, TorqueSize
from hil.importers.imported_robot import Robot
from hil.importers.messages import sentence
from hil.importers.plausibility import constant_torques
from hil.importers.recording_import import ImportedRecording, ImportOptions, RobotOf, read_by_map
from hil.look.look import look_at_joints, mountings
from hil.look.messages import choice_text, fit_alike, sentences, setting_text
from hil.look.other_arm import Contradictions
from hil.look.physics import Size, sides_alike
from hil.look.readings import (
    DoubtfulArm,
    DoubtfulTime,
    GravityOption,
    NoJointTorque,
    ReadAsGiven,
)
from hil.look.result import ChangedReading, Look, Row, TiedReading
from hil.look.servo_load import may_be_load, servo_load, torques_without_sign, without_torque
from hil.look.torque_sample import SUSPECT_ERROR, TorqueSample, explained
from hil.pipeline.sources import cell_of
from identification.hypotheses.diagnosis import UNEXPLAINED, TorqueDiagnosis, unexplained_share
from identification.hypotheses.scores import SURE_SIGMAS, Score, compare, score_of
from identification.signals.recording import MIN_MOVEMENT
from identification.signals.samples import Samples
from identification.text import percentage
from identification.validation.finding import Finding
from identification.validation.finding_messages import Naming, worded
from identification.validation.findings.diagnosis import rate_of_torque, without_bodies

# error ratio of another mounting that chance alone does not make
_MAX_MOUNTING_ERROR_RATIO: Final = 0.85
# contradictions: a wrong limit of a right URDF explains one, more are refused
_MAX_WARNED_CONTRADICTIONS: Final = 2
_OF_AXES: Final = ("order", "signs", "zero", "coupling")
_REMEDY: Final = (
    "give the URDF of this arm; to identify anyway, give the column map "
    "(`hil look LOG --urdf ARM.urdf -o map.toml`, --map map.toml)"
)


class Concluded(NamedTuple):
    """A recording, read as concluded, with its diagnosis; None where none was made."""

    recording: ImportedRecording
    diagnosis: TorqueDiagnosis | None = None
    look: Look | None = None  #: that changed how it is read


@dataclass(frozen=True)
class LayoutReading:
    """How to read recordings with the same columns as an examined one.

    Attributes:
        proposed: column map by names and units of these columns.
        source: name of the recording that was examined.
        look: that changed how it is read, if any.
    """

    proposed: str
    source: str
    look: Look | None

    @classmethod
    def of(
        cls, imported: ImportedRecording, source: Path, found: Concluded
    ) -> LayoutReading | None:
        """Return how to read others; None if this recording has no torque or no columns."""
        if imported.map_text is None or imported.is_stated:
            return None
        if "torque" not in found.recording.archive.columns:
            return None
        return cls(imported.map_text, source.name, found.look)

    def read(
        self, imported: ImportedRecording, source: Path, robot_of: RobotOf
    ) -> ImportedRecording:
        """Read a recording with the same columns in the same way.

        An arm and its logger have one layout: a recording of a poorer motion, or one that is held
        out, does not decide anew what its columns mean.

        Args:
            imported: the recording as its names and units say it is.
            source: its file or folder.
            robot_of: reads the robot's cell or URDF.

        Raises:
            RefusedRecordingError: every joint that moves does so under a constant torque.
        """
        _require_measured(imported.archive, source)
        if self.look is None:
            return imported
        return _again(imported, robot_of, self.look, self.source)


def concluded(
    imported: ImportedRecording,
    source: Path,
    robot_of: RobotOf,
    options: ImportOptions,
) -> Concluded:
    """Return a log, read again by what motion and torque show with certainty.

    A log that a map describes, or whose torque follows its arm, is returned as it is, and so is a
    bag. It has a warning if the URDF may describe another arm.

    Args:
        imported: the log as its names and units say it is.
        source: its file or folder.
        robot_of: reads the robot's cell or URDF.
        options: of the import.

    Raises:
        SourceError: two readings fit alike.
        RefusedRecordingError: no model of the arm of the URDF follows from it.
    """
    if imported.is_stated or "torque" not in imported.archive.columns:
        return Concluded(imported)
    is_open = may_be_load(imported, options)
    asked = TorqueSample.of(imported.archive)
    if is_open:
        if reason := servo_load(imported, lambda: asked):
            return Concluded(without_torque(imported, robot_of, reason))
    else:
        _require_measured(imported.archive, source)
        if unsigned := torques_without_sign(imported.archive, lambda: asked):
            raise _without_sign(source, unsigned)
    if asked is None or asked.is_unexplained_by_jumps:
        return Concluded(imported)
    found = asked.diagnosis()
    _require_torque_of_arm(source, found)
    if found.time is not None:
        warned = (*imported.concluded, DoubtfulTime(found.time))
        return Concluded(replace(imported, concluded=warned), found)
    if found.is_partly_weightless:
        return Concluded(imported, found)
    suspect = asked.is_suspect(found)
    is_bag = imported.map_text is None  # its joints have names: no other order is searched
    if is_bag or not (suspect or _hangs_otherwise(asked.cell, asked.rows, asked.score)):
        imported = _of_this_arm(imported, source, asked.contradictions())
        if not is_bag:
            _require_known_side(source, imported, asked)
        return Concluded(imported, found if found.is_complete else None)
    if asked.score.overall > SUSPECT_ERROR and (how := explained(imported.archive)):
        _require_known_side(source, imported, asked)
        imported = replace(imported, concluded=(*imported.concluded, how.how))
        return Concluded(_of_this_arm(imported, source, asked.contradictions(how.score)))
    return _as_a_look_says(imported, source, robot_of, asked, is_open)


def _as_a_look_says(
    imported: ImportedRecording,
    source: Path,
    robot_of: RobotOf,
    asked: TorqueSample,
    is_open: bool,
) -> Concluded:
    """Return a log read again where a look is certain that it is other than recorded."""
    look = look_at_joints(source, imported)
    error = asked.score.overall if look.error is None else look.error
    if error > UNEXPLAINED:
        error = min(error, unexplained_share(asked.cell.model, asked.rows, asked.score))
    if error > UNEXPLAINED:
        if is_open:
            servo = without_torque(imported, robot_of, NoJointTorque(error))
            return Concluded(servo)
        raise _other_arm(source, error)
    changed = _changed(look)
    as_recorded = imported
    if look.questions or not changed:
        contradictions = asked.contradictions(error=error)
        if not changed:
            as_recorded = _of_this_arm(imported, source, contradictions)
        if look.questions:
            raise undecided(source, look.questions[0], contradictions)
    assert look.map_text is not None
    assert imported.map_text is not None
    is_other_map = parse_toml(look.map_text) != parse_toml(imported.map_text)
    if is_other_map or look.gravity is not None:
        again = _again(imported, robot_of, look)
        if (read := TorqueSample.of(again.archive)) is not None:
            axes = [row.aspect for row in changed if row.aspect in _OF_AXES]
            contradictions = read.contradictions(error=error, changed=axes)
            again = _of_this_arm(again, source, contradictions)
        return Concluded(again, look=look)
    if look.no_better is not None and not changed:
        given = ReadAsGiven(error, look.no_better)
        as_recorded = replace(as_recorded, concluded=(*as_recorded.concluded, given))
    return Concluded(as_recorded)


@dataclass
class Asking:
    """What motion and torque show about a recording, before its archive is written.

    Attributes:
        source: the recording.
        robot_of: its robot.
        options: how it is read.
        refusal: why an identification would not take it; None if it would.
    """

    source: Path
    robot_of: RobotOf
    options: ImportOptions
    refusal: SourceError | None = None

    def __call__(self, imported: ImportedRecording) -> ImportedRecording:
        """Return a recording as :func:`concluded`, or as it is where that refuses it."""
        if imported.request.use == "standstill":
            return imported
        try:
            return concluded(imported, self.source, self.robot_of, self.options).recording
        except SourceError as error:
            self.refusal = error
            if isinstance(error, UndecidedError) and error.aspect == "side":
                # so that commands ask the same of the archive
                archive = with_entry(imported.archive, TORQUE_SIDE, UNDECIDED)
                examined = imported.examined.without(TorqueSize)  # the question says it
                return replace(imported, archive=archive, examined=examined)
            return imported


def _require_known_side(source: Path, imported: ImportedRecording, asked: TorqueSample) -> None:
    """Raise UndecidedError, as a look asks, if a torque may be that of motors, or their current."""
    size = Size.of(asked.cell, asked.cell.model, asked.rows)
    if sides_alike(size, asked.cell.joint_names):
        for choices in look_at_joints(source, imported).questions:
            raise undecided(source, choices, Contradictions())


def _require_measured(archive: Archive, source: Path) -> None:
    """Raise RefusedRecordingError if every joint that moves does so under a constant torque.

    A single one is not fitted, like one whose torque is zero.
    """
    position, torque = (np.asarray(archive.columns[name]) for name in ("position", "torque"))
    constant = constant_torques(position, torque, cell_of(archive).joint_names)
    moved = np.count_nonzero(np.ptp(position, axis=0) > MIN_MOVEMENT)
    if constant and len(constant) == moved:
        remedy = "give the channel that was measured (--columns 'torque=NAME{}'), or record it"
        problem = sentence(constant[0])
        raise RefusedRecordingError(source, problem, field="torque", remedy=remedy)


def _require_torque_of_arm(source: Path, found: TorqueDiagnosis) -> None:
    """Raise RefusedRecordingError if a torque has nothing of bodies, or is the rate of one."""
    if found.rigid.is_nothing:
        raise _not_of_arm(source, without_bodies(found.rigid))
    if found.is_rate:
        raise _not_of_arm(source, rate_of_torque())


def _hangs_otherwise(cell: Cell, samples: Samples, score: Score) -> bool:
    """Return whether another mounting predicts much better; a short log fits any to some %."""
    for model in mountings(cell).values():
        if np.array_equal(model.gravity, np.zeros(3)):
            continue  # less torque to explain
        against = compare(score_of(model, samples), score, cell.model)
        if against.ratio < _MAX_MOUNTING_ERROR_RATIO and against.sigmas < -SURE_SIGMAS:
            return True
    return False


def _of_this_arm(
    imported: ImportedRecording, source: Path, contradictions: Contradictions
) -> ImportedRecording:
    """Return a recording, with a warning if the URDF may describe another arm.

    Raises:
        RefusedRecordingError: more than two independent findings contradict it.
    """
    found = contradictions.found
    if not contradictions.is_doubtful:
        return imported
    if len(found) > _MAX_WARNED_CONTRADICTIONS:
        problem = f"was not recorded on the arm of the URDF: {sentences(found)}"
        raise RefusedRecordingError(source, problem, field="--urdf", remedy=_REMEDY)
    return replace(imported, concluded=(*imported.concluded, DoubtfulArm(found)))


def _changed(look: Look) -> list[Row]:
    """Return the rows of what is certain to be other than recorded."""
    return [row for row in look.rows if row.is_changed and row.certainty is Certainty.CERTAIN]


def _again(
    imported: ImportedRecording, robot_of: RobotOf, look: Look, looked_at: str = ""
) -> ImportedRecording:
    """Read a log again with a map and the gravity that were found, perhaps of another log."""
    assert look.map_text is not None
    gravity = look.gravity

    def robot(recorded: object) -> Robot:
        described = robot_of(recorded)  # type: ignore[arg-type]
        return described if gravity is None else described.with_gravity(gravity)

    again = read_by_map(imported.request, robot, look.map_text)
    changes = [ChangedReading(row, looked_at) for row in _changed(look)]
    return replace(again, concluded=(*imported.concluded, *changes))


def undecided(
    source: Path, choices: tuple[TiedReading, ...], contradictions: Contradictions
) -> UndecidedError:
    """Return the refusal of hypotheses that fit equally well; a doubtful arm comes first."""
    aspect = choices[0].aspect
    errors = [
        f" (error {percentage(choice.error, 1)})" if choice.error else "" for choice in choices
    ]
    readings = " or ".join(
        choice_text(choice) + error for choice, error in zip(choices, errors, strict=True)
    )
    settings = [choice.setting for choice in choices if choice.setting is not None]
    options = [setting_text(each) for each in settings if isinstance(each, GravityOption)]
    lines = [setting_text(each) for each in settings if not isinstance(each, GravityOption)]
    steps = []
    if options:
        steps.append(f"state {' or '.join(options)}")
    if lines:
        steps.append(
            f"write the map with `hil look {typed(source.name)} --urdf ARM.urdf -o map.toml`, "
            f"add {'one of the lines ' if len(lines) > 1 else ''}{' or '.join(lines)}, and give it "
            "with --map"
        )
    remedy = "; or ".join(steps) or "name joint, unit and sign of each column in a map (--map)"
    problem = f"{fit_alike(choices)}: {readings}"
    if contradictions.is_doubtful:
        found = sentences(contradictions.found)
        problem = f"may not be from the arm of the URDF: {found}; and {problem}"
        remedy = f"{_REMEDY}; or {remedy}"
        return UndecidedError(source, problem, field="--urdf", remedy=remedy, aspect=aspect)
    if aspect in _OF_AXES:
        remedy += "; if none of these is the case, give the URDF of this arm"
    if aspect == "side":
        problem = f"its torque is too small for the joints of this arm; {problem}"
        remedy += "; a map without them reads it as joint torque"
    return UndecidedError(source, problem, field=aspect, remedy=remedy, aspect=aspect)


def _not_of_arm(source: Path, found: Finding) -> RefusedRecordingError:
    finding = worded(found, Naming())
    remedy = (
        f"{finding.next_step}; to identify anyway, give the column map (`hil look LOG"
        " --urdf ARM.urdf -o map.toml`, --map map.toml)"
    )
    return RefusedRecordingError(source, finding.words, field="torque", remedy=remedy)


def _without_sign(source: Path, count: int) -> RefusedRecordingError:
    problem = (
        f"no torque is ever negative, although {count} joints move there and back: its sign was"
        " not recorded"
    )
    remedy = (
        "record the torque with its sign; where a bit of the numbers holds it, give a column map "
        "with"
        " [torque] sign_bit = N (`hil look LOG --urdf ARM.urdf -o map.toml`, --map map.toml)"
    )
    return RefusedRecordingError(source, problem, field="torque", remedy=remedy)


def _other_arm(source: Path, error: float) -> RefusedRecordingError:
    problem = (
        "its torque does not follow the arm of the URDF: no masses explain"
        f" {percentage(error)} of it, and no other unit, sign or joint order helps; it comes from"
        " another arm, or from another run than the positions"
    )
    return RefusedRecordingError(source, problem, field="--urdf", remedy=_REMEDY)
