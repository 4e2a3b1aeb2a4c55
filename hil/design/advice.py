"""What a person can change when a search found no motion that keeps every constraint."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hil.cell import AngleFrame, Cell
from hil.errors import UnsafeError
from hil.motion_checks import always_so, violation_text
from identification import excitation
from planner import Trajectory

from .settings import DesignSettings

Array = NDArray[np.float64]

WEAK: Final = 1e4
"""Condition number, columns of unit length, beyond which estimates are mostly noise."""
# Farther away [m] nothing is looked for.
_WIDEST: Final = 0.5
# Share of the largest entry of a direction that an entry has at least to be reported, and how many.
_CONCERNED: Final = 0.3
_MOST_NAMES: Final = 6


def criteria_text(measures: Iterable[float], digits: int = 2) -> str:
    """Return values of `CRITERIA` in words."""
    named = zip(excitation.CRITERIA.values(), measures, strict=True)
    return ", ".join(f"{one.label} {value:.{digits}f}" for one, value in named)


def margins(cell: Cell, problem: excitation.Problem, trajectory: Trajectory) -> str:
    """How near a motion comes to limits that its search looked at, "" if to none.

    Nothing is said of shapes that the arm's construction keeps close to each other.
    """
    constraints, motion, parts = problem.constraints, excitation.sampled(trajectory), list[str]()
    if (currents := constraints.currents) is not None:
        share = np.abs(currents.current(currents.torque(motion))) / currents.current_limit
        largest = share.max(axis=0)
        motor = int(np.argmax(largest))
        parts.append(
            f"current at most {100.0 * largest[motor]:.0f} % of its limit "
            f"(motor of {currents.model.joint_names[motor]})"
        )
    if constraints.checker is not None:
        margin = max(_WIDEST, cell.workspace.margin)
        workspace = replace(cell.workspace, margin=margin)
        folders = cell.mesh_folders
        wide = excitation.CollisionChecker(
            cell.urdf, workspace, limits=cell.joint_limits, mesh_folders=folders
        )
        near = wide.deepest_contact(motion.position)
        pair = (
            "" if near is None else f"nearest {near.distance:.2f} m ({near.first}, {near.second})"
        )
        parts.append(pair or f"nothing nearer than {margin:g} m")
    return "; ".join(parts)


def weakest(objective: excitation.Objective, trajectory: Trajectory) -> tuple[str, ...]:
    """Return the parameters that a motion separates least, those concerned most first.

    They are the largest entries of the weakest eigenvector of the Gram matrix with columns of unit
    length, or the parameters that are not excited at all.
    """
    gram = objective.information(excitation.midpoints(trajectory))
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


_POSTURE: Final = "let the joints swing about another posture ([sines] offset)"
_SLOWER_SINES: Final = (
    "ask for lower frequencies ([sines] slowest, fastest) or another posture to swing about "
    "([sines] offset)"
)
_SLOWER: Final = "allow slower motions ([via_points] slowest, [constraints] max_duration)"
_MOTORS: Final = "or check current limits and uncertainty of the cell"
_VIA_POINTS: Final = {
    "collision": "let via points lie nearer the middle of their ranges ([via_points] range_share), "
    "take fewer of them, or check floor, walls, margin and home of the cell",
    "current": f"{_SLOWER}, {_MOTORS}",
    "torque": _SLOWER,
    "planning": "ask for another fly, or for fewer via points",
    "too long": "allow more time ([constraints] max_duration), take fewer via points, or raise "
    "[via_points] slowest",
    "too short": "ask for less time ([constraints] min_duration), take more via points, or lower "
    "[via_points] slowest",
}
_SINES: Final = {
    "collision": f"{_POSTURE}, or check floor, walls and margin of the cell",
    "current": f"{_SLOWER_SINES}, {_MOTORS}",
    "torque": _SLOWER_SINES,
    "joint limit": "take longer ramps or lower frequencies ([sines] ramp, fastest)",
}
# Fewer motions than this are no search: the next ones may well be feasible.
_FEW: Final = 500
# What is more often too long or too short than this is not mended by chance.
_FAR: Final = 1.5


class NoExcitationError(UnsafeError):
    """Every motion that a design tried would have to be refused."""


def no_excitation(
    error: excitation.NoFeasibleMotionError,
    frame: AngleFrame,
    checker: excitation.CollisionChecker | None,
    settings: DesignSettings,
) -> NoExcitationError:
    """Return the error for a person: what forbids every motion, and what could be changed."""
    contact = error.nearest.get("collision")
    always = None if contact is None or checker is None else always_so(contact, checker)
    advice = "; ".join(_advice(error, settings, always))
    sentence = forbidden(error, frame)
    return NoExcitationError(f"{sentence}. What can be changed: {advice}" if advice else sentence)


def forbidden(error: excitation.NoFeasibleMotionError, frame: AngleFrame) -> str:
    """Return what forbids every motion, in angles of a frame."""
    return error.sentence(partial(violation_text, frame=frame))


def _advice(
    error: excitation.NoFeasibleMotionError, settings: DesignSettings, always: str | None
) -> Iterator[str]:
    """Yield what could be changed about each kind that forbids more than half of the motions."""
    known = _VIA_POINTS if settings.sines is None else _SINES
    unexciting, chance = 2 * error.unexciting > error.tried, True
    kinds = sorted(error.rejected, key=lambda kind: -error.rejected[kind])
    ruling = [kind for kind in kinds if 2 * error.rejected[kind] > error.tried]
    for kind in ruling or ([] if unexciting else kinds[:1]):
        if kind == "duration":  # only motions through via points have one that is not known before
            mildest, asked = error.nearest[kind], settings.constraints
            long = mildest.value > mildest.bound
            least = min(mildest.value, mildest.bound)
            chance = max(mildest.value, mildest.bound) < _FAR * least
            yield (
                f"the {'shortest' if long else 'longest'} motion tried lasts {mildest.value:.3g} s,"
                f" where {asked.min_duration:g} to {asked.max_duration:g} s are asked for: "
                + known["too long" if long else "too short"]
            )
        elif kind == "collision" and always is not None:
            yield always
            chance = False
        elif kind in known:
            yield known[kind]
    if unexciting:
        more = "via points" if settings.sines is None else "harmonics, or a longer motion,"
        yield f"take more {more} or judge by fewer parameters ([objective] parameters)"
    if chance and 0 < error.tried < _FEW:
        yield f"search longer, {error.tried} motions are few ([search] population, generations)"
