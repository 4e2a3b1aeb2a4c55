"""What it would be worth to average candidates that predict equally well.

Used by ``python -m benchmarks.board --averaging`` and ``python -m benchmarks.poor_recordings
--averaging``. Every candidate that a question weighed gives parameters, with all other settings as
chosen. They are averaged with the odds of the candidate against the chosen one
(`SettingsTrial.odds`), which are one where it predicts no worse; a column that a candidate does not
have is zero in it. Predicted torques are linear in the parameters of these columns, so that they
are averaged in their place. Parameters are of the recordings averaged to 125 Hz, as the questions
are.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any, Final, NamedTuple
from unittest.mock import patch

import numpy as np

from benchmarks.choices import Usual, decided_by
from hil.base.arrays import Array
from hil.pipeline.estimating import Estimation, estimate_with
from hil.pipeline.prepared import Prepared
from identification.selection import questions as names
from identification.selection.averaging import MIN_ODDS
from identification.selection.questions import BANDWIDTHS
from identification.selection.scores import TRANSFER_STD, SettingDecision, SettingsTrial
from identification.selection.settings import Settings


class Question(NamedTuple):
    """A question whose answers may be averaged."""

    decisions: tuple[str, ...]  # names of its decisions
    answered: Callable[[Settings, Settings], Settings]  # settings with the answer of others
    transfer: float = 0.0  # relative standard deviation between motions


def _preprocessed(*fields: str) -> Callable[[Settings, Settings], Settings]:
    return lambda now, other: now.preprocessed(
        **{name: getattr(other.preprocessing, name) for name in fields}
    )


def _friction(*entries: str) -> Callable[[Settings, Settings], Settings]:
    return lambda now, other: now.with_friction(
        **{name: other.friction[name] for name in entries if name in other.friction}
    )


def _strength(name: str) -> Callable[[Settings, Settings], Settings]:
    return lambda now, other: replace(
        now, strength=replace(now.strength, **{name: getattr(other.strength, name)})
    )


QUESTIONS: Final[Mapping[str, Question]] = {
    "presliding": Question((names.PRESLIDING_DISPLACEMENT,), _friction("presliding"), TRANSFER_STD),
    "rows": Question((names.ROWS, names.ROWS_IN_MOTION), _preprocessed("exclude_rows")),
    "velocity": Question((names.VELOCITY,), _preprocessed("velocity"), TRANSFER_STD),
    "bandwidth": Question((names.BANDWIDTH,), _preprocessed("rigid_bandwidth"), TRANSFER_STD),
    "delay": Question((names.DELAY,), _preprocessed("torque_delay")),
    "low-pass": Question(
        (names.LOW_PASS,), _preprocessed("torque_bandwidth", "torque_shape", "torque_delay")
    ),
    "friction": Question((names.FRICTION_AT_SPEED,), _friction("third", "stribeck")),
    "load": Question((names.LOAD,), _friction("load")),
    "rotors": Question((names.ROTORS,), _strength("wide_rotors")),
    "strength": Question((names.STRENGTH,), _strength("weight")),
    "consistency": Question((names.CONSISTENT,), _strength("consistent")),
}
OF_PRIOR: Final = ("rotors", "strength", "consistency")
"""Questions about the prior, whose candidates are ordered by what is safer: not in `ALL`."""
ALL: Final = "all but the prior"
COLUMNS: Final = (*QUESTIONS, ALL)
"""What is averaged: the answers to one question, or to all of them."""


@dataclass
class Watched:
    """An identification whose questions were watched."""

    trial: SettingsTrial | None = None
    weighed: dict[str, list[Settings]] = field(default_factory=dict)  # candidates of decisions
    prepared: Prepared | None = None

    def ratios(self) -> dict[str, float]:
        """Held-out error with averaged answers over that as it is: below 1 averaging pays."""
        ratios = dict.fromkeys(COLUMNS, 1.0)
        if self.trial is None or self.prepared is None:
            return ratios
        chosen = replace(self.prepared.settings, hedge=None, loading=None)
        if not np.all(np.isfinite(self.trial.errors(chosen).segments)):
            return ratios
        error = self._error(chosen)
        usual = chosen.preprocessed(rigid_bandwidth=BANDWIDTHS[0])
        hedge = self.prepared.settings.hedge
        averaged = np.zeros_like(error)
        if hedge is not None:
            averaged += hedge.shares[1] * (self._error(usual) - error)
        moved = {name: self._moved(name, chosen, error) for name in QUESTIONS}
        every = np.sum([moved[name] for name in QUESTIONS if name not in OF_PRIOR], axis=0)
        today = np.linalg.norm(error + averaged)
        for name, change in moved.items():
            beside = np.zeros_like(error) if name == "bandwidth" else averaged
            ratios[name] = float(np.linalg.norm(error + beside + change) / today)
        return {**ratios, ALL: float(np.linalg.norm(error + every) / today)}

    def _moved(self, name: str, chosen: Settings, error: Array) -> Array:
        """Return how averaged answers to a question move the held-out error (rows,)."""
        assert self.trial is not None
        question = QUESTIONS[name]
        others = {}
        for decision in question.decisions:
            for candidate in self.weighed.get(decision, ()):
                other = question.answered(chosen, candidate)
                others[self.trial.key(other)] = other
        others.pop(self.trial.key(chosen), None)
        moved = np.zeros_like(error)
        total = 1.0
        for other in others.values():
            if not np.all(np.isfinite(self.trial.errors(other).segments)):
                continue
            odds = self.trial.odds(other, chosen, question.transfer)
            if odds > MIN_ODDS:
                moved += odds * (self._error(other) - error)
                total += odds
        return moved / total

    def _error(self, settings: Settings) -> Array:
        """Return the errors of all held-out torques, by the parameters of settings (rows,)."""
        assert self.trial is not None and self.prepared is not None
        model = self.trial.model(settings)
        values = self.trial.values(settings)
        samples = self.prepared.held_out
        if model.friction.has_load and not self.prepared.sources.cell.model.friction.has_load:
            without = settings.with_friction(load=False)
            unloaded = self.trial.values(without)
            samples = tuple(each.with_load(self.trial.model(without), unloaded) for each in samples)
        return np.concatenate(
            [(each.torque - each.predicted_torque(model, values)).ravel() for each in samples]
        )


class Ratios(NamedTuple):
    """Error ratios to a plain fit, over the rows of the board."""

    mean: float  # geometric
    worst: float
    losses: int  # rows above one
    rows: int


def ratios_of(rows: Sequence[Mapping[str, Any]], *, averaged: bool = False) -> Ratios:
    """Return the ratios of rows as they are, or with all answers averaged but the prior's."""
    ratios = [
        row["hil"] / row["plain"] * (row["averaged"][ALL] if averaged else 1.0) for row in rows
    ]
    mean = float(np.exp(np.log(ratios).mean()))
    return Ratios(mean, max(ratios), sum(ratio > 1.0 for ratio in ratios), len(rows))


@contextmanager
def watched() -> Iterator[Watched]:
    """Collect the candidates of all questions of an identification, and what it prepared."""
    seen = Watched()

    def noted(
        usual: Usual, trial: SettingsTrial, name: str, candidates: Sequence[Settings]
    ) -> SettingDecision:
        seen.trial = trial
        seen.weighed.setdefault(name, []).extend(candidates)
        return usual()

    def estimated(prepared: Prepared, *others: Any, **more: Any) -> Estimation:
        seen.prepared = prepared
        return estimate_with(prepared, *others, **more)

    with decided_by(noted), patch("hil.pipeline.identification.estimate_with", estimated):
        yield seen
