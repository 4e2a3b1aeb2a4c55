"""Notes of a batch: each has words, and what is cached is read back."""

from __future__ import annotations

import json

import numpy as np
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
from identification.hypotheses.joint_changes import Change
from identification.signals.position_steps import PositionJump
from identification.signals.row_faults import RowFault, RowFaultKind, RowFaults
from identification.signals.sample_times import SampleTimes
from identification.validation.finding import Finding, RepeatedSamples, Value

ARM = ("shoulder", "elbow")
SIGN = Change("torque sign", (1,))
TURNED = Change("zero", (0,), np.pi / 4.0)
FAULT = RowFault(RowFaultKind.DISPLACED, 0.5, 0.1, 3, ("elbow",))
CACHED: list[Note] = [
    notes.AssumedTorqueConstants(can_be_weighed=True),
    notes.MergedSamples(3, "a.mcap"),
    notes.OtherMeaning(Finding("rows backwards", "wrong", "reverse the rows", "cause"), ARM),
    notes.RepairedArchive(),
    notes.StatedText("two gaps"),
]


@pytest.mark.parametrize("note", CACHED, ids=lambda note: type(note).__name__)
def test_a_cached_note_is_read_back(note: Note) -> None:
    assert note_of_json(json.loads(json.dumps(note_as_json(note)))) == note


@pytest.mark.parametrize(
    "values",
    [
        {"change": SIGN, "alike": (SIGN, TURNED), "error": 3.25},
        {"change": Change("torque order", (0, 1), order=(1, 0))},
        {"error": 0.5, "offsets": (0.0, 0.25), "counts": (1, 2), "names": ("a", "b"), "none": ()},
        {"jumps": (PositionJump("a.mcap", "elbow", 1.0, 0.5),), "unit": "ms"},
        {"faults": RowFaults(RowFaultKind.DISPLACED, (FAULT, FAULT))},
        {"times": SampleTimes(1, True, 2, 1000.0, 0.1, 0.5, 0.1, (1.0, 2.0))},
        {"repeated": (RepeatedSamples("elbow", 3, "a.mcap"),)},
    ],
    ids=lambda values: next(iter(values)),
)
def test_values_of_a_finding_are_read_back(values: dict[str, Value]) -> None:
    finding = Finding("alike", "wrong", "jog and compare", "cause", values, joints=(1,))
    note = notes.OtherMeaning(finding.about(np.array([True, False]), degrees=[4.0, 5.0]), ARM)
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
