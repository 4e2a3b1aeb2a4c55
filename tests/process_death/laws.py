"""Laws after the death of a process, checked by the controller's account and the files left.

Those of `tests.laws` for archives, manifest, motions and errors; the others are of processes.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from drivers.exchange.event_log import NO_ARCHIVE
from drivers.states import State
from hil.archive import Archive, ArchiveName, ArchiveOutcome, open_archive
from hil.base.errors import ArchiveError
from hil.campaign import Campaign
from sim_fixtures import Phase
from tests.laws.archives import as_exchanged, in_one_archive
from tests.laws.arm import IN_OPEN_MODE, closed, stands
from tests.laws.errors import names_one
from tests.laws.evidence import ArchiveFile, Evidence, entries_of
from tests.laws.motions import on_path
from tests.laws.second_reader import read
from tests.process_death.page import REST, STILL, at_rest
from tests.process_death.rig import Death, Seen

Records = NDArray[np.void]

PROMISED: Final = 52
"""Cycles that a dead archive process may cost beyond its backlog: a chunk of 100 ms, and one or two
that come while it is written."""
COMPARED: Final = ("number", "position", "target_current", "commanded_position", "state", "gap")
GONE: Final = ("ended", "is gone", "cannot be started")
NAMED: Final = {
    "exchange": tuple(f"the exchange process {what}" for what in GONE),
    "archive": (
        *(f"the archive process {what}" for what in (*GONE, "sent no heartbeat")),
        NO_ARCHIVE,  # of the exchange, where the supervisor is late to notice
        "cannot be written any more",
    ),
    "controller": ("controller", "link", "silent", "nothing received", "no packet", "packet"),
}
"""Words, one of which is in the error of a surviving supervisor, by the process that died."""


@dataclass(frozen=True, eq=False)
class Recorded:
    """One archive, as far as it can be read."""

    path: Path
    name: ArchiveName
    archive: Archive
    cycles: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Processes:
    """One run of real processes.

    Attributes:
        seen: from outside.
        campaign: that was run.
        recorded: its archives of this run.
        others: names of files among the archives that are none.
        undisturbed: no fault struck, so that the run completes.
    """

    seen: Seen
    campaign: Campaign
    recorded: tuple[Recorded, ...]
    others: tuple[str, ...] = ()
    undisturbed: bool = False


def evidence_of(
    seen: Seen,
    campaign: Campaign,
    earlier: frozenset[str] = frozenset(),
    *,
    undisturbed: bool = False,
) -> Evidence:
    """Return what a run left behind; archives in `earlier` are not those of this run."""
    recorded: list[Recorded] = []
    others: list[str] = []
    unreadable: list[str] = []
    for path in sorted(campaign.folder.archives.iterdir()):
        if path.name in earlier:
            continue
        name = ArchiveName.parse(path)
        if name is None:
            others.append(path.name)
            continue
        try:
            archive = open_archive(path)
        except ArchiveError as error:
            if not _died_writing(path, seen):
                unreadable.append(f"{path.name} cannot be read: {error}")
            continue
        cycles = archive.columns.get("cycle", np.zeros(0))
        recorded.append(Recorded(path, name, archive, np.asarray(cycles, np.int64)))
    return Evidence(
        period=campaign.cell.period,
        files=tuple(file_of(recording, seen) for recording in recorded),
        unreadable=tuple(unreadable),
        folder=campaign.folder.root,
        manifests=(tuple(seen.entered), entries_of(campaign.folder.root)),
        processes=Processes(seen, campaign, tuple(recorded), tuple(others), undisturbed),
    )


def file_of(recording: Recorded, seen: Seen) -> ArchiveFile:
    """Return an archive for the laws of all runs; the newest one may be truncated by a kill."""
    archive = recording.archive
    lost = 0 if archive.outcome is None else archive.outcome.records_lost
    return ArchiveFile(
        read(recording.path),
        archive.complete,
        archive.missing or "",
        _died_writing(recording.path, seen),
        lost or 0,
    )


def supervisor(processes: Processes) -> Iterator[str]:
    """A surviving supervisor names the process that died, in an error of the project."""
    seen = processes.seen
    if processes.undisturbed and seen.status != 0:
        yield f"the next run failed with status {seen.status}: {seen.report}"
    if seen.status is None:
        return
    if seen.status not in (0, 2, 4) or not seen.report:
        yield f"the supervisor ended with status {seen.status} and reported {seen.report}"
    text = seen.report.get("text", "")
    if seen.deaths and text:
        names = [name for victim in seen.killed for name in NAMED.get(victim, ())]
        yield from names_one(f"{' and '.join(seen.killed)} died", text, names)


def arm(processes: Processes) -> Iterator[str]:
    """The controller missed and rejected nothing, and the arm is at rest at the end."""
    seen = processes.seen
    rows = seen.rows
    if not len(rows):
        return
    if rows["rejected"][-1]:
        yield f"the controller rejected {rows['rejected'][-1]} answers"
    short = len(rows) < REST
    if "controller" not in seen.killed and not at_rest(rows):
        phases = rows["phase"][-REST:]
        is_open = not short and bool(np.isin(phases, (*IN_OPEN_MODE, Phase.TRIPPED)).any())
        yield from closed(Phase(phases[-1]).name, any_open=is_open, when="at the end")
        yield from stands(rows["velocity"][-REST:], STILL, "at the end")
    answered = rows[~rows["deserted"]]
    # The packet of the cycle in which the exchange ended is no fault.
    if not answered["replied"][:-1].all():
        count = np.count_nonzero(~answered["replied"][:-1])
        yield f"{count} packets were not answered while the exchange lived"
    if np.isin(answered["phase"], (Phase.TRIPPED,)).any():
        yield "the drive was lost while the exchange lived"
    if "exchange" not in seen.killed and "controller" not in seen.killed and len(answered):
        left_open = _seen_last(rows)
        when = "where the exchange ended by itself"
        yield from closed(left_open.name, any_open=left_open in IN_OPEN_MODE, when=when)
        yield from stands(answered["velocity"][-1], STILL, when)


def _seen_last(rows: Records) -> Phase:
    """Return the phase in the last packet that was replied to: that after the cycle before it."""
    last = int(np.flatnonzero(rows["replied"])[-1]) if rows["replied"].any() else 0
    return Phase(rows["phase"][last - 1]) if last else Phase.START


def link(processes: Processes) -> Iterator[str]:
    """The records of the exchange contain each packet that the controller had replied to, once."""
    seen = processes.seen
    rows = seen.rows
    records = seen.records
    if not len(records):
        return
    if (np.diff(records["cycle"]) != 1).any() or records["gap"].any():
        yield "packets are missing in the exchange's records"
    cyclic = rows[(rows["phase"] > Phase.DRIVE_OFF) & rows["replied"]]
    missing = np.setdiff1d(cyclic["number"], records["number"])
    if missing.size:
        yield f"{missing.size} answered packets are not in the exchange's records"
    if "exchange" in seen.killed or "controller" in seen.killed:
        return
    commanded = records["commanded_velocity"]
    sent = commanded[~np.isnan(commanded).any(axis=1)]
    if len(sent) and np.abs(sent[-1]).max() > 0.0:
        yield f"the last set-point has a speed of {np.abs(sent[-1]).max():.3g} rad/s"
    if records["state"][-1] in (State.OPENING, State.OPEN, State.EXITING, State.FAULTED):
        yield f"the session ended in {State(records['state'][-1]).name}"


def _is_newest(path: Path) -> bool:
    return path == max(path.parent.iterdir(), key=lambda sibling: sibling.stat().st_mtime_ns)


def _died_writing(path: Path, seen: Seen) -> bool:
    """Return whether a file may be truncated: the archive process was killed at it."""
    return "archive" in seen.killed and _is_newest(path)


def left_over(processes: Processes) -> Iterator[str]:
    """No process, open port or foreign file is left."""
    if processes.seen.left:
        yield f"processes are left over: {processes.seen.left}"
    if processes.seen.port_in_use:
        yield "the port is still in use"
    for name in processes.others:
        yield f"{name} lies among the archives"


def exchanged(processes: Processes) -> Iterator[str]:
    """Archives contain what was exchanged."""
    for recording in processes.recorded:
        for text in _as_exchanged(recording, processes.seen.records):
            yield f"{recording.path.name}: {text}"


def outcomes(processes: Processes) -> Iterator[str]:
    """Archives have the outcomes of their motions."""
    for recording in processes.recorded:
        for text in _outcome(recording, processes.seen):
            yield f"{recording.path.name}: {text}"


def _as_exchanged(recording: Recorded, records: Records) -> Iterator[str]:
    """An archive contains what was exchanged."""
    if not recording.cycles.size:
        return
    rows = _rows_of(recording, records)
    if rows is None:
        yield "holds cycles that were never exchanged"
        return
    yield from as_exchanged(recording.archive.columns, rows, COMPARED)


def _outcome(recording: Recorded, seen: Seen) -> Iterator[str]:
    """A completed archive has the outcome of its motion."""
    if recording.archive.outcome is None:
        return
    outcome = recording.archive.outcome.entries["outcome"]
    if outcome not in ("completed", "stopped", "void", "lost", "refused"):
        yield f"its outcome is {outcome}"
    alone = "exchange" not in seen.killed and "controller" not in seen.killed
    if outcome == "lost" and alone:
        yield "is marked lost, and neither end of the link had died"
    if outcome == "void" and recording.cycles.size and _moving(recording.archive.columns).any():
        yield "is marked void, and holds motion"


def _moving(columns: Mapping[str, NDArray[Any]] | Records) -> NDArray[np.bool_]:
    """Cycles in which a set-point with a speed was sent."""
    commanded = np.asarray(columns["commanded_velocity"])
    moving: NDArray[np.bool_] = np.nan_to_num(np.abs(commanded)).max(axis=1) > 0.0
    return moving


def _rows_of(recording: Recorded, records: Records) -> Records | None:
    """The exchange's records of the cycles of an archive."""
    if not len(records):
        return None
    first = int(recording.cycles[0] - records["cycle"][0])
    rows = records[max(first, 0) : first + recording.cycles.size]
    return rows if len(rows) == recording.cycles.size else None


