"""What contradicts a change that was found: other explanations, and errors that remain."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.distributions import SIGNIFICANT_SIGMAS
from identification.hypotheses.column_candidates import JOINT_MEANINGS
from identification.hypotheses.column_fit import ColumnFit
from identification.hypotheses.column_scores import (
    ALIKE_ERROR_RATIO,
    SEPARATE_ERROR_RATIO,
    ColumnScore,
)
from identification.hypotheses.error_ratios import mean_and_error
from identification.hypotheses.explanation import Explanation
from identification.hypotheses.joint_changes import Change, Part

_MOST_RIVALS: Final = 3  # that are named

Rival = tuple[Change, ...]


def rivals_of(fit: ColumnFit, found: Explanation, score: ColumnScore) -> tuple[Rival, ...]:
    """Return changes that explain a part as well as one, or several at once that explain more.

    Args:
        fit: knows all other changes that were found.
        found: change of the part.
        score: with it.
    """
    return _other_changes(fit, found, score) or _other_constants(fit, found)


def springs_alike(fit: ColumnFit, found: Explanation) -> tuple[Rival, ...]:
    """Return the spring of a joint that explains as much as another torque constant of it.

    Args:
        fit: knows all other changes that were found.
        found: change of whole recordings.
    """
    if not found.change.is_constant:
        return ()
    spring = Change("spring", found.change.joints)
    if not fit.columns(spring).any():
        return ()
    ratio, _ = fit.score(spring).ratio_to(fit.score(found.change))
    return ((spring,),) if ratio <= ALIKE_ERROR_RATIO else ()


def _other_changes(fit: ColumnFit, found: Explanation, score: ColumnScore) -> tuple[Rival, ...]:
    """Return single changes that explain as much, else pairs that explain significantly more.

    Or pairs with another size of what was found. All parameters explain the most: their rivals,
    also pairs, explain as much.
    """
    is_arm = found.change.meaning == "arm"
    if is_arm and _may_be_unmodelled(fit, score):
        return ((Change("unmodelled"),),)
    alike = SEPARATE_ERROR_RATIO if is_arm else ALIKE_ERROR_RATIO
    for rivals in _possible_rivals(fit, found.change):
        ratios: dict[Rival, float] = {}
        for rival in rivals:
            both = fit.score(*rival)
            ratio, highest = both.ratio_to(score)
            is_rival = ratio <= alike
            if len(rival) > 1 and not is_arm:
                is_rival = ratio * alike < 1.0 and (
                    highest < 1.0 or _has_another_size(fit, found, rival, both)
                )
            if is_rival:
                ratios[rival] = ratio
        if ratios:  # of pairs, one of which is enough
            return tuple(sorted(ratios, key=ratios.__getitem__)[:_MOST_RIVALS])
    return ()


def _possible_rivals(fit: ColumnFit, change: Change) -> tuple[list[Rival], list[Rival]]:
    """Return other changes of a part, and pairs of them."""
    load = Change("payload", part=change.part)
    of_joints = [
        Change(meaning, joints, part=change.part)
        for meaning in JOINT_MEANINGS
        for joints in [(), *((joint,) for joint in fit.moved)]
        if joints or meaning == "friction"
    ]
    drift = Change("friction drift", fit.moved)
    singles: list[Rival] = [(each,) for each in (load, *of_joints, drift) if each != change]
    throughout = [Change("scale", (joint,)) for joint in fit.moved]
    pairs: list[Rival] = [(load, each) for each in (*of_joints, *throughout)]
    if change.meaning in JOINT_MEANINGS:
        pairs += [(change, each) for each in of_joints if each != change]
    return singles, pairs


def _may_be_unmodelled(fit: ColumnFit, score: ColumnScore) -> bool:
    """Return whether parameters of a part may fit what the model lacks.

    Other motions show it with other parameters. The parameters of another arm explain most of an
    error that is more than noise.
    """
    is_noise = fit.usual.is_near_noise(fit.noise)
    return is_noise or not score.explains((), fit.usual, fit.noise, None)


def _other_constants(fit: ColumnFit, found: Explanation) -> tuple[Rival, ...]:
    """Return scales of other joints throughout that fit alike, with another size of a part."""
    rivals: list[Rival] = []
    for constant in fit.known:
        if constant.meaning != "scale" or constant.part is not None:
            continue
        without = fit.knowing([each for each in fit.known if each != constant]).as_recorded()
        one = without.score(found.change, constant)
        for joint in fit.moved:
            other = constant._replace(joints=(joint,))
            if other in fit.known:
                continue
            rival = (found.change, other)
            both = without.score(*rival)
            is_alike = both.ratio_to(one)[0] <= ALIKE_ERROR_RATIO
            if is_alike and _has_another_size(without, found, rival, both):
                rivals.append(rival)
    return tuple(rivals[:_MOST_RIVALS])


def _has_another_size(fit: ColumnFit, found: Explanation, rival: Rival, score: ColumnScore) -> bool:
    """Return whether a size, in a set of changes, is outside the intervals of each other."""
    if found.size is None or found.change not in rival:
        return False
    for each in rival:
        if each.meaning == "scale" and each.part is None and found.change.meaning == "payload":
            fit, _, _ = fit.without_scale(each, found.change)  # of the torque of the load as well
        elif each != found.change:
            fit = fit.knowing([*fit.known, each])
    other = fit.sized(found, score.values.mean(axis=0))
    if other.size is None:
        return True
    reach = math.hypot(found.half_interval, other.half_interval)
    return abs(other.size - found.size) > reach


def excess_of(fit: ColumnFit, part: Part, score: ColumnScore) -> float:
    """Return the ratio of a part's error to the other blocks' error, 1.0 if not significant.

    It is compared as it is, and as a share of the torque, with which noise may grow.
    """
    tables = fit.tables
    inside = tables.mask_of(Change("arm", part=part)) > 0.0
    torque = tables.torques[:, :, None]
    power = (np.swapaxes(torque, 1, 2) @ tables.gram @ torque)[..., 0, 0]
    return min(
        _excess(score.squares, usual, inside) for usual in (tables.rows.astype(float), power)
    )


def _excess(squares: Array, usual: Array, inside: NDArray[np.bool_]) -> float:
    """Return the ratio of errors inside a part and outside it, 1.0 if not significant.

    Args:
        squares: squared errors (B, n).
        usual: what they are in proportion to (B, n).
        inside: the blocks of the part (B,).
    """
    tested = (squares > 0.0) & (usual > 0.0)
    joints = tested[inside].any(axis=0) & tested[~inside].any(axis=0)
    tested = tested[:, joints]
    blocks = tested.any(axis=1)
    levels = np.full(tested.shape, np.nan)
    levels[tested] = 0.5 * np.log(squares[:, joints][tested] / usual[:, joints][tested])
    if not joints.any():
        return 1.0
    levels -= np.nanmean(levels, axis=0)
    means = np.nanmean(levels[blocks], axis=1)
    (mean, error), (rest, rest_error) = (
        mean_and_error(means[which]) for which in (inside[blocks], ~inside[blocks])
    )
    is_more = mean - rest > SIGNIFICANT_SIGMAS * math.hypot(error, rest_error)
    return math.exp(mean - rest) if is_more else 1.0
