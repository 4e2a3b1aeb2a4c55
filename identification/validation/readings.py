"""Other readings of a recording: sign, order, unit and zero of its joints, gravity in its torque.

All readings are fitted to few rows first. For those of least error the torque of every fifth block
is predicted from the others, as in :mod:`identification.validation.causes`, whose corrections are
used, and the errors are compared block by block. Parameters have the prior of
:mod:`identification.estimators.prior`, so that geometry alone is enough and masses help where they
are known. Among readings that predict alike, those in which friction takes energy from every joint
come first. The best reading is adopted if it is significant, and the search is repeated with it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.estimators.prior import body_prior, posterior_values
from identification.factor.columns import every_torque_factor, of_torques
from identification.factor.factor import Factor
from identification.model.robot import RobotModel
from identification.signals.recording import Recording
from identification.signals.samples import Samples
from identification.validation.causes import Fault, corrected, coupled_pairs
from identification.validation.finding import little_torque

Array = NDArray[np.float64]
Meaning = Literal[
    "torque sign",
    "position sign",
    "axis sign",
    "torque order",
    "position order",
    "joint order",
    "angle sum",
    "angle difference",
    "degrees",
    "radians",
    "zero",
    "no gravity",
    "mounting",
]

SURE: Final = 4.5
"""Standard errors over the blocks of a reading that is sure, whatever the number tried: with 19
degrees of freedom one of 4 000 exceeds it by chance."""
SEPARATE: Final = 3.0
"""Standard errors by which the second best reading is worse."""
EXPLAINED: Final = 0.15
"""Error of the torque above which no reading is sure: the arm does not explain the torque."""
_LARGE: Final = 0.15  # relative reduction of the error that chance alone does not make
_LEAST_GAIN: Final = 0.02  # relative reduction of the error of a reading that is adopted
_ALIKE: Final = 0.05  # the same, of readings that fit alike
_HARM: Final = 1.1  # error ratio of a joint beyond which a reading spoils it
_DISSIPATES: Final = 4.0  # standard errors of a friction that drives a joint
_LEAST_FRICTION: Final = 0.02  # of the torque of a joint
_ROWS: Final = 700
_FEWER_ROWS: Final = 250  # on which all readings are tried first
_BLOCKS: Final = 20
_FOLDS: Final = 5
# Rows that count as one beside the prior. Where other parts are predicted they are seven in all: a
# wrong reading needs bodies that no arm has, which a weak prior would allow. Of few rows, all of
# which are fitted, that would be too few to tell orders of a wrist apart.
_ROWS_PER_FACT: Final = 10.0
_ROWS_PER_FACT_LEFT_OUT: Final = 100.0
# Of the search for an order: as read, then at random until the best order is reached twice. From a
# third of the starts the right one is reached: ten miss it in 2 % of the cases.
_STARTS: Final = 10
_IMPROVES: Final = 0.98  # error ratio of one exchange from which a whole order is searched for
_ORDERS: Final = 2  # best orders of each kind that are compared
_CLOSER: Final = 12  # changes of least error on fewer rows, which are compared
_MOST_STEPS: Final = 6
_POSTURES: Final = 35  # at which the inertia about each axis is evaluated
_SPEED: Final = 0.9  # quantile of the speed at which friction is judged
_ZEROS: Final = (-135.0, -90.0, -45.0, -20.0, 20.0, 45.0, 90.0, 135.0, 180.0)  # deg
_NEARER: Final = (-0.5, -0.25, 0.25, 0.5)  # of a zero, tried about it
_DEGREE: Final = np.pi / 180.0
_SIGNS: Final[tuple[Meaning, ...]] = ("torque sign", "position sign", "axis sign")
_IN_ORDER: Final[tuple[Meaning, ...]] = ("torque order", "position order", "joint order")
COUPLED: Final[tuple[Meaning, ...]] = ("angle sum", "angle difference")
"""The recorded angle of the first joint contains that of the second, added or taken off."""
_GRAVITIES: Final[tuple[Meaning, ...]] = ("mounting", "no gravity")


class Change(NamedTuple):
    """One difference between a reading and what was recorded.

    `size` is an angle [rad] to add to a position; `name` that of a mounting; `order` the recorded
    place of each of the joints, by default those of a pair exchanged.
    """

    meaning: Meaning
    joints: tuple[int, ...] = ()
    size: float = 0.0
    name: str = ""
    order: tuple[int, ...] = ()

    @property
    def places(self) -> tuple[int, ...]:
        """The joints in whose place those of `joints` are read, for an order."""
        return self.order or self.joints[::-1]


_AS_READ: Final = Change("position order")
"""No change: an order of no joints."""


@dataclass(frozen=True, eq=False)
class Score:
    """Errors of predicted blocks under one reading.

    Attributes:
        squares: squared errors (B, n).
        torque: squared torque (n,).
        friction: at a usual speed, over its standard error (n,); negative drives the joint.
        share: that friction over the RMS torque (n,).
        columns: of the recorded torque, the one that is read as that of each joint (n,).
    """

    squares: Array
    torque: Array
    friction: Array
    share: Array
    columns: NDArray[np.intp]

    @property
    def relative(self) -> Array:
        """Errors as shares of the torque (n,)."""
        torque = np.where(self.torque > 0.0, self.torque, 1.0)
        return np.asarray(np.sqrt(self.squares.sum(axis=0) / torque))

    @property
    def overall(self) -> float:
        """Error over all joints as a share of the torque."""
        return float(np.sqrt(self.squares.sum() / max(self.torque.sum(), 1e-300)))

    @property
    def driven(self) -> NDArray[np.bool_]:
        """Whether friction would drive each joint (n,)."""
        return (self.friction < -_DISSIPATES) & (self.share < -_LEAST_FRICTION)

    @property
    def joints(self) -> NDArray[np.intp]:
        """The joint that each recorded column of the torque is read as (n,)."""
        return np.argsort(self.columns)


class Comparison(NamedTuple):
    """Errors of one reading over those of another: mean over the recorded torques, and of each."""

    ratio: float
    sigmas: float  # negative if the first is better
    joints: Array  # (n,) by column of the recorded torque


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
    """A change that was adopted, and those that fit alike.

    `error` and `before` are errors over all joints with and without it; `alike` are other changes
    with their errors, of which only knowledge of the arm can choose.
    """

    change: Change
    error: float
    before: float
    ratio: float
    sigmas: float
    alike: tuple[tuple[Change, float], ...] = ()

    @property
    def by_friction(self) -> bool:
        """Whether the error speaks for it little or not at all, but friction does."""
        return self.ratio > 1.0 - _ALIKE

    @property
    def sure(self) -> bool:
        """Whether nothing else fits alike, and the arm explains the torque.

        Friction, or a slightly smaller error, says it of a whole arm; of one joint a lag of the
        torque looks the same.
        """
        slight = self.ratio > 1.0 - _LARGE and len(self.change.joints) == 1
        return not self.alike and self.error < EXPLAINED and not slight


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
    """

    steps: tuple[Step, ...]
    model: RobotModel
    samples: Samples
    score: Score
    nearest: Mapping[Meaning, tuple[Change, Comparison]]
    unseen_zeros: tuple[int, ...] = ()


