"""`hil run`: a thin shell over `Campaign.run`, for a person, a script, and a terminal."""

from __future__ import annotations

import json
import os
import pty
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from hil.campaign import Campaign
from hil.cli import app
from hil.errors import HilError
from hil.results import Results
from tests.hil.fast_cell import fast_campaign, fast_cell, mirrored, pass_rehearsal


@pytest.fixture(scope="module")
def designed(tmp_path_factory: pytest.TempPathFactory) -> Campaign:
    folder = tmp_path_factory.mktemp("designed")
    return fast_campaign(folder / "campaign", fast_cell(folder))


@pytest.fixture
def campaign(tmp_path: Path, designed: Campaign) -> Campaign:
    created = Campaign.create(tmp_path / "campaign", designed.cell, designed.plan)
    pass_rehearsal(created.folder)
    return created


def hil_run(campaign: Campaign, *options: str) -> Result:
    return CliRunner().invoke(app, ["run", str(campaign.folder.root), *options])


def exit_code(result: Result) -> int:
    """As the program's: an error of ours carries its own."""
    error = result.exception
    return error.exit_code if isinstance(error, HilError) else result.exit_code


def test_a_script_without_a_terminal_gets_through_and_reads_json(campaign: Campaign) -> None:
    refused = hil_run(campaign, "--json")
    assert exit_code(refused) == 3
    told = json.loads(refused.stdout)
    assert told["exit_code"] == 3
    assert "--dry-run" in told["error"]
    assert not list(campaign.folder.archives.iterdir())

    slow = hil_run(campaign, "--dry-run", "--json")
    assert exit_code(slow) == 0, slow.exception
    told = json.loads(slow.stdout)
    assert (told["dry_run"], told["complete"], told["verdict"]) == ("to be accepted", False, None)

    both = hil_run(campaign, "--dry-run", "--accept-dry-run")
    assert exit_code(both) == 2

    done = hil_run(campaign, "--accept-dry-run", "--json")
    assert exit_code(done) == 0, done.exception
    (line,) = done.stdout.splitlines()
    told = json.loads(line)
    assert told["complete"]
    assert told["repetitions"] == [4, 4]
    assert told["verdict"]["good"]
    assert set(told["archives"]) == {path.name for path in campaign.folder.archives.iterdir()} - {
        "move_000_a1.mcap",
        "move_001_a1.mcap",
        "dryrun_000_a1.mcap",
        "dryrun_001_a1.mcap",
    }
    results = Results.model_validate_json(campaign.folder.results.read_bytes())
    assert results.verdict.line == told["verdict"]["line"]
    assert campaign.folder.report.exists()


def test_a_torque_that_contradicts_the_model_is_named_and_wants_a_word_of_its_own(
    tmp_path: Path, designed: Campaign
) -> None:
    campaign = Campaign.create(
        tmp_path / "campaign", mirrored(designed.cell, "[1, 1]"), designed.plan
    )
    pass_rehearsal(campaign.folder)
    slow = hil_run(campaign, "--dry-run", "--quiet")
    assert exit_code(slow) == 0, slow.exception
    assert "elbow: measured torque runs against the model's gravity" in slow.stdout
    assert "--accept-dry-run --accept-torque elbow" in slow.stdout
    refused = hil_run(campaign, "--accept-dry-run", "--json")
    assert exit_code(refused) == 3
    assert "--accept-torque elbow" in json.loads(refused.stdout)["error"]
    done = hil_run(
        campaign, "--accept-dry-run", "--accept-torque", "elbow", "--no-identify", "--json"
    )
    assert exit_code(done) == 0, done.exception
    assert json.loads(done.stdout)["against_gravity"] == ["elbow"]


def test_a_live_view_of_virtual_time_is_refused(campaign: Campaign) -> None:
    refused = hil_run(campaign, "--accept-dry-run", "--live", "8765")
    assert exit_code(refused) == 2
    assert "virtual time" in str(refused.exception)


def test_at_a_terminal_the_dry_run_is_asked_for_and_ctrl_c_leaves_a_campaign_to_go_on_with(
    campaign: Campaign,
) -> None:
    root = campaign.folder.root
    master, terminal = pty.openpty()
    process = subprocess.Popen(
        # With the terminal as its own: keys are read by whoever is in its foreground.
        ["setsid", "--ctty", sys.executable, "-m", "hil", "run", str(root), "--no-identify"],
        stdin=terminal,
        stdout=terminal,
        stderr=terminal,
        env={**os.environ, "TERM": "xterm-256color", "COLUMNS": "100", "LINES": "40"},
    )
    os.close(terminal)
    seen = b""
    answered = interrupted = False
    deadline = time.monotonic() + 120.0
    try:
        while process.poll() is None and time.monotonic() < deadline:
            try:
                seen += os.read(master, 65536)
            except OSError:  # the far end is closed
                break
            if not answered and b"Type yes" in seen:
                time.sleep(0.3)  # what is typed before the question counts for nothing
                os.write(master, b"yes\n")
                answered = True
            if not interrupted and list(campaign.folder.archives.glob("excitation_*")):
                process.send_signal(signal.SIGINT)
                interrupted = True
        assert process.wait(30.0) == 130, seen[-3000:].decode(errors="replace")
    finally:
        process.kill()
        process.wait()
        os.close(master)
    assert answered
    assert b"hil run" in seen, "what to type to go on"
    outcomes = [entry.outcome for entry in campaign.folder.manifest()]
    assert set(outcomes) <= {"completed", "stopped"}
    rest = Campaign.open(root).run()
    assert rest.complete, "the dry run was accepted at the terminal"
