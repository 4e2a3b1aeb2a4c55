"""Archives of an identification, sorted into fitted and held-out recordings."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from drivers.c4g_packets import DRIVE_ON
from hil.archive import Archive, ArchiveHeader, ArchiveName, open_archive, opened, place_of
from hil.archive.campaign_archives import RecordedCampaign
from hil.archive.header import EPISODE, REJECTED
from hil.archive.imported import COPIED_COMMANDS, TORQUE_SIDE, UNDECIDED
from hil.archive.recording_of_archive import recording_of
from hil.base.arrays import Array
from hil.base.errors import ArchiveError, CampaignFolderError, InputError
from hil.base.files import file_digest
from hil.base.safe_input import path_exists
from hil.base.terminal_text import typed
from hil.cell import Cell
from identification.signals.noise import standstill_variance
from identification.signals.recording import (
    Recording,
    RecordingError,
    cut_at_pauses,
    offsets_of_repetitions,
    without_repeats,
)
from identification.signals.row_faults import RowFault, RowFaultKind, without_faulty_rows
from identification.signals.sample_times import SampleTimes, true_times
from identification.validation.finding import TestedOn

from .notes import (
    AssumedPayload,
    AssumedTorqueConstants,
    EndedEarly,
    LastHeldOut,
    Note,
    NotJudged,
    RejectedArchive,
    RestPredicted,
    StatedText,
)

FLOAT32_STEP = 2.0**-24
"""Relative rounding error of a float32 position on the wire."""


@dataclass(frozen=True, eq=False)
class Source:
    """The recording of one archive."""

    path: Path  #: of the archive
    name: str  #: file name
    recording: Recording  #: joints in the order of the model
    origin: float  #: time of the first set-point [s]
    merged: int = 0  #: samples that repeated the time stamp before them, averaged with it
    times: SampleTimes | None = None  #: of its samples; None where the controller counts cycles
    faults: tuple[RowFault, ...] = ()  #: rows that are not of its motion
    stamps: Array | None = None  #: time stamps of the archive's rows, where `times` is known [s]
    #: of a part: the complete recording, with torques set to zero outside the part, and the index
    #: of its first sample, so that filters see the motion beyond its ends
    context: tuple[Recording, int] | None = None

    @property
    def retimed(self) -> bool:
        """Whether other times than the time stamps are used, or rows were left out for them."""
        return self.times is not None and (self.times.even or self.times.removed > 0)

    @property
    def whole(self) -> Recording:
        """The recording to prepare: the whole one, if this is a part."""
        return self.recording if self.context is None else self.context[0]

    @property
    def motion_key(self) -> int:
        """A number common to all parts of one recording."""
        return id(self.whole.position)


@dataclass(frozen=True, eq=False)
class Sources:
    """All archives of one identification."""

    cell: Cell  #: of the first archive
    header: ArchiveHeader  #: of the first archive
    plan: dict[str, Any] | None  #: of the first archive
    training: tuple[Source, ...]  #: fitted
    same_motion: bool  #: whether `training` are repetitions of one motion
    held_out: tuple[Source, ...]  #: predicted, not fitted
    noise_variance: Array | None  #: of positions at standstill (n,) [rad²]; None if not recorded
    torque_variance: Array | None  #: of torques at standstill (n,) [N²·m²]; None if not recorded
    warnings: tuple[Note, ...]
    tested_on: TestedOn  #: what the held-out motion is
    in_sample: bool = False  #: whether nothing is held out; `held_out` is `training` then


def cell_of(archive: Archive) -> Cell:
    """Return the cell of an archive.

    Raises:
        ArchiveError: the archive has no cell or URDF, or one that is not UTF-8.
    """
    return Cell.from_texts(archive.text("cell.toml"), archive.text("robot.urdf"), archive.path)


GRAVITY: Final = "gravity of [robot]"
"""Difference of cells of one arm that is mounted otherwise, or whose torque has no weight."""


def arm_differences(cell: Cell, other: Cell) -> list[str]:
    """Return the parts in which two cells describe different arms; `GRAVITY` if only that.

    Payloads and how well torques are known aside.
    """
    unstated = {"torque_uncertainty": None}
    parts = (
        {
            "robot.urdf": cell.urdf,
            "[robot]": cell.without_payload().file.robot.model_copy(update=unstated),
            "[drive_train]": cell.file.drive_train
            and cell.file.drive_train.model_copy(update=unstated),
        }
        for cell in (cell, other)
    )
    first, second = parts
    differing = [name for name in first if first[name] != second[name]]
    gravity = other.file.robot.gravity
    if differing == ["[robot]"] and gravity != cell.file.robot.gravity:
        robot = cell.file.robot.model_copy(update={"gravity": gravity})
        turned = replace(cell, file=cell.file.model_copy(update={"robot": robot}))
        return arm_differences(turned, other) or [GRAVITY]
    return differing


def gather_sources(
    given: Sequence[Path | Archive],
    split: float,
    predict: Sequence[Path | Archive] = (),
    *,
    in_sample: bool = False,
    with_torque: bool = True,
) -> Sources:
    """Open archives that are not in memory, and sort all into fitted and held-out recordings.

    Excitations are fitted, validation runs are held out; imported recordings state their use.

    Args:
        given: archives.
        split: part of a single recording that is held out where nothing else is (`Options.split`);
            of several recordings it is the last.
        predict: archives that are held out.
        in_sample: hold nothing out.
        with_torque: whether recordings must have it.

    Raises:
        InputError: there is nothing to fit, an archive is given twice, or `predict` is given with
            `in_sample`.
        ArchiveError: an archive cannot be read or used, or belongs to another cell.
    """
    if in_sample and predict:
        raise InputError(
            place_of(predict[0]),
            "cannot be held out if everything is fitted",
            remedy="omit --fit-all",
        )
    refuse_duplicates([*given, *predict])
    archives = [opened(archive) for archive in [*given, *predict]]
    by_use = _by_use(archives, len(given))
    fitted = by_use["excitation"]
    predicted = by_use["validation"]
    if in_sample:
        fitted = [*fitted, *predicted]
        predicted = []
    if not fitted:
        raise InputError(
            place_of(given[0]) if given else None,
            "the archives contain no excitation and no imported recording"
            + (" that was not rejected" if by_use[REJECTED] else ""),
            remedy="give archives of kind excitation or imported",
        )
    cell = cell_of(fitted[0])
    _require_one_cell(archives)
    standstills = [
        source_of(archive, cell, to_fit=False).recording for archive in by_use["standstill"]
    ]
    sources = [(archive, source_of(archive, cell, to_fit=with_torque)) for archive in fitted]
    every = all_fitted(cell, sources, standstills[0] if standstills else None)
    held_out = tuple(source_of(archive, cell, to_fit=with_torque) for archive in predicted)
    warnings = (
        *known_warnings(cell, fitted[0]),
        *filter(None, map(_incomplete, archives)),
        *_import_warnings(archives),
        *filter(None, map(_not_judged, [*fitted, *predicted])),
    )
    every = replace(every, warnings=warnings)
    return every if in_sample else _with_held_out(every, held_out, split)


def _by_use(archives: Sequence[Archive], given: int) -> defaultdict[str, list[Archive]]:
    """Sort archives by purpose; archives beyond the first `given` are to be predicted."""
    by_use: defaultdict[str, list[Archive]] = defaultdict(list)
    for k, archive in enumerate(archives):
        use = archive.header.purpose if k < given else "validation"
        rejected = archive.outcome is not None and archive.outcome.outcome == REJECTED
        by_use[REJECTED if rejected else use].append(archive)
    return by_use


def _require_one_cell(archives: Sequence[Archive]) -> None:
    """Raise ArchiveError if an archive has another cell or URDF than the first."""
    for archive in archives[1:]:
        for name in ("robot.urdf", "cell.toml"):
            if archive.attachments.get(name) != archives[0].attachments.get(name):
                problem = f"has another {name} than {archives[0].path}"
                remedy = "identify the archives of each cell separately"
                raise ArchiveError(archive.path, problem, remedy=remedy)


def _import_warnings(archives: Sequence[Archive]) -> Iterator[Note]:
    for archive in archives:
        for warning in archive.header.findings.warnings:
            yield StatedText(warning, archive.path.name)


def _with_held_out(every: Sources, held_out: tuple[Source, ...], split: float) -> Sources:
    """Return sources with these held out; if there are none, a share or the last of the fitted."""
    training = every.training
    tested_on = TestedOn.UNSEEN
    warnings = [*every.warnings]
    if not held_out and len(training) == 1:
        tested_on = TestedOn.REST
        training, held_out = _split(training[0], split)
        warnings.append(RestPredicted(split))
    elif not held_out:
        tested_on = TestedOn.REPETITION if every.same_motion else TestedOn.ANOTHER_RECORDING
        training, held_out = training[:-1], training[-1:]
        warnings.append(LastHeldOut(held_out[0].name))
    return replace(
        every,
        training=training,
        held_out=held_out,
        warnings=tuple(warnings),
        tested_on=tested_on,
        in_sample=False,
    )


def all_fitted(
    cell: Cell, fitted: Sequence[tuple[Archive, Source]], standstill: Recording | None
) -> Sources:
    """Return sources without held-out recordings; `standstill` is a recording at standstill.

    Raises:
        ArchiveError: the plan in the first archive is not valid.
    """
    archives, fitted_sources = zip(*fitted, strict=True)
    training = tuple(fitted_sources)
    plan = None
    same_motion = False
    if "plan.json" in archives[0].attachments:
        plan = archives[0].table("plan.json")
        same_motion = len({archive.attachments.get("plan.json") for archive in archives}) == 1
    else:
        training, same_motion = aligned(training)
    noise = torque = None
    if standstill is not None:
        noise = position_noise(cell, standstill)
        torque = (
            None
            if standstill.torque is None
            else standstill_variance(standstill.time, standstill.torque)
        )
    return Sources(
        cell=cell,
        header=archives[0].header,
        plan=plan,
        training=training,
        same_motion=same_motion,
        held_out=training,
        noise_variance=noise,
        torque_variance=torque,
        warnings=(),
        tested_on=TestedOn.FITTED,
        in_sample=True,
    )


def aligned(sources: tuple[Source, ...]) -> tuple[tuple[Source, ...], bool]:
    """Return imported recordings with a common origin, and whether they show one motion."""
    offsets = offsets_of_repetitions([source.recording for source in sources])
    if offsets is None:
        return sources, False
    both = list(zip(sources, offsets, strict=True))
    latest = max(source.recording.time[0] - offset for source, offset in both)
    return tuple(replace(source, origin=float(latest + offset)) for source, offset in both), True


def has_commands_as_positions(recording: Recording) -> bool:
    """Return whether the positions of a recording are commands, bit for bit."""
    if COPIED_COMMANDS in recording.provenance:
        return True
    commands = recording.commanded_position
    if commands is None or not np.ptp(recording.position, axis=0).any():
        return False
    return bool(np.array_equal(commands, recording.position))


def archives_in(paths: Sequence[Path]) -> Iterator[Path]:
    """Yield files, and the archives of folders (of campaigns: the complete ones).

    Raises:
        InputError: a folder has none.
    """
    for path in paths:
        if not path.is_dir():
            yield path
            continue
        folder = RecordedCampaign(path)
        if path_exists(path / "manifest.json"):
            kinds = ("excitation", "validation", "standstill")
            inside = [archive for kind in kinds for archive in folder.completed(kind)]
        else:
            inside = sorted(path.glob("*.mcap"))
        if not inside:
            remedy = "give archives (*.mcap) or the folder of a campaign that was run"
            raise InputError(path, "contains no complete archive", remedy=remedy)
        yield from inside


def refuse_duplicates(archives: Sequence[Path | Archive]) -> None:
    """Raise InputError if two are equal: fitted recordings must not be held out as well.

    Files with the same bytes, or imports of these and of the same episode in them.
    """
    seen: dict[str, str] = {}
    for archive in archives:
        path = place_of(archive)
        name = str(path)
        try:
            if isinstance(archive, Archive):
                entries = archive.header.entries
                digest = entries["source_sha256"] + entries.get(EPISODE, "")
                name = ", ".join(json.loads(entries["source"]))
            else:
                digest = file_digest(archive)
        except OSError:
            continue  # reported when it is opened
        if digest in seen:
            is_same = name == seen[digest]
            fault = "was given twice" if is_same else f"is a copy of {seen[digest]}"
            raise InputError(
                path, fault, remedy="give it once" if is_same else "give only one of them"
            )
        seen[digest] = name


def _incomplete(archive: Archive) -> Note | None:
    """Return the warning about an archive that did not end as planned."""
    name = archive.path.name
    outcome = archive.outcome
    if archive.missing is not None:
        return StatedText(archive.missing)
    if outcome is None or outcome.outcome == "completed":
        return None
    if outcome.outcome == REJECTED:
        return RejectedArchive(name, outcome.reason)
    return EndedEarly(name, outcome.outcome)


def _not_judged(archive: Archive) -> Note | None:
    """Return the warning about an archive that is not in its campaign's manifest."""
    path = archive.path
    folder = RecordedCampaign(path.parent.parent)
    if path.parent.name != folder.archives.name or ArchiveName.parse(path) is None:
        return None
    with suppress(CampaignFolderError):
        if folder.sealed and path.name not in {entry.name for entry in folder.manifest()}:
            return NotJudged(path.name)
    return None


