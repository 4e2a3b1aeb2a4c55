"""Which laws a simulated campaign breaks."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import Final

import numpy as np

from drivers.events import MotionEnded
from tests.simulate.laws import LAWS as OTHERS
from tests.simulate.observed import Broken, Exchanged, Law, Life, Observed
from tests.simulate.script import DISTURBS_THE_ARM, kind_of

_NUMBERS: Final = 0x7FFF  # Packet numbers are 1 to this
_HEADER, _AXIS, _INIT = 12, 36, 1200  # bytes
_DRIVE_ON: Final = 5


def gaps(seen: Observed) -> Iterator[Broken]:
    """More packets missed in a row than the cell allows: the motion comes to no good end.

    `docs/safety.md`: it is brought to rest on its path, or refused, or lost, but not completed.
    """
    most = seen.cell.controller.max_gap
    for number, life in enumerate(seen.runs, start=1):
        for first, second in pairwise(one for one in life.exchanged if one.record >= 0):
            missed = (_number(second) - _number(first)) % _NUMBERS - 1
            outcome = _outcome_of_motion(life, first, second)
            if most < missed < _NUMBERS // 2 and outcome == "completed":
                text = f"run {number}: {missed} packets missed before packet {_number(second)}"
                yield Broken("gaps", f"{text}, {most} are allowed, and the motion completed")


def _outcome_of_motion(life: Life, first: Exchanged, second: Exchanged) -> str | None:
    """How a motion ended whose set-points moved before a gap and after it."""
    before, after = life.records[first.record], life.records[second.record]
    sped = np.nan_to_num(before["commanded_velocity"]).any()
    if not sped or not np.isfinite(after["commanded_velocity"]).all():
        return None
    later = life.records[second.record : second.record + 3]["commanded_velocity"]
    if not np.nan_to_num(later).any(axis=1).all():
        return None  # it was at its end
    ends = (event for _, event in life.events if isinstance(event, MotionEnded))
    same = (end for end in ends if end.interval == int(after["interval"]))
    return next((end.outcome for end in same if end.cycle >= int(after["cycle"])), None)


def piles(seen: Observed) -> Iterator[Broken]:
    """Of packets of one kind that waited together in open mode only one gets an answer.

    ARCHITECTURE.md, "Late answers are dropped": answers to the others would run the motion ahead
    of the arm.
    """
    mode = seen.cell.controller.mode
    end = _HEADER + _AXIS * (len(seen.cell.joint_names) + seen.controller.foreign_axes)
    for number, life in enumerate(seen.runs, start=1):
        answered = [one for one in life.exchanged if one.replies and one.record >= 0]
        for first, second in pairwise(answered):
            together = first.cycle == second.cycle and first.packet[:4] != second.packet[:4]
            opens = len(second.packet) < _INIT and _opens(second.packet[:end], mode)
            if together and opens and _kind(first, end) == _kind(second, end):
                text = f"run {number}: packets {_number(first)} and {_number(second)}"
                yield Broken("piles", f"{text} of one pile were both answered in open mode")


def _number(one: Exchanged) -> int:
    return int.from_bytes(one.packet[:4], "little")


def _kind(one: Exchanged, end: int) -> tuple[int, bytes, bytes]:
    """What follows the axes, from `end` on, may be garbage."""
    return len(one.packet), one.packet[4:8], one.packet[_HEADER:end:_AXIS]


def _opens(packet: bytes, mode: int) -> bool:
    """Whether a cyclic packet has an axis in open mode, with a drive on."""
    if _DRIVE_ON not in packet[4:8]:
        return False
    return any(
        int.from_bytes(packet[at : at + 4], "little") == mode
        for at in range(_HEADER, len(packet) - _AXIS + 1, _AXIS)
    )


_FOR_A_PERSON: Final = frozenset({"RepetitionsRejectedError", "ArmChangedError"})


def completion(seen: Observed) -> Iterator[Broken]:
    """Once nothing goes wrong any more, the campaign completes and can be identified.

    But where something disturbed the arm, its repetitions may be unlike each other for good: the
    run then says that a person has to look.
    """
    if seen.complete:
        if seen.found is None:
            yield Broken("completion", f"complete, and not identified: {seen.unidentified}")
        return
    disturbed = any(kind_of(line) in {*DISTURBS_THE_ARM, "corrupt"} for line in seen.struck)
    looked_for = disturbed and type(seen.runs[-1].error).__name__ in _FOR_A_PERSON
    if not looked_for:
        yield Broken("completion", f"after {len(seen.runs)} runs it ended {seen.ended}")


LAWS: Final[dict[str, Law]] = {"completion": completion, "gaps": gaps, "piles": piles, **OTHERS}


def judged(seen: Observed) -> list[Broken]:
    """What is broken; a law that fails itself is a failure of its own name."""
    found: list[Broken] = []
    for name, law in LAWS.items():
        try:
            found += law(seen)
        except Exception as error:  # an observation that a law cannot read must be looked at
            found.append(Broken(f"{name} (cannot judge)", f"{type(error).__name__}: {error}"))
    return found
