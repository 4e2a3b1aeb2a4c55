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
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from identification.arrays import Array
from identification.factor.factor import Factor, joined
from identification.hypotheses.faults import (
    COUPLED,
    OF_MOTION,
    Fault,
    Kind,
    Part,
    corrected,
    coupled_pairs,
)
from identification.model.robot import RobotModel
from identification.signals.recording import STUCK_MOVEMENT
from identification.signals.samples import Samples
from identification.validation.fault_scores import (
    FEWEST_BLOCKS,
    MASS,
    FaultScore,
    ScorePrior,
    fault_score,
    size_of_fault,
)
from identification.validation.fault_sizes import estimated_size
from identification.validation.fault_tables import BLOCKS, FaultTables, columns_of_fault, row_step
from identification.validation.physical_signs import SIGMAS, friction_at
from identification.validation.prediction import noise_floor

_LEAST_GAIN: Final = 0.1  # relative reduction of the error by a significant correction
_ALIKE: Final = 1.05  # error ratio up to which a fault with fewer coefficients is preferred
# Largest relative error of each joint with a corrected sign or order: more error than that means
# another cause.
_EXPLAINED: Final = 0.5
# Relative error of each joint without which no columns are interchanged.
_SMALL_ERROR: Final = 0.02
# Noise floors without which no axis turns the other way. An arm whose base turns the other way is
# nearly its own mirror image, which other parameters fit to some per cent.
_LITTLE_MORE: Final = 1.05
_NOISE_OF: Final = 3  # recordings
_CHANGED: Final = 2.0  # standard deviations of a payload that is one
_MOST_CAUSES: Final = 4
_DIVIDED: Final = 4  # parts of a block whose scatter gives the interval of a size
_FEW_ROWS: Final = 600  # of all recordings together, on which faults of positions are tried first


class Cause(NamedTuple):
    """Fault that explains errors."""

    fault: Fault
    # error of predicted blocks with the correction over that without: geometric mean over joints
    ratio: float
    size: float | None  # delay [s], factor less one, or mass [kg]; None without size
    std: float  # standard deviation over the blocks
    interval_factor: float = 2.0  # standard deviations in half a 95 % interval

    @property
    def half_interval(self) -> float:
        """Half a 95 % interval of the size."""
        return self.interval_factor * self.std


def find_causes(
    model: RobotModel,
    recordings: Sequence[Samples],
    values: Array,
    names: Sequence[str] = (),
    *,
    noise: Array | None = None,
    prior: ScorePrior | None = None,
    scale_std: Array | None = None,
) -> tuple[Cause, ...]:
    """Find faults that explain the error of values (p,) from the recordings, by their effect.

    `noise` is the standard deviation of each joint's torque noise (n,) [N·m or N], by default that
    of the residual at high frequencies. With the prior of the arm, turned signs and exchanged
    joints of a motion that determines little are seen, too. `scale_std` are the relative standard
    deviations (n,) of the scales of torques, which the intervals of sizes include.
    """
    if noise is None:
        noise = noise_floor(model, values, recordings[:_NOISE_OF])
    recording_names = tuple(names) or tuple(f"recording {k + 1}" for k in range(len(recordings)))
    search = _Search(model, recordings, values, recording_names, noise, prior, scale_std)
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
        return explained and self.cause.ratio < 1.0 - _LEAST_GAIN and self.highest < 1.0

    def ambiguous_with(self, other: _Trial) -> bool:
        """Return whether another order, or order instead of sign, explains nearly as much."""
        mine = self.cause.fault
        its = other.cause.fault
        return (
            mine.discrete
            and its.discrete
            and not (mine.kind.endswith("sign") and its.kind.endswith("sign"))
            and mine.joints != its.joints
            and (1.0 - _LEAST_GAIN) * other.cause.ratio < self.cause.ratio
        )


class _Pair(NamedTuple):
    """Scores with and without the correction of a fault, both without a prior or with it."""

    corrected: FaultScore
    usual: FaultScore