def known_warnings(cell: Cell, archive: Archive) -> list[Note]:
    """Return the warnings about known systematic errors."""
    assumed = "drive_train.torque_constant" in cell.file.cell.assumed
    if not assumed or archive.header.only_simulated:
        return []
    controller = cell.file.controller
    is_ur = controller is not None and controller.transport == "rtde"
    return [AssumedTorqueConstants(can_be_weighed=is_ur)]


def payload_warnings(cell: Cell) -> list[Note]:
    """Return the warning about a payload that was not weighed before it was recorded."""
    return [AssumedPayload()] if "robot.payload" in cell.file.cell.assumed else []


def source_of(archive: Archive, cell: Cell, *, to_fit: bool = True) -> Source:
    """Return the usable part of an archive's recording.

    Raises:
        ArchiveError: the recording cannot be used for identification.
    """
    recording = recording_of(archive)
    if to_fit and recording.torque is None and recording.motor_current is None:
        problem = "contains neither joint torques nor motor currents"
        remedy = "import torques, or motor currents with gear ratios and torque constants"
        if recording.commanded_position is not None:
            remedy += "; `hil identify` finds servo and friction from positions alone"
        raise ArchiveError(archive.path, problem, remedy=remedy)
    if to_fit and recording.provenance.get(TORQUE_SIDE) == UNDECIDED:
        problem = "comes from a log whose torque is too small for the joints of this arm"
        remedy = (
            f"choose what it is by `hil look {typed(archive.path.name)}`, and import the log again"
            " with that line in its map; a map without it reads it as joint torque"
        )
        raise ArchiveError(archive.path, problem, field="side", remedy=remedy)
    return _usable(archive, cell, recording)


