"""A campaign as a script has it: what it may be given, what it says of itself, and its bytes."""

from __future__ import annotations

import hashlib
import shlex
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import hil
from hil import Campaign
from hil.campaign import MotionRefusedError
from hil.campaign.intervals import at_limit, way
from hil.motion_checks import MotionChecks
from hil.move import straight_way
from planner import TrajectoryPlayer
from tests.hil.fast_cell import fast_campaign, fast_cell, pass_rehearsal


@pytest.fixture(scope="module")
def designed(tmp_path_factory: pytest.TempPathFactory) -> Campaign:
    """A plan of one repetition; only read it."""
    folder = tmp_path_factory.mktemp("designed")
    return fast_campaign(folder / "campaign", fast_cell(folder, repetitions=1), rehearsed=False)


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory, designed: Campaign) -> Campaign:
    """The same, run without a rehearsal; only read it."""
    root = tmp_path_factory.mktemp("done") / "a"
    campaign = Campaign.create(root, designed.cell, designed.plan)
    campaign.run(unrehearsed=True, durable=False)
    return campaign


@pytest.fixture
def campaign(tmp_path: Path, designed: Campaign) -> Campaign:
    return Campaign.create(tmp_path / "campaign", designed.cell, designed.plan)


# --- what it may be given


def test_folders_may_be_text_and_arguments_have_their_names(
    tmp_path: Path, designed: Campaign
) -> None:
    root = str(tmp_path / "named")
    made = Campaign.create(folder=root, cell=designed.cell, excitation=designed.plan)
    assert Campaign.open(root).folder.plan_hash == made.folder.plan_hash
    assert made.plan.to_text() == designed.plan.to_text()


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ({"folder": None}, "folder: is None; give the path of a folder"),
        ({"cell": "cell.toml"}, r"cell: is an object of type str; give .*hil\.Cell\.load"),
        ({"excitation": None}, "excitation: is None; give an Excitation"),
        ({"excitation": 3.0}, "excitation: is an object of type float"),
    ],
)
def test_what_is_of_another_type_is_refused_as_a_type_error(
    wrong: dict[str, object], sentence: str, tmp_path: Path, designed: Campaign
) -> None:
    given = {"folder": tmp_path / "c", "cell": designed.cell, "excitation": designed.plan, **wrong}
    with pytest.raises(TypeError, match=sentence) as refused:
        Campaign.create(**given)  # type: ignore[arg-type]
    assert isinstance(refused.value, hil.errors.InputError)
    assert not (tmp_path / "c").exists()


class TestExistOk:
    """`exist_ok` opens a campaign that fits, so that a script can be run again."""

    def test_what_fits_is_opened_with_what_it_holds(
        self, campaign: Campaign, designed: Campaign
    ) -> None:
        pass_rehearsal(campaign.folder)
        for excitation in (designed.plan, designed.plan.excitation):
            again = Campaign.create(campaign.folder.root, designed.cell, excitation, exist_ok=True)
            assert again.folder.plan_hash == campaign.folder.plan_hash
            assert again.folder.rehearsal.exists()

    def test_another_cell_or_excitation_is_refused(
        self, campaign: Campaign, designed: Campaign, tmp_path: Path
    ) -> None:
        root, cell = campaign.folder.root, fast_cell(tmp_path, repetitions=7)
        with pytest.raises(hil.errors.InputError, match="a campaign with another cell"):
            Campaign.create(root, cell, designed.plan, exist_ok=True)
        other = replace(designed.plan, validation=designed.plan.validation[:0])
        with pytest.raises(hil.errors.InputError, match="a campaign with another excitation"):
            Campaign.create(root, designed.cell, other, exist_ok=True)

    def test_without_it_and_for_other_things_in_the_folder(
        self, campaign: Campaign, designed: Campaign, tmp_path: Path
    ) -> None:
        with pytest.raises(hil.errors.InputError, match="is not empty"):
            Campaign.create(campaign.folder.root, designed.cell, designed.plan)
        (tmp_path / "mine").mkdir()
        (tmp_path / "mine" / "notes.txt").touch()
        with pytest.raises(hil.errors.InputError, match="is not empty"):
            Campaign.create(tmp_path / "mine", designed.cell, designed.plan, exist_ok=True)
        made = Campaign.create(tmp_path / "new", designed.cell, designed.plan, exist_ok=True)
        assert made.folder.plan.exists()


