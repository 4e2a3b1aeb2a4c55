"""A campaign: checked before it moves, archived once, deterministic, resumable."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.states import State
from drivers.transports.faults import Lose
from drivers.transports.simulated import SimulatedTransport
from hil.archive import ArchiveName, ArchiveWriter, open_archive
from hil.campaign import (
    Campaign,
    CampaignFolderError,
    CampaignPlan,
    Link,
    MotionFailedError,
    MotionRefusedError,
    NotRehearsedError,
    PlannedMotion,
    Stop,
)
from hil.campaign import campaign as campaign_module
from hil.campaign.intervals import Interval, hold, require_sound, wanted, with_moves
from hil.cell import Cell
from hil.errors import ArchiveWriteError, ControllerFault, InputError
from hil.motion_checks import MotionChecks
from hil.progress import Silent, Task
from hil.simulation import simulated_controller, simulated_link, simulated_provenance
from planner import (
    FlyPercent,
    Move,
    PiecewiseCubic,
    PlanFile,
    PlannerCrashed,
    TrajectoryPlayer,
    plan_moves,
)

Run = Callable[..., Campaign]


def digests(campaign: Campaign) -> dict[str, str]:
    """Checksum of every archive by name."""
    return {
        path.name: hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(campaign.folder.archives.glob("*.mcap"))
    }


def execute(campaign: Campaign, stop: Stop | None = None) -> None:
    provenance = simulated_provenance(campaign.cell, False)
    campaign.run(
        simulated_link(campaign.cell),
        stop or Stop(),
        Silent(),
        provenance=provenance,
        durable=False,
        unrehearsed=True,
    )


def one_repetition(cell: Cell, plan: CampaignPlan) -> tuple[Cell, CampaignPlan]:
    return cell.with_campaign(repetitions=1), replace(plan, validation=plan.validation[:1])


def test_every_interval_of_motion_is_one_archive(campaign: Campaign) -> None:
    names = [ArchiveName.parse(path) for path in campaign.folder.archives.glob("*.mcap")]
    kinds = sorted((name.kind, name.index) for name in names if name is not None)
    assert kinds == [
        *(("excitation", i) for i in range(3)),
        ("move", 0),
        ("move", 1),
        ("standstill", 0),
        *(("validation", i) for i in range(2)),
    ]


def test_an_archive_is_whole_in_itself(campaign: Campaign) -> None:
    archive = open_archive(campaign.folder.completed("excitation")[0])
    assert archive.complete
    assert set(archive.attachments) == {
        "cell.toml", "robot.urdf", "drive_train.json", "plan.json", "init_packet.bin"
    }  # fmt: skip
    assert archive.header.entries["simulated"] == "yes"
    assert archive.outcome is not None
    assert archive.outcome.entries["outcome"] == "completed"


def test_the_commanded_motion_is_the_planned_one_and_keeps_the_limits(campaign: Campaign) -> None:
    archive = open_archive(campaign.folder.completed("excitation")[0])
    commanded = archive.columns["commanded_position"]
    commanded = commanded[~np.isnan(commanded).any(axis=1)]
    trajectory, period = campaign.plan.excitation.trajectory, campaign.cell.period
    planned, _, _ = trajectory.sample(np.arange(len(commanded)) * period)
    # The first set-point is the controller's own float32 target, and its offset is kept.
    assert commanded == pytest.approx(planned, abs=2e-6)
    limits = campaign.cell.joint_limits
    velocity = np.diff(commanded, axis=0) / period
    assert np.all(np.abs(velocity) <= limits.velocity * (1 + 1e-6))


def test_the_arm_follows_and_returns_to_where_it_was(campaign: Campaign) -> None:
    first = open_archive(campaign.folder.archives / "move_000_a1.mcap")
    last = open_archive(campaign.folder.archives / "move_001_a1.mcap")
    before, after = first.columns["target_position"][0], last.columns["target_position"][-1]
    assert after == pytest.approx(before, abs=2e-6)
    # Stiction keeps the arm itself some encoder counts away from the target.
    assert last.columns["position"][-1] == pytest.approx(after, abs=5e-3)


def test_an_archive_holds_one_interval_in_open_mode_from_closed_to_closed(
    campaign: Campaign,
) -> None:
    for path in campaign.folder.archives.glob("*.mcap"):
        columns = open_archive(path).columns
        interval, state = columns["interval"], columns["state"]
        assert len(set(interval[interval >= 0])) == 1, path.name
        assert state[0] in (State.CLOSED, State.OPENING), path.name
        assert state[-1] == State.CLOSED, path.name


def test_archives_follow_each_other_without_a_lost_cycle(campaign: Campaign) -> None:
    files = [open_archive(campaign.folder.archives / e.name) for e in campaign.folder.manifest()]
    spans = [(f.columns["cycle"][0], f.columns["cycle"][-1]) for f in files]
    for (_, last), (first, _) in pairwise(spans):
        assert first == last + 1


def test_records_are_gap_free(campaign: Campaign) -> None:
    for path in campaign.folder.archives.glob("*.mcap"):
        assert np.all(np.diff(open_archive(path).columns["cycle"]) == 1), path.name


def test_one_seed_is_one_bit_identical_campaign(
    tmp_path: Path, cell: Cell, plan: CampaignPlan, run: Run
) -> None:
    short, motions = one_repetition(cell, plan)
    runs = [run(tmp_path / name / "same", short, motions) for name in ("a", "b")]
    assert digests(runs[0]) == digests(runs[1])


def test_a_stop_ends_the_motion_on_its_path_and_the_rest_is_resumed(
    tmp_path: Path, cell: Cell, plan: CampaignPlan
) -> None:
    short, motions = one_repetition(cell, plan)
    campaign = Campaign.create(tmp_path / "stopped", short, motions)
    controller = simulated_controller(short)
    link, stop = Link.over(SimulatedTransport(controller), short), Stop()
    advance = controller.accept

    def stop_at_speed(reply: bytes | None) -> None:
        advance(reply)
        stop.requested = stop.requested or bool(np.abs(controller.plant.velocity).max() > 1.0)

    controller.accept = stop_at_speed  # type: ignore[method-assign]
    with pytest.raises(MotionFailedError, match="stopped by the operator"):
        campaign.run(link, stop, Silent(), provenance={}, durable=False, unrehearsed=True)
    stopped = open_archive(campaign.folder.archives / "move_000_a1.mcap")
    assert stopped.complete
    assert stopped.outcome is not None
    assert stopped.outcome.entries["outcome"] == "stopped"
    assert np.abs(stopped.columns["velocity"][-1]).max() < 0.01  # three encoder counts a cycle

    again = Campaign.open(campaign.folder.root)
    execute(again)
    assert len(again.folder.completed("excitation")) == 1
    assert len(again.folder.completed("validation")) == 1


def test_a_stop_between_motions_begins_none(tmp_path: Path, cell: Cell, plan: CampaignPlan) -> None:
    campaign = Campaign.create(tmp_path / "between", *one_repetition(cell, plan))
    controller = simulated_controller(campaign.cell)
    link, stop = Link.over(SimulatedTransport(controller), campaign.cell), Stop()

    class StopAfterTheFirst(Silent):
        @contextmanager
        def task(self, title: str, total: float) -> Iterator[Task]:
            class Stopping:
                def advance(self, units: float, note: str = "") -> None:
                    stop.requested = True

            yield Stopping()

    with pytest.raises(MotionFailedError, match="it had not begun"):
        campaign.run(
            link, stop, StopAfterTheFirst(), provenance={}, durable=False, unrehearsed=True
        )
    assert [entry.name for entry in campaign.folder.manifest()] == ["move_000_a1.mcap"]


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("gear_ratio = [-116.0", "gear_ratio = [116.0", "gear ratio"),
        ("calibration = [0.25", "calibration = [29.25", "calibration"),
        ("k65 = 0.035", "k65 = -0.035", "k65"),
    ],
)
def test_a_controller_that_announces_another_drive_train_is_refused(
    tmp_path: Path, cell: Cell, plan: CampaignPlan, old: str, new: str, named: str
) -> None:
    assert old in cell.text
    wrong = Cell.from_texts(cell.text.replace(old, new), cell.urdf, cell.path)
    campaign = Campaign.create(tmp_path / "init", wrong, plan)
    link = Link.over(SimulatedTransport(simulated_controller(cell)), wrong)
    with pytest.raises(ControllerFault, match=f"cannot be used: .*{named}"):
        campaign.run(link, Stop(), Silent(), provenance={}, durable=False, unrehearsed=True)
    assert not list(campaign.folder.archives.iterdir())


def test_a_real_link_is_not_driven_from_the_archives_thread(cell: Cell) -> None:
    class Wire:
        now = 0.0

    with pytest.raises(TypeError, match="Wire is not virtual time"):
        Link.over(Wire(), cell)  # type: ignore[arg-type]


def test_a_stop_before_the_connection_moves_nothing(
    tmp_path: Path, cell: Cell, plan: CampaignPlan
) -> None:
    campaign = Campaign.create(tmp_path / "before", *one_repetition(cell, plan))
    with pytest.raises(ControllerFault, match="before anything moved"):
        execute(campaign, Stop(requested=True))
    assert not list(campaign.folder.archives.iterdir())


def test_what_the_arm_does_after_a_refusal_is_recorded(
    tmp_path: Path, cell: Cell, plan: CampaignPlan
) -> None:
    """The controller closes open mode at once; the arm needs longer to come to rest."""
    campaign = Campaign.create(tmp_path / "lost", *one_repetition(cell, plan))
    controller = simulated_controller(campaign.cell)
    lose = Lose(600, "to_controller")
    link = Link.over(SimulatedTransport(controller, [lose]), campaign.cell)
    with pytest.raises(MotionFailedError, match=r"move 1 \(move_000_a1\.mcap\) was lost: "):
        campaign.run(link, Stop(), Silent(), provenance={}, durable=False, unrehearsed=True)
    archive = open_archive(campaign.folder.archives / "move_000_a1.mcap")
    (ended,) = (event for event in archive.events if event.name == "MotionEnded")
    last = archive.columns["cycle"][-1] * campaign.cell.period
    assert last - ended.time == pytest.approx(0.5, abs=0.002)
    assert np.abs(archive.columns["velocity"][-1]).max() < 0.01


def test_whatever_goes_wrong_in_archiving_the_arm_comes_to_rest(
    tmp_path: Path, cell: Cell, plan: CampaignPlan, monkeypatch: pytest.MonkeyPatch
) -> None:
    campaign = Campaign.create(tmp_path / "memory", *one_repetition(cell, plan))
    controller = simulated_controller(campaign.cell)
    link = Link.over(SimulatedTransport(controller), campaign.cell)

    def failing(writer: ArchiveWriter, *arguments: object) -> None:
        if np.abs(controller.plant.velocity).max() > 0.5:
            raise MemoryError("none left")

    monkeypatch.setattr(ArchiveWriter, "write", failing)
    with pytest.raises(MemoryError):
        campaign.run(link, Stop(), Silent(), provenance={}, durable=False, unrehearsed=True)
    assert np.abs(controller.plant.velocity).max() < 0.01


def test_a_plan_that_changed_since_is_refused(
    tmp_path: Path, cell: Cell, plan: CampaignPlan
) -> None:
    campaign = Campaign.create(tmp_path / "changed", *one_repetition(cell, plan))
    text = campaign.folder.plan.read_text("utf-8")
    campaign.folder.plan.write_text(text.replace('"seed": 1', '"seed": 2'), "utf-8")
    with pytest.raises(NotRehearsedError, match=r"plan\.json is not the one"):
        execute(Campaign.open(campaign.folder.root))


def test_motions_that_do_not_join_are_refused_before_anything_moves(
    tmp_path: Path, cell: Cell, plan: CampaignPlan
) -> None:
    good = plan.validation[0].trajectory
    shifted = tuple(np.column_stack([c[:, 0] + 0.01, c[:, 1:]]) for c in good.coefficients)
    bad = replace(plan, validation=(PlannedMotion(PiecewiseCubic(good.knots, shifted)),))
    with pytest.raises(MotionRefusedError, match="validation 1 was not sent: it begins with joint"):
        Campaign.create(tmp_path / "jump", cell.with_campaign(validation_runs=1), bad)
    assert not list(tmp_path.iterdir()), "no folder is made for what can never run"


def test_a_motion_for_another_arm_is_refused(
    tmp_path: Path, cell: Cell, plan: CampaignPlan
) -> None:
    good = plan.validation[0].trajectory
    five = PiecewiseCubic(good.knots[:5], good.coefficients[:5])
    bad = replace(plan, validation=(PlannedMotion(five),))
    with pytest.raises(MotionRefusedError, match="for 5 joints, the arm has 6"):
        Campaign.create(tmp_path / "five", cell.with_campaign(validation_runs=1), bad)
    assert not list(tmp_path.iterdir()), "no folder is made for what can never run"


def test_a_torn_archive_is_not_among_the_completed(
    tmp_path: Path, cell: Cell, plan: CampaignPlan, run: Run
) -> None:
    campaign = run(tmp_path / "flipped", *one_repetition(cell, plan))
    (path,) = campaign.folder.completed("excitation")
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    assert campaign.folder.completed("excitation") == []


def test_what_is_whole_is_kept_and_what_is_torn_is_done_again(
    tmp_path: Path, cell: Cell, plan: CampaignPlan, run: Run
) -> None:
    short, motions = one_repetition(cell, plan)
    campaign = run(tmp_path / "torn", short, motions)
    kept = campaign.folder.completed("excitation")[0]
    before = kept.read_bytes()
    torn = campaign.folder.completed("validation")[0]
    torn.write_bytes(torn.read_bytes()[:-100])

    execute(Campaign.open(campaign.folder.root))

    assert kept.read_bytes() == before
    assert [p.name for p in campaign.folder.completed("validation")] == ["validation_000_a2.mcap"]
    assert torn.exists(), "nothing is ever overwritten"


def test_a_disk_that_refuses_brings_the_arm_to_rest_before_anything_else(
    tmp_path: Path, cell: Cell, plan: CampaignPlan, monkeypatch: pytest.MonkeyPatch
) -> None:
    campaign = Campaign.create(tmp_path / "full", *one_repetition(cell, plan))
    controller = simulated_controller(campaign.cell)
    link = Link.over(SimulatedTransport(controller), campaign.cell)
    write, calls = ArchiveWriter.write, []

    def refusing(writer: ArchiveWriter, *arguments: object) -> None:
        calls.append(np.abs(controller.plant.velocity).max())
        if len(calls) == 5:
            raise ArchiveWriteError(writer.path, "no space left on device")
        write(writer, *arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(ArchiveWriter, "write", refusing)
    with pytest.raises(ArchiveWriteError, match="no space left"):
        campaign.run(link, Stop(), Silent(), provenance={}, durable=False, unrehearsed=True)
    assert max(calls) > 0.1, "the arm was moving"
    assert np.abs(controller.plant.velocity).max() < 1e-3
    assert len(calls) == 5, "nothing was sent to be archived after that"
    assert campaign.folder.manifest() == []


def test_a_motion_outside_the_limits_is_refused_before_anything_moves(
    tmp_path: Path, cell: Cell, plan: CampaignPlan
) -> None:
    good = plan.validation[0].trajectory
    far = tuple(
        np.column_stack([c[:, 0] + (4.0 if j == 1 else 0.0), c[:, 1:]])
        for j, c in enumerate(good.coefficients)
    )
    bad = replace(plan, validation=(PlannedMotion(PiecewiseCubic(good.knots, far)),))
    with pytest.raises(MotionRefusedError, match=r"validation 1 was not sent: .*position of J2"):
        Campaign.create(tmp_path / "far", cell.with_campaign(validation_runs=1), bad)
    assert not list(tmp_path.iterdir()), "no folder is made for what can never run"


def test_a_motion_into_the_floor_is_refused_before_anything_moves(
    tmp_path: Path, cell: Cell, plan: CampaignPlan
) -> None:
    raised = Cell.from_texts(cell.text.replace("floor = 0.0", "floor = 1.0"), cell.urdf, cell.path)
    with pytest.raises(MotionRefusedError, match=r"collision of .*floor"):
        Campaign.create(tmp_path / "floor", raised, plan)
    assert not list(tmp_path.iterdir()), "no folder is made for what can never run"


def test_motors_that_are_too_weak_are_named_before_anything_moves(
    tmp_path: Path, cell: Cell, plan: CampaignPlan
) -> None:
    weak = Cell.from_texts(
        cell.text.replace("current_limit = [16.5, 22.0", "current_limit = [16.5, 6.0"),
        cell.urdf,
        cell.path,
    )
    with pytest.raises(MotionRefusedError, match="current of motor of joint_2"):
        Campaign.create(tmp_path / "weak", weak, plan)
    assert not list(tmp_path.iterdir()), "no folder is made for what can never run"


def test_an_older_folder_with_a_motion_that_must_not_be_sent_is_refused_before_anything_moves(
    tmp_path: Path, cell: Cell, plan: CampaignPlan, monkeypatch: pytest.MonkeyPatch
) -> None:
    raised = Cell.from_texts(cell.text.replace("floor = 0.0", "floor = 1.0"), cell.urdf, cell.path)
    with monkeypatch.context() as once:
        once.setattr(campaign_module, "require_runnable", lambda *arguments: None)
        campaign = Campaign.create(tmp_path / "floor", raised, plan)
    with pytest.raises(MotionRefusedError, match=r"standstill 1 .*collision of .*floor.*home_deg"):
        execute(campaign)
    assert not list(campaign.folder.archives.iterdir())


def test_only_where_the_way_from_the_arm_is_not_free_is_it_to_be_jogged(
    cell: Cell, plan: CampaignPlan
) -> None:
    low = cell.home + np.array([0.0, 1.6, -1.5, 0.0, 0.0, 0.0])
    ways = with_moves(cell, wanted(cell, plan), low)
    assert [way.from_arm for way in ways if way.kind == "move"] == [True, True]
    buried = MotionChecks.of(
        Cell.from_texts(cell.text.replace("floor = 0.0", "floor = 0.3"), cell.urdf, cell.path)
    )
    with pytest.raises(MotionRefusedError, match=r"move 1 .*jog the arm"):
        require_sound(ways, buried)
    wild = Interval("excitation", 0, hold(cell.home + 10.0, 1.0))
    with pytest.raises(MotionRefusedError, match=r"repetition 1 .*; design another motion\."):
        require_sound([wild], buried)


def test_a_folder_in_use_is_not_overwritten(campaign: Campaign) -> None:
    with pytest.raises(CampaignFolderError, match="is not empty"):
        Campaign.create(campaign.folder.root, campaign.cell, campaign.plan)


def test_a_damaged_manifest_and_a_foreign_folder_are_named(tmp_path: Path) -> None:
    with pytest.raises(CampaignFolderError, match="is not a campaign folder"):
        Campaign.open(tmp_path)


def test_the_plan_is_restored_to_the_bit(campaign: Campaign) -> None:
    again = CampaignPlan.load(campaign.folder.plan)
    assert json.dumps(again.excitation.to_dict()) == json.dumps(campaign.plan.excitation.to_dict())
    assert again.moves is not None and campaign.plan.moves is not None
    assert again.moves.to_dict() == campaign.plan.moves.to_dict()
    validation = [motion.to_dict() for motion in campaign.plan.validation]
    assert [motion.to_dict() for motion in again.validation] == validation


def stored_plan(campaign: Campaign, name: str) -> tuple[PlanFile, PiecewiseCubic]:
    """The plan file that an archive carries, and the motion that stands beside its moves."""
    text = open_archive(campaign.folder.archives / name).attachments["plan.json"].decode()
    assert text.count('"knots"') == 1, "the motion is stored once"
    stored = json.loads(text)
    motion = stored.get("excitation", stored)["trajectory"]
    file = PlanFile.from_dict(stored["moves"] | {"motion": motion})
    return file, PiecewiseCubic.from_dict(motion)


@pytest.mark.parametrize(
    "name",
    ["excitation_000_a1.mcap", "validation_001_a1.mcap", "move_000_a1.mcap", "move_001_a1.mcap"],
)
def test_the_moves_in_an_archive_plan_to_the_motion_that_was_run(
    campaign: Campaign, name: str
) -> None:
    file, motion = stored_plan(campaign, name)
    assert file.joint_names == campaign.cell.joint_names
    assert replace(file, trajectory=None).plan().trajectory.to_dict() == motion.to_dict()
    assert file.plan().trajectory.to_dict() == motion.to_dict()


def test_validation_keeps_the_via_points_the_speed_and_the_fly_it_was_drawn_with(
    campaign: Campaign,
) -> None:
    file, _ = stored_plan(campaign, "validation_000_a1.mcap")
    settings = campaign.cell.campaign
    assert len(file.moves) == settings.n_via + 1
    assert {move.fly for move in file.moves} == {FlyPercent(100.0 * settings.fly)}
    speeds = {tuple(np.asarray(move.joint_speed)) for move in file.moves}
    assert len(speeds) == 1 and len(set(speeds.pop())) == campaign.cell.joint_limits.n_joints


def test_a_plan_without_moves_of_an_earlier_version_is_read_and_run(
    tmp_path: Path, cell: Cell, plan: CampaignPlan, run: Run
) -> None:
    short, motions = one_repetition(cell, plan)
    old = {
        "format_version": 1,
        "excitation": motions.excitation.to_dict(),
        "validation": [motion.trajectory.to_dict() for motion in motions.validation],
    }
    path = tmp_path / "plan.json"
    path.write_text(json.dumps(old))
    read = CampaignPlan.load(path)
    assert read.moves is None and [motion.moves for motion in read.validation] == [None]
    campaign = run(tmp_path / "old", short, read)
    validation = open_archive(campaign.folder.completed("validation")[0])
    stored = json.loads(validation.attachments["plan.json"])
    assert stored == {"trajectory": motions.validation[0].trajectory.to_dict()}


def test_a_plan_that_knows_no_method_is_read(tmp_path: Path, plan: CampaignPlan) -> None:
    """Version 2: excitations came from a random search, without condition numbers."""
    path = tmp_path / "plan.json"
    plan.save(path)
    old = json.loads(path.read_text()) | {"format_version": 2}
    del old["excitation"]["method"]
    for name in ("condition", "scaled_condition"):
        del old["excitation"]["criteria"][name]
    path.write_text(json.dumps(old))
    read = CampaignPlan.load(path)
    assert read.excitation.method == "random"
    assert read.excitation.criteria.condition is None
    assert read.excitation.trajectory.to_dict() == plan.excitation.trajectory.to_dict()
    assert read.moves is not None
    path.write_text(json.dumps(old | {"format_version": 5}))
    with pytest.raises(InputError, match="format version 5"):
        CampaignPlan.load(path)


@pytest.mark.parametrize("moves", [7, {"format": "joint motion plan"}, {"format": "other"}])
def test_a_plan_with_unusable_moves_is_refused(
    tmp_path: Path, plan: CampaignPlan, moves: object
) -> None:
    path = tmp_path / "plan.json"
    plan.save(path)
    path.write_text(json.dumps(json.loads(path.read_text()) | {"moves": moves}))
    with pytest.raises(InputError, match="is not a campaign plan"):
        CampaignPlan.load(path)


def test_a_solver_that_crashes_on_the_way_home_ends_the_campaign_and_not_the_process(
    tmp_path: Path, cell: Cell, plan: CampaignPlan, monkeypatch: pytest.MonkeyPatch
) -> None:
    def crashing(*arguments: object, **settings: object) -> None:
        raise PlannerCrashed(-11)

    monkeypatch.setattr("hil.campaign.intervals.in_child", crashing)
    campaign = Campaign.create(tmp_path / "crash", *one_repetition(cell, plan))
    with pytest.raises(PlannerCrashed, match="signal 11"):
        execute(campaign)
    assert campaign.folder.manifest() == []


def overridden(player: TrajectoryPlayer) -> NDArray[np.float64]:
    """The set-points of a motion that is slowed to a third on its way."""
    player.begin(player.start)
    before = [player.advance()[0] for _ in range(200)]
    player.override(0.3)
    return np.array(before + [player.advance()[0] for _ in range(300)])


def test_an_override_changes_as_fast_as_the_cells_bounds_allow(
    tmp_path: Path, cell: Cell, plan: CampaignPlan
) -> None:
    written = "override = { acceleration = 1.3, jerk = 1.7 }"
    assert written in cell.text
    text = cell.text.replace(written, "override = { acceleration = 1.05, jerk = 1.1 }")
    careful = Cell.from_texts(text, cell.urdf, cell.path)
    campaign = Campaign.create(tmp_path / "careful", *one_repetition(careful, plan))

    class Taken(Exception):
        pass

    played: list[TrajectoryPlayer] = []
    link = simulated_link(campaign.cell)

    def take(player: TrajectoryPlayer, *rest: object, **options: object) -> None:
        played.append(player)
        raise Taken

    link.run = take  # type: ignore[method-assign, assignment]
    with pytest.raises(Taken):
        campaign.run(link, Stop(), Silent(), provenance={}, durable=False, unrehearsed=True)
    (ours,) = played
    limits = cell.joint_limits
    way = (Move(cell.home, speed=cell.campaign.approach_speed),)
    trajectory = plan_moves(ours.start, way, limits).trajectory
    careful_one, default = (
        TrajectoryPlayer(trajectory, cell.period, limits, **bounds)
        for bounds in ({"override_acceleration": 1.05, "override_jerk": 1.1}, {})
    )
    ramps = [overridden(player) for player in (ours, careful_one, default)]
    np.testing.assert_array_equal(ramps[0], ramps[1])
    assert np.max(np.abs(ramps[0] - ramps[2])) > 1e-3
