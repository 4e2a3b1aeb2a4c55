"""One interval of a link into one archive: what belongs to it, and how it ended.

And what came while no archive was open: the newest of it, of the session that began last.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.drive_train import DriveTrain
from drivers.events import InitReceived, LinkLost, MotionEnded, MotionStarted, StateChanged
from drivers.packets import InitPacket
from drivers.record import PACKET_DTYPE, cycle_dtype
from drivers.states import State
from hil.archive import Archive, ArchiveSpec, Recorder, open_archive
from hil.archive.process import RECENT, Recent
from hil.cell import Cell
from hil.simulation import simulated_controller
from sim_fixtures.ns16 import CELL_PATH

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


def a_new_session() -> InitReceived:
    return InitReceived(InitPacket.decode(bytes_of_an_init()), None)


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


def test_torques_are_those_of_the_drive_train_in_force(recorder: Recorder) -> None:
    recorder.take(cycles(0, 10), [])
    assert read(recorder).columns["torque"] == pytest.approx(GEAR * CONSTANT * 2.0)


def test_an_interval_is_over_when_its_motion_came_to_rest(recorder: Recorder) -> None:
    recorder.take(cycles(0, 100), [MotionStarted(0, 10)])
    assert not recorder.over
    recorder.take(cycles(100, 50), [ended("completed", 140)])
    assert recorder.over
    archive = read(recorder)
    assert archive.n_samples == 150
    assert [event.name for event in archive.events] == ["MotionStarted", "MotionEnded"]


@pytest.mark.parametrize("outcome", ["refused", "lost"])
def test_half_a_second_more_is_recorded_of_a_motion_that_failed(
    recorder: Recorder, outcome: str
) -> None:
    recorder.take(cycles(0, 100), [ended(outcome, 80)])
    assert not recorder.over
    recorder.take(cycles(100, 1000), [])
    assert recorder.over
    assert read(recorder).columns["cycle"][-1] == 80 + 500


def test_a_controller_that_starts_anew_has_no_place_in_the_same_file(recorder: Recorder) -> None:
    new = [StateChanged(State.INIT, State.DRIVE_OFF, 3)]
    both = np.concatenate([cycles(1000, 50), cycles(0, 30)])
    recorder.take(both, [ended("lost", 1049), a_new_session(), *new])
    assert recorder.restarted
    assert recorder.over
    recorder.take(cycles(30, 5000), new)
    archive = read(recorder)
    assert np.array_equal(archive.columns["cycle"], 1000 + np.arange(50))
    assert [event.name for event in archive.events] == ["MotionEnded", "InitReceived"]


def test_a_silent_link_is_noticed(recorder: Recorder) -> None:
    recorder.take(cycles(0, 10), [LinkLost(1.2, State.CLOSED)])
    assert recorder.link_lost
    assert "nothing heard for 1.200 s" in read(recorder).events[0].text


def test_lost_records_are_an_event_and_in_the_outcome(recorder: Recorder) -> None:
    recorder.take(cycles(0, 10), [])
    recorder.take(cycles(17, 10), [], lost=7)
    archive = read(recorder)
    assert archive.outcome is not None
    assert archive.outcome.entries["records_lost"] == "7"
    assert [event.text for event in archive.events] == ["7 records overwritten"]


def test_a_spec_gains_what_is_known_later(spec: ArchiveSpec) -> None:
    more = spec.with_more({"accepted_init": "yes"}, {"init_packet.bin": b"x"})
    assert more.metadata == {"simulated": "yes", "accepted_init": "yes"}
    assert more.attachments == {"init_packet.bin": b"x"}
    assert spec.attachments == {}


def at(*numbers: int) -> NDArray[np.void]:
    """Records of these cycles."""
    rows = np.zeros(len(numbers), cycle_dtype(2))
    rows["cycle"] = numbers
    return rows


def packets(*cycles: int) -> NDArray[np.void]:
    """Both directions of each cycle."""
    rows = np.zeros(2 * len(cycles), PACKET_DTYPE)
    rows["cycle"] = np.repeat(cycles, 2)
    return rows


@pytest.mark.parametrize("batch", [7, 20, 333, 2 * RECENT])
def test_records_and_their_packets_go_together(batch: int) -> None:
    recent, numbers = Recent(), range(3 * RECENT)
    for begin in numbers[::batch]:
        part = numbers[begin : begin + batch]
        recent.keep(at(*part), [], packets(*part))
    kept, _, kept_packets = recent.take_session()
    assert RECENT <= len(kept) < RECENT + batch
    assert kept["cycle"].tolist() == list(numbers[-len(kept) :])
    assert kept_packets["cycle"].tolist() == np.repeat(kept["cycle"], 2).tolist()


def test_only_the_session_that_began_last_counts_and_is_given_once() -> None:
    recent = Recent()
    recent.keep(at(7, 8, 0, 1), [], packets(7, 8, 0, 1))
    recent.keep(at(2), [], packets(2))
    kept, events, kept_packets = recent.take_session()
    assert kept["cycle"].tolist() == [0, 1, 2]
    assert kept_packets["cycle"].tolist() == [0, 0, 1, 1, 2, 2]
    assert not events
    assert not len(recent.take_session()[0])
