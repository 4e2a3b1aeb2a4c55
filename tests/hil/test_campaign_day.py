"""A day with a campaign."""

from __future__ import annotations

import gc
import json
import re
import shlex
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest
from typer.testing import CliRunner

from hil.campaign import Campaign, CampaignFolderError, MotionFailedError, Stop
from hil.campaign.campaign import campaign_of_design
from hil.campaign.operator import RunStatus, Unattended
from hil.cell import Cell
from hil.cli import app
from hil.design import DesignResult
from hil.version import software
from tests.hil.fast_cell import fast_campaign, fast_cell

DOCUMENT = Path(__file__).parents[2] / "docs" / "campaign.md"
QUICK = """\
method = "b"
[search]
population = 8
generations = 3
[via_points]
n_via = 3
fly = 0.5
slowest = 0.8
"""


def blocks(language: str) -> list[str]:
    """Code blocks of the document in one language, "" for commands."""
    return re.findall(rf"^```{language}\n(.*?)^```$", DOCUMENT.read_text("utf-8"), re.M | re.S)


def commands() -> list[list[str]]:
    """What the document types, in order."""
    lines = [line for block in blocks("") for line in block.splitlines()]
    return [shlex.split(line, comments=True)[1:] for line in lines]


@pytest.fixture(scope="module")
def day(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """What each command of the document printed; every one of them must succeed.

    The search is shorter than the default one.
    """
    folder, said = tmp_path_factory.mktemp("day"), {}
    fast_cell(folder)
    (folder / "quick.toml").write_text(QUICK)
    with pytest.MonkeyPatch.context() as here:
        here.chdir(folder)
        for arguments in commands():
            more = ["--settings", "quick.toml"] if arguments[0] == "design" else []
            result = CliRunner().invoke(app, [*arguments, *more])
            assert result.exit_code == 0, (arguments, result.output, result.exception)
            said[" ".join(arguments)] = result.stdout
    return said | {"folder": str(folder)}


def test_every_command_of_the_document_does_what_it_says(day: dict[str, str]) -> None:
    assert "next: hil rehearse runs/mine" in day["design cell.toml -o runs/mine"]
    assert "passed all" in day["rehearse runs/mine"]
    assert day["run runs/mine --accept-dry-run"].rstrip().splitlines()[-1].startswith("The model")
    assert "every step is done" in day["status runs/mine"]
    assert day["report runs/mine"].rstrip().endswith("report.html")


def test_status_as_json_names_every_step(day: dict[str, str]) -> None:
    found = json.loads(day["status runs/mine --json"])
    assert [(step["name"], step["state"]) for step in found["steps"]] == [
        (name, "done")
        for name in (
            *("design", "rehearse", "dry run", "warm-up"),
            *("repetitions", "validation", "identify", "report"),
        )
    ]
    assert found["complete"] and found["next_command"] == "" and found["notes"] == []


def test_the_python_of_the_document_runs_too(
    day: dict[str, str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(day["folder"])
    (code,) = blocks("python")
    exec(compile(code, str(DOCUMENT), "exec"), {})
    assert "report done" in capsys.readouterr().out


def test_nothing_whole_is_done_again(day: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(day["folder"])
    campaign = Campaign.open(Path("runs/mine"))
    before = campaign.folder.manifest()
    result = campaign.run()
    assert result.archives == () and result.complete
    assert campaign.folder.manifest() == before


def test_status_names_what_is_torn_rejected_and_next(
    day: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(day["folder"])
    done = Campaign.open(Path("runs/mine"))
    campaign = Campaign.create(tmp_path / "two words", done.cell, done.plan)
    status = campaign.status()
    assert status.next_command == f"hil rehearse '{tmp_path}/two words'"
    assert [step.state for step in status.steps[:3]] == ["done", "next", "blocked"]
    folder = campaign.folder
    for name in ("excitation_000_a1.mcap", "excitation_001_a1.mcap"):
        (folder.archives / name).write_bytes(b"torn")
    folder.add("excitation_000_a1.mcap", "rejected", "a jam")
    with folder.locked():
        notes = campaign.status().notes
    assert notes == (
        "a run or a rehearsal is at work on it now",
        "excitation_001_a1.mcap was left by a run that was killed: used if it is whole, its "
        "motion run again if not",
        "excitation_000_a1.mcap is rejected: a jam",
    )


def test_a_design_replaces_its_own_campaign_and_never_a_recorded_one(
    day: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(day["folder"])
    mine = Path("runs/mine")
    arguments = ["design", "cell.toml", "-o", str(mine), "--settings", "quick.toml", "--force"]
    refused = CliRunner().invoke(app, arguments)
    assert isinstance(refused.exception, CampaignFolderError)
    assert "holds a campaign with recordings" in str(refused.exception)

    cell, excitation = fast_cell(tmp_path), DesignResult.load(mine).excitation
    root = tmp_path / "made"
    first = campaign_of_design(root, cell, excitation)
    sealed = (root / "manifest.json").stat().st_mtime_ns
    campaign_of_design(root, cell, excitation)
    assert (root / "manifest.json").stat().st_mtime_ns == sealed
    other = fast_cell(tmp_path, validation_runs=2)
    second = campaign_of_design(root, other, excitation)
    assert (len(first.plan.validation), len(second.plan.validation)) == (1, 2)
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "cell.toml").write_text("somebody's")
    with pytest.raises(CampaignFolderError, match="is not empty"):
        campaign_of_design(tmp_path / "own", cell, excitation)


# --- What the process that supervised a run still holds afterwards: it may supervise for days


class Impatient(Unattended):
    """Stops the arm in the first repetition."""

    def __init__(self, stop: Stop) -> None:
        self._stop = stop

    def show(self, status: RunStatus) -> None:
        self._stop.requested = status.phase == "repetition" and status.motion is not None


def left_in_cycles(work: Callable[[], object]) -> Counter[str]:
    """What `work` leaves to the cycle collector, by type."""
    gc.collect()
    gc.disable()
    gc.set_debug(gc.DEBUG_SAVEALL)
    try:
        work()
        gc.collect()
        return Counter(type(one).__qualname__ for one in gc.garbage)
    finally:
        gc.set_debug(0)
        gc.garbage.clear()
        gc.enable()


def test_a_campaign_leaves_nothing_to_the_cycle_collector(tmp_path: Path) -> None:
    """Made of a cell file, run, stopped on the way, opened and run again."""
    plan = fast_campaign(tmp_path / "first", fast_cell(tmp_path, repetitions=1)).plan
    folder = tmp_path / "second"
    software()  # what is installed is read once in a process

    def work() -> None:
        stop = Stop()
        campaign = Campaign.create(folder, Cell.load(tmp_path / "cell.toml"), plan)
        with pytest.raises(MotionFailedError):
            campaign.run(stop=stop, operator=Impatient(stop), unrehearsed=True)
        assert Campaign.open(folder).run(unrehearsed=True).complete

    assert not left_in_cycles(work)