def stamps_of(source: Source, cell: Cell) -> NDArray[np.int64]:
    """Return the time stamps in the archive of the samples of a source (m,) [ns].

    Raises:
        ArchiveError: the archive cannot be read again.
    """
    archive = open_archive(source.path)
    recording = recording_of(archive)
    rows = np.arange(recording.n_samples, dtype=np.float64)[:, None]
    numbered = replace(recording, motor_current=np.repeat(rows, recording.n_joints, axis=1))
    whole = _usable(archive, cell, numbered).recording.motor_current
    assert whole is not None
    first = 0 if source.context is None else source.context[1]
    own = whole[first : first + source.recording.n_samples, 0]
    stamps: NDArray[np.int64] = archive.columns["stamp"][np.rint(own).astype(np.intp)]
    return stamps


def _usable(archive: Archive, cell: Cell, recording: Recording) -> Source:
    useful = useful_part(archive, recording)
    if useful is not None:
        recording = recording.between(useful.start, useful.stop)
    units = dict(zip(cell.joint_names, cell.model.chain.position_units, strict=True))
    if all(name in units for name in recording.joint_names):
        recording = replace(
            recording, joint_units=tuple(units[name] for name in recording.joint_names)
        )
    timed = recording
    times = stamps = None
    faults: tuple[RowFault, ...] = ()
    try:
        if archive.kind == "imported":  # other archives have the cycle counter of the controller
            recording.check_finite()
            timed, times, faults, stamps = _true_rows(recording)
            timed = cut_at_pauses(timed)
        single = without_repeats(timed).checked(cell.joint_names)
    except RecordingError as error:
        raise ArchiveError(archive.path, str(error), remedy="leave it out") from error
    return Source(
        archive.path,
        archive.path.name,
        single,
        float(single.time[0]),
        timed.n_samples - single.n_samples,
        times,
        faults,
        stamps,
    )


