"""What a stranger made up inside files of ours, with seals that are right."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest

from hil.archive import Archive, ArchiveHeader
from hil.batch.cache import _HEAD, _MAGIC, _TEXT, Store, decoded, encoded
from hil.study.analysis import class_of, plan_in

HEADER = {"kind": "move", "joint_names": '["a"]', "attachments": "[]"}


@pytest.mark.parametrize(
    ("code", "shape"),
    [
        ("<f8", [10**30]),
        ("<f8", [-1]),
        ("<f8", [1.0]),
        ("<f8", [float("inf")]),
        ("(2,", [1]),
        ("f8,,", [1]),
        ("O", [1]),
        (None, [1]),
        ([["a", "<f8"]], [1]),
    ],
)
def test_a_forged_entry_of_a_cache_is_none(code: object, shape: list[float]) -> None:
    good = encoded("key", {}, {"a": np.zeros(1)})
    assert decoded(good, "key") is not None
    text = json.dumps({"key": "key", "arrays": [["a", code, shape]], "header": {}}).encode()
    body = _TEXT.pack(len(text)) + text + bytes(8)
    forged = _HEAD.pack(_MAGIC, len(body), zlib.crc32(body)) + body
    assert decoded(forged, "key") is None


KEY = "ab" * 32


FORGED: tuple[object, ...] = (
    *([["a", "|O", [1]]], [["a", "<f8", [1 << 40]]], [["a", "?!", []]], [["a", "<f8", [-1]]]),
    *([["a", "<f8", [1 << 62, 4]]], [[]], 3, [["a", 7, {}]]),
)


@pytest.mark.parametrize("arrays", FORGED)
def test_a_kept_sum_that_somebody_forged_badly_counts_as_absent(
    arrays: object, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dumps = json.dumps
    monkeypatch.setattr(
        "hil.batch.cache.json.dumps", lambda found: dumps(found | {"arrays": arrays})
    )
    assert decoded(encoded(KEY, {}, {}), KEY) is None
    store = Store(tmp_path)
    store.put(KEY, {}, {})
    assert store.get(KEY) is None


@pytest.mark.parametrize("value", [10**400, True, float("nan"), float("inf"), "1", None])
def test_planted_values_that_are_no_numbers_are_none(value: object) -> None:
    def planted(of_x: object) -> object:
        return ArchiveHeader.of({**HEADER, "planted": json.dumps({"x": of_x})}).planted

    assert planted(-1.5) == {"x": -1.5}
    assert planted(value) == {}


@pytest.mark.parametrize("text", [b"[1]", b"{bad", b"[" * 100_000, b"\xff", b'{"trajectory": 3}'])
def test_a_plan_that_is_none_tells_no_other_class(text: bytes, tmp_path: Path) -> None:
    header = ArchiveHeader.of(HEADER)
    told = plan_in(Archive(tmp_path, header, None, {"plan.json": text}, {}, (), None))
    assert class_of(told) == "fly-by"


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
