"""What a stranger made up inside files of ours, with seals that are right."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from hil.archive import Archive, ArchiveHeader
from hil.study.records import class_in

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
