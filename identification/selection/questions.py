"""Settings of an identification, chosen by predicting parts of the fitted data from the rest.

One question after the other is answered by the errors of its candidates in parts that are predicted
from the rest (:mod:`~identification.selection.folds`), compared by
:mod:`~identification.selection.scores`. Held-out data are not read.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.model.elements import TorqueRipple
from identification.model.robot import RobotModel
from identification.selection.averaging import AveragedBandwidth, averaged_bandwidth
from identification.selection.scores import (
    MEANINGLESS_ERROR,
    MIN_IMPOSSIBLE_IMPROVEMENT,
    MIN_IMPROVEMENT,
    TRANSFER_STD,
    Known,
    Ready,
    SettingDecision,
    SettingsTrial,
)
from identification.selection.settings import Choice, Settings
from identification.signals.masks import ExcludedRows
from identification.signals.samples import Preprocessing, VelocitySource

Rows = NDArray[np.bool_]
Question = Literal[
    "rotors",
    "delay",
    "bandwidth",
    "velocity",
    "presliding",
    "excluded rows",
    "friction",
    "ripple",
    "springs",
    "position torque",
    "low-pass",
    "estimator",
]

SELECTION_RATE: Final = 125.0
"""Rate [Hz] to which recordings are averaged for choices: three times the widest bandwidth."""
MIN_CERTAINTY: Final = 3.0
ROTORS: Final = "largest inertia of rotors"
PRESLIDING_DISPLACEMENT: Final = "presliding displacement"
ROWS: Final = "rows that are left out"
VELOCITY: Final = "velocity"
BANDWIDTH: Final = "bandwidth of the motion"
FRICTION_AT_SPEED: Final = "friction at speed"
LOW_PASS: Final = "low-pass of the torque"
REVERSAL: Final = "reversal of dry friction"
DELAY: Final = "delay of the torque"
LOAD: Final = "friction that grows with load"
STRENGTH: Final = "strength of the prior"
CONSISTENT: Final = "physical consistency"
SPRINGS: Final = "torsion springs"
POSITION_TORQUE: Final = "torque of the position"
ROWS_IN_MOTION: Final = "rows that are left out, by the error in motion"
"""Names of decisions."""
# A drive differentiates its encoder at a higher rate than the log has.
VELOCITIES: Final[tuple[VelocitySource, ...]] = ("measured", "position")
# Unmodelled dynamics start at about 10 Hz on most arms. The smoother of 14 Hz, the default, leaves
# nine tenths of an amplitude there, and half of it at 14 Hz. Soft drives swing from 3 Hz on.
BANDWIDTHS: Final = (14.0, 10.0, 20.0, 7.0, 5.0, 40.0, 3.5)  # Hz, by distance from the first
# The middle of what gears show first. Zero is no candidate: its sign at rest is noise.
PRESLIDING_DISTANCES: Final = (3e-5, 1e-5, 1e-4, 3e-4, 1e-6, 1e-3)  # rad or m
# Rows of a joint that stands while another moves hold its load; but those near a reversal, or at
# rest by brake or static friction, can mislead.
EXCLUDED_ROWS: Final[tuple[ExcludedRows, ...]] = ("rests", "halts", "slow")
# Speeds over which dry friction may reverse smoothly, and factors that refine the best of them.
REVERSAL_SPEEDS: Final = (0.02, 0.08, 0.3)  # rad/s or m/s
REVERSAL_FACTORS: Final = (1.5, 1.25, 1.12, 1.06, 1.03, 1.015, 1.008)
NEARBY_FACTORS: Final = (1.0, 0.9, 0.95, 1.05, 1.1)  # factors of the bandwidth of a low-pass
PRIOR_WEIGHTS: Final = (1.0, 4.0, 16.0, 64.0, 1e4)
"""Weights of the described bodies: deviations of 30, 15, 7.5, 4 and 0.3 % of their masses.

