"""What each choice of the automatic settings is worth: identifications that leave it out.

Used by ``python -m benchmarks.board --choices``. A choice that is left out has its first candidate,
whatever the data say: the default where nothing is known.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, Final
from unittest.mock import patch

import numpy as np

from identification.selection import questions as names
from identification.selection.averaging import MIN_ODDS
from identification.selection.scores import SettingDecision, SettingsTrial
from identification.selection.settings import Choice, Settings

CHOICES: Final[Mapping[str, tuple[str, ...]]] = {
    "rotors": (names.ROTORS,),
    "presliding": (names.PRESLIDING_DISPLACEMENT,),
    "rows": (names.ROWS, names.ROWS_IN_MOTION),
    "velocity": (names.VELOCITY,),
    "bandwidth": (names.BANDWIDTH,),
    "averaging": (),
    "delay": (names.DELAY,),
    "low-pass": (names.LOW_PASS,),
    "reversal": (names.REVERSAL,),
    "friction": (names.FRICTION_AT_SPEED,),
    "load": (names.LOAD,),
    "strength": (names.STRENGTH,),
    "consistency": (names.CONSISTENT,),
    "springs": (names.SPRINGS,),
    "position torque": (names.POSITION_TORQUE,),
}
"""Names of the decisions of each choice; none of a chosen bandwidth averaged with the usual one."""


Usual = Callable[[], SettingDecision]
"""Makes the decision that an identification would make."""


@contextmanager
def decided_by(
    rule: Callable[[Usual, SettingsTrial, str, Sequence[Settings]], SettingDecision],
) -> Iterator[None]:
    """Have a rule make all decisions, of the usual one, the trial, the name and candidates."""

    def replaced(decide: Callable[..., SettingDecision]) -> Callable[..., SettingDecision]:
        def decided(
            trial: SettingsTrial,
            name: str,
            candidates: Sequence[Settings],
            *others: Any,
            **more: Any,
        ) -> SettingDecision:
            usual = partial(decide, trial, name, candidates, *others, **more)
            return rule(usual, trial, name, candidates)

        return decided

    with (
        patch.object(SettingsTrial, "decide", replaced(SettingsTrial.decide)),
        patch.object(SettingsTrial, "decide_last", replaced(SettingsTrial.decide_last)),
    ):
        yield


@contextmanager
def without(choice: str) -> Iterator[None]:
    """Leave out a choice: its decisions return the first candidate, a delay the stated one."""
    if choice == "averaging":
        with patch.object(SettingsTrial, "odds", lambda *_: 0.0):
            yield
        return
    left_out = CHOICES[choice]

    def first(
        usual: Usual, _: SettingsTrial, name: str, candidates: Sequence[Settings]
    ) -> SettingDecision:
        if name not in left_out:
            return usual()
        return SettingDecision(_first(name, candidates), Choice(name, (), (), 0))

    with decided_by(first):
        yield


@contextmanager
def taken() -> Iterator[set[str]]:
    """Collect the choices that make a difference: all but those that return a first candidate.

    Leaving out one of the others repeats the same identification.
    """
    found = set[str]()

    def noted(
        usual: Usual, trial: SettingsTrial, name: str, candidates: Sequence[Settings]
    ) -> SettingDecision:
        decision = usual()
        if trial.key(decision.settings) != trial.key(_first(name, candidates)):
            found.update(choice for choice, decisions in CHOICES.items() if name in decisions)
        return decision

    def hedged(odds: Callable[..., float]) -> Callable[..., float]:
        def measured(trial: SettingsTrial, *others: Any) -> float:
            weight = odds(trial, *others)
            if weight > MIN_ODDS:
                found.add("averaging")
            return weight

        return measured

    odds = patch.object(SettingsTrial, "odds", hedged(SettingsTrial.odds))
    with decided_by(noted), odds:
        yield found


def _first(name: str, candidates: Sequence[Settings]) -> Settings:
    """Return the candidate where nothing is known: of delays the stated one."""
    return min(candidates, key=_added_delay) if name == names.DELAY else candidates[0]


def _added_delay(settings: Settings) -> float:
    return abs(settings.preprocessing.torque_delay - settings.stated_delay)


def judged_by_others(
    rows: Sequence[Mapping[str, Any]], key: str = "without"
) -> dict[str, dict[str, Any]]:
    """Whether the other robots would keep each choice, and the mean ratio if they decide.

    `mean`: geometric mean over robots of the error without it over that with it; `dropped_by`: the
    robots whose others would leave it out; `left_to_others`: geometric mean over robots of the
    error that their others choose over that with the choice.

    Args:
        rows: of the board.
        key: under which a row has the error without each choice over that with it.
    """
    table = {}
    for choice in rows[0][key]:
        robots: dict[str, list[float]] = {}
        for row in rows:
            robots.setdefault(row["data"], []).append(float(np.log(row[key][choice])))
        means = {name: float(np.mean(logs)) for name, logs in robots.items()}
        dropped = [
            name
            for name in means
            if np.mean([mean for other, mean in means.items() if other != name] or [0.0]) < 0.0
        ]
        chosen = [mean if name in dropped else 0.0 for name, mean in means.items()]
        table[choice] = {
            "mean": round(float(np.exp(np.mean([*means.values()]))), 4),
            "worst": round(float(np.exp(max(max(logs) for logs in robots.values()))), 3),
            "best": round(float(np.exp(min(min(logs) for logs in robots.values()))), 3),
            "dropped_by": dropped,
            "left_to_others": round(float(np.exp(np.mean(chosen))), 4),
        }
    return table
