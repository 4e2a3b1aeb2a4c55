from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.process_death import journal


def test_what_was_appended_is_read_back_by_round(tmp_path: Path) -> None:
    path = tmp_path / "deaths.jsonl"
    assert journal.read(path) == {}
    for number in (3, 1):
        journal.append(path, {"round": number, "broken": []})
    assert journal.read(path) == {1: {"round": 1, "broken": []}, 3: {"round": 3, "broken": []}}


def test_a_torn_last_line_costs_that_round_and_no_other(tmp_path: Path) -> None:
    path = tmp_path / "deaths.jsonl"
    for number in (1, 2):
        journal.append(path, {"round": number})
    whole = path.read_bytes()
    for torn in range(1, len(whole)):
        path.write_bytes(whole[:torn])
        known = set(journal.read(path))
        assert known == ({1} if torn >= len(whole) // 2 else set()), torn
        journal.append(path, {"round": 9})
        assert set(journal.read(path)) == known | {9}


def test_a_line_that_is_no_result_is_named(tmp_path: Path) -> None:
    path = tmp_path / "deaths.jsonl"
    path.write_text(json.dumps({"round": 1}) + "\nno\n" + json.dumps({"round": 2}) + "\n")
    with pytest.raises(ValueError, match="line 2"):
        journal.read(path)
