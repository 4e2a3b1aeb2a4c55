"""How it was run, as the page shows it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from hil.archive.header import ArchiveName
from hil.report import numbers
from hil.report.figures.conduct import warm_up_panels
from hil.results import RecordedResult, Results


@dataclass(frozen=True)
class RecordedRow:
    """One archive, every number already text."""

    archive: str
    when: str
    seconds: str
    counts: list[str]
    outcome: str
    rejected: bool


def context(results: Results) -> dict[str, Any]:
    """What the template `conduct.html.j2` needs."""
    conduct = results.conduct
    if conduct is None:
        return {"conduct": None}
    return {
        "conduct": conduct,
        "when": when(conduct.recorded),
        "health": health(conduct.recorded),
        "useless": [(_motion(one), one) for one in conduct.recorded if one.outcome != "completed"],
        "recorded_rows": [_row(one) for one in conduct.recorded],
        "warm_up_panels": warm_up_panels(results),
    }


def when(recorded: Sequence[RecordedResult]) -> str:
    """From the first archive's begin to the last one's, in a sentence."""
    begins = sorted(one.when for one in recorded if one.when is not None)
    if not begins:
        return (
            "No date is on record; virtual time has none." if recorded else "Nothing was recorded."
        )
    first, last = (_to_the_minute(one) for one in (begins[0], begins[-1]))
    if first[:10] == last[:10]:
        last = last[11:]
    return f"{first} to {last}, where the last motion began (UTC)."


def _to_the_minute(when: str) -> str:
    return when[:16].replace("T", " ")


def health(recorded: Sequence[RecordedResult]) -> str:
    """How the link did over all archives, in a sentence."""
    cycles = sum(one.cycles for one in recorded)
    if not cycles:
        return "No archive could be read."
    counted: list[tuple[str, Callable[[RecordedResult], int]]] = [
        ("packets missed", lambda one: one.missed),
        ("answers late", lambda one: one.late),
        ("answers not taken", lambda one: one.not_taken),
        ("cycles not archived", lambda one: one.lost),
    ]
    sums = [(words, sum(count(one) for one in recorded)) for words, count in counted]
    told = [f"{count} {words} ({_share(count, cycles)})" for words, count in sums if count]
    size = f"{cycles:,} cycles in {len(recorded)} archives".replace(",", "\u202f")
    return f"{size}: {', '.join(told) if told else 'no packet missed, no answer late, none lost'}."


def _share(count: int, cycles: int) -> str:
    return f"{numbers.significant(1e6 * count / cycles, 2)} in a million"


def _motion(one: RecordedResult) -> str:
    """What a person calls it."""
    name = ArchiveName.parse(one.archive)
    return one.kind if name is None else name.motion


def _row(one: RecordedResult) -> RecordedRow:
    return RecordedRow(
        archive=one.archive,
        when=numbers.MISSING if one.when is None else one.when[:19].replace("T", " "),
        seconds=numbers.fixed(one.seconds, 1),
        counts=[str(n) for n in (one.cycles, one.missed, one.late, one.not_taken, one.lost)],
        outcome=one.outcome,
        rejected=one.outcome != "completed",
    )
