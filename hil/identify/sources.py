"""Archives as identification needs them: whose they are, what is fitted, what is predicted."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.packets import DRIVE_ON
from hil.archive import Archive, ArchiveHeader, ArchiveName, open_archive
from hil.archive.header import REJECTED
from hil.campaign.errors import CampaignFolderError
from hil.campaign.folder import CampaignFolder
from hil.cell import Cell
from hil.errors import ArchiveError, InputError
from hil.files import file_digest
from hil.reading import path_exists
from hil.recordings import recording_of
from identification.signals.clock import true_times
from identification.signals.noise import standstill_variance
from identification.signals.recording import (
    Recording,
    RecordingError,
    offsets_of_repetitions,
    without_repeats,
)

Array = NDArray[np.float64]

FLOAT32_STEP = 2.0**-24
"""Relative rounding step of a position on the wire, as a share of its size."""


@dataclass(frozen=True, eq=False)
class Source:
    """One archive: its recording and where the planned motion begins in it."""

    path: Path  #: of the archive
    name: str  #: file name
    recording: Recording  #: joints in the order of the model
    origin: float  #: time of the first set-point [s]
    merged: str = ""  #: what was done about repeated time stamps, in words; nothing for none
    clock: tuple[str, ...] = ()  #: what was decided about its time stamps, in sentences
    retimed: bool = False  #: whether other times than the stamps were used
    #: the motion of a longer recording that this is a part of, and where it begins in it, so that
    #: filters know what lies beyond its ends. Its torques are zero outside.
    context: tuple[Recording, int] | None = None

    def changed(self, change: Callable[[Recording], Recording]) -> Source:
        """The source with its recording, and the context of it, changed alike row by row."""
        context = self.context
        return replace(
            self,
            recording=change(self.recording),
            context=None if context is None else (change(context[0]), context[1]),
        )


@dataclass(frozen=True, eq=False)
class Sources:
    """All archives of one identification."""

    cell: Cell  #: from the attachments of the first archive
    header: ArchiveHeader  #: of the first archive
    plan: dict[str, Any] | None  #: of the first archive; None where none was attached
    training: tuple[Source, ...]  #: what is fitted
    same_motion: bool  #: whether these are repetitions of one motion
    held_out: tuple[Source, ...]  #: what is predicted and never fitted
    #: of the positions (n,) [rad²]; None where no standstill was recorded
    noise_variance: Array | None
    torque_variance: Array | None  #: of the torques at standstill (n,) [N²·m²]; None likewise
    warnings: tuple[str, ...]  #: what a reader must know about the archives
    tested_on: str  #: what is predicted, in words
    in_sample: bool = False  #: whether nothing was held out: `held_out` is `training` then

    def with_warning(self, warning: str) -> Sources:
        """These sources with one more thing a reader must know."""
        return replace(self, warnings=(*self.warnings, warning))


def cell_of(archive: Archive) -> Cell:
    """The cell that travels inside an archive.

    Raises:
        ArchiveError: the archive carries no cell or no URDF, or one that is not UTF-8.
    """
    return Cell.from_texts(archive.text("cell.toml"), archive.text("robot.urdf"), archive.path)


def apart(one: Cell, other: Cell) -> list[str]:
    """What two cells describe differently of the arm; what it carries may differ."""
    parts = (
        {"robot.urdf": cell.urdf, "[robot]": cell.without_payload().file.robot}
        | {"[drive_train]": cell.file.drive_train}
        for cell in (one, other)
    )
    mine, theirs = parts
    return [name for name in mine if mine[name] != theirs[name]]


def gather_sources(
    paths: Sequence[Path], split: float, predict: Sequence[Path] = (), *, in_sample: bool = False
) -> Sources:
    """Open archives and sort them into what is fitted and what is predicted.

    Excitations are fitted and validation runs predicted; imported recordings are what they were
    declared; those of `predict` are predicted in any case. Where there is nothing to predict, the
    last part of a single recording (see `Options.split`), or the last of several, is held out;
    `in_sample` fits whatever moves.

    Raises:
        InputError: there is nothing to fit, an archive is named twice, or something is to be
            predicted and all of it to be fitted.
        ArchiveError: an archive cannot be read, is not fit, or belongs to another cell.
    """
    if in_sample and predict:
        raise InputError(
            predict[0], "cannot be held out where all is fitted", remedy="leave out --in-sample"
        )
    refuse_duplicates([*paths, *predict])
    archives = [open_archive(path) for path in [*paths, *predict]]
    by_use: defaultdict[str, list[Archive]] = defaultdict(list)
    for k, archive in enumerate(archives):
        use = archive.header.serves_as if k < len(paths) else "validation"
        rejected = archive.outcome is not None and archive.outcome.outcome == REJECTED
        by_use[REJECTED if rejected else use].append(archive)
    fitted, predicted = by_use["excitation"], by_use["validation"]
    if in_sample:
        fitted, predicted = [*fitted, *predicted], []
    if not fitted:
        raise InputError(
            paths[0] if paths else None,
            "there is no excitation and no imported recording among the archives"
            + (" but rejected ones" if by_use[REJECTED] else ""),
            remedy="name archives of kind excitation or imported",
        )
    cell = cell_of(fitted[0])
    for archive in archives[1:]:
        for name in ("robot.urdf", "cell.toml"):
            if archive.attachments.get(name) != archives[0].attachments.get(name):
                problem = f"carries another {name} than {archives[0].path}"
                remedy = "identify each cell's archives by themselves"
                raise ArchiveError(archive.path, problem, remedy=remedy)
    rest = [source_of(archive, cell, to_fit=False).recording for archive in by_use["standstill"]]
    own = [(archive, source_of(archive, cell)) for archive in fitted]
    every = all_fitted(cell, own, rest[0] if rest else None)
    held_out = [source_of(archive, cell) for archive in predicted]
    warnings = [*known_warnings(cell, fitted[0]), *filter(None, map(_incomplete, archives))]
    warnings += [
        f"{archive.path.name}: {warning}"
        for archive in archives
        for warning in archive.header.findings.warnings
    ]
    warnings += filter(None, map(_not_judged, [*fitted, *predicted]))
    if in_sample:
        return replace(every, warnings=tuple(warnings))
    training, tested_on = every.training, "unseen motion"
    if not held_out and len(training) == 1:
        tested_on = "the rest of the same motion"
        training, held_out = _split(training[0], split)
        warnings.append(
            f"a temporal split: the first {split:.0%} of one recording were fitted, the rest of the"
            " same motion was predicted; other motions would be a harder test"
        )
    elif not held_out:
        repeated = every.same_motion
        tested_on = "a repetition of the fitted motion" if repeated else "another recording"
        training, held_out = training[:-1], [training[-1]]
        warnings.append(
            f"no validation run: the last recording, {held_out[0].name}, was held out instead"
        )
    return replace(
        every,
        training=training,
        held_out=tuple(held_out),
        warnings=tuple(warnings),
        tested_on=tested_on,
        in_sample=False,
    )


def all_fitted(
    cell: Cell, fitted: Sequence[tuple[Archive, Source]], rest: Recording | None
) -> Sources:
    """Sources of which nothing is held out, with the noise of a recording at standstill.

    Raises:
        ArchiveError: the plan in the first archive is none.
    """
    archives, found = zip(*fitted, strict=True)
    training, plan, same_motion = tuple(found), None, False
    if "plan.json" in archives[0].attachments:
        plan = archives[0].table("plan.json")
        same_motion = len({archive.attachments.get("plan.json") for archive in archives}) == 1
    else:
        training, same_motion = aligned(training)
    noise = torque = None
    if rest is not None:
        noise = position_noise(cell, rest)
        torque = None if rest.torque is None else standstill_variance(rest.time, rest.torque)
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
        tested_on="the motion that was fitted",
        in_sample=True,
    )


def aligned(sources: tuple[Source, ...]) -> tuple[tuple[Source, ...], bool]:
    """Imported recordings with one origin if they show one motion, and whether they do."""
    offsets = offsets_of_repetitions([source.recording for source in sources])
    if offsets is None:
        return sources, False
    both = list(zip(sources, offsets, strict=True))
    latest = max(source.recording.time[0] - offset for source, offset in both)
    return tuple(replace(one, origin=float(latest + offset)) for one, offset in both), True


def archives_in(paths: Sequence[Path]) -> Iterator[Path]:
    """Archives, and those of folders, of campaigns the whole ones.

    Raises:
        InputError: a folder has none.
    """
    for path in paths:
        if not path.is_dir():
            yield path
            continue
        folder = CampaignFolder(path)
        if path_exists(path / "manifest.json"):
            kinds = ("excitation", "validation", "standstill")
            inside = [archive for kind in kinds for archive in folder.completed(kind)]
        else:
            inside = sorted(path.glob("*.mcap"))
        if not inside:
            remedy = "name archives (*.mcap) or the folder of a campaign that was run"
            raise InputError(path, "holds no whole archive", remedy=remedy)
        yield from inside


def refuse_duplicates(paths: Sequence[Path]) -> None:
    """What is fitted must not be predicted as well."""
    seen: dict[str, Path] = {}
    for path in paths:
        try:
            digest = file_digest(path)
        except OSError:
            continue  # opening it will say so
        if digest in seen:
            raise InputError(path, f"holds the same as {seen[digest]}", remedy="name it once")
        seen[digest] = path


def _incomplete(archive: Archive) -> str | None:
    """What a reader must know about an archive that did not end as planned."""
    name, outcome = archive.path.name, archive.outcome
    if archive.missing is not None or outcome is None or outcome.outcome == "completed":
        return archive.missing
    if outcome.outcome == REJECTED:
        return f"{name} was rejected and left out: {outcome.reason}"
    return f"{name} ended {outcome.outcome}"


def _not_judged(archive: Archive) -> str | None:
    """What a reader must know about an archive that its campaign's manifest does not name."""
    path = archive.path
    folder = CampaignFolder(path.parent.parent)
    if path.parent.name != folder.archives.name or ArchiveName.parse(path) is None:
        return None
    with suppress(CampaignFolderError):
        if folder.sealed and path.name not in {entry.name for entry in folder.manifest()}:
            return (
                f"{path.name} is not named in its campaign's manifest.json: the run that made it "
                "was killed before it was judged"
            )
    return None


