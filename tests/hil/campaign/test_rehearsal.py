"""A rehearsal: the plan on a simulated copy of the cell."""

from __future__ import annotations

import json
import os
import re
import shlex
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner

from drivers.drive_train import DriveTrain
from drivers.transports.simulated import Lose
from hil.archive import open_archive
from hil.base.errors import ExecutionError, OperatorStopError
from hil.base.progress import Silent, Task
from hil.campaign import Campaign, CampaignPlan, NotRehearsedError, Stop, rehearsal_criteria
from hil.campaign.folder import CampaignFolder
from hil.campaign.gates import require_rehearsed
from hil.campaign.identified_campaign import identify_campaign
from hil.campaign.rehearsal_criteria import (
    FALSE_ALARM,
    judgement_of,
    largest_deviation,
    of_currents,
    of_motions,
)
from hil.campaign.rehearsal_messages import criterion_record
from hil.campaign.rehearsal_record import AS_MODELLED, CRITERIA, Rehearsal
from hil.campaign.simulated_sessions import result_of
from hil.campaign.twin import (
    MAX_RESONANCE,
    PARAMETER_SPREAD,
    Twin,
    link_faults,
    too_far_without_a_packet,
)
from hil.cell import Cell
from hil.cell.toml_edits import with_values
from hil.cli import app
from identification.distributions import NORMAL_95, student_limit, student_tail
from planner import Move, plan_moves
from planner.worker import WorkerProcess
from sim_fixtures.plant import ElasticPlant, PlantTruth
from tests import messages
from tests.hil.fast_cell import CELL, URDF, fast_campaign, fast_cell
from tests.hil.new_cells import described_robot, filled_in

pytestmark = pytest.mark.long

GEARS = """
[simulation.drive_train]
gear_ratio = [100.0, -80.0]
joint_sign = [1, -1]
joint_offset_deg = [0.0, 10.0]
"""


def cell_of(folder: Path, text: str, urdf: str = URDF) -> Cell:
    (folder / "fast.urdf").write_text(urdf)
    (folder / "cell.toml").write_text(text)
    return Cell.load(folder / "cell.toml")


@pytest.fixture(scope="module")
def designed(tmp_path_factory: pytest.TempPathFactory) -> Campaign:
    """A campaign that was rehearsed; tests only read it."""
    folder = tmp_path_factory.mktemp("designed")
    campaign = fast_campaign(folder / "campaign", fast_cell(folder), rehearsed=False)
    campaign.rehearse()
    return campaign


def test_a_good_plan_on_a_right_cell_passes_every_criterion(designed: Campaign) -> None:
    """With noise and a faulty link."""
    rehearsal = Rehearsal.load(designed.folder)
    assert rehearsal is not None and rehearsal.passed and not rehearsal.failures
    assert rehearsal.plan_hash == designed.folder.plan_hash
    assert [criterion.name for criterion in rehearsal.criteria] == [*CRITERIA]
    require_rehearsed(designed.folder)
    twin = Campaign.open(designed.folder.rehearsed / "plain")
    assert twin.plan.to_text() == designed.plan.to_text()
    assert len(twin.folder.completed("excitation")) == 3
    assert len(twin.folder.completed("validation")) == len(designed.plan.validation)
    archives = [open_archive(twin.folder.archives / e.name) for e in twin.folder.manifest()]
    assert all(archive.header.entries["rehearsal"] == "yes" for archive in archives)
    assert sum(int(archive.columns["gap"].sum()) for archive in archives) > 0


