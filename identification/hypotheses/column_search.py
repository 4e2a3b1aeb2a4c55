"""Changes of recordings that are linear in columns of torque, and predict parts of them better.

Delay, scale, friction, spring and drift of a joint, friction by the load, a load, and some of these
in a part of the recordings only. The torque of every fifth block is predicted from the others, as
it is and with one change after the other. The change that reduces the error most is named if the
reduction is significant and explains the error of the fit: what is left is near the noise, near the
error of the other joints, or near that of separate parameters for the part. The search is repeated
with it.

What was found in a part is certain only if nothing else explains it as well (another change of the
part, a load with one, friction that drifts), and if the part is then predicted as well as the rest.

The functions below stand in the order of the search; `column_candidates` lists what is tried,
`column_fit` scores it, and `part_rivals` looks for what contradicts it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Final, NamedTuple

from identification.arrays import Array
from identification.hypotheses.column_candidates import changes_to_try
from identification.hypotheses.column_fit import ColumnFit
from identification.hypotheses.column_scores import (
    ALIKE_ERROR_RATIO,
    ColumnScore,
    fit_ratio,
    rough_size,
    separate_errors,
)
from identification.hypotheses.explanation import ExplainedFit, Explanation
from identification.hypotheses.joint_changes import Change, Part
from identification.hypotheses.part_rivals import excess_of, rivals_of, springs_alike
from identification.hypotheses.torque_columns import BLOCKS
from identification.model.robot import RobotModel
from identification.signals.samples import Samples

UNSEEN: Final = "unseen motion"
"""What a model is tested on if it is another motion than the fitted one."""
_MIN_ERROR_REDUCTION: Final = 0.1  # relative reduction of the error by a significant change
_MIN_PAYLOAD_SIGMAS: Final = 2.0  # standard deviations of a payload that is one
_MAX_CHANGES: Final = 4  # changes


def find_columns(
    model: RobotModel, recordings: Sequence[Samples], fitted: ExplainedFit
) -> tuple[Explanation, ...]:
    """Find changes of fitted recordings, or of parts of them, that explain their errors."""
    fit, found = _found(ColumnFit.of(model, recordings, fitted), _MAX_CHANGES)
    return tuple(_without_contradicted([*_reviewed(fit, found)]))


def find_columns_of_unseen(
    model: RobotModel, seen: Sequence[Samples], unseen: Sequence[Samples], fitted: ExplainedFit
) -> tuple[Explanation, ...]:
    """Find a change that begins within unseen recordings.

    Args:
        model: of the arm.
        seen: recordings that have none.
        unseen: recordings in which one may begin.
        fitted: fit of the seen ones, with their names.
    """
    names = [fitted.name_of(recording) for recording in range(len(seen))]
    several = len(unseen) > 1
    names += [f"{UNSEEN} ({k + 1})" if several else UNSEEN for k in range(len(unseen))]
    recordings = [*seen, *unseen]
    blocks = BLOCKS * len(recordings)
    fit = ColumnFit.of(
        model, recordings, replace(fitted, names=names), seen=len(seen), blocks=blocks
    )
    fit, found = _found(fit, 1)
    return tuple(_without_contradicted([*_reviewed(fit, found)]))


# The search: one change after the other


def _found(fit: ColumnFit, most: int) -> tuple[ColumnFit, list[Explanation]]:
    """Return the recordings with the changes found in them, and these, one after the other."""
    found: list[Explanation] = []
    while len(found) < most and (trial := _best(_trials(fit))) is not None:
        change = trial.explanation.change
        if most > 1 and (pair := _load_and_scale(fit, trial.explanation)) is not None:
            fit, load, scale = pair
            fit = fit.knowing([*fit.known, load.change])
            found += [load, scale]
            continue
        found.append(fit.sized(trial.explanation, trial.values))
        if change.meaning in ("arm", "drift"):
            break  # separate parameters leave nothing to compare, a drift what is not linear
        fit = fit.knowing([*fit.known, change])
    return fit, found


class _Trial(NamedTuple):
    """A change, tried."""

    explanation: Explanation
    highest: float  # upper limit of its ratio
    coefficients: int  # added coefficients
    values: Array  # parameters (p,) fitted with it
    explains: bool  # whether it explains the error of the fit

    @property
    def is_better(self) -> bool:
        """Whether it reduces the error significantly, and explains it."""
        return (
            self.explains
            and self.explanation.ratio < 1.0 - _MIN_ERROR_REDUCTION
            and self.highest < 1.0
        )


def _trials(fit: ColumnFit) -> Iterator[_Trial]:
    """Try each change."""
    separate: dict[Part, ColumnScore | None] = {}
    for change in changes_to_try(fit):
        of_part = None
        if change.part is not None:
            if change.part not in separate:
                separate[change.part] = _separate(fit, change.part)
            of_part = separate[change.part]
            if of_part is None:
                continue
        if (trial := _tried(fit, change, of_part)) is not None:
            yield trial


def _separate(fit: ColumnFit, part: Part) -> ColumnScore | None:
    """Return the score of separate parameters of a part, None if they hardly fit better.

    All that may have changed in the part is within them.
    """
    arm = Change("arm", part=part)
    score = fit.score(arm) if fit.known else None
    if score is None:  # the two sides have nothing in common: a tenth of the time
        mask = fit.tables.mask_of(arm)
        fitted = separate_errors(fit.tables, fit.tables.torques, mask)
    else:
        fitted = score.fitted
    if fit_ratio(fitted, fit.usual.fitted) > 1.0 - _MIN_ERROR_REDUCTION:
        return None
    return fit.score(arm) if score is None else score


def _tried(fit: ColumnFit, change: Change, separate: ColumnScore | None) -> _Trial | None:
    """Return a change with its score, None if the recordings cannot have it.

    Args:
        fit: without the change.
        change: to be tried.
        separate: score of separate parameters of its part.
    """
    added = fit.columns(change)
    if not added.any():
        return None  # such as friction of a frictionless joint
    score = fit.score(change)
    size, std = rough_size(change, score, fit.tables)
    if change.meaning == "load friction" and (size or 0.0) <= 0.0:
        return None  # friction dissipates
    is_load = change.meaning == "payload" and size is not None
    if is_load and abs(size or 0.0) < _MIN_PAYLOAD_SIGMAS * std:
        return None  # the interval of its mass contains zero
    ratio, highest = score.ratio_to(fit.usual)
    explains = score.explains(change.joints, fit.usual, fit.noise, separate)
    found = Explanation(change, ratio, size, std)
    return _Trial(found, highest, added.shape[3], score.values.mean(axis=0), explains)


def _best(trials: Iterator[_Trial]) -> _Trial | None:
    """Return the significant trial of least error, with few coefficients preferred."""
    better = [trial for trial in trials if trial.is_better]
    least = min((trial.explanation.ratio for trial in better), default=0.0)
    alike = [trial for trial in better if trial.explanation.ratio <= ALIKE_ERROR_RATIO * least]
    return min(alike, key=lambda trial: (trial.coefficients, trial.explanation.ratio), default=None)


def _load_and_scale(
    fit: ColumnFit, found: Explanation
) -> tuple[ColumnFit, Explanation, Explanation] | None:
    """Return a load in a part and the scale of a joint, if they explain more than was found.

    Where the torque of a joint has another scale, a load alone leaves its error, or is a wrong one,
    and other scales or parameters of the part imitate both. What is left is searched in the first
    of the returned, with the scale undone.
    """
    if found.change.part is None:
        return None
    load = Change("payload", part=found.change.part)
    separate = fit.score(Change("arm", part=found.change.part))
    of_load = fit.score(load)
    is_arm = found.change.meaning == "arm"  # which has many more coefficients
    least = (ALIKE_ERROR_RATIO if is_arm else 1.0 - _MIN_ERROR_REDUCTION) * found.ratio
    best: tuple[Change, float, float] | None = None
    for joint in fit.moved:
        scale = Change("scale", (joint,))
        both = fit.score(load, scale)
        ratio, highest = both.ratio_to(fit.usual)
        alone = both.ratio_to(fit.score(scale)), both.ratio_to(of_load)
        is_needed = all(each < 1.0 - _MIN_ERROR_REDUCTION and limit < 1.0 for each, limit in alone)
        explains = both.explains((), fit.usual, fit.noise, separate)
        if is_needed and explains and highest < 1.0 and ratio < least:
            least = ratio
            best = scale, alone[0][0], alone[1][0]
    if best is None:
        return None
    scale, ratio_of_load, ratio_of_scale = best
    undone, size, std = fit.without_scale(scale, load)
    of_load_alone = undone.sized(Explanation(load, ratio_of_load))
    return undone, of_load_alone, Explanation(scale, ratio_of_scale, size, std)


# The review: each change given all others


def _reviewed(fit: ColumnFit, found: Sequence[Explanation]) -> Iterator[Explanation]:
    """Yield what was found with its size given all others, and what contradicts one of a part."""
    changes = [each.change for each in found]
    for k, each in enumerate(found):
        given = fit.knowing(changes[:k] + changes[k + 1 :])
        part = each.change.part
        if part is None:
            yield _given_others(given, each)._replace(rivals=springs_alike(given, each))
            continue
        score = given.score(each.change)
        if given.known:
            each = given.sized(each, score.values.mean(axis=0))
        rivals = rivals_of(given, each, score)
        yield each._replace(rivals=rivals, excess=excess_of(given, part, score))


def _given_others(fit: ColumnFit, found: Explanation) -> Explanation:
    """Return what was found throughout, with its size given all others.

    The size of the first is otherwise that without those found later.
    """
    is_undone = fit.recordings is not fit.recorded  # a scale, whose size was found with it
    if not fit.known or is_undone or found.size is None:
        return found
    return fit.sized(found, fit.score(found.change).values.mean(axis=0))


def _without_contradicted(found: Sequence[Explanation]) -> Iterator[Explanation]:
    """Yield what was found, without what rests on an uncertain change of a part.

    All that is in a part is as uncertain as one of it: it is named as `others` of that one. What
    was found after it, and is throughout or uncertain as well, is left out.
    """
    of_parts = [each for each in found if each.change.part is not None]
    uncertain = next((each for each in of_parts if not each.is_certain), None)
    if uncertain is None:
        yield from found
        return
    part = uncertain.change.part
    first = next(k for k, each in enumerate(found) if each.change.part == part)
    yield from found[:first]
    others = [each.change for each in found[first:] if each.change.part in (None, part)]
    others.remove(uncertain.change)
    rivals = tuple(
        (*rival, *(each for each in others if not _contains(rival, each)))
        for rival in uncertain.rivals
    )
    yield uncertain._replace(others=tuple(others), rivals=rivals)
    yield from (
        each for each in found[first:] if each.change.part not in (None, part) and each.is_certain
    )


def _contains(changes: Sequence[Change], other: Change) -> bool:
    """Return whether a friction is part of one of some changes, or a constant in place of it."""
    if other.meaning == "friction":
        return any(
            each.meaning.startswith("friction")
            and {*other.joints} <= {*(each.joints or other.joints)}
            for each in changes
        )
    return other.part is None and any(
        each.part is None and each.meaning == other.meaning for each in changes
    )
