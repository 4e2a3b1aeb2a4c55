"""Settings of an identification, chosen by predicting parts of the fitted data from the rest.

Each recording is cut into `FOLDS` segments. Parameters are estimated from all segments but one and
predict all rows of that one, including rest. The score of a candidate is ``||e|| / ||tau||`` over
all joints, geometric mean over the segments, so that no hard one decides alone. A candidate
replaces the first one only if its error is lower by more than the standard error of the difference
over the segments (one-standard-error rule, Breiman et al. 1984). Held-out data are not read.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.errors import IdentificationError
from identification.estimators.consistent import consistent_values
from identification.estimators.prior import (
    USUAL_SPEED,
    BodyPrior,
    body_prior,
    design_effect_of,
    posterior_values,
    torque_scatter,
)
from identification.factor.blocks import add_grams, count_by_block, equal_runs
from identification.factor.factor import Factor, total_factor
from identification.factor.rows import augmented_rows
from identification.model.elements import Element, TorqueRipple, TorsionSpring
from identification.model.friction import FrictionLaw
from identification.model.robot import RobotModel
from identification.selection.settings import Choice, Settings, Strength
from identification.signals.masks import LeftOut
from identification.signals.samples import Preprocessing, Samples, VelocitySource

Array = NDArray[np.float64]
Rows = NDArray[np.bool_]
Question = Literal[
    "delay",
    "bandwidth",
    "velocity",
    "presliding",
    "rows",
    "friction",
    "ripple",
    "springs",
    "low-pass",
    "estimator",
]

FOLDS: Final = 10
RATE: Final = 125.0
"""Rate [Hz] to which recordings are averaged for choices: three times the widest bandwidth."""
SHORT: Final = 15.0
"""Time of motion [s] below which fewer questions are asked: ten segments of less than a second and
a half show no period of an exciting motion."""
IF_LONG: Final[frozenset[str]] = frozenset({"springs"})
"""Questions that are asked of long recordings only: their answers correct small errors, and a wrong
one costs much on another motion."""
DETAILS: Final[frozenset[str]] = frozenset({"bandwidth", "presliding"})
"""Questions that a short recording must answer with `CERTAIN` standard errors. It is not asked for
a narrower bandwidth: what is smoothed away is not predicted wrongly, but on another motion."""
CERTAIN: Final = 3.0
LOW_PASS: Final = "low-pass of the torque"
REVERSAL: Final = "reversal of dry friction"
DELAY: Final = "delay of the torque"
LOAD: Final = "friction that grows with load"
STRENGTH: Final = "strength of the prior"
CONSISTENT: Final = "physical consistency"
SPRINGS: Final = "torsion springs"
ROWS_IN_MOTION: Final = "rows that are left out, by the error in motion"
"""Names of decisions."""
# A drive differentiates its encoder at a higher rate than the log has.
VELOCITIES: Final[tuple[VelocitySource, ...]] = ("measured", "position")
# Unmodelled dynamics start at about 10 Hz on most arms. The smoother of 14 Hz, the default, leaves
# nine tenths of an amplitude there, and half of it at 14 Hz.
BANDWIDTHS: Final = (14.0, 7.0, 10.0, 20.0, 40.0)  # Hz
# The middle of what gears show first. Zero is no candidate: its sign at rest is noise.
PRESLIDING: Final = (3e-5, 1e-6, 1e-5, 1e-4, 3e-4, 1e-3)  # rad or m
# Rows of a joint that stands while another moves hold its load; but those near a reversal, or at
# rest by brake or static friction, can mislead.
LEFT_OUT: Final[tuple[LeftOut, ...]] = ("rests", "halts", "slow")
# Speeds over which dry friction may reverse smoothly, and factors that refine the best of them.
REVERSAL_SPEEDS: Final = (0.02, 0.08, 0.3)  # rad/s or m/s
REVERSAL_STEPS: Final = (1.5, 1.25, 1.12, 1.06, 1.03, 1.015, 1.008)
NEARBY: Final = (1.0, 0.9, 0.95, 1.05, 1.1)  # factors of the bandwidth of a low-pass
STRENGTHS: Final = (1.0, 4.0, 16.0, 64.0, 1e4)
"""Weights of the described bodies: deviations of 30, 15, 7.5, 4 and 0.3 % of their masses.

