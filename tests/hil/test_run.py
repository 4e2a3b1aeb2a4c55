"""A run: its gates, dry run, warm-up, quality checks, and what a next run takes over."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.transports import SimulatedTransport
from hil.archive import open_archive
from hil.archive.check import check_archive
from hil.archive.repair import amend_outcome
from hil.campaign import Campaign, CampaignFolderError, Link, NotRehearsedError
from hil.campaign.dry_run import OVERRIDE, DryRun, agreement
from hil.campaign.errors import (
    AgainstGravityError,
    DryRunError,
    MotionFailedError,
    RepetitionsRejectedError,
)
from hil.campaign.operator import OperatorRequest, RunStatus, Stop
from hil.campaign.quality import FIELDS, Played, RepetitionCheck
from hil.campaign.run import RunResult
from hil.campaign.warmup import COLD_AFTER, FrictionMeter, WarmUp, change_per_motion
from hil.cell import Cell
from hil.identify.sources import gather_sources
from hil.screen.screen import Pace
from hil.simulation import (
    controller_settings,
    planted_truth,
    simulated_controller,
    simulated_link,
)
from sim_fixtures.controller_faults import Faultable
from sim_fixtures.fault_script import parse_fault, split_faults
from tests.hil.fast_cell import fast_campaign, fast_cell, mirrored, pass_rehearsal

Array = NDArray[np.float64]
Make = Callable[..., Campaign]


class Person:
    """Somebody at the screen.

    Args:
        accepts: what is answered to a dry run.
        requests: override and hold by what is being run.
    """

    can_answer = True

    def __init__(
        self,
        accepts: bool = True,
        requests: Callable[[RunStatus], OperatorRequest] = lambda _: OperatorRequest(),
    ) -> None:
        self.accepts, self.requests = accepts, requests
        self.seen: list[RunStatus] = []
        self.asked: list[DryRun] = []

    def show(self, status: RunStatus) -> None:
        self.seen.append(status)

    def request(self) -> OperatorRequest:
        return self.requests(self.seen[-1])

    def accept_dry_run(self, summary: DryRun) -> bool:
        self.asked.append(summary)
        return self.accepts


@pytest.fixture(scope="module")
def designed(tmp_path_factory: pytest.TempPathFactory) -> Campaign:
    """The plan that all campaigns here run."""
    folder = tmp_path_factory.mktemp("designed")
    return fast_campaign(folder / "campaign", fast_cell(folder))


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory, designed: Campaign) -> Campaign:
    """A finished campaign of four repetitions; tests only read it."""
    folder = tmp_path_factory.mktemp("undisturbed")
    campaign = Campaign.create(folder / "campaign", fast_cell(folder), designed.plan)
    campaign.run(unrehearsed=True, durable=False)
    return campaign


@pytest.fixture
def make(tmp_path: Path, designed: Campaign) -> Make:
    """A rehearsed campaign of a few seconds, with `[campaign]` changed."""

    def made(*, rehearsed: bool = True, **settings: float) -> Campaign:
        cell = fast_cell(tmp_path, **{"repetitions": 1, **settings})
        campaign = Campaign.create(tmp_path / "campaign", cell, designed.plan)
        if rehearsed:
            pass_rehearsal(campaign.folder)
        return campaign

    return made


@dataclass(frozen=True)
class Push:
    """Somebody leans against the upper arm for 0.1 s."""

    cycle: int

    def inflict(self, on: Faultable) -> None:
        on.suffer("load", 1, 0.15, 50)


def kinds(result: RunResult) -> list[str]:
    return [name.split("_")[0] for name in result.archives]


# --- gates


def test_a_plan_is_not_run_before_exactly_it_was_rehearsed(make: Make) -> None:
    campaign = make(rehearsed=False)
    with pytest.raises(NotRehearsedError, match=r"was not rehearsed; run `hil rehearse .*`") as no:
        campaign.run(accept_dry_run=True)
    assert no.value.exit_code == 3
    pass_rehearsal(campaign.folder, passed=False)
    with pytest.raises(NotRehearsedError, match="failed its rehearsal"):
        campaign.run(accept_dry_run=True)
    pass_rehearsal(campaign.folder)
    text = campaign.folder.rehearsal.read_text("utf-8")
    other = text.replace(campaign.folder.plan_hash, "0" * 64)
    assert other != text
    campaign.folder.rehearsal.write_text(other, "utf-8")
    with pytest.raises(NotRehearsedError, match="with another cell, URDF or plan"):
        campaign.run(accept_dry_run=True)
    assert not list(campaign.folder.archives.iterdir())


def test_nobody_to_accept_the_dry_run_is_told_before_anything_moves(make: Make) -> None:
    campaign = make()
    with pytest.raises(DryRunError, match=r"was not done, and nobody .*--dry-run`") as refused:
        campaign.run()
    assert refused.value.exit_code == 3
    assert not list(campaign.folder.archives.iterdir())


def test_what_was_not_done_cannot_be_accepted_where_an_arm_may_move(
    tmp_path: Path, designed: Campaign
) -> None:
    text = fast_cell(tmp_path).with_link(transport="udp", host="10.2.12.150").text
    real = Cell.from_texts(text, designed.cell.urdf, designed.cell.path)
    campaign = Campaign.create(tmp_path / "real", real, designed.plan)
    pass_rehearsal(campaign.folder)
    with pytest.raises(DryRunError, match="cannot be accepted before it was done"):
        campaign.run(accept_dry_run=True)


def test_what_a_simulated_arm_did_slowly_opens_no_gate_to_a_real_one(
    tmp_path: Path, designed: Campaign
) -> None:
    text = fast_cell(tmp_path).with_link(transport="udp", host="10.2.12.150").text
    real = Cell.from_texts(text, designed.cell.urdf, designed.cell.path)
    campaign = Campaign.create(tmp_path / "real", real, designed.plan)
    pass_rehearsal(campaign.folder)
    twin = simulated_link(campaign.cell, instead_of_hardware=True)
    done = campaign.run(twin, dry_run_only=True)
    assert done.simulated
    with pytest.raises(CampaignFolderError, match=r"of a simulated arm, .* to a real one"):
        campaign.run(accept_dry_run=True)


def test_the_dry_run_is_every_motion_slowly_and_the_rest_waits_for_a_word(make: Make) -> None:
    campaign = make()
    done = campaign.run(dry_run_only=True)
    assert kinds(done) == ["move", "dryrun", "dryrun", "move"]
    assert done.dry_run == "to be accepted"
    assert not done.complete
    motions = [
        campaign.plan.excitation.trajectory,
        *(one.trajectory for one in campaign.plan.validation),
    ]
    for name, motion in zip(sorted(DryRun.load(campaign.folder).archives), motions, strict=True):  # type: ignore[union-attr]
        archive = open_archive(campaign.folder.archives / name)
        limits, period = campaign.cell.joint_limits, campaign.cell.period
        commanded = archive.columns["commanded_position"]
        speed = np.abs(np.diff(commanded[~np.isnan(commanded).any(axis=1)], axis=0)) / period
        planned = np.abs(motion.sample(np.arange(0, motion.duration, period))[1])
        assert speed.max(axis=0) == pytest.approx(OVERRIDE * planned.max(axis=0), rel=0.01)
        assert np.all(speed <= OVERRIDE * limits.velocity)

    with pytest.raises(DryRunError, match=r"was done, but is not accepted; .*--accept-dry-run`"):
        campaign.run()
    rest = campaign.run(accept_dry_run=True)
    assert kinds(rest) == ["move", "standstill", "excitation", "validation", "move"]
    accepted = DryRun.load(campaign.folder)
    assert accepted is not None
    assert accepted.accepted is not None
    assert accepted.accepted.by
    assert rest.complete
    assert campaign.run().archives == (), "accepted once, and nothing is missing"


def test_a_person_is_asked_and_a_no_ends_the_run(make: Make) -> None:
    campaign = make()
    nobody = Person(accepts=False)
    with pytest.raises(DryRunError, match="is not accepted"):
        campaign.run(operator=nobody)
    assert [entry.name.split("_")[0] for entry in campaign.folder.manifest()] == [
        "move", "dryrun", "dryrun"
    ]  # fmt: skip
    (summary,) = nobody.asked
    assert summary.plan_hash == campaign.folder.plan_hash
    assert summary.simulated
    assert 0.0 < max(summary.current_share) < 1.0
    somebody = Person()
    assert "dryrun" not in kinds(campaign.run(operator=somebody)), "what is done is not done again"
    assert len(somebody.asked) == 1
    phases = [status.phase for status in somebody.seen]
    assert list(dict.fromkeys(phases)) == ["move", "standstill", "repetition", "validation"]
    assert somebody.seen[0].time_left > somebody.seen[-1].time_left
    assert any(status.motion is not None for status in somebody.seen)


class TestTimeLeft:
    """After the first tenth of a run the time left is right within a fifth, and counts down."""

    @pytest.mark.parametrize("warmup_drift", [0.0, 0.002])
    @pytest.mark.parametrize("first_repetitions", [0, 3])
    def test_is_right(self, make: Make, warmup_drift: float, first_repetitions: int) -> None:
        """With its dry run, and of a run that resumes what an earlier one did."""
        campaign = make(repetitions=6, warmup_drift=warmup_drift)
        stop = Stop()
        if first_repetitions:

            def stopping(status: RunStatus) -> OperatorRequest:
                begun = status.phase == "repetition" and status.number > first_repetitions
                stop.requested = stop.requested or begun
                return OperatorRequest()

            with pytest.raises(MotionFailedError, match="stopped"):
                campaign.run(stop=stop, operator=Person(requests=stopping), durable=False)
        link = simulated_link(campaign.cell)
        pace, estimates = Pace(virtual=False), list[tuple[float, float]]()

        class Clock(Person):
            def show(self, status: RunStatus) -> None:
                now = link.cycles * 0.002
                pace.take(status, now, held=False)
                left = pace.left(status)
                assert left is not None
                estimates.append((now, left))

        campaign.run(link, operator=Clock(), durable=False)
        now, left = np.array(estimates).T
        true, known = now[-1] - now, now - now[0] > 0.1 * (now[-1] - now[0])
        assert known.sum() >= 10, "updates come by the computer's own clock"
        off = np.abs(left - true)[known] / (0.2 * true[known] + 1.0)
        assert off.max() < 1.0, (true[known][off.argmax()], left[known][off.argmax()])
        learned = np.diff(now).max()  # since the last update: it arrives at once
        assert np.diff(left[known]).max() < 0.1 * true[0] + learned


# --- what slow torques say


def test_a_joint_that_is_mirrored_is_named_and_accepted_by_name_only(
    tmp_path: Path, designed: Campaign
) -> None:
    cell, against = mirrored(designed.cell, "[-1, -1]"), ("shoulder",)
    campaign = Campaign.create(tmp_path / "campaign", cell, designed.plan)
    pass_rehearsal(campaign.folder)
    with pytest.raises(AgainstGravityError, match="runs against the model's gravity") as refused:
        campaign.run(accept_dry_run=True, accept_torque=cell.joint_names)
    assert refused.value.exit_code == 3
    assert refused.value.joints == against, "what nobody had seen is not accepted beforehand"
    assert f"--accept-torque {against[0]}" in str(refused.value)
    step = campaign.status().steps[2]
    assert "runs against the model's gravity" in step.sentence
    assert step.command.endswith(f"--accept-torque {against[0]}")
    for wrong in ((), ("nothing",)):
        with pytest.raises(AgainstGravityError):
            campaign.run(accept_dry_run=True, accept_torque=wrong)
    asked = Person(accepts=False)
    with pytest.raises(DryRunError):
        campaign.run(operator=asked, accept_dry_run=True)
    assert asked.asked[0].against_gravity == against
    assert not campaign.folder.completed("excitation")
    done = campaign.run(accept_dry_run=True, accept_torque=against)
    assert done.complete
    assert done.against_gravity == against


def test_torques_of_a_right_cell_are_not_doubted(make: Make) -> None:
    campaign = make()
    assert campaign.run(dry_run_only=True).against_gravity == ()
    found = DryRun.load(campaign.folder)
    assert found is not None
    assert (found.warnings, found.gravity_not_seen) == ((), ())


def test_a_torque_is_judged_by_the_weight_beside_friction_and_not_without_any() -> None:
    time_ = np.linspace(0.0, 20.0, 2000)
    speed = np.column_stack([np.cos(time_)] * 4)
    weight = np.column_stack(
        [30.0 * np.cos(np.sin(time_)), 8.0 * np.sin(time_), 0.2 * np.cos(time_ / 3.0), 0.0 * time_]
    )
    noise = np.random.default_rng(1).normal(scale=1.0, size=weight.shape)
    friction = 20.0 * np.sign(speed) + 5.0 * speed + noise
    moving = np.abs(speed) > 0.05
    for sign in (1.0, -1.0):
        found = agreement(weight, sign * 1.3 * weight + friction, speed, moving)
        assert np.all(sign * found[:2] > 0.9)
        assert np.isnan(found[2:]).all(), "too light beside friction, and without weight"
    assert np.isnan(agreement(weight, friction, speed, np.zeros_like(moving))).all()


# --- quality


def test_a_repetition_that_was_slowed_is_rejected_with_its_reason_and_run_again(
    make: Make,
) -> None:
    """The person slows the second repetition once it is under way."""
    campaign = make(repetitions=2)
    slowed: list[RunStatus] = []

    def wish(status: RunStatus) -> OperatorRequest:
        if status.phase == "repetition" and status.number == 2 and status.motion is not None:
            slowed.append(status)
        return OperatorRequest(override=0.5 if len(slowed) in range(1, 4) else 1.0)

    result = campaign.run(operator=Person(requests=wish), unrehearsed=True)
    (rejected,) = result.rejected
    assert rejected.archive == "excitation_001_a1.mcap"
    assert "held or slowed" in rejected.reason
    assert result.repetitions == (2, 2)
    good = [path.name for path in campaign.folder.completed("excitation")]
    assert good == ["excitation_000_a1.mcap", "excitation_001_a2.mcap"]
    (entry,) = (e for e in campaign.folder.manifest() if e.outcome == "rejected")
    assert entry.reason == rejected.reason
    archive = open_archive(campaign.folder.archives / rejected.archive)
    assert archive.complete
    assert archive.outcome is not None
    assert archive.outcome.entries["outcome"] == "rejected"
    assert archive.outcome.entries["reason"] == rejected.reason
    # Whoever names all files of the folder does not pool it either.
    loose = sorted(campaign.folder.archives.glob("excitation_*"))
    sources = gather_sources(loose, split=0.5)
    assert rejected.archive not in {one.name for one in (*sources.training, *sources.held_out)}
    assert any(
        "rejected and left out: it was held or slowed" in doubt for doubt in sources.warnings
    )


def test_a_motion_that_is_never_of_use_ends_the_run_after_as_many_tries_as_allowed(
    make: Make,
) -> None:
    campaign = make(bad_repetitions=2)
    slow = Person(
        requests=lambda status: OperatorRequest(0.5 if status.phase == "repetition" else 1.0)
    )
    with pytest.raises(RepetitionsRejectedError, match="of no use 3 times") as ended:
        campaign.run(operator=slow, unrehearsed=True)
    assert ended.value.exit_code == 5
    assert [e.outcome for e in campaign.folder.manifest() if "excitation" in e.name] == [
        "rejected"
    ] * 3
    assert campaign.run(unrehearsed=True).repetitions == (1, 1), "and a next run goes on"


def test_a_load_on_an_axis_is_seen_beside_the_repetitions_before(
    tmp_path: Path, designed: Campaign, undisturbed: Campaign
) -> None:
    """The same campaign to the bit, but for 0.1 s in the middle of its last repetition."""
    third = open_archive(undisturbed.folder.archives / "excitation_003_a1.mcap", fields=["cycle"])
    middle = int(np.mean(third.columns["cycle"][[0, -1]]))
    cell = fast_cell(tmp_path)
    pushes: list[Any] = [Push(middle)]
    controller = simulated_controller(cell, faults=pushes)
    link = Link.over(SimulatedTransport(controller), cell, controller.finish)
    campaign = Campaign.create(tmp_path / "campaign", cell, designed.plan)
    result = campaign.run(link, unrehearsed=True, durable=False)
    (rejected,) = result.rejected
    assert rejected.archive == "excitation_003_a1.mcap"
    assert "shoulder" in rejected.reason
    assert result.repetitions == (4, 4)


def test_a_repetition_in_which_answers_were_lost_is_the_motion_as_planned(
    tmp_path: Path, designed: Campaign, undisturbed: Campaign
) -> None:
    """Two in a row, at speed: the motion waits two cycles, and leaves nothing out.

    What the controller's own hold does to the currents is another matter: they are compared.
    """
    name = "excitation_001_a1.mcap"
    usual = open_archive(undisturbed.folder.archives / name, fields=["cycle"])
    middle = int(np.mean(usual.columns["cycle"][[0, -1]]))
    cell = fast_cell(tmp_path)
    settings = replace(controller_settings(cell), missed_replies=5)
    controller = simulated_controller(cell, settings=settings)
    lost, _ = split_faults([parse_fault(f"lose@{middle}x2:to_controller")])
    link = Link.over(SimulatedTransport(controller, lost), cell, controller.finish)
    campaign = Campaign.create(tmp_path / "campaign", cell, designed.plan)
    campaign.run(link, unrehearsed=True, durable=False)
    mine, theirs = (
        open_archive(one.folder.archives / name).columns["commanded_position"]
        for one in (campaign, undisturbed)
    )
    sent = [int(np.isfinite(one).all(axis=1).sum()) for one in (mine, theirs)]
    assert sent[0] == sent[1] + 2
    both = [played(one.folder.archives / name).commanded for one in (campaign, undisturbed)]
    np.testing.assert_allclose(*both, atol=1e-5)


def played(archive: Path) -> Played:
    return Played.of(open_archive(archive, fields=FIELDS))


@pytest.mark.parametrize(
    ("channel", "joint", "named"), [("position", 1, "position of elbow"),
                                    ("current", 0, "current of shoulder")]
)  # fmt: skip
def test_the_check_lets_noise_pass_and_names_what_differs(
    undisturbed: Campaign, channel: str, joint: int, named: str
) -> None:
    campaign = undisturbed
    check = RepetitionCheck(campaign.cell, campaign.plan.excitation.trajectory)
    *earlier, last = (played(path) for path in campaign.folder.completed("excitation"))
    for one in earlier:
        assert check.problem(one) is None
        check.accept(one)
    assert check.problem(last) is None
    values = getattr(last, channel).copy()
    spread = np.std(values[:, joint])
    values[:, joint] += 0.2 * spread
    assert named in str(check.problem(replace(last, **{channel: values})))


def test_the_check_by_itself_sees_missed_packets_saturation_and_missing_cycles(
    undisturbed: Campaign,
) -> None:
    campaign = undisturbed
    check = RepetitionCheck(campaign.cell, campaign.plan.excitation.trajectory)
    good = played(campaign.folder.completed("excitation")[0])
    assert check.problem(good) is None
    short = replace(
        good,
        **{name: getattr(good, name)[:400] for name in ("position", "current", "commanded")},
    )
    assert "cycles are archived" in str(check.problem(short))
    few, many = (replace(good, missed=round(share * len(good.position))) for share in (0.005, 0.03))
    assert check.problem(few) is None
    assert "packets were missed" in str(check.problem(many))
    position = good.position.copy()
    told = good.commanded[:, 1]
    end = 100 + int(np.argmax(np.abs(told[100:] - told[100]) > 0.03))
    position[100:end, 1] = position[100, 1]
    found = check.problem(replace(good, position=position))
    assert "elbow is stuck: its position stays the same from 0.20 s" in str(found)
    current = good.current.copy()
    limit = campaign.cell.drive_train.current_limit[1]
    current[100:102, 1] = limit
    assert check.problem(replace(good, current=current)) is None
    current[100:105, 1] = -limit
    found = check.problem(replace(good, current=current))
    assert "current of elbow was at its limit for 10 ms" in str(found)


def test_an_amended_archive_keeps_its_content(tmp_path: Path, undisturbed: Campaign) -> None:
    path = tmp_path / "excitation_000_a1.mcap"
    shutil.copy(undisturbed.folder.completed("excitation")[0], path)
    before = open_archive(path)
    amend_outcome(path, "rejected", "something touched it")
    after = open_archive(path)
    assert after.complete
    assert check_archive(path).keeps
    assert after.outcome.entries == {
        **before.outcome.entries, "outcome": "rejected", "reason": "something touched it"
    }  # fmt: skip
    assert after.header.entries == before.header.entries
    assert after.attachments == before.attachments
    assert after.events == before.events
    for name, column in before.columns.items():
        np.testing.assert_array_equal(after.columns[name], column)


# --- what a next run takes over


def test_an_archive_whose_run_was_killed_before_it_entered_it_is_not_made_again(
    tmp_path: Path, undisturbed: Campaign
) -> None:
    root = tmp_path / "campaign"
    shutil.copytree(undisturbed.folder.root, root)
    manifest = root / "manifest.json"
    content = json.loads(manifest.read_text("utf-8"))
    gone = [e for e in content["archives"] if e["name"].startswith(("excitation_003", "valid"))]
    content["archives"] = [e for e in content["archives"] if e not in gone]
    manifest.write_text(json.dumps(content), "utf-8")
    # One that is torn, and one that came from elsewhere, are no part of it.
    foreign = root / "archives" / "excitation_002_a2.mcap"
    shutil.copy(root / "archives" / "excitation_001_a1.mcap", foreign)
    torn = root / "archives" / "validation_000_a1.mcap"
    torn.write_bytes(torn.read_bytes()[:-50])

    result = Campaign.open(root).run(unrehearsed=True, durable=False)
    assert result.adopted == ("excitation_003_a1.mcap",)
    assert kinds(result) == ["move", "validation", "move"]
    assert result.complete


# --- warm-up


def test_the_change_per_motion_is_that_of_the_joint_that_changes_most() -> None:
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
    found: list[Array] = []
    for name, planted in (("as it is", truth), ("more", more)):
        campaign = Campaign.create(tmp_path / name, cell, designed.plan)
        campaign.run(simulated_link(cell, truth=planted), unrehearsed=True, durable=False)
        found.append(meter.measure(campaign.folder.completed("excitation")[0]))
    assert found[1] / found[0] == pytest.approx(np.full(2, 1.1), abs=0.01)


def rests_for(campaign: Campaign, seconds: float) -> None:
    """The arm moved last so long ago."""
    found = WarmUp.load(campaign.folder.warmup, campaign.folder.plan_hash)
    assert found is not None
    assert found.moved_at == pytest.approx(time.time(), abs=60.0)
    replace(found, moved_at=time.time() - seconds).save(campaign.folder.warmup)


def test_the_arm_warms_up_until_friction_hardly_changes_and_again_when_it_has_cooled_down(
    make: Make,
) -> None:
    campaign = make(warmup_drift=0.004, warmup_least=5, warmup_most=7, repetitions=2)
    text = campaign.cell.text
    assert "friction_drift = 0.9" in text
    watching = Person()
    first = campaign.run(
        simulated_link(campaign.cell, effects=True), operator=watching, unrehearsed=True
    )
    assert first.warm_up == "warm"
    assert kinds(first)[1:] == [*["warmup"] * 5, "standstill", *["excitation"] * 2, "validation",
                                "move"]  # fmt: skip
    found = WarmUp.load(campaign.folder.warmup, campaign.folder.plan_hash)
    assert found is not None
    curve = found.curve
    assert curve.friction.shape == (5, 2)
    assert np.all(curve.friction[-1] < curve.friction[0]), "friction falls as the gears warm up"
    assert curve.change[-1] <= 0.004
    assert watching.seen[-1].drift is not None

    gone = campaign.folder.archives / "excitation_001_a1.mcap"
    gone.unlink()
    again = campaign.run(simulated_link(campaign.cell, effects=True), unrehearsed=True)
    assert kinds(again) == ["move", "excitation", "move"], "still warm"
    assert again.archives[1] == "excitation_001_a2.mcap", "no number is given twice"
    (campaign.folder.archives / again.archives[1]).unlink()
    rests_for(campaign, COLD_AFTER + 60.0)
    cold = campaign.run(simulated_link(campaign.cell, effects=True), unrehearsed=True)
    assert kinds(cold) == ["move", *["warmup"] * 5, "excitation", "move"]
    later = WarmUp.load(campaign.folder.warmup, campaign.folder.plan_hash)
    assert later is not None
    assert [len(later.earlier), len(later.motions)] == [5, 5]


def test_a_warm_up_that_takes_too_long_goes_on_and_says_so(make: Make) -> None:
    campaign = make(warmup_drift=1e-9, warmup_least=3, warmup_most=4)
    result = campaign.run(simulated_link(campaign.cell, effects=True), unrehearsed=True)
    assert result.warm_up == "not warm"
    assert kinds(result).count("warmup") == 4
    assert result.complete


def test_a_damaged_record_of_a_warm_up_or_a_dry_run_is_named(make: Make) -> None:
    campaign = make()
    campaign.folder.dry_run.write_text("{}", "utf-8")
    with pytest.raises(CampaignFolderError, match=r"dry_run\.json is damaged"):
        campaign.run(accept_dry_run=True)
    campaign.folder.warmup.write_text("{}", "utf-8")
    with pytest.raises(CampaignFolderError, match=r"warmup\.json is damaged"):
        campaign.run(unrehearsed=True)
