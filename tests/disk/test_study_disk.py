"""What a study keeps between sessions, on a disk that refuses: told, and made good by the next."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from hil.errors import OutputError
from hil.study import stages as stages_module
from hil.study import study_settings
from hil.study.folder import StudyFolder
from hil.study.records import Record, read_or_make
from hil.study.stages import TIMES, Stages
from tests.disk.faults import REFUSALS, RENAME, SYNC, Rule
from tests.disk.mounted import PlantedDisk, planted_disk

REFUSED = [
    pytest.param(Rule((operation,), error=error), id=f"{error} at {operation}")
    for operation in (SYNC, RENAME)
    for error in sorted(REFUSALS)
]
TOLD = r"cannot be written \(.+\).*nothing there was changed: make room"


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[PlantedDisk]:
    with planted_disk(tmp_path) as planted:
        yield planted


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("rule", REFUSED)
def test_a_study_that_cannot_be_begun_leaves_an_empty_folder(disk: PlantedDisk, rule: Rule) -> None:
    folder, settings = StudyFolder(disk.root), study_settings(quick=True)
    disk.do_wrong(rule)
    with pytest.raises(OutputError, match=rf"study\.json {TOLD}"):
        folder.begin(settings)
    assert disk.do_wrong()
    assert names(disk.root) == []
    folder.begin(settings)
    assert names(disk.root) == ["study.json"]


@pytest.mark.parametrize("rule", REFUSED)
def test_what_was_read_of_archives_is_kept_whole_or_made_again(
    disk: PlantedDisk, rule: Rule
) -> None:
    path, made = disk.root / "fits" / "a.json", []

    def make() -> Record:
        made.append(1)
        return Record(inputs="these archives")

    disk.do_wrong(rule)
    with pytest.raises(OutputError, match=rf"a\.json {TOLD}"):
        read_or_make(path, Record, "these archives", make)
    disk.do_wrong()
    assert names(path.parent) == []
    for _ in range(2):
        assert read_or_make(path, Record, "these archives", make) == make()
        made.pop()
    assert len(made) == 2, "once in vain, once kept"


def test_times_that_cannot_be_written_are_told_when_the_stage_ends(
    disk: PlantedDisk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stages_module, "_EVERY", 0.005)  # so that the thread meets it too
    stages = Stages(disk.root, begun=False)
    with stages.stage("searches"):
        pass
    before = (disk.root / TIMES).read_text()
    disk.do_wrong(Rule((SYNC,), error="EDQUOT"))
    with pytest.raises(OutputError, match=rf"{TIMES} {TOLD}"), stages.stage("plans"):
        until = time.monotonic() + 10.0
        while not disk.struck and time.monotonic() < until:
            time.sleep(0.005)
    assert len(disk.do_wrong()) > 1, "the thread was refused and went on"
    assert (disk.root / TIMES).read_text() == before
    with stages.stage("campaigns"):
        pass
    assert {"searches", "plans", "campaigns"} == set(
        json.loads((disk.root / TIMES).read_text())["wall"]
    )


@pytest.mark.parametrize("error", [KeyboardInterrupt, ZeroDivisionError])
def test_what_ended_a_stage_is_not_hidden_by_times_that_cannot_be_written(
    disk: PlantedDisk, error: type[BaseException]
) -> None:
    stages = Stages(disk.root, begun=False)
    disk.do_wrong(Rule((SYNC,), error="ENOSPC"))
    with pytest.raises(error), stages.stage("searches"):
        raise error
    assert disk.do_wrong()
    assert "searches" in stages.times.wall