None below one: folds of one motion would favour a weaker prior, which another motion pays for. The
large ones are for recordings that determine little (``benchmarks.poor_recordings``): those of the
board hardly depend on them (up to 4 instead of 1e4 changes their mean error by 0.1 %), but would
lose with a first weight of 4 (``benchmarks.leave_one_out``).
"""
# Terms beside Coulomb and viscous friction; they correlate, so one at most. The stated law comes
# first.
FRICTION_TERMS: Final[tuple[Mapping[str, Any], ...]] = (
    {"third": "none", "stribeck": 0.0},
    {"third": "quadratic", "stribeck": 0.0},
    {"third": "cubic", "stribeck": 0.0},
    {"third": "none", "stribeck": 0.1},
)
# Improvement required to replace the first, simpler candidate, beside its standard error; more for
# a low-pass, which correlates with other settings.
WORTHWHILE: Final = 0.01
LOW_PASS_WORTHWHILE: Final = 0.05
TERM_WORTHWHILE: Final = 0.02
SPRING_WORTHWHILE: Final = 0.3  # of the error of its own joint
# Bodies that cannot exist are of no use in a simulator, so they must predict much better.
IMPOSSIBLE_WORTHWHILE: Final = 0.05
# An error above the torque itself chooses nothing, nor does one that no sensor resolves.
_MEANINGLESS: Final = 1.0
_EXACT: Final = 1e-5
_SAME: Final = 1e-4  # relative difference of errors that is none
# Speeds above this share of the largest are predicted from slower ones to try friction terms.
_FAST: Final = 0.85
# Share of the rows of a joint in motion that are faster than a Stribeck term reaches.
_FEWEST_FAST: Final = 0.1
# Another motion may be faster by this factor, which a friction law has to bear.
_FASTER: Final = 2.0
# Smallest friction within the range of speeds, as a share of Coulomb or static friction.
_LEAST_FRICTION: Final = 0.5
# Share of load that becomes friction in a worm gear; a larger one is another effect.
_LARGEST_SHARE: Final = 0.5
_SHOWN: Final = 0.1  # share of the torque's scatter from which on friction is judged
_SPEEDS: Final = 20  # points of that test
_MOST_SWEEPS: Final = 2
_POSTURES: Final = 50  # of a recording in which the inertia of the joints is judged
_FAR_BETTER: Final = 0.5  # share of an error, of what shows in spite of doubts
# Variance inflation from which on two columns are one (James et al. 2013, section 3.3.3): 5 to 10.
_COLLINEAR: Final = 5.0


@dataclass(frozen=True, eq=False)
class Errors:
    """Prediction errors of the segments."""

    squares: Array  # of the errors of each segment and joint (FOLDS, n); infinite if not predicted
    torque: Array  # squares of the torque (FOLDS, n)

    @property
    def segments(self) -> Array:
        """``||e|| / ||tau||`` over all joints of each segment with torque (k,)."""
        loaded = self.torque.sum(axis=1) > 0.0
        return _relative(self.squares.sum(axis=1)[loaded], self.torque.sum(axis=1)[loaded])

    def segments_of(self, joint: int) -> Array:
        """``||e|| / ||tau||`` of a joint in each segment in which it has torque (k,)."""
        loaded = self.torque[:, joint] > 0.0
        return _relative(self.squares[loaded, joint], self.torque[loaded, joint])

    @property
    def joints(self) -> Array:
        """Geometric mean over the joints of their relative error in each segment (k,)."""
        both = self.torque > 0.0
        ratio = _relative(self.squares, np.where(both, self.torque, 1.0))
        count = np.maximum(both.sum(axis=1), 1)
        means = np.exp(np.where(both, np.log(ratio), 0.0).sum(axis=1) / count)
        return np.asarray(means[both.any(axis=1)])

    @property
    def overall(self) -> float:
        """Geometric mean of the segments' errors, infinite if a segment is not predicted."""
        return _mean(self.segments)


def _mean(errors: Array) -> float:
    """Return the geometric mean of errors (k,), NaN of none."""
    return float(np.exp(np.mean(np.log(errors)))) if errors.size else math.nan


def _relative(squares: Array, torque: Array) -> Array:
    """Return relative errors of sums of squares with torque, above zero."""
    return np.sqrt(np.maximum(squares / torque, np.finfo(np.float64).tiny))


@dataclass(frozen=True, eq=False)
class Folds:
    """Factors by segment."""

    fitted: Factor  # of usable rows, a block for each segment
    predicted: Factor  # of all rows

    @classmethod
    def of(
        cls, model: RobotModel, recordings: Iterable[Samples], fast: Array | None = None
    ) -> Folds:
        """Reduce recordings, each cut into `FOLDS` segments of equal length.

        With speeds `fast` (n,), slower rows are fitted and faster ones are predicted.
        """
        fitted = Factor.zero(model, FOLDS)
        beside = Factor.zero(model, FOLDS)
        for samples in recordings:
            usable = samples.usable
            others = ~samples.usable
            if fast is not None:
                others = np.abs(samples.motion.velocity) > fast
                usable = usable & ~others
            edges = np.linspace(0, len(usable), FOLDS + 1).round().astype(int)
            index = np.repeat(np.arange(FOLDS), np.diff(edges))
            fitted.counts[:] += count_by_block(index, usable)
            beside.counts[:] += count_by_block(index, others)
            for part, rows in augmented_rows(model, replace(samples, usable=usable | others)):
                for joint, table in enumerate(rows):
                    # The fewer rows are those that are not fitted.
                    some = np.flatnonzero(others[part, joint])
                    add_grams(beside.matrices[joint], table[:, some], equal_runs(index[part][some]))
                    table[:, ~usable[part, joint]] = 0.0
                fitted.add_rows(index[part], rows)
        return cls(fitted, fitted + beside if fast is None else beside)

    def without(self, k: int) -> Factor:
        """Return the factor of all segments but k."""
        return self.fitted.without(slice(k, k + 1))

    @property
    def separable(self) -> bool:
        """Whether rows are fitted without any one of the segments."""
        others = self.fitted.samples - self.fitted.counts
        return bool(others.any(axis=1).all())

    def errors(self, estimate: Callable[[Factor], Array], targets: Factor) -> Errors:
        """Return errors of ``estimate(factor without a segment)`` on its part of the targets."""
        values = np.array([estimate(self.without(k)) for k in range(FOLDS)])
        torque = np.array([table[:, -1, -1] for table in targets.matrices]).T
        return Errors(targets.squared_errors_by_block(values), torque)


PredictedRows = Literal["all", "fitted", "moving"]
"""Rows that are predicted; moving ones are those that slide, whichever are fitted."""

Ready = Callable[[RobotModel, Preprocessing], Sequence[Samples]]
"""Prepares the fitted data for a model, averaged to `RATE`."""

Columns = tuple[tuple[FrictionLaw, ...], tuple[int, ...], tuple[str, ...]]
"""Friction of a model, periods of its torque ripple per motor turn, joints with a spring."""