def find_readings(
    model: RobotModel,
    samples: Samples,
    *,
    mountings: Mapping[str, RobotModel] | None = None,
    unit_is_open: bool = True,
) -> Readings:
    """Find how samples of one recording are to be read.

    `mountings` are models with another gravity, by name ("" without gravity); `unit_is_open`
    whether nothing states the unit of the positions.
    """
    few = _thinned(samples, _ROWS)

    def started() -> _Search:
        return _Search(model, few, mountings or {}, unit_is_open=unit_is_open)

    search = started()
    as_recorded = search.tried()
    steps: list[Step] = []
    while len(steps) < _MOST_STEPS:
        step = search.by_prediction() or search.by_friction()
        if step is None:
            break
        steps.append(step)
    if len(steps) > 1:
        again = started()
        single = again.single_as_good_as(search.score, as_recorded)
        if single is not None:
            search = again
            steps = [single]
    nearest = search.nearest()
    score = score_of(search.model, search.samples, search.score.columns)
    return Readings(
        tuple(steps), search.model, search.samples, score, nearest, search.unseen_zeros()
    )


class _Search:
    """The reading found so far, and the changes tried on it."""

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
        self.score = score_of(model, samples)
        self._trials: list[Trial] | None = None
        self._tries: dict[Change, Trial] = {}

    def by_friction(self) -> Step | None:
        """Adopt the sign of joints that friction would drive; None if it drives none."""
        joints = tuple(np.flatnonzero(self.score.driven).tolist())
        if not joints:
            return None
        friction = self.score.friction
        clear = friction[np.abs(friction) > _DISSIPATES]
        kinds: tuple[Meaning, ...] = ("torque sign", "position sign")
        # All torques negated: with other bodies an arm predicts them alike, so that the error does
        # not decide, but friction and inertia do: a lag of the torque turns none of all.
        everywhere = (
            len(clear) > 1
            and bool(np.all(clear < 0.0))
            and inertial_torque(self.model, self.samples).sum() < 0.0
        )
        if everywhere:
            kinds = ("torque sign",)
            joints = tuple(range(self.model.n_joints))
        trials = [self._try(Change(kind, joints)) for kind in kinds]
        best = min(trials, key=lambda trial: trial.against.ratio)
        if not everywhere and (best.against.ratio > 1.0 + _ALIKE or best.against.sigmas > SURE):
            return None
        return self._adopt(best, trials)

    def by_prediction(self) -> Step | None:
        """Adopt the change that fits best; None if none is significant."""
        trials = self.tried()
        better = [trial for trial in trials if trial.score.overall < self.score.overall]
        zeros = [trial for trial in better if trial.change.meaning == "zero"]
        if zeros:  # an angle between those tried may fit as well as another change
            better.append(self._nearer(min(zeros, key=lambda trial: trial.against.ratio)))
        good = [
            trial for trial in better if _is_better(trial.against) and not self._is_spoilt(trial)
        ]
        if not good:
            return None
        best = min(good, key=lambda trial: trial.against.ratio)
        close = [trial for trial in good if self._are_alike(trial, best)]
        best = min(close, key=lambda trial: (int(trial.score.driven.sum()), trial.against.ratio))
        return self._adopt(best, better)

    def single_as_good_as(self, score: Score, tried: Sequence[Trial]) -> Step | None:
        """Adopt the one change of `tried` that fits as well as several do; None if none does."""
        trials = [
            trial
            for trial in tried
            if compare(trial.score, score, self.model).sigmas < SEPARATE
            and trial.score.overall < (1.0 + _ALIKE) * score.overall
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
        """Return the joints of which other zeros fit alike."""
        joints = np.flatnonzero(self.model.chain.revolute).tolist()
        unseen = []
        for joint in joints:
            trials = [self._try(Change("zero", (joint,), s * 45.0 * _DEGREE)) for s in (-1.0, 1.0)]
            if min(trial.against.sigmas for trial in trials) < SEPARATE:
                unseen.append(joint)
        return tuple(unseen)

    def _are_alike(self, trial: Trial, best: Trial) -> bool:
        """Whether two changes fit alike, so that the recording does not choose one."""
        if compare(trial.score, best.score, self.model).sigmas > SEPARATE:
            return False
        if trial.score.overall < (1.0 + _ALIKE) * best.score.overall:
            return True
        more = trial.score.squares.sum(axis=1) - best.score.squares.sum(axis=1)
        return _sigmas(more) < SEPARATE

    def _orders(self, trials: Sequence[Trial], fits: _Fits) -> Iterator[Trial]:
        """Yield whole orders: from several starts, the best exchange while the error falls."""
        is_poor = self.score.overall > EXPLAINED
        for kind in _IN_ORDER:
            trials_of_kind = [trial for trial in trials if trial.change.meaning == kind]
            if not is_poor and not any(trial.against.ratio < _IMPROVES for trial in trials_of_kind):
                continue
            tried = {_whole_order(trial.change, self.model.n_joints) for trial in trials_of_kind}
            for order in _best_orders(fits, kind, _STARTS if is_poor else 1):
                change = _order_change(kind, order)
                if change.joints and order not in tried:
                    yield self._try(change)

    def _is_spoilt(self, trial: Trial, beside: Trial | None = None) -> bool:
        """Whether a change that concerns few joints fits another one worse, or drives one.

        Worse than before, and than with `beside`. With an angle that contains another the posture
        of all that follows is another.
        """
        if trial.change.meaning in _IN_ORDER:
            return False
        if int(trial.score.driven.sum()) > int(self.score.driven.sum()):
            return True
        most = _HARM if beside is None else _HARM * np.maximum(1.0, beside.against.joints)
        spoils = bool(np.any(trial.against.joints > most))
        return spoils and trial.change.meaning not in COUPLED

    def _adopt(self, best: Trial, others: Sequence[Trial]) -> Step:
        """Adopt a change, with those of others that fit alike."""
        alternatives: list[Trial] = []
        if len(best.change.joints) < self.model.n_joints:  # an arm and its mirror image move alike
            alternatives = [self._try(change) for change in _alternatives(best.change)]
            alternatives += [other for other in others if _differs(other.change, best.change)]
        alike = {
            other.change: other.score.overall
            for other in alternatives
            if not self._is_spoilt(other, best)
            and self._are_alike(other, best)
            and other.score.driven.sum() <= best.score.driven.sum()
        }
        before = self.score.overall
        self.model = best.model
        self.samples = best.samples
        self.score = best.score
        self._trials = None
        self._tries.clear()
        ratio, sigmas, _ = best.against
        ranked = sorted(alike.items(), key=lambda pair: pair[1])
        return Step(best.change, best.score.overall, before, ratio, sigmas, tuple(ranked))

    def tried(self) -> list[Trial]:
        """Return the changes of least error, tried on all rows."""
        if self._trials is None:
            fits = _Fits(self.model, _thinned(self.samples, _FEWER_ROWS), self._mountings)
            errors = {change: fits.error(change) for change in self._changes()}
            ranked = sorted(errors, key=lambda change: errors[change])
            closer = ranked[:_CLOSER]
            kinds = {_kind(change) for change in closer}
            for change in ranked:
                if _kind(change) not in kinds:
                    kinds.add(_kind(change))
                    closer.append(change)
            trials = [self._try(change) for change in closer]
            self._trials = [*trials, *self._orders(trials, fits)]
        return self._trials

    def _nearer(self, best: Trial) -> Trial:
        """Return the trial of a zero with an angle that fits better."""
        for scale in (1.0, 0.25):
            sizes = [best.change.size + 45.0 * _DEGREE * scale * part for part in _NEARER]
            trials = [self._try(best.change._replace(size=size)) for size in sizes]
            best = min([best, *trials], key=lambda trial: trial.against.ratio)
        return best

    def _changes(self) -> Iterator[Change]:
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
                yield from (Change(kind, (joint,)) for kind in _SIGNS)
            if self.model.chain.revolute[joint]:
                yield from (Change("zero", (joint,), angle * _DEGREE) for angle in _ZEROS)
        for pair in coupled_pairs(self.model, moved):
            yield from (Change(kind, pair) for kind in COUPLED)
        for pair in combinations(moved, 2):
            yield from (Change(kind, pair) for kind in _IN_ORDER)

    def _try(self, change: Change) -> Trial:
        if change not in self._tries:
            model = _mounted(self.model, change, self._mountings)
            samples = _moved(self.model, self.samples, change)
            columns = self.score.columns
            if change.meaning in ("torque order", "joint order"):
                columns = columns[list(_whole_order(change, self.model.n_joints))]
            score = score_of(model, samples, columns)
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
        self._sums: dict[Change, Factor] = {}  # by the change of the motion

    def error(self, change: Change) -> float:
        """Return the logarithm of the squared error of a fit, summed over the torques.

        Small ones are aside: a fit makes their share as small as it likes.
        """
        model = _mounted(self.model, change, self._mountings)
        motion = _of_motion(change)
        if motion not in self._sums:
            moved = _moved(self.model, self._samples, motion)
            self._sums[motion] = every_torque_factor(model, moved)
        axes = Axes.of([change], self.model.n_joints)
        sums = self._sums[motion]
        factor = of_torques(sums, axes.torque_order, axes.torque_sign)
        prior = body_prior(model, factor).gaussian
        squares = factor.squared_errors(posterior_values(factor, prior, _ROWS_PER_FACT)[0])
        squares = squares[self._counts[axes.torque_order]]
        return float(np.log(np.where(squares > 0.0, squares, 1.0)).sum())


def _of_motion(change: Change) -> Change:
    """Return the change of the motion that is part of a change, or of a mounting."""
    if change.meaning in ("torque sign", "torque order"):
        return _AS_READ
    if change.meaning == "axis sign":
        return change._replace(meaning="position sign")
    if change.meaning.endswith("order"):
        return Change("position order", change.joints, order=change.places)
    return change


def _mounted(model: RobotModel, change: Change, mountings: Mapping[str, RobotModel]) -> RobotModel:
    return mountings[change.name] if change.meaning in _GRAVITIES else model


def _moved(model: RobotModel, samples: Samples, change: Change) -> Samples:
    """Return samples with signs, orders, unit or zero of the joints changed."""
    meaning = change.meaning
    joints = change.joints
    motion = samples.motion
    if meaning in _GRAVITIES:
        return samples
    if meaning.endswith("order"):
        return _reordered(model, samples, change)
    if meaning in ("torque sign", "axis sign", "angle sum", "angle difference"):
        return corrected(model, samples, Fault(meaning, joints))
    if meaning == "position sign":
        turned = corrected(model, samples, Fault("axis sign", joints))
        return corrected(model, turned, Fault("torque sign", joints))
    if meaning == "zero":
        position = motion.position.copy()
        position[:, list(joints)] += change.size
        motion = motion._replace(position=position)
    else:
        factor = _DEGREE if meaning == "degrees" else 1.0 / _DEGREE
        motion = motion._replace(
            position=factor * motion.position,
            velocity=factor * motion.velocity,
            acceleration=factor * motion.acceleration,
        )
    return replace(samples, motion=motion, mask=None).with_friction_direction(model)


def _reordered(model: RobotModel, samples: Samples, change: Change) -> Samples:
    """Return samples with joints read from other places."""
    order = np.array(_whole_order(change, model.n_joints))
    motion = samples.motion
    torque = samples.torque
    usable = samples.usable
    if change.meaning != "torque order":
        load = None if motion.load is None else motion.load[:, order]
        motion = motion._replace(
            position=motion.position[:, order],
            velocity=motion.velocity[:, order],
            acceleration=motion.acceleration[:, order],
            direction=None,
            load=load,
        )
        usable = usable[:, order]
    if change.meaning != "position order":
        torque = torque[:, order]
    result = replace(samples, motion=motion, torque=torque, usable=usable, mask=None)
    return result.with_friction_direction(model)


def _best_orders(fits: _Fits, kind: Meaning, starts: int) -> list[tuple[int, ...]]:
    """Return the orders of least error on few rows."""
    errors: dict[tuple[int, ...], float] = {}

    def error(order: tuple[int, ...]) -> float:
        if order not in errors:
            errors[order] = fits.error(_order_change(kind, order))
        return errors[order]

    n = fits.model.n_joints
    rng = np.random.default_rng(0)
    reached: list[tuple[int, ...]] = []
    for start in range(starts):
        order = tuple(range(n)) if start == 0 else tuple(rng.permutation(n).tolist())
        while True:
            others = [_exchanged(order, pair) for pair in combinations(range(n), 2)]
            best = min(others, key=error)
            if error(best) >= error(order):
                break
            order = best
        reached.append(order)
        if reached.count(min(reached, key=error)) > 1:
            break
    return sorted(errors, key=lambda order: errors[order])[:_ORDERS]


def _exchanged(order: tuple[int, ...], pair: tuple[int, int]) -> tuple[int, ...]:
    places = list(order)
    first, second = pair
    places[first], places[second] = places[second], places[first]
    return tuple(places)


def _order_change(meaning: Meaning, order: tuple[int, ...]) -> Change:
    """Return the change to a whole order of n joints, with those that move alone."""
    joints = tuple(joint for joint, place in enumerate(order) if joint != place)
    return Change(meaning, joints, order=tuple(order[joint] for joint in joints))


def _whole_order(change: Change, joints: int) -> tuple[int, ...]:
    """Return the places of all n joints under a change of order."""
    order = list(range(joints))
    for joint, place in zip(change.joints, change.places, strict=True):
        order[joint] = place
    return tuple(order)


def _is_better(against: Comparison) -> bool:
    """Whether a change reduces the error by more than chance, of all that are tried."""
    if against.ratio < 1.0 - _LARGE and against.sigmas < -SEPARATE:
        return True
    return against.ratio < 1.0 - _LEAST_GAIN and against.sigmas < -SURE


def _differs(change: Change, other: Change) -> bool:
    """Whether two changes are not angles of one zero."""
    is_zero = change.meaning == other.meaning == "zero" and change.joints == other.joints
    return change != other and not is_zero


def _thinned(samples: Samples, rows: int) -> Samples:
    return samples.thinned(max(1, len(samples.torque) // rows))


def _factor(model: RobotModel, samples: Samples) -> Factor:
    index = np.arange(len(samples.torque)) * _BLOCKS // max(1, len(samples.torque))
    return Factor.of(model, samples, index=index)


def score_of(model: RobotModel, samples: Samples, columns: NDArray[np.intp] | None = None) -> Score:
    """Predict every fifth of `_BLOCKS` blocks of samples from the others.

    `columns` are those of the recorded torque that the joints are read from, by default in order.
    """
    columns = np.arange(model.n_joints) if columns is None else columns
    factor = _factor(model, samples)
    prior = body_prior(model, factor).gaussian
    squares = np.zeros((len(factor), factor.n_joints))
    weights: Array | None = None
    estimates: list[Array] = []
    for fold in range(_FOLDS):
        left_out = np.arange(len(factor)) % _FOLDS == fold
        values, weights = posterior_values(
            factor.without(left_out), prior, _ROWS_PER_FACT_LEFT_OUT, weights
        )
        estimates.append(values)
        squares[left_out] = _squares(factor, values, left_out)
    friction = np.array(estimates) @ _friction_columns(model, samples).T
    deviation = np.sqrt((_FOLDS - 1) * friction.var(axis=0))
    torque = factor.gram[:, -1, -1]
    rms = np.maximum(np.sqrt(torque / np.maximum(factor.samples, 1)), 1e-300)
    mean = friction.mean(axis=0)
    return Score(squares, torque, mean / np.maximum(deviation, 1e-300), mean / rms, columns)


def inertial_torque(model: RobotModel, samples: Samples) -> Array:
    """Return the torque of each joint's own RMS acceleration (n,) [N·m or N], by a fit.

    It is negative where the fit has a negative inertia about the axis.
    """
    factor = Factor.of(model, samples)
    prior = body_prior(model, factor).gaussian
    values = posterior_values(factor, prior, _ROWS_PER_FACT)[0]
    motion = samples.motion
    position = motion.position[:: max(1, len(motion.position) // _POSTURES)]
    still = np.zeros_like(position)
    weight = model.torque(values, position, still, still)
    units = np.eye(model.n_joints)
    inertia = np.array(
        [
            np.mean(
                model.torque(values, position, still, still + unit)[:, joint] - weight[:, joint]
            )
            for joint, unit in enumerate(units)
        ]
    )
    acceleration = np.sqrt(np.mean(motion.acceleration**2, axis=0))
    return np.asarray(inertia * acceleration)


def _squares(factor: Factor, values: Array, blocks: slice | NDArray[np.bool_]) -> Array:
    """Return the squared errors of parameters in some blocks (B, n)."""
    squares = []
    for gram, columns in zip(factor.matrices, factor.columns, strict=True):
        residual = np.append(-values[columns], 1.0)
        squares.append((gram[blocks] @ residual) @ residual)
    return np.asarray(np.maximum(np.column_stack(squares), 0.0))


def _friction_columns(model: RobotModel, samples: Samples) -> Array:
    """Return the friction of each joint at a usual speed as a sum of the parameters (n, p)."""
    speed = np.quantile(np.abs(samples.motion.velocity), _SPEED, axis=0)
    columns = np.zeros((model.n_joints, model.n_parameters))
    for place, (_, term, joint, motor, _) in enumerate(model.friction.terms, model.base.rank):
        if not motor and term.is_friction and not term.of_load:
            law = model.friction.laws[joint]
            here = speed[joint : joint + 1]
            columns[joint, place] = term.column(here, law.sign(here))[0]
    return columns


def compare(score: Score, other: Score, model: RobotModel) -> Comparison:
    """Compare two readings, torque by torque and block by block; small torques aside.

    A torque is compared with itself, whichever joint it is read as.
    """
    at = other.joints
    torque = np.sqrt(other.torque)[at]
    counts = (torque > 0.0) & ~little_torque(torque, ~np.array(model.chain.revolute)[at])
    mine = score.squares[:, score.joints[counts]]
    its = other.squares[:, at[counts]]
    tested = (mine > 0.0) & (its > 0.0)
    totals = np.where(tested, mine, 0.0).sum(axis=0), np.where(tested, its, 0.0).sum(axis=0)
    both = (totals[0] > 0.0) & (totals[1] > 0.0)
    joints = np.ones(len(counts))
    joints[np.flatnonzero(counts)[both]] = np.sqrt(totals[0][both] / totals[1][both])
    if not both.any():
        return Comparison(1.0, 0.0, joints)
    ratio = float(np.exp(np.log(joints[counts]).mean()))
    change = np.zeros(tested.shape)
    change[tested] = 0.5 * np.log(mine[tested] / its[tested])
    return Comparison(ratio, _sigmas(change[tested.any(axis=1)].mean(axis=1)), joints)


def _sigmas(changes: Array) -> float:
    """Return the mean of changes by block over its standard error."""
    error = float(np.std(changes, ddof=1)) / np.sqrt(len(changes)) if len(changes) > 1 else np.inf
    return float(changes.mean() / error) if error > 0.0 else 0.0


def _kind(change: Change) -> tuple[Meaning, tuple[int, ...]]:
    """Return the meaning of a change, with its joints where each has a sign or a zero of its own.

    All joints are one: an arm that hangs weighs as one that stands, all torques negated.
    """
    return change.meaning, change.joints if change.meaning in (*_SIGNS, "zero") else ()


def _alternatives(change: Change) -> Iterator[Change]:
    """Yield the changes that may have the same effect as one that was found."""
    for kinds in (_SIGNS[:2], _IN_ORDER):
        if change.meaning in kinds:
            yield from (change._replace(meaning=kind) for kind in kinds if kind != change.meaning)


class Axes(NamedTuple):
    """Where the joints of a recording are in what was recorded, and how to convert them.

    A quantity as read is ``sign * recorded[:, order]``; positions are multiplied by `factor`, and
    `zero` [rad] is added: angles that may each contain that of other joints, ``coupling @ angles``.
    """

    position_order: NDArray[np.intp]
    position_sign: Array
    torque_order: NDArray[np.intp]
    torque_sign: Array
    factor: float
    zero: Array
    coupling: Array  # (n, n)

    @classmethod
    def of(cls, changes: Iterable[Change], joints: int) -> Axes:
        """Return the axes after changes, one after the other."""
        axes = cls(
            np.arange(joints), np.ones(joints), np.arange(joints), np.ones(joints), 1.0,
            np.zeros(joints), np.eye(joints),
        )  # fmt: skip
        for change in changes:
            axes = axes._after(change)
        return axes

    def _after(self, change: Change) -> Axes:
        meaning = change.meaning
        joints = list(change.joints)
        order = np.arange(len(self.zero))
        sign = np.ones(len(self.zero))
        if meaning.endswith("order"):
            order[joints] = change.places
        elif meaning.endswith("sign"):
            sign[joints] = -1.0
        axes = self
        if meaning in ("position order", "joint order", "position sign", "axis sign"):
            axes = axes._replace(
                position_order=axes.position_order[order],
                position_sign=axes.position_sign[order] * sign,
                zero=axes.zero[order] * sign,
                coupling=axes.coupling[np.ix_(order, order)] * np.outer(sign, sign),
            )
        if meaning in ("torque order", "joint order", "torque sign", "axis sign"):
            axes = axes._replace(
                torque_order=axes.torque_order[order], torque_sign=axes.torque_sign[order] * sign
            )
        if meaning in ("degrees", "radians"):
            factor = _DEGREE if meaning == "degrees" else 1.0 / _DEGREE
            axes = axes._replace(factor=axes.factor * factor, zero=axes.zero * factor)
        if meaning == "zero":
            zero = np.zeros(len(self.zero))
            zero[joints] = change.size
            axes = axes._replace(zero=axes.zero + axes.coupling @ zero)
        if meaning in COUPLED:
            with_other = np.eye(len(self.zero))
            with_other[change.joints] = 1.0 if meaning == "angle sum" else -1.0
            axes = axes._replace(coupling=axes.coupling @ with_other)
        return axes

    def read(self, recording: Recording) -> Recording:
        """Return a recording as read."""
        scale = self.factor * self.position_sign
        uncoupled = np.linalg.inv(self.coupling).T
        velocity = recording.velocity
        torque = recording.torque
        return replace(
            recording,
            position=(recording.position[:, self.position_order] * scale + self.zero) @ uncoupled,
            velocity=None
            if velocity is None
            else velocity[:, self.position_order] * scale @ uncoupled,
            torque=None if torque is None else torque[:, self.torque_order] * self.torque_sign,
        )
