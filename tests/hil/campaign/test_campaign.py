"""A campaign: checked before it moves, archived once, deterministic, resumable."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.errors import Check, GuardError
from drivers.states import State
from drivers.transports.simulated import Corrupt, Lose, SimulatedTransport
from hil.archive import ArchiveName, ArchiveWriter, open_archive
from hil.base.errors import ArchiveWriteError, ControllerError, InputError
from hil.base.progress import Silent, Task
from hil.campaign import (
    Campaign,
    CampaignFolderError,
    CampaignPlan,
    MotionFailedError,
    MotionRefusedError,
    NotRehearsedError,
    PlannedMotion,
    Stop,
    VirtualLink,
)
from hil.campaign import state as state_module
from hil.campaign.planned_motions import planned_motions
from hil.cell import AngleFrame, Cell
from hil.control.errors import refusal_text
from hil.control.motion_checks import MotionChecks
from hil.control.motions import CampaignMotion, CheckedMoves, player_of, require_allowed, rest
from hil.control.simulated_cell import simulated_controller, simulated_link
from planner import (
    Move,
    PiecewiseCubic,
    PlanFile,
    PlannerCrashed,
    TrajectoryPlayer,
    plan_moves,
)
from sim_fixtures import SimulatedController
from tests import messages
from tests.hil.fast_cell import set_points
from tests.messages import NO_CAMPAIGN_FOLDER, NO_CAMPAIGN_PLAN

pytestmark = pytest.mark.safety

Run = Callable[..., Campaign]


def execute(campaign: Campaign, link: VirtualLink | None = None, **how: Any) -> None:
    link = link or simulated_link(campaign.cell)
    campaign.run(link, durable=False, unrehearsed=True, **how)


@dataclass
class Arm:
    """A campaign of one repetition, and the simulated arm that it is run on."""

    campaign: Campaign
    controller: SimulatedController
    link: VirtualLink

    @classmethod
    def made(cls, folder: Path, cell: Cell, plan: CampaignPlan, *faults: Lose) -> Arm:
        campaign = Campaign.create(folder / "one", *one_repetition(cell, plan))
        controller = simulated_controller(campaign.cell)
        return cls(
            campaign,
            controller,
            VirtualLink.over(SimulatedTransport(controller, faults), campaign.cell),
        )

    @property
    def speed(self) -> float:
        return float(np.abs(self.controller.plant.velocity).max())


@pytest.fixture
def arm(tmp_path: Path, cell: Cell, plan: CampaignPlan) -> Arm:
    return Arm.made(tmp_path, cell, plan)


def one_repetition(cell: Cell, plan: CampaignPlan) -> tuple[Cell, CampaignPlan]:
    return cell.with_campaign(repetitions=1), replace(plan, validation=plan.validation[:1])


def written(cell: Cell, old: str, new: str) -> Cell:
    assert old in cell.text
    return Cell.from_texts(cell.text.replace(old, new), cell.urdf, cell.path)


class TestArchives:
    """What a finished campaign leaves."""

    def test_every_interval_of_motion_is_one_complete_archive(self, campaign: Campaign) -> None:
        names = [ArchiveName.parse(path) for path in campaign.folder.archives.glob("*.mcap")]
        assert sorted((name.kind, name.index) for name in names if name is not None) == [
            *(("excitation", i) for i in range(3)),
            *(("move", i) for i in range(2)),
            ("standstill", 0),
            *(("validation", i) for i in range(2)),
        ]
        archive = open_archive(campaign.folder.completed("excitation")[0])
        assert archive.complete
        assert set(archive.attachments) == {
            "cell.toml", "robot.urdf", "drive_train.json", "plan.json", "init_packet.bin"
        }  # fmt: skip
        assert archive.header.entries["simulated"] == "yes"
        assert archive.outcome.entries["outcome"] == "completed"

    def test_commanded_is_what_was_planned_and_the_arm_returns(self, campaign: Campaign) -> None:
        archive = open_archive(campaign.folder.completed("excitation")[0])
        commanded = set_points(archive)
        trajectory = campaign.plan.excitation.trajectory
        period = campaign.cell.period
        planned, _, _ = trajectory.sample(np.arange(len(commanded)) * period)
        # The first set-point is the controller's float32 target; its rounding offset remains.
        assert commanded == pytest.approx(planned, abs=2e-6)
        velocity = np.abs(np.diff(commanded, axis=0)) / period
        assert np.all(velocity <= campaign.cell.joint_limits.velocity * (1 + 1e-6))
        first = open_archive(campaign.folder.archives / "move_000_a1.mcap")
        last = open_archive(campaign.folder.archives / "move_001_a1.mcap")
        before = first.columns["target_position"][0]
        after = last.columns["target_position"][-1]
        assert after == pytest.approx(before, abs=2e-6)
        # Stiction keeps the arm itself some encoder counts away from the target.
        assert last.columns["position"][-1] == pytest.approx(after, abs=5e-3)

    def test_cycles_from_closed_to_closed_without_a_gap(self, campaign: Campaign) -> None:
        """Each archive holds one interval in open mode; no cycle is missing between two."""
        files = [open_archive(campaign.folder.archives / e.name).columns
                 for e in campaign.folder.manifest()]  # fmt: skip
        for columns in files:
            interval = columns["interval"]
            state = columns["state"]
            assert len(set(interval[interval >= 0])) == 1
            assert state[0] in (State.CLOSED, State.OPENING)
            assert state[-1] == State.CLOSED
            assert np.all(np.diff(columns["cycle"]) == 1)
        for before, after in pairwise(files):
            assert after["cycle"][0] == before["cycle"][-1] + 1

    def test_a_damaged_archive_is_recorded_again(
        self, tmp_path: Path, cell: Cell, plan: CampaignPlan, run: Run
    ) -> None:
        campaign = run(tmp_path / "damaged", *one_repetition(cell, plan))
        (intact,), (damaged,) = (campaign.folder.completed(k) for k in ("excitation", "validation"))
        before = intact.read_bytes()
        content = bytearray(damaged.read_bytes())
        content[len(content) // 2] ^= 1
        damaged.write_bytes(content)
        assert campaign.folder.completed("validation") == []
        execute(Campaign.open(campaign.folder.root))
        assert intact.read_bytes() == before
        again = [path.name for path in campaign.folder.completed("validation")]
        assert again == ["validation_000_a2.mcap"]
        assert damaged.exists(), "nothing is overwritten"


class TestStop:
    """A stop ends a motion on its path, or begins none."""

    def test_on_the_path_and_the_rest_is_resumed(self, arm: Arm) -> None:
        stop = Stop()
        advance = arm.controller.accept

        def stop_at_speed(reply: bytes | None) -> None:
            advance(reply)
            stop.requested = stop.requested or arm.speed > 1.0

        arm.controller.accept = stop_at_speed  # type: ignore[method-assign]
        with pytest.raises(MotionFailedError, match="stopped by the operator"):
            execute(arm.campaign, arm.link, stop=stop)
        stopped = open_archive(arm.campaign.folder.archives / "move_000_a1.mcap")
        assert stopped.complete
        assert stopped.outcome.entries["outcome"] == "stopped"
        assert np.abs(stopped.columns["velocity"][-1]).max() < 0.01  # three encoder counts a cycle
        again = Campaign.open(arm.campaign.folder.root)
        execute(again)
        assert len(again.folder.completed("excitation")) == 1
        assert len(again.folder.completed("validation")) == 1

    def test_between_motions_begins_none(self, arm: Arm) -> None:
        stop = Stop()

        class StopAfterTheFirst(Silent):
            @contextmanager
            def task(self, title: str, total: float) -> Iterator[Task]:
                yield Task(lambda *_: setattr(stop, "requested", True))

        with pytest.raises(MotionFailedError, match="it had not started"):
            execute(arm.campaign, arm.link, stop=stop, reporter=StopAfterTheFirst())
        assert [entry.name for entry in arm.campaign.folder.manifest()] == ["move_000_a1.mcap"]

    def test_before_the_connection_moves_nothing(self, arm: Arm) -> None:
        with pytest.raises(ControllerError, match="before anything moved"):
            execute(arm.campaign, arm.link, stop=Stop(requested=True))
        assert not list(arm.campaign.folder.archives.iterdir())


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("gear_ratio = [-116.0", "gear_ratio = [116.0", "gear ratio"),
        ("calibration = [0.25", "calibration = [29.25", "calibration"),
        ("k65 = 0.035", "k65 = -0.035", "k65"),
    ],
)
def test_a_controller_of_another_drive_train_is_refused(
    tmp_path: Path, cell: Cell, plan: CampaignPlan, old: str, new: str, named: str
) -> None:
    wrong = written(cell, old, new)
    campaign = Campaign.create(tmp_path / "init", wrong, plan)
    link = VirtualLink.over(SimulatedTransport(simulated_controller(cell)), wrong)
    with pytest.raises(ControllerError, match=f"cannot be used: .*{named}"):
        execute(campaign, link)
    assert not list(campaign.folder.archives.iterdir())


def test_a_real_link_is_not_driven_from_the_archives_thread(cell: Cell) -> None:
    class Wire:
        now = 0.0

    with pytest.raises(TypeError, match="Wire is not virtual time"):
        VirtualLink.over(Wire(), cell)  # type: ignore[arg-type]


def test_what_the_arm_does_after_a_refusal_is_recorded(
    tmp_path: Path, cell: Cell, plan: CampaignPlan
) -> None:
    """The controller closes open mode at once; the arm needs longer to come to rest."""
    arm = Arm.made(tmp_path, cell, plan, Lose(600, "to_controller"))
    with pytest.raises(MotionFailedError, match=r"move 1 \(move_000_a1\.mcap\) was lost: "):
        execute(arm.campaign, arm.link)
    archive = open_archive(arm.campaign.folder.archives / "move_000_a1.mcap")
    (ended,) = (event for event in archive.events if event.name == "MotionEnded")
    last = archive.columns["cycle"][-1] * arm.campaign.cell.period
    assert last - ended.time == pytest.approx(0.5, abs=0.002)
    assert np.abs(archive.columns["velocity"][-1]).max() < 0.01


def test_a_refusal_has_names_and_fields_of_the_cell_file(
    tmp_path: Path, cell: Cell, plan: CampaignPlan
) -> None:
    """A wrong position is received: both the line at once and the error name joint and field."""
    arm = Arm.made(tmp_path, cell, plan, Corrupt(600, offset=27, mask=0x40))
    lines = list[str]()
    reporter = Silent()
    reporter.say = lines.append  # type: ignore[method-assign]
    with pytest.raises(MotionFailedError, match="was refused: following error of") as failed:
        arm.campaign.run(arm.link, Stop(), reporter, unrehearsed=True)
    text = failed.value.reason
    assert text.startswith(f"following error of {cell.joint_names[0]} is ")
    assert messages.SET_BY_FOLLOWING_ERROR in text
    error = failed.value.refused.error
    assert f"REFUSED: {text}; {error.remedy}" in lines


def test_a_refusal_shows_degrees_in_the_frame_of_the_limits(cell: Cell) -> None:
    """Those of the teach pendant here, where joint 3 has another sense and zero position."""
    pendant = AngleFrame.of(cell)
    value = np.radians(100.0)
    bound = np.radians(90.0) * (1.0 + 1e-7)
    shown = [pendant.shown(np.full(6, angle))[2] for angle in (value, bound)]
    for check, text in (
        (Check.VELOCITY, "100 °/s; allowed is 90 °/s, set by [limits] velocity_deg"),
        (Check.POSITION, f"{shown[0]:.9g} °; allowed is {shown[1]:.6g} °, set by [limits] lower"),
    ):
        error = GuardError(check, 2, value, bound, 7)
        named = f"{check.quantity} of {cell.joint_names[2]} is {text}"
        assert refusal_text(cell, error).startswith(named)
    assert pendant.name == "controller" and shown[0] != pytest.approx(100.0)


@pytest.mark.parametrize(
    "error", [MemoryError("none left"), ArchiveWriteError(None, "no space left on device")]
)
def test_the_arm_comes_to_rest_when_archiving_fails(
    arm: Arm, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    write = ArchiveWriter.write
    speeds = list[float]()

    def failing(writer: ArchiveWriter, *arguments: Any) -> None:
        speeds.append(arm.speed)
        if arm.speed > 0.5:
            raise error
        write(writer, *arguments)

    monkeypatch.setattr(ArchiveWriter, "write", failing)
    with pytest.raises(type(error), match=str(error)):
        execute(arm.campaign, arm.link)
    assert arm.speed < 1e-3
    assert sum(speed > 0.5 for speed in speeds) == 1, "nothing is archived after that"
    assert arm.campaign.folder.manifest() == []


def test_a_plan_that_changed_since_is_refused(arm: Arm) -> None:
    plan = arm.campaign.folder.plan
    plan.write_text(plan.read_text("utf-8").replace('"seed": 1', '"seed": 2'), "utf-8")
    with pytest.raises(NotRehearsedError, match=r"plan\.json is not the one"):
        execute(Campaign.open(arm.campaign.folder.root))


WEAK = [16.5, 6.0, 9.5, 3.5, 7.0, 10.0]


def shifted(motion: PiecewiseCubic, joint: int | None, by: float) -> PiecewiseCubic:
    """A motion with one joint, or all of them, moved by an angle [rad]."""
    return PiecewiseCubic(
        motion.knots,
        tuple(
            np.column_stack([c[:, 0] + by * (joint in (None, j)), c[:, 1:]])
            for j, c in enumerate(motion.coefficients)
        ),
    )


@pytest.mark.parametrize(
    ("change", "line", "message"),
    [
        pytest.param(lambda m: shifted(m, None, 0.01), None, "validation 1 .* begins with joint",
                     id="jump"),
        pytest.param(lambda m: PiecewiseCubic(m.knots[:5], m.coefficients[:5]), None,
                     "for 5 joints, the arm has 6", id="another arm"),
        pytest.param(lambda m: shifted(m, 1, 4.0), None,
                     r"validation 1 was not sent: .*position of J2", id="beyond limits"),
        pytest.param(lambda m: m, {"workspace.floor": 1.0}, "collision of .*floor",
                     id="into the floor"),
        pytest.param(lambda m: m, {"drive_train.current_limit": WEAK},
                     "current of motor of joint_2", id="weak motors"),
    ],
)  # fmt: skip
def test_a_plan_that_can_never_run_becomes_no_folder(
    tmp_path: Path,
    cell: Cell,
    plan: CampaignPlan,
    change: Callable[[Any], PiecewiseCubic],
    line: dict[str, Any] | None,
    message: str,
) -> None:
    changed = PlannedMotion(change(plan.validation[0].trajectory))
    bad = replace(plan, validation=(changed,)) if line is None else plan
    with pytest.raises(MotionRefusedError, match=message):
        Campaign.create(tmp_path / "bad", cell if line is None else cell.with_values(line), bad)
    assert not list(tmp_path.iterdir())


def test_an_older_folder_with_a_collision_is_refused(
    tmp_path: Path, cell: Cell, plan: CampaignPlan, monkeypatch: pytest.MonkeyPatch
) -> None:
    raised = written(cell, "floor = 0.0", "floor = 1.0")
    with monkeypatch.context() as once:
        once.setattr(state_module, "require_runnable", lambda *arguments: None)
        campaign = Campaign.create(tmp_path / "floor", raised, plan)
    with pytest.raises(MotionRefusedError, match=r"standstill 1 .*collision of .*floor.*home_deg"):
        execute(campaign)
    assert not list(campaign.folder.archives.iterdir())


def test_only_a_move_from_the_arm_asks_for_jogging(cell: Cell, plan: CampaignPlan) -> None:
    low = cell.home + np.array([0.0, 1.6, -1.5, 0.0, 0.0, 0.0])
    motions = planned_motions(cell, plan)
    joined = CheckedMoves(cell, MotionChecks.of(cell)).with_moves(motions, low)
    assert [motion.from_arm for motion in joined if motion.kind == "move"] == [True, True]
    buried = MotionChecks.of(written(cell, "floor = 0.0", "floor = 0.3"))
    with pytest.raises(MotionRefusedError, match=r"move 1 .*jog the arm"):
        CheckedMoves(cell, buried).with_moves(motions, low)
    wild = CampaignMotion("excitation", 0, rest(cell.home + 10.0, 1.0))
    with pytest.raises(MotionRefusedError, match=r"repetition 1 .*; design another motion\."):
        require_allowed([wild], buried)


def test_a_folder_without_a_campaign_is_named(tmp_path: Path) -> None:
    with pytest.raises(CampaignFolderError, match=NO_CAMPAIGN_FOLDER):
        Campaign.open(tmp_path)


class TestPlan:
    """`plan.json`, and what of it is in the archives."""

    def test_it_is_restored_to_the_bit_with_what_it_was_made_of(self, campaign: Campaign) -> None:
        assert CampaignPlan.load(campaign.folder.plan).to_text() == campaign.plan.to_text()
        file, _ = stored_plan(campaign, "validation_000_a1.mcap")
        settings = campaign.cell.campaign
        assert len(file.moves) == settings.n_via + 1
        assert {move.fly_percent for move in file.moves} == {100.0 * settings.fly}
        speeds = {tuple(np.asarray(move.joint_speed)) for move in file.moves}
        assert len(speeds) == 1 and len(set(speeds.pop())) == campaign.cell.joint_limits.n_joints

    @pytest.mark.parametrize("motion", ["excitation_000", "validation_001", "move_000"])
    def test_moves_in_an_archive_plan_to_its_motion(self, campaign: Campaign, motion: str) -> None:
        file, planned = stored_plan(campaign, f"{motion}_a1.mcap")
        assert file.joint_names == campaign.cell.joint_names
        assert replace(file, trajectory=None).plan().trajectory.to_dict() == planned.to_dict()
        assert file.plan().trajectory.to_dict() == planned.to_dict()

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"format_version": 3}, "format version 3"),
            ({"moves": 7}, NO_CAMPAIGN_PLAN),
            ({"moves": {"format": "joint motion plan"}}, NO_CAMPAIGN_PLAN),
            ({"moves": {"format": "other"}}, NO_CAMPAIGN_PLAN),
        ],
    )
    def test_other_content_is_refused(
        self, tmp_path: Path, plan: CampaignPlan, change: dict[str, object], message: str
    ) -> None:
        path = tmp_path / "plan.json"
        path.write_text(json.dumps(json.loads(plan.to_text()) | change))
        with pytest.raises(InputError, match=message):
            CampaignPlan.load(path)


def stored_plan(campaign: Campaign, name: str) -> tuple[PlanFile, PiecewiseCubic]:
    """The plan file that an archive carries, and the motion that stands beside its moves."""
    text = open_archive(campaign.folder.archives / name).attachments["plan.json"].decode()
    assert text.count('"knots"') == 1, "the motion is stored once"
    stored = json.loads(text)
    motion = stored.get("excitation", stored)["trajectory"]
    file = PlanFile.from_dict(stored["moves"] | {"motion": motion})
    return file, PiecewiseCubic.from_dict(motion)


def test_a_solver_that_crashes_ends_the_campaign_only(
    arm: Arm, monkeypatch: pytest.MonkeyPatch
) -> None:
    def crashing(*arguments: object, **settings: object) -> None:
        raise PlannerCrashed(-11)

    monkeypatch.setattr("hil.control.motions.in_child", crashing)
    with pytest.raises(PlannerCrashed, match="signal 11"):
        execute(arm.campaign, arm.link)
    assert arm.campaign.folder.manifest() == []


def test_an_override_changes_as_fast_as_the_bounds_allow(cell: Cell) -> None:
    old = "acceleration = 1.3, jerk = 1.7"
    new = "acceleration = 1.05, jerk = 1.1"
    narrow = written(cell, f"override = {{ {old} }}", f"override = {{ {new} }}")
    limits = cell.joint_limits
    motion = plan_moves(cell.home + 0.5, (Move(cell.home, speed=0.1),), limits).trajectory
    slowed = []
    for player in (
        player_of(narrow, motion),
        TrajectoryPlayer(
            motion, cell.period, limits, override_acceleration=1.05, override_jerk=1.1
        ),
        player_of(cell, motion),
    ):
        player.begin(player.start)
        before = [player.advance()[0] for _ in range(200)]
        player.override(0.3)
        slowed.append(np.array(before + [player.advance()[0] for _ in range(300)]))
    np.testing.assert_array_equal(slowed[0], slowed[1])
    assert np.max(np.abs(slowed[0] - slowed[2])) > 1e-3