def known_warnings(cell: Cell, archive: Archive) -> list[str]:
    """What is known beforehand to stand between the numbers and the truth, in sentences."""
    assumed = "drive_train.torque_constant" in cell.file.cell.assumed
    known = {
        "the torque constants are assumed: predictions are as good as they look, but every "
        "parameter is in their units": assumed and not archive.header.only_simulated,
        "friction drift is switched on: the planted friction is that of a half-warm joint, "
        "and a short run is colder, so friction estimates differ from it": any(
            "friction drift" in effect for effect in archive.header.effects
        ),
    }
    return [words for words, true in known.items() if true]


def source_of(archive: Archive, cell: Cell, *, to_fit: bool = True) -> Source:
    """The recording of an archive, as far as it is of use.

    Raises:
        ArchiveError: the recording is not fit to be identified from; names file and reason.
    """
    recording = recording_of(archive)
    if to_fit and recording.torque is None and recording.motor_current is None:
        problem = "holds no joint torques to fit, and no motor currents"
        remedy = "import torques, or motor currents with gear ratios and torque constants"
        raise ArchiveError(archive.path, problem, remedy=remedy)
    useful = useful_part(archive, recording)
    if useful is not None:
        recording = recording.between(useful.start, useful.stop)
    try:
        single = without_repeats(recording).checked(cell.joint_names)
    except RecordingError as error:
        raise ArchiveError(archive.path, str(error), remedy="leave it out") from error
    merged, timed = recording.n_samples - single.n_samples, single
    averaged = f"{merged} samples had the time stamp of the one before and were averaged with it"
    words: tuple[str, ...] = ()
    if archive.kind == "imported":  # a controller counts its own cycles
        timed, words = true_times(single)
    return Source(
        archive.path,
        archive.path.name,
        timed,
        float(timed.time[0]),
        averaged if merged else "",
        words,
        retimed=timed is not single,
    )


