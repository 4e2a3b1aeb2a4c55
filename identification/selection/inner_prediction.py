"""Settings of an identification, chosen by predicting parts of what is fitted from the rest.

Each recording is cut into `FOLDS` stretches of time. Parameters are estimated from all stretches
but one and predict the torque of that one: every row of it, at rest too. The score of a candidate
is ``||e|| / ||tau||`` over all joints, its mean over the stretches: squared and summed, one stretch
whose motion the others do not determine would decide alone. What is held out of the fit is never
read.

Only the factors of the stretches are needed (:mod:`identification.factor.phases`), so the samples
are read once for each candidate way of preparing them, and any number of estimators are compared
on the same factors.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from identification.errors import IdentificationError
from identification.estimators.consistent import (
    Shrinkage,
    SolverError,
    consistent_estimate,
    shrunk_values,
)
from identification.factor.factor import Factor, augmented_rows, joint_weights, solve
from identification.model.elements import Element, TorqueRipple
from identification.model.friction import FrictionLaw
from identification.model.robot import RobotModel
from identification.signals.masks import LeftOut
from identification.signals.samples import Preprocessing, Samples, VelocitySource

Array = NDArray[np.float64]
Question = Literal[
    "delay",
    "bandwidth",
    "velocity",
    "presliding",
    "rows",
    "friction",
    "ripple",
    "low-pass",
    "estimator",
]

FOLDS: Final = 5
LOW_PASS: Final = "low-pass of the torque"
DELAY: Final = "delay of the torque"
"""Names of those choices."""
# What a rigid model leaves out (elasticity of gears, the clock of a logger, the servo) begins at
# some 10 Hz on most arms: the first candidate, which others have to beat.
BANDWIDTHS: Final = (10.0, 5.0, 7.0, 14.0, 20.0, 40.0)  # Hz
# In the middle of what gears do first. A jump (zero) is no candidate: at rest its sign is that of
# the noise.
PRESLIDING: Final = (1e-4, 1e-6, 1e-5, 3e-5, 3e-4, 1e-3)  # rad or m
# Rows near a reversal say how dry friction turns round, but not so well as sliding ones what it is:
# where they do not help, intervals are honest only without them.
LEFT_OUT: Final[tuple[LeftOut, ...]] = ("slow", "rests")
NEARBY: Final = (1.0, 0.9, 0.95, 1.05, 1.1)  # of a low-pass that was found
STRENGTHS: Final = (0.0, 1e-3, 1e-2, 0.1, 1.0, math.inf)
PRIOR_WEIGHTS: Final = (0.01, 0.1, 1.0, 10.0)
# Beyond Coulomb and viscous friction; one of them alone, for they look alike.
FRICTION_TERMS: Final[tuple[Mapping[str, Any], ...]] = (
    {"third": None, "stribeck": None},
    {"third": "quadratic", "stribeck": None},
    {"third": "cubic", "stribeck": None},
    {"third": None, "stribeck": 0.1},
)
# A candidate replaces the simpler one before it only if it predicts better by this share; a
# low-pass of the torque, which can stand in for much else, by more. Of estimators and rows none is
# simpler, and the best is chosen; what differs by less than a tie is rounding.
TIE: Final = 1e-4
WORTHWHILE: Final = 0.01
LOW_PASS_WORTHWHILE: Final = 0.05
TERM_WORTHWHILE: Final = 0.02
# Rows beyond this rate add nothing to a comparison of bandwidths of 40 Hz and less.
_RATE: Final = 250.0  # Hz
_MOST_SWEEPS: Final = 4


@dataclass(frozen=True)
class Settings:
    """What is chosen.

    Attributes:
        model: the robot, with its friction.
        preprocessing: of recordings into samples.
        shrinkage: of the estimate.
    """

    model: RobotModel
    preprocessing: Preprocessing
    shrinkage: Shrinkage = Shrinkage()  # noqa: RUF009 - frozen

    @property
    def key(self) -> tuple[Columns, Preprocessing, Shrinkage]:
        """What differs between settings of one robot."""
        return *self.factor_key, self.shrinkage

    @property
    def factor_key(self) -> tuple[Columns, Preprocessing]:
        """What of it factors depend on."""
        return (self.model.friction.laws, self.model.elements.elements), self.preprocessing

    @property
    def ripple(self) -> tuple[int, ...]:
        """Orders of the torque ripple that is estimated, periods per motor turn."""
        elements = self.model.elements.elements
        return next((one.orders for one in elements if isinstance(one, TorqueRipple)), ())

    def describe(self) -> tuple[str, ...]:
        """The settings in words, part by part."""
        how, width = self.preprocessing, self.preprocessing.torque_bandwidth
        return (
            f"{how.rigid_bandwidth:g} Hz",
            "measured velocity" if how.velocity == "measured" else "velocity from positions",
            *self.model.friction.laws[0].summary(),
            f"torque ripple, {' and '.join(map(str, self.ripple))} per motor turn"
            if self.ripple
            else "no torque ripple",
            {"slow": "slow rows and reversals", "rests": "long rests", "none": "none"}.get(
                how.left_out or "", "by the friction law"
            ),
            f"delay of {1e3 * how.torque_delay:.3g} ms",
            "no low-pass" if width is None else f"low-pass of {width:.3g} Hz, {how.torque_shape}",
            self.shrinkage.describe(),
        )


@dataclass(frozen=True)
class Choice:
    """One question that was decided by inner prediction.

    Attributes:
        name: what was chosen.
        candidates: in words.
        errors: ``||e|| / ||tau||`` of each candidate over all joints, mean over the stretches; of a
            low-pass the geometric mean of those of each joint.
        chosen: index of the one that is used.
    """

    name: str
    candidates: tuple[str, ...]
    errors: tuple[float, ...]
    chosen: int


class Errors(NamedTuple):
    """Errors of predictions, infinite where some stretch cannot be predicted.

    Attributes:
        overall: ``||e|| / ||tau||`` over all joints, mean over the stretches.
        by_joint: geometric mean of those of each joint over all stretches.
    """

    overall: float = math.inf
    by_joint: float = math.inf


@dataclass(frozen=True, eq=False)
class Folds:
    """Factors of each stretch: of the rows that count in a fit, and of all rows.

    Attributes:
        fitted: FOLDS factors.
        predicted: FOLDS factors.
    """

    fitted: tuple[Factor, ...]
    predicted: tuple[Factor, ...]

    @classmethod
    def of(cls, model: RobotModel, recordings: Iterable[Samples]) -> Folds:
        """Reduce recordings, each cut into `FOLDS` stretches of equal length."""
        fitted = [Factor.zero(model) for _ in range(FOLDS)]
        predicted = [Factor.zero(model) for _ in range(FOLDS)]
        places = [np.append(columns, model.n_parameters) for columns in model.plan.columns]
        for samples in recordings:
            usable, m = samples.usable, len(samples.torque)
            edges = np.linspace(0, m, FOLDS + 1).round().astype(int)
            for part, rows in augmented_rows(model, replace(samples, usable=usable | True)):
                for k in range(FOLDS):
                    start, stop = max(edges[k], part.start), min(edges[k + 1], part.stop)
                    if start >= stop:
                        continue
                    counts = usable[start:stop]
                    for joint, (block, place) in enumerate(zip(rows, places, strict=True)):
                        own = block[:, start - part.start : stop - part.start]
                        used = own if counts[:, joint].all() else own[:, counts[:, joint]]
                        index = np.ix_(place, place)
                        predicted[k].gram[joint][index] += own @ own.T
                        fitted[k].gram[joint][index] += used @ used.T
                    predicted[k].samples[:] += stop - start
                    fitted[k].samples[:] += np.count_nonzero(counts, axis=0)
        return cls(tuple(fitted), tuple(predicted))

    def without(self, k: int) -> Factor:
        """What is fitted to predict stretch k."""
        others = [factor for index, factor in enumerate(self.fitted) if index != k]
        return sum(others[1:], others[0])

    def errors(
        self, estimate: Callable[[int, Factor], Array], rows: Literal["all", "fitted"] = "all"
    ) -> Errors:
        """Errors of predictions by ``estimate(k, factor without stretch k)`` on these rows."""
        targets = self.predicted if rows == "all" else self.fitted
        squares = np.zeros((FOLDS, targets[0].n_joints))
        for k, target in enumerate(targets):
            squares[k] = target.squared_errors(estimate(k, self.without(k)))
        torque = np.array([target.gram[:, -1, -1] for target in targets])
        if not torque.any():
            return Errors(math.nan, math.nan)
        return Errors(
            float(np.mean(_relative(squares.sum(axis=1), torque.sum(axis=1)))),
            math.exp(float(np.log(_relative(squares.sum(axis=0), torque.sum(axis=0))).mean())),
        )


def _relative(squares: Array, torque: Array) -> Array:
    """Relative errors of those sums of squares that have any torque, above zero."""
    loaded = torque > 0.0
    shares = squares[loaded] / torque[loaded]
    return np.sqrt(np.maximum(shares, np.finfo(np.float64).tiny))


Ready = Callable[[RobotModel, Preprocessing], Sequence[Samples]]
"""What is fitted, prepared for a model, and nothing else."""

Columns = tuple[tuple[FrictionLaw, ...], tuple[Element, ...]]
"""What columns a model of one robot has beside the rigid body's."""

