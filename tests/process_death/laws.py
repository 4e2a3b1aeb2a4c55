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
from hil.campaign import Campaign
from hil.errors import ArchiveError
from sim_fixtures import Phase
from tests.laws.archives import (
    as_exchanged,
    gap_free,
    in_one_archive,
    not_truncated,
    nothing_lost,
    readable,
)
from tests.laws.arm import IN_OPEN_MODE, closed, stands
from tests.laws.errors import names_one
from tests.laws.manifests import entries_kept, manifest_of
from tests.laws.motions import on_path
from tests.laws.second_reader import read
from tests.process_death.controller import REST, STILL, at_rest
from tests.process_death.rig import Seen

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
        "cannot be written further",
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


def broken_by(
    seen: Seen, campaign: Campaign, earlier: frozenset[str] = frozenset()
) -> tuple[list[str], dict[str, int]]:
    """Return broken laws, and figures; archives in `earlier` are not checked."""
    figures: dict[str, int] = {}
    folder = campaign.folder.root
    problems = [*_supervisor(seen), *_arm(seen), *_link(seen)]
    problems += entries_kept(seen.entered, manifest_of(folder)[1])
    if seen.left:
        problems.append(f"processes are left over: {seen.left}")
    if seen.port_in_use:
        problems.append("the port is still in use")
    recorded: list[Recorded] = []
    for path in sorted(campaign.folder.archives.iterdir()):
        if path.name in earlier:
            continue
        name = ArchiveName.parse(path)
        if name is None:
            problems.append(f"{path.name} lies among the archives")
            continue
        try:
            archive = open_archive(path)
        except ArchiveError as error:
            if not ("archive" in seen.killed and _is_newest(path)):
                problems.append(f"{path.name} cannot be read: {error}")
            continue
        cycles = archive.columns.get("cycle", np.zeros(0))
        recorded.append(Recorded(path, name, archive, np.asarray(cycles, np.int64)))
    for recording in recorded:
        texts = [
            *_readable(recording, seen, campaign.cell.period),
            *_as_exchanged(recording, seen.records),
            *_outcome(recording, seen),
        ]
        problems += [f"{recording.path.name}: {text}" for text in texts]
    problems += _archived(recorded, seen, figures)
    problems += _motions(recorded, seen, campaign)
    return problems, figures


def _supervisor(seen: Seen) -> Iterator[str]:
    """A surviving supervisor names the process that died, in an error of the project."""
    if seen.status is None:
        return
    if seen.status not in (0, 2, 4) or not seen.report:
        yield f"the supervisor ended with status {seen.status} and reported {seen.report}"
    text = seen.report.get("text", "")
    if seen.deaths and text:
        names = [name for victim in seen.killed for name in NAMED.get(victim, ())]
        yield from names_one(f"{' and '.join(seen.killed)} died", text, names)


def _arm(seen: Seen) -> Iterator[str]:
    """The controller missed and rejected nothing, and the arm is at rest at the end."""
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


def _link(seen: Seen) -> Iterator[str]:
    """The records of the exchange contain each packet that the controller had replied to, once."""
    rows, records = seen.rows, seen.records
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


def _readable(recording: Recorded, seen: Seen, period: float) -> Iterator[str]:
    """An archive is a gap-free prefix, also for the second reader."""
    archive = recording.archive
    yield from gap_free(recording.cycles)
    yield from not_truncated(
        complete=archive.complete,
        problem=archive.missing or "",
        excused="archive" in seen.killed and _is_newest(recording.path),
    )
    yield from readable(read(recording.path), period)
    if archive.outcome is not None:
        yield from nothing_lost(archive.outcome.records_lost)


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


def _archived(recorded: list[Recorded], seen: Seen, figures: dict[str, int]) -> Iterator[str]:
    """Every cycle of motion is archived, except what a dead archive process may cost."""
    records = seen.records
    if not len(records):
        return
    moving = records["cycle"][_moving(records)]
    there = np.concatenate([np.zeros(0, np.int64), *(recording.cycles for recording in recorded)])
    yield from in_one_archive(recording.cycles.tolist() for recording in recorded)
    missing = np.setdiff1d(moving, there)
    death = next((candidate for candidate in seen.deaths if candidate.victim == "archive"), None)
    if death is None:
        if missing.size:
            yield f"{missing.size} cycles of motion are in no archive"
        return
    lost = int(np.count_nonzero(missing < records["cycle"][0] + death.written))
    if any(not recording.archive.complete for recording in recorded) or lost:
        figures["lost"] = lost
    # Records that the system gave it no time to read are not its loss.
    if lost > PROMISED + death.behind:
        yield f"{lost} cycles of motion were lost with the archive process"


def _motions(recorded: list[Recorded], seen: Seen, campaign: Campaign) -> Iterator[str]:
    """Every set-point of a repetition or validation motion lies on its planned path."""
    for recording in recorded:
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
