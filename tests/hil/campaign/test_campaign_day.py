"""A campaign: commands of its document, its script interface, conduct and status."""

from __future__ import annotations

import json
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import hil
from hil.base.progress import Silent
from hil.campaign import Campaign, CampaignFolderError, MotionRefusedError
from hil.campaign.campaign import campaign_of_design
from hil.campaign.dry_run_record import Acceptance, DryRunRecord
from hil.campaign.folder import CampaignFolder
from hil.campaign.identified_campaign import identify_campaign
from hil.campaign.joint_warm_up import WarmMotion, WarmUpRecord
from hil.campaign.status import execution_log_of, status_of
from hil.cell import Cell
from hil.cli import app
from hil.control.motion_checks import MotionChecks
from hil.control.motions import at_limit, straight_move
from hil.control.move import plan_move
from hil.control.record import origin_of, with_present_date
from hil.design import DesignResult
from planner import TrajectoryPlayer
from sim_fixtures.ns16 import CELL_PATH
from tests.hil.fast_cell import QUICK, fast_campaign, fast_cell, pass_rehearsal
from tests.messages import ANOTHER_CELL_OR_PLAN, HOLDS_RECORDINGS, LEFT_OUT_SIMULATED

pytestmark = pytest.mark.long

DOCUMENT = Path(__file__).parents[3] / "docs" / "campaign.md"


def blocks(language: str) -> list[str]:
    """Code blocks in one language, "" for commands, up to the section on monitoring."""
    day = DOCUMENT.read_text("utf-8").partition("\n## Monitoring a run\n")[0]
    return re.findall(rf"^```{language}\n(.*?)^```$", day, re.M | re.S)


def commands() -> list[list[str]]:
    """What the document types, in order."""
    lines = [line for block in blocks("") for line in block.splitlines()]
    return [shlex.split(line, comments=True)[1:] for line in lines]


