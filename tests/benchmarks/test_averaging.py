"""What averaged answers would be worth, by an arm whose predicted torques are given."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from benchmarks.averaging import ALL, QUESTIONS, Watched, ratios_of, watched
from hil.pipeline.prepared import Prepared
from identification.selection.averaging import AveragedBandwidth
from identification.selection.folds import Errors
from identification.selection.questions import BANDWIDTH, CONSISTENT, ROTORS, VELOCITY
from identification.selection.scores import SettingsTrial
from identification.selection.settings import Settings
from identification.signals.samples import Preprocessing
from tests.identification.two_link import MODEL

pytestmark = pytest.mark.long

CHOSEN = Settings(
    Preprocessing(rigid_bandwidth=10.0, velocity="measured"),
    friction={"presliding": 3e-5, "third": "none", "stribeck": 0.0, "load": False},
)
OTHER = replace(
    Settings(
        Preprocessing(
            rigid_bandwidth=7.0,
            velocity="position",
            exclude_rows="slow",
            torque_delay=0.001,
            torque_bandwidth=20.0,
        ),
        friction={"presliding": 1e-4, "third": "cubic", "stribeck": 0.1, "load": True},
    ),
    strength=replace(CHOSEN.strength, weight=4.0, consistent=True, wide_rotors=True),
)


@pytest.mark.parametrize("name", QUESTIONS)
def test_a_question_takes_its_own_answer_only(name: str) -> None:
    """So that all answers together, and nothing less, are the other settings."""
    answered = QUESTIONS[name].answered(CHOSEN, OTHER)
    assert answered != CHOSEN
    every = CHOSEN
    for question in QUESTIONS.values():
        every = question.answered(every, OTHER)
    assert every == OTHER
    for other_name, question in QUESTIONS.items():
        if {other_name, name} != {"delay", "low-pass"} and other_name != name:
            assert question.answered(answered, CHOSEN) == answered


class Trial:
    """Two held-out torques whose errors the bandwidth decides, and segments that are as good."""

    def __init__(self, worse: float) -> None:
        self.worse = worse  # error of the segments with another answer

    def key(self, settings: Settings) -> object:
        return settings.preprocessing, settings.strength

    def model(self, settings: Settings) -> Any:
        return SimpleNamespace(friction=SimpleNamespace(has_load=False))

    def values(self, settings: Settings) -> Any:
        how = settings.preprocessing
        return np.array([1.0, -1.0 if how.rigid_bandwidth == 7.0 else 1.0])

    def errors(self, settings: Settings) -> Errors:
        size = 0.1 if settings.preprocessing == CHOSEN.preprocessing else 0.1 * self.worse
        return Errors(np.full((5, 1), size**2), np.ones((5, 1)))

    odds = SettingsTrial.odds


def an_identification(worse: float, hedge: AveragedBandwidth | None = None) -> Watched:
    samples = SimpleNamespace(
        torque=np.zeros(2), predicted_torque=lambda model, values: -cast("Any", values)
    )
    sources = SimpleNamespace(cell=SimpleNamespace(model=Trial(1.0).model(CHOSEN)))
    prepared = SimpleNamespace(
        settings=replace(CHOSEN, hedge=hedge), held_out=(samples,), sources=sources
    )
    weighed = {BANDWIDTH: [CHOSEN, OTHER], VELOCITY: [CHOSEN, CHOSEN]}
    return Watched(cast("SettingsTrial", Trial(worse)), weighed, cast("Prepared", prepared))


def test_answers_that_predict_alike_count_the_same() -> None:
    """Errors of (1, 1) and (1, -1) have the mean (1, 0)."""
    ratios = an_identification(1.0).ratios()
    assert ratios["bandwidth"] == ratios[ALL] == pytest.approx(np.sqrt(0.5))
    assert ratios["velocity"] == 1.0


def test_an_answer_that_is_clearly_worse_does_not_count() -> None:
    assert an_identification(1.5).ratios() == dict.fromkeys([*QUESTIONS, ALL], 1.0)


def test_it_is_compared_with_the_averaged_bandwidth() -> None:
    """The usual bandwidth has the error of the chosen one here, so that nothing changes."""
    averaged = an_identification(1.0, AveragedBandwidth(14.0, 1.0)).ratios()
    assert averaged == an_identification(1.0).ratios()


def test_answers_about_the_prior_are_not_averaged_with_all() -> None:
    watching = an_identification(1.0)
    assert watching.trial is not None
    watching.weighed = {ROTORS: [OTHER], CONSISTENT: [OTHER]}
    assert watching.ratios()[ALL] == 1.0


def test_candidates_of_every_decision_are_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(SettingsTrial, "errors", lambda *_: Trial(1.0).errors(CHOSEN))
    with watched() as seen:
        SettingsTrial(MODEL, lambda *_: []).decide(BANDWIDTH, [CHOSEN, OTHER])
    assert seen.weighed == {BANDWIDTH: [CHOSEN, OTHER]}
    assert seen.prepared is None


def test_ratios_of_rows_with_and_without_averaging() -> None:
    rows = [
        {"hil": hil, "plain": 0.1, "averaged": {ALL: ratio}}
        for hil, ratio in ((0.2, 0.4), (0.05, 1.0))
    ]
    now = ratios_of(rows)
    averaged = ratios_of(rows, averaged=True)
    assert now[1:] == (2.0, 1, 2)
    assert averaged[1:] == pytest.approx((0.8, 0, 2))
    assert (now.mean, averaged.mean) == pytest.approx((1.0, np.sqrt(0.4)))