def test_the_errors_are_there_after_import_hil() -> None:
    look = "import hil, sys; print(hil.errors.UnsafeError.exit_code, 'numpy' in sys.modules)"
    shown = subprocess.run([sys.executable, "-c", look], capture_output=True, text=True, check=True)
    assert shown.stdout == "3 False\n"


# --- its bytes


def checksums(campaign: Campaign) -> dict[str, str]:
    archives = sorted(campaign.folder.archives.iterdir())
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in archives}


def test_one_seed_gives_the_same_bytes_whatever_the_folder_is_called(
    tmp_path: Path, done: Campaign
) -> None:
    again = Campaign.create(tmp_path / "another name", done.cell, done.plan)
    again.run(unrehearsed=True, durable=False)
    assert checksums(again) == checksums(done)
    assert len(checksums(done)) >= 4


# --- ways


def test_an_arm_that_rounding_takes_across_its_limit_may_leave_it(designed: Campaign) -> None:
    cell, limits = designed.cell, designed.cell.joint_limits
    start = limits.lower - 4e-7 * (limits.upper - limits.lower)
    assert np.array_equal(at_limit(start, limits), limits.lower)
    motions = [way(cell, start, cell.home).trajectory, straight_way(cell, start, cell.home)]
    assert MotionChecks.of(cell).refusal(motions[0]) is None  # type: ignore[arg-type]
    player = TrajectoryPlayer(motions[0], cell.period, limits)  # type: ignore[arg-type]
    player.begin(start)
    first, _ = player.advance()
    assert np.abs(first - start).max() < 1e-3


@pytest.mark.parametrize("plan_way", [way, straight_way])
def test_an_arm_beyond_its_limit_is_told_so_in_degrees(
    plan_way: Callable[..., object], designed: Campaign
) -> None:
    cell, start = designed.cell, designed.cell.joint_limits.lower.copy()
    start[1] -= np.radians(0.5)
    elbow = np.degrees(start[1])
    with pytest.raises(
        MotionRefusedError, match=f"elbow stands at {elbow:.6g}°, its limits are .*jog the arm"
    ):
        plan_way(cell, start, cell.home)


# --- status


def test_what_a_simulated_arm_left_out_is_not_asked_for_at_the_end(done: Campaign) -> None:
    steps = {step.name: step for step in done.status().steps}
    assert steps["rehearse"].sentence == "left out, as a simulated arm allows"
    assert steps["dry run"].state == steps["validation"].state == "done"
    assert done.status().next_command.startswith("hil identify ")


def test_before_that_the_gates_are_asked_for_as_the_run_asks_for_them(
    campaign: Campaign, done: Campaign
) -> None:
    (name, *_) = [path.name for path in done.folder.completed("excitation")]
    (campaign.folder.archives / name).write_bytes((done.folder.archives / name).read_bytes())
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
    name: str, command: str, campaign: Campaign, done: Campaign
) -> None:
    """Following it leads to an end: to the step's own command, or to a sentence for a person."""
    folder = campaign.folder
    for entry in done.folder.manifest():
        (folder.archives / entry.name).write_bytes((done.folder.archives / entry.name).read_bytes())
        folder.add(entry.name, entry.outcome)
    path = folder.root / name
    path.write_text(path.read_text("utf-8") + "\n# edited" if path.exists() else "{", "utf-8")
    status = Campaign.open(folder.root).status()
    assert not status.complete
    assert status.next_command == command.format(shlex.quote(str(folder.root)))
    stuck = next(step for step in status.steps if step.state == "next")
    assert name in stuck.sentence or command


def test_a_torn_archive_that_was_replaced_is_nothing_to_run_again(
    campaign: Campaign, done: Campaign
) -> None:
    whole = done.folder.completed("excitation")[0]
    folder = campaign.folder
    (folder.archives / "excitation_000_a1.mcap").write_bytes(b"torn")
    (folder.archives / "move_000_a1.mcap").write_bytes(b"torn")
    (folder.archives / "excitation_000_a2.mcap").write_bytes(whole.read_bytes())
    folder.add("excitation_000_a2.mcap", "completed")
    assert campaign.status().notes == (
        "excitation_000_a1.mcap was left by a run that was killed; nothing is missing without it",
        "move_000_a1.mcap was left by a run that was killed; nothing is missing without it",
    )
