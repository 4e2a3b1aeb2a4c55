"""A run: gates, dry run, quality checks, warm-up, disk and lock."""

from __future__ import annotations

import json
import shutil
import signal
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner, Result

import hil.files
from drivers.transports.simulated import SimulatedTransport
from hil.archive import open_archive
from hil.archive.check import check_archive
from hil.archive.repair import amend_outcome
from hil.batch.cache import CacheLocation
from hil.batch.discovery import discover
from hil.campaign import (
    Campaign,
    CampaignFolderError,
    MotionRefusedError,
    NotRehearsedError,
    VirtualLink,
    quality,
)
from hil.campaign import link as link_module
from hil.campaign.connection import active_checks
from hil.campaign.dry_run import OVERRIDE, DryRunRecord, agreement
from hil.campaign.errors import (
    AgainstGravityError,
    DryRunError,
    MotionFailedError,
    RepetitionsRejectedError,
)
from hil.campaign.folder import CampaignFolder
from hil.campaign.gates import require_rehearsed
from hil.campaign.operator import OperatorRequest, RunStatus, Stop
from hil.campaign.quality import FIELDS, Executed, RepetitionCheck
from hil.campaign.rehearsal import Rehearsal
from hil.campaign.run import RunResult
from hil.campaign.stages import WarmUpStage
from hil.campaign.warmup import (
    COLD_AFTER,
    FrictionMeter,
    WarmUpRecord,
    change_per_motion,
)
from hil.cli import app
from hil.errors import ControllerError, HilError, InputError, OperatorStopError, OutputError
from hil.identify.sources import gather_sources
from hil.motion_checks import MotionChecks
from hil.move import plan_move, send
from hil.progress import Silent
from hil.results import Results
from hil.simulation import (
    controller_settings,
    planted_truth,
    simulated_controller,
    simulated_link,
)
from sim_fixtures.faults import parse_fault, split_faults
from tests.hil.batch_work import Here
from tests.hil.fast_cell import fast_campaign, fast_cell, mirrored, pass_rehearsal, set_points
from tests.hil.screen_rig import on_terminal

pytestmark = pytest.mark.safety

Array = NDArray[np.float64]
Make = Callable[..., Campaign]
Requests = Callable[[RunStatus], OperatorRequest]


class Operator:
    """Operator at the screen: his requests by the status of the run, and his answer."""

    can_answer = True

    def __init__(
        self, requests: Requests = lambda _: OperatorRequest(), *, accepts: bool = True
    ) -> None:
        self.accepts, self.requests = accepts, requests
        self.seen: list[RunStatus] = []
        self.asked: list[DryRunRecord] = []

    def show(self, status: RunStatus) -> None:
        self.seen.append(status)

    def request(self) -> OperatorRequest:
        return self.requests(self.seen[-1]) if self.seen else OperatorRequest()

    def accept_dry_run(self, summary: DryRunRecord) -> bool:
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
    """A rehearsed campaign of a few seconds; of a real arm where that is wanted."""

    def made(
        name: str = "campaign", *, real: bool = False, rehearsed: bool = True, **settings: float
    ) -> Campaign:
        cell = fast_cell(tmp_path, **{"repetitions": 1, **settings})
        if real:
            cell = cell.with_link(transport="udp", host="192.0.2.7")
        campaign = Campaign.create(tmp_path / name, cell, designed.plan)
        if rehearsed:
            pass_rehearsal(campaign.folder)
        return campaign

    return made


@pytest.fixture(scope="module")
def dry(tmp_path_factory: pytest.TempPathFactory, designed: Campaign) -> Campaign:
    """A campaign whose dry run is done and accepted, and nothing more; tests copy it."""
    folder = tmp_path_factory.mktemp("dry")
    cell = fast_cell(folder, repetitions=1)
    campaign = Campaign.create(folder / "campaign", cell, designed.plan)
    pass_rehearsal(campaign.folder)
    campaign.run(dry_run_only=True, operator=Operator())
    return campaign


@pytest.fixture
def copied(tmp_path: Path, dry: Campaign) -> Campaign:
    """A copy of it."""
    shutil.copytree(dry.folder.root, tmp_path / "copied")
    return Campaign.open(tmp_path / "copied")


