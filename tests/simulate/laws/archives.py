"""Archives contain what crossed the simulated wire, except what they state as lost.

The laws of `tests.laws.archives`, and: one interval of motion per file; records agree with the
packets and answers, decoded here.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.events import MotionEnded, MotionStarted
from tests.drivers import oracle
from tests.laws.archives import (
    as_exchanged,
    consistent,
    in_one_archive,
    not_truncated,
    ordered,
    read_alike,
    stated,
)
from tests.laws.second_reader import Archived, read
from tests.simulate.observed import Life, Observed

from .conversation import Talk, heard
from .wire import REFUSALS, Array, Gears

_EPS: Final = float(np.finfo(np.float64).eps)
_FLUSHED: Final = 0.1  # duration of a chunk [s]
_DRAINED: Final = 100  # cycles after which records are passed to the archive
_SAME: Final = ("arrival", "number", "gap", "interval", "state", "status", "mode")
_SI: Final = (
    *("target_position", "target_velocity", "position", "velocity"),
    *("target_current", "model_current", "diagonal_inertia", "extra3"),
)
"""Names of D1..D5, extra1..3 in a record."""


@dataclass(frozen=True, eq=False)
class Placed:
    """An archive with the session (None without records, or if none matches) and its rows (k,)."""

    archived: Archived
    life: Life
    talk: Talk | None
    rows: NDArray[np.intp]


@lru_cache(maxsize=2)
def placed(observed: Observed) -> tuple[Placed, ...]:
    """Return the archives of all lives that are in the folder."""
    archives_placed = []
    for life, conversation in zip(observed.runs, heard(observed), strict=True):
        for name in life.archives:
            path = observed.folder / "archives" / name
            if path.exists():
                archived = read(path)
                archives_placed.append(
                    Placed(archived, life, *_place(archived, conversation.talks))
                )
    return tuple(archives_placed)


def _place(archived: Archived, talks: tuple[Talk, ...]) -> tuple[Talk | None, NDArray[np.intp]]:
    rows = archived.cycles
    nothing = np.zeros(0, np.intp)
    if not len(rows):
        return None, nothing
    for talk in talks:
        records = talk.records
        at = np.searchsorted(records["cycle"], rows["cycle"])
        if len(records) and at[-1] < len(records):
            there = records[at]
            same = (there["cycle"] == rows["cycle"]) & (there["number"] == rows["number"])
            if (same & (there["arrival"] == rows["arrival"])).all():
                return talk, at
    return None, nothing


def archives(observed: Observed) -> Iterator[str]:
    """Check the law of this module."""
    gears = Gears.of(observed.cell.drive_table)
    constants = np.array(observed.cell.drive_table.torque_constant, float)
    all_placed = placed(observed)
    for number, placed_archive in enumerate(all_placed):
        archived = placed_archive.archived
        name = archived.path.name
        intact_too = number == observed.seed % len(all_placed)
        newest = any(placed_archive is p for p in _newest(all_placed, placed_archive.life))
        texts = [
            *_readable(placed_archive, intact_too=intact_too, newest=newest),
            *ordered(archived.cycles["cycle"], archived.cycles["gap"]),
            *consistent(archived, observed.cell.period),
            *stated(archived),
            *_made_of(placed_archive, gears, constants),
        ]
        for text in texts:
            yield f"{name}: {text}"
    yield from _each_interval(observed, all_placed)


def _newest(all_placed: tuple[Placed, ...], life: Life) -> list[Placed]:
    """Return the archive with the last cycles of a life, and those without cycles."""
    mine = [p for p in all_placed if p.life is life]
    last = max((_last_of(p) for p in mine), default=-1)
    return [p for p in mine if _last_of(p) in (-1, last)]


def _last_of(placed_archive: Placed) -> int:
    """Return the index of the packet of the last cycle in an archive; -1 for none."""
    return (
        int(placed_archive.talk.index[placed_archive.rows[-1]])
        if placed_archive.talk is not None and len(placed_archive.rows)
        else -1
    )


def _readable(placed_archive: Placed, *, intact_too: bool, newest: bool) -> Iterator[str]:
    archived = placed_archive.archived
    life = placed_archive.life
    name = archived.path.name
    being_written = newest and (life.died or bool(life.disk))  # at the fault
    yield from not_truncated(
        complete=archived.whole,
        problem=archived.problem,
        excused=being_written or name in life.torn,
    )
    if not archived.whole or intact_too:
        yield from read_alike(archived)


def _made_of(placed_archive: Placed, gears: Gears, constants: Array) -> Iterator[str]:
    """Each record agrees with its packet and answer."""
    archived = placed_archive.archived
    talk = placed_archive.talk
    rows = placed_archive.rows
    cycles = archived.cycles
    if not len(cycles):
        return
    if talk is None:
        yield "its records agree with no session of the run that wrote it"
        return
    init = talk.life.exchanged[talk.at].packet
    if archived.attachments.get("init_packet.bin") != init:
        yield "its init packet is not the session's"
    lost = int(rows[-1] - rows[0] + 1 - len(rows))
    stated = int((archived.outcome or {}).get("records_lost", 0))
    if archived.whole and lost != stated:
        yield f"{lost} cycles in between were exchanged and not archived, {stated} are stated lost"
    if not archived.whole and lost:
        yield f"{lost} cycles are missing within the truncated file"
    records = talk.records[rows]
    yield from as_exchanged(cycles, records, _SAME)
    if talk.init.slots:
        yield from _decoded(talk, rows, cycles, gears, constants)


def _decoded(
    talk: Talk, rows: NDArray[np.intp], cycles: NDArray[np.void], gears: Gears, constants: Array
) -> Iterator[str]:
    slots = list(talk.init.slots or ())
    d = talk.received.d[rows][:, slots].astype(np.float64)
    period = talk.init.period
    finite = np.isfinite(d).all(axis=(1, 2))  # a corrupted packet may have any number
    size = np.abs(np.linalg.inv(gears.matrix)).sum(axis=1).max() * (
        1.0
        + np.abs(gears.offset).max()
        + np.abs(d[finite, :, :4]).max(axis=(1, 2), initial=0.0, keepdims=True)[:, :, 0]
    )
    bound = 16.0 * len(slots) * _EPS * size
    for column, name in enumerate(_SI):
        recorded = cycles[name][finite]
        if column in (0, 2):
            good = np.abs(recorded - gears.joint(d[finite, :, column])) <= bound
        elif column in (1, 3):
            expected = np.linalg.solve(gears.matrix, d[finite, :, column].T).T / period
            good = np.abs(recorded - expected) <= bound / period
        else:
            good = recorded == d[finite, :, column]
        if not good.all():
            yield f"{name} is not that of the packets"
    torque = (cycles["target_current"][finite] * constants) @ (2.0 * np.pi * gears.matrix)
    scale = np.abs(cycles["target_current"][finite] * constants) @ np.abs(
        2.0 * np.pi * gears.matrix
    )
    if np.any(np.abs(cycles["torque"][finite] - torque) > 16.0 * len(slots) * _EPS * (scale + 1.0)):
        yield "torque is not that of the current"
    settings = talk.life.settings
    sent = cycles["commanded_position"]
    wanted, answered = (side.mode[rows][:, slots] for side in (talk.received, talk.answer))
    on = talk.received.status[rows, int(settings.get("arm", 1)) - 1] == oracle.DRIVE_ON
    refused = (np.isin(answered, REFUSALS) & (answered != wanted)).any(axis=1)
    led = (wanted == int(settings.get("mode", 4))).all(axis=1) & on & ~refused
    if talk.usable and not np.array_equal(np.isfinite(sent).all(axis=1) & led, led):
        yield "a set-point was sent that is not in its record"
    given = np.isfinite(sent) & led[:, np.newaxis]
    motor = gears.motor(np.where(given, sent, 0.0))
    on_wire = talk.answer.d[rows][:, slots, 0]
    # Tolerance: half a step of float32 on the wire, and the conversion from joint angles.
    allowed = np.spacing(np.abs(on_wire)).astype(np.float64) + 32.0 * len(slots) * _EPS * (
        1.0 + np.abs(motor)
    )
    if np.any(given & (np.abs(motor - on_wire) > allowed)):
        yield "a recorded set-point is not the one that was sent"
    if np.isfinite(sent[~on | refused]).any():
        yield "a set-point is recorded where none was allowed"


def _each_interval(observed: Observed, all_placed: tuple[Placed, ...]) -> Iterator[str]:
    """Each motion is completely in one archive of its life, with its outcome."""
    for number, (life, conversation) in enumerate(
        zip(observed.runs, heard(observed), strict=True), 1
    ):
        mine = [p for p in all_placed if p.life is life and p.talk is not None]
        begun = [(talk, interval) for talk in conversation.talks for interval in _motions(talk)]
        at_risk = begun[len(begun) - _at_risk(life, mine) :]
        for talk, interval in begun:
            rows = np.flatnonzero(talk.records["interval"] == interval)
            if len(rows):
                excused = any(talk is other and interval == same for other, same in at_risk)
                period = observed.cell.period
                for text in _interval(life, talk, interval, rows, mine, period, excused=excused):
                    yield f"life {number}, interval {interval}: {text}"
        records = [{(id(p.talk), int(row)) for row in p.rows} for p in mine]
        for text in in_one_archive(records):
            yield f"life {number}: {text}"


def _at_risk(life: Life, mine: list[Placed]) -> int:
    """Return the number of last motions of a life that may have no archive.

    A kill or a disk fault concerns the last one; truncation may empty any of the newest files.
    """
    with_rows = {p.archived.path.name for p in mine if len(p.rows)}
    truncated = len(life.torn) if {*life.torn} - with_rows else 0
    return max(truncated, int(life.died or bool(life.disk)))


def _motions(talk: Talk) -> list[int]:
    """Return the intervals of a session in which a motion began."""
    return [event.interval for event in talk.events if isinstance(event, MotionStarted)]


def _interval(
    life: Life,
    talk: Talk,
    interval: int,
    rows: NDArray[np.intp],
    mine: list[Placed],
    period: float,
    *,
    excused: bool,
) -> Iterator[str]:
    cycles = talk.records["cycle"]
    ends = [e for e in talk.events if isinstance(e, MotionEnded) and e.interval == interval]
    if ends:  # axes may stay open for some cycles after the drive was lost
        rows = rows[cycles[rows] <= ends[-1].cycle]
    holding = [p for p in mine if p.talk is talk and np.isin(rows, p.rows).any()]
    if len(holding) != 1:
        if len(holding) > 1 or not (excused or _cut_short(life)):
            yield f"its {len(rows)} cycles are in {len(holding)} archives"
        return
    archived = holding[0].archived
    if ends and archived.whole:
        ended = ends[-1]
        valid = {ended.outcome, *(("rejected",) if ended.outcome == "completed" else ())}
        if archived.ended not in valid and archived.ended != "interrupted":
            yield f"it ended {ended.outcome}, and {archived.path.name} states {archived.ended!r}"
    missing = rows[~np.isin(rows, holding[0].rows)]
    stated = int((archived.outcome or {}).get("records_lost", 0))
    if archived.whole and archived.ended != "interrupted" and len(missing) > stated:
        yield f"{len(missing)} of its cycles are not in {archived.path.name}, which states {stated}"
    excused = archived.path.name in life.torn or archived.path.name in life.refused
    if not archived.whole and life.died and not excused and len(rows):
        # An incomplete chunk, and records still in memory.
        most = round(_FLUSHED / period) + _DRAINED
        if cycles[missing[-1]] - cycles[missing[0]] >= most if len(missing) else False:
            yield f"{len(missing)} cycles were lost by the kill, at most {most} are allowed"


def _cut_short(life: Life) -> bool:
    """Whether the run was aborted by Ctrl-C."""
    return isinstance(life.error, KeyboardInterrupt)
