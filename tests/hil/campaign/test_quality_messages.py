"""Why a completed motion is rejected: each problem has words with its figures."""

from __future__ import annotations

from typing import get_args

import pytest

from hil.campaign import quality_problems as problems
from hil.campaign.quality_messages import problem_words, replaced_words
from hil.campaign.quality_problems import QualityProblem, ReplacedRepetitions
from identification.signals.position_steps import PositionJump
from tests import messages

WORDS: dict[QualityProblem, str] = {
    problems.MissedPackets(31, 1000): "31 of 1000 packets were missed; 1 % are allowed",
    problems.StuckJoint("elbow", 0.2, 0.0312): (
        "elbow is stuck: its position stops changing 0.20 s after the start, while its command"
        " moves by 0.0312 rad"
    ),
    problems.SaturatedCurrent("elbow", 0.01): "the current of elbow was at its limit for 10 ms",
    problems.IncompleteArchive(400, 1000): "only 400 of its 1000 cycles are archived",
    problems.HeldOrSlowed(1.23): "it was held or slowed about 1.2 s after its start",
    problems.MovedAtRest("elbow", 0.0123, 0.001): "elbow moved at 0.012 rad/s when the arm should",
    problems.OtherRepetition("position", "elbow", 3, 0.06, 0.05): (
        "the position of elbow differs from the 3 previous repetitions by 6.00 % of the"
        " following-error threshold (rms); 5.00 % are allowed"
    ),
    problems.OtherRepetition("current", "elbow", 3, 0.2, 0.1): "20.00 % of its rms current (rms)",
    problems.ColdStart(1800.0): "the arm had rested for 30 min when it began",
    problems.ColdStart(None): "the arm had rested for an unknown time when it began",
    problems.Slipped(PositionJump("", "elbow", 1.5, -0.01)): (
        "the measured position of elbow slipped by 0.57° 1.50 s after the archive begins"
    ),
    problems.OthersAgree(("a.mcap",), only_missed=False): (
        "a.mcap and the next repetition agree with each other, not with this"
    ),
    problems.OthersAgree(("a.mcap", "b.mcap"), only_missed=True): messages.MISSED_IN_IT_ONLY,
}


@pytest.mark.parametrize(("problem", "words"), WORDS.items(), ids=list(WORDS.values()))
def test_each_problem_has_words(problem: QualityProblem, words: str) -> None:
    assert words in problem_words(problem)


def test_the_table_has_every_problem() -> None:
    assert {type(problem) for problem in WORDS} == {*get_args(QualityProblem)}


@pytest.mark.parametrize(
    ("archives", "words"),
    [
        (("a.mcap",), "a.mcap was the only accepted repetition, and was rejected because 3 later"),
        (("a.mcap", "b.mcap"), "packets were missed in all accepted repetitions (a.mcap, b.mcap)"),
    ],
)
def test_replaced_repetitions_are_named(archives: tuple[str, ...], words: str) -> None:
    assert words in replaced_words(ReplacedRepetitions(archives, 3))