@dataclass
class Push:
    """A load on the upper arm for 0.1 s, or for so many cycles."""

    cycle: int
    load: float = 0.15
    cycles: int = 50

    def apply_to(self, on: Any) -> None:
        on.disturb("load", 1, self.load, self.cycles)


def run_pushed(campaign: Campaign, fault: Push) -> RunResult:
    """Run a campaign with a load on the arm."""
    controller = simulated_controller(campaign.cell, faults=[fault])  # type: ignore[list-item]
    link = VirtualLink.over(SimulatedTransport(controller), campaign.cell, controller.finish)
    return campaign.run(link, unrehearsed=True, durable=False)


def cycles_of(campaign: Campaign, archive: str) -> Array:
    """The cycles of a motion (k,)."""
    opened = open_archive(campaign.folder.archives / archive, fields=["cycle"])
    return np.asarray(opened.columns["cycle"])


def middle_of(campaign: Campaign, archive: str) -> int:
    """The cycle in the middle of a motion."""
    return int(np.mean(cycles_of(campaign, archive)[[0, -1]]))


def kinds(result: RunResult) -> list[str]:
    return [name.split("_")[0] for name in result.archives]


def outcomes(campaign: Campaign) -> dict[str, str]:
    """The outcome of each repetition."""
    entries = campaign.folder.manifest()
    return {e.name[11:-5]: e.outcome for e in entries if e.name.startswith("excitation")}


class Real:
    """A link in virtual time that reports a real arm."""

    only_simulated = False

    def __init__(self, campaign: Campaign) -> None:
        self._link = simulated_link(campaign.cell, instead_of_hardware=True)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._link, name)


# --- gates
def test_a_plan_is_not_run_before_it_was_rehearsed(make: Make) -> None:
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