@pytest.mark.parametrize("freedom", [4.0, 44.0, np.inf])
@pytest.mark.parametrize("count", [1, 58])
def test_a_correct_cell_fails_by_its_parameters_once_in_1000(count: int, freedom: float) -> None:
    factor = float(student_limit(0.025, freedom))
    allowed = largest_deviation(count, factor) * factor / NORMAL_95
    each = 2.0 * float(student_tail(allowed, freedom))
    assert 1.0 - (1.0 - each) ** count == pytest.approx(FALSE_ALARM, rel=1e-3)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_simulated_parameters_are_within_a_tenth_of_nominal(designed: Campaign, seed: int) -> None:
    twin = Twin.of(designed.cell, seed=seed, repetitions=3)
    nominal = designed.cell.nominal_values()
    stated = nominal != 0.0
    apart = np.abs(twin.truth[stated] / nominal[stated] - 1.0)
    # Each base parameter of this arm is a sum of figures of one sign, or of one figure.
    assert np.all(apart <= PARAMETER_SPREAD + 1e-12)
    assert np.all(apart > 0.0)
    assert np.all(twin.truth[~stated] == 0.0)
    other = Twin.of(designed.cell, seed=seed + 10, repetitions=3)
    assert not np.array_equal(other.truth, twin.truth)


def moving(designed: Campaign, degrees: tuple[float, float], speed: float) -> CampaignPlan:
    """A plan whose excitation goes to a posture and back."""
    cell = designed.cell
    home = designed.cell.home
    moves = (Move(home + np.radians(degrees), speed=speed), Move(home, speed=speed))
    trajectory = plan_moves(home, moves, cell.joint_limits).trajectory
    excitation = replace(designed.plan.excitation, trajectory=trajectory)
    return replace(designed.plan, excitation=excitation, moves=None)


@pytest.mark.parametrize(
    ("right", "wrong"),
    [
        ("joint_sign = [1, -1]", "joint_sign = [-1, -1]"),
        ("gear_ratio = [100.0, -80.0]", "gear_ratio = [-100.0, -80.0]"),
        ("gear_ratio = [100.0, -80.0]", "gear_ratio = [100.0, 80.0]"),
        ("torques", "of the wrong sign on our side"),
        ("excitation", "tiny and slow"),
        ("excitation", "one joint only"),
        ("current_limit = [20.0, 12.0]", "nearly too weak"),
    ],
)
def test_a_wrong_cell_or_plan_fails(
    tmp_path: Path, designed: Campaign, monkeypatch: pytest.MonkeyPatch, right: str, wrong: str
) -> None:
    """The simulated arm shares no conversion with the PC, so that a sign cannot cancel."""
    cell = designed.cell
    plan = designed.plan
    expected = {"parameters"}
    match wrong:
        case "of the wrong sign on our side":
            # The residuals are so large that the intervals of the parameters become wide.
            expected = {"unseen motion"}
            honest = DriveTrain.joint_torque
            monkeypatch.setattr(
                DriveTrain,
                "joint_torque",
                lambda train, current: honest(train, current) * [1.0, -1.0],
            )
        case "tiny and slow" | "one joint only":
            poor = ((1.0, 1.0), 0.02) if wrong == "tiny and slow" else ((0.0, 40.0), 1.0)
            plan = moving(designed, *poor)
            expected = {"excitation", "unseen motion"}
        case "nearly too weak":
            good = Rehearsal.load(designed.folder)
            (share,) = (c.value for c in good.criteria if c.name == "current (as modelled)")
            text = CELL.replace(right, f"current_limit = {[20.0 * share / 0.85, 12.0]}")
            cell = cell_of(tmp_path, text)
            expected = {"current (as modelled)"}
        case _:
            cell = cell_of(tmp_path, CELL.replace(right, wrong, 1) + GEARS)
            expected = set()
    campaign = Campaign.create(tmp_path / "campaign", cell, plan)
    rehearsal = campaign.rehearse()
    failed = {criterion.name for criterion in rehearsal.criteria if not criterion.passed}
    assert not rehearsal.passed
    assert failed & expected if expected else failed, rehearsal.failures
    if wrong == "nearly too weak":
        assert failed == expected
    with pytest.raises(NotRehearsedError, match="failed its rehearsal"):
        require_rehearsed(campaign.folder)


