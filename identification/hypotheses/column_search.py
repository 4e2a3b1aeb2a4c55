"""Changes of recordings that are linear in columns of torque, and predict parts of them better.

Delay, scale, friction and drift of a joint, friction by the load, a load, and some of these in a
part of the recordings only. The torque of every fifth block is predicted from the others, as it is
and with one change after the other. The change that reduces the error most is named if the
reduction is significant and explains the error of the fit: what is left is near the noise, near the
error of the other joints, or near that of separate parameters for the part. The search is repeated
with it.

What was found in a part is certain only if nothing else explains it as well (another change of the
part, a load with one, friction that drifts), and if the part is then predicted as well as the rest.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.distributions import SIGNIFICANT_SIGMAS
from identification.hypotheses.column_scores import (
    MIN_BLOCKS,
    SEPARATE_ERROR_RATIO,
    ColumnScore,
    ScorePrior,
    column_score,
    fit_ratio,
    rough_size,
    separate_errors,
)
from identification.hypotheses.error_ratios import mean_and_error
from identification.hypotheses.joint_changes import Change, Meaning, Part, changed_samples
from identification.hypotheses.sizes import estimated_size
from identification.hypotheses.torque_columns import BLOCKS, ColumnSums, columns_of
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
_SCALE_ROUNDS: Final = 20  # fits, each with the scale of the one before undone
_SCALE_TOLERANCE: Final = 1e-3  # relative change of a scale
_MOST_RIVALS: Final = 3  # that are named
_PARTS_PER_BLOCK: Final = 4  # parts of a block whose scatter gives the interval of a size
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
        rivals: other changes that explain its part as well, or several at once that explain more,
            the best first.
        excess: error of its part with it over that of the other blocks, 1.0 if not significantly
            above.
        others: further changes of its part, where they are not certain.
    """

    change: Change
    ratio: float
    size: float | None = None
    std: float = 0.0
    interval_factor: float = 2.0
    rivals: tuple[tuple[Change, ...], ...] = ()
    excess: float = 1.0
    others: tuple[Change, ...] = ()

    @property
    def is_certain(self) -> bool:
        """Whether it is clearly not zero, nothing else explains as much, and nothing is left."""
        if self.size is None:
            is_something = self.change.meaning != "payload"  # a load has a mass
        else:
            is_something = abs(self.size) > self.half_interval
        return is_something and not self.rivals and self.excess <= SEPARATE_ERROR_RATIO

    def is_assumed(self, scale_std: Array) -> bool:
        """Return whether it is a torque constant within what is assumed of the torques' scales.

        Args:
            scale_std: relative standard deviation of each joint's torque scale (n,).
        """
        if not self.change.is_constant or self.size is None:
            return False
        return abs(self.size) <= SIGNIFICANT_SIGMAS * self.relative_std(scale_std)

    def relative_std(self, scale_std: Array) -> float:
        """Return the deviation of a torque constant relative to the others, of these deviations."""
        return math.hypot(scale_std[[*self.change.joints]].max(), self.std)

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
    return _Search.of(model, recordings, fitted, seen=len(seen), blocks=blocks).explanations(1)


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


def _best(trials: Sequence[_Trial]) -> _Trial | None:
    """Return the significant trial of least error, with few coefficients preferred."""
    better = [trial for trial in trials if trial.is_better]
    least = min((trial.explanation.ratio for trial in better), default=0.0)
    alike = [trial for trial in better if trial.explanation.ratio <= _ALIKE_ERROR_RATIO * least]
    return min(alike, key=lambda trial: (trial.coefficients, trial.explanation.ratio), default=None)


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