LowPasses = Callable[[RobotModel, Preprocessing], Sequence[Preprocessing]]
"""Settings with low-passes that the torque may have come through."""


def choose_settings(
    ready: Ready,
    start: Settings,
    questions: Collection[Question],
    low_passes: LowPasses,
    delays: Sequence[float] = (),
    ripples: Sequence[Sequence[TorqueRipple]] = (),
) -> tuple[Settings, tuple[Choice, ...]]:
    """Choose settings one question after the other, each with what was chosen before it.

    Args:
        ready: prepares what is fitted.
        start: what is not asked for stays as it is here.
        questions: what is chosen.
        low_passes: looked for where "low-pass" is among them.
        delays: of the torque that were found to be significant [s], of which one is used where
            "delay" is among them and it predicts no worse than that of `start`.
        ripples: of which one is added to the model where "ripple" is among them and it helps.

    Returns:
        The settings, and how they were chosen; those of `start` where what is fitted is too short
        to predict a part of it from the rest.
    """
    trial = _Trial(ready)
    now = start
    if "bandwidth" in questions:
        now = _with(now, rigid_bandwidth=BANDWIDTHS[0])
    if "rows" in questions:
        now = _with(now, left_out=LEFT_OUT[0])
    if "presliding" in questions:
        now = _friction(now, presliding=PRESLIDING[0])
    if "estimator" in questions:
        # The consistent solution is found once: what is compared on the way has to follow the data.
        quick = [Shrinkage(strength) for strength in STRENGTHS if math.isfinite(strength)]
        now = trial.decide("", [replace(now, shrinkage=one) for one in quick]).settings
    first = now
    now, choices = _sweep(trial, first, questions)
    if "delay" in questions:
        first, now, choices = _with_delay(trial, first, now, choices, questions, delays)
    if "low-pass" in questions:
        now, choices = _with_low_pass(trial, first, now, choices, questions, low_passes)
    # Models with other columns are compared, each with a centre of its own: now it needs one, too.
    trial.renew_centres()
    if "friction" in questions:
        found = trial.decide(
            "friction at speed", [_friction(now, **one) for one in FRICTION_TERMS], TERM_WORTHWHILE
        )
        now, choices = found.settings, [*choices, found.choice]
    if "ripple" in questions:
        rippled = [replace(now, model=now.model.with_elements(one)) for one in ripples]
        found = trial.decide("torque ripple", [now, *rippled])
        now, choices = found.settings, [*choices, found.choice]
    if "estimator" in questions:
        weights = PRIOR_WEIGHTS if now.shrinkage.strength > 0.0 else (now.shrinkage.prior_weight,)
        some = [strength for strength in STRENGTHS if strength > 0.0]
        each = [Shrinkage(), *(Shrinkage(strength, w) for w in weights for strength in some)]
        found = trial.decide("estimator", [replace(now, shrinkage=one) for one in each], TIE)
        now, choices = found.settings, [*choices, found.choice]
    if not math.isfinite(trial.errors(now).overall):
        return start, ()
    return now, tuple(choice for choice in choices if len(choice.candidates) > 1)