@pytest.mark.parametrize("cycle_ms", [1, 4])
def test_it_passes_at_any_cycle(tmp_path: Path, designed: Campaign, cycle_ms: int) -> None:
    """At 2 ms: above."""
    assert designed.cell.controller.cycle_ms == 2
    cell = cell_of(tmp_path, CELL.replace("cycle_ms = 2", f"cycle_ms = {cycle_ms}"))
    rehearsal = Campaign.create(tmp_path / "campaign", cell, designed.plan).rehearse()
    assert rehearsal.passed, rehearsal.failures


@pytest.mark.parametrize(
    ("cycle_ms", "changes", "survives"),
    [
        (2, {}, True),  # 0.22 revolutions
        (4, {}, False),  # 0.44
        (4, {"drive_train.following_error": [2.0, 2.0]}, True),
        (4, {"limits.velocity_deg": [200.0, 240.0]}, True),
    ],
)
def test_packets_are_lost_where_a_motion_survives_it(
    designed: Campaign, cycle_ms: int, changes: dict[str, list[float]], survives: bool
) -> None:
    cell = designed.cell.with_values({"controller.cycle_ms": cycle_ms, **changes})
    lost = [each for each in link_faults(cell, 300.0, seed=1) if isinstance(each, Lose)]
    assert bool(lost) is survives
    limit = too_far_without_a_packet(cell)
    if survives:
        assert limit is None
    else:
        assert limit is not None
        assert (limit.motor, limit.cycle_ms) == ("shoulder", 4)
        assert limit.turns == pytest.approx(0.44, abs=0.005) and limit.turns > limit.allowed
        assert limit in Twin.of(cell, seed=1, repetitions=3).assumed


@pytest.mark.parametrize(
    ("row", "share", "passed"), [(1, 0.9, True), (1, 0.995, False), (2, 0.9, False)]
)
def test_a_lost_packet_is_not_the_motion(
    designed: Campaign, monkeypatch: pytest.MonkeyPatch, row: int, share: float, passed: bool
) -> None:
    """The current with which the controller comes back in two cycles counts if it saturates."""
    twin = Campaign.open(designed.folder.rehearsed / "plain")
    limit = twin.cell.drive_train.current_limit

    def with_a_loss(path: Path) -> SimpleNamespace:
        columns = {name: values.copy() for name, values in open_archive(path).columns.items()}
        columns["gap"][100] = 1
        columns["target_current"][100 + row] = share * limit
        return SimpleNamespace(columns=columns)

    monkeypatch.setattr(rehearsal_criteria, "open_archive", with_a_loss)
    judged = of_currents(twin.cell, twin.folder, AS_MODELLED, 0.8)
    assert judgement_of(judged).passed is passed


@pytest.mark.parametrize(
    ("changes", "frequency"),
    [
        ({"simulation.delay": 0.008}, range(20, 31)),
        ({"simulation.delay": 0.006, "simulation.elasticity": [2e-5, 2e-5]}, range(50, 71)),
    ],
)
def test_an_unstable_servo_is_named_with_commands_that_work(
    tmp_path: Path, designed: Campaign, changes: dict[str, object], frequency: range
) -> None:
    cell = designed.cell.with_values(changes)
    unstable = Campaign.create(tmp_path / "unstable", cell, designed.plan)
    failures = unstable.rehearse().failures
    assert len(failures) == 2, "motion and current"
    for sentence in failures:
        match = re.search(r"oscillates at (\d+) Hz, with an amplitude that grows", sentence)
        assert match is not None and int(match[1]) in frequency
        assert messages.MOTION_NOT_AT_FAULT in sentence
        command = shlex.split(sentence.split("`")[-2])
        assert command[:2] == ["hil", "plot"] and command[-2] == "--joint"
        plotted = CliRunner().invoke(app, [*command[1:], "-o", str(tmp_path / "x.png")])
        assert plotted.exit_code == 0

    text = unstable.folder.cell.read_text()
    corrected = {"simulation.delay": 0.0005, "simulation.elasticity": []}
    unstable.folder.cell.write_text(with_values(text, corrected))
    assert Campaign.open(unstable.folder.root).rehearse().passed


