"""What a person can change when a search found no motion that keeps every constraint."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hil.cell import AngleFrame, Cell
from hil.errors import UnsafeError
from hil.motion_checks import always_so, violation_text
from identification.excitation import (
    CollisionChecker,
    CurrentModel,
    NoFeasibleMotionError,
    Objective,
    Problem,
    SearchSettings,
    Violation,
    midpoints,
    sampled,
)
from identification.excitation.collision.scene import NEAR
from identification.model.motion import Motion
from planner import Trajectory

from .settings import ConstraintTable, DesignSettings

Array = NDArray[np.float64]

WEAK: Final = 1e4
"""Condition number, columns of unit length, beyond which estimates are mostly noise."""
# Farther away [m] nothing is looked for, and nearer by such steps [m].
_WIDEST: Final = 0.5
_STEP: Final = 0.005
# Share of the largest entry of a direction that an entry has at least to be reported, and how many.
_CONCERNED: Final = 0.3
_MOST_NAMES: Final = 6


def margins(cell: Cell, problem: Problem, trajectory: Trajectory) -> str:
    """Return how near a motion comes to limits that its search looked at, "" if to none."""
    constraints, motion = problem.constraints, sampled(trajectory)
    parts = [] if constraints.currents is None else [_largest_current(constraints.currents, motion)]
    if constraints.checker is not None:
        parts.append(_nearest(cell, constraints.checker, motion))
    return "; ".join(parts)


def weakest(objective: Objective, trajectory: Trajectory) -> tuple[str, ...]:
    """Return the parameters that a motion tells apart least, those concerned most first.

    They are the largest entries of the weakest eigenvector of the Gram matrix with columns of unit
    length, or the parameters that are not excited at all.
    """
    gram = objective.information(midpoints(trajectory))
    chosen = objective.parameters
    names = objective.model.parameter_names
    judged = names if chosen is None else tuple(names[k] for k in chosen)
    length = np.sqrt(np.diag(gram))
    if not np.all(length > 0.0):
        return tuple(judged[k] for k in np.flatnonzero(~(length > 0.0)))
    _, directions = np.linalg.eigh(gram / length[:, None] / length)
    size: Array = np.abs(directions[:, 0])
    order = np.argsort(-size, kind="stable")[:_MOST_NAMES]
    return tuple(judged[k] for k in order if size[k] >= _CONCERNED * size.max())


def _largest_current(currents: CurrentModel, motion: Motion) -> str:
    share = np.abs(currents.current(currents.torque(motion))) / currents.current_limit
    largest = share.max(axis=0)
    motor = int(np.argmax(largest))
    return (
        f"current at most {100.0 * largest[motor]:.0f} % of its limit "
        f"(motor of {currents.model.joint_names[motor]})"
    )


def _nearest(cell: Cell, checker: CollisionChecker, motion: Motion) -> str:
    """Return what comes nearest to what, to some millimetres.

    A checker finds what is nearer than its margin, so wider and wider ones are asked. One takes
    what is nearer than its margin in any posture for built that way, and looks at it no more: what
    the one before did look at, and found no contact of, is as far as that one's margin.
    """
    margin, known = cell.workspace.margin, _built_in(checker)
    for wider in (*np.arange(margin + _STEP, NEAR, _STEP).tolist(), max(_WIDEST, margin)):
        wide = CollisionChecker(
            cell.urdf,
            replace(cell.workspace, margin=wider),
            limits=cell.joint_limits,
            mesh_folders=cell.mesh_folders,
        )
        found = [(margin, *pair) for pair in sorted(_built_in(wide) - known)]
        contact = wide.deepest_contact(motion.position)
        if contact is not None:
            found.append((contact.distance, contact.first, contact.second))
        if found:
            distance, first, second = min(found)
            return f"nearest {distance:.2f} m ({first}, {second})"
        margin = wider
    return f"nothing nearer than {margin:g} m"


def _built_in(checker: CollisionChecker) -> set[tuple[str, str]]:
    """Return pairs that a checker leaves out, by the names of links and obstacles."""
    return {(_link(pair.first), _link(pair.second)) for pair in checker.built_in}


def _link(shape: str) -> str:
    """Return the link of a shape, whose name has a number behind it, or an obstacle's own name."""
    return shape.rpartition("_")[0] or shape


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
