"""Recording of one interval of a link: which rows belong to it, how it ended, raw packets.

Also the buffer of what arrives while no archive is open.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers import CyclicPacket
from drivers.drive_train import DriveTrain
from drivers.events import (
    Event,
    InitReceived,
    LinkLost,
    MotionEnded,
    MotionStarted,
    PacketRejected,
    StateChanged,
)
from drivers.packets import INIT_LENGTH, InitPacket, is_init, next_number
from drivers.record import LONGEST_PACKET, PACKET_DTYPE, PacketRing, cycle_dtype
from drivers.states import State
from drivers.transports.faults import Lose
from drivers.transports.simulated import SimulatedTransport
from hil.archive import Archive, ArchiveSpec, Level, Recorder, open_archive
from hil.archive.check import check_archive
from hil.archive.process import BUFFERED_CYCLES, PreTriggerBuffer
from hil.archive.recorder import describe, level_of
from hil.archive.repair import repair
from hil.archive.schema import CYCLE, PACKETS
from hil.campaign import Link, Stop
from hil.cell import Cell
from hil.demo_link import loopback_link
from hil.recording import record
from hil.simulation import controller_settings, own_postures, simulated_controller
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
        recorder.record(both, [ended("lost", 1049), a_new_session(), *new])
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
        assert archive.columns["torque"] == pytest.approx(GEAR * CONSTANT * 2.0), "of these drives"


@pytest.mark.parametrize(
    ("event", "text"),
    [
        (PacketRejected("stale", 2, "number 9 is old"), "packets stale: 2 (number 9 is old)"),
        (LinkLost(1.2, State.OPEN, 30), "no valid packet for 1.200 s in state OPEN; stale"),
    ],
)
def test_event_texts(event: Event, text: str) -> None:
    assert text in describe(event)
    assert level_of(event) == (Level.ERROR if isinstance(event, LinkLost) else Level.WARN)


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


class TestPreTriggerBuffer:
    @pytest.mark.parametrize("batch", [7, 20, 333, 2 * BUFFERED_CYCLES])
    def test_records_and_their_packets_are_dropped_together(self, batch: int) -> None:
        buffer, numbers = PreTriggerBuffer(), range(3 * BUFFERED_CYCLES)
        for begin in numbers[::batch]:
            part = numbers[begin : begin + batch]
            buffer.add(at(*part), [], packets(*part))
        returned, _, returned_packets = buffer.pop_session()
        assert BUFFERED_CYCLES <= len(returned) < BUFFERED_CYCLES + batch
        assert returned["cycle"].tolist() == list(numbers[-len(returned) :])
        assert returned_packets["cycle"].tolist() == np.repeat(returned["cycle"], 2).tolist()

    def test_only_the_latest_session_is_returned_once(self) -> None:
        buffer = PreTriggerBuffer()
        buffer.add(at(7, 8, 0, 1), [], packets(7, 8, 0, 1))
        buffer.add(at(2), [], packets(2))
        returned, events, returned_packets = buffer.pop_session()
        assert returned["cycle"].tolist() == [0, 1, 2]
        assert returned_packets["cycle"].tolist() == [0, 0, 1, 1, 2, 2]
        assert not events
        assert not len(buffer.pop_session()[0])


NAME = "excitation_000_a1.mcap"


def with_packets(cell: Cell) -> Cell:
    return cell.with_link(packets=True)


def recorded(folder: Path, cell: Cell, *faults: Lose, duration: float = 1.0) -> Path:
    """A second of the controller's own motion, over the simulated link."""
    settings = replace(controller_settings(cell), own_motion=own_postures(cell))
    controller = simulated_controller(cell, settings=settings)
    link = Link.over(SimulatedTransport(controller, faults), cell, controller.finish)
    path = folder / NAME
    record(
        link, cell, path, kind="excitation", stop=Stop(), duration=duration, durable=False
    )  # fmt: skip
    return path


def packets_of(path: Path) -> list[tuple[int, bool, float, bytes]]:
    """Cycle, whether sent, time and bytes of each packet."""
    archive = open_archive(path, topics=[PACKETS])
    assert archive.complete, archive.missing
    columns = archive.columns
    assert not any(
        data[length:].any() for data, length in zip(columns["data"], columns["length"], strict=True)
    )
    return [
        (int(cycle), bool(sent), float(time), data[:length].tobytes())
        for cycle, sent, time, data, length in zip(
            *(columns[name] for name in ("cycle", "sent", "time", "data", "length")), strict=True
        )
    ]