def test_a_motion_beyond_a_speed_limit_is_no_completed_one(designed: Campaign) -> None:
    plain = CampaignFolder(designed.folder.rehearsed / "plain")
    assert judgement_of(of_motions(designed.cell, plain, AS_MODELLED, "")).passed
    velocity = [0.7 * speed for speed in designed.cell.file.limits.velocity_deg]
    slow = designed.cell.with_values({"limits.velocity_deg": velocity})
    criterion = criterion_record(of_motions(slow, plain, AS_MODELLED, ""), slow)
    assert not criterion.passed
    assert "of its speed limit" in criterion.sentence and "hil plot" in criterion.sentence


def test_a_refused_motion_names_the_tables_to_correct(designed: Campaign) -> None:
    plain = CampaignFolder(designed.folder.rehearsed / "plain")
    failed = of_motions(designed.cell, plain, "plain", "move 2 was refused")
    sentence = criterion_record(failed, designed.cell).sentence
    assert "plain: move 2 was refused: correct the cause, by [limits]" in sentence
    for table in ("[drive_train]", "[nominal]", "[controller]", "[simulation]"):
        assert table in sentence
    assert "`hil plot " in sentence


def test_a_cell_of_hardware_is_rehearsed_from_nominal_figures(
    tmp_path: Path, designed: Campaign
) -> None:
    text = CELL[: CELL.index("[simulation]")].replace('"simulated"', '"udp"')
    campaign = Campaign.create(tmp_path / "campaign", cell_of(tmp_path, text), designed.plan)
    rehearsal = campaign.rehearse()
    assert rehearsal.passed, rehearsal.failures
    assert any("noise of" in sentence for sentence in rehearsal.assumed)
    assert any("joint_sign" in sentence for sentence in rehearsal.not_seen)
    assert campaign.cell.controller.transport == "udp"


def test_a_report_of_the_archives_has_the_true_parameters(
    designed: Campaign,
) -> None:
    identification = identify_campaign(designed.folder.rehearsed / "plain", Silent())
    twin = Twin.of(designed.cell, seed=1, repetitions=3)
    truths = [
        parameter.truth
        for parameter in identification.results.parameters
        if parameter.truth is not None
    ]
    assert truths == twin.truth.tolist()


class StopsAfter(Silent):
    """A reporter that asks for a stop as soon as something was recorded."""

    def __init__(self, stop: Stop) -> None:
        self.stop = stop

    @contextmanager
    def task(self, title: str, total: float) -> Iterator[Task]:
        yield Task(lambda *_: setattr(self.stop, "requested", True))


def test_a_stopped_rehearsal_replaces_no_passed_one(tmp_path: Path, designed: Campaign) -> None:
    campaign = Campaign.create(tmp_path / "campaign", designed.cell, designed.plan)
    stop = Stop()
    with pytest.raises(OperatorStopError, match="rehearse again"):
        campaign.rehearse(stop=stop, reporter=StopsAfter(stop))
    assert Rehearsal.load(campaign.folder) is None
    assert campaign.rehearse().passed
    written = campaign.folder.rehearsal.stat().st_mtime_ns
    assert campaign.rehearse().passed
    assert campaign.folder.rehearsal.stat().st_mtime_ns == written


def test_one_seed_is_one_bit_identical_rehearsal(tmp_path: Path, designed: Campaign) -> None:
    """Also of the run in the second process."""
    campaign = Campaign.create(tmp_path / "campaign", designed.cell, designed.plan)
    campaign.rehearse()
    for run in ("plain", "effects"):
        first, again = (
            {path.name: path.read_bytes() for path in folder.glob(f"{run}/archives/*.mcap")}
            for folder in (designed.folder.rehearsed, campaign.folder.rehearsed)
        )
        assert first
        assert first == again


def test_of_a_failed_run_as_modelled_nothing_else_is_left(tmp_path: Path) -> None:
    cell = cell_of(tmp_path, CELL.replace("gear_ratio = [100.0", "gear_ratio = [-100.0") + GEARS)
    campaign = fast_campaign(tmp_path / "campaign", cell, rehearsed=False)
    assert not campaign.rehearse().passed
    assert [path.name for path in campaign.folder.rehearsed.iterdir()] == ["plain"]


