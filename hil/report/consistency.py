"""Physical consistency, as the page shows it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

from hil.report import numbers
from hil.report.figures.consistency import shift_panels
from hil.results import ConsistencyResult, Results

_AT_EDGE: Final = 0.01


@dataclass(frozen=True)
class LinkRow:
    """One link of the consistent model, every number already text."""

    joint: str
    mass: str
    centre: str
    rotor_inertia: str
    room: str
    reference: str
    at_edge: bool


def context(results: Results) -> dict[str, Any]:
    """What the template `consistency.html.j2` needs."""
    consistency = results.consistency
    if consistency is None:
        return {"consistency": None, "shift_panels": [], "link_rows": []}
    return {
        "consistency": consistency,
        "link_rows": link_rows(consistency),
        "shift_panels": shift_panels(results, consistency),
    }


def link_rows(consistency: ConsistencyResult) -> list[LinkRow]:
    """The links as a table."""
    return [
        LinkRow(
            joint=link.joint,
            mass=numbers.significant(link.mass, 3),
            centre=", ".join(numbers.fixed(x, 3) for x in link.centre),
            rotor_inertia=numbers.significant(link.rotor_inertia, 3),
            room=numbers.significant(link.room, 2),
            reference=link.reference,
            at_edge=link.room < _AT_EDGE,
        )
        for link in consistency.links
    ]
