"""What a simulated campaign went through: a law about what never came about says nothing."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from drivers.events import AnswersLost, GapSeen, InitReceived, LinkLost, MotionEnded
from tests.simulate.observed import Life, Observed

EXPECTED: Final = (
    "a duplicate was answered",
    "a stale packet was left out",
    "a malformed packet was left out",
    "packets piled up",
    "packets were missed",
    "more were missed than allowed",
    "answers were not taken",
    "a set-point was refused",
    "the link fell silent",
    "the controller began anew in mid-run",
    "motion completed",
    "motion stopped",
    "motion refused",
    "motion lost",
    "the process died",
    "the process died with a torn archive",
    "the disk failed",
    "a whole archive was adopted",
    "a motion was rejected",
    "a dry run was accepted",
    "several runs completed it",
    "no run completed it",
)  # Each is the ground of a law, or of a part of one


def situations(seen: Observed) -> tuple[str, ...]:
    """Those of `EXPECTED` that came about."""
    found = {name for life in seen.runs for name in _of_life(life, seen.cell.controller.max_gap)}
    if not seen.complete:
        found.add("no run completed it")
    elif len(seen.runs) > 1:
        found.add("several runs completed it")
    return tuple(name for name in EXPECTED if name in found)


def _of_life(life: Life, max_gap: int) -> Iterator[str]:
    counters, result = life.counters, life.result
    events = [event for _, event in life.events]
    inits = sum(isinstance(event, InitReceived) for event in events)
    told = {
        "a duplicate was answered": counters.duplicates,
        "a stale packet was left out": counters.stale,
        "a malformed packet was left out": counters.malformed,
        "packets piled up": counters.discarded.get("late"),
        "packets were missed": counters.missed,
        "answers were not taken": any(isinstance(event, AnswersLost) for event in events),
        "a set-point was refused": counters.refused,
        "the link fell silent": any(isinstance(event, LinkLost) for event in events),
        "the controller began anew in mid-run": inits > 1,
        "the process died": life.died,
        "the process died with a torn archive": life.died and any(life.torn.values()),
        "the disk failed": life.disk,
        "a whole archive was adopted": result is not None and result.adopted,
        "a motion was rejected": result is not None and result.rejected,
        "a dry run was accepted": result is not None and result.dry_run == "accepted",
        "more were missed than allowed": any(
            isinstance(event, GapSeen) and event.missed > max_gap for event in events
        ),
    }
    yield from (name for name, met in told.items() if met)
    yield from {f"motion {event.outcome}" for event in events if isinstance(event, MotionEnded)}
