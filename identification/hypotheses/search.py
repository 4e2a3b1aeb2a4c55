"""Other readings of a recording: sign, order, unit and zero of its joints, gravity in its torque.

All readings are fitted to few rows first. For those of least error the torque of every fifth block
is predicted from the others, and the errors are compared block by block. Parameters have the prior
of :mod:`identification.estimators.prior`, so that geometry alone is enough and masses help where
they are known. Among readings that predict alike, those in which friction takes energy from every
joint come first. The best reading is adopted if it is significant, and the search is repeated with
it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product
from typing import Final

import numpy as np

from identification.arrays import Array
from identification.estimators.prior import TorqueSums, body_priors
from identification.factor.columns import every_torque_factor
from identification.factor.factor import MIN_NOISE, Factor
from identification.hypotheses.gravity_share import has_part_of_gravity
from identification.hypotheses.joint_changes import (
    AS_READ,
    COUPLED,
    DEGREE,
    GRAVITIES,
    ORDERS,
    SIGNS,
    SIZED,
    UNITS,
    Axes,
    Change,
    Meaning,
    alternatives_to,
    change_of_motion,
    changed_samples,
    coupled_pairs,
    differs,
    kind_of,
    mounted_model,
    order_change,
    whole_order,
)
from identification.hypotheses.joint_fit import (
    JointFit,
    PositionScales,
    candidates,
    find_joints,
    fit_joints,
    position_scales,
    starting_at,
)
from identification.hypotheses.little_torque import little_torque
from identification.hypotheses.mirror_images import SignRival, Signs, mirror_images
from identification.hypotheses.scores import (
    ROWS_PER_FACT,
    Comparison,
    Score,
    compare,
    friction_columns,
    inertial_torque,
    score_of,
    sigmas_of,
)
from identification.model.robot import RobotModel
from identification.signals.samples import Samples

SURE_SIGMAS: Final = 4.5
"""Standard errors over the blocks of a reading that is sure, whatever the number tried: with 19
degrees of freedom one of 4 000 exceeds it by chance."""
SEPARATE_SIGMAS: Final = 3.0
"""Standard errors by which the second best reading is worse."""
EXPLAINED_ERROR: Final = 0.15
"""Error of the torque above which no reading is sure: the arm does not explain the torque."""
_LARGE_REDUCTION: Final = 0.15  # relative reduction of the error that chance alone does not make
_MIN_ERROR_REDUCTION: Final = 0.02  # relative reduction of the error of a reading that is adopted
_ALIKE_REDUCTION: Final = 0.05  # the same, of readings that fit alike
_MAX_JOINT_ERROR_RATIO: Final = 1.1  # error ratio of a joint beyond which a reading spoils it
_HALVED_ERROR_RATIO: Final = 0.5  # error ratio over all joints from which it may
_MAX_ROWS: Final = 700
_FIRST_TRIAL_ROWS: Final = 250  # on which all readings are tried first
# Of the search for an order: as read, then at random until the best order is reached twice. From a
# third of the starts the right one is reached: ten miss it in 2 % of the cases.
_ORDER_STARTS: Final = 10
# error ratio of one exchange from which a whole order is searched for
_EXCHANGE_ERROR_RATIO: Final = 0.98
_COMPARED_ORDERS: Final = 2  # best orders of each kind that are compared
_COMPARED_CHANGES: Final = 12  # changes of least error on fewer rows, which are compared
_MAX_STEPS: Final = 6
_SAME_SIZE_TOLERANCE: Final = 0.3  # rad, or of a scale: difference of two fits that are one
# error ratio to a zero far away, of which no better fit is expected
_FAR_ZERO_ERROR_RATIO: Final = 0.5
_MIN_ZERO_SEPARATION: Final = 60.0 * DEGREE  # between two zeros that are not one
_FAR_ZERO_STARTS: Final = 2  # zeros far from what is stated at which a fit starts
_NEEDED_SIGMAS: Final = 2.0  # standard errors of one of several zeros and scales that its fit needs
_ADEQUATE_ERROR_RATIO: Final = 1.2  # error ratio to a free fit, of a reading that explains the rows
# The same of each joint, as a mean hides one that is not explained: of four joints that share one
# error the mean reaches 1.2 where that of one alone is 2.
_ADEQUATE_JOINT_ERROR_RATIO: Final = 2.0
# A joint turned by more than a right angle is nearer to its reverse, so that its sign and a nearer
# zero may look alike.
_FAR_ZERO: Final = 90.0 * DEGREE
# signs of least error, compared together with zeros and scales
_COMPARED_SIGNS: Final = 3
_MAX_NEGATED_JOINTS: Final = 8  # that move, up to which every combination of their signs is tried
_RIDGE: Final = 1e-6  # of the squares of a column, where others say the same
_FITS_AT_ONCE: Final = 24  # fits, so that their sums stay in the processor's cache
# deg, near which a fit starts
_START_ZEROS_DEGREES: Final = (-135.0, -90.0, -45.0, 45.0, 90.0, 135.0, 180.0)


@dataclass(frozen=True, eq=False)
class Trial:
    """A change, tried."""

    change: Change
    model: RobotModel
    samples: Samples
    score: Score
    against: Comparison  # with the reading before


@dataclass(frozen=True, eq=False)
class Step:
    """An adopted change, and the changes that fit equally well.

    `error` and `before` are errors over all joints with and without it; `alike` are other changes
    with their errors, of which only knowledge of the arm can choose.
    """

    change: Change
    error: float
    before: float
    ratio: float
    sigmas: float
    alike: tuple[tuple[Change, float], ...] = ()
    is_adequate: bool = True  # whether no free fit explains the rows much better

    @property
    def is_clear(self) -> bool:
        """Whether the arm explains the torque with it, and certainly worse without."""
        is_certain = not self.by_friction and self.sigmas < -SURE_SIGMAS
        return self.error < EXPLAINED_ERROR and is_certain

    @property
    def is_explained(self) -> bool:
        """Whether that is so, and no free fit explains the torque much better."""
        return self.is_clear and self.is_adequate

    @property
    def is_far(self) -> bool:
        """Whether it is a zero that no assembly has."""
        return self.change.meaning == "zero" and abs(self.change.size) > _FAR_ZERO

    @property
    def by_friction(self) -> bool:
        """Whether friction supports it, and the error little or not at all."""
        return self.ratio > 1.0 - _ALIKE_REDUCTION

    @property
    def sure(self) -> bool:
        """Whether nothing else fits alike, and the arm explains the torque as a free fit does.

        Friction, or a slightly smaller error, says it of a whole arm; of one joint a lag of the
        torque looks the same.
        """
        slight = self.ratio > 1.0 - _LARGE_REDUCTION and len(self.change.joints) == 1
        if self.change.meaning in SIZED:
            slight = self.sigmas > -SEPARATE_SIGMAS
        return not self.alike and self.error < EXPLAINED_ERROR and not slight and self.is_adequate


@dataclass(frozen=True)
class Adequacy:
    """How a reading compares with a free fit of the same rows.

    The free fit has any zero and scale of each joint, and hardly believes the masses of the URDF.

    Attributes:
        ratio: error with the reading over that of the free fit, mean over the joints.
        largest: of the joints.
        agrees: whether the free fit has the same zeros and scales.
    """

    ratio: float
    largest: float
    agrees: bool

    @property
    def is_enough(self) -> bool:
        """Whether the reading explains the rows about as well."""
        return (
            self.agrees
            and self.ratio < _ADEQUATE_ERROR_RATIO
            and self.largest < _ADEQUATE_JOINT_ERROR_RATIO
        )


@dataclass(frozen=True, eq=False)
class Readings:
    """How a recording is to be read.

    Attributes:
        steps: changes of what was recorded, in order.
        model: with the gravity that was found.
        samples: few rows, as read.
        score: of these.
        nearest: by meaning, the change that comes nearest to the reading found, compared with it.
        unseen_zeros: joints of which the torque shows no zero: others fit alike.
        adequacy: whether nothing else explains the rows much better.
        rivals: signs of the joints that explain the rows alike, fewest changes first.
        no_better: changes that fit best, by no more than chance: the recording is read without.
        scales: of the positions, where the numbers alone say their unit.
    """

    steps: tuple[Step, ...]
    model: RobotModel
    samples: Samples
    score: Score
    nearest: Mapping[Meaning, tuple[Change, Comparison]]
    unseen_zeros: tuple[int, ...] = ()
    adequacy: Adequacy = Adequacy(1.0, 1.0, agrees=True)
    rivals: tuple[SignRival, ...] = ()
    no_better: tuple[Change, ...] = ()
    scales: PositionScales | None = None

    @property
    def disputed_signs(self) -> tuple[Step, ...]:
        """The signs that were found, and are others where the rows are explained alike."""
        axes = Axes.of((step.change for step in self.steps), self.model.n_joints)
        signs = Signs.of(axes)
        return tuple(step for step in self.steps if _is_disputed(step, signs, self.rivals))


def find_readings(
    model: RobotModel,
    samples: Samples,
    *,
    mountings: Mapping[str, RobotModel] | None = None,
    unit_is_open: bool = True,
) -> Readings:
    """Find how samples of one recording are to be read.

    Args:
        model: of the arm.
        samples: of the recording.
        mountings: models with another gravity, by name ("" without gravity).
        unit_is_open: whether nothing states the unit of the positions.
    """
    few = _thinned(samples, _MAX_ROWS)

    def started(changes: Sequence[Change] = ()) -> _Search:
        search = _Search(model, few, mountings or {}, unit_is_open=unit_is_open)
        search.change(changes)
        return search

    search, steps = _one_by_one(started)
    adequacy = search.adequacy()
    is_doubted = not adequacy.is_enough or any(not step.sure or step.is_far for step in steps)
    if is_doubted and (steps or search.score.overall > EXPLAINED_ERROR):
        search, steps = _with_a_sign(started, search, steps)
    has_signs = any(step.change.meaning in SIGNS for step in steps)
    is_several = has_signs and len(steps) > 1
    if (is_doubted or is_several) and (steps or search.score.overall > EXPLAINED_ERROR):
        search, steps = _with_signs(started, search, steps)
    search, steps, no_better = _without_chance(started, search, steps)
    has_signs = any(step.change.meaning in SIGNS for step in steps)
    rivals = search.sign_rivals()
    if has_signs and rivals and len(rivals[0].signs.changes) < len(search.signs.changes):
        search.change([Change("axis sign", rivals[0].flipped)])
        rivals = search.sign_rivals()
    search, steps = _signs_together(started, search, steps)
    adequacy = search.adequacy()
    nearest = search.nearest()
    score = score_of(search.model, search.samples, search.score.columns)
    steps = _without_adopted(steps)
    # What a change explains shows only together with the others.
    steps = [step if step.alike else replace(step, error=search.score.overall) for step in steps]
    found = Readings(
        tuple(steps),
        search.model,
        search.samples,
        score,
        nearest,
        search.unseen_zeros(),
        adequacy,
        rivals,
        no_better,
        position_scales(search.model, search.samples) if unit_is_open else None,
    )
    return replace(found, steps=tuple(_judged(started, search, found)))


def _judged(started: Callable[..., _Search], search: _Search, found: Readings) -> list[Step]:
    """Return the steps that were found, each adequate if nothing else explains the rows alike."""
    steps = list(found.steps)
    if not found.adequacy.is_enough:
        steps = _doubted(steps, search, started())
    doubted = [step for step in steps if not step.sure]
    steps = [  # each was chosen together with the others
        step if doubted in ([], [step]) else replace(step, is_adequate=False) for step in steps
    ]
    if any(step.change.meaning == "no gravity" for step in steps) and has_part_of_gravity(
        started().model, search.samples, found.score
    ):
        steps = [replace(step, is_adequate=False) for step in steps]
    has_other_scales = found.scales is not None and bool(found.scales.other)
    return [
        replace(step, is_adequate=False)
        if _is_disputed(step, search.signs, found.rivals)
        or (has_other_scales and step.change.meaning in SIZED)  # which may imitate them
        else step
        for step in steps
    ]


def _without_chance(
    started: Callable[..., _Search], search: _Search, steps: list[Step]
) -> tuple[_Search, list[Step], tuple[Change, ...]]:
    """Return a hypothesis without changes that are not better than none, and these changes.

    Where several changes fit alike, a recording without any of them is one more that may: the best
    of many explains some of what no change explains.
    """
    open_steps = [step for step in steps if step.alike]
    if not open_steps:
        return search, steps, ()
    rest = [step for step in steps if not step.alike]
    without = started([step.change for step in rest])
    drives_more = without.score.driven.sum() > search.score.driven.sum()
    if drives_more or _is_better(compare(search.score, without.score, search.model)):
        return search, steps, ()
    alike = (pair[0] for step in open_steps for pair in step.alike)
    no_better = dict.fromkeys([*(step.change for step in open_steps), *alike])
    return without, rest, tuple(no_better)


def _is_disputed(step: Step, signs: Signs, rivals: Sequence[SignRival]) -> bool:
    """Return whether a step is of signs that are others where the rows are explained alike.

    So is the zero of a position that was negated, as its direction is.
    """
    joints = list(step.change.joints)
    is_of_negated = step.change.meaning == "zero" and bool((signs.position[joints] < 0.0).any())
    return (step.change.meaning in SIGNS or is_of_negated) and not all(
        signs.agrees(rival.signs, joints) for rival in rivals
    )


def _with_signs(
    started: Callable[..., _Search], found: _Search, steps: list[Step]
) -> tuple[_Search, list[Step]]:
    """Return a hypothesis with signs of all joints chosen at once, or the found one if better.

    One after the other leads astray where several are wrong.
    """
    first = started()
    tried = []
    for signs in first.best_signs():
        if signs.changes == found.signs.changes:
            continue
        search = started(signs.changes)
        tried.append((search, search.by_joint_fit(())))
    if not tried:
        return found, steps
    best, more = min(tried, key=lambda each: each[0].score.overall)
    against = compare(best.score, found.score, found.model)
    is_alike = (
        against.sigmas < SEPARATE_SIGMAS
        and best.score.overall < (1.0 + _ALIKE_REDUCTION) * found.score.overall
    )
    is_better = against.ratio < 1.0 - _LARGE_REDUCTION and against.sigmas < -SEPARATE_SIGMAS
    count = len(best.signs.changes) + len(more), sum(step.is_far for step in more)
    is_simpler = count < (len(steps), sum(step.is_far for step in steps))
    if not is_better and not (is_alike and is_simpler):
        return found, steps
    chosen = best.signs.changes
    others = best.more_steps()
    return best, [*_sign_steps(started, best, chosen), *more, *others]


def _sign_steps(
    started: Callable[..., _Search], search: _Search, signs: Sequence[Change]
) -> list[Step]:
    """Return the steps of signs, each compared with all but it."""
    before = started().score.overall
    steps = []
    for sign in signs:
        without = started([change for change in search.changes if change != sign])
        ratio, sigmas, _ = compare(search.score, without.score, search.model)
        steps.append(Step(sign, search.score.overall, before, ratio, sigmas))
    return steps


def _signs_together(
    started: Callable[..., _Search], search: _Search, steps: list[Step]
) -> tuple[_Search, list[Step]]:
    """Return a hypothesis with one change of the sign for each joint; several may cancel."""
    signs = search.signs.changes
    adopted = [change for change in search.changes if change.meaning in SIGNS]
    if len(signs) == len(adopted) and {*signs} == {*adopted}:
        return search, steps
    axes = Axes.of(search.changes, search.model.n_joints)
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
    again = started([step.change for step in first] + [*signs] + [step.change for step in last])
    known = {step.change: step for step in steps}
    new = [known.get(step.change, step) for step in _sign_steps(started, again, signs)]
    return again, [*first, *new, *last]


def _without_adopted(steps: Sequence[Step]) -> list[Step]:
    """Return steps without alternatives that another step adopted in addition."""
    adopted = [step.change for step in steps]
    return [
        replace(step, alike=tuple(each for each in step.alike if each[0] not in adopted))
        for step in steps
    ]


def _one_by_one(started: Callable[..., _Search]) -> tuple[_Search, list[Step]]:
    """Adopt changes one after the other, then zeros and scales of all joints together."""
    search = started()
    as_recorded = search.tried()
    steps = search.more_steps()
    if len(steps) > 1:
        again = started()
        single = again.single_as_good_as(search.score, as_recorded)
        if single is not None:
            search = again
            steps = [single]
    if sized := [step for step in steps if step.change.meaning in SIZED]:
        # Found one after the other: now all at once, on the others.
        others = [step for step in steps if step not in sized]
        again = started([step.change for step in others])
        if joint_steps := again.by_joint_fit(sized):
            search = again
            steps = [*others, *joint_steps]
    return search, steps


def _with_a_sign(
    started: Callable[..., _Search], found: _Search, steps: list[Step]
) -> tuple[_Search, list[Step]]:
    """Return a hypothesis with a sign and fitted zeros and scales, or the found one if better.

    One after the other, neither need lessen the error: a joint whose sign is wrong has no zero that
    fits, and one whose zero is wrong no sign. Where both fit alike, no step is adequate.
    """
    tried = list(_signed(started))
    if not tried:
        return found, steps
    change, best, more = min(tried, key=lambda each: each[1].score.overall)
    against = compare(best.score, found.score, found.model)
    is_alike = (
        against.sigmas < SEPARATE_SIGMAS
        and best.score.overall < (1.0 + _ALIKE_REDUCTION) * found.score.overall
    )
    is_better = against.ratio < 1.0 - _LARGE_REDUCTION and against.sigmas < -SEPARATE_SIGMAS
    if not is_better and not (is_alike and len(more) + 1 < len(steps)):
        is_other = is_alike and not _contains([step.change for step in more], steps)
        if not is_other or any(step.change == change for step in steps):
            return found, steps
        return found, [replace(step, is_adequate=False) for step in steps]
    before = started()
    without = started([step.change for step in more])
    alone = compare(best.score, without.score, found.model)
    is_alone = not any(
        other != change
        and compare(again.score, best.score, found.model).sigmas < SEPARATE_SIGMAS
        and again.score.overall < (1.0 + _ALIKE_REDUCTION) * best.score.overall
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
            and abs(change.size - step.change.size) < _SAME_SIZE_TOLERANCE
            for change in changes
        )
        for step in steps
    )


def _signed(started: Callable[..., _Search]) -> Iterator[tuple[Change, _Search, list[Step]]]:
    """Yield the signs that fit best with zeros and scales of all joints, and these steps."""
    fewer = started()
    fewer.samples = _thinned(fewer.samples, _FIRST_TRIAL_ROWS)
    for change in fewer.signs_by_joint_fit()[:_COMPARED_SIGNS]:
        again = started([change])
        yield change, again, again.by_joint_fit(())


def _doubted(steps: Sequence[Step], found: _Search, as_recorded: _Search) -> list[Step]:
    """Return steps of a reading that a free fit explains much better, none of them adequate.

    A sign or an order still is if no free fit without it comes near.
    """
    if not steps:
        return []
    without = as_recorded.free_fit()
    is_beyond = found.stated_fit().ratio_to(without) < 1.0 - _LARGE_REDUCTION
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
    few = _thinned(samples, _MAX_ROWS)
    search = _Search(model, few, {}, unit_is_open=False)
    steps = search.by_joint_fit(())
    adequacy = search.adequacy() if steps else Adequacy(1.0, 1.0, agrees=True)
    steps = [replace(step, is_adequate=step.is_adequate and adequacy.is_enough) for step in steps]
    return Readings(tuple(steps), model, search.samples, search.score, {}, (), adequacy)


@dataclass(frozen=True, eq=False)
class _Joints:
    """Zeros and scales of several joints, tried together."""

    fit: JointFit
    changes: tuple[Change, ...]
    samples: Samples
    score: Score
    whole: Comparison  # with the reading before
    against: tuple[Comparison, ...]  # of each change, with all but it


class _Search:
    """The best interpretation so far, and the changes tried on it."""

    def __init__(
        self,
        model: RobotModel,
        samples: Samples,
        mountings: Mapping[str, RobotModel],
        *,
        unit_is_open: bool,
    ) -> None:
        self.model = model
        self.samples = samples
        self._mountings = mountings
        self._unit_is_open = unit_is_open
        self._changes: list[Change] = []
        self.score = score_of(model, samples)
        self._trials: list[Trial] | None = None
        self._excluded: frozenset[Change] = frozenset()
        self._tries: dict[Change, Trial] = {}
        self._fitted: list[_Joints] = []

    @property
    def changes(self) -> tuple[Change, ...]:
        """What was adopted."""
        return tuple(self._changes)

    @property
    def signs(self) -> Signs:
        """The signs of all joints that were adopted."""
        return Signs.of(Axes.of(self._changes, self.model.n_joints))

    def change(self, changes: Sequence[Change]) -> None:
        """Adopt changes as they are."""
        for change in changes:
            trial = self._try(change)
            self._become(trial.model, trial.samples, trial.score, [change])

    def _become(
        self, model: RobotModel, samples: Samples, score: Score, changes: Sequence[Change]
    ) -> None:
        self.model = model
        self.samples = samples
        self.score = score
        self._changes += changes
        self._trials = None
        self._tries.clear()
        self._fitted.clear()

    def by_friction(self) -> list[Step]:
        """Adopt the sign of joints that friction would drive; none if it drives none."""
        joints = tuple(np.flatnonzero(self.score.driven).tolist())
        if not joints:
            return []
        kinds: tuple[Meaning, ...] = ("torque sign", "position sign")
        # All torques negated: with other bodies an arm predicts them alike, so that the error does
        # not decide, but friction and inertia do: a lag of the torque turns none of all.
        everywhere = self.score.is_all_driven
        if everywhere and inertial_torque(self.model, self.samples).sum() > 0.0:
            return []  # the rows run backwards: no sign is wrong
        if everywhere:
            kinds = ("torque sign",)
            joints = tuple(range(self.model.n_joints))
        trials = [self._try(Change(kind, joints)) for kind in kinds]
        best = min(trials, key=lambda trial: trial.against.ratio)
        if not everywhere and (
            best.against.ratio > 1.0 + _ALIKE_REDUCTION or best.against.sigmas > SURE_SIGMAS
        ):
            return []
        return [self._adopt(best, trials)]

    def by_prediction(self) -> list[Step]:
        """Adopt the change that fits best, or zeros and scales; none if none is significant."""
        trials = self.tried()
        better = [trial for trial in trials if trial.score.overall < self.score.overall]
        good = [
            trial
            for trial in better
            if trial.change.meaning not in SIZED
            and _is_better(trial.against)
            and not self._is_spoilt(trial)
        ]
        joints = self._best_joints(better)
        if joints is not None and all(
            compare(joints.score, trial.score, self.model).ratio < 1.0 - _ALIKE_REDUCTION
            for trial in good
        ):
            others = [trial for trial in better if trial.change.meaning not in SIZED]
            others += [*self._singles(joints), *self._other_sides(joints)]
            return self._adopt_joints(joints, others)
        if not good:
            return []
        best = min(good, key=lambda trial: trial.against.ratio)
        close = [trial for trial in good if self._are_alike(trial, best)]
        best = min(close, key=lambda trial: (int(trial.score.driven.sum()), trial.against.ratio))
        others = [trial for trial in better if trial.change.meaning != "zero"]
        return [self._adopt(best, [*others, *self._singles()])]

    def more_steps(self) -> list[Step]:
        """Adopt changes one after the other, as long as they are significant."""
        steps: list[Step] = []
        while len(steps) < _MAX_STEPS:
            found = self.by_prediction() or self.by_friction()
            if not found:
                break
            steps += found
        return steps

    def signs_by_joint_fit(self) -> list[Change]:
        """Return the signs of single joints, best fit with zeros and scales first."""
        free = candidates(self.model, self.samples)
        moved = np.flatnonzero(np.ptp(self.samples.motion.position, axis=0) > 0.0).tolist()
        costs = {}
        for change in (Change(kind, (joint,)) for joint in moved for kind in SIGNS):
            samples = changed_samples(self.model, self.samples, change)
            costs[change] = fit_joints(self.model, samples, free).cost
        return sorted(costs, key=lambda change: costs[change])

    def best_signs(self) -> list[Signs]:
        """Return the signs of all joints that fit few rows best."""
        moved = np.flatnonzero(np.ptp(self.samples.motion.position, axis=0) > 0.0)
        if len(moved) > _MAX_NEGATED_JOINTS:
            return []
        fits = _Fits(self.model, _thinned(self.samples, _FIRST_TRIAL_ROWS), self._mountings)
        positions = []
        for negated in product((1.0, -1.0), repeat=len(moved)):
            position = np.ones(self.model.n_joints)
            position[moved] = negated
            positions.append(position)
        signs = fits.by_friction(positions)
        errors = fits.of_signs(signs)
        best = [signs[k] for k in np.argsort(errors, kind="stable")[:_COMPARED_SIGNS]]
        return list({each.changes: each for each in map(fits.with_best_torques, best)}.values())

    def sign_rivals(self) -> tuple[SignRival, ...]:
        """Return the signs of mirror images of the arm that fit alike, fewest changes first."""
        tried = list(mirror_images(self.model.chain, self.model.gravity))
        if self.signs.changes:
            tried += [(joint,) for joint in range(self.model.n_joints)]
        alike: dict[tuple[int, ...], float] = {}
        self._keep_alike(alike, tried)
        several = list(alike)
        for joints in several:  # images of images
            both = [tuple(sorted({*joints} ^ {*others})) for others in alike]
            self._keep_alike(alike, [each for each in both if each and each not in alike])
        rivals = [
            SignRival(self.signs.flipped(joints), joints, error) for joints, error in alike.items()
        ]
        probable = [rival for rival in rivals if rival.signs.is_probable]
        return tuple(sorted(probable, key=lambda rival: len(rival.signs.changes)))

    def _keep_alike(
        self, alike: dict[tuple[int, ...], float], tried: Sequence[tuple[int, ...]]
    ) -> None:
        """Add the joints that may be negated as well, with the error then."""
        for joints in tried:
            trial = self._try(Change("axis sign", joints))
            if trial.against.sigmas < SEPARATE_SIGMAS and (
                trial.score.overall < (1.0 + _ALIKE_REDUCTION) * self.score.overall
            ):
                alike[joints] = trial.score.overall

    def _singles(self, but: _Joints | None = None) -> list[Trial]:
        """Return single fitted zeros and scales, other than the best."""
        known = [] if but is None else list(but.changes)
        singles = []
        for each in self._fitted:
            (change, *more) = each.changes
            near = [
                other
                for other in known
                if other[:2] == change[:2] and abs(other.size - change.size) < _SAME_SIZE_TOLERANCE
            ]
            if not more and not near:
                known.append(change)
                singles.append(self._try(change))
        return singles

    def _other_sides(self, joints: _Joints) -> list[Trial]:
        """Return the best zero far from a single one that was found, where the motion has two.

        Such as a joint whose body hangs: turned to either side it loads the others alike.
        """
        (change, *more) = joints.changes
        if more or change.meaning != "zero":
            return []
        angles = [angle * DEGREE for angle in _START_ZEROS_DEGREES]
        far = [angle for angle in angles if _apart(angle, change.size) > _MIN_ZERO_SEPARATION]
        trials = [self._try(change._replace(size=angle)) for angle in far]
        best = min(trials, key=lambda trial: trial.score.overall)
        zero = np.zeros(self.model.n_joints)
        zero[list(change.joints)] = best.change.size
        free = np.isin(np.arange(2 * len(zero)), change.joints)
        start = starting_at(self.model, self.samples, zero, np.zeros_like(zero))
        size = float(fit_joints(self.model, self.samples, free, start).zero[change.joints[0]])
        if _apart(size, change.size) < _MIN_ZERO_SEPARATION:
            return [best]
        return [self._try(change._replace(size=size))]

    def by_joint_fit(self, near: Sequence[Step]) -> list[Step]:
        """Adopt zeros and scales of all joints together, near the ones found before, if any fit."""
        n = self.model.n_joints
        zero = np.zeros(n)
        gain = np.ones(n)
        for step in near:
            places = list(step.change.joints)
            if step.change.meaning == "zero":
                zero[places] += step.change.size
            else:
                gain[places] *= 1.0 + step.change.size
        start = starting_at(self.model, self.samples, zero, gain - 1.0)
        every = candidates(self.model, self.samples)
        joints = self._joints(find_joints(self.model, self.samples, every, start))
        if joints is None:
            return []
        found = self._adopt_joints(joints, [])
        alike = {step.change[:2]: step.alike for step in near}
        return [replace(step, alike=alike.get(step.change[:2], ())) for step in found]

    def stated_fit(self) -> JointFit:
        """Fit the rows as read."""
        none = np.zeros(2 * self.model.n_joints, dtype=np.bool_)
        return fit_joints(self.model, self.samples, none)

    def free_fit(self) -> JointFit:
        """Fit the rows with any zeros and scales, and hardly believe the masses."""
        free = candidates(self.model, self.samples)
        return fit_joints(self.model, self.samples, free, free_bodies=True)

    def adequacy(self) -> Adequacy:
        """Compare the reading found with a free fit."""
        free = self.free_fit()
        moved = [joint for each in self._changes if each.meaning == "zero" for joint in each.joints]
        stated = self.stated_fit()
        largest = float(stated.ratios_to(free).max(initial=1.0))
        return Adequacy(stated.ratio_to(free), largest, free.is_zero_at(moved))

    def _best_joints(self, trials: Sequence[Trial]) -> _Joints | None:
        """Return zeros and scales that predict better; None if none do."""
        every = candidates(self.model, self.samples)
        best = self._joints(find_joints(self.model, self.samples, every))
        if best is not None:
            self._fitted.append(best)
        zeros = [trial for trial in trials if trial.change.meaning == "zero"]
        zeros = [trial for trial in zeros if trial.against.ratio < 1.0 - _LARGE_REDUCTION]
        for far in sorted(zeros, key=lambda trial: trial.against.ratio)[:_FAR_ZERO_STARTS]:
            if (
                best is not None
                and compare(best.score, far.score, self.model).ratio < _FAR_ZERO_ERROR_RATIO
            ):
                continue  # near what is stated is better
            zero = np.zeros(self.model.n_joints)
            joints = list(far.change.joints)
            zero[joints] = far.change.size
            start = starting_at(self.model, self.samples, zero, np.zeros_like(zero))
            alone = np.isin(np.arange(len(every)), joints)
            for free in (alone, every):
                fit = find_joints(self.model, self.samples, free, start)
                other = self._joints(fit)
                if other is not None:
                    self._fitted.append(other)
                if other is not None and (
                    best is None or _is_clearly_better(other.score, best.score, self.model)
                ):
                    best = other
        return best

    def _joints(self, fit: JointFit) -> _Joints | None:
        """Return the zeros and scales of a joint fit that predict better; None if none do."""
        n = self.model.n_joints
        while changes := _changes_of(fit):
            samples, score = self._scored(changes)
            without = [
                self._scored([each for each in changes if each != one])[1] for one in changes
            ]
            against = [compare(score, other, self.model) for other in without]
            is_needed = [each.sigmas < -_NEEDED_SIGMAS for each in against]
            if all(is_needed):
                whole = compare(score, self.score, self.model)
                if whole.ratio > 1.0 - _MIN_ERROR_REDUCTION or whole.sigmas > -SEPARATE_SIGMAS:
                    return None
                return _Joints(fit, changes, samples, score, whole, tuple(against))
            free = np.zeros(2 * n, dtype=np.bool_)
            for change, is_one in zip(changes, is_needed, strict=True):
                places = np.array(change.joints) + (0 if change.meaning == "zero" else n)
                free[places] = is_one
            fit = fit_joints(self.model, self.samples, free, fit.fixed(free))
        return None

    def _scored(self, changes: Sequence[Change]) -> tuple[Samples, Score]:
        """Return samples with more zeros and scales, and their score."""
        samples = self.samples
        for change in changes:
            samples = changed_samples(self.model, samples, change)
        score = score_of(self.model, samples, self.score.columns)
        return samples, score.of_torque(self._torque_scale(changes))

    def _torque_scale(self, changes: Sequence[Change]) -> Array:
        return Axes.of([*self._changes, *changes], self.model.n_joints).torque_scale

    def _adopt_joints(self, joints: _Joints, others: Sequence[Trial]) -> list[Step]:
        """Adopt zeros and scales, with other changes that fit alike."""
        before = self.score.overall
        alike = tuple(
            (trial.change, trial.score.overall)
            for trial in others
            if compare(trial.score, joints.score, self.model).sigmas < SEPARATE_SIGMAS
            and trial.score.overall < (1.0 + _ALIKE_REDUCTION) * joints.score.overall
        )
        steps = [
            Step(
                change,
                joints.score.overall,
                before,
                each.ratio,
                each.sigmas,
                alike,
                is_adequate=change.meaning == "zero" or joints.fit.is_scale_known,
            )
            for change, each in zip(joints.changes, joints.against, strict=True)
        ]
        self._become(self.model, joints.samples, joints.score, joints.changes)
        return steps

    def single_as_good_as(self, score: Score, tried: Sequence[Trial]) -> Step | None:
        """Adopt the one change of `tried` that fits as well as several do; None if none does."""
        trials = [
            trial
            for trial in tried
            if compare(trial.score, score, self.model).sigmas < SEPARATE_SIGMAS
            and trial.score.overall < (1.0 + _ALIKE_REDUCTION) * score.overall
            and trial.score.driven.sum() <= score.driven.sum()
        ]
        if not trials:
            return None
        return self._adopt(min(trials, key=lambda trial: trial.score.overall), trials)

    def nearest(self) -> dict[Meaning, tuple[Change, Comparison]]:
        """Return by meaning the change that comes nearest to the reading found."""
        nearest: dict[Meaning, tuple[Change, Comparison]] = {}
        for trial in self.tried():
            meaning = trial.change.meaning
            if meaning not in nearest or trial.against.ratio < nearest[meaning][1].ratio:
                nearest[meaning] = trial.change, trial.against
        return nearest

    def unseen_zeros(self) -> tuple[int, ...]:
        """Return the joints whose zeros may also be others."""
        self.tried()
        joints = np.flatnonzero(self.model.chain.revolute).tolist()
        angles = (-45.0 * DEGREE, 45.0 * DEGREE)
        possible = (
            zero
            for zero in (Change("zero", (joint,), angle) for joint in joints for angle in angles)
            if zero not in self._excluded
        )
        unseen = (zero for zero in possible if self._try(zero).against.sigmas < SEPARATE_SIGMAS)
        return tuple(dict.fromkeys(joint for zero in unseen for joint in zero.joints))

    def _are_alike(self, trial: Trial, best: Trial) -> bool:
        """Whether two changes fit alike, so that the recording does not choose one."""
        if compare(trial.score, best.score, self.model).sigmas > SEPARATE_SIGMAS:
            return False
        if trial.score.overall < (1.0 + _ALIKE_REDUCTION) * best.score.overall:
            return True
        more = trial.score.squares.sum(axis=1) - best.score.squares.sum(axis=1)
        return sigmas_of(more) < SEPARATE_SIGMAS

    def _orders(self, trials: Sequence[Trial], fits: _Fits) -> Iterator[Trial]:
        """Yield whole orders: from several starts, the best exchange while the error falls."""
        is_poor = self.score.overall > EXPLAINED_ERROR
        for kind in ORDERS:
            trials_of_kind = [trial for trial in trials if trial.change.meaning == kind]
            if not is_poor and not any(
                trial.against.ratio < _EXCHANGE_ERROR_RATIO for trial in trials_of_kind
            ):
                continue
            tried = {whole_order(trial.change, self.model.n_joints) for trial in trials_of_kind}
            for order in _best_orders(fits, kind, _ORDER_STARTS if is_poor else 1):
                change = order_change(kind, order)
                if change.joints and order not in tried:
                    yield self._try(change)

    def _is_spoilt(self, trial: Trial, beside: Trial | None = None) -> bool:
        """Whether a change that concerns few joints fits another one worse, or drives one.

        Worse than before, and than with `beside`. With an angle that contains another the posture
        of all that follows is another.
        """
        if trial.change.meaning in ORDERS:
            return False
        if int(trial.score.driven.sum()) > int(self.score.driven.sum()):
            return True
        most = (
            _MAX_JOINT_ERROR_RATIO
            if beside is None
            else _MAX_JOINT_ERROR_RATIO * np.maximum(1.0, beside.against.joints)
        )
        # What a second fault leaves may fit a joint worse where the first one is corrected.
        halves = trial.against.ratio < _HALVED_ERROR_RATIO and beside is None
        spoils = bool(np.any(trial.against.joints > most)) and not halves
        return spoils and trial.change.meaning not in COUPLED

    def _adopt(self, best: Trial, others: Sequence[Trial]) -> Step:
        """Adopt a change, with others that fit equally well."""
        alternatives: list[Trial] = []
        if len(best.change.joints) < self.model.n_joints:  # an arm and its mirror image move alike
            alternatives = [self._try(change) for change in alternatives_to(best.change)]
            alternatives += [other for other in others if differs(other.change, best.change)]
        alike = {
            other.change: other.score.overall
            for other in alternatives
            if not self._is_spoilt(other, best)
            and self._are_alike(other, best)
            and other.score.driven.sum() <= best.score.driven.sum()
        }
        before = self.score.overall
        ratio, sigmas, _ = best.against
        ranked = sorted(alike.items(), key=lambda pair: pair[1])
        self._become(best.model, best.samples, best.score, [best.change])
        return Step(best.change, best.score.overall, before, ratio, sigmas, tuple(ranked))

    def tried(self) -> list[Trial]:
        """Return the changes of least error, tried on all rows."""
        if self._trials is None:
            fits = _Fits(self.model, _thinned(self.samples, _FIRST_TRIAL_ROWS), self._mountings)
            errors = fits.errors([AS_READ, *self._to_try()])
            excluded = errors.pop(AS_READ) + SURE_SIGMAS**2 * ROWS_PER_FACT / fits.rows
            self._excluded = frozenset(
                change for change, error in errors.items() if error >= excluded
            )
            trials = [self._try(change) for change in to_compare(errors, excluded)]
            self._trials = [*trials, *self._orders(trials, fits)]
        return self._trials

    def _to_try(self) -> Iterator[Change]:
        n = self.model.n_joints
        moved = np.flatnonzero(np.ptp(self.samples.motion.position, axis=0) > 0.0).tolist()
        if self._unit_is_open and all(self.model.chain.revolute):
            yield from (Change("degrees"), Change("radians"))
        yield from (Change("mounting", (), 0.0, name) for name in self._mountings if name)
        if "" in self._mountings:
            yield Change("no gravity")
        yield Change("torque sign", tuple(range(n)))
        for joint in range(n):
            if joint in moved:
                yield from (Change(kind, (joint,)) for kind in SIGNS)
            if self.model.chain.revolute[joint]:
                yield from (
                    Change("zero", (joint,), angle * DEGREE) for angle in _START_ZEROS_DEGREES
                )
        for pair in coupled_pairs(self.model, moved):
            yield from (Change(kind, pair) for kind in COUPLED)
        for pair in combinations(moved, 2):
            yield from (Change(kind, pair) for kind in ORDERS)

    def _try(self, change: Change) -> Trial:
        if change not in self._tries:
            model = mounted_model(self.model, change, self._mountings)
            samples = changed_samples(self.model, self.samples, change)
            columns = self.score.columns
            if change.meaning in ("torque order", "joint order"):
                columns = columns[list(whole_order(change, self.model.n_joints))]
            score = score_of(model, samples, columns)
            score = score.of_torque(self._torque_scale([change]))
            against = compare(score, self.score, self.model)
            self._tries[change] = Trial(change, model, samples, score, against)
        return self._tries[change]


class _Fits:
    """Fits to all of few rows under changes of a reading.

    A motion is reduced once for all torques: orders and signs of torques are parts of its sums.
    """

    def __init__(
        self, model: RobotModel, samples: Samples, mountings: Mapping[str, RobotModel]
    ) -> None:
        self.model = model
        self._samples = samples
        self._mountings = mountings
        torque = np.sqrt(np.square(samples.torque).sum(axis=0))
        self._counts = ~little_torque(torque, ~np.array(model.chain.revolute))
        self._sums: dict[Change, Factor] = {}  # of every torque, by the change of the motion

    @property
    def rows(self) -> int:
        """Number of rows."""
        return len(self._samples.torque)

    def errors(self, changes: Sequence[Change]) -> dict[Change, float]:
        """Return logarithms of the squared errors of fits, each summed over the torques.

        Small ones are aside: a fit makes their share as small as it likes.
        """
        errors: dict[Change, float] = {}
        by_gravity: dict[str | None, list[Change]] = {}
        for change in changes:
            gravity = change.name if change.meaning in GRAVITIES else None
            by_gravity.setdefault(gravity, []).append(change)
        for alike in by_gravity.values():
            model = mounted_model(self.model, alike[0], self._mountings)
            for first in range(0, len(alike), _FITS_AT_ONCE):
                errors.update(self._errors(model, alike[first : first + _FITS_AT_ONCE]))
        return errors

    def _errors(self, model: RobotModel, changes: Sequence[Change]) -> dict[Change, float]:
        """Return the errors of changes under one gravity."""
        motions = [change_of_motion(change) for change in changes]
        axes = [Axes.of([change], self.model.n_joints) for change in changes]
        errors = self._errors_as_read(model, motions, axes)
        return dict(zip(changes, errors, strict=True))

    def _reduce(self, model: RobotModel, motions: Sequence[Change]) -> None:
        """Reduce each motion once, for all torques."""
        if new := list(dict.fromkeys(motion for motion in motions if motion not in self._sums)):
            moved = [changed_samples(self.model, self._samples, motion) for motion in new]
            factor = every_torque_factor(model, moved)
            for block, motion in enumerate(new):
                self._sums[motion] = factor.blocks(slice(block, block + 1))

    def by_friction(self, positions: Sequence[Array]) -> list[Signs]:
        """Complete position signs (n,) with the torque signs that make friction dissipate energy.

        Each joint is fitted alone, as the other torques may have any sign.
        """
        columns = friction_columns(self.model, self._samples)
        motions = [_negated_positions(position) for position in positions]
        for first in range(0, len(motions), _FITS_AT_ONCE):
            self._reduce(self.model, motions[first : first + _FITS_AT_ONCE])
        signs = []
        for position, motion in zip(positions, motions, strict=True):
            torque = np.ones(len(position))
            factor = self._sums[motion]
            for joint, (matrix,) in enumerate(factor.matrices):
                width = len(matrix) - factor.n_joints
                own = matrix[:width, :width]
                ridge = _RIDGE * np.diag(own.diagonal() + np.finfo(np.float64).tiny)
                fitted = np.linalg.solve(own + ridge, matrix[:width, width + joint])
                friction = columns[joint, factor.columns[joint][:width]] @ fitted
                torque[joint] = -1.0 if friction < 0.0 else 1.0
            signs.append(Signs(position, torque))
        return signs

    def with_best_torques(self, signs: Signs) -> Signs:
        """Return the signs after flipping torque signs one by one while the fit improves."""
        (error,) = self.of_signs([signs])
        while True:
            torques = signs.torque * (1.0 - 2.0 * np.eye(len(signs.torque)))
            others = [signs._replace(torque=torque) for torque in torques]
            errors = self.of_signs(others)
            best = int(np.argmin(errors))
            if errors[best] >= error:
                return signs
            signs, error = others[best], errors[best]

    def of_signs(self, signs: Sequence[Signs]) -> list[float]:
        """Return the error of each combination of joint signs."""
        errors: list[float] = []
        for first in range(0, len(signs), _FITS_AT_ONCE):
            some = signs[first : first + _FITS_AT_ONCE]
            motions = [_negated_positions(each.position) for each in some]
            axes = [Axes.of(each.changes, self.model.n_joints) for each in some]
            errors += self._errors_as_read(self.model, motions, axes)
        return errors

    def _errors_as_read(
        self, model: RobotModel, motions: Sequence[Change], axes: Sequence[Axes]
    ) -> list[float]:
        """Return the errors of motions, each with the torque as its axes read it."""
        self._reduce(model, motions)
        sums = of_torques([self._sums[motion] for motion in motions], axes)
        priors = body_priors(model, sums)
        errors = []
        for each, read, mean, information in zip(sums.each(), axes, *priors, strict=True):
            values, _ = each.posterior(mean, ROWS_PER_FACT * information, MIN_NOISE)
            squares = each.squared_errors(values)[self._counts[read.torque_order]]
            errors.append(float(np.log(np.where(squares > 0.0, squares, 1.0)).sum()))
        return errors


def to_compare(errors: Mapping[Change, float], excluded: float) -> list[Change]:
    """Return the changes to compare on all rows: the best ones, and the best of each kind.

    Of changes that the fits exclude, only the best of each meaning: it shows how certain they are.

    Args:
        errors: of fits to few rows.
        excluded: error from which a change is certainly worse than none.
    """
    chosen: list[Change] = []
    kinds: set[object] = set()
    meanings: set[Meaning] = set()
    for place, change in enumerate(sorted(errors, key=lambda change: errors[change])):
        is_new = place < _COMPARED_CHANGES or kind_of(change) not in kinds
        if (is_new and errors[change] < excluded) or change.meaning not in meanings:
            chosen.append(change)
        kinds.add(kind_of(change))
        meanings.add(change.meaning)
    return chosen


def _negated_positions(sign: Array) -> Change:
    """Return the change of the motion to positions with signs (n,)."""
    joints = tuple(np.flatnonzero(sign < 0.0).tolist())
    return Change("position sign", joints) if joints else AS_READ


def of_torques(every: Sequence[Factor], axes: Sequence[Axes]) -> TorqueSums:
    """Return the sums of [W | y], y as axes read it, by those of every torque."""
    n = every[0].n_joints
    p = every[0].n_parameters + 1 - n
    gram = np.zeros((len(every), n, p + 1, p + 1))
    for factor, read, parts in zip(every, axes, gram, strict=True):
        for joint, (part, (matrix,)) in enumerate(zip(parts, factor.matrices, strict=True)):
            width = len(matrix) - n
            columns = factor.columns[joint][:width]
            torque = width + read.torque_order[joint]
            part[columns[:, None], columns] = matrix[:width, :width]
            part[columns, p] = part[p, columns] = read.torque_sign[joint] * matrix[torque, :width]
            part[p, p] = matrix[torque, torque]
    return TorqueSums(gram, np.array([factor.samples for factor in every]))


def _best_orders(fits: _Fits, kind: Meaning, starts: int) -> list[tuple[int, ...]]:
    """Return the orders of least error on few rows."""
    errors: dict[tuple[int, ...], float] = {}

    def best_of(orders: Sequence[tuple[int, ...]]) -> tuple[int, ...]:
        new = {order: order_change(kind, order) for order in orders if order not in errors}
        found = fits.errors(list(dict.fromkeys(new.values())))
        errors.update((order, found[change]) for order, change in new.items())
        return min(orders, key=errors.__getitem__)

    n = fits.model.n_joints
    rng = np.random.default_rng(0)
    reached: list[tuple[int, ...]] = []
    for start in range(starts):
        order = tuple(range(n)) if start == 0 else tuple(rng.permutation(n).tolist())
        while True:
            others = [_exchanged(order, pair) for pair in combinations(range(n), 2)]
            best = best_of([order, *others])
            if best == order:
                break
            order = best
        reached.append(order)
        if reached.count(best_of(reached)) > 1:
            break
    return sorted(errors, key=lambda order: errors[order])[:_COMPARED_ORDERS]


def _exchanged(order: tuple[int, ...], pair: tuple[int, int]) -> tuple[int, ...]:
    places = list(order)
    first, second = pair
    places[first], places[second] = places[second], places[first]
    return tuple(places)


def _apart(angle: float, other: float) -> float:
    """Return the size of the angle between two [rad], at most half a turn."""
    return float(abs((angle - other + np.pi) % (2.0 * np.pi) - np.pi))


def _is_better(against: Comparison) -> bool:
    """Whether a change reduces the error by more than chance, of all that are tried."""
    if against.ratio < 1.0 - _LARGE_REDUCTION and against.sigmas < -SEPARATE_SIGMAS:
        return True
    return against.ratio < 1.0 - _MIN_ERROR_REDUCTION and against.sigmas < -SURE_SIGMAS


def _is_clearly_better(score: Score, other: Score, model: RobotModel) -> bool:
    return compare(score, other, model).ratio < 1.0 - _ALIKE_REDUCTION


def _changes_of(fit: JointFit) -> tuple[Change, ...]:
    zeros = [Change("zero", (joint,), float(fit.zero[joint])) for joint in fit.moved]
    return (*zeros, *(Change("scale", (j,), float(fit.gain[j])) for j in fit.scaled))


def _thinned(samples: Samples, rows: int) -> Samples:
    return samples.thinned(max(1, len(samples.torque) // rows))
