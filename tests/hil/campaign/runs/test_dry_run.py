"""A dry run: slow, judged, asked for and accepted."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hil.base.errors import InputError, OperatorStopError
from hil.campaign.record_messages import not_accepted
from hil.campaign import (
    Campaign,
    CampaignFolderError,
)
from hil.campaign.dry_run_record import MAX_DRY_RUN_OVERRIDE, DryRunRecord, agreement
from hil.campaign.errors import (
    AgainstGravityError,
    DryRunError,
)
from hil.campaign.folder import CampaignFolder
from hil.control.motion_watch import Stop
from hil.control.simulated_cell import simulated_link
from tests.hil.campaign.runs.rig import Make, Operator, Real, kinds, peak_speed
from tests.hil.fast_cell import mirrored, pass_rehearsal
from tests.messages import AGAINST_GRAVITY, DRY_RUN_NOT_DONE

pytestmark = pytest.mark.safety


@pytest.mark.parametrize(
    ("real", "message"),
    [
        (False, r"was not done, and there is no .*simulated.*--accept-dry-run`"),
        (True, DRY_RUN_NOT_DONE),
    ],
)
def test_a_dry_run_that_was_not_done_is_asked_for(make: Make, real: bool, message: str) -> None:
    """Before anything moves; where an arm may move, it cannot be accepted beforehand."""
    campaign = make(real=real)
    with pytest.raises(DryRunError, match=message) as refused:
        campaign.run(accept_dry_run=real)
    assert refused.value.exit_code == 3
    assert not list(campaign.folder.archives.iterdir())


def test_the_dry_run_is_every_motion_slowly(make: Make) -> None:
    campaign = make()
    done = campaign.run(dry_run_only=True)
    assert kinds(done) == ["move", "dryrun", "dryrun", "move"]
    assert done.dry_run == "to be accepted"
    assert not done.complete
    motions = [
        campaign.plan.excitation.trajectory,
        *(validation.trajectory for validation in campaign.plan.validation),
    ]
    record = DryRunRecord.load(campaign.folder)
    assert (record.against_gravity, record.gravity_not_seen) == ((), ()), "torques of a right cell"
    for name, motion in zip(sorted(record.archives), motions, strict=True):
        planned = np.abs(motion.sample(np.arange(0, motion.duration, campaign.cell.period))[1])
        limits = campaign.cell.joint_limits.velocity
        speed = peak_speed(campaign, name)
        assert speed * limits == pytest.approx(MAX_DRY_RUN_OVERRIDE * planned.max(axis=0), rel=0.01)
        assert np.all(speed <= MAX_DRY_RUN_OVERRIDE)

    with pytest.raises(DryRunError, match=r"was done, but is not accepted; .*--accept-dry-run`"):
        campaign.run()
    second_run = campaign.run(accept_dry_run=True)
    assert kinds(second_run) == ["move", "standstill", "excitation", "validation", "move"]
    assert DryRunRecord.load(campaign.folder).accepted.by
    assert second_run.complete
    assert campaign.run().archives == (), "accepted once, and nothing is missing"


def test_the_operator_is_asked_and_a_no_ends_the_run(make: Make) -> None:
    campaign = make()
    refusing = Operator(accepts=False)
    with pytest.raises(DryRunError, match="is not accepted"):
        campaign.run(operator=refusing)
    names = [entry.name.split("_")[0] for entry in campaign.folder.manifest()]
    assert names == ["move", "dryrun", "dryrun"]
    (summary,) = refusing.asked
    assert summary.plan_hash == campaign.folder.plan_hash
    assert summary.simulated
    assert 0.0 < max(summary.current_share) < 1.0
    accepting = Operator()
    assert "dryrun" not in kinds(campaign.run(operator=accepting)), "what is done is not done again"
    assert len(accepting.asked) == 1
    phases = [status.phase for status in accepting.seen]
    assert list(dict.fromkeys(phases)) == ["move", "standstill", "repetition", "validation"]
    assert any(status.motion is not None for status in accepting.seen)


def test_a_mirrored_joint_is_accepted_by_its_name_only(tmp_path: Path, designed: Campaign) -> None:
    cell = mirrored(designed.cell, "[-1, -1]")
    against = ("shoulder",)
    campaign = Campaign.create(tmp_path / "campaign", cell, designed.plan)
    pass_rehearsal(campaign.folder)
    with pytest.raises(AgainstGravityError, match=AGAINST_GRAVITY) as refused:
        campaign.run(accept_dry_run=True, accept_torque=cell.joint_names)
    assert refused.value.exit_code == 3
    assert refused.value.joints == against, "not accepted before it was measured"
    assert f"--accept-torque {against[0]}" in str(refused.value)
    step = campaign.status().steps[2]
    assert AGAINST_GRAVITY in step.sentence
    assert step.command.endswith(f"--accept-torque {against[0]}")
    for wrong in ((), ("elbow",)):
        with pytest.raises(AgainstGravityError):
            campaign.run(accept_dry_run=True, accept_torque=wrong)
    with pytest.raises(InputError, match=r"no joint knee .*; the joints are shoulder, elbow"):
        campaign.run(accept_dry_run=True, accept_torque=["shoulder", "knee"])
    with pytest.raises(DryRunError):
        campaign.run(operator=(asked := Operator(accepts=False)), accept_dry_run=True)
    assert asked.asked[0].against_gravity == against
    assert not campaign.folder.completed("excitation")
    done = campaign.run(accept_dry_run=True, accept_torque=against)
    assert (done.complete, done.against_gravity) == (True, against)


def test_with_an_assumed_payload_its_centre_is_the_first_cause(tmp_path: Path) -> None:
    folder = CampaignFolder(tmp_path)
    record = DryRunRecord(
        "0", 0.2, ("a.mcap",), 1.0, False, ("shoulder",), (0.1,), (0.0,), 0, 0,
        against_gravity=("shoulder",),
    )  # fmt: skip
    loaded = replace(record, assumed_payload=True)
    text = str(not_accepted(folder, loaded, ("shoulder",)))
    assert text.index("--payload-centre") < text.index("joint_sign")


def test_a_torque_is_judged_by_weight_beside_friction() -> None:
    time_ = np.linspace(0.0, 20.0, 2000)
    speed = np.column_stack([np.cos(time_)] * 4)
    weight = np.column_stack(
        [30.0 * np.cos(np.sin(time_)), 8.0 * np.sin(time_), 0.2 * np.cos(time_ / 3.0), 0.0 * time_]
    )
    noise = np.random.default_rng(1).normal(scale=1.0, size=weight.shape)
    friction = 20.0 * np.sign(speed) + 5.0 * speed + noise
    moving = np.abs(speed) > 0.05
    for sign in (1.0, -1.0):
        correlation = agreement(weight, sign * 1.3 * weight + friction, speed, moving)
        assert np.all(sign * correlation[:2] > 0.9)
        assert np.isnan(correlation[2:]).all(), "light beside friction, and without weight"
    assert np.isnan(agreement(weight, friction, speed, np.zeros_like(moving))).all()


def test_a_simulated_dry_run_opens_no_gate_to_a_real_arm(make: Make) -> None:
    did = make("did", real=True)
    simulated = simulated_link(did.cell, instead_of_hardware=True)
    did.run(simulated, dry_run_only=True, operator=Operator())
    record = DryRunRecord.load(did.folder)
    for name, claimed in (("copied", record), ("edited", replace(record, simulated=False))):
        mine = make(name, real=True)
        claimed.accepted_now().save(mine.folder.dry_run)
        with pytest.raises(DryRunError, match="was not done"):
            mine.run(Real(mine))  # type: ignore[arg-type]
        step = mine.status().steps[2]
        assert (step.name, step.state) == ("dry run", "next")
        assert "is not valid" in step.sentence
        assert not list(mine.folder.archives.iterdir())


def test_a_dry_run_without_archives_or_of_version_1_is_void(copied: Campaign) -> None:
    record = copied.folder.dry_run
    text = record.read_text()
    record.write_text(text.replace('"format_version": 2', '"format_version": 1'))
    with pytest.raises(CampaignFolderError, match="format version 1"):
        copied.run()
    record.write_text(text)
    next(copied.folder.archives.glob("dryrun*")).unlink()
    with pytest.raises(DryRunError, match="was not done"):
        copied.run()


def test_an_unwatched_move_is_no_faster_than_a_dry_run(copied: Campaign) -> None:
    """The arm was jogged elsewhere since; `approach_speed` of this cell is full speed."""
    elsewhere = copied.cell.with_values({"simulation.initial_deg": [70.0, -70.0]})
    result = copied.run(simulated_link(elsewhere))
    moves = [name for name in result.archives if name.startswith("move")]
    assert len(moves) >= 2
    for name in moves:
        assert peak_speed(copied, name).max() <= MAX_DRY_RUN_OVERRIDE * 1.001


def test_a_stop_while_a_dry_run_is_asked_for(copied: Campaign) -> None:
    replace(DryRunRecord.load(copied.folder), accepted=None).save(copied.folder.dry_run)
    stop = Stop()

    class Leaves(Operator):
        def accept_dry_run(self, summary: DryRunRecord) -> bool:
            stop.requested = True
            return False

    with pytest.raises(OperatorStopError, match="is not accepted") as stopped:
        copied.run(operator=Leaves(), stop=stop)
    assert stopped.value.exit_code == 130
