"""`--json` prints one JSON object to stdout also if a command fails."""

from __future__ import annotations

import errno
import json
import os
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from hil.archive import ImportedSamples, write_samples
from hil.archive.process_handle import Failed
from hil.base.errors import ArchiveWriteError, ControllerError, HilError, InputError
from hil.base.files import convert_write_errors, make_folder
from hil.campaign.state import CampaignState
from hil.cli import COMMANDS, app, as_json, exit_code_of, main
from hil.control.live_link import write_error
from planner import PlannerError
from tests.messages import NO_CAMPAIGN_FOLDER

NOWHERE = "/nowhere"
FAILING = {
    "design": ("design", NOWHERE),
    "rehearse": ("rehearse", NOWHERE),
    "run": ("run", NOWHERE),
    "status": ("status", NOWHERE),
    "look": ("look", NOWHERE),
    "identify": ("identify", NOWHERE),
    "report": ("report", NOWHERE),
    "new": ("new", "--urdf", NOWHERE, "-o", "cell.toml"),
    "plot": ("plot", NOWHERE),
    "move": ("move", NOWHERE, "--to", "home"),
    "compare": ("compare", NOWHERE),
    "study": ("study", "--cell", NOWHERE),
    "batch": ("batch", NOWHERE, "--workers", "1"),
    "trend": ("trend", NOWHERE),
    "torque-constants": ("torque-constants", NOWHERE, NOWHERE, "--mass", "1"),
    "payload": ("payload", NOWHERE, "--loaded", NOWHERE),
    "export": ("export", NOWHERE, "--to", "mjcf"),
    "rollout": ("rollout", NOWHERE),
    "plan": ("plan", NOWHERE, "--cell", NOWHERE),
    "record": ("record", NOWHERE),
    "simulate": ("simulate", NOWHERE),
    "doctor": ("doctor", NOWHERE),
    "import": ("import", "rosbag2", NOWHERE, "-o", "out.mcap", "--urdf", NOWHERE),
    "archive": ("archive", "info", NOWHERE),
    "demo": ("demo", "--nonsense"),
}
"""A failing call of each command."""


def called(*arguments: str) -> Result:
    return CliRunner().invoke(app, [*arguments, "--json"])


def test_usage_errors_are_json_too() -> None:
    assert {*FAILING} == {*COMMANDS}
    for arguments in (("status",), ("bla",), ("plot", "--no-such-option")):
        result = called(*arguments)
        assert (result.exit_code, json.loads(result.stdout)["exit_code"]) == (2, 2)
    without_json = CliRunner().invoke(app, ["status"])
    assert (without_json.exit_code, without_json.stdout) == (2, "")


@pytest.mark.parametrize("command", [*FAILING])
def test_a_command_that_fails_prints_one_object(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    result = called(*FAILING[command])
    document = json.loads(result.stdout)
    assert document["error"]
    if command != "archive":  # which has one object per file
        assert document["exit_code"] == 2
        assert document["kind"].isidentifier()
    assert [path.name for path in tmp_path.iterdir()] == []


def test_json_of_an_error_has_its_parts_and_status() -> None:
    document = as_json(InputError("a.toml", "is empty", field="cell", remedy="fill it"))
    assert document == {
        "error": "a.toml: cell: is empty; fill it",
        "kind": "InputError",
        "exit_code": 2,
        "path": "a.toml",
        "field": "cell",
        "problem": "is empty",
        "remedy": "fill it",
    }
    exit_codes = [exit_code_of(error) for error in (ControllerError(""), PlannerError(), OSError())]
    assert exit_codes == [4, 2, 1]


@pytest.mark.parametrize(
    "number", [errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EROFS, errno.EFBIG]
)
def test_errors_of_a_disk_are_not_bad_input(
    number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Exit status 1, also for an archive that cannot grow, here or in its own process."""
    refusal = OSError(number, os.strerror(number))
    with pytest.raises(HilError) as of_folder, convert_write_errors(tmp_path):
        raise refusal

    def refuse(*_: object) -> int:
        raise refusal

    samples = ImportedSamples(np.arange(3) * 10**7, np.zeros((3, 1)))
    monkeypatch.setattr("hil.archive.writer.os.write", refuse)
    with pytest.raises(ArchiveWriteError) as of_archive:
        write_samples(tmp_path / "a.mcap", samples, joint_names=("a",), metadata={})
    failed = write_error(Failed(1, "a.mcap", "cannot be written any more", "make room", number))
    for error in (of_folder.value, of_archive.value, failed):
        assert exit_code_of(error) == as_json(error)["exit_code"] == 1


def test_names_that_cannot_be_used_are_bad_input(tmp_path: Path) -> None:
    with pytest.raises(InputError) as caught:
        make_folder(tmp_path / ("a" * 300))
    exists = write_error(Failed(1, "a.mcap", "exists already", "", None))
    assert exit_code_of(caught.value) == exit_code_of(exists) == 2


@pytest.mark.parametrize(("raised", "code"), [(KeyboardInterrupt(), 130), (MemoryError(), 1)])
def test_ctrl_c_and_unexpected_errors_are_json_too(
    raised: BaseException, code: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise raised

    monkeypatch.setattr(CampaignState, "open", fail)
    document = json.loads(called("status", NOWHERE).stdout)
    assert document["exit_code"] == code and document["error"]
    silent = CliRunner().invoke(app, ["status", NOWHERE])
    assert silent.stdout == ""


@pytest.mark.parametrize("more", [[], ["--json"]])
def test_the_exit_status_of_the_program_is_the_same_with_json(
    more: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["hil", "status", NOWHERE, *more])
    with pytest.raises(SystemExit) as ended:
        main()
    output = capsys.readouterr()
    assert ended.value.code == 2
    assert NO_CAMPAIGN_FOLDER in output.err
    assert bool(output.out) == bool(more)
