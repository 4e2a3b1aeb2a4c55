"""`hil run`: its options, its JSON, its exit codes, a terminal."""

from __future__ import annotations

import json
import signal
import time
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from hil.base.errors import HilError, OperatorStopError
from hil.campaign import (
    Campaign,
)
from hil.cli import app
from hil.control.errors import MotionFailedError
from hil.results.results import Results
from tests.hil.fast_cell import mirrored, pass_rehearsal
from tests.hil.screen_rig import on_terminal
from tests.messages import AGAINST_GRAVITY

pytestmark = pytest.mark.safety


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
    assert "--accept-dry-run" in refused["error"]
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
    assert f"elbow: measured torque {AGAINST_GRAVITY}" in slow.stdout
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
