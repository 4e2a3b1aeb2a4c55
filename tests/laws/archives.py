"""An archive holds what was exchanged, once and in order, and states what it lacks.

`docs/archive-format.md`: records as exchanged, increasing cycles, missing packets counted; a file
that was not closed is readable to its last complete chunk.
"""

from __future__ import annotations

from collections.abc import Collection, Hashable, Iterable, Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.archive import open_archive
from hil.base.errors import ArchiveError
from tests.laws.second_reader import Archived


def readable(archived: Archived, period: float) -> Iterator[str]:
    """A file as it is, without what was exchanged: all laws that need nothing else."""
    yield from read_alike(archived)
    yield from ordered(archived.cycles["cycle"], archived.cycles["gap"])
    yield from consistent(archived, period)
    yield from stated(archived)


def not_truncated(*, complete: bool, problem: str, excused: bool) -> Iterator[str]:
    """A file is complete, unless a fault struck while it was written."""
    if not complete and not excused:
        yield f"is incomplete ({problem}) without a fault that truncated it"


def read_alike(archived: Archived) -> Iterator[str]:
    """The product reads the same rows, and says whether the file is complete."""
    try:
        archive = open_archive(archived.path, fields=("cycle", "position"))
    except ArchiveError as error:
        if len(archived.cycles):
            yield f"is refused ({error}) with {len(archived.cycles)} complete records"
        return
    if archive.complete is not archived.whole:
        yield f"complete is {archive.complete}, expected {archived.whole}"
    columns = archive.columns
    if len(archived.cycles):
        same = np.array_equal(columns["cycle"], archived.cycles["cycle"])
        if not same or not np.array_equal(columns["position"], archived.cycles["position"]):
            yield f"{len(columns['cycle'])} records are read of {len(archived.cycles)}"


def ordered(cycles: NDArray[Any], gaps: NDArray[Any]) -> Iterator[str]:
    """Cycles (k,) increase, and leave room for the packets (k,) that were missed before each.

    After a silence more may be missing: their number is unknown.
    """
    if not (np.diff(cycles) > 0).all():
        yield "cycles do not increase"
    if np.any(np.diff(cycles) < 1 + gaps[1:]):
        yield "more packets are missing than cycles between two records"


def gap_free(cycles: NDArray[Any], missed: int = 0) -> Iterator[str]:
    """Between the first and the last cycle (k,) only the packets missed are lacking."""
    if len(cycles) and int(cycles[-1]) - int(cycles[0]) + 1 - len(cycles) != missed:
        yield f"has gaps: {len(cycles)} cycles of {int(cycles[0])} to {int(cycles[-1])}"


def consistent(archived: Archived, period: float) -> Iterator[str]:
    """The channels agree with each other: times, numbers, JointState."""
    rows = archived.cycles
    if not len(rows):
        return
    cycle = rows["cycle"]
    stamps = np.rint(cycle * (period * 1e9)).astype(np.int64)
    headers = rows["sec"].astype(np.int64) * 10**9 + rows["nanosec"]
    if not (np.array_equal(stamps, archived.stamps) and np.array_equal(stamps, headers)):
        yield "times are not cycle times period"
    if not np.array_equal(archived.sequences, np.arange(len(rows))):
        yield "messages are not numbered consecutively"
    state = np.concatenate([rows[name] for name in ("position", "velocity", "torque")], axis=1)
    sent, inside = (
        np.concatenate([rows[f"{whose}_{name}"] for name in ("position", "velocity")], axis=1)
        for whose in ("commanded", "target")
    )
    sent = np.where(np.isnan(sent), inside, sent)
    same = np.array_equal(state, archived.states, equal_nan=True)
    if not (same and np.array_equal(sent, archived.commanded, equal_nan=True)):
        yield "the JointState channels do not agree with the records"


def stated(archived: Archived) -> Iterator[str]:
    """The numbers of the outcome agree with the records."""
    outcome = archived.outcome
    if outcome is None or not archived.whole:
        return
    rows = archived.cycles
    expected = {"samples": len(rows), "events": len(archived.events)}
    if len(rows):
        expected["lost_packets"] = int(rows["gap"].sum())
        expected["first_cycle"] = int(rows["cycle"][0])
        expected["last_cycle"] = int(rows["cycle"][-1])
    for key, value in expected.items():
        if outcome.get(key) != str(value):
            yield f"{key} is stated as {outcome.get(key)}, and is {value}"


def nothing_lost(records_lost: int | None) -> Iterator[str]:
    """No record was lost between the exchange and the file: by the outcome."""
    if records_lost:
        yield f"states that {records_lost} records were lost"


def as_exchanged(
    archived: Mapping[str, NDArray[Any]] | NDArray[np.void],
    exchanged: NDArray[np.void],
    names: Iterable[str],
) -> Iterator[str]:
    """The columns of an archive are those of the cycles exchanged (k,)."""
    for name in names:
        columns = archived[name], exchanged[name]
        numbers = columns[1].dtype.kind == "f"
        if not np.array_equal(*columns, equal_nan=numbers):
            yield f"{name} is not that of the cycle exchanged"


def in_one_archive(records: Iterable[Collection[Hashable]]) -> Iterator[str]:
    """No record is in two archives; the records of each archive by what identifies them."""
    seen: set[Hashable] = set()
    for of_archive in records:
        if twice := len(seen & set(of_archive)):
            yield f"{twice} records are in two archives"
        seen |= set(of_archive)