def archived(processes: Processes) -> Iterator[str]:
    """Every cycle of motion is archived once, except what a dead archive process may cost."""
    yield from in_one_archive(recording.cycles.tolist() for recording in processes.recorded)
    death = _death_of_archive(processes.seen)
    missing = _missing(processes)
    if death is None:
        if missing.size:
            yield f"{missing.size} cycles of motion are in no archive"
        return
    lost = lost_cycles(processes)
    # Records that the system gave it no time to read are not its loss.
    if lost > PROMISED + death.behind:
        yield f"{lost} cycles of motion were lost with the archive process"


def lost_cycles(processes: Processes) -> int:
    """Return how many cycles of motion were lost with the archive process; 0 if it lived."""
    death = _death_of_archive(processes.seen)
    if death is None:
        return 0
    first = processes.seen.records["cycle"][:1].sum()
    return int(np.count_nonzero(_missing(processes) < first + death.written))


def torn(processes: Processes) -> bool:
    """Return whether the death of the archive process left an incomplete archive."""
    return _death_of_archive(processes.seen) is not None and any(
        not recording.archive.complete for recording in processes.recorded
    )


def _death_of_archive(seen: Seen) -> Death | None:
    return next((death for death in seen.deaths if death.victim == "archive"), None)


def _missing(processes: Processes) -> NDArray[np.int64]:
    """Return the cycles of motion that are in no archive."""
    records = processes.seen.records
    if not len(records):
        return np.zeros(0, np.int64)
    cycles = [recording.cycles for recording in processes.recorded]
    moving = records["cycle"][_moving(records)]
    missing: NDArray[np.int64] = np.setdiff1d(moving, np.concatenate([np.zeros(0, int), *cycles]))
    return missing


