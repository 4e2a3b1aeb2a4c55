"""Texts about a design: criteria, and remedies where no motion is feasible."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import partial
from typing import Final

from hil.base.errors import UnsafeError
from hil.cell import AngleFrame
from hil.control.messages import fixed_words, violation_text
from hil.control.motion_checks import fixed_distance
from hil.control.motion_refusals import FixedDistance
from identification import excitation
from identification.model.kinematics import Chain

from .settings import DesignSettings


def criteria_text(measures: Iterable[float], n_parameters: int | None = None) -> str:
    """Return values of `CRITERIA` as text, with the largest ones for a number of parameters."""
    parts = []
    for criterion, value in zip(excitation.CRITERIA.values(), measures, strict=True):
        text = f"{criterion.label} {value:.{criterion.decimals}f}"
        if n_parameters is not None and criterion.largest is not None:
            text += f" of {criterion.largest(n_parameters):.0f}"
        parts.append(text)
    return ", ".join(parts)


_REMEDIES: Final = {
    "collision": "restrict via points to the middle of the joint ranges ([campaign] range_share of "
    "the cell, e.g. 0.5; [via_points] range_share of settings), use another mean posture of sines "
    "([sines] offset), or check floor, walls, margin and home",
    "current": "allow slower motions ([via_points] slowest, [sines] fastest), or check current "
    "limits and uncertainty of the cell",
    "torque": "allow slower motions ([via_points] slowest, [sines] fastest)",
    "planning": "use another fly, or fewer via points",
    "duration": "allow more or less time ([constraints] max_duration, min_duration), or change "
    "number and speed of the via points ([via_points] n_via, slowest)",
    "joint limit": "use longer ramps or lower frequencies ([sines] ramp, fastest)",
}


class NoExcitationError(UnsafeError):
    """No evaluated motion of a design satisfies all constraints."""


def no_excitation(
    error: excitation.NoFeasibleMotionError,
    frame: AngleFrame,
    checker: excitation.CollisionChecker | None,
    settings: DesignSettings,
    chain: Chain | None = None,
) -> NoExcitationError:
    """Return the error of a search without a result, with violations and remedies.

    Args:
        error: of the search.
        frame: of the angles.
        checker: of collisions.
        settings: of the search.
        chain: of the arm; one of several arms is advised to be designed for one.
    """
    contact = error.nearest.get("collision")
    fixed = None if contact is None or checker is None else fixed_distance(contact, checker)
    of_arms = None if chain is None else advice_on_branches(chain)
    advice = "; ".join([*filter(None, [of_arms]), *_advice(error, settings, fixed)])
    text = infeasible_text(error, frame)
    return NoExcitationError(f"{text}. Possible changes: {advice}" if advice else text)


def infeasible_text(error: excitation.NoFeasibleMotionError, frame: AngleFrame) -> str:
    """Return the message of an error with angles in a frame."""
    return error.sentence(partial(violation_text, frame=frame))


def advice_on_branches(chain: Chain) -> str | None:
    """Return how one arm of several is designed for; None if the joints form a single chain."""
    parents = set(chain.parents.tolist())
    ends = [joint for joint in range(chain.n_joints) if joint not in parents]
    if len(ends) < 2:
        return None
    branches = [_branch(chain, end) for end in ends]
    longest = max(branches, key=len)
    others = [name for k, name in enumerate(chain.joint_names) if k not in longest]
    fixing = " ".join(f"--fix {name}" for name in others)
    last = ", ".join(chain.joint_names[end] for end in ends)
    return (
        f"the {chain.n_joints} joints form {len(ends)} arms, with the last joints {last}: move "
        f"one arm at a time, with a cell in which the other joints are fixed (`hil new --urdf "
        f"ARM.urdf {fixing}`)"
    )


def _branch(chain: Chain, end: int) -> set[int]:
    """Return the joints from the base to one of them."""
    joints: set[int] = set()
    joint = end
    while joint >= 0:
        joints.add(joint)
        joint = int(chain.parents[joint])
    return joints


def _advice(
    error: excitation.NoFeasibleMotionError, settings: DesignSettings, fixed: FixedDistance | None
) -> Iterator[str]:
    """Yield remedies for the constraints that exclude more than half, or most, of the motions."""
    kinds = sorted(error.rejected, key=lambda kind: -error.rejected[kind])
    ruling = [kind for kind in kinds if 2 * error.rejected[kind] > error.tried]
    for kind in ruling or kinds[:1]:
        collides = fixed if kind == "collision" else None
        yield _REMEDIES[kind] if collides is None else fixed_words(collides)
    if error.unexciting:
        more = "via points" if settings.sines is None else "harmonics, or a longer motion,"
        yield f"use more {more} or fewer parameters ([objective] parameters)"