def _true_rows(
    recording: Recording,
) -> tuple[Recording, SampleTimes, tuple[RowFault, ...], Array]:
    """Return the rows of one motion at their times, how these were decided, faults and stamps.

    By stamps that are not the times of the samples, rows may seem displaced that are not.
    """
    sound, faults = without_faulty_rows(recording)
    timed, times = true_times(sound)
    if times.even and any(fault.kind is RowFaultKind.DISPLACED for fault in faults):
        even, even_times = true_times(recording)
        if even_times.even and not even_times.removed:
            again, remaining = without_faulty_rows(even)
            if len(remaining) < len(faults):
                rows = np.isin(even.time, again.time)
                return again, even_times, remaining, recording.time[rows]
    return timed, times, faults, sound.time


def useful_part(archive: Archive, recording: Recording) -> range | None:
    """Return the range of usable samples; None for all of an imported recording.

    These are the samples with a commanded position, or, for motions of the controller's own
    program, those with the drive on (otherwise the brakes carry the arm).
    """
    if archive.header.by_controller_program and "status" in archive.columns:
        usable = archive.columns["status"] == DRIVE_ON
        problem = "the drive is never on"
    elif recording.commanded_position is not None and archive.kind != "imported":
        usable = ~np.isnan(recording.commanded_position).any(axis=1)
        problem = "it has no commanded position"
    else:
        return None
    rows = np.flatnonzero(usable)
    if not rows.size:
        raise ArchiveError(archive.path, problem)
    return range(int(rows[0]), int(rows[-1]) + 1)


