"""Settings of an identification, chosen by predicting parts of the fitted data from the rest.

Each recording is cut into `FOLDS` segments. Parameters are estimated from all segments but one and
predict all rows of that one, including rest. The score of a candidate is ``||e|| / ||tau||`` over
all joints, averaged over the segments. Held-out data are not read.
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
from identification.factor.factor import (
    Factor,
    augmented_rows,
    count_by_block,
    joint_weights,
    solve,
)
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
"""Names of decisions."""
# Unmodelled dynamics start at about 10 Hz on most arms: the default.
BANDWIDTHS: Final = (10.0, 5.0, 7.0, 14.0, 20.0, 40.0)  # Hz
# A typical value of gears first. Zero is no candidate: its sign at rest is noise.
PRESLIDING: Final = (1e-4, 1e-6, 1e-5, 3e-5, 3e-4, 1e-3)  # rad or m
# Rows near a reversal show presliding, but bias intervals of sliding friction.
LEFT_OUT: Final[tuple[LeftOut, ...]] = ("slow", "rests")
NEARBY: Final = (1.0, 0.9, 0.95, 1.05, 1.1)  # factors of the bandwidth of a low-pass
STRENGTHS: Final = (0.0, 1e-3, 1e-2, 0.1, 1.0, math.inf)
PRIOR_WEIGHTS: Final = (0.01, 0.1, 1.0, 10.0)
# Terms beside Coulomb and viscous friction; they correlate, so one at most. A stated Stribeck speed
# is a candidate too.
FRICTION_TERMS: Final[tuple[Mapping[str, Any], ...]] = (
    {"third": None, "stribeck": None},
    {"third": "quadratic", "stribeck": None},
    {"third": "cubic", "stribeck": None},
    {"third": None, "stribeck": 0.1},
)
# Improvement required to replace the first, simpler candidate; more for a low-pass, which
# correlates with other settings. Estimators and rows have no order of simplicity: the best is used.
# Less than a tie is rounding.
TIE: Final = 1e-4
WORTHWHILE: Final = 0.01
LOW_PASS_WORTHWHILE: Final = 0.05
TERM_WORTHWHILE: Final = 0.02
# Sufficient to compare bandwidths up to 40 Hz.
_RATE: Final = 250.0  # Hz
_MOST_SWEEPS: Final = 4


@dataclass(frozen=True)
class Settings:
    """Chosen settings."""

    model: RobotModel  # with its friction
    preprocessing: Preprocessing  # of recordings into samples
    shrinkage: Shrinkage = Shrinkage()  # noqa: RUF009 - frozen  # of the estimate

    @property
    def key(self) -> tuple[Columns, Preprocessing, Shrinkage]:
        """Key of the settings of one robot."""
        return *self.factor_key, self.shrinkage

    @property
    def factor_key(self) -> tuple[Columns, Preprocessing]:
        """Key of the settings that change factors."""
        return (self.model.friction.laws, self.model.elements.elements), self.preprocessing

    @property
    def ripple(self) -> tuple[int, ...]:
        """Orders of the estimated torque ripple, periods per motor turn."""
        elements = self.model.elements.elements
        return next((one.orders for one in elements if isinstance(one, TorqueRipple)), ())

    def describe(self) -> tuple[str, ...]:
        """Return descriptions of the settings, one by one."""
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
    """Decision by inner prediction."""

    name: str  # of the setting
    candidates: tuple[str, ...]  # descriptions
    # ``||e|| / ||tau||`` over all joints, mean over the segments; of a low-pass by joint (geometric
    # mean)
    errors: tuple[float, ...]
    chosen: int  # index of the candidate


class Errors(NamedTuple):
    """Prediction errors, infinite if some segment cannot be predicted."""

    overall: float = math.inf  # ``||e|| / ||tau||`` over all joints, mean over the segments
    by_joint: float = math.inf  # geometric mean of the relative errors of the joints


@dataclass(frozen=True, eq=False)
class Folds:
    """Factors by segment."""

    fitted: Factor  # of usable rows, a block for each segment
    predicted: Factor  # of all rows

    @classmethod
    def of(cls, model: RobotModel, recordings: Iterable[Samples]) -> Folds:
        """Reduce recordings, each cut into `FOLDS` segments of equal length."""
        fitted, predicted = Factor.zero(model, FOLDS), Factor.zero(model, FOLDS)
        for samples in recordings:
            usable, m = samples.usable, len(samples.torque)
            edges = np.linspace(0, m, FOLDS + 1).round().astype(int)
            index = np.repeat(np.arange(FOLDS), np.diff(edges))
            predicted.counts[:] += np.diff(edges)[:, None]
            fitted.counts[:] += count_by_block(index, usable)
            for part, rows in augmented_rows(model, replace(samples, usable=usable | True)):
                predicted.add_rows(index[part], rows)
                for table, lost in zip(rows, ~usable[part].T, strict=True):
                    table[:, lost] = 0.0
                fitted.add_rows(index[part], rows)
        return cls(fitted, predicted)

    def without(self, k: int) -> Factor:
        """Return the factor of all segments but k."""
        return self.fitted.blocks(np.arange(FOLDS) != k)

    def errors(
        self, estimate: Callable[[int, Factor], Array], rows: Literal["all", "fitted"] = "all"
    ) -> Errors:
        """Return prediction errors of ``estimate(k, factor without segment k)`` on these rows."""
        targets = self.predicted if rows == "all" else self.fitted
        squares = np.zeros((FOLDS, targets.n_joints))
        for k in range(FOLDS):
            segment = targets.blocks(np.arange(FOLDS) == k)
            squares[k] = segment.squared_errors(estimate(k, self.without(k)))
        torque = np.array([own[:, -1, -1] for own in targets.matrices]).T
        if not torque.any():
            return Errors(math.nan, math.nan)
        return Errors(
            float(np.mean(_relative(squares.sum(axis=1), torque.sum(axis=1)))),
            math.exp(float(np.log(_relative(squares.sum(axis=0), torque.sum(axis=0))).mean())),
        )


def _relative(squares: Array, torque: Array) -> Array:
    """Return relative errors of sums of squares with torque, above zero."""
    loaded = torque > 0.0
    shares = squares[loaded] / torque[loaded]
    return np.sqrt(np.maximum(shares, np.finfo(np.float64).tiny))


Ready = Callable[[RobotModel, Preprocessing], Sequence[Samples]]
"""Prepares the fitted data for a model."""

Columns = tuple[tuple[FrictionLaw, ...], tuple[Element, ...]]
"""Friction and elements of a model."""

LowPasses = Callable[[RobotModel, Preprocessing], Sequence[Preprocessing]]
"""Returns settings with candidate low-passes of the torque."""


def choose_settings(
    ready: Ready,
    start: Settings,
    questions: Collection[Question],
    low_passes: LowPasses,
    delays: Sequence[float] = (),
    ripples: Sequence[Sequence[TorqueRipple]] = (),
) -> tuple[Settings, tuple[Choice, ...]]:
    """Choose settings one after the other, from data that `ready` prepares.

    Significant `delays` of the torque [s] are candidates for "delay" that must predict no worse
    than that of `start`. Returns settings and decisions; `start` alone if the data are too short.
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
        # During the sweep estimators without consistent solution are used.
        quick = [Shrinkage(strength) for strength in STRENGTHS if math.isfinite(strength)]
        now = trial.decide("", [replace(now, shrinkage=one) for one in quick]).settings
    first = now
    now, choices = _sweep(trial, first, questions)
    if "delay" in questions:
        first, now, choices = _compare_delays(trial, first, now, choices, questions, delays)
    if "low-pass" in questions:
        now, choices = _compare_low_passes(trial, first, now, choices, questions, low_passes)
    # The following models have other columns and need their own centres.
    trial.clear_centres()
    if "friction" in questions:
        law = now.model.friction.laws[0]
        stated = {"third": law.third, "stribeck": law.stribeck}
        terms = FRICTION_TERMS if stated in FRICTION_TERMS else (stated, *FRICTION_TERMS)
        found = trial.decide(
            "friction at speed", [_friction(now, **one) for one in terms], TERM_WORTHWHILE
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


def _compare_delays(
    trial: _Trial,
    first: Settings,
    now: Settings,
    choices: list[Choice],
    questions: Collection[Question],
    delays: Sequence[float],
) -> tuple[Settings, Settings, list[Choice]]:
    """Compensate a significant delay unless it predicts worse, and choose the other settings again.

    Compared on sliding rows, as presliding is similar to a delay. Returns the settings before and
    after the sweep, and its decisions.
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


def _compare_low_passes(
    trial: _Trial,
    first: Settings,
    now: Settings,
    choices: list[Choice],
    questions: Collection[Question],
    low_passes: LowPasses,
) -> tuple[Settings, list[Choice]]:
    """Add a low-pass of the torque, or its delay alone, if that predicts better.

    Starts from the `first` settings: a narrow bandwidth chosen `now` would replace a part of it.
    """
    possible = low_passes(first.model, first.preprocessing)
    if not possible:
        return now, choices
    some = [replace(first, preprocessing=one) for one in possible]
    filtered, behind = _sweep(trial, trial.best(some), questions)
    # Refined by prediction, as the residual's minimum is flat.
    filtered = trial.decide("", _nearby_bandwidths(filtered), share=0.0).settings
    # Compared by joint, as the channel is common to all.
    found = trial.decide(LOW_PASS, [now, filtered], LOW_PASS_WORTHWHILE, by_joint=True)
    if found.choice.chosen and filtered.preprocessing.torque_shape.causal:
        # A lag that predicts as well is called a delay.
        late = trial.decide("", _nearby_lags(now, filtered), share=0.0).settings
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
    """Scores of settings, with cached factors."""

    def __init__(self, ready: Ready) -> None:
        self._ready = ready
        self._samples: dict[Preprocessing, list[Samples]] = {}
        self._folds: dict[tuple[Columns, Preprocessing], Folds] = {}
        self._errors: dict[tuple[Columns, Preprocessing, Shrinkage, str], Errors] = {}
        self._centres: dict[tuple[tuple[str, ...], float, int], Array] = {}
        self._near: dict[tuple[str, ...], Array] = {}  # solutions to start from
        self._unsolved: set[tuple[tuple[str, ...], float]] = set()

    def decide(
        self,
        name: str,
        candidates: Sequence[Settings],
        share: float | None = None,
        *,
        by_joint: bool = False,
        rows: Literal["all", "fitted"] = "all",
    ) -> _Decision:
        """Return the first candidate, or the best one if better by a share (`WORTHWHILE`)."""
        share = WORTHWHILE if share is None else share
        each = [self.errors(one, rows) for one in candidates]
        errors = [one.by_joint if by_joint else one.overall for one in each]
        best = int(np.nanargmin(errors)) if np.any(np.isfinite(errors)) else 0
        chosen = best if errors[best] < (1.0 - share) * errors[0] else 0
        words = _differences(candidates)
        return _Decision(candidates[chosen], Choice(name, words, tuple(errors), chosen))

    def best(self, candidates: Sequence[Settings]) -> Settings:
        """Return the candidate with the least error by joint."""
        return min(candidates, key=lambda one: self.errors(one).by_joint)

    def errors(self, settings: Settings, rows: Literal["all", "fitted"] = "all") -> Errors:
        """Return the errors of predicting these rows of each segment from the others."""
        key = *settings.key, rows
        if key not in self._errors:
            self._errors[key] = self._predicted(settings, rows)
        return self._errors[key]

    def _predicted(self, settings: Settings, rows: Literal["all", "fitted"]) -> Errors:
        shrinkage, folds = settings.shrinkage, self._reduced(settings)
        centre_key = settings.model.parameter_names, shrinkage.prior_weight
        if shrinkage.strength > 0.0 and centre_key in self._unsolved:
            return Errors()
        if not all(folds.without(k).samples.any() for k in range(FOLDS)):
            return Errors()

        def estimate(k: int, factor: Factor) -> Array:
            weights = joint_weights(factor)
            if shrinkage.strength == 0.0:
                return solve(factor.weighted(weights)).values
            key = *centre_key, k
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
        except SolverError:  # slow, not repeated
            self._unsolved.add(centre_key)
        except IdentificationError:
            pass
        return Errors()

    def clear_centres(self) -> None:
        """Discard consistent solutions, to solve again with the next settings."""
        self._centres.clear()
        self._unsolved.clear()
        self._errors.clear()

    def _reduced(self, settings: Settings) -> Folds:
        key = settings.factor_key
        if key not in self._folds:
            if settings.preprocessing not in self._samples:
                samples = self._ready(settings.model, settings.preprocessing)
                self._samples[settings.preprocessing] = [*samples]
            samples = self._samples[settings.preprocessing]
            model = settings.model
            ready = (_thinned(one.with_friction_direction(model)) for one in samples)
            self._folds[key] = Folds.of(model, ready)
        return self._folds[key]


def _thinned(samples: Samples) -> Samples:
    """Reduce the rate of samples to what comparisons need."""
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
    """Decide interdependent settings in turn until nothing changes."""
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
    """Setting that is decided repeatedly."""

    question: Question
    name: str
    vary: Callable[[Settings], list[Settings]]  # settings with each candidate
    share: float = WORTHWHILE  # required improvement, see `_Trial.decide`


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


def _nearby_bandwidths(now: Settings) -> list[Settings]:
    width = now.preprocessing.torque_bandwidth or math.nan
    return [_with(now, torque_bandwidth=share * width) for share in NEARBY]


def _nearby_lags(now: Settings, filtered: Settings) -> list[Settings]:
    """Return delays near the lag of a causal low-pass, in its place."""
    how, width = filtered.preprocessing, filtered.preprocessing.torque_bandwidth or math.inf
    lag = how.torque_shape.lag(width)
    return [_with(now, torque_delay=how.torque_delay + share * lag) for share in NEARBY]


def _friction(settings: Settings, **changes: Any) -> Settings:
    return replace(settings, model=settings.model.with_friction(**changes))


def _with(settings: Settings, **changes: Any) -> Settings:
    return replace(settings, preprocessing=replace(settings.preprocessing, **changes))


def _differences(candidates: Sequence[Settings]) -> tuple[str, ...]:
    """Describe candidates by their differences."""
    parts = [one.describe() for one in candidates]
    differ = [len(set(column)) > 1 for column in zip(*parts, strict=True)]
    return tuple(
        ", ".join(word for word, apart in zip(words, differ, strict=True) if apart)
        for words in parts
    )
