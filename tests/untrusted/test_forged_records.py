"""What is kept between runs, sealed rightly and put together by somebody: it counts as absent."""

from __future__ import annotations

import json
import zlib
from io import BytesIO
from pathlib import Path
from types import MethodType, SimpleNamespace
from typing import cast

import pytest

from hil.archive import Archive
from hil.errors import ArchiveError
from hil.study.records import Record, class_in, read_record, write_record
from identification.excitation import Journal, SearchSettings
from tests.identification.searching import problem

# Records of a study


def test_a_study_reads_its_archives_again_where_a_record_does_not_fit(tmp_path: Path) -> None:
    path = tmp_path / "run.json"
    write_record(path, Record(inputs="digest"))
    assert read_record(path, Record, "digest") is not None
    assert read_record(path, Record, "another digest") is None
    for content in ('{"inputs": 1}', '{"inputs": "digest", "more": 1}', "[" * 10_000, "\0"):
        path.write_text(content)
        assert read_record(path, Record, "digest") is None


def test_a_plan_whose_moves_are_none_is_told_with_its_archive(tmp_path: Path) -> None:
    path = tmp_path / "validation_000_a1.mcap"
    plan = json.dumps({"moves": [{"target": "x"}]}).encode()
    forged = SimpleNamespace(path=path, attachments={"plan.json": plan})
    forged.table = MethodType(Archive.table, forged)
    archive = cast("Archive", forged)
    with pytest.raises(ArchiveError, match="its plan cannot be read") as told:
        class_in(archive)
    assert str(path) in str(told.value)


# What a search keeps


def test_a_journal_full_of_forged_frames_is_read_in_time_that_grows_as_it_does(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    file = BytesIO()
    Journal(file, problem(), SearchSettings(population=4, generations=3))
    frame = 12 + len(b"\x93NUMPY")
    count = 2_000
    for k in range(count):  # each claims all that follows
        length = frame * (count - k) - 12
        file.write(length.to_bytes(8, "little") + bytes(4) + b"\x93NUMPY")
    summed, crc32 = [], zlib.crc32

    def counted(data: bytes) -> int:
        summed.append(len(data))
        return crc32(data)

    monkeypatch.setattr(zlib, "crc32", counted)
    Journal(file, problem(), SearchSettings(population=4, generations=3))
    assert sum(summed) < 8 * len(file.getvalue())