@pytest.mark.parametrize(
    ("real", "message"),
    [
        (False, r"was not done, and there is no .*--dry-run`"),
        (True, "cannot be accepted before it was done"),
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
    assert (record.warnings, record.gravity_not_seen) == ((), ()), "torques of a right cell"
    for name, motion in zip(sorted(record.archives), motions, strict=True):
        planned = np.abs(motion.sample(np.arange(0, motion.duration, campaign.cell.period))[1])
        limits = campaign.cell.joint_limits.velocity
        speed = peak_speed(campaign, name)
        assert speed * limits == pytest.approx(OVERRIDE * planned.max(axis=0), rel=0.01)
        assert np.all(speed <= OVERRIDE)

    with pytest.raises(DryRunError, match=r"was done, but is not accepted; .*--accept-dry-run`"):
        campaign.run()
    second_run = campaign.run(accept_dry_run=True)
    assert kinds(second_run) == ["move", "standstill", "excitation", "validation", "move"]
    assert DryRunRecord.load(campaign.folder).accepted.by
    assert second_run.complete
    assert campaign.run().archives == (), "accepted once, and nothing is missing"


def peak_speed(campaign: Campaign, name: str) -> Array:
    """Of a motion, as a share of the joints' speed limits (n,)."""
    commanded = set_points(open_archive(campaign.folder.archives / name))
    speed = np.abs(np.diff(commanded, axis=0)).max(axis=0) / campaign.cell.period
    return np.asarray(speed / campaign.cell.joint_limits.velocity)


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


@pytest.mark.parametrize("warmup_drift", [0.0, 0.002])
@pytest.mark.parametrize("first_repetitions", [0, 3])
def test_the_time_left_is_right_and_counts_down(
    make: Make, monkeypatch: pytest.MonkeyPatch, warmup_drift: float, first_repetitions: int
) -> None:
    """Within a fifth after the first tenth, with a dry run, and where an earlier run is resumed."""
    campaign, stop = make(repetitions=6, warmup_drift=warmup_drift), Stop()
    if first_repetitions:

        def stopping(status: RunStatus) -> OperatorRequest:
            begun = status.phase == "repetition" and status.number > first_repetitions
            stop.requested = stop.requested or begun
            return OperatorRequest()

        with pytest.raises(MotionFailedError, match="stopped"):
            campaign.run(stop=stop, operator=Operator(stopping), durable=False)
    link = simulated_link(campaign.cell)
    controller_time = SimpleNamespace(monotonic=lambda: link.cycles * 0.002, sleep=time.sleep)
    monkeypatch.setattr(link_module, "time", controller_time)
    estimates = list[tuple[float, float]]()

    class Clock(Operator):
        def show(self, status: RunStatus) -> None:
            estimates.append((link.cycles * 0.002, status.time_left))

    campaign.run(link, operator=Clock(), durable=False)
    now, left = np.array(estimates).T
    true, settled = now[-1] - now, now - now[0] > 0.1 * (now[-1] - now[0])
    assert settled.sum() >= 10
    off = np.abs(left - true)[settled] / (0.2 * true[settled] + 1.0)
    assert off.max() < 1.0, (true[settled][off.argmax()], left[settled][off.argmax()])
    learned = np.diff(now).max()  # since the last update: it arrives at once
    assert np.diff(left[settled]).max() < 0.1 * true[0] + learned


def test_a_mirrored_joint_is_accepted_by_its_name_only(tmp_path: Path, designed: Campaign) -> None:
    cell, against = mirrored(designed.cell, "[-1, -1]"), ("shoulder",)
    campaign = Campaign.create(tmp_path / "campaign", cell, designed.plan)
    pass_rehearsal(campaign.folder)
    with pytest.raises(AgainstGravityError, match="runs against the model's gravity") as refused:
        campaign.run(accept_dry_run=True, accept_torque=cell.joint_names)
    assert refused.value.exit_code == 3
    assert refused.value.joints == against, "not accepted before it was measured"
    assert f"--accept-torque {against[0]}" in str(refused.value)
    step = campaign.status().steps[2]
    assert "runs against the model's gravity" in step.sentence
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


def edited(campaign: Campaign) -> None:
    """Edit its cell file."""
    text = campaign.folder.cell.read_text()
    assert "standstill_s = 0.3" in text
    campaign.folder.cell.write_text(text.replace("standstill_s = 0.3", "standstill_s = 0.7"))


def test_a_cell_edited_during_its_rehearsal_is_not_rehearsed(make: Make) -> None:
    campaign = make(rehearsed=False)

    class Editing(Silent):
        def say(self, text: str) -> None:
            if "as modelled" in text:
                edited(campaign)

    with pytest.raises(CampaignFolderError, match=r"cell\.toml was changed after it was read"):
        campaign.rehearse(reporter=Editing())
    assert Rehearsal.load(campaign.folder) is None


def test_motions_of_another_folder_are_not_sent(copied: Campaign) -> None:
    edited(copied)
    copied.folder.seal()
    pass_rehearsal(copied.folder)
    with pytest.raises(CampaignFolderError, match=r"cell\.toml was changed after it was read"):
        copied.run(accept_dry_run=True)
    assert not list(copied.folder.archives.glob("excitation*"))


def test_a_link_to_another_arm_is_refused(copied: Campaign) -> None:
    other = copied.cell.with_values({"limits.velocity_deg": [300.0, 300.0]})
    with pytest.raises(CampaignFolderError, match=r"opened with another cell \(\[limits\]"):
        copied.run(simulated_link(other))
    there = copied.cell.with_link(port=4711)
    assert copied.run(simulated_link(there)).complete


def test_a_mesh_belongs_to_what_was_rehearsed(tmp_path: Path) -> None:
    folder = CampaignFolder(tmp_path)
    folder.cell.write_text('[cell]\nname = "a"\nmesh_folders = ["meshes"]\n')
    folder.urdf.write_text(
        '<robot name="a"><link name="b"><collision><geometry>'
        '<mesh filename="package://arm/link.stl"/></geometry></collision></link></robot>'
    )
    mesh = tmp_path / "meshes" / "arm" / "link.stl"
    mesh.parent.mkdir(parents=True)
    mesh.write_bytes(b"a cube")
    folder.seal()
    before = folder.plan_hash
    mesh.write_bytes(b"a larger cube")
    assert folder.plan_hash != before
    with pytest.raises(NotRehearsedError, match=r"mesh package://arm/link\.stl is not the one"):
        folder.require_unchanged()
    # On another computer, which reads what was recorded, the mesh need not be there.
    mesh.unlink()
    assert folder.plan_hash == before


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


@pytest.mark.parametrize("provenance", [{"operator": "me"}, {"simulated": "no"}, None])
def test_the_link_decides_whether_the_arm_is_simulated(
    make: Make, monkeypatch: pytest.MonkeyPatch, provenance: dict[str, str] | None
) -> None:
    campaign = make(real=True)
    twin = simulated_link(campaign.cell, instead_of_hardware=True)
    if provenance is None:  # as of a version that left it to the caller
        monkeypatch.setattr("hil.campaign.runner.with_present_date", lambda _: {})
    campaign.run(twin, provenance=provenance, dry_run_only=True)
    monkeypatch.undo()
    first = next(campaign.folder.archives.iterdir())
    kind = open_archive(first, fields=()).header.entries.get("simulated")
    assert kind == (None if provenance is None else "yes")
    with pytest.raises(CampaignFolderError, match=r"holds archives of .*leads to a real one"):
        campaign.run(Real(campaign), dry_run_only=True)  # type: ignore[arg-type]
    hash_ = campaign.folder.plan_hash
    counts = DryRunRecord.load_valid(campaign.folder, plan_hash=hash_, motions=2, simulated=False)
    assert counts is None


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
        assert peak_speed(copied, name).max() <= OVERRIDE * 1.001


def link_to_controller_with(campaign: Campaign, **figures: Any) -> VirtualLink:
    """A link to a simulated controller whose own cell file differs in some figures."""
    other = campaign.cell.with_values({k.replace("__", "."): v for k, v in figures.items()})
    controller = simulated_controller(other)
    return VirtualLink.over(SimulatedTransport(controller), campaign.cell, controller.finish)


@pytest.mark.parametrize(
    ("figures", "error", "message"),
    [
        ({"drive_train__current_limit": [3.0, 12.0]}, MotionRefusedError,
         r"motor of shoulder: \S+ A, .*controller has 3 A .*cell file 20 A: write"),
        ({"drive_train__following_error": [1.0, 0.01]}, NotRehearsedError,
         r"elbow: 0\.01 motor revolutions in the controller, 1 in the cell file.*rehearse"),
        ({"controller__cycle_ms": 1}, ControllerError,
         r"cycle is 1 ms in the controller, 2 ms in the cell; correct the cell file, or the c\w+$"),
    ],
)  # fmt: skip
def test_what_the_controller_states_is_checked_first(
    copied: Campaign, figures: dict[str, Any], error: type[HilError], message: str
) -> None:
    before = sorted(copied.folder.archives.iterdir())
    with pytest.raises(error, match=message):
        copied.run(link_to_controller_with(copied, **figures))
    assert sorted(copied.folder.archives.iterdir()) == before


def test_wider_limits_change_nothing_and_narrower_ones_are_noted(copied: Campaign) -> None:
    wider = link_to_controller_with(copied, drive_train__current_limit=[30.0, 13.0])
    assert copied.run(wider, dry_run_only=True).dry_run == "accepted"
    wider.connect(Stop())
    checks = MotionChecks.of(copied.cell)
    assert active_checks(copied.cell, wider.connection, checks) is checks
    narrower = link_to_controller_with(copied, drive_train__current_limit=[19.5, 12.0])
    (note,) = [run_note for run_note in copied.run(narrower).notes if "limits" in run_note]
    assert "counted (shoulder: 19.5 A in the controller, 20 in the cell file)" in note


def test_a_single_move_respects_the_controllers_current_limit(
    tmp_path: Path, dry: Campaign
) -> None:
    link = link_to_controller_with(dry, drive_train__current_limit=[0.5, 12.0])
    move = plan_move(dry.cell, link.connect(Stop()), dry.cell.home)
    with pytest.raises(MotionRefusedError, match=r"the motion .*controller has 0\.5 A"):
        send(move, dry.cell, link, tmp_path / "move.mcap", stop=Stop())
    assert not (tmp_path / "move.mcap").exists()


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


@pytest.mark.parametrize(
    "edit",
    [
        lambda content: content.update(passed="yes"),
        lambda content: content.update(criteria=[]),
        lambda content: content["criteria"][2].update(passed=False),
        lambda content: content.update(format_version=7),
        lambda content: content["criteria"].pop(),
    ],
)
def test_a_rehearsal_passes_with_all_its_criteria(
    copied: Campaign, edit: Callable[[dict[str, Any]], object]
) -> None:
    folder = copied.folder
    require_rehearsed(folder)
    content = json.loads(folder.rehearsal.read_text())
    edit(content)
    folder.rehearsal.write_text(json.dumps(content))
    with pytest.raises(CampaignFolderError, match=r"rehearsal\.json cannot be read"):
        require_rehearsed(folder)


# --- quality
def slowing(times: range, phase: str = "repetition", number: int = 1) -> Requests:
    """Half the speed in one motion, at these times that it is shown."""
    shown = list[RunStatus]()

    def requests(status: RunStatus) -> OperatorRequest:
        this = (status.phase, status.number) == (phase, number)
        if this and status.motion is not None:
            shown.append(status)
        return OperatorRequest(0.5 if len(shown) in times else 1.0)

    return requests


def test_a_slowed_repetition_is_rejected_and_run_again(make: Make) -> None:
    campaign = make(repetitions=2)
    operator = Operator(slowing(range(1, 4), number=2))
    result = campaign.run(operator=operator, unrehearsed=True)
    (rejected,) = result.rejected
    assert rejected.archive == "excitation_001_a1.mcap"
    assert "held or slowed" in rejected.reason
    assert result.repetitions == (2, 2)
    assert outcomes(campaign) == {
        "000_a1": "completed", "001_a1": "rejected", "001_a2": "completed"
    }  # fmt: skip
    (entry,) = (e for e in campaign.folder.manifest() if e.outcome == "rejected")
    assert entry.reason == rejected.reason
    archive = open_archive(campaign.folder.archives / rejected.archive)
    assert archive.complete
    assert archive.outcome.entries["outcome"] == "rejected"
    assert archive.outcome.entries["reason"] == rejected.reason
    # Whoever names all files of the folder does not pool it either.
    loose = sorted(campaign.folder.archives.glob("excitation_*"))
    sources = gather_sources(loose, split=0.5)
    assert rejected.archive not in {
        source.name for source in (*sources.training, *sources.held_out)
    }
    assert any("rejected and left out: it was held or slowed" in text for text in sources.warnings)


def test_a_motion_that_is_always_rejected_ends_the_run(make: Make) -> None:
    campaign = make(bad_repetitions=2)
    slow = Operator(lambda status: OperatorRequest(0.5 if status.phase == "repetition" else 1.0))
    with pytest.raises(RepetitionsRejectedError, match="was rejected 3 times") as ended:
        campaign.run(operator=slow, unrehearsed=True)
    assert ended.value.exit_code == 5
    assert [*outcomes(campaign).values()] == ["rejected"] * 3
    assert campaign.run(unrehearsed=True).repetitions == (1, 1), "a next run continues"


def test_a_load_on_an_axis_is_detected(
    tmp_path: Path, designed: Campaign, undisturbed: Campaign
) -> None:
    """The same campaign to the bit, but for 0.1 s in the middle of its last repetition."""
    campaign = Campaign.create(tmp_path / "campaign", fast_cell(tmp_path), designed.plan)
    result = run_pushed(campaign, Push(middle_of(undisturbed, "excitation_003_a1.mcap")))
    (rejected,) = result.rejected
    assert rejected.archive == "excitation_003_a1.mcap"
    assert "shoulder" in rejected.reason
    assert result.repetitions == (4, 4)


def test_a_disturbed_first_repetition_rejects_no_others(make: Make, undisturbed: Campaign) -> None:
    campaign = make(repetitions=3)
    result = run_pushed(campaign, Push(middle_of(undisturbed, "excitation_000_a1.mcap")))
    assert result.complete
    assert [rejection.archive[11:-5] for rejection in result.rejected] == [
        "001_a1",
        "001_a2",
        "000_a1",
    ]
    assert "agree with each other, not with this" in result.rejected[2].reason
    assert any("excitation_000_a1.mcap was the only repetition" in note for note in result.notes)
    good = [path.name[11:-5] for path in campaign.folder.completed("excitation")]
    assert good == ["000_a2", "001_a3", "002_a1"]
    touched = open_archive(campaign.folder.archives / "excitation_000_a1.mcap")
    assert touched.outcome.outcome == "rejected"
    assert not campaign.folder.damaged()


def test_an_arm_that_changes_during_a_campaign_ends_it(make: Make, undisturbed: Campaign) -> None:
    begins = int(cycles_of(undisturbed, "excitation_002_a1.mcap")[0])
    campaign = make(repetitions=3)
    with pytest.raises(RepetitionsRejectedError, match="current of shoulder"):
        run_pushed(campaign, Push(begins - 1, 0.05, cycles=10**9))
    assert [*outcomes(campaign).values()] == ["completed"] * 2 + ["rejected"] * 4


def test_a_repetition_with_lost_replies_is_as_planned(
    tmp_path: Path, designed: Campaign, undisturbed: Campaign
) -> None:
    """Two in a row, at speed: the motion pauses for two cycles and skips no set-point."""
    name = "excitation_001_a1.mcap"
    middle = middle_of(undisturbed, name)
    cell = fast_cell(tmp_path)
    settings = replace(controller_settings(cell), missed_replies=5)
    controller = simulated_controller(cell, settings=settings)
    lost, _ = split_faults([parse_fault(f"lose@{middle}x2:to_controller")])
    link = VirtualLink.over(SimulatedTransport(controller, lost), cell, controller.finish)
    campaign = Campaign.create(tmp_path / "campaign", cell, designed.plan)
    campaign.run(link, unrehearsed=True, durable=False)
    sent, intended = (
        run_campaign.folder.archives / name for run_campaign in (campaign, undisturbed)
    )
    assert len(set_points(open_archive(sent))) == len(set_points(open_archive(intended))) + 2
    both = [played(path).commanded for path in (sent, intended)]
    np.testing.assert_allclose(*both, atol=1e-5)


def played(archive: Path) -> Executed:
    return Executed.of(open_archive(archive, fields=FIELDS))


@pytest.mark.parametrize(
    ("channel", "joint", "named"),
    [("position", 1, "position of elbow"), ("current", 0, "current of shoulder")],
)
def test_the_check_lets_noise_pass_and_names_what_differs(
    undisturbed: Campaign, channel: str, joint: int, named: str
) -> None:
    check = RepetitionCheck(undisturbed.cell, undisturbed.plan.excitation.trajectory)
    *earlier, last = (played(path) for path in undisturbed.folder.completed("excitation"))
    for repetition in earlier:
        assert check.problem(repetition) is None
        check.accept(repetition)
    assert check.problem(last) is None
    values = getattr(last, channel).copy()
    values[:, joint] += 0.2 * np.std(values[:, joint])
    assert named in str(check.problem(replace(last, **{channel: values})))


def test_a_truncated_stuck_or_saturated_motion_is_named(undisturbed: Campaign) -> None:
    check = RepetitionCheck(undisturbed.cell, undisturbed.plan.excitation.trajectory)
    good = played(undisturbed.folder.completed("excitation")[0])
    short = {name: getattr(good, name)[:400] for name in ("position", "current", "commanded")}
    position, current, saturated = good.position.copy(), good.current.copy(), good.current.copy()
    commanded = good.commanded[:, 1]
    end = 100 + int(np.argmax(np.abs(commanded[100:] - commanded[100]) > 0.03))
    position[100:end, 1] = position[100, 1]
    limit = undisturbed.cell.drive_train.current_limit[1]
    current[100:102, 1], saturated[100:105, 1] = limit, -limit
    few, many = (round(share * len(good.position)) for share in (0.005, 0.03))
    for changes, message in (
        ({}, None),
        (short, "cycles are archived"),
        ({"missed": few}, None),
        ({"missed": many}, "packets were missed"),
        ({"position": position}, "elbow is stuck: its position stays the same from 0.20 s"),
        ({"current": current}, None),
        ({"current": saturated}, "current of elbow was at its limit for 10 ms"),
    ):
        problem = check.problem(replace(good, **changes))
        assert problem is None if message is None else message in str(problem)


def test_an_amended_archive_keeps_its_content(tmp_path: Path, undisturbed: Campaign) -> None:
    path = tmp_path / "excitation_000_a1.mcap"
    shutil.copy(undisturbed.folder.completed("excitation")[0], path)
    before = open_archive(path)
    amend_outcome(path, "rejected", "something touched it")
    after = open_archive(path)
    assert after.complete
    assert check_archive(path).conforms
    amended = {"outcome": "rejected", "reason": "something touched it"}
    assert after.outcome.entries == before.outcome.entries | amended
    assert after.header.entries == before.header.entries
    assert (after.attachments, after.events) == (before.attachments, before.events)
    for name, column in before.columns.items():
        np.testing.assert_array_equal(after.columns[name], column)


class Killed(BaseException):
    """The process of a run is killed."""


def test_an_archive_that_was_not_checked_is_not_pooled(
    tmp_path: Path, make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    campaign = make(repetitions=2)

    def dies(*_: object) -> None:
        raise Killed

    monkeypatch.setattr(quality, "amend_outcome", dies)
    with suppress(Killed):
        campaign.run(operator=Operator(slowing(range(1, 4), number=2)), unrehearsed=True)
    monkeypatch.undo()
    slowed = campaign.folder.archives / "excitation_001_a1.mcap"
    assert open_archive(slowed, fields=()).outcome.outcome == "completed"
    cache = CacheLocation(str(tmp_path / "cache"))
    discovery = discover([str(campaign.folder.root)], cache, Here(), Silent())
    assert slowed.as_posix() not in {ref.location for ref in discovery.refs}
    (skipped,) = (unused for unused in discovery.skipped if unused.path == slowed.as_posix())
    assert "not listed in its campaign's manifest.json" in skipped.reason
    good = campaign.folder.completed("excitation")
    warnings = gather_sources([*good, slowed], 0.5).warnings
    assert any(text.startswith(f"{slowed.name} is not in its campaign") for text in warnings)
    again = campaign.run(unrehearsed=True)
    assert again.repetitions == (2, 2)
    assert [rejection.archive for rejection in again.rejected] == [slowed.name], (
        "judged by the next run"
    )


def test_an_archive_that_was_not_entered_is_adopted(tmp_path: Path, undisturbed: Campaign) -> None:
    root = tmp_path / "campaign"
    shutil.copytree(undisturbed.folder.root, root)
    manifest = root / "manifest.json"
    content = json.loads(manifest.read_text("utf-8"))
    gone = ("excitation_003", "valid")
    content["archives"] = [e for e in content["archives"] if not e["name"].startswith(gone)]
    manifest.write_text(json.dumps(content), "utf-8")
    foreign = root / "archives" / "excitation_002_a2.mcap"
    shutil.copy(root / "archives" / "excitation_001_a1.mcap", foreign)
    truncated = root / "archives" / "validation_000_a1.mcap"
    truncated.write_bytes(truncated.read_bytes()[:-50])

    result = Campaign.open(root).run(unrehearsed=True, durable=False)
    assert result.adopted == ("excitation_003_a1.mcap",)
    assert kinds(result) == ["move", "validation", "move"]
    assert result.complete


# --- warm-up
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
    for seconds in (COLD_AFTER + 60.0, -3600.0):  # and where a clock was put back
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
    campaign, clock = make(warmup_drift=0.9, warmup_least=4, repetitions=2), time.time
    passed = [0.0]
    monkeypatch.setattr("hil.campaign.stages.time.time", lambda: clock() + passed[0])

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
    assert any("rested for 120 min during the campaign" in note for note in result.notes)


def test_a_slowed_warm_up_motion_gives_no_friction(make: Make) -> None:
    campaign = make(warmup_drift=1e-9, warmup_least=3, warmup_most=3)
    operator = Operator(slowing(range(1, 4), "warm-up"))
    result = campaign.run(operator=operator, unrehearsed=True)
    assert [rejection.archive for rejection in result.rejected] == ["warmup_000_a1.mcap"]
    assert [motion.archive for motion in warm_up_of(campaign).motions] == [
        "warmup_000_a2.mcap", "warmup_001_a1.mcap", "warmup_002_a1.mcap"
    ]  # fmt: skip
    assert any("not warm" in note for note in result.notes)
    assert result.warm_up == "not warm" and result.complete


# --- disk, stop
@pytest.mark.parametrize("name", ["dry_run.json", "warmup.json"])
def test_a_full_disk_is_named(make: Make, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    drift = 1e-9 if name == "warmup.json" else 0.0
    campaign = make(warmup_drift=drift, warmup_least=3, warmup_most=3)
    write = hil.files._write_through

    def full(path: Path, content: str | bytes) -> None:
        if path.name.startswith(name):
            raise OSError(28, "No space left on device")
        write(path, content)

    monkeypatch.setattr(hil.files, "_write_through", full)
    with pytest.raises(OutputError, match=rf"{name} cannot be written \(No space left"):
        campaign.run(accept_dry_run=True)
    monkeypatch.undo()
    again = campaign.run(accept_dry_run=True)
    assert again.complete
    assert "dryrun" not in kinds(again)


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


# --- `hil run`
@pytest.fixture
def campaign(tmp_path: Path, designed: Campaign) -> Campaign:
    created = Campaign.create(tmp_path / "campaign", designed.cell, designed.plan)
    pass_rehearsal(created.folder)
    return created


def hil_run(campaign: Campaign, *options: str) -> Result:
    return CliRunner().invoke(app, ["run", str(campaign.folder.root), *options])


def summary_of(result: Result, exit_code: int = 0) -> dict[str, Any]:
    """What `hil run --json` printed; its last line is the result."""
    error = result.exception
    status = error.exit_code if isinstance(error, HilError) else result.exit_code
    assert status == exit_code, error
    summary: dict[str, Any] = json.loads(result.stdout)
    return summary


@pytest.mark.parametrize(
    ("outcome", "error"),
    [("stopped", OperatorStopError), ("refused", MotionFailedError), ("lost", MotionFailedError)],
)
def test_a_motion_that_fails_after_a_stop_is_a_fault(campaign, monkeypatch, outcome, error):
    def run(self, *, stop, **_):
        stop.requested = True
        raise MotionFailedError("repetition 1", outcome, "why")

    monkeypatch.setattr(Campaign, "run", run)
    assert type(hil_run(campaign, "--quiet").exception) is error


def test_a_script_without_a_terminal_reads_json(campaign: Campaign) -> None:
    refused = summary_of(hil_run(campaign, "--json"), 3)
    assert refused["exit_code"] == 3
    assert "--dry-run" in refused["error"]
    assert not list(campaign.folder.archives.iterdir())
    slow = summary_of(hil_run(campaign, "--dry-run", "--json"))
    assert (slow["dry_run"], slow["complete"]) == ("to be accepted", False)
    assert slow["verdict"] is None
    before = {path.name for path in campaign.folder.archives.iterdir()}

    done = summary_of(hil_run(campaign, "--accept-dry-run", "--json"))
    assert done["complete"]
    assert done["repetitions"] == [4, 4]
    assert done["verdict"]["good"]
    made = {path.name for path in campaign.folder.archives.iterdir()} - before
    assert set(done["archives"]) == made
    results = Results.model_validate_json(campaign.folder.results.read_bytes())
    assert results.verdict.line == done["verdict"]["line"]
    assert campaign.folder.report.exists()


def test_a_torque_against_the_model_needs_its_own_option(
    tmp_path: Path, designed: Campaign
) -> None:
    cell = mirrored(designed.cell, "[1, 1]")
    campaign = Campaign.create(tmp_path / "campaign", cell, designed.plan)
    pass_rehearsal(campaign.folder)
    slow = hil_run(campaign, "--dry-run", "--quiet")
    assert slow.exit_code == 0, slow.exception
    assert "elbow: measured torque runs against the model's gravity" in slow.stdout
    assert "--accept-dry-run --accept-torque elbow" in slow.stdout
    refused = summary_of(hil_run(campaign, "--accept-dry-run", "--json"), 3)
    assert "--accept-torque elbow" in refused["error"]
    options = ("--accept-dry-run", "--accept-torque", "elbow", "--no-identify", "--json")
    assert summary_of(hil_run(campaign, *options))["against_gravity"] == ["elbow"]


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (["--dry-run", "--accept-dry-run"], ""),
        (["--accept-dry-run", "--live", "8765"], "virtual time"),
    ],
)
def test_options_without_effect_are_refused(
    campaign: Campaign, options: list[str], text: str
) -> None:
    refused = hil_run(campaign, *options)
    assert getattr(refused.exception, "exit_code", refused.exit_code) == 2
    assert text in str(refused.exception)


def test_on_a_terminal_a_dry_run_is_asked_for_and_ctrl_c_stops(campaign: Campaign) -> None:
    root = campaign.folder.root
    with on_terminal("-m", "hil", "run", root, "--no-identify", columns=100) as end:
        end.await_seen(b"Type yes")
        time.sleep(0.3)  # input before the question is discarded
        end.press("yes\n")
        until = time.monotonic() + 120.0
        while not list(campaign.folder.archives.glob("excitation_*")):
            assert time.monotonic() < until and end.process.poll() is None, end.seen[-3000:]
            end.look()
        end.process.send_signal(signal.SIGINT)
        assert end.end(30.0) == 130, end.seen[-3000:]
        assert b"hil run" in end.seen, "the command that resumes"
    assert {entry.outcome for entry in campaign.folder.manifest()} <= {"completed", "stopped"}
    assert Campaign.open(root).run().complete, "the dry run was accepted at the terminal"
