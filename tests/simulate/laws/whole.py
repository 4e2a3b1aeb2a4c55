"""Laws of whole campaigns: gaps, packets that piled up, completion."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from drivers.events import MotionEnded
from tests.drivers import oracle
from tests.faults import DISTURBS_THE_ARM, kind_of
from tests.simulate.observed import Observed

from .conversation import heard

_NUMBERS: Final = 0x7FFF  # largest packet number


def gaps(seen: Observed) -> Iterator[str]:
    """A motion with more consecutive missed packets than allowed does not complete.

    `docs/safety.md#safety-rules`: it is stopped on its path, refused or lost.
    """
    most = seen.cell.controller.max_gap
    for number, life in enumerate(seen.runs, start=1):
        ends = [event for _, event in life.events if isinstance(event, MotionEnded)]
        completed = {end.interval: end.cycle for end in ends if end.outcome == "completed"}
        rows = life.records[
            [exchanged.record for exchanged in life.exchanged if exchanged.record >= 0]
        ]
        speed = rows["commanded_velocity"]
        moves = np.append(np.nan_to_num(speed).any(axis=1), [True, True])
        missed = np.diff(rows["number"]) % _NUMBERS - 1
        # Set-points move before a gap and for some cycles after it.
        amid = moves[:-3] & moves[1:-2] & moves[2:-1] & moves[3:]
        amid &= np.isfinite(speed[1:]).all(axis=1)
        for at in np.flatnonzero(amid & (missed > most) & (missed < _NUMBERS // 2)):
            row = rows[at + 1]
            if completed.get(int(row["interval"]), -1) >= row["cycle"]:
                text = f"run {number}: {missed[at]} packets missed before packet {row['number']}"
                yield f"{text}, {most} are allowed, and the motion completed"


def piles(seen: Observed) -> Iterator[str]:
    """Of packets of one kind that waited together in open mode, one is answered.

    Answers to the others would run the motion ahead of the arm (ARCHITECTURE.md).
    """
    for number, life in enumerate(seen.runs, start=1):
        for talk in heard(seen)[number - 1].talks:
            received = talk.received
            cycle = np.array([life.exchanged[k].cycle for k in talk.index])
            together = (np.diff(cycle) == 0) & (np.diff(received.number) != 0)
            kind = np.concatenate((received.status, received.mode), axis=1)
            on = (received.status == oracle.DRIVE_ON).any(axis=1)
            opens = on & (received.mode == seen.cell.controller.mode).any(axis=1)
            for at in np.flatnonzero(together & (kind[1:] == kind[:-1]).all(axis=1) & opens[1:]):
                text = f"run {number}: packets {received.number[at]} and {received.number[at + 1]}"
                yield f"{text} waited together; both were answered in open mode"


_NEEDS_OPERATOR: Final = frozenset({"RepetitionsRejectedError"})


def completion(seen: Observed) -> Iterator[str]:
    """Without further faults the campaign completes and is identified.

    If the arm was disturbed, its repetitions may differ, and the run may request an inspection.
    """
    if seen.complete:
        if seen.found is None:
            yield f"complete, and not identified: {seen.unidentified}"
        return
    disturbed = any(kind_of(line) in {*DISTURBS_THE_ARM, "corrupt"} for line in seen.struck)
    excused = type(seen.runs[-1].error).__name__ in _NEEDS_OPERATOR
    if not (excused and disturbed):
        yield f"after {len(seen.runs)} runs it ended {seen.ended}"
