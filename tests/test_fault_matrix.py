"""Every fault in every situation has the outcome that was decided for it, and breaks no law.

The laws, checked in every run: each fresh packet is answered once and with its own number; no
set-point leaves for an axis that is not open or has no drive; those that leave keep position,
velocity, acceleration and jerk; none moves once the motion was lost or refused; the arm comes to
rest; and a new motion, requested after somebody has switched the drive on again, completes.
`python -m tests.fault_matrix` prints the table.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from drivers import CyclicPacket, State
from tests.fault_matrix.faulty_runs import (
    BEHAVIOURS,
    FAULTS,
    FAULTS_AT_SPEED,
    SITUATIONS,
    SPEEDS,
    behaviours,
    cases,
    cycles_without_a_fault,
    play,
    play_at,
)
from tests.fault_matrix.laws import broken_in_records, broken_on_the_wire
from tests.fault_matrix.outcomes import AT_SPEED, EXPECTED, HEADING, at_speed, row


def test_the_table_has_every_fault_in_every_situation() -> None:
    assert list(EXPECTED) == list(FAULTS)
    for fault, outcomes in EXPECTED.items():
        assert list(outcomes) == list(SITUATIONS), fault
        for situation, texts in outcomes.items():
            assert len(texts) in (1, len(behaviours(fault, situation))), (fault, situation)


def test_the_document_shows_this_table() -> None:
    document = Path(__file__).parents[1] / "docs" / "fault-matrix.md"
    table = HEADING + "".join(row(fault, outcomes) for fault, outcomes in EXPECTED.items())
    assert table in document.read_text(encoding="utf-8")


def test_without_a_fault_every_situation_comes_about() -> None:
    assert set(SITUATIONS) - {"open at rest"} <= set(cycles_without_a_fault(True))
    assert "open at rest" in cycles_without_a_fault(False)


@pytest.mark.parametrize(
    ("fault", "situation", "while_silent"),
    [pytest.param(*case, id=f"{case[0]}, {case[1]}, {case[2]}") for case in cases()],
)
def test_fault(fault: str, situation: str, while_silent: str) -> None:
    run = play(fault, situation, while_silent)
    texts = EXPECTED[fault][situation]
    expected = texts[behaviours(fault, situation).index(while_silent) if len(texts) > 1 else 0]
    assert run.outcome == expected
    assert run.broken == []
    if expected != "no start":
        assert run.recovery.startswith("completed")


def test_the_document_shows_the_table_of_speeds() -> None:
    document = Path(__file__).parents[1] / "docs" / "fault-matrix.md"
    assert at_speed() in document.read_text(encoding="utf-8")


@pytest.mark.parametrize("while_silent", BEHAVIOURS)
@pytest.mark.parametrize("speed", SPEEDS)
@pytest.mark.parametrize("fault", FAULTS_AT_SPEED)
def test_fault_at_speed(fault: str, speed: float, while_silent: str) -> None:
    """The arm comes to rest, whatever the controller did meanwhile."""
    run = play_at(fault, speed, while_silent)
    expected = AT_SPEED[fault][SPEEDS.index(speed)].split(" / ")
    assert run.outcome.partition(" (")[0] == expected[BEHAVIOURS.index(while_silent)]
    assert run.broken == []
    assert run.recovery.startswith("completed")


@pytest.fixture(scope="module")
def sound():
    """A run in which nothing is wrong but one packet."""
    return play("packet lost", "moving")


class TestTheLawsCanBeBroken:
    """A law that nothing breaks proves nothing: each is shown a run with one thing changed."""

    @staticmethod
    def altered(sound, state, alter) -> list[str]:
        """What is found if the answer to one packet, of a given state, is altered."""
        records = sound.session._ring.last(8192)
        number = records["number"][records["state"] == state][5]
        exchanged = [list(pair) for pair in sound.link.exchanged]
        for pair in exchanged:
            if len(pair[0]) == 84 and int.from_bytes(pair[0][:4], "little") == number:
                pair[1] = alter(pair[1])
        return list(broken_on_the_wire(exchanged, sound.session.counters))

    @staticmethod
    def further(reply: bytes, distance: float = 0.3) -> bytes:
        answer = CyclicPacket.decode(reply, 2)
        axes = answer.axes.copy()
        axes["d"][1, 0] += distance
        return CyclicPacket(answer.number, answer.status, answer.functionality, axes).encode()

    def test_nothing_is_found_where_nothing_was_altered(self, sound) -> None:
        assert self.altered(sound, State.OPEN, lambda reply: reply) == []

    @pytest.mark.parametrize("state", [State.DRIVE_OFF, State.CLOSED, State.OPEN])
    def test_a_set_point_elsewhere_is_found(self, sound, state: State) -> None:
        found = self.altered(sound, state, self.further)
        assert len(found) == 1
        assert "set-point" in found[0]

    def test_an_answer_too_few_or_with_another_number_is_found(self, sound) -> None:
        assert len(self.altered(sound, State.OPEN, lambda reply: None)) == 2
        assert "number" in self.altered(sound, State.OPEN, lambda reply: b"\1" + reply[1:])[0]

    @pytest.mark.parametrize(
        ("field", "state", "change", "text"),
        [
            ("commanded_position", State.OPEN, 1e-4, "derivative 3"),
            ("commanded_position", State.OPEN, 5.0, "outside the joints' range"),
            ("commanded_velocity", State.OPEN, 0.1, "after the motion was lost"),
        ],
    )
    def test_a_record_out_of_bounds_is_found(self, sound, field, state, change, text) -> None:
        records = sound.session._ring.last(8192)
        assert list(broken_in_records(records, slice(0, 0))) == []
        row = np.flatnonzero(records["state"] == state)[20]
        records[field][row] += change
        assert any(text in found for found in broken_in_records(records, slice(0, len(records))))

    def test_a_set_point_for_a_closed_axis_is_found(self, sound) -> None:
        records = sound.session._ring.last(8192)
        records["commanded_position"][np.flatnonzero(records["state"] == State.CLOSED)[0]] = 0.0
        assert any("without open mode" in found for found in broken_in_records(records, None))