def _with_delay(
    trial: _Trial,
    first: Settings,
    now: Settings,
    choices: list[Choice],
    questions: Collection[Question],
    delays: Sequence[float],
) -> tuple[Settings, Settings, list[Choice]]:
    """Compensate a delay that was found to be significant, unless that predicts worse.

    Compared are sliding rows: at reversals a presliding displacement stands in for a delay. All
    else is chosen anew beside it.

    Returns:
        The settings before and after the sweep, and its choices.
    """
    compared: list[Choice] = []
    for delay in delays:
        sliding = _with(now, left_out="slow")
        late = _with(sliding, torque_delay=delay)
        found = trial.decide(DELAY, [late, sliding], TIE, rows="fitted")
        compared.append(found.choice)
        if not found.choice.chosen:
            first = _with(first, torque_delay=delay)
            now, choices = _sweep(trial, first, questions)
    return first, now, [*compared, *choices]


def _with_low_pass(
    trial: _Trial,
    first: Settings,
    now: Settings,
    choices: list[Choice],
    questions: Collection[Question],
    low_passes: LowPasses,
) -> tuple[Settings, list[Choice]]:
    """Add a low-pass of the torque, or a delay in its place, where that predicts better.

    Looked for from the `first` settings: a narrow bandwidth of the motion or a long presliding
    displacement, chosen `now`, would stand in for a part of it.
    """
    possible = low_passes(first.model, first.preprocessing)
    if not possible:
        return now, choices
    some = [replace(first, preprocessing=one) for one in possible]
    filtered, behind = _sweep(trial, trial.best(some), questions)
    # The residual's least is flat; prediction with what was chosen beside it is sharper.
    filtered = trial.decide("", _widths(filtered), share=0.0).settings
    # All joints come through the same channel: the largest errors are not to decide alone.
    found = trial.decide(LOW_PASS, [now, filtered], LOW_PASS_WORTHWHILE, by_joint=True)
    if found.choice.chosen and filtered.preprocessing.torque_shape.causal:
        # What its lag alone predicts as well is a delay.
        late = trial.decide("", _lags(now, filtered), share=0.0).settings
        delay = trial.decide(DELAY, [now, late], LOW_PASS_WORTHWHILE, by_joint=True)
        both = trial.decide(LOW_PASS, [late, filtered], LOW_PASS_WORTHWHILE, by_joint=True)
        if delay.choice.chosen and not both.choice.chosen:
            return late, [*choices, delay.choice, both.choice]
    if found.choice.chosen:
        return filtered, [*behind, found.choice]
    return now, [*choices, found.choice]


