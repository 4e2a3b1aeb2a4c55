"""A reader walks from `hil identify` to the verdict by the files that ARCHITECTURE.md lists."""

from __future__ import annotations

import re
import sys
from collections import defaultdict
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

import hil
from hil.base.progress import Silent
from hil.cli import identify as command
from hil.identified.identified_arm import identify_recordings
from hil.importers.imported_robot import Robot
from hil.importers.recording_import import ImportOptions
from hil.pipeline.options import Options
from identification.validation.verdict import Verdict
from tests.hil.importers.moving_log import URDF
from tests.hil.simulated_logs import write_moving_log

ROOT = Path(hil.__file__).parents[1]
MOST = {"From a log to a recording": 12, "From an archive to the verdict": 20}
"""Files of each walk, at most."""


def walk(title: str) -> list[str]:
    """Return the files of a list, in its order."""
    text = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
    _, _, section = text.partition(f"## {title}")
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


@pytest.fixture(scope="module")
def traced(tmp_path_factory: pytest.TempPathFactory) -> dict[str, set[str]]:
    """Which files call each one while a simulated log is identified."""
    folder = tmp_path_factory.mktemp("log")
    (folder / "three.urdf").write_text(URDF)
    write_moving_log(folder / "log.csv", URDF)
    robot = Robot.from_urdf(folder / "three.urdf")
    arm, callers = callers_during(
        lambda: identify_recordings(
            [folder / "log.csv"], [], lambda _: robot, ImportOptions(), Options(), Silent()
        )
    )
    assert isinstance(arm.verdict, Verdict)
    return callers


@pytest.mark.parametrize("title", MOST)
def test_each_file_is_called_by_one_before_it(title: str, traced: dict[str, set[str]]) -> None:
    """So that a reader never needs a file beside the list to get on."""
    files = walk(title)
    assert 0 < len(files) == len(set(files)) <= MOST[title]
    start = files.index("hil/identified/identified_arm.py")
    for number, name in enumerate(files[start + 1 :], start=start + 1):
        assert traced[name] & set(files[start:number]), f"{name} is called by {traced[name]}"


def test_the_walks_lead_from_the_command_to_the_verdict() -> None:
    assert command.identify_recordings is identify_recordings  # which the command calls
    first, second = map(walk, MOST)
    assert first[0] == "hil/identified/identified_arm.py"
    assert second[:2] == ["hil/cli/identify.py", "hil/identified/identified_arm.py"]
    assert first[-1] in second
    assert second[-1] == "identification/validation/verdict.py"
