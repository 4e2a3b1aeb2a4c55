"""What results say about recordings and settings: each note has words with its figures."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from hil.pipeline import notes
from hil.pipeline.note_messages import note_lines
from hil.pipeline.notes import Note
from hil.pipeline.torque_scale import ScaleSource, TorqueScale
from identification.estimators.delay import DelayEstimate
from identification.signals.masks import RowReason
from identification.signals.sample_times import SampleTimes, time_base
from identification.validation.consistency import ConsistencyCheck
from identification.validation.finding import Finding

BACKWARDS = Finding("rows backwards", "wrong", "reverse the rows", "cause")
DELAY = DelayEstimate(
    delay=4e-3,
    std=1e-4,
    assumed=0.0,
    cycle=1e-3,
    interval_factor=2.0,
    reason=None,
    significant=True,
)
TIMES = SampleTimes(3, True, 2, 250.0, 0.1, 0.2, 0.01, (4.0, 1.5))
SCALE = TorqueScale(np.array([0.03]), by_currents=True, source=ScaleSource.DATA_SHEET)
WORDS: dict[Note, str] = {
    notes.StatedText("a chunk is missing", "a.mcap"): "a.mcap: a chunk is missing",
    notes.RejectedArchive(
        "a.mcap", "it was held"
    ): "a.mcap was rejected and is not used: it was held",
    notes.EndedEarly("a.mcap", "stopped"): "a.mcap ended stopped",
    notes.NotJudged("a.mcap"): "a.mcap is not in its campaign's manifest.json",
    notes.AssumedTorqueConstants(can_be_weighed=True): "`hil torque-constants`",
    notes.AssumedPayload(): "[robot.payload]",
    notes.RepairedArchive(): "data were lost when it was repaired",
    notes.OtherMeaning(BACKWARDS, ("shoulder", "elbow")): "backwards in time: as recorded",
    notes.RestPredicted(0.7): "the first 70 %",
    notes.LastHeldOut("a.mcap"): "the last recording, a.mcap, was held out",
    notes.MergedSamples(3, "a.mcap"): "a.mcap: 3 samples",
    notes.TimesUsed("a.mcap", TIMES): "a.mcap: dropped 3 rows",
    notes.UnevenClock("a.mcap", time_base(np.array([0.0, 1.0, 4.0]))): "a.mcap: 3 samples in 4 s",
    notes.PositionNoise(at_standstill=True): "at standstill",
    notes.EstimatedDelay(DELAY): "4.000 ms ± 0.200 ms",
    notes.NoOtherDelay(2e-3, beside_low_pass=True): "2 ms was applied in addition to the low-pass",
    notes.CompensatedDelay(4e-3, 2e-3): "4 ms of all axes was compensated, the estimate combined",
    notes.DelayNotApplied(DELAY, notes.WhyNotApplied.PREDICTS_WORSE): "as it predicts worse",
    notes.LoadNotConverged(0.02, 7): "by 2.0 % in pass 7",
    notes.IntervalUnits(SCALE): "assuming torque constants to 3 %",
    notes.ElasticGears(): "elastic gears",
    notes.PoorlySeparated(1e9, from_sums=True): "1e+09",
    notes.UnrestrictedBodies("it did not converge"): "because it did not converge",
    notes.ManyOutliers("elbow", 0.05): "5 % of the rows of elbow",
    notes.ReweightingNotConverged(50): "50 iterations",
    notes.PriorContradicted(("I2zz", "m3"), 4.0): "I2zz, m3 differ by more than 4 standard",
    notes.WeakInstruments(("I2zz",)): "too weak for I2zz",
    notes.NotConsistent("no solution"): "parameters were found: no solution",
    notes.NotEssential(notes.NoEssentialParameters.NOTHING_HELD_OUT): "there is none",
}


def leaves(kind: type[Note]) -> Iterator[type[Note]]:
    yield from kind.__subclasses__()


@pytest.mark.parametrize(("note", "words"), WORDS.items(), ids=lambda each: type(each).__name__)
def test_the_words_of_a_note_have_its_figures(note: Note, words: str) -> None:
    assert words in note_lines([note])[0]


def test_rows_that_are_left_out_have_their_reasons() -> None:
    every = dict.fromkeys(RowReason, 0.01)
    (line,) = note_lines([notes.FittedRows(2000, every)])
    fitted = 100 - len(RowReason)
    assert line.startswith(f"{fitted}.0 % of 2000 rows (one joint at one sample) were fitted")
    assert line.count("1.00 %") == len(RowReason)


def test_every_kind_of_note_is_worded_here() -> None:
    of_checks = {notes.FittedRows, notes.CostlyBodies}  # above, and by `consistency_words`
    ours = {kind for kind in leaves(Note) if kind.__module__ == notes.__name__}
    assert {*map(type, WORDS)} | of_checks == ours


def test_costly_bodies_are_worded_as_in_the_report(monkeypatch: pytest.MonkeyPatch) -> None:
    check = object.__new__(ConsistencyCheck)
    monkeypatch.setattr("hil.pipeline.note_messages.consistency_words", lambda _: "costly")
    assert note_lines([notes.CostlyBodies(check)]) == ["costly"]
