"""The arm is warmed up before its repetitions, and again when it has cooled down."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.campaign import (
    Campaign,
)
from hil.campaign.campaign_run import RunResult
from hil.campaign.joint_warm_up import (
    COLD_AFTER_SECONDS,
    FrictionMeter,
    WarmUpRecord,
    change_per_motion,
)
from hil.campaign.operator import RunStatus
from hil.campaign.run_notes import NotWarm, WarmedUpAgain
from hil.campaign.warm_up_stage import WarmUpStage
from hil.control.motion_checks import MotionChecks
from hil.control.planted_arm import planted_truth
from hil.control.simulated_cell import simulated_link
from tests.hil.campaign.runs.rig import Array, Make, Operator, kinds, slowing
from tests.hil.fast_cell import fast_cell

pytestmark = pytest.mark.safety


def test_the_change_per_motion_is_the_largest_of_any_joint() -> None:
    k = np.arange(8.0)
    friction = np.column_stack([20.0 * (1.0 - 0.01 * k), np.full(8, 5.0), np.full(8, np.nan)])
    assert change_per_motion(friction) == pytest.approx(0.01 / (1.0 - 0.01 * 5.5), rel=1e-9)
    assert np.isnan(change_per_motion(friction[:1]))
    assert np.isnan(change_per_motion(friction[:, 2:]))
    touched = friction.copy()
    touched[-2, 1] *= 1.5
    assert change_per_motion(touched) == pytest.approx(change_per_motion(friction))


def test_friction_is_measured_without_knowing_the_arm_exactly(
    tmp_path: Path, designed: Campaign
) -> None:
    """A tenth more friction in the plant is a tenth more in the measure."""
    cell = fast_cell(tmp_path, repetitions=1)
    truth = planted_truth(cell)
    more = replace(truth, coulomb=1.1 * truth.coulomb, viscous=1.1 * truth.viscous)
    meter = FrictionMeter(cell, designed.plan.excitation.trajectory)
    frictions: list[Array] = []
    for name, planted in (("as it is", truth), ("more", more)):
        campaign = Campaign.create(tmp_path / name, cell, designed.plan)
        campaign.run(simulated_link(cell, truth=planted), unrehearsed=True, durable=False)
        frictions.append(meter.measure(campaign.folder.completed("excitation")[0]))
    assert frictions[1] / frictions[0] == pytest.approx(np.full(2, 1.1), abs=0.01)


def warm_up_of(campaign: Campaign) -> WarmUpRecord:
    record = WarmUpRecord.load(campaign.folder.warmup, campaign.folder.plan_hash)
    assert record is not None
    return record


def rested(campaign: Campaign, seconds: float) -> None:
    """The arm moved last so many seconds ago."""
    record = warm_up_of(campaign)
    assert record.moved_at == pytest.approx(time.time(), abs=60.0)
    replace(record, moved_at=time.time() - seconds).save(campaign.folder.warmup)


def test_the_arm_warms_up_and_again_when_it_has_cooled_down(make: Make) -> None:
    campaign = make(warmup_drift=0.004, warmup_least=5, warmup_most=7, repetitions=2)
    assert "friction_drift = 0.9" in campaign.cell.text

    def run() -> RunResult:
        return campaign.run(simulated_link(campaign.cell, effects=True), unrehearsed=True)

    first = run()
    assert first.warm_up == "warm"
    assert kinds(first)[1:] == [*["warmup"] * 5, "standstill", *["excitation"] * 2, "validation",
                                "move"]  # fmt: skip
    record = warm_up_of(campaign)
    friction = np.array([motion.friction for motion in record.motions])
    assert friction.shape == (5, 2)
    assert np.all(friction[-1] < friction[0]), "friction falls as the gears warm up"
    assert record.changes[-1] <= 0.004

    (campaign.folder.archives / "excitation_001_a1.mcap").unlink()
    again = run()
    assert kinds(again) == ["move", "excitation", "move"], "still warm"
    assert again.archives[1] == "excitation_001_a2.mcap", "no number is given twice"
    for seconds in (COLD_AFTER_SECONDS + 60.0, -3600.0):  # and where a clock was put back
        (campaign.folder.archives / campaign.folder.completed("excitation")[1].name).unlink()
        rested(campaign, seconds)
        assert kinds(run()) == ["move", *["warmup"] * 5, "excitation", "move"]
    later = warm_up_of(campaign)
    assert [len(later.earlier), len(later.motions)] == [10, 5]


@pytest.mark.parametrize("when", ["before", "held"])
def test_an_arm_that_rests_for_hours_is_warmed_up_again(
    make: Make, monkeypatch: pytest.MonkeyPatch, when: str
) -> None:
    """Between two repetitions, or while the operator holds the next one before it begins."""
    campaign = make(warmup_drift=0.9, warmup_least=4, repetitions=2)
    clock = time.time
    passed = [0.0]
    monkeypatch.setattr("hil.campaign.warm_up_stage.time.time", lambda: clock() + passed[0])

    class Leaves(Operator):
        def show(self, status: RunStatus) -> None:
            super().show(status)
            second = (status.phase, status.number) == ("repetition", 2)
            if second and when == "held":
                passed[0] = 2.0 * 3600.0

    motion_ended = WarmUpStage.motion_ended

    def rests_after(stage: WarmUpStage) -> None:
        motion_ended(stage)
        passed[0] = 2.0 * 3600.0

    if when == "before":
        monkeypatch.setattr(WarmUpStage, "motion_ended", rests_after)

    result = campaign.run(operator=Leaves(), unrehearsed=True)
    assert result.complete
    made = [kind for kind in kinds(result) if kind in ("warmup", "excitation")]
    cold = ["excitation"] if when == "held" else []
    assert made == [*["warmup"] * 4, "excitation", *cold, *["warmup"] * 4, "excitation"]
    assert len(result.rejected) == len(cold)
    rests = [note.rest for note in result.notes if isinstance(note, WarmedUpAgain)]
    assert rests == [pytest.approx(7200.0, abs=30.0)]


def test_a_slowed_warm_up_motion_gives_no_friction(make: Make) -> None:
    campaign = make(warmup_drift=1e-9, warmup_least=3, warmup_most=3)
    operator = Operator(slowing(range(1, 4), "warm-up"))
    result = campaign.run(operator=operator, unrehearsed=True)
    assert [rejection.archive for rejection in result.rejected] == ["warmup_000_a1.mcap"]
    assert [motion.archive for motion in warm_up_of(campaign).motions] == [
        "warmup_000_a2.mcap", "warmup_001_a1.mcap", "warmup_002_a1.mcap"
    ]  # fmt: skip
    assert [type(note) for note in result.notes] == [NotWarm]
    assert result.warm_up == "not warm" and result.complete


def test_what_a_warm_up_sends_is_checked(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    campaign = make(warmup_drift=0.9, warmup_least=3, warmup_most=3)
    campaign.run(unrehearsed=True)
    next(campaign.folder.archives.glob("validation*")).unlink()
    campaign.folder.warmup.unlink()
    checked: list[object] = []
    refusal = MotionChecks.refusal

    def spied(checks: MotionChecks, motion: Any) -> str | None:
        checked.append(motion)
        return refusal(checks, motion)

    monkeypatch.setattr(MotionChecks, "refusal", spied)
    assert "warmup" in kinds(campaign.run(unrehearsed=True))
    assert any(motion is campaign.plan.excitation.trajectory for motion in checked)