LowPasses = Callable[[RobotModel, Preprocessing], Sequence[Preprocessing]]
"""Returns settings with candidate low-passes of the torque."""

Known = Mapping[str, tuple[float, float]]
"""Mean and standard deviation of parameters that are known beforehand."""


class SuggestedDelay(NamedTuple):
    """A delay of the torque that differs significantly from that of the settings."""

    value: float  # s
    determined: bool  # whether to a millisecond


def choose_settings(
    model: RobotModel,
    ready: Ready,
    start: Settings,
    questions: Collection[Question],
    low_passes: LowPasses,
    delays: Sequence[SuggestedDelay] = (),
    ripples: Sequence[Sequence[TorqueRipple]] = (),
    springs: Sequence[str] = (),
    stated: Known | None = None,
) -> Settings:
    """Choose settings one after the other, from data that `ready` prepares for the arm's `model`.

    `delays` of the torque are candidates for "delay" that must predict no worse than that of
    `start`, or better if they are not determined; `ripples` those for "ripple", and joints
    `springs` those for "springs". Returns settings with their choices; `start` if the data are too
    short, or predict no part of themselves.
    """
    trial = _Trial(model, ready, stated, ripples)
    now = _first_candidates(start, questions)
    asked: set[str] = {*questions}
    if "estimator" in asked:
        asked |= {"strength", "consistency"}
    if trial.duration(now) < SHORT:
        asked -= IF_LONG
    first = now
    trial.weigh(first)
    now, choices = _sweep(trial, first, asked)
    if "delay" in asked:
        first, now, choices = _compare_delays(trial, first, now, choices, asked, delays)
    if "low-pass" in asked:
        now, choices = _compare_low_passes(trial, first, now, choices, asked, low_passes)
    if "friction" in asked:
        for decide in (_friction_terms, _load_friction):
            decision = decide(trial, now)
            now = decision.settings
            choices = [*choices, decision.choice]
    if "ripple" in asked:
        rippled = [now.with_friction(ripple=orders) for orders in trial.ripples]
        decision = trial.decide("torque ripple", [now, *rippled])
        now = decision.settings
        choices = [*choices, decision.choice]
    trial.weigh(now)
    compared, now, decided = _choose_prior(trial, now, asked)
    if not trial.errors(compared).overall < _MEANINGLESS:
        return start
    choices = [*choices, *decided]
    if "springs" in asked:
        # Last: what is left of a spring that impossible bodies stand for is theirs as before.
        for decision in _torsion_springs(trial, now, springs):
            now = decision.settings
            choices = [*choices, decision.choice]
    return replace(now, choices=tuple(choice for choice in choices if len(choice.candidates) > 1))


def _first_candidates(start: Settings, questions: Collection[Question]) -> Settings:
    """Return settings with the first candidate of each that is swept."""
    settings = start
    if "bandwidth" in questions:
        settings = settings.preprocessed(rigid_bandwidth=BANDWIDTHS[0])
    if "velocity" in questions:
        settings = settings.preprocessed(velocity=VELOCITIES[0])
    if "rows" in questions:
        settings = settings.preprocessed(left_out=LEFT_OUT[0])
    if "presliding" in questions:
        settings = settings.with_friction(presliding=PRESLIDING[0])
    return settings


def _choose_prior(
    trial: _Trial, now: Settings, asked: Collection[str]
) -> tuple[Settings, Settings, list[Choice]]:
    """Choose the strength of the prior, then whether bodies must be possible.

    Returns the settings after each of the two, and the decisions.
    """
    choices: list[Choice] = []
    if "strength" in asked and trial.knows_bodies(now):
        weights = [replace(now.strength, weight=weight) for weight in STRENGTHS]
        decision = trial.decide_last(STRENGTH, [replace(now, strength=each) for each in weights])
        now = decision.settings
        choices = [decision.choice]
    compared = now
    if "consistency" in asked:
        possible = replace(now, strength=replace(now.strength, consistent=True))
        if trial.fits_impossible(now, possible):
            decision = trial.decide(
                CONSISTENT,
                [possible, now],
                IMPOSSIBLE_WORTHWHILE,
                possible=lambda each: trial.carries_over(each, possible),
            )
            now = decision.settings
            choices = [*choices, decision.choice]
        else:
            now = possible
    return compared, now, choices


def _friction_terms(trial: _Trial, now: Settings) -> _Decision:
    """Choose the terms beside Coulomb and viscous friction, the stated ones first.

    A term must also predict fast motion from slower one no worse, and leave friction in a faster
    motion, too: the law is the choice that carries over to another motion least. Segments of a
    short motion have the same speeds and do not test it: there a term must predict the fast motion
    clearly better.
    """
    law = trial.model(now).friction.laws[0].table()
    stated = {"third": law["third"], "stribeck": law["stribeck"]}
    terms = [stated, *(term for term in FRICTION_TERMS if term != stated)]
    candidates = [now.with_friction(**term) for term in terms]

    limit = trial.fast_error(now)
    if trial.duration(now) < SHORT:
        limit *= 1.0 - TERM_WORTHWHILE

    def possible(term: Settings) -> bool:
        return (
            trial.fast_error(term) <= limit
            and trial.shows_stribeck(term)
            and trial.has_friction(term)
        )

    return trial.decide("friction at speed", candidates, TERM_WORTHWHILE, possible=possible)


def _load_friction(trial: _Trial, now: Settings) -> _Decision:
    """Choose whether dry friction grows with the transmitted torque, as in strain-wave gears.

    A stated term comes first. Shares that no gear has are refused.
    """
    law = trial.model(now).friction.laws[0]
    candidates = [now.with_friction(load=load) for load in (law.load, not law.load)]
    return trial.decide(
        LOAD,
        candidates,
        TERM_WORTHWHILE,
        possible=lambda each: law.load or trial.has_load_shares(each),
    )


