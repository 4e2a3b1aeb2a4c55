"""A planted defect is found: a law that nothing can break would be none."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.process_death.command import process_death
from tests.process_death.defects import DEFECTS
from tests.process_death.rounds import drawn

MID_MOTION = {
    "archive-flushes-rarely": "archive",
    "archive-drops-records": "archive",
    "exchange-leaves-the-arm": "supervisor",
}
"""Who has to die in mid-motion for a defect to show."""


def round_in_which(victim: str) -> int:
    """The first round that kills it alone, half way through a repetition."""
    for number in range(10_000):
        one = drawn(number)
        trigger = one.trigger
        half_way = trigger.count in (3, 4) and 0.25 < trigger.way < 0.45
        if one.victims == (victim,) and trigger.moment == "motion" and half_way and not one.loops:
            return number
    raise AssertionError("no round is like that")


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(DEFECTS))
def test_a_planted_defect_is_found_in_the_round_that_can_show_it(name: str, tmp_path: Path) -> None:
    number = round_in_which(MID_MOTION[name])
    journal = tmp_path / "journal.jsonl"
    where = ("--start", str(number), "--rounds", "1")
    report, _ = process_death(*where, "--defect", name, "--journal", str(journal))
    assert report["seeds_failed"] == [number]
    broken = json.loads(journal.read_text())["broken"]
    assert any(DEFECTS[name].found in text for text in broken), broken
    healthy, errors = process_death(*where)
    assert not healthy["failed"], errors
