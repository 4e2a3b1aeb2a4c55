"""A run ends with a complete campaign, or with an error of `docs/campaign.md` and its remedy.

Any other end of a run is a defect.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from planner import FourierSeries, PiecewiseCubic
from tests.laws.errors import allowed
from tests.laws.manifests import completed, manifest_of, nothing_missing
from tests.laws.motions import as_planned
from tests.laws.second_reader import read
from tests.simulate.observed import Life, Observed

_DEATHS: Final = ("Killed", "KeyboardInterrupt")


def resume(observed: Observed) -> Iterator[str]:
    """Check the law of this module."""
    for number, life in enumerate(observed.runs, 1):
        yield from _ended(number, life)
    entries = manifest_of(observed.folder)[1]
    counts = (1, observed.cell.campaign.repetitions, len(observed.plan.validation))
    missing = list(nothing_missing(entries, counts))
    if observed.complete and missing:
        yield f"the last run reports a complete campaign, and {', '.join(missing)}"
    if not observed.complete and not missing:
        yield f"nothing is missing, and the last run ended {observed.ended}"
    for entry in completed(entries):
        motion = _motion(observed, *entry.motion)
        if motion is not None:
            archived = read(observed.folder / "archives" / entry.name)
            yield from as_planned(archived, motion, observed.cell.period)


def _ended(number: int, life: Life) -> Iterator[str]:
    error = life.error
    if error is None:
        if life.result is None:
            yield f"life {number} ended without a result and without an error"
        return
    if type(error).__name__ not in _DEATHS:
        for text in allowed(error):
            yield f"life {number} {text}"


def _motion(observed: Observed, kind: str, index: int) -> PiecewiseCubic | FourierSeries | None:
    if kind == "excitation":
        return observed.plan.excitation.trajectory
    return observed.plan.validation[index].trajectory if kind == "validation" else None
