"""What a person should know of a motion that was found: what it is near to, what it cannot tell."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hil.cell import Cell
from identification.excitation import (
    CollisionChecker,
    CurrentModel,
    Objective,
    Problem,
    midpoints,
    sampled,
)
from identification.excitation.collision.built_in import NEAR
from identification.model.motion import Motion
from planner import Trajectory

Array = NDArray[np.float64]

WEAK: Final = 1e4
"""Condition number, columns of unit length, beyond which estimates are mostly noise."""
# Farther away [m] nothing is looked for, and nearer by such steps [m].
_FAR: Final = 0.5
_STEP: Final = 0.005
# Share of the largest entry of a direction that an entry has at least which is told, and how many.
_CONCERNED: Final = 0.3
_MOST_NAMES: Final = 6


def margins(cell: Cell, problem: Problem, trajectory: Trajectory) -> str:
    """Return how near a motion comes to limits that its search looked at, "" if to none."""
    kept, motion = problem.constraints, sampled(trajectory)
    parts = [] if kept.currents is None else [_largest_current(kept.currents, motion)]
    if kept.checker is not None:
        parts.append(_nearest(cell, kept.checker, motion))
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
    for wider in (*np.arange(margin + _STEP, NEAR, _STEP).tolist(), max(_FAR, margin)):
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