def assert_decoded_packets_are_the_cycles(archive: Archive, path: Path) -> None:
    """What was received decodes to the records, and each answer follows its packet."""
    n = len(archive.joint_names)
    columns, packets = archive.columns, packets_of(path)
    cyclic = [packet for packet in packets if len(packet[3]) < INIT_LENGTH]
    received = {cycle: data for cycle, sent, _, data in cyclic if not sent}
    answers = {cycle: data for cycle, sent, _, data in cyclic if sent}
    assert set(columns["cycle"].tolist()) <= received.keys()
    for row, cycle in enumerate(columns["cycle"].tolist()):
        packet = CyclicPacket.decode(received[cycle], n)
        assert packet.number == columns["number"][row]
        assert packet.axes["mode"].tolist() == columns["mode"][row].tolist()
        currents = packet.axes["d"][:, 4].astype(np.float64)
        assert currents.tobytes() == columns["target_current"][row].tobytes()
        model = packet.axes["extra"][:, 0].astype(np.float64)
        assert model.tobytes() == columns["model_current"][row].tobytes()
        answer = CyclicPacket.decode(answers[cycle], n)
        assert answer.number == next_number(packet.number)
    times = [time for _, _, time, _ in packets]
    assert times == sorted(times)


class TestRawPackets:
    def test_all_packets_of_a_simulated_link_are_stored(self, tmp_path: Path, cell: Cell) -> None:
        path = recorded(tmp_path, with_packets(cell))
        archive = open_archive(path)
        part = {"start": 0.25, "stop": 0.35}
        cycles = open_archive(path, topics=[CYCLE], **part).columns["cycle"]
        some = open_archive(path, topics=[PACKETS], **part).columns["cycle"]
        assert some.tolist() == np.repeat(cycles, 2).tolist()
        with pytest.raises(ValueError, match="open one at a time"):
            open_archive(path, topics=[CYCLE, PACKETS])
        assert_decoded_packets_are_the_cycles(archive, path)
        packets = packets_of(path)
        inits = [place for place, packet in enumerate(packets) if is_init(packet[3])]
        assert len(inits) == 1
        assert packets[inits[0] + 1][1], "the init packet's answer follows it"
        assert packets[inits[0]][3] == archive.attachments["init_packet.bin"]
        # One answer to each packet, in turns.
        assert [sent for _, sent, _, _ in packets] == [False, True] * (len(packets) // 2)
        assert archive.outcome.entries["packets"] == str(len(packets))
        assert archive.outcome.entries["packets_lost"] == "0"
        assert check_archive(path).conforms, check_archive(path).faults

    def test_lost_packet_is_missing_and_others_have_their_cycles(
        self, tmp_path: Path, cell: Cell
    ) -> None:
        path = recorded(tmp_path, with_packets(cell), Lose(600, "to_pc"))
        archive = open_archive(path)
        assert archive.columns["gap"].sum() == 1
        assert_decoded_packets_are_the_cycles(archive, path)
        received = {cycle for cycle, sent, _, _ in packets_of(path) if not sent}
        cycles = archive.columns["cycle"]
        (hole,) = set(range(int(cycles[0]), int(cycles[-1]))) - set(cycles.tolist())
        assert hole not in received

    def test_all_packets_of_a_udp_link_are_stored(self, tmp_path: Path, cell: Cell) -> None:
        on_udp = with_packets(cell).with_link(transport="udp", host="127.0.0.1", bind="127.0.0.1")
        path = tmp_path / NAME
        with loopback_link(on_udp, simulated_by=cell.path, options=("--patience", "2")) as link:
            done = record(
                link, on_udp, path, kind="excitation", stop=Stop(), duration=1.0, durable=False
            )
        assert done.outcome == "completed"
        archive = open_archive(path)
        assert archive.outcome.entries["packets_lost"] == "0"
        assert_decoded_packets_are_the_cycles(archive, path)
        first = next(packet for packet in packets_of(path) if len(packet[3]) == INIT_LENGTH)
        assert first[3] == archive.attachments["init_packet.bin"]
        assert check_archive(path).conforms, check_archive(path).faults

    def test_truncated_archive_with_packets_is_repaired(self, tmp_path: Path, cell: Cell) -> None:
        path = recorded(tmp_path, with_packets(cell))
        before = packets_of(path)
        path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
        repaired = repair(path, tmp_path / "repaired.mcap")
        found = check_archive(repaired.output)
        assert found.conforms, found.faults
        after = packets_of(repaired.output)
        assert after
        assert before[: len(after)] == after
        assert open_archive(repaired.output).complete

    def test_long_packet_is_truncated(self) -> None:
        ring = PacketRing(2)
        ring.put(0, 0.0, False, bytes(range(256)) * 6)
        (returned,) = ring.drain()
        assert returned["length"] == 1536
        assert returned["data"].tobytes() == (bytes(range(256)) * 6)[:LONGEST_PACKET]
