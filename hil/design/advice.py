"""Texts about a design: criteria, margins, weakest parameters, remedies without a result."""

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
"""Condition number with columns of unit length beyond which estimates are mostly noise."""
_WIDEST: Final = 0.5  # largest reported clearance [m]
# Smallest reported entry of a direction relative to the largest, and number of names.
_CONCERNED: Final = 0.3
_MOST_NAMES: Final = 6


def criteria_text(measures: Iterable[float], digits: int = 2) -> str:
    """Return values of `CRITERIA` as text."""
    named = zip(excitation.CRITERIA.values(), measures, strict=True)
    return ", ".join(f"{one.label} {value:.{digits}f}" for one, value in named)


def margins(cell: Cell, problem: excitation.Problem, trajectory: Trajectory) -> str:
    """Return largest current and smallest clearance of a motion, as far as they were checked."""
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
        workspace = replace(cell.workspace, margin=max(_WIDEST, cell.workspace.margin))
        wide = excitation.CollisionChecker(
            cell.urdf, workspace, limits=cell.joint_limits, mesh_folders=cell.mesh_folders
        )
        near = wide.deepest_contact(motion.position)
        if near is not None:
            parts.append(f"nearest {near.distance:.2f} m ({near.first}, {near.second})")
    return "; ".join(parts)


def weakest(objective: excitation.Objective, trajectory: Trajectory) -> tuple[str, ...]:
    """Return the parameters that a motion separates least, in falling order.

    These are the largest entries of the eigenvector with the smallest eigenvalue of the Gram matrix
    of unit columns.
    """
    gram = objective.information(excitation.midpoints(trajectory))
    chosen = objective.parameters
    names = objective.model.parameter_names
    judged = names if chosen is None else tuple(names[k] for k in chosen)
    length = np.sqrt(np.diag(gram))
    _, directions = np.linalg.eigh(gram / length[:, None] / length)
    size: Array = np.abs(directions[:, 0])
    order = np.argsort(-size, kind="stable")[:_MOST_NAMES]
    return tuple(judged[k] for k in order if size[k] >= _CONCERNED * size.max())


_SLOWER_SINES: Final = (
    "use lower frequencies ([sines] slowest, fastest) or another mean posture ([sines] offset)"
)
_SLOWER: Final = "allow slower motions ([via_points] slowest, [constraints] max_duration)"
_MOTORS: Final = "or check current limits and uncertainty of the cell"
_VIA_POINTS: Final = {
    "collision": "restrict via points to the middle of the joint ranges ([via_points] range_share),"
    " use fewer of them, or check floor, walls, margin and home of the cell",
    "current": f"{_SLOWER}, {_MOTORS}",
    "torque": _SLOWER,
    "planning": "use another fly, or fewer via points",
    "too long": "allow more time ([constraints] max_duration), use fewer via points, or raise "
    "[via_points] slowest",
    "too short": "allow less time ([constraints] min_duration), use more via points, or lower "
    "[via_points] slowest",
}
_SINES: Final = {
    "collision": "use another mean posture ([sines] offset), or check floor, walls and margin of "
    "the cell",
    "current": f"{_SLOWER_SINES}, {_MOTORS}",
    "torque": _SLOWER_SINES,
    "joint limit": "use longer ramps or lower frequencies ([sines] ramp, fastest)",
}


class NoExcitationError(UnsafeError):
    """No evaluated motion of a design satisfies all constraints."""


def no_excitation(
    error: excitation.NoFeasibleMotionError,
    frame: AngleFrame,
    checker: excitation.CollisionChecker | None,
    settings: DesignSettings,
) -> NoExcitationError:
    """Return the error of a search without a result, with violations and remedies."""
    contact = error.nearest.get("collision")
    always = None if contact is None or checker is None else always_so(contact, checker)
    advice = "; ".join(_advice(error, settings, always))
    text = infeasible_text(error, frame)
    return NoExcitationError(f"{text}. Possible changes: {advice}" if advice else text)


def infeasible_text(error: excitation.NoFeasibleMotionError, frame: AngleFrame) -> str:
    """Return the message of an error with angles in a frame."""
    return error.sentence(partial(violation_text, frame=frame))


def _advice(
    error: excitation.NoFeasibleMotionError, settings: DesignSettings, always: str | None
) -> Iterator[str]:
    """Yield remedies for the constraints that exclude more than half, or most, of the motions."""
    remedies = _VIA_POINTS if settings.sines is None else _SINES
    kinds = sorted(error.rejected, key=lambda kind: -error.rejected[kind])
    ruling = [kind for kind in kinds if 2 * error.rejected[kind] > error.tried]
    for kind in ruling or kinds[:1]:
        if kind == "duration":  # of via points
            nearest, asked = error.nearest[kind], settings.constraints
            long = nearest.value > nearest.bound
            yield (
                f"the {'shortest' if long else 'longest'} motion lasts {nearest.value:.3g} s,"
                f" allowed are {asked.min_duration:g} to {asked.max_duration:g} s: "
                + remedies["too long" if long else "too short"]
            )
        elif kind == "collision" and always is not None:
            yield always
        elif kind in remedies:
            yield remedies[kind]
    if error.unexciting:
        more = "via points" if settings.sines is None else "harmonics, or a longer motion,"
        yield f"use more {more} or fewer parameters ([objective] parameters)"