def _split(whole: Source, share: float) -> tuple[tuple[Source, ...], tuple[Source, ...]]:
    """Split a recording in two parts, each with the complete motion as context.

    The first has no torque of the last in it, so that no filter of torques can bring it there.
    """
    recording = whole.recording
    count = recording.n_samples
    cut = round(share * count)
    before_cut = (np.arange(count) < cut)[:, None]
    torque, current = (
        None if values is None else np.where(before_cut, values, 0.0)
        for values in (recording.torque, recording.motor_current)
    )
    context = replace(recording, torque=torque, motor_current=current)

    def part(part_name: str, context: Recording, start: int, stop: int) -> Source:
        return replace(
            whole,
            name=f"{whole.name} ({part_name})",
            recording=recording.between(start, stop),
            origin=float(recording.time[min(start, count - 1)]),
            context=(context, start),
        )

    first = part("first part", context, 0, cut)
    return (first,), (part("last part", recording, cut, count),)


def position_noise(cell: Cell, standstill: Recording) -> Array:
    """Return the variance of positions at standstill (n,), at least of their resolution."""
    measured = standstill_variance(standstill.time, standstill.position)
    if cell.file.drive_train is None:
        # Smallest difference between two positions of a joint, 0 if all are equal.
        steps = [
            np.diff(np.unique(channel)).min(initial=np.inf) for channel in standstill.position.T
        ]
        least = np.where(np.isfinite(steps), steps, 0.0)
        return np.asarray(np.maximum(measured, least**2 / 12.0))
    drives = cell.drive_train
    count = 1.0 / cell.drive_table.encoder_counts_per_revolution
    rounding = (
        2.0 * FLOAT32_STEP * np.abs(drives.motor_revolutions(standstill.position)).max(axis=0)
    )
    joint_step = np.abs(drives.joint_from_motor) * (2.0 * np.pi * np.maximum(count, rounding))
    resolution = (joint_step**2).sum(axis=1) / 12.0
    return np.asarray(np.maximum(measured, resolution))
