"""What limits a comparison of campaigns: each note has words."""

from __future__ import annotations

import pytest

from hil.batch.cluster import SkippedArchive
from hil.batch.setup import Setup
from hil.compare import notes
from hil.compare.messages import campaign_words, comparison_lines
from hil.compare.notes import CampaignName
from hil.pipeline.notes import Note, RepairedArchive

MARCH = CampaignName("march")
JUNE = CampaignName("june")
WORDS: dict[Note, str] = {
    notes.UnusableArchive(SkippedArchive("a.mcap", "it is damaged")): (
        "a.mcap could not be used: it is damaged"
    ),
    notes.OtherSetups(((MARCH, Setup()), (JUNE, Setup(delay=0.002)))): (
        "different payloads or delays, compensated (march: nothing; june: torque lags by 2 ms)"
    ),
    notes.SingleRepetition(MARCH): "march: with one repetition, uncertainty includes noise only",
    notes.OfCampaign(MARCH, RepairedArchive()): "march: data were lost when it was repaired",
    notes.UnknownDailyVariation(): "compare campaigns at the same temperature",
}


@pytest.mark.parametrize(("note", "words"), WORDS.items(), ids=list(WORDS.values()))
def test_each_note_has_words(note: Note, words: str) -> None:
    (line,) = comparison_lines([note])
    assert words in line


@pytest.mark.parametrize(
    ("name", "words"),
    [
        (MARCH, "march"),
        (CampaignName("march", day="2026-03-01"), "march (2026-03-01)"),
        (CampaignName("march", Setup(delay=0.002)), "march, torque lags by 2 ms"),
        (CampaignName("march", Setup(), "2026-03-01"), "march, nothing stated (2026-03-01)"),
    ],
)
def test_a_name_has_setup_and_day_where_they_are_given(name: CampaignName, words: str) -> None:
    assert campaign_words(name) == words


def test_every_kind_is_worded_here() -> None:
    kinds = {kind for kind in Note.__subclasses__() if kind.__module__ == notes.__name__}
    assert kinds == {*map(type, WORDS)}