class _Decision(NamedTuple):
    settings: Settings
    choice: Choice


class _Trial:
    """Scores of settings, on factors that are made once."""

    def __init__(self, ready: Ready) -> None:
        self._ready = ready
        self._samples: dict[Preprocessing, list[Samples]] = {}
        self._folds: dict[tuple[Columns, Preprocessing], Folds] = {}
        self._errors: dict[tuple[Columns, Preprocessing, Shrinkage, str], Errors] = {}
        self._centres: dict[tuple[tuple[str, ...], float, int], Array] = {}
        self._near: dict[tuple[str, ...], Array] = {}  # a solution, from which others are found
        self._without_centre: set[tuple[tuple[str, ...], float]] = set()

    def decide(
        self,
        name: str,
        candidates: Sequence[Settings],
        share: float | None = None,
        *,
        by_joint: bool = False,
        rows: Literal["all", "fitted"] = "all",
    ) -> _Decision:
        """Take the first candidate, or the best one if it predicts better by that share.

        By `WORTHWHILE` without one.
        """
        share = WORTHWHILE if share is None else share
        each = [self.errors(one, rows) for one in candidates]
        errors = [one.by_joint if by_joint else one.overall for one in each]
        best = int(np.nanargmin(errors)) if np.any(np.isfinite(errors)) else 0
        chosen = best if errors[best] < (1.0 - share) * errors[0] else 0
        words = _differences(candidates)
        return _Decision(candidates[chosen], Choice(name, words, tuple(errors), chosen))

    def best(self, candidates: Sequence[Settings]) -> Settings:
        """The one that predicts best on average over the joints."""
        return min(candidates, key=lambda one: self.errors(one).by_joint)

    def errors(self, settings: Settings, rows: Literal["all", "fitted"] = "all") -> Errors:
        """Errors of predicting these rows of each stretch from the others."""
        key = *settings.key, rows
        if key not in self._errors:
            self._errors[key] = self._predicted(settings, rows)
        return self._errors[key]

    def _predicted(self, settings: Settings, rows: Literal["all", "fitted"]) -> Errors:
        shrinkage, folds = settings.shrinkage, self._reduced(settings)
        machine = settings.model.parameter_names, shrinkage.prior_weight
        if shrinkage.strength > 0.0 and machine in self._without_centre:
            return Errors()
        if not all(folds.without(k).samples.any() for k in range(FOLDS)):
            return Errors()

        def estimate(k: int, factor: Factor) -> Array:
            weights = joint_weights(factor)
            if shrinkage.strength == 0.0:
                return solve(factor.weighted(weights)).values
            key = *machine, k
            if key not in self._centres:
                near = self._near.get(settings.model.parameter_names)
                found = consistent_estimate(
                    settings.model,
                    factor,
                    weights=weights,
                    prior_weight=shrinkage.prior_weight,
                    near=near,
                )
                self._centres[key] = found.estimate.values
                self._near[settings.model.parameter_names] = found.solution
            return shrunk_values(factor.weighted(weights), self._centres[key], shrinkage.strength)

        try:
            return folds.errors(estimate, rows)
        except SolverError:  # after a long search, which is not repeated
            self._without_centre.add(machine)
        except IdentificationError:
            pass
        return Errors()

    def renew_centres(self) -> None:
        """Find consistent solutions anew, with the settings that are asked for next."""
        self._centres.clear()
        self._without_centre.clear()
        self._errors.clear()

    def _reduced(self, settings: Settings) -> Folds:
        key = settings.factor_key
        if key not in self._folds:
            if settings.preprocessing not in self._samples:
                samples = self._ready(settings.model, settings.preprocessing)
                self._samples[settings.preprocessing] = [*samples]
            samples = self._samples[settings.preprocessing]
            self._folds[key] = Folds.of(
                settings.model, (_thinned(one.directed(settings.model)) for one in samples)
            )
        return self._folds[key]


