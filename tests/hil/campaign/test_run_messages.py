"""What the reader of a run's results must know: each note has words with its figures."""

from __future__ import annotations

import json
from typing import get_args

import pytest

from hil.campaign.campaign_run import RunResult
from hil.campaign.dry_run_record import DryRunRecord
from hil.campaign.joint_warm_up import WarmMotion, WarmUpRecord
from hil.campaign.operator import OperatorFault, RequestUnread, ScreenFailed
from hil.campaign.precision_record import PrecisionRecord
from hil.campaign.quality_problems import ReplacedRepetitions
from hil.campaign.run_messages import run_lines
from hil.campaign.run_notes import (
    AgainstGravity,
    LowerCurrentLimits,
    NotWarm,
    RunNote,
    WarmedUpAgain,
)
from hil.control.motion_refusals import LowerLimit
from tests.messages import AGAINST_GRAVITY, DISTURBED_ALIKE

JOINTS = ("shoulder", "elbow")
DRY_RUN = DryRunRecord(
    "0", 0.2, (), 90.0, False, JOINTS, (0.1, 0.2), (0.01, 0.02), 0, 0, against_gravity=JOINTS
)
WARM_UP = WarmUpRecord(
    "0",
    JOINTS,
    0.002,
    tuple(WarmMotion(f"warmup_{k:03d}_a1.mcap", (0.9**k, 0.9**k)) for k in range(4)),
    "not warm",
)
LIMITS = (
    LowerLimit("shoulder", "current_limit", 19.5, 20.0),
    LowerLimit("elbow", "current_limit", 11.0, 12.0),
)
WORDS: dict[RunNote, str] = {
    LowerCurrentLimits(LIMITS): (
        "the controller's own, lower current limits were used (shoulder: 19.5 A in the controller,"
        " 20 in the cell file; elbow: 11 A in the controller, 12 in the cell file)"
    ),
    NotWarm(WARM_UP): "the arm was not warm when the repetitions began (warm-up: friction changes",
    WarmedUpAgain(7200.0): "the arm had rested for 120 min during the campaign, and was warmed up",
    WarmedUpAgain(None): "rested for an unknown time during the campaign",
    ReplacedRepetitions(("a.mcap", "b.mcap"), 3): DISTURBED_ALIKE,
    ScreenFailed("OSError: no picture"): "screen failed (OSError: no picture); nothing was shown",
    RequestUnread("TypeError: x", ended_hold=False): (
        "could not be read (TypeError: x); the last request remained active"
    ),
    RequestUnread("TypeError: x", ended_hold=True): "(TypeError: x); the arm was held and could",
}


@pytest.mark.parametrize(("note", "words"), WORDS.items(), ids=list(WORDS.values()))
def test_each_note_has_words(note: RunNote, words: str) -> None:
    (line,) = run_lines([note])
    assert words in line


def test_each_joint_against_gravity_has_a_line() -> None:
    lines = run_lines([AgainstGravity(DRY_RUN)])
    assert [line.split(": ")[:2] for line in lines] == [["dry run", joint] for joint in JOINTS]
    assert all(AGAINST_GRAVITY in line for line in lines)


def test_every_kind_of_note_is_worded_here() -> None:
    kinds = {*get_args(RunNote), *get_args(OperatorFault)}
    assert {*map(type, WORDS), AgainstGravity} == kinds


@pytest.mark.parametrize(
    ("precision", "words"),
    [(None, ""), (PrecisionRecord("0", ("mass 1 %",)), "no repetition was measured yet")],
)
def test_the_result_is_json_in_words(precision: PrecisionRecord | None, words: str) -> None:
    result = RunResult(
        campaign="arm",
        command="hil run arm",
        plan_hash="0",
        simulated=True,
        archives=(),
        rejected=(),
        adopted=(),
        dry_run="left out",
        against_gravity=(),
        warm_up="none",
        repetitions=(1, 2),
        validations=(0, 1),
        complete=False,
        cycles=100,
        precision=precision,
        notes=(WarmedUpAgain(7200.0),),
    )
    document = json.loads(json.dumps(result.to_dict()))
    assert document["precision"] == words
    assert document["notes"] == run_lines(result.notes)
    assert document["repetitions"] == [1, 2]