def _torsion_springs(trial: _Trial, now: Settings, joints: Sequence[str]) -> list[_Decision]:
    """Choose the joints with a torsion spring, such as a hose that their motion twists.

    Bodies that cannot exist, with a negative inertia, predict the torque of a spring as well; so
    possible ones are compared, where they fit worse. Each spring must predict its own joint much
    better, which the error over all joints does not show of one with little torque.
    """
    possible = replace(now, strength=replace(now.strength, consistent=True))
    if not trial.fits_impossible(now, possible):
        return []
    every = possible.with_friction(springs=tuple(joints))

    def shows_spring(joint: str) -> bool:
        decision = trial.decide(
            SPRINGS,
            [possible, every],
            SPRING_WORTHWHILE,
            joint=joint,
            possible=lambda settings: trial.stiffness(joint, settings) > 0.0,
            certainty=CERTAIN,
        )
        return bool(decision.choice.chosen)

    shown = tuple(filter(shows_spring, joints))
    if not shown:
        return []
    candidates = [possible, possible.with_friction(springs=shown)]
    decision = trial.decide(SPRINGS, candidates, by_joint=True)
    return [decision._replace(settings=replace(decision.settings, strength=now.strength))]


def _compare_delays(
    trial: _Trial,
    first: Settings,
    now: Settings,
    choices: list[Choice],
    questions: Collection[str],
    delays: Sequence[SuggestedDelay],
) -> tuple[Settings, Settings, list[Choice]]:
    """Compensate a significant delay unless it predicts worse, and choose the other settings again.

    Compared on sliding rows, as presliding is similar to a delay, by the geometric mean over the
    joints. Returns the settings before and after the sweep, and its decisions.
    """
    compared: list[Choice] = []
    for delay in delays:
        sliding = now.preprocessed(left_out="slow")
        late = sliding.preprocessed(torque_delay=delay.value)
        # A short recording has to show that the delay predicts better, and so has a wide interval.
        doubtful = trial.duration(now) < SHORT or not delay.determined
        pair = [sliding, late] if doubtful else [late, sliding]
        # The unknown scale of one torque resembles a delay, but of that joint only.
        decision = trial.decide(DELAY, pair, 0.0, by_joint=True, rows="fitted")
        compared.append(decision.choice)
        if decision.settings.preprocessing.torque_delay == delay.value:
            first = first.preprocessed(torque_delay=delay.value)
            now, choices = _sweep(trial, first, questions)
    return first, now, [*compared, *choices]


def _compare_low_passes(
    trial: _Trial,
    first: Settings,
    now: Settings,
    choices: list[Choice],
    questions: Collection[str],
    low_passes: LowPasses,
) -> tuple[Settings, list[Choice]]:
    """Add a low-pass of the torque, or its delay alone, if that predicts better.

    Starts from the bandwidth of the `first` settings: a narrow one chosen `now` would replace a
    part of it.
    """
    start = now.preprocessed(rigid_bandwidth=first.preprocessing.rigid_bandwidth)
    possible = low_passes(trial.model(start), start.preprocessing)
    if not possible:
        return now, choices
    candidates = [replace(start, preprocessing=how) for how in possible]
    # A lag and a low-pass differ beside reversals, where friction is not quite as any law: one that
    # replaces a delay is the best of many.
    delayed = now.preprocessing.torque_delay != now.stated_delay
    certainty = CERTAIN if delayed else 1.0

    def compare(first: Settings, other: Settings) -> _Decision:
        return trial.decide(
            LOW_PASS, [first, other], LOW_PASS_WORTHWHILE, by_joint=True, certainty=certainty
        )

    likely = compare(start, trial.best(candidates))
    if not likely.choice.chosen:
        return now, [*choices, likely.choice]
    filtered, behind = _sweep(trial, likely.settings, questions)
    # Refined by prediction, as the residual's minimum is flat.
    filtered = trial.decide("", _nearby_bandwidths(filtered), share=0.0).settings
    # Compared by joint, as the channel is common to all.
    decision = compare(now, filtered)
    if decision.choice.chosen and filtered.preprocessing.torque_shape.causal:
        # A lag that predicts as well is called a delay.
        late = trial.decide("", _nearby_lags(now, filtered), share=0.0).settings
        delay = trial.decide(DELAY, [now, late], LOW_PASS_WORTHWHILE, by_joint=True)
        both = trial.decide(LOW_PASS, [late, filtered], LOW_PASS_WORTHWHILE, by_joint=True)
        if delay.choice.chosen and not both.choice.chosen:
            return late, [*choices, delay.choice, both.choice]
    if decision.choice.chosen and "friction" in questions:
        # Dry friction that reverses smoothly, as in most simulators, resembles it: of a filter that
        # does not exist.
        reversal = _smooth_reversal(trial, start, filtered)
        if reversal.choice.chosen:
            return reversal.settings, [*choices, reversal.choice]
    if decision.choice.chosen:
        return filtered, [*behind, decision.choice]
    return now, [*choices, decision.choice]


def _smooth_reversal(trial: _Trial, now: Settings, filtered: Settings) -> _Decision:
    """Choose friction of ``tanh(v / v_t)`` in place of a low-pass if it predicts clearly better."""
    best = trial.best([_with_tanh(now, speed) for speed in REVERSAL_SPEEDS])
    for step in REVERSAL_STEPS:
        if trial.best([best, filtered]) is filtered and step < REVERSAL_STEPS[0]:
            break
        speed = float(best.friction["tanh"])
        best = trial.best([best, *(_with_tanh(now, speed * part) for part in (1.0 / step, step))])
    return trial.decide(
        REVERSAL, [filtered, best], LOW_PASS_WORTHWHILE, by_joint=True, certainty=CERTAIN
    )