None below one: folds of one motion would favour a weaker prior, which another motion pays for. The
large ones are for recordings that determine little (``benchmarks.poor_recordings``): those of the
board hardly depend on them (up to 4 instead of 1e4 changes their mean error by 0.1 %), but would
lose with a first weight of 4 (``benchmarks.leave_one_out``).
"""
# Terms in addition to Coulomb and viscous friction; they correlate, so at most one. The stated law
# comes first.
FRICTION_TERMS: Final[tuple[Mapping[str, Any], ...]] = (
    {"third": "none", "stribeck": 0.0},
    {"third": "quadratic", "stribeck": 0.0},
    {"third": "cubic", "stribeck": 0.0},
    {"third": "none", "stribeck": 0.1},
)
MIN_REVERSAL_IMPROVEMENT: Final = 0.05
MIN_ROTORS_IMPROVEMENT: Final = 0.05
"""Rotors far heavier than the links change the error to a fifth or to less than a tenth more."""
MIN_TERM_IMPROVEMENT: Final = 0.02
MIN_ELEMENT_IMPROVEMENT: Final = 0.3  # of the error of its own joint
_MAX_SWEEPS: Final = 2

LowPasses = Callable[[RobotModel, Preprocessing], Sequence[Preprocessing]]
"""Returns settings with candidate low-passes of the torque."""


class SuggestedDelay(NamedTuple):
    """A delay of the torque that differs significantly from the settings."""

    value: float  # s
    determined: bool  # whether to a millisecond, and its estimate predicts better with it


def choose_settings(
    model: RobotModel,
    ready: Ready,
    start: Settings,
    questions: Collection[Question],
    low_passes: LowPasses,
    delays: Sequence[SuggestedDelay] = (),
    ripples: Sequence[Sequence[TorqueRipple]] = (),
    springs: Sequence[str] = (),
    position_torques: Sequence[str] = (),
    stated: Known | None = None,
) -> Settings:
    """Choose settings one after the other.

    Args:
        model: of the arm.
        ready: prepares data by settings.
        start: settings to begin with.
        questions: settings that are chosen.
        low_passes: of the torque, that are candidates.
        delays: of the torque, which must predict no worse than the delay of `start`, or better if
            they are not determined.
        ripples: candidates for torque ripple.
        springs: joints that may have a spring.
        position_torques: joints that may have a torque of their position.
        stated: parameters that are known.

    Returns:
        Settings with their choices; `start` if the data are too short, or predict no part of
        themselves.
    """
    trial = SettingsTrial(model, ready, stated, ripples)
    now = _first_candidates(start, questions)
    requested: set[str] = {*questions}
    if "estimator" in requested:
        requested |= {"strength", "consistency"}
    first = now
    trial.weigh(first)
    if "estimator" in requested and trial.has_grouped_rotors(first):
        requested |= {"rotors"}
    now, choices = _sweep(trial, first, requested)
    if "delay" in requested:
        first, now, choices = _compare_delays(trial, first, now, choices, requested, delays)
    if "low-pass" in requested:
        now, choices = _compare_low_passes(trial, first, now, choices, requested, low_passes)
    if "friction" in requested:
        for decide in (_friction_terms, _load_friction):
            decision = decide(trial, now)
            now = decision.settings
            choices = [*choices, decision.choice]
    if "ripple" in requested:
        rippled = [now.with_friction(ripple=orders) for orders in trial.ripples]
        decision = trial.decide("torque ripple", [now, *rippled])
        now = decision.settings
        choices = [*choices, decision.choice]
    if "position torque" in requested:
        # Before the prior: bodies that cannot exist predict a torque of the position as well.
        for decision in _position_torques(trial, now, position_torques):
            now = decision.settings
            choices = [*choices, decision.choice]
    trial.weigh(now)
    compared, now, decided = _choose_prior(trial, now, requested)
    if not trial.errors(compared).overall < MEANINGLESS_ERROR:
        return start
    choices = [*choices, *decided]
    if "springs" in requested:
        # Last: what is left of a spring that impossible bodies stand for is theirs as before.
        for decision in _torsion_springs(trial, now, springs):
            now = decision.settings
            choices = [*choices, decision.choice]
    if "bandwidth" in requested:
        now = replace(now, hedge=_usual_bandwidth(trial, now))
    return replace(now, choices=tuple(choice for choice in choices if len(choice.candidates) > 1))


def _usual_bandwidth(trial: SettingsTrial, now: Settings) -> AveragedBandwidth | None:
    """Return the usual bandwidth with the odds that another motion prefers it to the chosen one."""
    usual = now.preprocessed(rigid_bandwidth=BANDWIDTHS[0])
    odds = 0.0 if usual == now else trial.odds(usual, now, TRANSFER_STD)
    return averaged_bandwidth(BANDWIDTHS[0], odds)


def _first_candidates(start: Settings, questions: Collection[Question]) -> Settings:
    """Return settings with the first candidate of each that is swept."""
    settings = start
    if "bandwidth" in questions:
        settings = settings.preprocessed(rigid_bandwidth=BANDWIDTHS[0])
    if "velocity" in questions:
        settings = settings.preprocessed(velocity=VELOCITIES[0])
    if "excluded rows" in questions:
        settings = settings.preprocessed(exclude_rows=EXCLUDED_ROWS[0])
    if "presliding" in questions:
        settings = settings.with_friction(presliding=PRESLIDING_DISTANCES[0])
    return settings


def _choose_prior(
    trial: SettingsTrial, now: Settings, requested: Collection[str]
) -> tuple[Settings, Settings, list[Choice]]:
    """Choose the strength of the prior, then whether bodies must be possible.

    Returns the settings after each of the two, and the decisions.
    """
    choices: list[Choice] = []
    if "strength" in requested and trial.knows_bodies(now):
        weights = [replace(now.strength, weight=weight) for weight in PRIOR_WEIGHTS]
        decision = trial.decide_last(STRENGTH, [replace(now, strength=each) for each in weights])
        now = decision.settings
        choices = [decision.choice]
    compared = now
    if "consistency" in requested:
        possible = replace(now, strength=replace(now.strength, consistent=True))
        if trial.fits_impossible(now, possible):
            decision = trial.decide(
                CONSISTENT,
                [possible, now],
                MIN_IMPOSSIBLE_IMPROVEMENT,
                possible=lambda each: trial.carries_over(each, possible),
            )
            now = decision.settings
            choices = [*choices, decision.choice]
        else:
            now = possible
    return compared, now, choices


def _friction_terms(trial: SettingsTrial, now: Settings) -> SettingDecision:
    """Choose the terms in addition to Coulomb and viscous friction, the stated ones first.

    A term must also predict fast motion from slower one no worse, and leave friction in a faster
    motion, too: the law is the choice that carries over to another motion least.
    """
    law = trial.model(now).friction.laws[0].table()
    stated = {"third": law["third"], "stribeck": law["stribeck"]}
    terms = [stated, *(term for term in FRICTION_TERMS if term != stated)]
    candidates = [now.with_friction(**term) for term in terms]

    limit = trial.fast_error(now)

    def possible(term: Settings) -> bool:
        return (
            trial.fast_error(term) <= limit
            and trial.shows_stribeck(term)
            and trial.has_friction(term)
        )

    return trial.decide(FRICTION_AT_SPEED, candidates, MIN_TERM_IMPROVEMENT, possible=possible)


def _load_friction(trial: SettingsTrial, now: Settings) -> SettingDecision:
    """Choose whether dry friction grows with the transmitted torque, as in strain-wave gears.

    A stated term comes first. Shares that no gear has are refused.
    """
    law = trial.model(now).friction.laws[0]
    candidates = [now.with_friction(load=load) for load in (law.load, not law.load)]
    return trial.decide(
        LOAD,
        candidates,
        MIN_TERM_IMPROVEMENT,
        possible=lambda each: law.load or trial.has_load_shares(each),
    )


def _torsion_springs(
    trial: SettingsTrial, now: Settings, joints: Sequence[str]
) -> list[SettingDecision]:
    """Choose the joints with a torsion spring, such as a hose that their motion twists.

    Bodies that cannot exist, with a negative inertia, predict the torque of a spring as well; so
    possible ones are compared, where they fit worse. Each spring must predict its own joint much
    better, which the error over all joints does not show of one with little torque.
    """
    possible = replace(now, strength=replace(now.strength, consistent=True))
    if not trial.fits_impossible(now, possible):
        return []
    every = possible.with_friction(springs=tuple(joints))

    def pulls_back(joint: str, settings: Settings) -> bool:
        return trial.stiffness(joint, settings) > 0.0

    shown = _joints_better(trial, SPRINGS, (possible, every), joints, pulls_back)
    if not shown:
        return []
    candidates = [possible, possible.with_friction(springs=shown)]
    decision = trial.decide(SPRINGS, candidates, by_joint=True)
    return [decision._replace(settings=replace(decision.settings, strength=now.strength))]


def _joints_better(
    trial: SettingsTrial,
    name: str,
    candidates: tuple[Settings, Settings],
    joints: Sequence[str],
    possible: Callable[[str, Settings], bool],
) -> tuple[str, ...]:
    """Return the joints whose own error an element lessens much, where it is possible.

    Args:
        trial: of the settings.
        name: of the decision.
        candidates: without the element, and with one in every joint.
        joints: that may have one.
        possible: whether that of a joint may be chosen.
    """

    def is_better(joint: str) -> bool:
        decision = trial.decide(
            name,
            candidates,
            MIN_ELEMENT_IMPROVEMENT,
            joint=joint,
            possible=partial(possible, joint),
            certainty=MIN_CERTAINTY,
        )
        return bool(decision.choice.chosen)

    return tuple(filter(is_better, joints))


def _position_torques(
    trial: SettingsTrial, now: Settings, joints: Sequence[str]
) -> list[SettingDecision]:
    """Choose the joints with a torque that repeats with their position.

    Each must predict its own joint much better, as a spring, and be seen nearly whole: elsewhere it
    would be a guess. Those that would leave more of the error of the fitted rows are not tried.
    """
    most = 1.0 - 0.5 * MIN_ELEMENT_IMPROVEMENT
    joints = [joint for joint in joints if trial.left_by_position(joint, now) < most]
    if not joints:
        return []
    every = now.with_friction(position_torque=tuple(joints))

    shown = _joints_better(trial, POSITION_TORQUE, (now, every), joints, trial.is_seen_whole)
    if not shown:
        return []
    candidates = [now, now.with_friction(position_torque=shown)]
    return [trial.decide(POSITION_TORQUE, candidates, by_joint=True)]


def _compare_delays(
    trial: SettingsTrial,
    first: Settings,
    now: Settings,
    choices: list[Choice],
    questions: Collection[str],
    delays: Sequence[SuggestedDelay],
) -> tuple[Settings, Settings, list[Choice]]:
    """Compensate a significant delay unless it predicts clearly worse, and choose the rest again.

    Compared on sliding rows, as presliding is similar to a delay, by the geometric mean over the
    joints. Returns the settings before and after the sweep, and its decisions.
    """
    compared: list[Choice] = []
    for delay in delays:
        sliding = now.preprocessed(exclude_rows="slow")
        late = sliding.preprocessed(torque_delay=delay.value)
        # A delay with a wide interval has to show that it predicts better.
        pair = [late, sliding] if delay.determined else [sliding, late]
        # The unknown scale of one torque resembles a delay, but of that joint only. One that was
        # estimated beside friction which the law does not have is not refuted by that law at once.
        certainty = MIN_CERTAINTY if delay.determined else 1.0
        decision = trial.decide(DELAY, pair, 0.0, by_joint=True, rows="fitted", certainty=certainty)
        compared.append(decision.choice)
        if decision.settings.preprocessing.torque_delay == delay.value:
            first = first.preprocessed(torque_delay=delay.value)
            now, choices = _sweep(trial, first, questions)
    return first, now, [*compared, *choices]


def _compare_low_passes(
    trial: SettingsTrial,
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
    # A lag and a low-pass differ near reversals, where friction is not quite as any law: one that
    # replaces a delay is the best of many.
    delayed = now.preprocessing.torque_delay != now.stated_delay
    certainty = MIN_CERTAINTY if delayed else 1.0

    def compare(first: Settings, other: Settings) -> SettingDecision:
        # That there is one, its gain has shown (`possible_low_passes`).
        return trial.decide(LOW_PASS, [first, other], by_joint=True, certainty=certainty)

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
        delay = trial.decide(DELAY, [now, late], by_joint=True)
        both = trial.decide(LOW_PASS, [late, filtered], by_joint=True)
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


def _smooth_reversal(trial: SettingsTrial, now: Settings, filtered: Settings) -> SettingDecision:
    """Choose friction of ``tanh(v / v_t)`` in place of a low-pass if it predicts clearly better."""
    best = trial.best([_with_tanh(now, speed) for speed in REVERSAL_SPEEDS])
    for step in REVERSAL_FACTORS:
        if trial.best([best, filtered]) is filtered and step < REVERSAL_FACTORS[0]:
            break
        speed = float(best.friction["tanh"])
        best = trial.best([best, *(_with_tanh(now, speed * part) for part in (1.0 / step, step))])
    return trial.decide(
        REVERSAL, [filtered, best], MIN_REVERSAL_IMPROVEMENT, by_joint=True, certainty=MIN_CERTAINTY
    )


def _with_tanh(now: Settings, speed: float) -> Settings:
    return now.with_friction(tanh=speed).preprocessed(exclude_rows="rests")


def _sweep(
    trial: SettingsTrial, now: Settings, questions: Collection[str]
) -> tuple[Settings, list[Choice]]:
    """Decide interdependent settings in turn until nothing changes."""
    requested = [swept for swept in _SETTINGS_SEARCHED if swept.question in questions]
    choices: list[Choice] = []
    for _ in range(_MAX_SWEEPS):
        before = now
        choices = []
        for swept in requested:
            candidates = swept.vary(now)
            if swept.size is not None:
                candidates = [candidates[k] for k in trial.walk(candidates, swept.size)]
            decision = trial.decide(
                swept.name,
                candidates,
                swept.share,
                certainty=swept.certainty,
                transfer=swept.transfer,
            )
            now = decision.settings
            choices = [*choices, decision.choice]
            if swept.question == "excluded rows":
                decision = _rows_for_motion(trial, now, candidates)
                now = decision.settings
                choices = [*choices, decision.choice]
        if trial.key(now) == trial.key(before):
            break
    return now, choices


def _rows_for_motion(
    trial: SettingsTrial, now: Settings, candidates: Sequence[Settings]
) -> SettingDecision:
    """Choose among the candidates that predict all rows as well by the rows in motion.

    Static friction holds a joint at rest with any torque: its rows cannot be predicted, and decide
    the error over all rows. Fitted, they spoil the friction at speed. Any gain above its standard
    error decides: friction that is wrong by its interval changes the prediction by a hundredth.
    """
    limit = trial.errors(now).overall * (1.0 + MIN_IMPROVEMENT)
    others = [each for each in candidates if each != now and trial.errors(each).overall < limit]
    return trial.decide(ROWS_IN_MOTION, [now, *others], 0.0, rows="moving")


class _SearchedSetting(NamedTuple):
    """Setting that is decided repeatedly."""

    question: Question
    name: str
    vary: Callable[[Settings], list[Settings]]  # settings with each candidate
    size: Callable[[Settings], float] | None = None  # of the setting, if it is a number
    share: float | None = None  # by which another candidate must be better, if not as usual
    certainty: float = 1.0  # in standard errors
    transfer: float = 0.0  # relative standard deviation in addition


_SETTINGS_SEARCHED: Final = (
    _SearchedSetting(
        "rotors",
        ROTORS,
        lambda now: [
            replace(now, strength=replace(now.strength, wide_rotors=wide)) for wide in (False, True)
        ],
        share=MIN_ROTORS_IMPROVEMENT,
        certainty=MIN_CERTAINTY,
    ),
    _SearchedSetting(
        "presliding",
        PRESLIDING_DISPLACEMENT,
        lambda now: [now.with_friction(presliding=distance) for distance in PRESLIDING_DISTANCES],
        lambda now: float(now.friction["presliding"]),
        transfer=TRANSFER_STD,
    ),
    _SearchedSetting(
        "excluded rows",
        ROWS,
        lambda now: [now.preprocessed(exclude_rows=rows) for rows in EXCLUDED_ROWS],
    ),
    _SearchedSetting(
        "velocity",
        VELOCITY,
        lambda now: [now.preprocessed(velocity=source) for source in VELOCITIES],
        transfer=TRANSFER_STD,
    ),
    _SearchedSetting(
        "bandwidth",
        BANDWIDTH,
        lambda now: [now.preprocessed(rigid_bandwidth=width) for width in BANDWIDTHS],
        lambda now: now.preprocessing.rigid_bandwidth,
        transfer=TRANSFER_STD,
    ),
)


def _nearby_bandwidths(now: Settings) -> list[Settings]:
    width = now.preprocessing.torque_bandwidth or math.nan
    return [now.preprocessed(torque_bandwidth=share * width) for share in NEARBY_FACTORS]


def _nearby_lags(now: Settings, filtered: Settings) -> list[Settings]:
    """Return delays near the lag of a causal low-pass, in its place."""
    how = filtered.preprocessing
    width = filtered.preprocessing.torque_bandwidth or math.inf
    lag = how.torque_shape.lag(width)
    return [
        now.preprocessed(torque_delay=how.torque_delay + share * lag) for share in NEARBY_FACTORS
    ]