def test_a_rehearsal_is_stopped_while_the_second_run_goes_on() -> None:
    with WorkerProcess(timeout=60.0) as child:
        child.begin(time.sleep, 30.0)
        with pytest.raises(OperatorStopError, match="rehearse again"):
            result_of(child, Stop(requested=True), "the rehearsal", "rehearse again")


def test_a_second_run_that_was_killed_is_no_verdict() -> None:
    with WorkerProcess(timeout=60.0) as child:
        child.begin(os.abort)
        with pytest.raises(ExecutionError, match="second simulated arm ended"):
            result_of(child, Stop(), "the rehearsal", "rehearse again")


def test_the_command_is_the_method_with_exit_codes(designed: Campaign, tmp_path: Path) -> None:
    runner = CliRunner()
    good = runner.invoke(app, ["rehearse", str(designed.folder.root), "--json"])
    assert good.exit_code == 0
    stored = Rehearsal.load(designed.folder)
    assert Rehearsal.model_validate_json(good.stdout) == stored
    cell = cell_of(tmp_path, CELL.replace("gear_ratio = [100.0", "gear_ratio = [-100.0") + GEARS)
    Campaign.create(tmp_path / "campaign", cell, designed.plan)
    bad = runner.invoke(app, ["rehearse", str(tmp_path / "campaign"), "--json"])
    assert bad.exit_code == 5
    printed = json.loads(bad.stdout)
    assert not printed["passed"]
    assert "gear ratio" in printed["criteria"][0]["sentence"]


# --- A rehearsal of an arm with seven joints, two of whose main axes are almost parallel

HOME = [0.0, -30.0, 0.0, -120.0, 0.0, 90.0, 0.0]
FOUR = [2.0] * 4
THREE = [1.0] * 3


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Cell:
    """The Panda as `hil new` writes it, with assumed unpublished values."""
    path = tmp_path_factory.mktemp("seven") / "cell.toml"
    urdf = described_robot("panda_description/urdf/panda.urdf")
    CliRunner().invoke(app, ["new", "--urdf", str(urdf), "-o", str(path)], catch_exceptions=False)
    path.write_text(
        filled_in(
            path, 7, campaign__home_deg=HOME, workspace__margin=0.002, limits__torque=[],
            limits__lower_deg=[angle - 50.0 for angle in HOME],
            limits__upper_deg=[angle + 40.0 for angle in HOME],
            limits__velocity_deg=[120.0] * 7, limits__acceleration_deg=[500.0] * 7,
            limits__jerk_deg=[8000.0] * 7,
            nominal__rotor_inertia=[0.6, 0.6, 0.5, 0.5, 0.2, 0.2, 0.2],
            nominal__coulomb=FOUR + THREE, nominal__viscous=FOUR + THREE,
        )
    )  # fmt: skip
    return Cell.load(path).with_campaign(repetitions=3, validation_runs=2)


def test_springs_of_the_twin_suit_axes_that_carry_each_other(cell: Cell) -> None:
    """The plant itself, without gravity, friction and servo: energy put into the springs stays."""
    given = Twin.of(cell, seed=1, repetitions=1).cell.file.simulation
    compliance = np.array(given.elasticity)
    none = np.zeros(7)
    assert (compliance[:3] > 0.0).all() and not compliance[3:].any()
    step = 0.5 * cell.period
    assert MAX_RESONANCE * step <= 1.0
    for angles in (HOME, [0.0, 0.0, 0.0, -90.0, 0.0, 40.0, 0.0]):
        plant = ElasticPlant(
            cell.urdf,
            PlantTruth(np.array(given.rotor_inertia), none, none, none),
            elasticity=compliance,
            gravity=np.zeros(3),
            position=np.radians(angles),
            step=step,
        )
        plant.step(np.full(7, 1.0), step)
        before = plant.energy()
        for _ in range(4000):
            plant.step(np.zeros(7), step)
        assert plant.energy() < 2.0 * before