def _with_tanh(now: Settings, speed: float) -> Settings:
    return now.with_friction(tanh=speed).preprocessed(left_out="rests")


class _Decision(NamedTuple):
    settings: Settings
    choice: Choice


class _Reduced(NamedTuple):
    """Rows of settings, with the prior of their model."""

    folds: Folds
    prior: BodyPrior


class _Trial:
    """Scores of settings, with cached factors."""

    def __init__(
        self,
        model: RobotModel,
        ready: Ready,
        stated: Known | None = None,
        ripples: Sequence[Sequence[TorqueRipple]] = (),
    ) -> None:
        self.ripples = {ripple[0].orders: ripple for ripple in ripples if ripple}
        self._model = model
        self._models: dict[Columns, RobotModel] = {}
        self._laws: dict[tuple[tuple[str, object], ...], tuple[FrictionLaw, ...]] = {}
        self._ready = ready
        self._known = stated
        self._samples: dict[Preprocessing, list[Samples]] = {}
        self._directed: dict[tuple[Preprocessing, tuple[float, ...]], list[Samples]] = {}
        self._tables: dict[tuple[Columns, Preprocessing], _Reduced] = {}
        self._errors: dict[tuple[Columns, Preprocessing, Strength, str], Errors] = {}
        self._effect = 1.0
        self._weighed: tuple[Columns, Preprocessing] | None = None

    def model(self, settings: Settings) -> RobotModel:
        """Return the model of the arm with the friction and the torque ripple of settings."""
        laws, orders, springs = key = self._columns(settings)
        if key not in self._models:
            model = self._model.with_friction_laws(laws)
            elements: list[Element] = [*self.ripples.get(orders, ())]
            elements += [TorsionSpring(joint, rest=0.0, identified=True) for joint in springs]
            self._models[key] = model.with_elements(elements)
        return self._models[key]

    def _columns(self, settings: Settings) -> Columns:
        entries = {**settings.friction}
        orders = tuple(entries.pop("ripple", ()))
        springs = tuple(entries.pop("springs", ()))
        key = tuple(entries.items())
        if key not in self._laws:
            self._laws[key] = tuple(law.changed(entries) for law in self._model.friction.laws)
        return self._laws[key], orders, springs

    def factor_key(self, settings: Settings) -> tuple[Columns, Preprocessing]:
        """Return the key of the settings that change factors."""
        return self._columns(settings), settings.preprocessing

    def key(self, settings: Settings) -> tuple[Columns, Preprocessing, Strength]:
        """Return the key of the settings that change predictions."""
        return *self.factor_key(settings), settings.strength

    def weigh(self, settings: Settings) -> None:
        """Set how many rows count as one by the correlation of the residuals of settings.

        It is the same for all that are compared, so that none wins by a weaker prior.
        """
        key = self.factor_key(settings)
        if key == self._weighed:
            return
        self._weighed = key
        model = self.model(settings)
        total = total_factor(model, self.samples(settings))
        prior = self._reduced(settings).prior.gaussian
        self._effect = design_effect_of(total, prior) if total.samples.any() else 1.0
        self._errors.clear()

    def duration(self, settings: Settings) -> float:
        """Return the time of motion of the recordings [s], in which at least one joint moves."""
        model = self.model(settings)
        samples = self.samples(settings)
        return sum(
            float(np.count_nonzero(model.moving(each.motion.velocity).any(axis=1)))
            * float(np.median(np.diff(each.motion.time)))
            for each in samples
        )

    def decide(
        self,
        name: str,
        candidates: Sequence[Settings],
        share: float | None = None,
        *,
        by_joint: bool = False,
        joint: str | None = None,
        rows: PredictedRows = "all",
        possible: Callable[[Settings], bool] | None = None,
        certainty: float = 1.0,
    ) -> _Decision:
        """Return the first candidate, or the best one if it is clearly better, and `possible`.

        Better by a share (`WORTHWHILE`), and by more than the standard error of the difference over
        the segments times the certainty: over all joints, by their geometric mean `by_joint`, or of
        one `joint`.
        """
        share = WORTHWHILE if share is None else share
        scores = [self.errors(each, rows) for each in candidates]
        if joint is not None:
            index = self._model.joint_names.index(joint)
            segments = [score.segments_of(index) for score in scores]
        else:
            segments = [score.joints if by_joint else score.segments for score in scores]
        means = [_mean(part) for part in segments]
        chosen = 0
        for k, mean in enumerate(means):
            if not (mean < means[chosen] and mean < _MEANINGLESS) or means[0] < _EXACT:
                continue
            better = _clearly_better(segments[k], segments[0], share, certainty)
            if better and (possible is None or possible(candidates[k])):
                chosen = k
        self._retain_samples(candidates[chosen])
        return self._decision(name, candidates, means, chosen)

    def decide_last(self, name: str, candidates: Sequence[Settings]) -> _Decision:
        """Return the last candidate up to which none predicts worse than the first.

        For candidates in the order of what is safer where nothing is predicted, which therefore
        need not be better. None behind one that is worse is tried.
        """
        means = [self.errors(candidates[0]).overall]
        if _EXACT <= means[0] < _MEANINGLESS:
            for each in candidates[1:]:
                means.append(self.errors(each).overall)
                if not means[-1] <= (1.0 + _SAME) * means[0]:
                    break
        chosen = len(means) - 1
        if not means[chosen] <= (1.0 + _SAME) * means[0]:
            chosen -= 1
        return self._decision(name, candidates[: len(means)], means, chosen)

    def _decision(
        self, name: str, candidates: Sequence[Settings], means: Sequence[float], chosen: int
    ) -> _Decision:
        described = _differences([_description(self.model(each), each) for each in candidates])
        return _Decision(candidates[chosen], Choice(name, described, tuple(means), chosen))

    def knows_bodies(self, settings: Settings) -> bool:
        """Return whether the description has the masses of this arm."""
        return not self._reduced(settings).prior.placeholder

    def fits_impossible(self, settings: Settings, possible: Settings) -> bool:
        """Return whether bodies that cannot exist fit better than possible ones.

        What they fit better is the most that they can predict better.
        """
        limit = (1.0 - IMPOSSIBLE_WORTHWHILE) * self.fitted_error(possible)
        return self.fitted_error(settings) < limit

    def stiffness(self, joint: str, settings: Settings) -> float:
        """Return the fitted stiffness of the torsion spring of a joint [N·m/rad]."""
        model = self.model(settings)
        reduced = self._reduced(settings)
        values = self._estimator(settings, reduced)(reduced.folds.fitted)
        springs = [
            placed.part
            for placed in model.elements.identified
            if isinstance(placed.element, TorsionSpring) and placed.element.joint == joint
        ]
        return float(values[model.element_part][springs[0]][0])

    def walk(self, candidates: Sequence[Settings], size: Callable[[Settings], float]) -> list[int]:
        """Return the indices of the first candidate and, to both sides by size, of improvements.

        And of the next ones, which are worse: no candidate beyond is tried.
        """
        order = sorted(range(len(candidates)), key=lambda k: size(candidates[k]))
        start = order.index(0)
        visited = [0]
        for side in (order[:start][::-1], order[start + 1 :]):
            least = self.errors(candidates[0]).overall
            for k in side:
                visited.append(k)
                error = self.errors(candidates[k]).overall
                if not error < least:
                    break
                least = error
        return sorted(visited)

    def best(self, candidates: Sequence[Settings]) -> Settings:
        """Return the candidate with the least error by joint."""
        return min(candidates, key=lambda each: _mean(self.errors(each).joints))

    def errors(self, settings: Settings, rows: PredictedRows = "all") -> Errors:
        """Return the errors of predicting these rows of each segment from the others."""
        key = *self.key(settings), rows
        if key not in self._errors:
            self._errors[key] = self._predicted(settings, rows)
        return self._errors[key]

    def _predicted(self, settings: Settings, rows: PredictedRows) -> Errors:
        reduced = self._reduced(settings)
        n = self.model(settings).n_joints
        unknown = Errors(np.full((FOLDS, n), np.inf), np.ones((FOLDS, n)))
        if not reduced.folds.separable:
            return unknown
        estimate = self._estimator(settings, reduced)
        targets = reduced.folds.predicted if rows == "all" else reduced.folds.fitted
        if rows == "moving":
            targets = self._reduced(settings.preprocessed(left_out="slow")).folds.fitted
        try:
            return reduced.folds.errors(estimate, targets)
        except (IdentificationError, np.linalg.LinAlgError):
            return unknown

    def _estimator(self, settings: Settings, reduced: _Reduced) -> Callable[[Factor], Array]:
        effect = self._effect
        prior = reduced.prior.with_weight(settings.strength.weight)
        model = self.model(settings)
        _, of_all = posterior_values(reduced.folds.fitted, prior.gaussian, effect)

        def estimate(factor: Factor) -> Array:
            values, weights = posterior_values(factor, prior.gaussian, effect, of_all)
            if settings.strength.consistent:
                values = consistent_values(model, factor, weights, values, prior, effect)
            return values

        return estimate

    def fitted_error(self, settings: Settings) -> float:
        """Return the error of the fitted rows themselves; infinite if none can be fitted."""
        reduced = self._reduced(settings)
        try:
            values = self._estimator(settings, reduced)(reduced.folds.fitted)
        except (IdentificationError, np.linalg.LinAlgError):
            return math.inf
        return reduced.folds.fitted.relative_error(values)

    def fast_error(self, settings: Settings) -> float:
        """Return the error of fast motion predicted from slower one; zero if there is none.

        Infinite if slower motion cannot be fitted.
        """
        samples = self.samples(settings)
        speeds = [np.abs(each.motion.velocity).max(axis=0) for each in samples]
        fast = _FAST * np.max(speeds, axis=0)
        folds = Folds.of(self.model(settings), samples, fast)
        if not (folds.fitted.samples.any() and folds.predicted.samples.any()):
            return 0.0
        try:
            values = self._estimator(settings, self._reduced(settings))(folds.fitted)
        except (IdentificationError, np.linalg.LinAlgError):
            return math.inf
        return folds.predicted.relative_error(values)

    def has_friction(self, settings: Settings) -> bool:
        """Return whether the fitted friction of every joint stays near that at rest at all speeds.

        Up to twice those recorded and at least to a usual one, which another motion may have.
        """
        model = self.model(settings)
        reduced = self._reduced(settings)
        values = self._estimator(settings, reduced)(reduced.folds.fitted)
        table = model.friction.table(values[model.friction_part])
        fastest = np.max(
            [np.abs(each.motion.velocity).max(axis=0) for each in self.samples(settings)], axis=0
        )
        fastest = np.maximum(_FASTER * fastest, USUAL_SPEED)
        scatters = torque_scatter(model, reduced.folds.fitted)
        for law, coefficients, speed, scatter in zip(
            model.friction.laws, table, fastest, scatters, strict=False
        ):
            along = np.linspace(0.0, speed, _SPEEDS)
            columns = law.columns(along, np.ones_like(along))
            forces = [
                coefficients[symbol] * column
                for symbol, column in zip(law.symbols, columns, strict=True)
                if symbol != "fo"
            ]
            total = np.sum(forces, axis=0)
            # Stribeck friction at the lowest speed is at most twice that at higher ones.
            dry = max(coefficients.get("f0", 0.0), float(total[0]))
            # Friction that hardly shows in the torque is not worth a judgement.
            if dry > _SHOWN * scatter and float(total.min()) < _LEAST_FRICTION * dry:
                return False
        return True

    def carries_over(self, settings: Settings, possible: Settings) -> bool:
        """Return whether bodies that cannot exist may be trusted in another motion.

        They predict fast motion from slower one no worse than possible ones. Their inertia is one,
        or they predict so much better that they stand for something that is there.
        """
        if self.fast_error(settings) > self.fast_error(possible):
            return False
        limit = _FAR_BETTER * self.errors(possible).overall
        return self.has_inertia(settings) or self.errors(settings).overall < limit

    def has_inertia(self, settings: Settings) -> bool:
        """Return whether fitted inertias of joints that moved at one frequency are positive.

        Position and acceleration are one column then, and a negative inertia is the torque of a
        position, which is another one in a faster motion. Positive definite where the joints were,
        as bodies that cannot exist may be (Yoshida and Khalil 2000).
        """
        model = self.model(settings)
        reduced = self._reduced(settings)
        values = self._estimator(settings, reduced)(reduced.folds.fitted)
        samples = self.samples(settings)
        moved = [(each.motion.position, each.motion.acceleration) for each in samples]
        alike = np.flatnonzero(_correlation(moved) ** 2 > 1.0 - 1.0 / _COLLINEAR)
        for position, _ in moved:
            some = position[:: max(1, len(position) // _POSTURES)]
            inertia = model.joint_inertia(values, some)[:, alike[:, None], alike]
            if np.linalg.eigvalsh(inertia).min(initial=np.inf) <= 0.0:
                return False
        return True

    def shows_stribeck(self, settings: Settings) -> bool:
        """Return whether all joints that move are faster than their Stribeck term reaches, too.

        A slower one does not tell it from viscous friction, and both would be large and opposite.
        """
        samples = self.samples(settings)
        for joint, law in enumerate(self.model(settings).friction.laws):
            if not law.stribeck:
                continue
            speeds = np.concatenate(
                [np.abs(each.motion.velocity[each.usable[:, joint], joint]) for each in samples]
            )
            moving = speeds[speeds > law.standstill]
            # At twice its speed the term has fallen to 2 %.
            if moving.size and np.mean(moving > 2.0 * law.stribeck) < _FEWEST_FAST:
                return False
        return True

    def has_load_shares(self, settings: Settings) -> bool:
        """Return whether the fitted shares of load that become friction are those of gears.

        Weighted by the torque of their joints: that of a joint with hardly any torque is open.
        """
        reduced = self._reduced(settings)
        values = self._estimator(settings, reduced)(reduced.folds.fitted)
        power = reduced.folds.fitted.gram[:, -1, -1]
        model = self.model(settings)
        shares = [
            (value, power[term.owner])
            for value, term in zip(values[model.friction_part], model.friction.terms, strict=True)
            if term.term.of_load
        ]
        share, weight = np.array(shares).T
        return bool(0.0 < np.average(share, weights=weight) < _LARGEST_SHARE)

    def samples(self, settings: Settings) -> list[Samples]:
        """Return the samples of settings, with direction of friction and transmitted torque.

        The load is that of the estimate without friction that depends on it.
        """
        model = self.model(settings)
        how = settings.preprocessing
        key = how, tuple(law.presliding for law in model.friction.laws)
        if how not in self._samples:
            self._samples[how] = self._directed[key] = [*self._ready(model, how)]
        if key not in self._directed:
            self._directed[key] = [
                each.with_friction_direction(model) for each in self._samples[how]
            ]
        samples = self._directed[key]
        if not model.friction.has_load:
            return samples
        without = settings.with_friction(load=False)
        reduced = self._reduced(without)
        values = self._estimator(without, reduced)(reduced.folds.fitted)
        return [each.with_load(self.model(without), values) for each in samples]

    def _retain_samples(self, settings: Settings) -> None:
        """Give up the samples of all other settings: those of a long recording are large."""
        how = settings.preprocessing
        self._samples = {key: value for key, value in self._samples.items() if key == how}
        self._directed = {key: value for key, value in self._directed.items() if key[0] == how}

    def _reduced(self, settings: Settings) -> _Reduced:
        key = self.factor_key(settings)
        if key not in self._tables:
            model = self.model(settings)
            folds = Folds.of(model, self.samples(settings))
            prior = body_prior(model, folds.fitted, stated=self._known)
            self._tables[key] = _Reduced(folds, prior)
        return self._tables[key]


def _correlation(pairs: Sequence[tuple[Array, Array]]) -> Array:
    """Return the correlation (n,) of two columns (m, n) of recordings, zero of a constant one."""
    first, second = (
        np.concatenate([column - column.mean(axis=0) for column in columns])
        for columns in zip(*pairs, strict=True)
    )
    power = np.sqrt((first**2).sum(axis=0) * (second**2).sum(axis=0))
    return np.asarray((first * second).sum(axis=0) / np.where(power > 0.0, power, 1.0))


def _clearly_better(errors: Array, first: Array, share: float, certainty: float) -> bool:
    """Return whether errors of segments (k,) are lower than others by share and standard error."""
    if errors.shape != first.shape or not errors.size:
        return False
    if not np.all(np.isfinite(first)):
        return bool(np.all(np.isfinite(errors)))
    change = np.log(errors / first)
    spread = float(change.std(ddof=1) / np.sqrt(len(change))) if len(change) > 1 else np.inf
    return bool(change.mean() < min(math.log(1.0 - share), -certainty * spread))


def _sweep(
    trial: _Trial, now: Settings, questions: Collection[str]
) -> tuple[Settings, list[Choice]]:
    """Decide interdependent settings in turn until nothing changes."""
    asked = [swept for swept in _SWEPT if swept.question in questions]
    short = trial.duration(now) < SHORT
    choices: list[Choice] = []
    for _ in range(_MOST_SWEEPS):
        before = now
        choices = []
        for swept in asked:
            certainty = CERTAIN if short and swept.question in DETAILS else 1.0
            candidates = swept.vary(now)
            if short and swept.question == "bandwidth":
                widths = [each.preprocessing.rigid_bandwidth for each in candidates]
                candidates = [
                    each
                    for each, width in zip(candidates, widths, strict=True)
                    if width >= widths[0]
                ]
            if swept.size is not None:
                candidates = [candidates[k] for k in trial.walk(candidates, swept.size)]
            decision = trial.decide(swept.name, candidates, certainty=certainty)
            now = decision.settings
            choices = [*choices, decision.choice]
            if swept.question == "rows":
                decision = _rows_for_motion(trial, now, candidates, certainty)
                now = decision.settings
                choices = [*choices, decision.choice]
        if trial.key(now) == trial.key(before):
            break
    return now, choices


def _rows_for_motion(
    trial: _Trial, now: Settings, candidates: Sequence[Settings], certainty: float
) -> _Decision:
    """Choose among the candidates that predict all rows as well by the rows in motion.

    Static friction holds a joint at rest with any torque: its rows cannot be predicted, and decide
    the error over all rows. Fitted, they spoil the friction at speed.
    """
    limit = trial.errors(now).overall * (1.0 + WORTHWHILE)
    others = [each for each in candidates if each != now and trial.errors(each).overall < limit]
    return trial.decide(ROWS_IN_MOTION, [now, *others], rows="moving", certainty=certainty)


class _Swept(NamedTuple):
    """Setting that is decided repeatedly."""

    question: Question
    name: str
    vary: Callable[[Settings], list[Settings]]  # settings with each candidate
    size: Callable[[Settings], float] | None = None  # of the setting, if it is a number


_SWEPT: Final = (
    _Swept(
        "presliding",
        "presliding displacement",
        lambda now: [now.with_friction(presliding=distance) for distance in PRESLIDING],
        lambda now: float(now.friction["presliding"]),
    ),
    _Swept(
        "rows",
        "rows that are left out",
        lambda now: [now.preprocessed(left_out=rows) for rows in LEFT_OUT],
    ),
    _Swept(
        "velocity",
        "velocity",
        lambda now: [now.preprocessed(velocity=source) for source in VELOCITIES],
    ),
    _Swept(
        "bandwidth",
        "bandwidth of the motion",
        lambda now: [now.preprocessed(rigid_bandwidth=width) for width in BANDWIDTHS],
        lambda now: now.preprocessing.rigid_bandwidth,
    ),
)


def _nearby_bandwidths(now: Settings) -> list[Settings]:
    width = now.preprocessing.torque_bandwidth or math.nan
    return [now.preprocessed(torque_bandwidth=share * width) for share in NEARBY]


def _nearby_lags(now: Settings, filtered: Settings) -> list[Settings]:
    """Return delays near the lag of a causal low-pass, in its place."""
    how = filtered.preprocessing
    width = filtered.preprocessing.torque_bandwidth or math.inf
    lag = how.torque_shape.lag(width)
    return [now.preprocessed(torque_delay=how.torque_delay + share * lag) for share in NEARBY]


def _description(model: RobotModel, settings: Settings) -> tuple[str, ...]:
    """Return descriptions of the settings of a model, one by one."""
    how = settings.preprocessing
    width = how.torque_bandwidth
    elements = model.elements.elements
    orders = next((part.orders for part in elements if isinstance(part, TorqueRipple)), ())
    ripple = "no torque ripple"
    if orders:
        ripple = f"torque ripple, {' and '.join(map(str, orders))} per motor turn"
    springs = [part.joint for part in elements if isinstance(part, TorsionSpring)]
    left_out = {
        "slow": "slow rows and reversals",
        "halts": "long halts of each joint",
        "rests": "rests of the whole arm",
        "none": "none",
    }
    return (
        f"{how.rigid_bandwidth:g} Hz",
        "measured velocity" if how.velocity == "measured" else "velocity from positions",
        *model.friction.laws[0].summary(),
        ripple,
        f"torsion springs of {', '.join(springs)}" if springs else "no torsion spring",
        left_out.get(how.left_out or "", "by the friction law"),
        f"delay of {1e3 * how.torque_delay:.3g} ms",
        "no low-pass" if width is None else f"low-pass of {width:.3g} Hz, {how.torque_shape}",
        settings.strength.describe(),
    )


def _differences(descriptions: Sequence[tuple[str, ...]]) -> tuple[str, ...]:
    """Reduce descriptions of candidates to what differs."""
    differ = [len(set(column)) > 1 for column in zip(*descriptions, strict=True)]
    return tuple(
        ", ".join(part for part, apart in zip(parts, differ, strict=True) if apart)
        for parts in descriptions
    )
