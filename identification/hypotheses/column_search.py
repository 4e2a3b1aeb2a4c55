"""Changes of recordings that are linear in columns of torque, and predict parts of them better.

Delay, scale, friction and drift of a joint, friction by the load, a load, and some of these in a
part of the recordings only. The torque of every fifth block is predicted from the others, as it is
and with one change after the other. The change that reduces the error most is named if the
reduction is significant and explains the error of the fit: what is left is near the noise, near the
error of the other joints, or near that of separate parameters for the part. The search is repeated
with it.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.distributions import SIGNIFICANT_SIGMAS
from identification.estimators.payload_estimate import MASS_TOLERANCE
from identification.hypotheses.column_scores import (
    MIN_ROWS,
    ColumnScore,
    ScorePrior,
    column_score,
    rough_size,
    separate_errors,
)
from identification.hypotheses.error_ratios import geometric_mean
from identification.hypotheses.joint_changes import Change, Meaning, Part
from identification.hypotheses.part_search import PartScan
from identification.hypotheses.sizes import estimated_size
from identification.hypotheses.torque_columns import BLOCKS, ColumnRows, ColumnSums, columns_of
from identification.model.link_wrenches import MASS_INDEX, N_LINK
from identification.model.robot import RobotModel
from identification.signals.recording import MIN_MOVEMENT
from identification.signals.samples import Samples

UNSEEN: Final = "unseen motion"
"""What a model is tested on if it is another motion than the fitted one."""
_MIN_ERROR_REDUCTION: Final = 0.1  # relative reduction of the error by a significant change
# error ratio up to which a change with fewer coefficients is preferred
_ALIKE_ERROR_RATIO: Final = 1.05
_MIN_PAYLOAD_SIGMAS: Final = 2.0  # standard deviations of a payload that is one
_MAX_CHANGES: Final = 4  # changes
_SCALE_ROUNDS: Final = 20  # fits, each with the load and the parameters of the one before
_SCALE_TOLERANCE: Final = 1e-3  # change of a scale, or of a mass [kg]
_PARTS_PER_BLOCK: Final = 4  # parts of a block, from and to which a change of a part may be
_SEPARATE_ERROR_RATIO: Final = 1.1  # error ratio to separate parameters of a part
_REST_ERROR_RATIO: Final = 1.5  # error ratio of a part to the rest, whose motion is another
_OF_ARM: Final[tuple[Meaning, ...]] = ("payload", "arm")  # that may be of a part
_OF_JOINT: Final[tuple[Meaning, ...]] = ("scale", "friction")


class Explanation(NamedTuple):
    """A change that explains errors.

    Attributes:
        change: of the recordings, with its joints and part.
        ratio: error of predicted blocks with it over that without, geometric mean over the joints.
        size: delay [s], drift [rad], factor less one, mass [kg] or share of the load; None without
            a size.
        std: standard deviation of it over the blocks.
        interval_factor: standard deviations in half a 95 % interval.
        rivals: what explains its part alike, and is something else.
        is_adequate: whether its part is then explained as well as by separate parameters.
    """

    change: Change
    ratio: float
    size: float | None = None
    std: float = 0.0
    interval_factor: float = 2.0
    rivals: tuple[tuple[Change, ...], ...] = ()
    is_adequate: bool = True

    @property
    def is_certain(self) -> bool:
        """Whether nothing else explains its part alike, and it does so as well as anything can."""
        return self.is_adequate and not self.rivals

    @property
    def half_interval(self) -> float:
        """Half a 95 % interval of the size."""
        return self.interval_factor * self.std


@dataclass(frozen=True, eq=False)
class ExplainedFit:
    """A fit of recordings whose errors are to be explained.

    Attributes:
        values: its parameters (p,).
        noise: standard deviation of each joint's torque noise (n,) [N·m or N], NaN where unknown;
            None if it has none.
        names: of the recordings, by default numbers.
        prior: what is believed of the arm.
        scale_std: relative standard deviations (n,) of the torques' scales, which the intervals of
            sizes include; None: exact.
    """

    values: Array
    noise: Array | None = None
    names: Sequence[str] = ()
    prior: ScorePrior | None = None
    scale_std: Array | None = None

    def name_of(self, recording: int) -> str:
        """Return the name of a recording."""
        named = recording < len(self.names)
        return self.names[recording] if named else f"recording {recording + 1}"


def find_columns(
    model: RobotModel, recordings: Sequence[Samples], fitted: ExplainedFit
) -> tuple[Explanation, ...]:
    """Find changes of fitted recordings, or of parts of them, that explain their errors."""
    return _Search.of(model, recordings, fitted).explanations()


def find_columns_of_unseen(
    model: RobotModel, seen: Sequence[Samples], unseen: Sequence[Samples], fitted: ExplainedFit
) -> tuple[Explanation, ...]:
    """Find changes that begin within unseen recordings.

    Args:
        model: of the arm.
        seen: recordings that have none.
        unseen: recordings in which one may begin.
        fitted: fit of the seen ones, with their names.
    """
    names = [fitted.name_of(recording) for recording in range(len(seen))]
    several = len(unseen) > 1
    names += [f"{UNSEEN} ({k + 1})" if several else UNSEEN for k in range(len(unseen))]
    fitted = replace(fitted, names=names)
    recordings = [*seen, *unseen]
    blocks = BLOCKS * len(recordings)
    return _Search.of(model, recordings, fitted, seen=len(seen), blocks=blocks).explanations()


class _Trial(NamedTuple):
    """Changes, tried together."""

    changes: tuple[Change, ...]
    ratio: float  # of the errors of all rows
    highest: float  # upper limit of its ratio where it is
    coefficients: int  # added coefficients
    values: Array  # parameters (p,) fitted with it
    explains: bool  # whether it explains the error of the fit
    size: float | None = None  # of the first change, about
    std: float = 0.0
    ratio_inside: float = 1.0  # of the errors of the rows of its part

    @property
    def is_better(self) -> bool:
        """Whether it reduces the error significantly, and explains it."""
        return self.explains and self.ratio < 1.0 - _MIN_ERROR_REDUCTION and self.highest < 1.0


def _best(trials: Sequence[_Trial]) -> _Trial | None:
    """Return the significant trial of least error, with few coefficients preferred."""
    better = [trial for trial in trials if trial.is_better]
    least = min((trial.ratio for trial in better), default=0.0)
    alike = [trial for trial in better if trial.ratio <= _ALIKE_ERROR_RATIO * least]
    return min(alike, key=lambda trial: (trial.coefficients, trial.ratio), default=None)


class _Event(NamedTuple):
    """A part in which something is other, with what may be."""

    best: _Trial | None
    rivals: tuple[tuple[Change, ...], ...]  # that predict its rows alike


@dataclass(eq=False)
class _Search:
    """Recordings as sums over columns, and the changes that were found in them."""

    model: RobotModel
    recordings: Sequence[Samples]
    fitted: ExplainedFit
    rows: ColumnRows
    edges: NDArray[np.intp]  # rows between the blocks (B + 1,)
    tables: ColumnSums
    groups: NDArray[np.intp]  # first rows of the blocks that are predicted as one
    moved: list[int]  # joints whose scale and friction the fitted rows show
    seen: int  # recordings without a change that begins in them
    values: Array  # parameters (p,) with what is known
    load: Array  # known loads as coefficients of the columns of a payload (B, 10)
    known: list[Explanation] = field(default_factory=list)

    @classmethod
    def of(
        cls,
        model: RobotModel,
        recordings: Sequence[Samples],
        fitted: ExplainedFit,
        *,
        seen: int = 0,
        blocks: int = BLOCKS,
    ) -> _Search:
        fit = recordings[:seen] or recordings
        travel = np.max([np.ptp(samples.motion.position, axis=0) for samples in fit], axis=0)
        usable = np.any([samples.usable.any(axis=0) for samples in fit], axis=0)
        moved = np.flatnonzero((travel > MIN_MOVEMENT) & usable).tolist()
        rows = ColumnRows.of(model, recordings, fitted.values)
        edges = rows.edges(-(-blocks // len(recordings)), _PARTS_PER_BLOCK, MIN_ROWS)
        return cls(
            model=model,
            recordings=recordings,
            fitted=fitted,
            rows=rows,
            edges=edges,
            tables=rows.sums(edges),
            groups=edges[:-1:_PARTS_PER_BLOCK],
            moved=moved,
            seen=seen,
            values=fitted.values,
            load=np.zeros((len(edges) - 1, N_LINK)),
        )

    def explanations(self, most: int = _MAX_CHANGES) -> tuple[Explanation, ...]:
        """Return the changes found, one after the other."""
        sizes: list[Array] = []
        while len(self.known) < most:
            event = self._event()
            trials = self.trials()
            trial = _best([*trials, *([] if event.best is None else [event.best])])
            if trial is None:
                break
            rivals = event.rivals if trial is event.best else ()
            self.known += [
                Explanation(change, trial.ratio, rivals=rivals) for change in trial.changes
            ]
            sizes += [trial.values] * len(trial.changes)
            if trial.changes[0].meaning in ("arm", "drift"):
                break  # separate parameters leave nothing to compare, a drift what is not linear
            self._refit()
        return tuple(self._judged(self._sized(sizes)))

    @property
    def _changes_known(self) -> list[Change]:
        return [each.change for each in self.known]

    @property
    def _before(self) -> Array:
        """Columns of what was found before."""
        none = np.zeros((*self.tables.gram.shape[:3], 0))
        return np.concatenate([none, *map(self._columns, self._changes_known)], axis=3)

    @property
    def _noise(self) -> Array:
        """Sums of squared noise (n,)."""
        noise = self.fitted.noise
        noise = np.zeros(self.model.n_joints) if noise is None else np.nan_to_num(noise)
        return np.asarray(noise**2 * self.tables.rows.sum(axis=0))

    def _columns(
        self, change: Change, load: Array | None = None, values: Array | None = None
    ) -> Array:
        """Return the columns of a change, beside a load (B, 10) and parameters (p,).

        By default they are what is known.
        """
        load = self.load if load is None else load
        values = self.values if values is None else values
        return columns_of(self.tables, self.model, values, change, load)

    def _score(self, before: Array, *columns: Array, by_group: bool = False) -> ColumnScore:
        starts = np.searchsorted(self.edges[:-1], self.groups) if by_group else None
        added = np.concatenate([*columns, before], axis=3)
        return column_score(self.tables, added, self.tables.torques, starts=starts)

    def trials(self) -> list[_Trial]:
        """Try each change of all rows, or of whole recordings."""
        before = self._before
        usual = self._score(before, by_group=True)
        noise = self._noise
        separate: dict[Part, ColumnScore | None] = {}
        trials = []
        for change in self._changes():
            if change.part is not None:
                if change.part not in separate:
                    separate[change.part] = self._separate(
                        change.part, before, usual, by_group=True
                    )
                if separate[change.part] is None:
                    continue
            added = self._columns(change)
            if not added.any():
                continue  # such as friction of a frictionless joint
            score = self._score(before, added, by_group=True)
            of_part = None if change.part is None else separate[change.part]
            explains = score.explains(change.joints, usual, noise, of_part)
            size, std = rough_size(change, score, self.tables)
            if change.meaning == "load friction" and (size or 0.0) <= 0.0:
                continue  # friction dissipates
            if change.meaning == "payload" and not _is_load(size, std):
                continue
            ratio, highest = score.ratio_to(usual)
            values = score.values.mean(axis=0)
            count = added.shape[3]
            trials.append(_Trial((change,), ratio, highest, count, values, explains, size, std))
        return trials

    def _separate(
        self, part: Part, before: Array, usual: ColumnScore, *, by_group: bool = False
    ) -> ColumnScore | None:
        """Return the score of separate parameters of a part, None if no joint fits them better.

        All that may have changed in the part is within them.
        """
        arm = Change("arm", part=part)
        if self.known:
            score = self._score(before, self._columns(arm), by_group=by_group)
            fitted = score.fitted
        else:  # the two sides have nothing in common: a tenth of the time
            mask = self.tables.mask_of(arm)
            fitted = separate_errors(self.tables, self.tables.torques, mask)
        if np.all(fitted > (1.0 - _MIN_ERROR_REDUCTION) ** 2 * usual.fitted):
            return None
        return score if self.known else self._score(before, self._columns(arm), by_group=by_group)

    def _event(self) -> _Event:
        """Return what explains the part in which the recordings differ most from the rest."""
        part = self._part()
        if part is None:
            return _Event(None, ())
        before = self._before
        usual = self._score(before)
        separate = self._separate(part, before, usual)
        if separate is None:
            return _Event(None, ())
        inside = np.array(part.blocks)
        load = self._score(before, self._columns(Change("payload", part=part)))
        with_load = self.load + inside[:, None] * load.added.mean(axis=0)[:N_LINK]
        trials = []
        for changes in self._alternatives(part):
            is_loaded = len(changes) > 1
            carried = with_load if is_loaded else None
            columns = [self._columns(each, carried) for each in changes]
            if not columns[-1].any():
                continue
            score = self._score(before, *columns)
            if changes[-1].meaning in _OF_JOINT:  # of parameters that the part has not spoilt
                values = score.values.mean(axis=0)
                columns = [self._columns(each, carried, values) for each in changes]
                score = self._score(before, *columns)
            size, std = rough_size(changes[0], score, self.tables)
            if changes[0].meaning == "payload" and not _is_load(size, std):
                continue
            joints = () if is_loaded else changes[0].joints
            ratio, _ = score.ratio_to(usual)
            ratio_inside, highest = score.ratio_inside(usual, inside)
            trials.append(
                _Trial(
                    changes,
                    ratio,
                    highest,
                    sum(each.shape[3] for each in columns),
                    score.values.mean(axis=0),
                    score.explains(joints, usual, self._noise, separate),
                    size,
                    std,
                    ratio_inside,
                )
            )
        return _event_of(trials)

    def _alternatives(self, part: Part) -> Iterator[tuple[Change, ...]]:
        """Yield what may be other in a part."""
        load = Change("payload", part=part)
        friction = Change("friction", part=part)
        yield (load,)
        yield (friction,)
        yield (Change("arm", part=part),)
        yield load, friction
        for joint in self.moved:
            scale = Change("scale", (joint,), part=part)
            yield (scale,)
            yield (friction._replace(joints=(joint,)),)
            yield load, scale
            if not self.seen:
                yield load, scale._replace(part=None)

    def _part(self) -> Part | None:
        """Return the part in which something is other, from row to row; None if there is none."""
        every = Part("", (True,) * len(self.tables.gram))
        changes = [Change("payload", part=every), Change("friction", part=every)]
        changes += [Change("scale", (j,), part=every) for j in self.moved]
        changes += [Change("friction", (j,), part=every) for j in self.moved]
        columns = np.concatenate([*map(self._columns, changes)], axis=3)
        load = range(N_LINK)
        alternatives = {"payload": [*load], "payload, friction": [*load, N_LINK]}
        for k, change in enumerate(changes[1:], N_LINK):
            alternatives[f"{change.meaning} {change.joints}"] = [k]
            if change.meaning == "scale":
                alternatives[f"payload, scale {change.joints}"] = [*load, k]
        before = self._before
        usual = self._score(before)
        fitted = np.concatenate([usual.values.mean(axis=0), usual.added.mean(axis=0)])
        scan = PartScan.of(self.tables, before, columns, fitted)
        first = int(np.searchsorted(self.tables.recording, self.seen))
        shortest = _PARTS_PER_BLOCK
        found = scan.best(alternatives, first, shortest)
        if found is None:
            return None
        edges = scan.edges(self.rows, self.edges, found, alternatives[found.name])
        if edges[1] - edges[0] < shortest:
            return None
        self._split(edges)
        return self._part_of(*edges)

    def _split(self, rows: Iterable[int]) -> None:
        """Split blocks at some rows."""
        edges = np.union1d(self.edges, np.array([*rows], dtype=np.intp))
        block = np.searchsorted(self.edges, edges[:-1], side="right") - 1
        self.known = [
            each._replace(change=_divided(each.change, block.tolist())) for each in self.known
        ]
        self.load = self.load[block]
        self.edges = edges
        self.tables = self.rows.sums(edges)

    def _part_of(self, first: int, end: int) -> Part:
        """Return the part of the rows from one to before another."""
        rows = self.rows
        last = len(rows.time)
        k = int(rows.recording[first])
        starts = first == 0 or rows.recording[first - 1] != k
        start = f"{_tenths(rows.time[first])} s"
        name = self.fitted.name_of(k)
        if end < last and rows.recording[end] == k:
            name += f" from {start} to {_tenths(rows.time[end])} s"
        else:
            name += "" if starts else f" from {start} on"
            name += " and what follows it" if k < rows.recording[end - 1] else ""
        blocks = (self.edges[:-1] >= first) & (self.edges[:-1] < end)
        is_end = end == last or rows.recording[end] != rows.recording[end - 1]
        return Part(name, tuple(blocks.tolist()), is_within=not (starts and is_end))

    def _refit(self) -> None:
        """Fit the parameters with what is known of parts, which multiplies them."""
        if not any(_is_of_event(each) for each in self._changes_known):
            return
        sizes = np.zeros(0)
        for _ in range(_SCALE_ROUNDS):
            score = self._score(self._before)
            self.values = score.values.mean(axis=0)
            self.load = self._load_of(score)
            before, sizes = sizes, score.added.mean(axis=0)
            if len(before) and np.abs(sizes - before).max() < _SCALE_TOLERANCE:
                break

    @property
    def _has_scaled_load(self) -> bool:
        meanings = [each.meaning for each in self._changes_known]
        return "payload" in meanings and "scale" in meanings

    def _coefficients(self, score: ColumnScore) -> Iterator[tuple[Change, Array]]:
        """Yield what is known with its coefficients by fold (F, r)."""
        first = 0
        for change in self._changes_known:
            count = self._columns(change).shape[3]
            yield change, score.added[:, first : first + count]
            first += count

    def _load_of(self, score: ColumnScore) -> Array:
        """Return the known loads (B, 10) of a score with what is known."""
        load = np.zeros_like(self.load)
        for change, coefficients in self._coefficients(score):
            if change.meaning == "payload":
                load += self.tables.mask_of(change)[:, None] * coefficients.mean(axis=0)
        return load

    def _sized(self, values: Sequence[Array]) -> list[Explanation]:
        """Return what was found with the sizes that are most probable.

        Args:
            values: parameters (p,) of the fit with each.
        """
        if not self._has_scaled_load:
            return [
                self._resized(each, mine, self._others([each.change]))
                for each, mine in zip(self.known, values, strict=True)
            ]
        score = self._score(self._before)
        tables = self.tables
        scales = {}
        for change, coefficients in self._coefficients(score):
            if change.meaning == "scale":
                size = float(coefficients.mean())
                scales[change] = size, float(np.sqrt((len(coefficients) - 1) * coefficients.var()))
                mask = tables.mask_of(change)
                tables = tables.divided_torque(change.joints[0], mask, 1.0 + size)
        return [
            each._replace(size=scales[each.change][0], std=scales[each.change][1])
            if each.change in scales
            else self._of_size(each, tables, self.values, self._others([each.change, *scales]))
            for each in self.known
        ]

    def _others(self, changes: Collection[Change]) -> list[Change]:
        """Return what is known in addition to some changes."""
        return [each for each in self._changes_known if each not in changes]

    def _resized(
        self, explanation: Explanation, values: Array, known: Sequence[Change]
    ) -> Explanation:
        """Return an explanation with the size that is most probable, by a fit with it (p,)."""
        if explanation.change.meaning == "arm":
            return explanation
        rows = ColumnRows.of(self.model, self.recordings, values)
        return self._of_size(explanation, rows.sums(self.edges), values, known)

    def _of_size(
        self, explanation: Explanation, tables: ColumnSums, values: Array, known: Sequence[Change]
    ) -> Explanation:
        found = estimated_size(
            explanation.change,
            tables,
            self.model,
            values,
            known=known,
            prior=self.fitted.prior,
            scale_std=self.fitted.scale_std,
        )
        if found is None:
            return explanation._replace(size=None, std=0.0)
        return explanation._replace(
            size=found.size, std=found.std, interval_factor=found.interval_factor
        )

    def _judged(self, found: Sequence[Explanation]) -> list[Explanation]:
        """Return what was found, with whether it explains its part as well as anything can."""
        if not any(_is_of_event(each.change) for each in found):
            return [*found]
        before = self._before
        with_all = self._score(before)
        judged = []
        for each in found:
            if _is_of_event(each.change) and each.change.part is not None:
                inside = np.array(each.change.part.blocks)
                arm = self._columns(Change("arm", part=each.change.part))
                joints = [
                    other.change.joints for other in found if other.change.part == each.change.part
                ]
                affected = [] if () in joints else [j for some in joints for j in some]
                separate = self._score(before, arm)
                is_explained = _is_explained(with_all, separate, inside, affected)
                judged.append(each._replace(is_adequate=is_explained))
            else:
                judged.append(each)
        return judged

    def _changes(self) -> Iterator[Change]:
        """Yield the changes to try: throughout, then of whole recordings."""
        if self.seen:
            return
        yield from (Change("delay"), Change("load friction"))
        for joint in self.moved:
            yield from (Change("delay", (joint,)), Change("scale", (joint,)))
            if self.model.chain.revolute[joint]:
                yield Change("drift", (joint,))
        if len(self.recordings) > 2:
            # What a joint that stands still does says nothing about its scale.
            of_parts = [Change(meaning) for meaning in _OF_ARM]
            of_parts += [Change(meaning, (joint,)) for joint in self.moved for meaning in _OF_JOINT]
            for change in of_parts:
                yield change._replace(part=self._other_recordings(change))

    def _other_recordings(self, change: Change) -> Part:
        """Return the recordings in which a change is largest, estimated separately in each."""
        tables = self.tables
        alike = Change("payload") if change.meaning == "arm" else change
        columns = []
        for k in range(1, len(self.recordings)):
            part = Part(self.fitted.name_of(k), tuple((tables.recording == k).tolist()))
            one = alike._replace(part=part)
            columns.append(columns_of(tables, self.model, self.fitted.values, one))
        score = column_score(tables, np.concatenate(columns, axis=3), tables.torques)
        sizes = score.added.mean(axis=0).reshape(len(columns), -1)
        sizes = np.append(0.0, sizes[:, MASS_INDEX if alike.meaning == "payload" else 0])
        order = np.argsort(sizes)
        cut = int(np.argmax(np.diff(sizes[order]))) + 1
        those = sorted(min(order[cut:], order[:cut], key=len).tolist())
        blocks = np.isin(tables.recording, those)
        name = ", ".join(self.fitted.name_of(k) for k in those)
        return Part(name, tuple(blocks.tolist()))


def _event_of(trials: Sequence[_Trial]) -> _Event:
    """Return the trial that predicts a part best, and what predicts it alike."""
    better = [trial for trial in trials if trial.is_better]
    least = min((trial.ratio_inside for trial in better), default=0.0)
    alike = [trial for trial in better if trial.ratio_inside <= _ALIKE_ERROR_RATIO * least]
    best = min(alike, key=lambda trial: (trial.coefficients, trial.ratio_inside), default=None)
    if best is None or best.changes[0].meaning == "arm":
        return _Event(best, ())
    return _Event(best, tuple(trial.changes for trial in alike if _differs(trial, best)))


def _differs(trial: _Trial, best: _Trial) -> bool:
    """Return whether a trial says something else than the best one, and not more of the same."""
    if trial.changes[0].meaning == "arm" or trial is best:
        return False
    if not set(best.changes) <= set(trial.changes):
        return True
    if trial.size is None or best.size is None:
        return False
    difference = abs(trial.size - best.size)
    is_clear = difference > SIGNIFICANT_SIGMAS * math.hypot(trial.std, best.std)
    return is_clear and difference > MASS_TOLERANCE * abs(best.size)


def _is_load(size: float | None, std: float) -> bool:
    """Return whether the interval of a mass does not contain zero."""
    return size is not None and abs(size) >= _MIN_PAYLOAD_SIGMAS * std


def _is_of_event(change: Change) -> bool:
    return change.part is not None and change.meaning != "arm"


def _is_explained(
    score: ColumnScore,
    separate: ColumnScore,
    inside: NDArray[np.bool_],
    joints: Sequence[int],
) -> bool:
    """Return whether the rows of a part are predicted about as well as they can be.

    That is as by separate parameters, which may be too many for a short part, and about as the
    other rows are.

    Args:
        score: with all that was found.
        separate: the same, with separate parameters in the part.
        inside: blocks of the part (B,).
        joints: that count; all if none.
    """
    mine = score.mean_squares(inside)
    limits = (
        (separate.mean_squares(inside), _SEPARATE_ERROR_RATIO),
        (score.mean_squares(~inside), _REST_ERROR_RATIO),
    )
    for other, ratio in limits:
        some = (mine > 0.0) & (other > 0.0)
        if len(joints):
            some &= np.isin(np.arange(len(some)), joints)
        if geometric_mean(np.sqrt(mine[some] / other[some])) > ratio:
            return False
    return True


def _divided(change: Change, blocks: Sequence[int]) -> Change:
    """Return a change whose part has these of its blocks."""
    if change.part is None:
        return change
    return change._replace(
        part=change.part._replace(blocks=tuple(change.part.blocks[k] for k in blocks))
    )


def _tenths(time: float) -> str:
    return f"{round(float(time), 1):g}"
