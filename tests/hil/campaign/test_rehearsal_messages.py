"""What a rehearsal found, assumed and cannot detect: each has words with its figures."""

from __future__ import annotations

from pathlib import Path

import pytest

from hil.campaign import rehearsal_criteria as criteria
from hil.campaign import twin, undetected
from hil.campaign.oscillation import Oscillation
from hil.campaign.rehearsal_criteria import Judged, WorstMotion
from hil.campaign.rehearsal_messages import (
    assumption_words,
    criterion_record,
    undetected_words,
)
from hil.campaign.rehearsal_record import AS_MODELLED, EFFECTS
from hil.cell import Cell
from identification.excitation.collision import ClosePair, PairExceptions
from tests import messages
from tests.hil.fast_cell import fast_cell

ARCHIVE = Path("/a/excitation_000.mcap")
WORST = WorstMotion(ARCHIVE, 1)
UNSTABLE = WorstMotion(ARCHIVE, 0, Oscillation(1, 110.0, 230.0, 3.5))
MET: dict[Judged, str] = {
    criteria.CurrentShare(AS_MODELLED, 0.62, 0.8, WORST): (
        "as modelled: the largest current is 62 % of its limit (motor of elbow,"
        " excitation_000.mcap), at most 80 % is allowed"
    ),
    criteria.SpeedShare(AS_MODELLED, 0.97, WORST): "completed, at up to 97 % of a speed limit",
    criteria.Undetermined(()): "not determined by the excitation: none",
    criteria.ParameterErrors(12, 2.34, "I1zz", 5.1): "at most 2.34 standard deviations (I1zz), 5.1",
    criteria.UnseenError(1.07, 0): "1.07 times what noise leaves (shoulder), at most 1.2",
}
NOT_MET: dict[Judged, tuple[str, str]] = {
    criteria.CurrentShare(AS_MODELLED, 0.9, 0.8, WORST): (
        "lower acceleration_deg",
        "`hil plot /a/excitation_000.mcap --joint elbow`",
    ),
    criteria.CurrentShare(EFFECTS, 0.9, 0.8, UNSTABLE): (
        "elbow oscillates at 110 Hz, with an amplitude that grows 230 times in 3.5 s",
        messages.MOTION_NOT_AT_FAULT,
    ),
    criteria.SpeedShare(AS_MODELLED, 1.2, WORST): (
        "elbow moved at 120 % of its speed limit (excitation_000.mcap), at most 105 %",
        "lower velocity_deg",
    ),
    criteria.FailedMotion(AS_MODELLED, "it was refused", WorstMotion(ARCHIVE)): (
        "as modelled: it was refused: correct the cause",
        "`hil plot /a/excitation_000.mcap`",
    ),
    criteria.FailedMotion(EFFECTS, "the link is dead", None): (
        "with what the model leaves out: the link is dead",
        "dead",
    ),
    criteria.Undetermined(("I1zz", "m2")): ("I1zz, m2", "design a motion that moves every joint"),
    criteria.ParameterErrors(12, 9.0, "I1zz", 5.1): ("9 standard", "`--again --seed 2`"),
    criteria.UnseenError(1.7, 0): ("1.70 times", "`hil design`"),
    criteria.UndeterminedCriterion("excitation", 0.0, "no rows"): (
        "excitation: cannot be determined",
        "(no rows)",
    ),
}
ASSUMED: dict[twin.Assumption, str] = {
    twin.CurrentNoise(0.05, 0.01): "noise of 0.05 A rms and a resolution of 0.01 A (0.5 % and 0.1",
    twin.DefaultEffects(0.1, 0.2, 0.0005): "ripple of 10 % of the Coulomb torque, friction that"
    " falls by 20 %, springs in the main axes, 0.5 ms",
    twin.ZeroNominal(("coulomb", "viscous")): "only zeros for coulomb, viscous",
    twin.NoLostPackets("shoulder", 0.44, 0.3, 4): (
        "the motor of shoulder turns by 0.44 revolutions in a cycle of 4 ms; the guard allows 0.3"
    ),
}
UNDETECTED: dict[undetected.Undetected, str] = {
    undetected.CopiedFigures.SCALES: "torque constants and current limits",
    undetected.CopiedFigures.SHAPES: "floor, walls and shapes",
    undetected.UncheckedPairs(
        PairExceptions((ClosePair("base", "link1", 0.0, 0.001),))
    ): "base and link1 (0.000 to 0.001 m)",
    undetected.CopiedDrives(("joint_sign",)): "joint_sign of [drive_train]: the simulated arm",
}


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Cell:
    return fast_cell(tmp_path_factory.mktemp("cell"))


@pytest.mark.parametrize(("judged", "words"), MET.items(), ids=list(MET.values()))
def test_what_is_met_states_its_figures(judged: Judged, words: str, cell: Cell) -> None:
    record = criterion_record(judged, cell)
    assert record.passed and words in record.sentence
    assert "`hil" not in record.sentence and "again" not in record.sentence, "no remedy"


@pytest.mark.parametrize(
    ("judged", "words"), NOT_MET.items(), ids=[first for first, _ in NOT_MET.values()]
)
def test_what_is_not_met_has_a_remedy(judged: Judged, words: tuple[str, str], cell: Cell) -> None:
    record = criterion_record(judged, cell)
    assert not record.passed
    assert words[0] in record.sentence and words[1] in record.sentence


def test_a_value_that_is_not_finite_is_not_met(cell: Cell) -> None:
    record = criterion_record(criteria.UnseenError(float("nan"), 0), cell)
    assert (record.value, record.passed) == (None, False)


@pytest.mark.parametrize(("assumed", "words"), ASSUMED.items(), ids=list(ASSUMED.values()))
def test_each_assumption_has_words(assumed: twin.Assumption, words: str) -> None:
    assert words in assumption_words(assumed)


@pytest.mark.parametrize(("error", "words"), UNDETECTED.items(), ids=list(UNDETECTED.values()))
def test_what_is_not_detected_has_words(error: undetected.Undetected, words: str) -> None:
    assert words in undetected_words(error)
