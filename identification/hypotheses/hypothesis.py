"""A reading of a recording, and its changes: tried, compared, and adopted where significant.

A few rows decide which changes are worth a comparison: each of these predicts every fifth block
from the other blocks, and its errors are compared with the previous reading's, block by block.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product
from operator import itemgetter
from typing import Final

import numpy as np

from identification.arrays import Array
from identification.hypotheses.few_row_fits import (
    ORDER_STARTS,
    FewRowFits,
    best_orders,
    to_compare,
)
from identification.hypotheses.joint_changes import (
    AS_READ,
    COUPLED,
    COUPLED_ANGLES,
    DEGREE,
    ORDERS,
    SIGNS,
    SIZED,
    Axes,
    Change,
    Meaning,
    alternatives_to,
    changed_samples,
    coupled_pairs,
    differs,
    drive_of,
    mounted_model,
    order_change,
    whole_order,
)
from identification.hypotheses.joint_fit import (
    JointFit,
    candidates,
    find_joints,
    fit_joints,
    starting_at,
)
from identification.hypotheses.mirror_images import SignRival, Signs, mirror_images
from identification.hypotheses.readings import Adequacy, Step
from identification.hypotheses.scores import (
    ALIKE_REDUCTION,
    EXPLAINED_ERROR,
    LARGE_REDUCTION,
    MIN_REDUCTION,
    ROWS_PER_FACT,
    SEPARATE_SIGMAS,
    SURE_SIGMAS,
    Comparison,
    Score,
    compare,
    fits_alike,
    inertial_torque,
    score_of,
    sigmas_of,
)
from identification.hypotheses.springs import may_have_springs, score_with_springs
from identification.model.robot import RobotModel
from identification.signals.samples import Samples

_MAX_JOINT_ERROR_RATIO: Final = 1.1  # error ratio of a joint beyond which a reading spoils it
_HALVED_ERROR_RATIO: Final = 0.5  # error ratio over all joints from which it may
_FIRST_TRIAL_ROWS: Final = 250  # on which all readings are tried first
# error ratio of one exchange from which a whole order is searched for
_EXCHANGE_ERROR_RATIO: Final = 0.98
_MAX_STEPS: Final = 6
SAME_SIZE_TOLERANCE: Final = 0.3
"""Difference of two fitted zeros [rad], or scales, that are one."""
# error ratio to a zero far away, of which no better fit is expected
_FAR_ZERO_ERROR_RATIO: Final = 0.5
_MIN_ZERO_SEPARATION: Final = 60.0 * DEGREE  # between two zeros that are not one
_FAR_ZERO_STARTS: Final = 2  # zeros far from what is stated at which a fit starts
_NEEDED_SIGMAS: Final = 2.0  # standard errors of one of several zeros and scales that its fit needs
# signs of least error, compared together with zeros and scales
_COMPARED_SIGNS: Final = 3
_MAX_NEGATED_JOINTS: Final = 8  # that move, up to which every combination of their signs is tried
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
class _Joints:
    """Zeros and scales of several joints, tried together."""

    fit: JointFit
    changes: tuple[Change, ...]
    samples: Samples
    score: Score
    whole: Comparison  # with the reading before
    against: tuple[Comparison, ...]  # of each change, with all but it


class Hypothesis:
    """What a recording is read as, and the changes tried on that.

    Args:
        model: of the arm.
        samples: of the recording, as stated.
        mountings: models with another gravity, by name ("" without gravity).
        unit_is_open: whether nothing states the unit of the positions.
        score: of the samples, if it is known.
    """

    def __init__(
        self,
        model: RobotModel,
        samples: Samples,
        mountings: Mapping[str, RobotModel],
        *,
        unit_is_open: bool,
        score: Score | None = None,
    ) -> None:
        self.model = model
        self.samples = samples
        self._mountings = mountings
        self._unit_is_open = unit_is_open
        self._changes: list[Change] = []
        self.score = score_of(model, samples) if score is None else score
        self._stated = model, samples, self.score
        self._trials: list[Trial] | None = None
        self._excluded: frozenset[Change] = frozenset()
        self._tries: dict[Change, Trial] = {}
        self._fitted: list[_Joints] = []

    def restarted(self, changes: Sequence[Change] = ()) -> Hypothesis:
        """Return the recording as stated, but for these changes."""
        model, samples, score = self._stated
        again = Hypothesis(
            model, samples, self._mountings, unit_is_open=self._unit_is_open, score=score
        )
        again.change(changes)
        return again

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
            best.against.ratio > 1.0 + ALIKE_REDUCTION or best.against.sigmas > SURE_SIGMAS
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
            and trial.against.is_better
            and not self._is_spoilt(trial)
        ]
        joints = self._best_joints(better)
        if joints is not None and all(
            compare(joints.score, trial.score, self.model).ratio < 1.0 - ALIKE_REDUCTION
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
        """Return the signs of single joints that fit few rows best, with zeros and scales."""
        few = self.samples.thinned_to(_FIRST_TRIAL_ROWS)
        free = candidates(self.model, few)
        moved = np.flatnonzero(np.ptp(few.motion.position, axis=0) > 0.0).tolist()
        costs = {}
        for change in (Change(kind, (joint,)) for joint in moved for kind in SIGNS):
            samples = changed_samples(self.model, few, change)
            costs[change] = fit_joints(self.model, samples, free).cost
        return sorted(costs, key=lambda change: costs[change])[:_COMPARED_SIGNS]

    def best_signs(self) -> list[Signs]:
        """Return the signs of all joints that fit few rows best."""
        moved = np.flatnonzero(np.ptp(self.samples.motion.position, axis=0) > 0.0)
        if len(moved) > _MAX_NEGATED_JOINTS:
            return []
        fits = self._few_row_fits()
        positions = []
        for negated in product((1.0, -1.0), repeat=len(moved)):
            position = np.ones(self.model.n_joints)
            position[moved] = negated
            positions.append(position)
        signs = fits.by_friction(positions)
        errors = fits.of_signs(signs)
        best = [signs[k] for k in np.argsort(errors, kind="stable")[:_COMPARED_SIGNS]]
        return list({each.changes: each for each in map(fits.with_best_torques, best)}.values())

    def _few_row_fits(self) -> FewRowFits:
        few = self.samples.thinned_to(_FIRST_TRIAL_ROWS)
        return FewRowFits(self.model, few, self._mountings)

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
            if fits_alike(trial.score, self.score, self.model):
                alike[joints] = trial.score.overall

    def with_springs(self, steps: Sequence[Step]) -> list[Step]:
        """Return steps, zeros and scales with the springs that explain the rows as well."""
        sized = [step for step in steps if step.change.meaning in SIZED]
        possible = may_have_springs(self.model, self.samples)
        own = tuple(sorted({joint for step in sized for joint in step.change.joints}))
        rivals = {step.change: self._springs_alike([step], step.change.joints) for step in sized}
        if len(sized) > 1:
            together = [own, *((joint,) for joint in possible)]
            of_all = [rival for joints in together for rival in self._springs_alike(sized, joints)]
            rivals = {change: (*alike, *of_all) for change, alike in rivals.items()}
        return [
            replace(step, springs=tuple(sorted(rivals.get(step.change, ()), key=itemgetter(1))))
            for step in steps
        ]

    def _springs_alike(
        self, steps: Sequence[Step], joints: Sequence[int]
    ) -> tuple[tuple[Change, float], ...]:
        """Return springs of joints and the error with them, if they may take the place of steps."""
        changes = {step.change for step in steps}
        possible = {*may_have_springs(self.model, self.samples)}
        if not {*joints} <= possible or not changes <= {*self._changes}:
            return ()
        again = self.restarted([each for each in self._changes if each not in changes])
        score = score_with_springs(again.model, again.samples, joints, again.score.columns)
        if score is None:
            return ()
        score = score.of_torque(again._torque_scale(()))
        if not fits_alike(score, self.score, self.model):
            return ()
        return ((Change("spring", tuple(joints)), score.overall),)

    def _singles(self, but: _Joints | None = None) -> list[Trial]:
        """Return single fitted zeros and scales, other than the best."""
        known = [] if but is None else list(but.changes)
        singles = []
        for each in self._fitted:
            (change, *more) = each.changes
            near = [
                other
                for other in known
                if other[:2] == change[:2] and abs(other.size - change.size) < SAME_SIZE_TOLERANCE
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
        zeros = [trial for trial in zeros if trial.against.ratio < 1.0 - LARGE_REDUCTION]
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
                    best is None
                    or compare(other.score, best.score, self.model).ratio < 1.0 - ALIKE_REDUCTION
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
                if whole.ratio > 1.0 - MIN_REDUCTION or whole.sigmas > -SEPARATE_SIGMAS:
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
            if fits_alike(trial.score, joints.score, self.model)
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
            if fits_alike(trial.score, score, self.model)
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
        if trial.score.overall < (1.0 + ALIKE_REDUCTION) * best.score.overall:
            return True
        more = trial.score.squares.sum(axis=1) - best.score.squares.sum(axis=1)
        return sigmas_of(more) < SEPARATE_SIGMAS

    def _orders(self, trials: Sequence[Trial], fits: FewRowFits) -> Iterator[Trial]:
        """Yield whole orders: from several starts, the best exchange while the error falls."""
        is_poor = self.score.overall > EXPLAINED_ERROR
        for kind in ORDERS:
            trials_of_kind = [trial for trial in trials if trial.change.meaning == kind]
            if not is_poor and not any(
                trial.against.ratio < _EXCHANGE_ERROR_RATIO for trial in trials_of_kind
            ):
                continue
            tried = {whole_order(trial.change, self.model.n_joints) for trial in trials_of_kind}
            for order in best_orders(fits, kind, ORDER_STARTS if is_poor else 1):
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
            fits = self._few_row_fits()
            errors = fits.errors([AS_READ, *self._to_try()])
            excluded = errors.pop(AS_READ) + SURE_SIGMAS**2 * ROWS_PER_FACT / fits.rows
            self._excluded = frozenset(
                change for change, error in errors.items() if error >= excluded
            )
            trials = [self._try(change) for change in to_compare(errors, excluded)]
            self._trials = [*trials, *self._drives(trials), *self._orders(trials, fits)]
        return self._trials

    def _drives(self, trials: Sequence[Trial]) -> Iterator[Trial]:
        """Yield the drives of coupled angles that lessen the error, where they halve it.

        Where there are rods, the torque of two joints is wrong without them. What lessens it a
        little imitates something else, such as a low-pass.
        """
        for trial in trials:
            if trial.change.meaning in COUPLED_ANGLES and trial.against.ratio < 1.0:
                drive = self._try(drive_of(trial.change))
                if drive.against.ratio < _HALVED_ERROR_RATIO:
                    yield drive

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
            yield from (Change(kind, pair) for kind in COUPLED_ANGLES)
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


def _apart(angle: float, other: float) -> float:
    """Return the size of the angle between two [rad], at most half a turn."""
    return float(abs((angle - other + np.pi) % (2.0 * np.pi) - np.pi))


def _changes_of(fit: JointFit) -> tuple[Change, ...]:
    zeros = [Change("zero", (joint,), float(fit.zero[joint])) for joint in fit.moved]
    return (*zeros, *(Change("scale", (j,), float(fit.gain[j])) for j in fit.scaled))
