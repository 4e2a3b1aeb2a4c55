"""Other readings of a recording: sign, order, unit and zero of its joints, gravity in its torque.

Changes are tried and compared by :mod:`identification.hypotheses.hypothesis`. Parameters have the
prior of :mod:`identification.estimators.prior`, so that geometry alone is enough and masses help
where they are known. Among readings that predict alike, one in which friction takes energy from
every joint comes first. The best reading is adopted if it is significant, and the search is
repeated with it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Final

from identification.hypotheses.gravity_share import has_part_of_gravity
from identification.hypotheses.hypothesis import SAME_SIZE_TOLERANCE, Hypothesis
from identification.hypotheses.joint_changes import (
    GRAVITIES,
    SIGNS,
    SIZED,
    UNITS,
    Axes,
    Change,
)
from identification.hypotheses.joint_fit import (
    position_scales,
)
from identification.hypotheses.mirror_images import SignRival
from identification.hypotheses.readings import Adequacy, Readings, Step, is_disputed
from identification.hypotheses.scores import (
    EXPLAINED_ERROR,
    LARGE_REDUCTION,
    any_load,
    compare,
    fits_alike,
    score_of,
)
from identification.model.robot import RobotModel
from identification.signals.samples import Samples

_MAX_ROWS: Final = 700


def find_readings(
    model: RobotModel,
    samples: Samples,
    *,
    mountings: Mapping[str, RobotModel] | None = None,
    unit_is_open: bool = True,
    with_nearest: bool = True,
    is_explained: bool = False,
) -> Readings:
    """Find how samples of one recording are to be read.

    Args:
        model: of the arm.
        samples: of the recording.
        mountings: models with another gravity, by name ("" without gravity).
        unit_is_open: whether nothing states the unit of the positions.
        with_nearest: whether to return also what comes nearest to the reading found, and which
            zeros the torque does not show; a quarter of the time where nothing is to be changed.
        is_explained: whether something else, such as a low-pass, explains most of the error: then
            changes are tried one by one only. To search signs together with zeros and scales takes
            longest, and they would fit by chance.
    """
    few = samples.thinned_to(_MAX_ROWS)
    hypothesis = Hypothesis(model, few, mountings or {}, unit_is_open=unit_is_open)
    hypothesis, steps = _searched(hypothesis, is_explained=is_explained)
    hypothesis, steps, no_better = _without_chance(hypothesis, steps)
    if not steps and not unit_is_open and not with_nearest:
        return Readings(
            (), hypothesis.model, hypothesis.samples, hypothesis.score, {}, no_better=no_better
        )
    rivals = _fewest_signs(hypothesis, steps)
    hypothesis, steps = _signs_together(hypothesis, steps)
    steps = _without_adopted(steps)
    # What a change explains shows only together with the others.
    steps = [
        step if step.alike else replace(step, error=hypothesis.score.overall) for step in steps
    ]
    found = Readings(
        steps=tuple(steps),
        model=hypothesis.model,
        samples=hypothesis.samples,
        score=score_of(hypothesis.model, hypothesis.samples, hypothesis.score.columns),
        nearest=hypothesis.nearest() if with_nearest else {},
        unseen_zeros=hypothesis.unseen_zeros() if with_nearest else (),
        adequacy=hypothesis.adequacy(),
        rivals=rivals,
        no_better=no_better,
        scales=position_scales(hypothesis.model, hypothesis.samples) if unit_is_open else None,
    )
    return replace(found, steps=tuple(_judged(hypothesis, found)))


def _searched(stated: Hypothesis, *, is_explained: bool) -> tuple[Hypothesis, list[Step]]:
    """Return the best hypothesis, and its steps: one change after the other, then signs at once.

    Signs are tried together with zeros and scales, and all of them together, where a change is
    doubted or the arm does not explain the torque.
    """
    hypothesis, steps = _one_by_one(stated)
    if is_explained or (not steps and hypothesis.score.overall <= EXPLAINED_ERROR):
        return hypothesis, steps
    is_enough = hypothesis.adequacy().is_enough
    is_doubted = not is_enough or any(not step.sure or step.is_far for step in steps)
    if is_doubted:
        hypothesis, steps = _with_a_sign(hypothesis, steps)
    if is_doubted or (_has_signs(steps) and len(steps) > 1):
        hypothesis, steps = _with_signs(hypothesis, steps)
    return hypothesis, steps


def _has_signs(steps: Sequence[Step]) -> bool:
    return any(step.change.meaning in SIGNS for step in steps)


def _fewest_signs(hypothesis: Hypothesis, steps: Sequence[Step]) -> tuple[SignRival, ...]:
    """Adopt the mirror image with the fewest changed signs; return the other images."""
    rivals = hypothesis.sign_rivals()
    if _has_signs(steps) and rivals:
        fewest = rivals[0]
        if len(fewest.signs.changes) < len(hypothesis.signs.changes):
            hypothesis.change([Change("axis sign", fewest.flipped)])
            return hypothesis.sign_rivals()
    return rivals


def _judged(hypothesis: Hypothesis, found: Readings) -> list[Step]:
    """Return the steps that were found, each adequate if nothing else explains the rows alike."""
    steps = hypothesis.with_springs(found.steps)
    if steps and (_is_better_without(hypothesis) or _is_load(hypothesis, found)):
        steps = [replace(step, is_adequate=False) for step in steps]
    if not found.adequacy.is_enough:
        steps = _doubted(steps, hypothesis)
    doubted = [step for step in steps if not step.sure]
    steps = [  # each was chosen together with the others
        step if doubted in ([], [step]) else replace(step, is_adequate=False) for step in steps
    ]
    if any(step.change.meaning == "no gravity" for step in steps) and has_part_of_gravity(
        hypothesis.restarted().model, hypothesis.samples, found.score
    ):
        steps = [replace(step, is_adequate=False) for step in steps]
    has_other_scales = found.scales is not None and bool(found.scales.other)
    return [
        replace(step, is_adequate=False)
        if is_disputed(step, hypothesis.signs, found.rivals)
        or (has_other_scales and step.change.meaning in SIZED)  # which may imitate them
        else step
        for step in steps
    ]


def _without_chance(
    hypothesis: Hypothesis, steps: list[Step]
) -> tuple[Hypothesis, list[Step], tuple[Change, ...]]:
    """Return a hypothesis without changes that are not better than none, and these changes.

    Where several changes fit alike, a recording without any of them is one more that may: the best
    of many explains some of what no change explains.
    """
    open_steps = [step for step in steps if step.alike]
    if not open_steps:
        return hypothesis, steps, ()
    rest = [step for step in steps if not step.alike]
    without = hypothesis.restarted([step.change for step in rest])
    drives_more = without.score.driven.sum() > hypothesis.score.driven.sum()
    if drives_more or compare(hypothesis.score, without.score, hypothesis.model).is_better:
        return hypothesis, steps, ()
    alike = (pair[0] for step in open_steps for pair in step.alike)
    no_better = dict.fromkeys([*(step.change for step in open_steps), *alike])
    return without, rest, tuple(no_better)


def _with_signs(found: Hypothesis, steps: list[Step]) -> tuple[Hypothesis, list[Step]]:
    """Return a hypothesis with signs of all joints chosen at once, or the found one if better.

    One after the other leads astray where several are wrong.
    """
    tried = []
    for signs in found.restarted().best_signs():
        if signs.changes == found.signs.changes:
            continue
        hypothesis = found.restarted(signs.changes)
        tried.append((hypothesis, hypothesis.by_joint_fit(())))
    if not tried:
        return found, steps
    best, more = min(tried, key=lambda each: each[0].score.overall)
    is_alike = fits_alike(best.score, found.score, found.model)
    is_better = compare(best.score, found.score, found.model).is_much_better
    count = len(best.signs.changes) + len(more), sum(step.is_far for step in more)
    is_simpler = count < (len(steps), sum(step.is_far for step in steps))
    if not is_better and not (is_alike and is_simpler):
        return found, steps
    chosen = best.signs.changes
    others = best.more_steps()
    return best, [*_sign_steps(best, chosen), *more, *others]


def _sign_steps(hypothesis: Hypothesis, signs: Sequence[Change]) -> list[Step]:
    """Return the steps of signs, each compared with all but it."""
    before = hypothesis.restarted().score.overall
    steps = []
    for sign in signs:
        without = hypothesis.restarted([each for each in hypothesis.changes if each != sign])
        ratio, sigmas, _ = compare(hypothesis.score, without.score, hypothesis.model)
        steps.append(Step(sign, hypothesis.score.overall, before, ratio, sigmas))
    return steps


def _signs_together(hypothesis: Hypothesis, steps: list[Step]) -> tuple[Hypothesis, list[Step]]:
    """Return a hypothesis with one change of the sign for each joint; several may cancel."""
    signs = hypothesis.signs.changes
    adopted = [change for change in hypothesis.changes if change.meaning in SIGNS]
    if len(signs) == len(adopted) and {*signs} == {*adopted}:
        return hypothesis, steps
    axes = Axes.of(hypothesis.changes, hypothesis.model.n_joints)
    others = [step for step in steps if step.change.meaning not in SIGNS]
    sized = []
    for step in others:
        change = step.change
        if change.meaning == "zero":  # one adopted before a sign is negated by it
            (joint,) = change.joints
            change = change._replace(size=float(axes.zero[joint]))
        sized.append(replace(step, change=change))
    first = [step for step in sized if step.change.meaning not in SIZED]
    last = [step for step in sized if step.change.meaning in SIZED]
    again = hypothesis.restarted(
        [step.change for step in first] + [*signs] + [step.change for step in last]
    )
    known = {step.change: step for step in steps}
    new = [known.get(step.change, step) for step in _sign_steps(again, signs)]
    return again, [*first, *new, *last]


def _without_adopted(steps: Sequence[Step]) -> list[Step]:
    """Return steps without alternatives that another step adopted in addition."""
    adopted = [step.change for step in steps]
    return [
        replace(step, alike=tuple(each for each in step.alike if each[0] not in adopted))
        for step in steps
    ]


def _one_by_one(hypothesis: Hypothesis) -> tuple[Hypothesis, list[Step]]:
    """Adopt changes one after the other, then zeros and scales of all joints together."""
    as_recorded = hypothesis.tried()
    steps = hypothesis.more_steps()
    if len(steps) > 1:
        again = hypothesis.restarted()
        single = again.single_as_good_as(hypothesis.score, as_recorded)
        if single is not None:
            hypothesis = again
            steps = [single]
    if sized := [step for step in steps if step.change.meaning in SIZED]:
        # Found one after the other: now all at once, on the others.
        others = [step for step in steps if step not in sized]
        again = hypothesis.restarted([step.change for step in others])
        if joint_steps := again.by_joint_fit(sized):
            hypothesis = again
            steps = [*others, *joint_steps]
    return hypothesis, steps


def _with_a_sign(found: Hypothesis, steps: list[Step]) -> tuple[Hypothesis, list[Step]]:
    """Return a hypothesis with a sign and fitted zeros and scales, or the found one if better.

    One after the other, neither need lessen the error: a joint whose sign is wrong has no zero that
    fits, and one whose zero is wrong no sign. Where both fit alike, no step is adequate.
    """
    tried = list(_signed(found))
    if not tried:
        return found, steps
    change, best, more = min(tried, key=lambda each: each[1].score.overall)
    is_alike = fits_alike(best.score, found.score, found.model)
    is_better = compare(best.score, found.score, found.model).is_much_better
    if not is_better and not (is_alike and len(more) + 1 < len(steps)):
        is_other = is_alike and not _contains([step.change for step in more], steps)
        if not is_other or any(step.change == change for step in steps):
            return found, steps
        return found, [replace(step, is_adequate=False) for step in steps]
    before = found.restarted()
    without = found.restarted([step.change for step in more])
    alone = compare(best.score, without.score, found.model)
    is_alone = not any(
        other != change and fits_alike(again.score, best.score, found.model)
        for other, again, _ in tried
    )
    sign = Step(
        change,
        best.score.overall,
        before.score.overall,
        alone.ratio,
        alone.sigmas,
        is_adequate=is_alone,
    )
    return best, [sign, *more, *best.more_steps()]


def _contains(changes: Sequence[Change], steps: Sequence[Step]) -> bool:
    """Return whether all of some steps are among changes, about of the same size."""
    return all(
        any(
            change[:2] == step.change[:2]
            and abs(change.size - step.change.size) < SAME_SIZE_TOLERANCE
            for change in changes
        )
        for step in steps
    )


def _signed(found: Hypothesis) -> Iterator[tuple[Change, Hypothesis, list[Step]]]:
    """Yield the signs that fit best with zeros and scales of all joints, and these steps."""
    for change in found.restarted().signs_by_joint_fit():
        again = found.restarted([change])
        yield change, again, again.by_joint_fit(())


def _is_better_without(found: Hypothesis) -> bool:
    """Return whether a free fit explains the rows much better without any change than with them.

    Such as a heavy load on the flange, which the masses of the description contradict, and which
    exchanged joints of a wrist imitate in a part.
    """
    return found.restarted().free_fit().ratio_to(found.free_fit()) < 1.0 - LARGE_REDUCTION


def _is_load(found: Hypothesis, readings: Readings) -> bool:
    """Return whether a load explains the rows as well as another gravity does.

    In slow motion, the torque of a light arm with a heavy load is that of the arm upside down.
    """
    gravities = [step for step in readings.steps if step.change.meaning in GRAVITIES]
    if not gravities:
        return False
    others = [step.change for step in readings.steps if step not in gravities]
    stated = found.restarted(others)
    loaded = score_of(
        stated.model, stated.samples, stated.score.columns, stated=any_load(stated.model)
    )
    return fits_alike(loaded, found.score, found.model)


def _doubted(steps: Sequence[Step], found: Hypothesis) -> list[Step]:
    """Return steps of a reading that a free fit explains much better, none of them adequate.

    A sign or an order still is if no free fit without it comes near.
    """
    if not steps:
        return []
    without = found.restarted().free_fit()
    is_beyond = found.stated_fit().ratio_to(without) < 1.0 - LARGE_REDUCTION
    return [
        replace(
            step,
            is_adequate=is_beyond
            and step.is_adequate
            and step.change.meaning not in (*SIZED, *UNITS),
        )
        for step in steps
    ]


def find_zeros_and_scales(model: RobotModel, samples: Samples) -> Readings:
    """Find zeros and scales of joints that are other than stated, with nothing else changed."""
    few = samples.thinned_to(_MAX_ROWS)
    hypothesis = Hypothesis(model, few, {}, unit_is_open=False)
    steps = hypothesis.by_joint_fit(())
    adequacy = hypothesis.adequacy() if steps else Adequacy(1.0, 1.0, agrees=True)
    steps = [replace(step, is_adequate=step.is_adequate and adequacy.is_enough) for step in steps]
    steps = hypothesis.with_springs(steps)
    return Readings(tuple(steps), model, hypothesis.samples, hypothesis.score, {}, (), adequacy)
