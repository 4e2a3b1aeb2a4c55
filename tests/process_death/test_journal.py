from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.process_death import journal
from tests.process_death.__main__ import main


def result(number: int) -> dict[str, object]:
    return {"round": number, "broken": [], "seconds": 9.0, "processor": 2.0}


def test_what_was_appended_is_read_back_by_round(tmp_path: Path) -> None:
    path = tmp_path / "deaths.jsonl"
    assert journal.read(path) == {}
    for number in (3, 1):
        journal.append(path, result(number))
    assert journal.read(path) == {1: result(1), 3: result(3)}


def test_a_torn_last_line_costs_that_round_and_no_other(tmp_path: Path) -> None:
    path = tmp_path / "deaths.jsonl"
    for number in (1, 2):
        journal.append(path, result(number))
    whole = path.read_bytes()
    for torn in range(1, len(whole)):
        path.write_bytes(whole[:torn])
        known = set(journal.read(path))
        assert known == ({1} if torn >= len(whole) // 2 else set()), torn
        journal.append(path, result(9))
        assert set(journal.read(path)) == known | {9}


def test_a_line_that_is_no_result_is_named(tmp_path: Path) -> None:
    path = tmp_path / "deaths.jsonl"
    path.write_text(json.dumps(result(1)) + "\nno\n" + json.dumps(result(2)) + "\n")
    with pytest.raises(ValueError, match="line 2"):
        journal.read(path)


@pytest.mark.parametrize(
    "content",
    [
        b'{"kind": "begin", "rate": 1000}\n',
        b'{"round": 3, "harm": "cut in x", "broken": []}\n',
        b"[1, 2]\n",
        b"\xff\xfe\n",
    ],
)
def test_a_foreign_journal_is_told_of_in_a_sentence(
    content: bytes, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "deaths.jsonl"
    path.write_bytes(content)
    assert main(["--rounds", "1", "--journal", str(path)]) == 2
    assert capsys.readouterr().err == f"error: {path}, line 1 is no result of a round\n"
    assert path.read_bytes() == content


def test_a_folder_is_no_journal(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--rounds", "1", "--journal", str(tmp_path)]) == 2
    assert f"error: {tmp_path} cannot be read" in capsys.readouterr().err
