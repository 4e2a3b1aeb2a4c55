"""Rounds as a person plays them, what is drawn for them, and planted defects that they find."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, get_args

import pytest

from hil.campaign.plan import design
from hil.progress import Silent
from tests.hil.fast_cell import fast_cell
from tests.process_death.defects import DEFECTS
from tests.process_death.laws import broken_by
from tests.process_death.play import NOISE, SHORT, finished
from tests.process_death.rig import Strike, made, run
from tests.process_death.rounds import VICTIMS, Moment, Victim, drawn

ROOT: Final = Path(__file__).resolve().parents[2]


def process_death(*options: str) -> tuple[dict[str, Any], str]:
    """What `python -m tests.process_death --json` prints, and its standard error."""
    done = subprocess.run(
        [sys.executable, "-m", "tests.process_death", "--json", *options],
        cwd=ROOT, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode in (0, 1), done.stderr
    report: dict[str, Any] = json.loads(done.stdout)
    assert done.returncode == (1 if report["failed"] else 0)
    return report, done.stderr


@pytest.mark.parametrize("first", [0, 25])
def test_the_arm_rests_and_the_campaign_is_completed(first: int) -> None:
    """Whoever is killed; three rounds at a time: most of their time is waiting."""
    report, errors = process_death("--start", str(first), "--rounds", "25", "--jobs", "3")
    assert report["ran"] == 25
    assert not report["failed"], errors
    assert report["nobody_killed"] <= 6, "the rounds must come to their kills"


def test_rounds_are_known_by_number_and_kill_all_at_all_moments() -> None:
    assert drawn(417) == drawn(417)
    rounds = [drawn(number) for number in range(1000)]
    assert len({str(one) for one in rounds[:200]}) > 190
    assert [one.victims[0] for one in rounds[:4]] == list(VICTIMS)
    assert all(len(set(one.victims)) == len(one.victims) for one in rounds)
    assert {one.trigger.moment for one in rounds} == set(get_args(Moment))
    pairs = {one.victims[:2] for one in rounds if len(one.victims) > 1}
    assert len(pairs) == len(VICTIMS) * (len(VICTIMS) - 1)


def round_in_which(victim: Victim) -> int:
    """The first round that kills it alone, half way through a repetition."""
    for number in range(10_000):
        one = drawn(number)
        trigger = one.trigger
        half_way = trigger.count in (3, 4) and 0.25 < trigger.way < 0.45
        if one.victims == (victim,) and trigger.moment == "motion" and half_way and not one.loops:
            return number
    raise AssertionError("no round is like that")


@pytest.mark.parametrize(
    ("victim", "how", "status", "words"),
    [
        ("supervisor", "SIGINT", 4, "was stopped: the supervisor asked for a stop"),
        pytest.param("supervisor", "SIGHUP", 4, "was stopped", marks=pytest.mark.slow),
        (
            *("archive", "SIGSTOP", 4),
            "gave no sign of life for 5 s and was ended; the arm was brought to rest",
        ),
        ("archive", "full disk", 2, "cannot be written further"),
    ],
)
def test_what_is_no_kill_brings_the_arm_to_rest_too(
    victim: Victim, how: Strike, status: int, words: str, tmp_path: Path
) -> None:
    """Ctrl-C, a terminal that is closed, an archive process that hangs, a full disk."""
    cell = fast_cell(tmp_path, **SHORT).with_values({"simulation.current_noise": NOISE})
    campaign = made(tmp_path, cell, design(cell, Silent()))
    played = replace(drawn(round_in_which(victim)), over_sockets=False)
    seen = run(campaign, played, (victim,), tmp_path / "said.json", how=how)
    assert broken_by(seen, campaign)[0] == []
    assert seen.status == status
    assert words in seen.said["text"]
    assert finished(campaign, played, seen, tmp_path) == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "victim"),
    [
        ("archive-flushes-rarely", "archive"),
        ("archive-drops-records", "archive"),
        ("exchange-leaves-the-arm", "supervisor"),
    ],
)
def test_a_planted_defect_is_found(name: str, victim: Victim, tmp_path: Path) -> None:
    """In a round that can show it; a law that nothing can break would be none."""
    number = round_in_which(victim)
    journal = tmp_path / "journal.jsonl"
    where = ("--start", str(number), "--rounds", "1")
    report, _ = process_death(*where, "--defect", name, "--journal", str(journal))
    assert report["seeds_failed"] == [number]
    broken = json.loads(journal.read_text())["broken"]
    assert any(DEFECTS[name].found in text for text in broken), broken
    healthy, errors = process_death(*where)
    assert not healthy["failed"], errors
