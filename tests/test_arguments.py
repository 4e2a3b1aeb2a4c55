"""The long commands refuse numbers and journals that make no sense, before they do anything."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

from tests.endurance import __main__ as endurance
from tests.journal import Journal, JournalError, entries, rounds
from tests.process_death import __main__ as process_death
from tests.simulate import __main__ as simulate
from tests.simulate.verdicts import Verdict

Command = Callable[[list[str]], int]


@pytest.mark.parametrize(
    ("command", "arguments", "named"),
    [
        (simulate.main, ["--seeds", "-3"], "--seeds: '-3' is not a whole number of 0 or more"),
        (process_death.main, ["--rounds", "-1"], "--rounds: '-1' is not"),
        (process_death.main, ["--rounds", "1", "--start", "x"], "--start: 'x' is not"),
        (endurance.main, ["--minutes", "nan"], "--minutes: 'nan' is not"),
    ],
)
def test_invalid_numbers_are_refused_with_their_option(
    command: Command,
    arguments: list[str],
    named: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    journal = tmp_path / "journal.jsonl"
    with pytest.raises(SystemExit) as refused:
        command([*arguments, "--journal", str(journal)])
    assert refused.value.code == 2
    assert named in capsys.readouterr().err
    assert not journal.exists()


COMMANDS: dict[str, tuple[Command, list[str], dict[str, Any]]] = {
    "endurance": (endurance.main, ["--merge"], {"kind": "begin", "rate": 1000}),
    "deaths": (process_death.main, ["--rounds", "1"],
               {"round": 3, "broken": [], "seconds": 9.0, "processor": 2.0}),
    "simulate": (simulate.main, ["--seeds", "1"],
                 asdict(Verdict(3, "an arm", (), (), (), (), 9))),
}  # fmt: skip
"""Long commands, how they are called, and a line of their journals."""
OTHERS = {
    "a list": b"[1, 2]\n",
    "notes": b"milk\n",
    "another coding": b"\xff\xfe\n",
    "no number": b'{"round": [], "harm": "", "broken": [], "seconds": 1, "processor": 1}\n',
    **{name: json.dumps(line).encode() + b"\n" for name, (_, _, line) in COMMANDS.items()},
}


def read(path: Path) -> list[int]:
    return entries(path, lambda entry: entry["n"], "number")


@pytest.mark.parametrize("sync_every", [0.0, 60.0])
def test_what_was_added_is_read_back_in_order(tmp_path: Path, sync_every: float) -> None:
    """Each line before the journal is closed."""
    path = tmp_path / "new" / "j.jsonl"
    assert read(path) == []
    for k, n in enumerate((3, 1, 3), 1):
        with Journal(path, sync_every) as journal:
            journal.add(n=n)
            assert read(path) == [3, 1, 3][:k]
    with Journal(None) as journal:
        journal.add(n=1)
    assert rounds(None) == {}


def test_only_a_truncated_last_line_is_lost(tmp_path: Path) -> None:
    path = tmp_path / "j.jsonl"
    whole = b'{"n":1}\n{"n":2}\n'
    for size in range(1, len(whole)):
        path.write_bytes(whole[:size])
        complete = [1] if size >= len(whole) // 2 else []
        assert read(path) == complete, size
        with Journal(path) as journal:
            journal.add(n=9)
        assert read(path) == [*complete, 9]


@pytest.mark.parametrize("line", ["no", "{}", "[]", "7", "null", '{"n":1}{"n":2}'])
def test_a_line_that_is_no_entry_is_named(tmp_path: Path, line: str) -> None:
    path = tmp_path / "j.jsonl"
    path.write_text(f'{{"n":1}}\n{line}\n{{"n":2}}\n')
    with pytest.raises(JournalError) as caught:
        read(path)
    assert str(caught.value) == f"{path}, line 2 is no number; name another --journal"
    with pytest.raises(JournalError, match="cannot be read"):
        read(tmp_path)
    with pytest.raises(JournalError, match="cannot be written: Is a directory"):
        Journal(tmp_path)


def test_rounds_are_known_by_number_and_the_last_of_one_counts(tmp_path: Path) -> None:
    path = tmp_path / "j.jsonl"
    with Journal(path) as journal:
        for n, text in ((4, "a"), (2, "b"), (4, "c")):
            journal.add(round=n, text=text)
    assert {n: result["text"] for n, result in rounds(path, "text").items()} == {4: "c", 2: "b"}
    with pytest.raises(JournalError, match="line 1 is no result of a round"):
        rounds(path, "harm")


@pytest.mark.parametrize(
    ("name", "other"), [(name, other) for name in COMMANDS for other in OTHERS if other != name]
)
def test_journals_of_other_commands_are_refused_unchanged(
    name: str, other: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "j.jsonl"
    path.write_bytes(OTHERS[other])
    command, arguments, _ = COMMANDS[name]
    assert command([*arguments, "--journal", str(path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{path}, line 1 is no " in line
    assert line.endswith("; name another --journal")
    assert path.read_bytes() == OTHERS[other]