@pytest.fixture(scope="module")
def day(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """What each command of the document printed; every one of them must succeed.

    The search is shorter than the default one.
    """
    folder = tmp_path_factory.mktemp("day")
    printed = {}
    fast_cell(folder)
    (folder / "quick.toml").write_text(QUICK)
    with pytest.MonkeyPatch.context() as here:
        here.chdir(folder)
        for arguments in commands():
            more = ["--settings", "quick.toml"] if arguments[0] == "design" else []
            result = CliRunner().invoke(app, [*arguments, *more])
            assert result.exit_code == 0, (arguments, result.output, result.exception)
            printed[" ".join(arguments)] = result.stdout
    return printed | {"folder": str(folder)}


def test_every_command_of_the_document_runs(day: dict[str, str]) -> None:
    assert "next: hil rehearse runs/mine" in day["design cell.toml -o runs/mine"]
    assert "passed all" in day["rehearse runs/mine"]
    assert day["run runs/mine --accept-dry-run"].startswith(("Good for", "Not for"))
    assert "all steps are done" in day["status runs/mine"]
    assert day["report runs/mine"].rstrip().endswith("report.html")
    printed = json.loads(day["status runs/mine --json"])
    assert [(step["name"], step["state"]) for step in printed["steps"]] == [
        (name, "done")
        for name in (
            *("design", "rehearse", "dry run", "warm-up"),
            *("repetitions", "validation", "identify", "report"),
        )
    ]
    assert printed["complete"] and printed["next_command"] == ""


def test_the_python_of_the_document_runs_too(
    day: dict[str, str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(day["folder"])
    (code,) = blocks("python")
    exec(compile(code, str(DOCUMENT), "exec"), {})
    assert "report done" in capsys.readouterr().out


def test_status_of_a_new_campaign_asks_for_its_rehearsal(
    day: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(day["folder"])
    designed = Campaign.open(Path("runs/mine"))
    campaign = Campaign.create(tmp_path / "two words", designed.cell, designed.plan)
    status = campaign.status()
    assert status.next_command == f"hil rehearse '{tmp_path}/two words'"
    assert [step.state for step in status.steps[:3]] == ["done", "next", "blocked"]


def test_a_design_replaces_no_recorded_campaign(
    day: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(day["folder"])
    mine = Path("runs/mine")
    arguments = ["design", "cell.toml", "-o", str(mine), "--settings", "quick.toml", "--force"]
    refused = CliRunner().invoke(app, arguments)
    assert isinstance(refused.exception, CampaignFolderError)
    assert HOLDS_RECORDINGS in str(refused.exception)

    cell = fast_cell(tmp_path)
    excitation = DesignResult.load(mine).excitation
    root = tmp_path / "made"
    first = campaign_of_design(root, cell, excitation)
    sealed = (root / "manifest.json").stat().st_mtime_ns
    campaign_of_design(root, cell, excitation)
    assert (root / "manifest.json").stat().st_mtime_ns == sealed
    other = fast_cell(tmp_path, validation_runs=2)
    second = campaign_of_design(root, other, excitation)
    assert (len(first.plan.validation), len(second.plan.validation)) == (1, 2)
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "cell.toml").write_text("# other")
    with pytest.raises(CampaignFolderError, match="is not empty"):
        campaign_of_design(tmp_path / "own", cell, excitation)


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> Campaign:
    """A campaign without rehearsal and dry run, as a simulated arm allows."""
    folder = tmp_path_factory.mktemp("conduct")
    cell = fast_cell(folder, repetitions=2)
    campaign = fast_campaign(folder / "campaign", cell, rehearsed=False)
    campaign.run(unrehearsed=True, durable=False)
    return campaign


@pytest.fixture
def folder(ran: Campaign, tmp_path: Path) -> CampaignFolder:
    """A copy of it, to be changed."""
    shutil.copytree(ran.folder.root, tmp_path / "campaign")
    return CampaignFolder(tmp_path / "campaign")


def test_the_conduct_has_what_was_left_out(ran: Campaign) -> None:
    conduct = identify_campaign(ran.folder.root, Silent()).results.conduct
    assert conduct == execution_log_of(ran.folder)
    steps = {step.step: step for step in conduct.steps}
    assert not steps["rehearsal"].done and steps["rehearsal"].words.startswith("not rehearsed")
    assert not steps["dry run"].done
    assert (steps["repetitions"].words, steps["repetitions"].details) == ("2 complete", [])


def test_the_page_has_rehearsal_dry_run_warm_up_and_rejections(folder: CampaignFolder) -> None:
    pass_rehearsal(folder)
    DryRunRecord(
        folder.plan_hash, 0.2, ("dryrun_000_a1.mcap",), 9.0, True, ("shoulder", "elbow"),
        (0.3, 0.12), (0.01, 0.02), 1, 2, Acceptance("ada", "2026-03-01"),
    ).save(folder.dry_run)  # fmt: skip
    motions = tuple(WarmMotion(f"w{k}", (10.0 - k, None)) for k in range(3))
    warm = WarmUpRecord(folder.plan_hash, ("shoulder", "elbow"), 0.002, motions, "not warm")
    assert np.isnan(warm.changes[0]) and warm.changes[1] == pytest.approx(1.0 / 9.5)
    warm.save(folder.warmup)
    name = "excitation_001_a9.mcap"
    shutil.copy(folder.archives / "excitation_001_a1.mcap", folder.archives / name)
    folder.add(name, "rejected", "it was held")
    steps = {step.step: step for step in execution_log_of(folder).steps}
    assert steps["rehearsal"].done
    assert "accepted by ada at 2026-03-01" in steps["dry run"].words
    assert "shoulder 30 %, elbow 12 %" in steps["dry run"].details[0]
    assert not steps["warm-up"].done and steps["warm-up"].words == "not warm after 3 motions"
    (drifting,) = steps["warm-up"].details
    assert "changes by 11.11 % per motion after 3 motions (warm below 0.20 %)" in drifting
    assert "1 rejected" in steps["repetitions"].words
    assert steps["repetitions"].details == [f"{name} rejected: it was held"]


def test_the_conduct_has_killed_attempts_and_no_wanted_warm_up(
    folder: CampaignFolder,
) -> None:
    """A killed program leaves an archive that is in no manifest."""
    name = "excitation_001_a9.mcap"
    whole = (folder.archives / "excitation_001_a1.mcap").read_bytes()
    (folder.archives / name).write_bytes(whole[: len(whole) // 2])
    steps = {step.step: step for step in execution_log_of(folder).steps}
    assert steps["repetitions"].words == "2 complete; 1 rejected or ended early"
    assert steps["repetitions"].details[0].startswith(f"{name} killed: ")
    assert steps["validation"].details == []
    assert steps["warm-up"].done
    assert steps["warm-up"].words == status_of(Campaign.open(folder.root)).steps[3].sentence


def test_ended_attempts_are_in_the_order_of_their_names(folder: CampaignFolder) -> None:
    whole = (folder.archives / "excitation_001_a1.mcap").read_bytes()
    for name in ("excitation_001_a8.mcap", "excitation_001_a9.mcap"):
        (folder.archives / name).write_bytes(whole)
    folder.add("excitation_001_a9.mcap", "rejected", "it was held")
    steps = {step.step: step for step in execution_log_of(folder).steps}
    assert steps["repetitions"].details == [
        "excitation_001_a8.mcap killed: the program ended before it checked the motion "
        "(completed: the motion is complete)",
        "excitation_001_a9.mcap rejected: it was held",
    ]


def test_steps_of_another_plan_or_unreadable_are_not_done(folder: CampaignFolder) -> None:
    pass_rehearsal(folder)
    folder.cell.write_text(folder.cell.read_text() + "\n# another\n")
    step = execution_log_of(folder).steps[0]
    assert not step.done and ANOTHER_CELL_OR_PLAN in step.words
    for path in (folder.rehearsal, folder.dry_run, folder.warmup):
        path.write_text("{")
    steps = execution_log_of(folder).steps[:3]
    assert all(not step.done for step in steps)
    assert all("cannot be read" in step.words for step in steps[:2])


def test_dates_are_those_of_motions_in_real_time() -> None:
    cell = Cell.load(CELL_PATH)
    assert "recorded_at" not in origin_of(cell)
    origin = origin_of(cell, virtual=False)
    assert origin["simulated"] == "yes"
    assert datetime.fromisoformat(origin["recorded_at"]).tzinfo is not None
    earlier = {**origin, "recorded_at": "2026-03-01T08:00:00+00:00"}
    assert with_present_date(earlier)["recorded_at"] >= origin["recorded_at"]
    assert "recorded_at" not in with_present_date({"simulated": "yes"})


# --- a campaign in a script: arguments, status, bytes of its archives


@pytest.fixture
def campaign(tmp_path: Path, ran: Campaign) -> Campaign:
    return Campaign.create(tmp_path / "campaign", ran.cell, ran.plan)


def test_exist_ok_opens_what_fits_and_nothing_else(
    campaign: Campaign, ran: Campaign, tmp_path: Path
) -> None:
    """So that a script can be run again."""
    root = str(campaign.folder.root)
    cell = ran.cell
    pass_rehearsal(campaign.folder)
    for excitation in (ran.plan, ran.plan.excitation):
        again = Campaign.create(root, cell, excitation, exist_ok=True)
        assert again.folder.plan_hash == campaign.folder.plan_hash
        assert again.folder.rehearsal.exists()
    other = replace(ran.plan, validation=ran.plan.validation[:0])
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").touch()
    for where, which, plan, exist_ok, message in (
        (root, fast_cell(tmp_path, repetitions=7), ran.plan, True, "a campaign with another cell"),
        (root, cell, other, True, "a campaign with another excitation"),
        (root, cell, ran.plan, False, "is not empty"),
        (tmp_path / "mine", cell, ran.plan, True, "is not empty"),
    ):
        with pytest.raises(hil.errors.InputError, match=message):
            Campaign.create(where, which, plan, exist_ok=exist_ok)
    made = Campaign.create(tmp_path / "new", cell, ran.plan, exist_ok=True)
    assert made.folder.plan.exists()


def test_the_errors_are_there_after_import_hil() -> None:
    look = "import hil, sys; print(hil.errors.UnsafeError.exit_code, 'numpy' in sys.modules)"
    shown = subprocess.run([sys.executable, "-c", look], capture_output=True, text=True, check=True)
    assert shown.stdout == "3 False\n"


# --- its bytes


def test_one_seed_gives_the_same_bytes_in_any_folder(tmp_path: Path, ran: Campaign) -> None:
    again = Campaign.create(tmp_path / "another name", ran.cell, ran.plan)
    again.run(unrehearsed=True, durable=False)
    first, second = (
        {path.name: path.read_bytes() for path in run.folder.archives.iterdir()}
        for run in (ran, again)
    )
    assert len(first) >= 4
    assert first == second


# --- moves


def test_an_arm_at_its_limit_by_rounding_may_leave_it(ran: Campaign) -> None:
    cell = ran.cell
    limits = ran.cell.joint_limits
    start = limits.lower - 4e-7 * (limits.upper - limits.lower)
    assert np.array_equal(at_limit(start, limits), limits.lower)
    motions = [straight_move(cell, start, cell.home).trajectory, plan_move(cell, start, cell.home)]
    assert MotionChecks.of(cell).refusal(motions[0]) is None  # type: ignore[arg-type]
    player = TrajectoryPlayer(motions[0], cell.period, limits)  # type: ignore[arg-type]
    player.begin(start)
    first, _ = player.advance()
    assert np.abs(first - start).max() < 1e-3


@pytest.mark.parametrize("plan_of_move", [straight_move, plan_move])
def test_an_arm_beyond_its_limit_is_reported_in_degrees(
    plan_of_move: Callable[..., object], ran: Campaign
) -> None:
    cell = ran.cell
    start = ran.cell.joint_limits.lower.copy()
    start[1] -= np.radians(0.5)
    elbow = np.degrees(start[1])
    with pytest.raises(
        MotionRefusedError, match=f"elbow stands at {elbow:.6g}°, its limits are .*jog the arm"
    ):
        plan_of_move(cell, start, cell.home)


# --- status


def test_a_status_asks_for_gates_as_the_run_does(ran: Campaign, campaign: Campaign) -> None:
    steps = {step.name: step for step in ran.status().steps}
    assert steps["rehearse"].sentence == LEFT_OUT_SIMULATED
    assert steps["dry run"].state == steps["validation"].state == "done"
    assert ran.status().next_command.startswith("hil identify ")
    (name, *_) = [path.name for path in ran.folder.completed("excitation")]
    (campaign.folder.archives / name).write_bytes((ran.folder.archives / name).read_bytes())
    campaign.folder.add(name, "completed")
    assert campaign.status().next_command.startswith("hil rehearse ")


@pytest.mark.parametrize(
    ("name", "command"),
    [
        ("rehearsal.json", "hil rehearse {} --again"),
        ("dry_run.json", ""),
        ("results.json", "hil identify {}"),
        ("cell.toml", ""),
    ],
)
def test_status_never_names_itself_where_a_file_is_damaged(
    name: str, command: str, campaign: Campaign, ran: Campaign
) -> None:
    """The next command is that of the step, or none with a sentence."""
    folder = campaign.folder
    for entry in ran.folder.manifest():
        (folder.archives / entry.name).write_bytes((ran.folder.archives / entry.name).read_bytes())
        folder.add(entry.name, entry.outcome)
    path = folder.root / name
    path.write_text(path.read_text("utf-8") + "\n# edited" if path.exists() else "{", "utf-8")
    status = Campaign.open(folder.root).status()
    assert not status.complete
    assert status.next_command == command.format(shlex.quote(str(folder.root)))
    stuck = next(step for step in status.steps if step.state == "next")
    assert name in stuck.sentence or command
