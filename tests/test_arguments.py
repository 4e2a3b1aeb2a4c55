"""The long commands refuse numbers that make no sense, before they do anything."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.disk import damage
from tests.endurance import __main__ as endurance
from tests.fuzz import __main__ as fuzz
from tests.process_death import __main__ as process_death
from tests.simulate import __main__ as simulate

Command = Callable[[list[str]], int]


@pytest.mark.parametrize(
    ("command", "arguments", "named"),
    [
        (simulate.main, ["--seeds", "-3"], "--seeds: '-3' is not a whole number of 0 or more"),
        (simulate.main, ["--seeds", "3", "--jobs", "0"], "--jobs: '0' is not"),
        (process_death.main, ["--rounds", "-1"], "--rounds: '-1' is not"),
        (process_death.main, ["--rounds", "1", "--start", "x"], "--start: 'x' is not"),
        (process_death.main, ["--rounds", "1", "--jobs", "0"], "--jobs: '0' is not"),
        (damage.main, ["--rounds", "1.5"], "--rounds: '1.5' is not"),
        (damage.main, ["--rounds", "1", "--start", "-1"], "--start: '-1' is not"),
        (fuzz.main, ["urdf", "--minutes", "0"], "--minutes: '0' is not a time above 0"),
        (fuzz.main, ["urdf", "--stop-after", "inf"], "--stop-after: 'inf' is not"),
        (fuzz.main, ["urdf", "--jobs", "-2"], "--jobs: '-2' is not"),
        (endurance.main, ["--minutes", "nan"], "--minutes: 'nan' is not"),
    ],
)
def test_a_number_that_makes_no_sense_is_refused_by_its_option(
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
