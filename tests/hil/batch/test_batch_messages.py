"""Notes of a batch: each has words, and what is cached is read back."""

from __future__ import annotations

import json

import pytest

from hil.batch import notes as batch_notes
from hil.batch.messages import batch_lines
from hil.batch.notes import (
    ARCHIVE_NOTES,
    DifferentSetups,
    MoreNotes,
    OfSomeArchives,
    note_as_json,
    note_of_json,
)
from hil.batch.setup import Setup
from hil.pipeline import notes
from hil.pipeline.notes import Note

CACHED: list[Note] = [
    notes.AssumedTorqueConstants(can_be_weighed=True),
    notes.MergedSamples(3, "a.mcap"),
    notes.OtherMeaning("torque sign", "all torques are negative", "correct it"),
    notes.RepairedArchive(),
    notes.StatedText("two gaps"),
]


@pytest.mark.parametrize("note", CACHED, ids=lambda note: type(note).__name__)
def test_a_cached_note_is_read_back(note: Note) -> None:
    assert note_of_json(json.loads(json.dumps(note_as_json(note)))) == note


def test_every_cached_note_is_tried() -> None:
    assert {type(note) for note in CACHED} == {*ARCHIVE_NOTES.values()}


WORDS: dict[Note, str] = {
    OfSomeArchives(notes.StatedText("two gaps"), 2, 4, "spring/a.mcap"): (
        "2 of 4 archives, such as spring/a.mcap: two gaps"
    ),
    MoreNotes(3): "3 more warnings are listed with the repetitions",
    DifferentSetups((Setup(), Setup(0.002, 3.0, (0.0, 0.0, 0.1), frame="tool0"))): (
        "compensated: nothing; torque lags by 2 ms, carries 3 kg at (0, 0, 0.1) m in tool0"
    ),
    notes.RepairedArchive(): "data were lost when it was repaired",
}


@pytest.mark.parametrize(("note", "words"), WORDS.items(), ids=list(WORDS.values()))
def test_each_note_has_words(note: Note, words: str) -> None:
    (line,) = batch_lines([note])
    assert line.endswith(words)


def test_every_kind_is_worded_here() -> None:
    kinds = {kind for kind in Note.__subclasses__() if kind.__module__ == batch_notes.__name__}
    assert kinds < {*map(type, WORDS)}