def useful_part(archive: Archive, recording: Recording) -> range | None:
    """The samples that identification may look at; None for all of an imported recording.

    Where the PC moved the arm, those it commanded. Where the controller's own program did, those
    with the drive on: with it off the brakes carry the arm, and no current tells of it.
    """
    if archive.header.controllers_own and "status" in archive.columns:
        useful, never = archive.columns["status"] == DRIVE_ON, "the drive was never on in it"
    elif recording.commanded_position is not None:
        useful = ~np.isnan(recording.commanded_position).any(axis=1)
        never = "the arm was never commanded in it"
    else:
        return None
    rows = np.flatnonzero(useful)
    if not rows.size:
        raise ArchiveError(archive.path, never)
    return range(int(rows[0]), int(rows[-1]) + 1)


def _split(whole: Source, share: float) -> tuple[tuple[Source, ...], list[Source]]:
    """The first part of a recording, and the rest; each knows the motion beyond its ends."""
    recording, count = whole.recording, whole.recording.n_samples
    cut, rows = round(share * count), np.arange(count)[:, None]

    def part(words: str, start: int, stop: int) -> Source:
        torque, current = (
            None if values is None else np.where((rows >= start) & (rows < stop), values, 0.0)
            for values in (recording.torque, recording.motor_current)
        )
        context = replace(recording, torque=torque, motor_current=current)
        return replace(
            whole,
            name=f"{whole.name} ({words})",
            recording=recording.between(start, stop),
            origin=float(recording.time[min(start, count - 1)]),
            context=(context, start),
        )

    return (part("first part", 0, cut),), [part("last part", cut, count)]


def position_noise(cell: Cell, rest: Recording) -> Array:
    """Variance of the measured positions at standstill, at least that of their resolution (n,).

    An arm that rests may show the same count for seconds; rounding to a count is noise all the
    same, uniform over the step.
    """
    measured = standstill_variance(rest.time, rest.position)
    if cell.file.drive_train is None:
        # The least that two readings of a joint differ by, 0 where none do.
        steps = [np.diff(np.unique(channel)).min(initial=np.inf) for channel in rest.position.T]
        least = np.where(np.isfinite(steps), steps, 0.0)
        return np.asarray(np.maximum(measured, least**2 / 12.0))
    drives, count = cell.drive_train, 1.0 / cell.drive_table.encoder_counts_per_revolution
    rounding = 2.0 * FLOAT32_STEP * np.abs(drives.motor_revolutions(rest.position)).max(axis=0)
    joint_step = np.abs(drives.joint_from_motor) * (2.0 * np.pi * np.maximum(count, rounding))
    resolution = (joint_step**2).sum(axis=1) / 12.0
    return np.asarray(np.maximum(measured, resolution))
