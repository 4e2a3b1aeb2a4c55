"""A reader walks from `hil identify` to the verdict by the files that ARCHITECTURE.md lists."""

from __future__ import annotations

import re
import sys
from collections import defaultdict
from pathlib import Path
from types import FrameType
from typing import Any

import hil
from hil.base.progress import Silent
from hil.cli import identify as command
from hil.identified.identified_arm import identify_recordings
from hil.importers.recording import ImportOptions
from hil.importers.robot import Robot
from hil.pipeline.options import Options
from identification.validation.verdict import Verdict
from tests.hil.simulated_logs import write_moving_log
from tests.hil.test_log_kinds import URDF

ROOT = Path(hil.__file__).parents[1]
MOST = 20  # files


def walk() -> list[str]:
    """Return the files of the list, in its order."""
    text = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
    _, _, section = text.partition("## From an archive to the verdict")
    section, _, _ = section.partition("\n## ")
    return re.findall(r"^\d+\. `([^`]+\.py)`", section, re.MULTILINE)


def callers_during(function: Any) -> tuple[Any, dict[str, set[str]]]:
    """Return the result of a call, and for each file of this repository which files call it."""
    callers: defaultdict[str, set[str]] = defaultdict(set)
    prefix = f"{ROOT}/"

    def note(frame: FrameType, event: str, _argument: object) -> None:
        if event != "call" or not frame.f_code.co_filename.startswith(prefix):
            return
        caller = frame.f_back
        while caller is not None and not caller.f_code.co_filename.startswith(prefix):
            caller = caller.f_back
        if caller is not None and frame.f_code.co_name != "<module>":
            name = frame.f_code.co_filename.removeprefix(prefix)
            callers[name].add(caller.f_code.co_filename.removeprefix(prefix))

    sys.setprofile(note)
    try:
        result = function()
    finally:
        sys.setprofile(None)
    return result, callers


def test_each_file_is_called_by_one_before_it(tmp_path: Path) -> None:
    """So that a reader never needs a file beside the list to get on. The log is simulated."""
    (tmp_path / "three.urdf").write_text(URDF)
    write_moving_log(tmp_path / "log.csv", URDF)
    robot = Robot.from_urdf(tmp_path / "three.urdf")
    arm, callers = callers_during(
        lambda: identify_recordings(
            [tmp_path / "log.csv"], [], lambda _: robot, ImportOptions(), Options(), Silent()
        )
    )
    files = walk()
    assert isinstance(arm.verdict, Verdict)
    assert 0 < len(files) == len(set(files)) <= MOST
    assert files[0] == "hil/cli/identify.py"
    assert command.identify_recordings is identify_recordings  # which the command calls
    assert files[1] == "hil/identified/identified_arm.py"
    assert files[-1] == "identification/validation/verdict.py"
    for number, name in enumerate(files[2:], start=2):
        assert callers[name] & set(files[1:number]), f"{name} is called by {callers[name]}"
