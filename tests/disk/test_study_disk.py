"""What a study keeps between sessions, on a disk that refuses: told, and made good by the next."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from hil.errors import OutputError
from hil.study import study_settings
from hil.study.records import Record, read_record, write_record
from hil.study.settings import StudyFolder
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
def test_a_record_is_written_whole_or_not_at_all(disk: PlantedDisk, rule: Rule) -> None:
    path, record = disk.root / "fits" / "a.json", Record(inputs="these archives")
    disk.do_wrong(rule)
    with pytest.raises(OutputError, match=rf"a\.json {TOLD}"):
        write_record(path, record)
    disk.do_wrong()
    assert names(path.parent) == []
    assert read_record(path, Record, "these archives") is None
    write_record(path, record)
    assert read_record(path, Record, "these archives") == record
