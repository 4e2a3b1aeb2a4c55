"""Faults of recordings whose correction predicts parts of the fitted motion better.

The torque of every fifth block is predicted from the others, as measured and with one fault after
the other corrected. The fault whose correction reduces the error most is named if the reduction is
significant and explains the error of the fit: what is left is near the noise, near the error of the
other joints, or near that of separate parameters for the affected part. The search is repeated with
it corrected. All but faults of positions are linear in the columns of one table per joint, whose
Gram matrices are computed once. A fault of positions is first tried on fewer rows.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.factor.factor import Factor, joined, solve_with_ridge
from identification.model.motion import Motion
from identification.model.regressor import LINK_SYMBOLS, RegressorPlan
from identification.model.robot import RobotModel
from identification.signals.recording import STUCK_MOVEMENT
from identification.signals.samples import Samples
from identification.validation.prediction import noise_floor

Array = NDArray[np.float64]
Kind = Literal[
    "delay",
    "gain",
    "torque sign",
    "torque order",
    "axis sign",
    "position order",
    "joint order",
    "angle sum",
    "angle difference",
    "payload",
    "load friction",
    "changed gain",
    "changed friction",
    "changed arm",
]

# Standard errors over the blocks, and relative reduction of the error, of a significant correction.
SIGMAS: Final = 3.0
LEAST_GAIN: Final = 0.1
_ALIKE: Final = 1.05  # error ratio up to which a fault with fewer coefficients is preferred
# Largest relative error of each joint with a corrected sign or order: more error than that means
# another cause.
_EXPLAINED: Final = 0.5
# Ratio of the fit's error on the affected joints, with the correction over that without: 0.55 is
# 70 % of the squared error. True faults of simulated and real arms, without noise known: at most
# 0.5, a payload in half of a recording 0.66; false ones: at least 0.9.
_EXPLAINS: Final = 0.55
# Relative error of each joint without which no columns are interchanged.
_SMALL_ERROR: Final = 0.02
# Noise floors without which no axis turns the other way. An arm whose base turns the other way is
# nearly its own mirror image, which other parameters fit to some per cent.
_LITTLE_MORE: Final = 1.05
_STANDS_OUT: Final = 0.7  # the same, if the joint then is as good as the others
_SAME_PART: Final = 0.85  # the same, if separate parameters for the part do no better
_NEAR_NOISE: Final = 2.0  # noise floors; those of coloured noise are underestimated by a third
_NOISE_OF: Final = 3  # recordings
_NO_TORQUE: Final = 1e-20  # squared torque of an axis that counts, as a share of the largest
_NEAR_SEPARATE: Final = 1.1  # error ratio to separate parameters
_MOST_CAUSES: Final = 4
# Rows and blocks of all recordings together.
_MOST_ROWS: Final = 3000
_FEW_ROWS: Final = 600  # on which faults of positions are tried first
_BLOCKS: Final = 10
_FOLDS: Final = 5
_FEWEST_ROWS: Final = 10
_FEWEST_BLOCKS: Final = 2
_JOINTS_BEFORE: Final = 2  # an angle contains that of one of them; parallel axes are neighbours, or
# have one across them in between
# Ridge as a share of each column's information, for columns that the motion hardly determines.
_RIDGE: Final = 1e-6
_LOAD: Final = len(LINK_SYMBOLS)
_MASS: Final = LINK_SYMBOLS.index("m")
_COUPLED: Final[tuple[Kind, ...]] = ("angle sum", "angle difference")
_OF_MOTION: Final[tuple[Kind, ...]] = ("axis sign", "position order", "joint order", *_COUPLED)
_OF_TORQUE: Final = ("torque sign", "torque order")


class Part(NamedTuple):
    """Part of the blocks of the fitted recordings."""

    name: str  # such as "A.mcap", or "A.mcap from 3 s on"
    blocks: tuple[bool, ...]  # mask over the blocks (B,)


class Fault(NamedTuple):
    """Possible fault of recordings."""

    kind: Kind  # of fault
    # affected joints; all if empty. Of a coupled angle: its own, and the one that it contains
    joints: tuple[int, ...] = ()
    part: Part | None = None  # affected part of the recordings; None for all

    @property
    def discrete(self) -> bool:
        """Whether the fault has no size, as a sign or an order."""
        return self.kind in (*_OF_MOTION, *_OF_TORQUE)


class Cause(NamedTuple):
    """Fault that explains errors."""

    fault: Fault
    # error of predicted blocks with the correction over that without: geometric mean over joints
    ratio: float
    size: float | None  # delay [s], factor less one, or mass [kg]; None without size
    std: float  # standard deviation over the blocks


def find_causes(
    model: RobotModel,
    recordings: Sequence[Samples],
    values: Array,
    names: Sequence[str] = (),
    *,
    noise: Array | None = None,
) -> tuple[Cause, ...]:
    """Find faults that explain the error of values (p,) from the recordings, by their effect.

    `noise` is the standard deviation of each joint's torque noise (n,) [N·m or N], by default that
    of the residual at high frequencies.
    """
    if noise is None:
        noise = noise_floor(model, values, recordings[:_NOISE_OF])
    recording_names = tuple(names) or tuple(f"recording {k + 1}" for k in range(len(recordings)))
    search = _Search(model, recordings, values, recording_names, noise)
    causes: list[Cause] = []
    while len(causes) < _MOST_CAUSES and (trial := _best(search.trials())) is not None:
        causes.append(search.resized(trial))
        if trial.cause.fault.kind == "changed arm":
            break  # with separate parameters nothing is left to compare
        search.correct(trial.cause.fault)
    return tuple(causes)


class _Trial(NamedTuple):
    """Correction of one fault."""

    cause: Cause  # the fault
    highest: float  # upper limit of its ratio
    coefficients: int  # added coefficients
    left: float  # remaining relative error of the worst of its joints
    values: Array  # parameters (p,) fitted with it
    explains: bool  # whether it explains the error of the fit

    @property
    def better(self) -> bool:
        """Whether the correction reduces the error significantly, and explains it."""
        explained = self.explains and (not self.cause.fault.discrete or self.left < _EXPLAINED)
        return explained and self.cause.ratio < 1.0 - LEAST_GAIN and self.highest < 1.0

    def ambiguous_with(self, other: _Trial) -> bool:
        """Return whether another order, or order instead of sign, explains nearly as much."""
        mine = self.cause.fault
        its = other.cause.fault
        return (
            mine.discrete
            and its.discrete
            and not (mine.kind.endswith("sign") and its.kind.endswith("sign"))
            and mine.joints != its.joints
            and (1.0 - LEAST_GAIN) * other.cause.ratio < self.cause.ratio
        )


def _best(trials: Sequence[_Trial]) -> _Trial | None:
    """Return the significant trial of least error, with few coefficients preferred."""
    better = [trial for trial in trials if trial.better]
    least = min((trial.cause.ratio for trial in better), default=0.0)
    alike = [trial for trial in better if trial.cause.ratio <= _ALIKE * least]
    best = min(alike, key=lambda trial: (trial.coefficients, trial.cause.ratio), default=None)
    return best if best and not any(best.ambiguous_with(trial) for trial in better) else None


class _Search:
    """Recordings with the faults corrected that were found."""

    def __init__(
        self,
        model: RobotModel,
        recordings: Sequence[Samples],
        values: Array,
        names: Sequence[str],
        noise: Array | None = None,
    ) -> None:
        self._model = model
        self._values = values
        self._names = names
        self._noise = np.zeros(model.n_joints) if noise is None else np.nan_to_num(noise)
        travel = np.max([np.ptp(samples.motion.position, axis=0) for samples in recordings], axis=0)
        self._moved = np.flatnonzero(travel > STUCK_MOVEMENT)
        self._recordings = recordings
        self._few = _Few.of(model, recordings)
        self._known: list[Fault] = []
        self._motion_tables: dict[Fault, _Tables] = {}  # cache: faults of the motion

    def correct(self, fault: Fault) -> None:
        """Correct a fault in all following trials."""
        if fault.discrete:
            self._recordings = [
                corrected(self._model, samples, fault) for samples in self._recordings
            ]
            self._few = _Few.of(self._model, self._recordings)
            self._motion_tables.clear()
        else:
            self._known.append(fault)

    def trials(self) -> list[_Trial]:
        """Try the correction of each fault."""
        model = self._model
        values = self._values
        tables = _Tables.of(model, self._recordings, values)
        target = tables.torques
        none = np.zeros((*tables.gram.shape[:3], 0))
        corrections = [_columns_of(tables, model, values, earlier) for earlier in self._known]
        before = np.concatenate([none, *corrections], axis=3)
        usual = _score(tables, before, target)
        noise = self._noise**2 * tables.rows.sum(axis=0)
        separate: dict[Part | None, _Score] = {}
        excluded = self._excluded(usual, noise)
        trials = []
        for fault in self._faults(tables):
            added = none
            measured = target.copy()
            seen = tables
            joints = list(fault.joints)
            if fault.part is not None:
                if fault.part not in separate:
                    every = _columns_of(tables, model, values, Fault("changed arm", (), fault.part))
                    columns = np.concatenate([every, before], axis=3)
                    separate[fault.part] = _score(tables, columns, target)
                # All that may have changed is within separate parameters.
                if separate[fault.part].fit_ratio_to(usual) > 1.0 - LEAST_GAIN:
                    continue
            if fault.kind in _OF_MOTION:
                if fault.kind in excluded or not self._few.improved_by(fault):
                    continue
                if fault not in self._motion_tables:
                    moved = [corrected(model, samples, fault) for samples in self._recordings]
                    self._motion_tables[fault] = _Tables.of(model, moved, values)
                seen = self._motion_tables[fault]
            elif fault.kind == "torque sign":
                measured[joints] *= -1.0
            elif fault.kind == "torque order":
                measured[joints] = target[joints[::-1]]
            else:
                added = _columns_of(tables, model, values, fault)
                if not added.any():
                    continue  # such as friction of a frictionless joint
            score = _score(seen, np.concatenate([added, before], axis=3), measured)
            explains = score.explains(joints, usual, noise, separate.get(fault.part))
            ratio, highest = score.ratio_to(usual)
            size, std = _size(fault, score, tables, added)
            worst = float(np.sqrt(score.shares(score.squares.sum(axis=0))[joints].max(initial=0.0)))
            if fault.kind == "load friction" and (size or 0.0) <= 0.0:
                continue  # friction dissipates
            trials.append(
                _Trial(
                    cause=Cause(fault, ratio, size, std),
                    highest=highest,
                    coefficients=added.shape[3],
                    left=worst,
                    values=score.values.mean(axis=0),
                    explains=explains,
                )
            )
        return trials

    def _excluded(self, usual: _Score, noise: Array) -> tuple[Kind, ...]:
        """Return the kinds of faults of positions that would leave more error."""
        if np.all(usual.fitted <= _LITTLE_MORE**2 * noise):
            return _OF_MOTION
        in_order = np.all(usual.shares(usual.fitted) < _SMALL_ERROR**2)
        return ("position order", "joint order", *_COUPLED) if in_order else ()

    def resized(self, trial: _Trial) -> Cause:
        """Return the cause of a trial; the load of friction is that of the parameters beside it."""
        cause = trial.cause
        if cause.fault.kind != "load friction":
            return cause
        tables = _Tables.of(self._model, self._recordings, trial.values)
        columns = [
            _columns_of(tables, self._model, trial.values, fault)
            for fault in (cause.fault, *self._known)
        ]
        score = _score(tables, np.concatenate(columns, axis=3), tables.torques)
        size, std = _size(cause.fault, score, tables, columns[0])
        return cause._replace(size=size, std=std)

    def _faults(self, tables: _Tables) -> Iterator[Fault]:
        kinds: tuple[Kind, ...] = ("delay", "gain", "torque sign", "axis sign")
        orders: tuple[Kind, ...] = ("torque order", "position order", "joint order")
        yield from (Fault("delay"), Fault("load friction"))
        changes = [Fault("payload"), Fault("changed arm")]
        # What a joint that stands still does says nothing about its order, sign or gain.
        moved = self._moved.tolist()
        for pair in coupled_pairs(self._model, moved):
            yield from (Fault(kind, pair) for kind in _COUPLED)
        for j in moved:
            yield from (Fault(kind, (j,)) for kind in kinds)
            yield from (Fault(kind, (k, j)) for k in moved if k < j for kind in orders)
            changes += [Fault("changed gain", (j,)), Fault("changed friction", (j,))]
        for part in self._later_parts(tables):
            yield from (fault._replace(part=part) for fault in changes)
        if len(self._recordings) > 2:
            for fault in changes:
                yield fault._replace(part=self._other_recordings(tables, fault))

    def _other_recordings(self, tables: _Tables, fault: Fault) -> Part:
        """Return the recordings in which a fault is largest, estimated separately in each."""
        model = self._model
        alike = fault
        columns = []
        if fault.kind == "changed arm":
            alike = Fault("payload")
        for k in range(1, len(self._recordings)):
            part = Part(self._names[k], tuple((tables.recording == k).tolist()))
            columns.append(_columns_of(tables, model, self._values, alike._replace(part=part)))
        score = _score(tables, np.concatenate(columns, axis=3), tables.torques)
        sizes = score.added.mean(axis=0).reshape(len(columns), -1)
        sizes = np.append(0.0, sizes[:, _MASS if alike.kind == "payload" else 0])
        order = np.argsort(sizes)
        cut = int(np.argmax(np.diff(sizes[order]))) + 1
        those = sorted(min(order[cut:], order[:cut], key=len).tolist())
        blocks = np.isin(tables.recording, those)
        return Part(", ".join(self._names[k] for k in those), tuple(blocks.tolist()))

    def _later_parts(self, tables: _Tables) -> Iterator[Part]:
        """Yield the blocks from each time on."""
        blocks = len(tables.recording)
        for first in range(_FEWEST_BLOCKS, blocks - _FEWEST_BLOCKS + 1):
            k = int(tables.recording[first])
            start = tables.start[first]
            description = (
                f"{self._names[k]} from {start:.3g} s on" if start > 0.0 else self._names[k]
            )
            if k < len(self._recordings) - 1:
                description += " and what follows it"
            yield Part(description, tuple((np.arange(blocks) >= first).tolist()))


@dataclass(frozen=True, eq=False)
class _Tables:
    """Sums of products of columns over the rows of B blocks, joint by joint.

    Columns: parameters (p), payload (10), rate of the predicted torque, friction in proportion to
    the load, torques of all joints (n).
    """

    gram: Array  # (B, n, q, q)
    rows: NDArray[np.intp]  # usable rows (B, n)
    recording: NDArray[np.intp]  # index of the recording of each block (B,)
    start: Array  # start time of each since its recording began (B,) [s]
    n_parameters: int  # p

    @property
    def width(self) -> int:
        """Number q of columns."""
        return int(self.gram.shape[-1])

    @property
    def torques(self) -> Array:
        """The measured torque of each joint as a combination of the columns (n, q)."""
        n = self.gram.shape[1]
        return np.eye(n, self.width, self.width - n)

    @cached_property
    def of_parameters(self) -> Array:
        """Sums over the columns of the parameters (B, n, p, p)."""
        return np.ascontiguousarray(self.gram[..., : self.n_parameters, : self.n_parameters])

    @cached_property
    def by_fold(self) -> Array:
        """The same of each fold (F, n, p, p)."""
        return _folded(self.of_parameters)

    @classmethod
    def of(cls, model: RobotModel, recordings: Sequence[Samples], values: Array) -> _Tables:
        """Reduce some thousand rows."""
        count = -(-_BLOCKS // len(recordings))
        step = _step(recordings, _MOST_ROWS)
        grams = []
        rows = []
        starts = []
        for samples in recordings:
            some = np.arange(step // 2, len(samples.torque), step)
            tables = _tables(model, samples, values, some)
            edges = np.linspace(0, len(some), count + 1).round().astype(int)
            usable = samples.usable[some]
            tables *= usable.T[:, :, None]
            for a, b in pairwise(edges):
                block_rows = tables[:, a:b]
                grams.append(np.swapaxes(block_rows, 1, 2) @ block_rows)
                rows.append(np.count_nonzero(usable[a:b], axis=0))
                starts.append(samples.motion.time[some[a]] - samples.motion.time[0] if a else 0.0)
        recording = np.repeat(np.arange(len(recordings)), count)
        return cls(np.array(grams), np.array(rows), recording, np.array(starts), model.n_parameters)


def _step(recordings: Sequence[Samples], rows: int) -> int:
    """Return the step with which all recordings together have about these rows."""
    return max(1, sum(len(samples.torque) for samples in recordings) // rows)


@dataclass(frozen=True, eq=False)
class _Few:
    """Few rows of recordings, without a low-pass, on which faults of positions are tried."""

    model: RobotModel
    recordings: tuple[Samples, ...]
    usual: _Score

    @classmethod
    def of(cls, model: RobotModel, recordings: Sequence[Samples]) -> _Few:
        """Take some of the rows."""
        step = _step(recordings, _FEW_ROWS)
        few = [samples.thinned(step) for samples in recordings]
        return cls(model, tuple(few), cls._score(model, few))

    def improved_by(self, fault: Fault) -> bool:
        """Return whether the correction of a fault predicts parts of these rows better."""
        recordings = [corrected(self.model, samples, fault) for samples in self.recordings]
        return self._score(self.model, recordings).ratio_to(self.usual)[0] < 1.0

    @staticmethod
    def _score(model: RobotModel, recordings: Sequence[Samples]) -> _Score:
        count = -(-_BLOCKS // len(recordings))
        p = model.n_parameters
        parts = [
            Factor.of(
                model,
                samples,
                index=np.arange(len(samples.torque)) * count // max(1, len(samples.torque)),
            )
            for samples in recordings
        ]
        factor = joined(parts)
        gram = np.zeros((len(factor), factor.n_joints, p + 1, p + 1))
        for joint, matrix in enumerate(factor.matrices):
            place = np.append(factor.columns[joint], p)
            gram[:, joint, place[:, None], place] = matrix
        blocks = np.arange(len(factor))
        tables = _Tables(gram, factor.counts, blocks, blocks.astype(np.float64), p)
        torque = np.eye(1, p + 1, p).repeat(factor.n_joints, axis=0)
        return _score(tables, np.zeros((*gram.shape[:3], 0)), torque)


def _tables(model: RobotModel, samples: Samples, values: Array, some: NDArray[np.intp]) -> Array:
    """Return the columns of some rows of each joint (n, k, q)."""
    n = model.n_joints
    p = model.n_parameters
    payload = RegressorPlan.of_bodies(model.chain, model.gravity, n - 1)
    filtered = samples.torque_bandwidth is not None or samples.parent is not None
    part = np.arange(len(samples.torque)) if filtered else some
    motion = samples.motion.rows(part)
    loads = payload.evaluate(*motion[1:4]).blocks
    if filtered:
        blocks, columns = samples.regressor(model)
        blocks = tuple(block[some] for block in blocks)
        loads = tuple(samples.as_measured(j, block)[some] for j, block in enumerate(loads))
    else:
        blocks, columns = model.regressor(*motion[1:])
    tables = np.zeros((n, len(some), p + _LOAD + 2 + n))
    for j in range(n):
        tables[j][:, columns[j]] = blocks[j]
        tables[j][:, p + payload.columns[j]] = loads[j]
    tables[:, :, p + _LOAD] = _rate(model, samples, values, some).T
    tables[:, :, p + _LOAD + 1] = _load_friction(model, samples, values, part, some).T
    tables[:, :, -n:] = samples.torque[some]
    return tables


def _rate(model: RobotModel, samples: Samples, values: Array, some: NDArray[np.intp]) -> Array:
    """Return the rate of the predicted torque (k, n) in some rows, from their neighbours."""
    after = np.minimum(some + 1, len(samples.torque) - 1)
    before = np.maximum(some - 1, 0)
    now, first, last = (samples.motion.rows(rows) for rows in (some, before, after))
    direction = now.direction
    if direction is None:
        direction = model.friction.direction(*now[:3])
    low, high = (model.torque(values, *motion[1:4], direction) for motion in (first, last))
    return np.asarray((high - low) / np.maximum(last.time - first.time, 1e-9)[:, None])


def _load_friction(
    model: RobotModel,
    samples: Samples,
    values: Array,
    part: NDArray[np.intp],
    some: NDArray[np.intp],
) -> Array:
    """Return the transmitted torque against the direction of motion (k, n) in some rows.

    `part` are the rows that a filter of the torque needs.
    """
    motion = samples.motion.rows(part)
    direction = motion.direction
    if direction is None:
        direction = model.friction.direction(*motion[:3])
    load = np.abs(model.gear_torque(values, *motion[1:4])) * direction[:, : model.n_joints]
    if len(part) == len(some):
        return np.asarray(load)
    columns = [samples.as_measured(j, load[:, j : j + 1])[some] for j in range(model.n_joints)]
    return np.hstack(columns)


class _Score(NamedTuple):
    """Squared errors of predicted blocks, and parameters and added coefficients by fold."""

    squares: Array  # (B, n)
    fitted: Array  # squared errors of the fit to all blocks (n,)
    torque: Array  # squared torque (n,)
    values: Array
    added: Array

    def shares(self, squares: Array) -> Array:
        """Return squared errors (n,) as shares of the squared torque, zero without torque."""
        loaded = self.torque > _NO_TORQUE * self.torque.max(initial=0.0)
        return np.where(loaded, squares / np.where(loaded, self.torque, 1.0), 0.0)

    def explains(
        self, joints: Sequence[int], usual: _Score, noise: Array, separate: _Score | None
    ) -> bool:
        """Return whether the error of the fit on some joints, all if none, is explained.

        It is compared with the fit `usual` without this correction, sums of squared noise (n,),
        and the fit with separate parameters for the part, if any.
        """
        before = usual.shares(usual.fitted)
        after = self.shares(self.fitted)
        every = np.flatnonzero(before > 0.0)
        affected = np.array(joints, dtype=np.intp) if len(joints) else every
        affected = affected[np.isin(affected, every)]
        if not affected.size:
            return False
        floor = usual.shares(noise)
        if np.all(after[affected] <= _NEAR_NOISE**2 * floor[affected]):
            return True
        ratio = _geometric_mean(np.sqrt(after[affected] / before[affected]))
        if ratio <= _EXPLAINS:
            return True
        others = np.setdiff1d(every, affected)
        if others.size and ratio <= _STANDS_OUT:
            level = float(np.median(after[others]))
            if np.all(after[affected] <= level) and np.all(before[affected] > level):
                return True
        if separate is None or ratio > _SAME_PART:
            return False
        least = separate.squares.sum(axis=0)[affected]
        mine = self.squares.sum(axis=0)[affected]
        positive = (least > 0.0) & (mine > 0.0)
        return bool(positive.any()) and _geometric_mean(
            np.sqrt(mine[positive] / least[positive])
        ) <= (_NEAR_SEPARATE)

    def fit_ratio_to(self, other: _Score) -> float:
        """Return the ratio of the errors of the fits, geometric mean over the joints."""
        positive = (self.fitted > 0.0) & (other.fitted > 0.0)
        return _geometric_mean(np.sqrt(self.fitted[positive] / other.fitted[positive]))

    def ratio_to(self, other: _Score) -> tuple[float, float]:
        """Return the error ratio, geometric mean over the joints, and its upper limit by blocks."""
        tested = np.isfinite(self.squares) & np.isfinite(other.squares)
        tested &= (self.squares > 0.0) & (other.squares > 0.0)
        tested_joints = tested.any(axis=0)
        if not tested_joints.any():
            return 1.0, np.inf
        ours = np.where(tested, self.squares, 0.0).sum(axis=0)[tested_joints]
        theirs = np.where(tested, other.squares, 0.0).sum(axis=0)[tested_joints]
        ratio = _geometric_mean(np.sqrt(ours / theirs))
        change = np.zeros(tested.shape)
        change[tested] = 0.5 * np.log(self.squares[tested] / other.squares[tested])
        some = tested.any(axis=1)
        blocks = change[some].sum(axis=1) / np.count_nonzero(tested[some], axis=1)
        if len(blocks) < _FEWEST_BLOCKS:
            return ratio, np.inf
        error = np.std(blocks, ddof=1) / np.sqrt(len(blocks))
        return ratio, float(np.exp(blocks.mean() + SIGMAS * error))


def _geometric_mean(ratios: Array) -> float:
    return float(np.exp(np.mean(np.log(np.maximum(ratios, 1e-12)))))


def _score(tables: _Tables, added: Array, target: Array) -> _Score:
    """Predict every fifth block from the others.

    Of the parameters with `added` columns (B, n, q, r), to the `target` of each joint (n, q), both
    as combinations of the columns.
    """
    blocks, n = tables.rows.shape
    p = tables.n_parameters
    column = np.broadcast_to(target[:, :, None], (blocks, n, target.shape[1], 1))
    wide = np.concatenate([added, column], axis=3)
    moved = tables.gram @ wide
    sums = _Sums(tables.of_parameters, moved[..., :p, :], np.swapaxes(wide, 2, 3) @ moved)
    folds = _Sums(tables.by_fold, _folded(sums.mixed), _folded(sums.beside))
    whole = _Sums(*(part.sum(axis=0) for part in folds))
    # Weighted by the inverse variances of an ordinary fit, limited by rounding.
    torque = whole.beside[:, -1, -1]
    floor = 1e-12 * torque + np.finfo(np.float64).tiny
    usual = np.maximum(whole.squares(_solved(whole.weighted(np.ones(n)))), floor)
    weights = np.maximum(tables.rows.sum(axis=0), 1) / usual
    total = whole.weighted(weights)
    of_folds = total - folds.weighted(weights)
    squares = np.zeros((blocks, n))
    coefficients = []
    for k in range(_FOLDS):
        fold_blocks = slice(k, None, _FOLDS)
        values = _solved(of_folds[k])
        coefficients.append(values)
        squares[fold_blocks] = _Sums(*(part[fold_blocks] for part in sums)).squares(values)
    squares = np.where(tables.rows >= _FEWEST_ROWS, np.maximum(squares, floor / blocks), 0.0)
    fitted = np.maximum(whole.squares(_solved(total)), floor)
    fold_values = np.array(coefficients)
    return _Score(squares, fitted, torque, fold_values[:, :p], fold_values[:, p:])


class _Sums(NamedTuple):
    """Sums of products of p parameters, r added columns and the torque, for each joint."""

    parameters: Array  # (..., n, p, p)
    mixed: Array  # parameters times the others (..., n, p, r + 1)
    beside: Array  # the others, torque last (..., n, r + 1, r + 1)

    def weighted(self, weights: Array) -> Array:
        """Return the sum (..., p + r + 1, p + r + 1) over the joints with weights (n,)."""
        p, count = self.mixed.shape[-2:]
        total = np.empty((*self.mixed.shape[:-3], p + count, p + count))
        parameters, mixed, beside = (
            (weights @ part.reshape(*part.shape[:-2], -1)).reshape(
                *part.shape[:-3], *part.shape[-2:]
            )
            for part in self
        )
        total[..., :p, :p] = parameters
        total[..., :p, p:] = mixed
        total[..., p:, :p] = np.swapaxes(mixed, -1, -2)
        total[..., p:, p:] = beside
        return total

    def squares(self, values: Array) -> Array:
        """Return the sum of squared errors (..., n) of coefficients (p + r,)."""
        p = self.parameters.shape[-1]
        first = values[:p]
        second = np.append(-values[p:], 1.0)
        of_parameters = (self.parameters @ first - 2.0 * (self.mixed @ second)) @ first
        return np.asarray(of_parameters + (self.beside @ second) @ second)


def _folded(blocks: Array) -> Array:
    """Return the sum of every fifth block (F, ...) of B (B, ...)."""
    return np.array([blocks[k::_FOLDS].sum(axis=0) for k in range(_FOLDS)])


def _solved(gram: Array) -> Array:
    """Solve a Gram matrix of [W | y] (k + 1, k + 1) for (k,), slightly regularised."""
    return solve_with_ridge(gram[:-1, :-1], gram[:-1, -1], _RIDGE)


def _size(fault: Fault, score: _Score, tables: _Tables, added: Array) -> tuple[float | None, float]:
    """Return the size of a fault of columns (B, n, q, r), and its jackknife deviation."""
    if fault.discrete or fault.kind == "changed arm":
        return None, 0.0
    p = score.values.shape[1]
    sizes = score.added[:, _MASS if fault.kind == "payload" else 0]
    if fault.kind == "load friction":
        loaded = np.median(score.added[:, : tables.gram.shape[1]], axis=1)
        return float(loaded.mean()), float(np.sqrt((_FOLDS - 1) * loaded.var()))
    if fault.kind in ("gain", "changed gain", "changed friction"):
        # Its column uses the pooled parameters, the fit finds others beside it.
        columns = added[..., :p, 0].reshape(-1, p)
        column = columns[np.argmax(columns.any(axis=1))]
        power = tables.gram[:, fault.joints[0], :p, :p].sum(axis=0) @ column
        size = power @ column
        scale = (score.values * (column != 0.0)) @ power
        if np.any(scale == 0.0):  # none of the torque is of the column
            return None, 0.0
        sizes = sizes * size / scale
    return float(sizes.mean()), float(np.sqrt((_FOLDS - 1) * sizes.var()))


def _columns_of(tables: _Tables, model: RobotModel, values: Array, fault: Fault) -> Array:
    """Return the columns of a fault as combinations of those of a table (B, n, q, r)."""
    blocks, n, width, _ = tables.gram.shape
    p = model.n_parameters
    joints = list(fault.joints or range(model.n_joints))
    count = {"payload": _LOAD, "changed arm": p, "load friction": n}.get(fault.kind, 1)
    columns = np.zeros((n, width, count))
    if fault.kind == "delay":
        columns[joints, p + _LOAD, 0] = -1.0
    elif fault.kind == "load friction":
        columns[joints, p + _LOAD + 1, joints] = 1.0
    elif fault.kind == "payload":
        columns[:, p : p + _LOAD] = np.eye(_LOAD)
    elif fault.kind == "changed arm":
        columns[:, :p] = np.eye(p)
    else:
        friction = fault.kind == "changed friction"
        columns[joints, :p, 0] = values * model.friction_columns if friction else values
    mask = np.ones(blocks) if fault.part is None else np.array(fault.part.blocks, dtype=np.float64)
    return np.asarray(mask[:, None, None, None] * columns)


def coupled_pairs(model: RobotModel, moved: Sequence[int]) -> Iterator[tuple[int, int]]:
    """Yield the joints whose angle a controller may state relative to one of the two before it.

    Such as the forearm's to the horizontal: the angle of axis 3 then contains that of axis 2.
    """
    turning = [joint for joint in moved if model.chain.revolute[joint]]
    yield from ((j, k) for j in turning for k in turning if 0 < j - k <= _JOINTS_BEFORE)


def corrected(model: RobotModel, samples: Samples, fault: Fault) -> Samples:
    """Return samples with a wrong sign or order, or a coupled angle, corrected."""
    n = model.n_joints
    sign = np.ones(n)
    order = np.arange(n)
    relative = np.eye(n)
    if fault.kind in _COUPLED:
        relative[fault.joints] = -1.0 if fault.kind == "angle sum" else 1.0
    elif fault.kind.endswith("sign"):
        sign[list(fault.joints)] = -1.0
    else:
        order[list(fault.joints)] = fault.joints[::-1]
    motion = samples.motion
    torque = samples.torque
    usable = samples.usable
    if fault.kind in _OF_MOTION:
        load = None if motion.load is None else motion.load[:, order]
        read = (relative @ (np.eye(n)[order] * sign[:, None])).T
        motion = Motion(motion.time, *(part @ read for part in motion[1:4]))
        motion = motion._replace(load=load)
        usable = usable[:, order]
    if fault.kind not in ("position order", *_COUPLED):
        torque = torque[:, order] * sign
    result = replace(samples, motion=motion, torque=torque, usable=usable, mask=None)
    if samples.parent is not None:
        parent, part = samples.parent
        result = replace(result, parent=(corrected(model, parent, fault), part))
    return result.with_friction_direction(model)