def motions(processes: Processes) -> Iterator[str]:
    """Every set-point of a repetition or validation motion lies on its planned path."""
    seen = processes.seen
    campaign = processes.campaign
    for recording in processes.recorded:
        plan = campaign.plan
        match recording.name.kind:
            case "excitation":
                motion: Any = plan.excitation.trajectory
            case "validation":
                motion = plan.validation[recording.name.index].trajectory
            case _:
                continue
        rows = _rows_of(recording, seen.records) if recording.cycles.size else None
        if rows is None:
            continue
        # An archive that is closed late may hold the begin of the next interval as well.
        began = [event.time for event in recording.archive.events if event.name == "MotionStarted"]
        cycles = rows["cycle"] * campaign.cell.period
        last = int(rows["interval"].argmax())
        first = int(np.searchsorted(cycles, began[-1] - 1e-6)) if began else last
        interval = int(rows["interval"][min(first, len(rows) - 1)])
        if interval < 0:
            continue
        every = seen.records[seen.records["interval"] == interval]
        commanded = every["commanded_position"]
        commanded = commanded[~np.isnan(commanded).any(axis=1)]
        if not len(commanded):
            continue
        for text in on_path(commanded, motion):
            yield f"{recording.path.name}: {text}"
        ends = motion.sample(np.array([0.0, motion.duration]))[0]
        short = np.abs(commanded[-1] - commanded[0] - (ends[1] - ends[0])).max() > 1e-6
        if short and (recording.archive.outcome or ArchiveOutcome()).outcome == "completed":
            yield f"{recording.path.name} is marked completed, and its motion was not"


LAWS: Final = {
    "a supervisor names the process that died": supervisor,
    "the controller sees an arm that comes to rest": arm,
    "the exchange records what it answered": link,
    "nothing is left over": left_over,
    "archives hold what was exchanged": exchanged,
    "archives have the outcome of their motion": outcomes,
    "motion is archived once": archived,
    "set-points are on the path": motions,
}
"""By name, of real processes (`tests.laws.table`)."""
