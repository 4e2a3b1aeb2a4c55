"""Steps of a campaign and its records: each outcome has words with its figures."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import get_args

import pytest

from hil.campaign import campaign_steps as steps
from hil.campaign.campaign_steps import EndedRecording, StepOutcome
from hil.campaign.dry_run_record import Acceptance, DryRunRecord
from hil.campaign.joint_warm_up import WarmMotion, WarmUpRecord
from hil.campaign.precision_record import PrecisionRecord
from hil.campaign.record_messages import gravity_lines, warm_up_line
from hil.campaign.rehearsal_record import Rehearsal, RehearsalCriterion
from hil.campaign.status_messages import step_details, step_line

DRY_RUN = DryRunRecord(
    "0", 0.2, ("a.mcap", "b.mcap"), 61.4, False, ("shoulder",), (0.3,), (0.0,), 1, 2,
    against_gravity=("shoulder",),
)  # fmt: skip
ACCEPTED = replace(DRY_RUN, accepted=Acceptance("ada", "2026-03-01"))
WARM = WarmUpRecord(
    "0", ("shoulder",), 0.002, tuple(WarmMotion(f"{k}.mcap", (1.0,)) for k in range(4)), "warm"
)
FAILED = Rehearsal(
    plan_hash="0", seed=1, passed=False, repetitions=3, motion_seconds=60.0, software={},
    criteria=[
        RehearsalCriterion(
            name="excitation", value=1.0, bound=0.0, passed=False, sentence="I1zz is not determined"
        )
    ],
    assumed=[], not_seen=["floor"],
)  # fmt: skip
KILLED = EndedRecording("b.mcap", "killed", "")
LINES: list[tuple[StepOutcome, str]] = [
    (steps.UnreadableStep("rehearsal.json cannot be read."), "rehearsal.json cannot be read"),
    (steps.DesignedPlan(12.34, 1), "an excitation of 12.3 s and 1 validation motion"),
    (steps.NotRehearsed(is_of_another_plan=False), "not rehearsed on the simulated arm"),
    (steps.NotRehearsed(is_of_another_plan=True), "rehearsed with another cell, URDF or plan"),
    (steps.Rehearsed(FAILED), "the rehearsal failed: I1zz is not determined"),
    (steps.NoDryRun(), "not done: every motion at 20 % of its speed"),
    (steps.NoDryRun(is_invalid=True), "is not valid: it belongs to another plan or kind of arm"),
    (steps.DryRunDone(DRY_RUN), "done (61 s), but not accepted; shoulder: measured torque opposes"),
    (steps.DryRunDone(ACCEPTED), "accepted by ada at 2026-03-01"),
    (steps.SkippedStep(as_simulated=True), "skipped, as the arm is simulated"),
    (steps.SkippedStep(as_simulated=False), "left out"),
    (steps.NoWarmUp(is_required=True), "not done"),
    (steps.NoWarmUp(is_required=False), "not required (warmup_drift)"),
    (steps.WarmUpDone(WARM), "warm after 4 motions"),
    (steps.PlannedRecordings("excitation", 2, 5), "2 of 5 repetitions complete"),
    (steps.PlannedRecordings("validation", 0, 2), "0 of 2 validation motions complete"),
    (steps.MadeRecordings(2, ()), "2 complete"),
    (steps.MadeRecordings(2, (KILLED,)), "2 complete; 1 rejected or ended early"),
    (steps.NotIdentified(), "not identified yet"),
    (steps.NotIdentified(("a.mcap", "b.mcap")), "without 2 of the archives (a.mcap)"),
    (steps.Identified("The model predicts well"), "The model predicts well"),
    (steps.NoReport(is_outdated=False), "no report yet"),
    (steps.NoReport(is_outdated=True), "older than the results"),
    (steps.Reported(Path("runs/report.html")), "runs/report.html"),
]


@pytest.mark.parametrize(("found", "words"), LINES, ids=[words for _, words in LINES])
def test_each_outcome_has_words(found: StepOutcome, words: str) -> None:
    assert words in step_line(found)


def test_the_table_has_every_outcome() -> None:
    assert {type(found) for found, _ in LINES} == {*get_args(StepOutcome)}


@pytest.mark.parametrize(
    ("found", "details"),
    [
        (steps.Rehearsed(FAILED), ["I1zz is not determined", "not detectable by it: floor"]),
        (
            steps.DryRunDone(ACCEPTED),
            [
                "largest current, of its limit: shoulder 30 %",
                "2 motions at 20 % of their speed",
                "1 packet missed, 2 replies late",
                f"{gravity_lines(DRY_RUN)[0]}; it was accepted by name",
            ],
        ),
        (steps.DryRunDone(DRY_RUN), []),
        (steps.WarmUpDone(WARM), []),
        (
            steps.WarmUpDone(replace(WARM, outcome="not warm")),
            [warm_up_line(replace(WARM, outcome="not warm"))],
        ),
        (
            steps.MadeRecordings(
                1,
                (
                    EndedRecording("a.mcap", "rejected", "it was held"),
                    KILLED,
                    replace(KILLED, archived_outcome="completed", reason="all of it"),
                ),
                PrecisionRecord("0", ()),
            ),
            [
                "a.mcap rejected: it was held",
                "b.mcap killed: it was never closed: the program or the computer stopped",
                "b.mcap killed: the program ended before it checked the motion"
                " (completed: all of it)",
                "no repetition was measured yet",
            ],
        ),
    ],
    ids=["rehearsal", "accepted", "not accepted", "warm", "not warm", "recordings"],
)
def test_details_are_for_the_report(found: StepOutcome, details: list[str]) -> None:
    assert step_details(found) == details


def test_a_warm_up_states_its_change() -> None:
    assert warm_up_line(WARM) == (
        "warm-up: friction changes by 0.00 % per motion after 4 motions (warm below 0.20 %): warm"
    )


def test_the_centre_of_an_assumed_payload_is_the_first_cause() -> None:
    (line,) = gravity_lines(replace(DRY_RUN, assumed_payload=True))
    assert line.index("--payload-centre") < line.index("joint_sign")
    assert "--payload-centre" not in gravity_lines(DRY_RUN)[0]
