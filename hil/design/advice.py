"""What a person can change when a search found no motion that keeps every constraint."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from typing import Final

from hil.cell import AngleFrame
from hil.errors import UnsafeError
from hil.violation_text import always_so, violation_text
from identification.excitation import (
    CollisionChecker,
    NoFeasibleMotionError,
    SearchSettings,
    Violation,
)

from .settings import ConstraintTable, DesignSettings

_VIA_POINTS: Final = {
    "collision": (
        "let via points lie nearer the middle of their ranges ([via_points] range_share), take "
        "fewer of them, or check floor, walls, margin and home of the cell"
    ),
    "current": (
        "allow slower motions ([via_points] slowest, [constraints] max_duration), or check "
        "current limits and uncertainty of the cell"
    ),
    "torque": "allow slower motions ([via_points] slowest, [constraints] max_duration)",
    "planning": "ask for another fly, or for fewer via points",
}
_SINES: Final = {
    "collision": (
        "let the joints swing about another posture ([sines] offset), or check floor, walls and "
        "margin of the cell"
    ),
    "current": (
        "ask for lower frequencies ([sines] slowest, fastest) or another posture to swing about "
        "([sines] offset), or check current limits and uncertainty of the cell"
    ),
    "torque": (
        "ask for lower frequencies ([sines] slowest, fastest) or another posture to swing about "
        "([sines] offset)"
    ),
    "joint limit": "take longer ramps or lower frequencies ([sines] ramp, fastest)",
}
_UNEXCITING: Final = "or judge by fewer parameters ([objective] parameters)"
# Fewer motions than this are no search: the next ones may well be feasible.
_FEW: Final = 500
# What is more often too long or too short than this is not mended by chance.
_FAR: Final = 1.5
# Durations between this share of the longest one and the longest one are hard to hit.
_NARROW: Final = 0.9


class NoExcitationError(UnsafeError):
    """Every motion that a design tried would have to be refused."""


def no_excitation(
    error: NoFeasibleMotionError,
    frame: AngleFrame,
    checker: CollisionChecker | None,
    settings: DesignSettings,
) -> NoExcitationError:
    """Return the error for a person: what forbids every motion, and what could be changed.

    Args:
        error: of the search.
        frame: of the angles to tell it in.
        checker: of the search; it knows which pairs no motion can part.
        settings: of the design.
    """
    contact = error.nearest.get("collision")
    always = None if contact is None or checker is None else always_so(contact, checker)
    advice = "; ".join(_advice(error, settings, always))
    sentence = forbidden(error, frame)
    return NoExcitationError(f"{sentence}. What can be changed: {advice}" if advice else sentence)


def forbidden(error: NoFeasibleMotionError, frame: AngleFrame) -> str:
    """Return what forbids every motion, of the one that comes closest the worst of each kind."""
    worst: dict[str, Violation] = {}
    for violation in sorted(error.closest, key=lambda violation: -violation.excess):
        worst.setdefault(violation.kind, violation)
    return NoFeasibleMotionError(
        error.rejected,
        error.nearest,
        closest=tuple(worst.values()),
        tried=error.tried,
        unexciting=error.unexciting,
        stopped=error.stopped,
    ).sentence(partial(violation_text, frame=frame))


def exhausted(generations: int, settings: SearchSettings) -> str:
    """Return why a search ended before its last generation, and what could be changed."""
    return (
        f"ended after {generations} of {settings.generations} generations: mating brought no "
        "motion that was not there before; raise mutation, crossover or population in [search]"
    )


def _advice(
    error: NoFeasibleMotionError, settings: DesignSettings, always: str | None
) -> Iterator[str]:
    """Yield what could be changed about each kind that forbids more than half of the motions."""
    unexciting = 2 * error.unexciting > error.tried
    bridged = True
    for kind in _ruling(error, alone=not unexciting):
        if kind == "duration":
            far, advice = _duration(error.nearest[kind], settings.constraints)
            bridged = not far
            yield advice
        elif kind == "collision" and always is not None:
            yield always
            bridged = False
        else:
            known = _VIA_POINTS if settings.sines is None else _SINES
            if kind in known:
                yield known[kind]
    if unexciting:
        more = "via points" if settings.sines is None else "harmonics, or a longer motion,"
        yield f"take more {more} {_UNEXCITING}"
    if bridged and 0 < error.tried < _FEW:
        yield f"search longer, {error.tried} motions are few ([search] population, generations)"


def _ruling(error: NoFeasibleMotionError, *, alone: bool) -> Sequence[str]:
    """Return the kinds that forbid more than half, or the one that forbids most."""
    kinds = sorted(error.rejected, key=lambda kind: -error.rejected[kind])
    most = [kind for kind in kinds if 2 * error.rejected[kind] > error.tried]
    return most or (kinds[:1] if alone else [])


def _duration(mildest: Violation, asked: ConstraintTable) -> tuple[bool, str]:
    """Return whether durations are far from what is asked for, and what to do.

    Only motions through via points have one that is not known before.
    """
    too_long = mildest.value > mildest.bound
    ratio = mildest.value / mildest.bound if too_long else mildest.bound / mildest.value
    if ratio < _FAR and asked.min_duration > _NARROW * asked.max_duration:
        return False, (
            f"leave more room between {asked.min_duration:g} and {asked.max_duration:g} s "
            "([constraints] min_duration, max_duration)"
        )
    if too_long:
        which, what = "shortest", "long"
        advice = (
            "allow more time ([constraints] max_duration), take fewer via points, or raise "
            "[via_points] slowest"
        )
    else:
        which, what = "longest", "short"
        advice = (
            "ask for less time ([constraints] min_duration), take more via points, or lower "
            "[via_points] slowest"
        )
    if ratio < _FAR:
        return False, advice
    times = f"{ratio:.0f}" if ratio >= 10.0 else f"{ratio:.1f}"
    return True, f"the {which} motion tried is {times} times too {what}: {advice}"
