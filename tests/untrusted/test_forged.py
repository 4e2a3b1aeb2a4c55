"""What a stranger made up inside files of ours, with seals that are right."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import zlib
from io import BytesIO
from pathlib import Path
from types import MethodType, SimpleNamespace
from typing import cast

import pytest

from hil.archive import Archive, ArchiveHeader
from hil.errors import ArchiveError
from hil.study.records import Record, class_in, read_record, write_record
from identification.excitation import Journal

HEADER = {"kind": "move", "joint_names": '["a"]', "attachments": "[]"}


@pytest.mark.parametrize("value", [10**400, True, float("nan"), float("inf"), "1", None])
def test_planted_values_that_are_no_numbers_are_none(value: object) -> None:
    def planted(of_x: object) -> object:
        return ArchiveHeader.of({**HEADER, "planted": json.dumps({"x": of_x})}).planted

    assert planted(-1.5) == {"x": -1.5}
    assert planted(value) == {}


@pytest.mark.parametrize("text", [b"[1]", b"{bad", b"[" * 100_000, b"\xff", b'{"trajectory": 3}'])
def test_a_plan_that_is_none_tells_no_other_class(text: bytes, tmp_path: Path) -> None:
    header = ArchiveHeader.of(HEADER)
    assert class_in(Archive(tmp_path, header, None, {"plan.json": text}, {}, (), None)) == "fly-by"


def test_a_name_that_is_no_text_is_told_as_json(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "hil", "status", b"x\xff", "--json"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONIOENCODING": "utf-8:strict"},
        capture_output=True,
        check=False,
    )
    assert done.returncode == 2
    assert "x\\udcff" in json.loads(done.stdout)["error"]


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
    with pytest.raises(ArchiveError, match="its plan cannot be read") as raised:
        class_in(archive)
    assert str(path) in str(raised.value)


# What a search keeps


def test_a_journal_full_of_forged_frames_is_read_in_time_that_grows_as_it_does(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    file = BytesIO()
    Journal(file, {})
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
    Journal(file, {})
    assert sum(summed) < 8 * len(file.getvalue())
