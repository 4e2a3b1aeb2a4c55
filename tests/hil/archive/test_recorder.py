"""Recording of one interval of a link: which rows belong to it, how it ended.

Also the buffer of what arrives while no archive is open.
"""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.c4g_packets import InitPacket
from drivers.cycle_records import cycle_dtype
from drivers.drive_train import DriveTrain
from drivers.events import (
    ControllerRemark,
    InitReceived,
    LinkLost,
    MotionEnded,
    MotionStarted,
    StateChanged,
)
from drivers.exchange.event_log import ExchangeEvent
from drivers.states import State
from hil.archive import Archive, ArchiveSpec, Recorder, open_archive
from hil.archive.process import BUFFERED_CYCLES, PreTriggerBuffer
from hil.archive.recorder import _EVENT_TEXTS
from hil.cell import Cell
from hil.control.simulated_cell import simulated_controller
from sim_fixtures.ns16 import CELL_PATH
from tests.near import near

PERIOD = 0.001
GEAR = 50.0
CONSTANT = 0.5


@pytest.fixture
def spec(tmp_path: Path) -> ArchiveSpec:
    return ArchiveSpec(
        tmp_path / "excitation_000_a1.mcap",
        joint_names=("a", "b"),
        period=PERIOD,
        metadata={"simulated": "yes"},
        durable=False,
    )


@pytest.fixture
def recorder(spec: ArchiveSpec) -> Recorder:
    ones = np.ones(2)
    drives = DriveTrain(
        gear_ratio=GEAR * ones,
        calibration=0.0 * ones,
        joint_sign=ones,
        joint_offset=0.0 * ones,
        torque_constant=CONSTANT * ones,
        current_limit=10.0 * ones,
    )
    return Recorder(spec.open(), drives)


def cycles(first: int, count: int) -> NDArray[np.void]:
    rows = np.zeros(count, cycle_dtype(2))
    rows["cycle"] = first + np.arange(count)
    rows["target_current"] = 2.0
    return rows


def read(recorder: Recorder) -> Archive:
    ended = recorder.ended
    recorder.close(ended.outcome if ended else "stopped", ended.reason if ended else "")
    return open_archive(recorder.writer.path)


def ended(outcome: str, cycle: int) -> MotionEnded:
    return MotionEnded(outcome, "as it came", 0, cycle)  # type: ignore[arg-type]


def bytes_of_an_init() -> bytes:
    controller = simulated_controller(Cell.load(CELL_PATH))
    for _ in range(9):
        packet = controller.next_packet()
        assert packet
        number = int.from_bytes(packet[:2], "little", signed=True)
        controller.accept((number + 1).to_bytes(2, "little") + packet[2:])
    init = controller.next_packet()
    assert init is not None
    return init


class TestRecorder:
    def test_interval_is_complete_when_its_motion_rests(self, recorder: Recorder) -> None:
        recorder.record(cycles(0, 100), [MotionStarted(0, 10)])
        assert not recorder.complete
        recorder.record(cycles(100, 50), [ended("completed", 140)])
        assert recorder.complete
        archive = read(recorder)
        assert archive.n_samples == 150
        assert [event.name for event in archive.events] == ["MotionStarted", "MotionEnded"]

    @pytest.mark.parametrize("outcome", ["refused", "lost"])
    def test_aftermath_of_a_failed_motion_is_recorded(
        self, recorder: Recorder, outcome: str
    ) -> None:
        recorder.record(cycles(0, 100), [ended(outcome, 80)])
        assert not recorder.complete
        recorder.record(cycles(100, 1000), [])
        assert recorder.complete
        assert read(recorder).columns["cycle"][-1] == 80 + 500

    def test_new_session_is_not_in_the_same_file(self, recorder: Recorder) -> None:
        new = [StateChanged(State.INIT, State.DRIVE_OFF, 3)]
        both = np.concatenate([cycles(1000, 50), cycles(0, 30)])
        session = InitReceived(InitPacket.decode(bytes_of_an_init()), None)
        recorder.record(both, [ended("lost", 1049), session, *new])
        assert recorder.restarted
        assert recorder.complete
        recorder.record(cycles(30, 5000), new)
        archive = read(recorder)
        assert np.array_equal(archive.columns["cycle"], 1000 + np.arange(50))
        assert [event.name for event in archive.events] == ["MotionEnded", "InitReceived"]

    def test_lost_link_and_lost_records_are_recorded(self, recorder: Recorder) -> None:
        recorder.record(cycles(0, 10), [LinkLost(1.2, State.CLOSED)])
        assert recorder.link_lost
        recorder.record(cycles(17, 10), [], lost=7)
        archive = read(recorder)
        assert archive.outcome.entries["records_lost"] == "7"
        silent, lost = (event.text for event in archive.events)
        assert "no valid packet for 1.200 s" in silent
        assert lost == "7 records overwritten"
        assert archive.columns["torque"] == near(GEAR * CONSTANT * 2.0), "of these drives"

    def test_what_the_controller_says_is_archived(self, recorder: Recorder) -> None:
        said = "C153A1: position deviates from path"
        recorder.record(cycles(0, 10), [ControllerRemark(said, 5)])
        (event,) = read(recorder).events
        assert (event.name, event.text) == ("ControllerRemark", said)
        assert event.time == pytest.approx(5 * PERIOD)


def test_every_event_has_a_text_and_a_level() -> None:
    assert _EVENT_TEXTS.keys() == {*get_args(ExchangeEvent)}


def at(*numbers: int) -> NDArray[np.void]:
    """Records of these cycles."""
    rows = np.zeros(len(numbers), cycle_dtype(2))
    rows["cycle"] = numbers
    return rows


class TestPreTriggerBuffer:
    @pytest.mark.parametrize("batch", [7, 20, 333, 2 * BUFFERED_CYCLES])
    def test_the_newest_records_stay(self, batch: int) -> None:
        buffer = PreTriggerBuffer()
        numbers = range(3 * BUFFERED_CYCLES)
        for begin in numbers[::batch]:
            part = numbers[begin : begin + batch]
            buffer.add(at(*part), [])
        returned, _ = buffer.pop_session()
        assert BUFFERED_CYCLES <= len(returned) < BUFFERED_CYCLES + batch
        assert returned["cycle"].tolist() == list(numbers[-len(returned) :])

    def test_only_the_latest_session_is_returned_once(self) -> None:
        buffer = PreTriggerBuffer()
        buffer.add(at(7, 8, 0, 1), [])
        buffer.add(at(2), [])
        returned, events = buffer.pop_session()
        assert returned["cycle"].tolist() == [0, 1, 2]
        assert not events
        assert not len(buffer.pop_session()[0])