def _thinned(samples: Samples) -> Samples:
    """One row in so many, as far as what is compared has no more to say."""
    usual = float(np.median(np.diff(samples.motion.time)))
    every = max(1, round(1.0 / (_RATE * usual)))
    if every == 1 or samples.torque_bandwidth is not None:
        return samples
    some = slice(None, None, every)
    return replace(
        samples,
        motion=samples.motion.rows(some),
        torque=samples.torque[some],
        usable=samples.usable[some],
        segments=(slice(0, len(samples.torque[some])),),
        mask=None,
    )


def _sweep(
    trial: _Trial, now: Settings, questions: Collection[Question]
) -> tuple[Settings, list[Choice]]:
    """Decide what depends on one another in turn, until nothing changes."""
    asked = [one for one in _SWEPT if one.question in questions]
    choices: list[Choice] = []
    for _ in range(_MOST_SWEEPS):
        before = now
        choices = []
        for one in asked:
            found = trial.decide(one.name, one.vary(now), one.share)
            now, choices = found.settings, [*choices, found.choice]
        if now.key == before.key:
            break
    return now, choices


class _Swept(NamedTuple):
    """A question that is decided again and again.

    Attributes:
        question: which.
        name: of the choice.
        vary: settings with each candidate.
        share: by which one has to predict better than the first, see `_Trial.decide`.
    """

    question: Question
    name: str
    vary: Callable[[Settings], list[Settings]]
    share: float = WORTHWHILE


_SWEPT: Final = (
    _Swept(
        "bandwidth",
        "bandwidth of the motion",
        lambda now: [_with(now, rigid_bandwidth=width) for width in BANDWIDTHS],
    ),
    _Swept(
        "velocity",
        "velocity",
        lambda now: [_with(now, velocity=source) for source in get_args(VelocitySource)],
    ),
    _Swept(
        "presliding",
        "presliding displacement",
        lambda now: [_friction(now, presliding=distance) for distance in PRESLIDING],
    ),
    _Swept(
        "rows",
        "rows that are left out",
        lambda now: [_with(now, left_out=rows) for rows in LEFT_OUT],
        share=0.0,
    ),
)


def _widths(now: Settings) -> list[Settings]:
    width = now.preprocessing.torque_bandwidth or math.nan
    return [_with(now, torque_bandwidth=share * width) for share in NEARBY]


def _lags(now: Settings, filtered: Settings) -> list[Settings]:
    """Delays in place of a causal low-pass, about its lag."""
    how, width = filtered.preprocessing, filtered.preprocessing.torque_bandwidth or math.inf
    lag = how.torque_shape.lag(width)
    return [_with(now, torque_delay=how.torque_delay + share * lag) for share in NEARBY]


def _friction(settings: Settings, **changes: Any) -> Settings:
    return replace(settings, model=settings.model.with_friction(**changes))


def _with(settings: Settings, **changes: Any) -> Settings:
    return replace(settings, preprocessing=replace(settings.preprocessing, **changes))


def _differences(candidates: Sequence[Settings]) -> tuple[str, ...]:
    """Each candidate in words, by what differs between them."""
    parts = [one.describe() for one in candidates]
    differ = [len(set(column)) > 1 for column in zip(*parts, strict=True)]
    return tuple(
        ", ".join(word for word, apart in zip(words, differ, strict=True) if apart)
        for words in parts
    )