def _trial(
    fault: Fault, pair: _Pair, tables: FaultTables, coefficients: int, *, explains: bool
) -> _Trial | None:
    """Return the correction by added coefficients; None of a size that no fault has."""
    score = pair.corrected
    size, std = size_of_fault(fault, score, tables)
    if fault.kind == "load friction" and (size or 0.0) <= 0.0:
        return None  # friction dissipates
    if size is not None and fault.kind == "payload" and abs(size) < _CHANGED * std:
        return None  # the interval of its mass contains zero
    ratio, highest = score.ratio_to(pair.usual)
    shares = score.shares(score.squares.sum(axis=0))[[*fault.joints]]
    return _Trial(
        cause=Cause(fault, ratio, size, std),
        highest=highest,
        coefficients=coefficients,
        left=float(np.sqrt(shares.max(initial=0.0))),
        values=score.values.mean(axis=0),
        explains=explains,
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
        prior: ScorePrior | None = None,
        scale_std: Array | None = None,
    ) -> None:
        self._model = model
        self._prior = prior
        self._scale_std = scale_std
        self._priors = (None,) if prior is None else (None, prior)
        self._values = values
        self._names = names
        self._noise = np.zeros(model.n_joints) if noise is None else np.nan_to_num(noise)
        travel = np.max([np.ptp(samples.motion.position, axis=0) for samples in recordings], axis=0)
        self._moved = np.flatnonzero(travel > STUCK_MOVEMENT)
        speeds = [np.abs(samples.motion.velocity).max(axis=0) for samples in recordings]
        self._friction = friction_at(model, np.max(speeds, axis=0))
        self._recordings = recordings
        self._few = _Few.of(model, recordings)
        self._known: list[Fault] = []
        self._motion_tables: dict[Fault, FaultTables] = {}  # cache: faults of the motion

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
        tables = FaultTables.of(model, self._recordings, values)
        target = tables.torques
        none = np.zeros((*tables.gram.shape[:3], 0))
        corrections = [columns_of_fault(tables, model, values, earlier) for earlier in self._known]
        before = np.concatenate([none, *corrections], axis=3)
        usuals = [fault_score(tables, before, target, prior) for prior in self._priors]
        usual = usuals[0]
        noise = self._noise**2 * tables.rows.sum(axis=0)
        separate: dict[Part | None, FaultScore] = {}
        excluded = self._excluded(usual, noise)
        trials = []
        for fault in self._faults(tables):
            added = none
            measured = target.copy()
            seen = tables
            joints = list(fault.joints)
            if fault.part is not None:
                if fault.part not in separate:
                    changed = Fault("changed arm", (), fault.part)
                    every = columns_of_fault(tables, model, values, changed)
                    columns = np.concatenate([every, before], axis=3)
                    separate[fault.part] = fault_score(tables, columns, target)
                # All that may have changed is within separate parameters.
                if separate[fault.part].fit_ratio_to(usual) > 1.0 - _LEAST_GAIN:
                    continue
            if fault.kind in OF_MOTION:
                if fault.kind in excluded or not self._few.improved_by(fault):
                    continue
                seen = self._of_motion(fault)
            elif fault.kind == "torque sign":
                measured[joints] *= -1.0
            elif fault.kind == "torque order":
                measured[joints] = target[joints[::-1]]
            else:
                added = columns_of_fault(tables, model, values, fault)
                if not added.any():
                    continue  # such as friction of a frictionless joint
            columns = np.concatenate([added, before], axis=3)
            priors = self._priors if fault.discrete else (None,)
            scores = [fault_score(seen, columns, measured, prior) for prior in priors]
            decisive = self._decisive(fault, scores, usuals)
            if decisive is None:
                continue
            explains = decisive.corrected.explains(
                joints, decisive.usual, noise, separate.get(fault.part)
            )
            trial = _trial(fault, decisive, tables, added.shape[3], explains=explains)
            trials += [] if trial is None else [trial]
        return trials

    def _decisive(
        self, fault: Fault, scores: Sequence[FaultScore], usuals: Sequence[FaultScore]
    ) -> _Pair | None:
        """Return the scores that show the effect of a correction best.

        Bodies that no arm has can make the torque of a turned sign where a motion determines
        little, and those of the prior cannot make that of a spring: neither alone may accuse. None
        if by one of them the error grows, or if friction drives an affected joint.
        """
        pairs = [_Pair(*pair) for pair in zip(scores, usuals, strict=False)]
        ratios = [pair.corrected.ratio_to(pair.usual) for pair in pairs]
        if len(pairs) == 1:
            return pairs[0]
        if max(ratio for ratio, _ in ratios) > 1.0:
            return None
        best = min(range(len(pairs)), key=lambda k: (ratios[k][1] >= 1.0, ratios[k][0]))
        friction = scores[-1].values @ self._friction[[*fault.joints]].T
        std = np.sqrt((len(friction) - 1) * friction.var(axis=0))
        if np.any(friction.mean(axis=0) < -SIGMAS * std):
            return None
        return pairs[best]

    def _of_motion(self, fault: Fault) -> FaultTables:
        """Return the tables of the recordings with a fault of the motion corrected."""
        if fault not in self._motion_tables:
            moved = [corrected(self._model, samples, fault) for samples in self._recordings]
            self._motion_tables[fault] = FaultTables.of(self._model, moved, self._values)
        return self._motion_tables[fault]

    def _excluded(self, usual: FaultScore, noise: Array) -> tuple[Kind, ...]:
        """Return the kinds of faults of positions that would leave more error."""
        if np.all(usual.fitted <= _LITTLE_MORE**2 * noise):
            return OF_MOTION
        in_order = np.all(usual.shares(usual.fitted) < _SMALL_ERROR**2)
        return ("position order", "joint order", *COUPLED) if in_order else ()

    def resized(self, trial: _Trial) -> Cause:
        """Return the cause of a trial with the size that is most probable beside all parameters."""
        cause = trial.cause
        if cause.fault.discrete or cause.fault.kind == "changed arm":
            return cause
        model = self._model
        tables = FaultTables.of(model, self._recordings, trial.values, divided=_DIVIDED)
        found = estimated_size(
            cause.fault,
            tables,
            model,
            trial.values,
            known=self._known,
            prior=self._prior,
            scale_std=self._scale_std,
        )
        return (
            cause._replace(size=None, std=0.0)
            if found is None
            else cause._replace(
                size=found.size, std=found.std, interval_factor=found.interval_factor
            )
        )

    def _faults(self, tables: FaultTables) -> Iterator[Fault]:
        kinds: tuple[Kind, ...] = ("delay", "gain", "torque sign", "axis sign")
        orders: tuple[Kind, ...] = ("torque order", "position order", "joint order")
        yield from (Fault("delay"), Fault("load friction"))
        changes = [Fault("payload"), Fault("changed arm")]
        # What a joint that stands still does says nothing about its order, sign or gain.
        moved = self._moved.tolist()
        for pair in coupled_pairs(self._model, moved):
            yield from (Fault(kind, pair) for kind in COUPLED)
        for j in moved:
            yield from (Fault(kind, (j,)) for kind in kinds)
            yield from (Fault(kind, (k, j)) for k in moved if k < j for kind in orders)
            changes += [Fault("changed gain", (j,)), Fault("changed friction", (j,))]
        for part in self._later_parts(tables):
            yield from (fault._replace(part=part) for fault in changes)
        if len(self._recordings) > 2:
            for fault in changes:
                yield fault._replace(part=self._other_recordings(tables, fault))

    def _other_recordings(self, tables: FaultTables, fault: Fault) -> Part:
        """Return the recordings in which a fault is largest, estimated separately in each."""
        model = self._model
        alike = fault
        columns = []
        if fault.kind == "changed arm":
            alike = Fault("payload")
        for k in range(1, len(self._recordings)):
            part = Part(self._names[k], tuple((tables.recording == k).tolist()))
            columns.append(columns_of_fault(tables, model, self._values, alike._replace(part=part)))
        score = fault_score(tables, np.concatenate(columns, axis=3), tables.torques)
        sizes = score.added.mean(axis=0).reshape(len(columns), -1)
        sizes = np.append(0.0, sizes[:, MASS if alike.kind == "payload" else 0])
        order = np.argsort(sizes)
        cut = int(np.argmax(np.diff(sizes[order]))) + 1
        those = sorted(min(order[cut:], order[:cut], key=len).tolist())
        blocks = np.isin(tables.recording, those)
        return Part(", ".join(self._names[k] for k in those), tuple(blocks.tolist()))

    def _later_parts(self, tables: FaultTables) -> Iterator[Part]:
        """Yield the blocks from each time on."""
        blocks = len(tables.recording)
        for first in range(FEWEST_BLOCKS, blocks - FEWEST_BLOCKS + 1):
            k = int(tables.recording[first])
            start = tables.start[first]
            description = (
                f"{self._names[k]} from {start:.3g} s on" if start > 0.0 else self._names[k]
            )
            if k < len(self._recordings) - 1:
                description += " and what follows it"
            yield Part(description, tuple((np.arange(blocks) >= first).tolist()))


@dataclass(frozen=True, eq=False)
class _Few:
    """Few rows of recordings, without a low-pass, on which faults of positions are tried."""

    model: RobotModel
    recordings: tuple[Samples, ...]
    usual: FaultScore

    @classmethod
    def of(cls, model: RobotModel, recordings: Sequence[Samples]) -> _Few:
        """Take some of the rows."""
        step = row_step(recordings, _FEW_ROWS)
        few = [samples.thinned(step) for samples in recordings]
        return cls(model, tuple(few), cls._errors(model, few))

    def improved_by(self, fault: Fault) -> bool:
        """Return whether the correction of a fault predicts parts of these rows better."""
        recordings = [corrected(self.model, samples, fault) for samples in self.recordings]
        return self._errors(self.model, recordings).ratio_to(self.usual)[0] < 1.0

    @staticmethod
    def _errors(model: RobotModel, recordings: Sequence[Samples]) -> FaultScore:
        count = -(-BLOCKS // len(recordings))
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
        tables = FaultTables(gram, factor.counts, blocks, blocks.astype(np.float64), p)
        torque = np.eye(1, p + 1, p).repeat(factor.n_joints, axis=0)
        return fault_score(tables, np.zeros((*gram.shape[:3], 0)), torque)