def _excess(squares: Array, usual: Array, inside: NDArray[np.bool_]) -> float:
    """Return the error of a part's blocks over that of all others, 1.0 if not significant.

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


@dataclass(eq=False)
class _Search:
    """Recordings as sums over columns, and the changes that were found in them."""

    model: RobotModel
    recordings: Sequence[Samples]
    fitted: ExplainedFit
    tables: ColumnSums
    moved: list[int]  # joints whose scale and friction the fitted rows show
    seen: int  # recordings without a change that begins in them
    blocks: int
    recorded: Sequence[Samples]  # the recordings, with all scales
    known: list[Change] = field(default_factory=list)

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
        tables = ColumnSums.of(model, recordings, fitted.values, blocks=blocks)
        return cls(model, recordings, fitted, tables, moved, seen, blocks, recordings)

    def explanations(self, most: int = _MAX_CHANGES) -> tuple[Explanation, ...]:
        """Return the changes found, one after the other."""
        found: list[Explanation] = []
        while len(found) < most and (trial := _best(self.trials())) is not None:
            meaning = trial.explanation.change.meaning
            if most > 1 and (both := self._load_and_scale(trial.explanation)):
                self.known.append(both[0].change)
                found += both
                continue
            found.append(self._resized(trial.explanation, trial.values))
            if meaning in ("arm", "drift"):
                break  # separate parameters leave nothing to compare, a drift what is not linear
            self.known.append(trial.explanation.change)
        return tuple(self._examined(found))

    def _examined(self, found: Sequence[Explanation]) -> Iterator[Explanation]:
        """Yield what was found, each in a part with what contradicts it, given all others.

        All that is in a part is as uncertain as one of it. What was found after it, and is
        throughout or uncertain as well, rests on it and is left out.
        """
        changes = [each.change for each in found]
        examined = []
        for k, each in enumerate(found):
            part = each.change.part
            others = changes[:k] + changes[k + 1 :]
            if part is None:
                examined.append(self._given(each, others))
                continue
            self.known = others
            score = self._score(self._before, each.change)
            if len(found) > 1:
                each = self._resized(each, score.values.mean(axis=0))
            rivals = self._rivals(each, score) or self._other_constants(each)
            self.known = others
            examined.append(each._replace(rivals=rivals, excess=self._excess(part, score)))
        of_parts = [each for each in examined if each.change.part is not None]
        uncertain = next((each for each in of_parts if not each.is_certain), None)
        if uncertain is None:
            yield from examined
            return
        part = uncertain.change.part
        first = next(k for k, change in enumerate(changes) if change.part == part)
        yield from examined[:first]
        others = [change for change in changes[first:] if change.part in (None, part)]
        others.remove(uncertain.change)
        rivals = tuple(
            (*rival, *(each for each in others if not _contains(rival, each)))
            for rival in uncertain.rivals
        )
        yield uncertain._replace(others=tuple(others), rivals=rivals)
        yield from (
            each
            for each in examined[first:]
            if each.change.part not in (None, part) and each.is_certain
        )

    def _given(self, found: Explanation, others: list[Change]) -> Explanation:
        """Return what was found throughout, with its size given all others.

        The size of the first is otherwise that without those found later.
        """
        is_undone = self.recordings is not self.recorded  # a scale, whose size was found with it
        if not others or is_undone or found.size is None:
            return found
        self.known = others
        score = self._score(self._before, found.change)
        return self._resized(found, score.values.mean(axis=0))

    def _rivals(self, found: Explanation, score: ColumnScore) -> tuple[tuple[Change, ...], ...]:
        """Return changes that explain a part as well as one, and pairs that explain more.

        Of pairs significantly more, or with another size of what was found. Of all parameters,
        which explain the most, pairs are rivals that explain as much.

        Args:
            found: change of the part.
            score: of it.
        """
        change = found.change
        load = Change("payload", part=change.part)
        of_joints = [
            Change(meaning, joints, part=change.part)
            for meaning in _OF_JOINT
            for joints in [(), *((joint,) for joint in self.moved)]
            if joints or meaning == "friction"
        ]
        drift = Change("friction drift", tuple(self.moved))
        singles = [(each,) for each in (load, *of_joints, drift) if each != change]
        throughout = [Change("scale", (joint,)) for joint in self.moved]
        pairs = [(load, each) for each in (*of_joints, *throughout)]
        if change.meaning in _OF_JOINT:
            pairs += [(change, each) for each in of_joints if each != change]
        is_arm = change.meaning == "arm"
        if is_arm and self._may_be_unmodelled(score):
            return ((Change("unmodelled"),),)
        alike = SEPARATE_ERROR_RATIO if is_arm else _ALIKE_ERROR_RATIO
        ratios: dict[tuple[Change, ...], float] = {}
        for rivals in (singles, pairs):
            for rival in rivals:
                both = self._score(self._before, *rival)
                ratio, highest = both.ratio_to(score)
                is_rival = ratio <= alike
                if len(rival) > 1 and not is_arm:
                    is_rival = ratio * alike < 1.0 and (
                        highest < 1.0 or self._has_another_size(found, rival, both)
                    )
                if is_rival:
                    ratios[rival] = ratio
            if ratios:
                break  # of pairs, one of which is enough
        return tuple(sorted(ratios, key=ratios.__getitem__)[:_MOST_RIVALS])

    def _may_be_unmodelled(self, score: ColumnScore) -> bool:
        """Return whether parameters of a part may fit what the model lacks.

        Other motions show it with other parameters. The parameters of another arm explain most of
        an error that is more than noise.
        """
        usual = self._score(self._before)
        is_noise = usual.is_near_noise(self._noise)
        return is_noise or not score.explains((), usual, self._noise, None)

    def _has_another_size(
        self, found: Explanation, rival: Sequence[Change], score: ColumnScore
    ) -> bool:
        """Return whether a size, in a set of changes, is outside the intervals of each other."""
        if found.size is None or found.change not in rival:
            return False
        search = replace(self, known=list(self.known))
        for each in rival:
            if each.meaning == "scale" and each.part is None and found.change.meaning == "payload":
                search._undo(each, found.change)  # of the torque of the load as well
            elif each != found.change:
                search.known.append(each)
        other = search._resized(found, score.values.mean(axis=0))
        if other.size is None:
            return True
        reach = math.hypot(found.half_interval, other.half_interval)
        return abs(other.size - found.size) > reach

    def _other_constants(self, found: Explanation) -> tuple[tuple[Change, ...], ...]:
        """Return scales of other joints throughout that fit alike, with another size of a part."""
        rivals = []
        for constant in self.known:
            if constant.meaning != "scale" or constant.part is not None:
                continue
            search = replace(self, known=[each for each in self.known if each != constant])
            search.recordings = self.recorded  # with its scale
            search._refitted(self.fitted.values)
            one = search._score(search._before, found.change, constant)
            for joint in self.moved:
                other = constant._replace(joints=(joint,))
                if other in self.known:
                    continue
                both = search._score(search._before, found.change, other)
                is_alike = both.ratio_to(one)[0] <= _ALIKE_ERROR_RATIO
                if is_alike and search._has_another_size(found, (found.change, other), both):
                    rivals.append((found.change, other))
        return tuple(rivals[:_MOST_RIVALS])

    def _excess(self, part: Part, score: ColumnScore) -> float:
        """Return the error of a part over that of the other blocks, 1.0 if not significant.

        It is compared as it is, and as a share of the torque, with which noise may grow.
        """
        tables = self.tables
        inside = tables.mask_of(Change("arm", part=part)) > 0.0
        torque = tables.torques[:, :, None]
        power = (np.swapaxes(torque, 1, 2) @ tables.gram @ torque)[..., 0, 0]
        return min(
            _excess(score.squares, usual, inside) for usual in (tables.rows.astype(float), power)
        )

    def _load_and_scale(self, found: Explanation) -> list[Explanation]:
        """Return a load in a part with the scale of a joint, if they explain more than was found.

        Where the torque of a joint has another scale, a load alone leaves its error, or is a wrong
        one, and other scales or parameters of the part imitate both. What is left is searched with
        the scale undone.
        """
        if found.change.part is None:
            return []
        load = Change("payload", part=found.change.part)
        before = self._before
        usual = self._score(before)
        separate = self._score(before, Change("arm", part=found.change.part))
        of_load = self._score(before, load)
        is_arm = found.change.meaning == "arm"  # which has many more coefficients
        least = (_ALIKE_ERROR_RATIO if is_arm else 1.0 - _MIN_ERROR_REDUCTION) * found.ratio
        best: tuple[Change, float, float] | None = None
        for joint in self.moved:
            scale = Change("scale", (joint,))
            both = self._score(before, load, scale)
            ratio, highest = both.ratio_to(usual)
            alone = both.ratio_to(self._score(before, scale)), both.ratio_to(of_load)
            is_needed = all(
                each < 1.0 - _MIN_ERROR_REDUCTION and limit < 1.0 for each, limit in alone
            )
            explains = both.explains((), usual, self._noise, separate)
            if is_needed and explains and highest < 1.0 and ratio < least:
                least = ratio
                best = scale, alone[0][0], alone[1][0]
        if best is None:
            return []
        scale, ratio_of_load, ratio_of_scale = best
        size, std = self._undo(scale, load)
        of_load_alone = self._resized(Explanation(load, ratio_of_load))
        return [of_load_alone, Explanation(scale, ratio_of_scale, size, std)]

    def _undo(self, scale: Change, load: Change) -> tuple[float, float]:
        """Undo the scale of a joint's torque in the recordings, and return it, and its deviation.

        It multiplies the torque of a load as well, so that it is found in rounds.
        """
        size = std = 0.0
        recorded = self.recordings
        for _ in range(_SCALE_ROUNDS):
            undone = scale._replace(size=size)
            self.recordings = [changed_samples(self.model, each, undone) for each in recorded]
            self._refitted(self.fitted.values)
            both = self._score(self._before, load, scale)
            more = both.added[:, N_LINK]  # after the columns of the load
            std = (1.0 + size) * float(np.sqrt((len(more) - 1) * more.var()))
            size = (1.0 + size) * (1.0 + float(more.mean())) - 1.0
            self._refitted(both.values.mean(axis=0))
            if abs(more.mean()) < _SCALE_TOLERANCE:
                break
        return size, std

    def _refitted(self, values: Array) -> None:
        self.fitted = replace(self.fitted, values=values)
        self.tables = ColumnSums.of(self.model, self.recordings, values, blocks=self.blocks)

    @property
    def _before(self) -> Array:
        """Columns of what was found before."""
        none = np.zeros((*self.tables.gram.shape[:3], 0))
        return np.concatenate([none, *map(self._columns, self.known)], axis=3)

    @property
    def _noise(self) -> Array:
        """Sums of squared noise (n,)."""
        noise = self.fitted.noise
        noise = np.zeros(self.model.n_joints) if noise is None else np.nan_to_num(noise)
        return np.asarray(noise**2 * self.tables.rows.sum(axis=0))

    def _columns(self, change: Change) -> Array:
        return columns_of(self.tables, self.model, self.fitted.values, change)

    def _score(self, before: Array, *changes: Change) -> ColumnScore:
        columns = np.concatenate([*map(self._columns, changes), before], axis=3)
        return column_score(self.tables, columns, self.tables.torques)

    def trials(self) -> list[_Trial]:
        """Try each change."""
        tables = self.tables
        before = self._before
        usual = self._score(before)
        noise = self._noise
        separate: dict[Part, ColumnScore | None] = {}
        trials = []
        for change in self._changes():
            if change.part is not None:
                if change.part not in separate:
                    separate[change.part] = self._separate(change.part, before, usual)
                if separate[change.part] is None:
                    continue
            added = self._columns(change)
            if not added.any():
                continue  # such as friction of a frictionless joint
            score = self._score(before, change)
            of_part = None if change.part is None else separate[change.part]
            explains = score.explains(change.joints, usual, noise, of_part)
            size, std = rough_size(change, score, tables)
            if change.meaning == "load friction" and (size or 0.0) <= 0.0:
                continue  # friction dissipates
            if (
                size is not None
                and change.meaning == "payload"
                and abs(size) < _MIN_PAYLOAD_SIGMAS * std
            ):
                continue  # the interval of its mass contains zero
            ratio, highest = score.ratio_to(usual)
            found = Explanation(change, ratio, size, std)
            trials.append(
                _Trial(found, highest, added.shape[3], score.values.mean(axis=0), explains)
            )
        return trials

    def _separate(self, part: Part, before: Array, usual: ColumnScore) -> ColumnScore | None:
        """Return the score of separate parameters of a part, None if they hardly fit better.

        All that may have changed in the part is within them.
        """
        arm = Change("arm", part=part)
        score = self._score(before, arm) if self.known else None
        if score is None:  # the two sides have nothing in common: a tenth of the time
            mask = self.tables.mask_of(arm)
            fitted = separate_errors(self.tables, self.tables.torques, mask)
        else:
            fitted = score.fitted
        if fit_ratio(fitted, usual.fitted) > 1.0 - _MIN_ERROR_REDUCTION:
            return None
        return self._score(before, arm) if score is None else score

    def _resized(self, explanation: Explanation, values: Array | None = None) -> Explanation:
        """Return an explanation with the size that is most probable, by a fit with it (p,)."""
        values = self.fitted.values if values is None else values
        if explanation.change.meaning == "arm":
            return explanation
        tables = ColumnSums.of(
            self.model, self.recordings, values, blocks=self.blocks, divided=_PARTS_PER_BLOCK
        )
        found = estimated_size(
            explanation.change,
            tables,
            self.model,
            values,
            known=self.known,
            prior=self.fitted.prior,
            scale_std=self.fitted.scale_std,
        )
        if found is None:
            return explanation._replace(size=None, std=0.0)
        return explanation._replace(
            size=found.size, std=found.std, interval_factor=found.interval_factor
        )

    def _changes(self) -> Iterator[Change]:
        """Yield the changes to try: throughout, then in parts."""
        # What a joint that stands still does says nothing about its scale.
        of_parts = [Change(meaning) for meaning in _OF_ARM]
        of_parts += [Change(meaning, (joint,)) for joint in self.moved for meaning in _OF_JOINT]
        if not self.seen:
            yield from (Change("delay"), Change("load friction"))
            for joint in self.moved:
                yield from (Change("delay", (joint,)), Change("scale", (joint,)))
                if self.model.chain.revolute[joint]:
                    yield Change("drift", (joint,))
        for part in self._later_parts():
            yield from (change._replace(part=part) for change in of_parts)
        yield from (Change("payload", part=part) for part in self._inner_parts())
        if not self.seen and len(self.recordings) > 2:
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

    def _inner_parts(self) -> Iterator[Part]:
        """Yield the blocks from each time to another, within a recording."""
        tables = self.tables
        blocks = np.arange(len(tables.recording))
        for first in range(MIN_BLOCKS, len(blocks) - 2 * MIN_BLOCKS + 1):
            k = int(tables.recording[first])
            if k < self.seen or tables.start[first] == 0.0:
                continue
            for end in range(first + MIN_BLOCKS, len(blocks) - MIN_BLOCKS + 1):
                if tables.recording[end] != k or tables.start[end] == 0.0:
                    break
                start, stop = tables.start[first], tables.start[end]
                name = f"{self.fitted.name_of(k)} from {start:.3g} s to {stop:.3g} s"
                inside = (blocks >= first) & (blocks < end)
                yield Part(name, tuple(inside.tolist()), start, stop)

    def _later_parts(self) -> Iterator[Part]:
        """Yield the blocks from each time on, in recordings that are not known to be without."""
        tables = self.tables
        blocks = len(tables.recording)
        for first in range(MIN_BLOCKS, blocks - MIN_BLOCKS + 1):
            k = int(tables.recording[first])
            if k < self.seen:
                continue
            start = tables.start[first]
            name = self.fitted.name_of(k)
            description = f"{name} from {start:.3g} s on" if start > 0.0 else name
            if k < len(self.recordings) - 1:
                description += " and what follows it"
            yield Part(description, tuple((np.arange(blocks) >= first).tolist()), start)
