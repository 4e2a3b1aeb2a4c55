"""Other readings of a recording: sign, order, unit and zero of its joints, gravity in its torque.

The torque of every fifth block is predicted from the others, as in
:mod:`identification.validation.causes`, whose corrections of signs and orders are used: as read and
with one reading after the other. Signs are also decided by friction, which takes energy from a
joint. The best reading is adopted if it is significant, and the search is repeated with it.
Parameters have the prior of :mod:`identification.estimators.prior`, so that geometry alone is
enough and masses help where they are known.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.estimators.prior import GaussianPrior, body_prior, posterior_values
from identification.factor.factor import Factor
from identification.model.robot import RobotModel
from identification.signals.recording import Recording
from identification.signals.samples import Samples
from identification.validation.causes import Fault, Kind, corrected
from identification.validation.finding import little_torque

Array = NDArray[np.float64]
Meaning = Literal[
    "torque sign",
    "position sign",
    "axis sign",
    "torque order",
    "position order",
    "joint order",
    "degrees",
    "radians",
    "zero",
    "no gravity",
    "mounting",
]

SURE: Final = 4.5
"""Standard errors over the blocks of a reading that is sure, whatever the number tried: with 19
degrees of freedom one of 4 000 exceeds it by chance."""
_SEPARATE: Final = 3.0  # standard errors by which the second best reading is worse
_LEAST_GAIN: Final = 0.02  # relative reduction of the error of a reading that is adopted
_ALIKE: Final = 0.05  # the same, of readings that fit alike
_HARM: Final = 1.1  # error ratio of a joint beyond which a reading spoils it
_DISSIPATES: Final = 4.0  # standard errors of a friction that drives a joint
_LEAST_FRICTION: Final = 0.02  # of the torque of a joint
_ROWS: Final = 700
_BLOCKS: Final = 20
_FOLDS: Final = 5
# Rows that count as one beside the prior: seven in all. A wrong reading needs bodies that no arm
# has, which a weak prior would allow.
_ROWS_PER_FACT: Final = 100.0
_LARGE: Final = 0.15  # relative reduction of the error that chance alone does not make
_CLEAR: Final = 3.0  # standard errors of a reading that reduces the error so much
_POOR: Final = 0.15  # error of the torque from which on whole orders are always searched for
_STARTS: Final = 8
_FEWER_ROWS: Final = 200  # on which orders are tried
_IMPROVES: Final = 0.98  # error ratio of one exchange from which a whole order is searched for
_CLOSER: Final = 24  # changes of least error on a fifth of the blocks, which are tried on all
_MOST_STEPS: Final = 6
_SPEED: Final = 0.9  # quantile of the speed at which friction is judged
_ZEROS: Final = (-90.0, -45.0, -20.0, 20.0, 45.0, 90.0, 180.0)  # deg
_NEARER: Final = (-0.5, -0.25, 0.25, 0.5)  # of a zero, tried about it
_DEGREE: Final = np.pi / 180.0


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


@dataclass(frozen=True, eq=False)
class Score:
    """Errors of predicted blocks under one reading.

    Attributes:
        squares: squared errors (B, n).
        torque: squared torque (n,).
        friction: at a usual speed, over its standard error (n,); negative drives the joint.
        share: that friction over the RMS torque (n,).
    """

    squares: Array
    torque: Array
    friction: Array
    share: Array

    @property
    def relative(self) -> Array:
        """Errors as shares of the torque (n,)."""
        torque = np.where(self.torque > 0.0, self.torque, 1.0)
        return np.asarray(np.sqrt(self.squares.sum(axis=0) / torque))

    @property
    def overall(self) -> float:
        """Error over all joints as a share of the torque."""
        return float(np.sqrt(self.squares.sum() / max(self.torque.sum(), 1e-300)))


class Comparison(NamedTuple):
    """Errors of one reading over those of another: mean over the joints, and of each."""

    ratio: float
    sigmas: float  # negative if the first is better
    joints: Array  # (n,)

    @property
    def spoils(self) -> bool:
        """Whether a joint is predicted worse."""
        return bool(np.any(self.joints > _HARM))


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
    def sure(self) -> bool:
        """Whether nothing else fits alike."""
        return not self.alike


@dataclass(frozen=True, eq=False)
class Readings:
    """How a recording is to be read.

    Attributes:
        steps: changes of what was recorded, in order.
        model: with the gravity that was found.
        samples: few rows, as read.
        score: of these.
        nearest: by meaning, the change that comes nearest to the reading found, compared with it.
    """

    steps: tuple[Step, ...]
    model: RobotModel
    samples: Samples
    score: Score
    nearest: Mapping[Meaning, tuple[Change, Comparison]]


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
    few = samples.thinned(max(1, len(samples.torque) // _ROWS))

    def started() -> _Search:
        return _Search(model, few, mountings or {}, unit_is_open=unit_is_open)

    search = started()
    steps: list[Step] = []
    while len(steps) < _MOST_STEPS:
        step = search.by_prediction() or search.by_friction()
        if step is None:
            break
        steps.append(step)
    if len(steps) > 1:
        again = started()
        single = again.single_as_good_as(search.score)
        if single is not None:
            search, steps = again, [single]
    return Readings(tuple(steps), search.model, search.samples, search.score, search.nearest())


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
        self.model, self.samples = model, samples
        self._mountings = mountings
        self._unit_is_open = unit_is_open
        self.score = score_of(model, samples)
        self._prior = _prior(model, samples)
        self._trials: list[Trial] | None = None

    def by_friction(self) -> Step | None:
        """Adopt the sign of joints that friction would drive; None if it drives none."""
        driven = (self.score.friction < -_DISSIPATES) & (self.score.share < -_LEAST_FRICTION)
        joints = tuple(np.flatnonzero(driven).tolist())
        if not joints:
            return None
        moved = np.abs(self.score.friction) > _DISSIPATES
        kinds: tuple[Meaning, ...] = ("torque sign", "position sign")
        if int(driven.sum()) >= max(2, int(moved.sum())):
            kinds = ("torque sign",)
            joints = tuple(range(self.model.n_joints))
        trials = [self._try(Change(kind, joints)) for kind in kinds]
        best = min(trials, key=lambda trial: trial.against.ratio)
        if best.against.ratio > 1.0 + _ALIKE or best.against.sigmas > SURE:
            return None
        return self._adopt(best)

    def by_prediction(self) -> Step | None:
        """Adopt the change that predicts best; None if none is significant."""
        trials = self._tried()
        trials = [*trials, *self._orders(trials)]
        good = [trial for trial in trials if _is_better(trial.against)]
        good = [trial for trial in good if not self._is_spoilt(trial)]
        if not good:
            return None
        best = min(good, key=lambda trial: trial.against.ratio)
        if best.change.meaning == "zero":
            best = self._nearer(best)
        return self._adopt(best)

    def single_as_good_as(self, score: Score) -> Step | None:
        """Adopt the one change that predicts as well as several do; None if none does."""
        trials = [
            trial
            for trial in self._tried()
            if compare(trial.score, score, self.model).sigmas < _SEPARATE
            and trial.score.overall < (1.0 + _ALIKE) * score.overall
        ]
        if not trials:
            return None
        return self._adopt(min(trials, key=lambda trial: trial.score.overall))

    def nearest(self) -> dict[Meaning, tuple[Change, Comparison]]:
        """Return by meaning the change that comes nearest to the reading found."""
        nearest: dict[Meaning, tuple[Change, Comparison]] = {}
        for trial in self._tried():
            meaning = trial.change.meaning
            if meaning not in nearest or trial.against.ratio < nearest[meaning][1].ratio:
                nearest[meaning] = trial.change, trial.against
        return nearest

    def _orders(self, trials: Sequence[Trial]) -> Iterator[Trial]:
        """Yield whole orders: from several starts, the best exchange while the error falls."""
        kinds: tuple[Meaning, ...] = ("torque order", "position order", "joint order")
        is_poor = self.score.overall > _POOR
        for kind in kinds:
            own = [trial for trial in trials if trial.change.meaning == kind]
            if not is_poor and not any(trial.against.ratio < _IMPROVES for trial in own):
                continue
            order = self._best_order(kind, _STARTS if is_poor else 1)
            change = _order_change(kind, order)
            if len(change.joints) > 2:
                yield self._try(change)

    def _best_order(self, kind: Meaning, starts: int) -> tuple[int, ...]:
        """Return the order of least error on few rows."""
        few = self.samples.thinned(max(1, len(self.samples.torque) // _FEWER_ROWS))
        known: dict[tuple[int, ...], float] = {}

        def error(order: tuple[int, ...]) -> float:
            if order not in known:
                change = _order_change(kind, order)
                samples = _reordered(self.model, few, change) if change.joints else few
                known[order] = _error_of(score_of(self.model, samples, folds=1, prior=self._prior))
            return known[order]

        n, rng = self.model.n_joints, np.random.default_rng(0)
        for start in range(starts):
            order = tuple(range(n)) if start == 0 else tuple(rng.permutation(n).tolist())
            while True:
                others = [_exchanged(order, pair) for pair in combinations(range(n), 2)]
                best = min(others, key=error)
                if error(best) >= error(order):
                    break
                order = best
        return min(known, key=lambda order: known[order])

    def _is_spoilt(self, trial: Trial) -> bool:
        """Whether a change that concerns few joints predicts another one worse."""
        orders = trial.change.meaning.endswith("order")
        return trial.against.spoils and not orders

    def _adopt(self, best: Trial) -> Step:
        """Adopt a change, with those that fit alike."""
        others = []
        if len(best.change.joints) < self.model.n_joints:  # an arm and its mirror image move alike
            others = [self._try(change) for change in _alternatives(best.change)]
        alike = [
            (other.change, other.score.overall)
            for other in others
            if not self._is_spoilt(other)
            and compare(other.score, best.score, self.model).sigmas < _SEPARATE
            and other.score.overall < (1.0 + _ALIKE) * best.score.overall
        ]
        before = self.score.overall
        self.model, self.samples, self.score = best.model, best.samples, best.score
        self._prior, self._trials = _prior(self.model, self.samples), None
        ratio, sigmas, _ = best.against
        return Step(best.change, best.score.overall, before, ratio, sigmas, tuple(alike))

    def _tried(self) -> list[Trial]:
        """Return the changes of least error, tried on all blocks."""
        if self._trials is None:
            changes = list(self._changes())
            few = {change: self._error_of_few(change) for change in changes}
            ranked = sorted(changes, key=lambda change: few[change])
            closer = ranked[:_CLOSER]
            meanings = {change.meaning for change in closer}
            for change in ranked:
                if change.meaning not in meanings:
                    meanings.add(change.meaning)
                    closer.append(change)
            self._trials = [self._try(change) for change in closer]
        return self._trials

    def _error_of_few(self, change: Change) -> float:
        """Return the sum of the logarithms of squared errors of one fold with a change."""
        model, samples = self._changed(change)
        prior = self._prior if model is self.model else None
        return _error_of(score_of(model, samples, folds=1, prior=prior))

    def _nearer(self, best: Trial) -> Trial:
        """Return the trial of a zero with an angle that fits better."""
        for scale in (1.0, 0.25):
            sizes = [best.change.size * (1.0 + scale * part) for part in _NEARER]
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
        signs: tuple[Meaning, ...] = ("torque sign", "position sign", "axis sign")
        orders: tuple[Meaning, ...] = ("torque order", "position order", "joint order")
        for joint in range(n):
            if joint in moved:
                yield from (Change(kind, (joint,)) for kind in signs)
            if self.model.chain.revolute[joint]:
                yield from (Change("zero", (joint,), angle * _DEGREE) for angle in _ZEROS)
        for pair in combinations(moved, 2):
            yield from (Change(kind, pair) for kind in orders)

    def _try(self, change: Change) -> Trial:
        model, samples = self._changed(change)
        score = score_of(model, samples)
        return Trial(change, model, samples, score, compare(score, self.score, self.model))

    def _changed(self, change: Change) -> tuple[RobotModel, Samples]:
        model, samples, meaning = self.model, self.samples, change.meaning
        if meaning == "mounting":
            return self._mountings[change.name], samples
        if meaning == "no gravity":
            return self._mountings[""], samples
        return model, _moved(model, samples, change)


def _moved(model: RobotModel, samples: Samples, change: Change) -> Samples:
    """Return samples with signs, orders, unit or zero of the joints changed."""
    meaning, joints = change.meaning, change.joints
    motion = samples.motion
    if meaning.endswith("order"):
        return _reordered(model, samples, change)
    if meaning in ("torque sign", "axis sign"):
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


_FAULTS: Final[Mapping[str, Kind]] = {
    "torque order": "torque order",
    "position order": "position order",
    "joint order": "joint order",
}


def _reordered(model: RobotModel, samples: Samples, change: Change) -> Samples:
    """Return samples with joints read from other places, one exchange after the other."""
    order, now = np.arange(model.n_joints), np.arange(model.n_joints)
    order[list(change.joints)] = change.places
    for joint in range(model.n_joints):
        place = int(np.flatnonzero(now == order[joint])[0])
        if place != joint:
            now[[joint, place]] = now[[place, joint]]
            samples = corrected(model, samples, Fault(_FAULTS[change.meaning], (joint, place)))
    return samples


def _error_of(score: Score) -> float:
    squares = score.squares.sum(axis=0)
    return float(np.log(np.where(squares > 0.0, squares, 1.0)).sum())


def _exchanged(order: tuple[int, ...], pair: tuple[int, int]) -> tuple[int, ...]:
    places = list(order)
    first, second = pair
    places[first], places[second] = places[second], places[first]
    return tuple(places)


def _order_change(meaning: Meaning, order: tuple[int, ...]) -> Change:
    """Return the change to a whole order of n joints, with those that move alone."""
    joints = tuple(joint for joint, place in enumerate(order) if joint != place)
    return Change(meaning, joints, order=tuple(order[joint] for joint in joints))


def _is_better(against: Comparison) -> bool:
    """Whether a change reduces the error by more than chance, of all that are tried."""
    if against.ratio < 1.0 - _LARGE and against.sigmas < -_CLEAR:
        return True
    return against.ratio < 1.0 - _LEAST_GAIN and against.sigmas < -SURE


def _factor(model: RobotModel, samples: Samples) -> Factor:
    index = np.arange(len(samples.torque)) * _BLOCKS // max(1, len(samples.torque))
    return Factor.of(model, samples, index=index)


def _prior(model: RobotModel, samples: Samples) -> GaussianPrior:
    return body_prior(model, _factor(model, samples)).gaussian


def score_of(
    model: RobotModel,
    samples: Samples,
    *,
    folds: int = _FOLDS,
    prior: GaussianPrior | None = None,
) -> Score:
    """Predict every fifth of `_BLOCKS` blocks of samples from the others, or of `folds` of them.

    `prior` is that of :func:`identification.estimators.prior.body_prior` if it is known.
    """
    factor = _factor(model, samples)
    prior = prior or body_prior(model, factor).gaussian
    squares, weights, estimates = np.zeros((len(factor), factor.n_joints)), None, []
    for fold in range(folds):
        left_out = np.arange(len(factor)) % _FOLDS == fold
        values, weights = posterior_values(factor.without(left_out), prior, _ROWS_PER_FACT, weights)
        estimates.append(values)
        for joint, (gram, columns) in enumerate(zip(factor.matrices, factor.columns, strict=True)):
            residual = np.append(-values[columns], 1.0)
            squares[left_out, joint] = (gram[left_out] @ residual) @ residual
    torque = factor.gram[:, -1, -1]
    friction, deviation = _friction(model, samples, np.array(estimates))
    rms = np.sqrt(torque / np.maximum(factor.samples, 1))
    return Score(
        np.maximum(squares, 0.0),
        torque,
        friction / np.maximum(deviation, 1e-300),
        friction / np.maximum(rms, 1e-300),
    )


def _friction(model: RobotModel, samples: Samples, estimates: Array) -> tuple[Array, Array]:
    """Return the friction of each joint at a usual speed and its jackknife deviation (n,), (n,).

    `estimates` are the parameters without each fold (F, p).
    """
    speed = np.quantile(np.abs(samples.motion.velocity), _SPEED, axis=0)
    columns = np.zeros((model.n_joints, model.n_parameters))
    for place, (_, term, joint, motor, _) in enumerate(model.friction.terms, model.base.rank):
        if not motor and term.is_friction and not term.of_load:
            law, here = model.friction.laws[joint], speed[joint : joint + 1]
            columns[joint, place] = term.column(here, law.sign(here))[0]
    friction = estimates @ columns.T
    count = len(estimates)
    return friction.mean(axis=0), np.sqrt((count - 1) * friction.var(axis=0))


def compare(score: Score, other: Score, model: RobotModel) -> Comparison:
    """Compare two readings, joint by joint and block by block; joints with little torque aside."""
    torque = np.sqrt(other.torque)
    counts = (torque > 0.0) & ~little_torque(torque, ~np.array(model.chain.revolute))
    mine, its = score.squares[:, counts], other.squares[:, counts]
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
    blocks = change[tested.any(axis=1)].mean(axis=1)
    error = float(np.std(blocks, ddof=1)) / np.sqrt(len(blocks)) if len(blocks) > 1 else np.inf
    sigmas = float(blocks.mean() / error) if error > 0.0 else 0.0
    return Comparison(ratio, sigmas, joints)


def _alternatives(change: Change) -> Iterator[Change]:
    """Yield the changes that may have the same effect as one that was found."""
    signs: tuple[Meaning, ...] = ("torque sign", "position sign")
    orders: tuple[Meaning, ...] = ("torque order", "position order", "joint order")
    for kinds in (signs, orders):
        if change.meaning in kinds:
            yield from (change._replace(meaning=kind) for kind in kinds if kind != change.meaning)


class Axes(NamedTuple):
    """Where the joints of a recording are in what was recorded, and how to convert them.

    A quantity as read is ``sign * recorded[:, order]``; positions are multiplied by `factor`, and
    `zero` [rad] is added.
    """

    position_order: NDArray[np.intp]
    position_sign: Array
    torque_order: NDArray[np.intp]
    torque_sign: Array
    factor: float
    zero: Array

    @classmethod
    def of(cls, changes: Iterable[Change], joints: int) -> Axes:
        """Return the axes after changes, one after the other."""
        axes = cls(
            np.arange(joints), np.ones(joints), np.arange(joints), np.ones(joints), 1.0,
            np.zeros(joints),
        )  # fmt: skip
        for change in changes:
            axes = axes._after(change)
        return axes

    def _after(self, change: Change) -> Axes:
        meaning, own = change.meaning, list(change.joints)
        order, sign = np.arange(len(self.zero)), np.ones(len(self.zero))
        if meaning.endswith("order"):
            order[own] = change.places
        elif meaning.endswith("sign"):
            sign[own] = -1.0
        axes = self
        if meaning in ("position order", "joint order", "position sign", "axis sign"):
            axes = axes._replace(
                position_order=axes.position_order[order],
                position_sign=axes.position_sign[order] * sign,
                zero=axes.zero[order] * sign,
            )
        if meaning in ("torque order", "joint order", "torque sign", "axis sign"):
            axes = axes._replace(
                torque_order=axes.torque_order[order], torque_sign=axes.torque_sign[order] * sign
            )
        if meaning in ("degrees", "radians"):
            factor = _DEGREE if meaning == "degrees" else 1.0 / _DEGREE
            axes = axes._replace(factor=axes.factor * factor, zero=axes.zero * factor)
        if meaning == "zero":
            zero = axes.zero.copy()
            zero[own] += change.size
            axes = axes._replace(zero=zero)
        return axes

    def read(self, recording: Recording) -> Recording:
        """Return a recording as read."""
        scale = self.factor * self.position_sign
        velocity, torque = recording.velocity, recording.torque
        return replace(
            recording,
            position=recording.position[:, self.position_order] * scale + self.zero,
            velocity=None if velocity is None else velocity[:, self.position_order] * scale,
            torque=None if torque is None else torque[:, self.torque_order] * self.torque_sign,
        )
