"""Raw packets in an archive: on request, byte by byte, and each with its cycle."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from drivers import CyclicPacket
from drivers.packets import INIT_LENGTH, is_init, next_number
from drivers.record import LONGEST_PACKET, PacketRing
from drivers.transports.faults import Lose
from drivers.transports.simulated import SimulatedTransport
from hil.archive import Archive, open_archive
from hil.archive.check import check_archive
from hil.archive.repair import repair
from hil.archive.schema import CYCLE, PACKETS
from hil.campaign import Link, Stop
from hil.cell import Cell
from hil.demo_link import loopback_link
from hil.recording import record
from hil.simulation import controller_settings, own_postures, simulated_controller

NAME = "excitation_000_a1.mcap"


def keeping_packets(cell: Cell) -> Cell:
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


def test_a_recording_on_the_simulated_link_keeps_every_packet_of_both_ends(
    tmp_path: Path, cell: Cell
) -> None:
    path = recorded(tmp_path, keeping_packets(cell))
    archive = open_archive(path)
    assert archive.outcome is not None
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
    assert check_archive(path).keeps, check_archive(path).faults


def test_the_cycles_are_those_of_an_archive_without_packets(tmp_path: Path, cell: Cell) -> None:
    with_them, without = tmp_path / "with", tmp_path / "without"
    with_them.mkdir()
    without.mkdir()
    rich = open_archive(recorded(with_them, keeping_packets(cell)))
    poor = open_archive(recorded(without, cell))
    assert poor.outcome is not None
    assert poor.outcome.packets is None
    for name, column in poor.columns.items():
        assert column.tobytes() == rich.columns[name].tobytes(), name
    assert poor.events == rich.events


def test_a_packet_that_was_lost_is_not_there_and_those_around_it_keep_their_cycles(
    tmp_path: Path, cell: Cell
) -> None:
    path = recorded(tmp_path, keeping_packets(cell), Lose(600, "to_pc"))
    archive = open_archive(path)
    assert archive.columns["gap"].sum() == 1
    assert_decoded_packets_are_the_cycles(archive, path)
    received = {cycle for cycle, sent, _, _ in packets_of(path) if not sent}
    cycles = archive.columns["cycle"]
    (hole,) = set(range(int(cycles[0]), int(cycles[-1]))) - set(cycles.tolist())
    assert hole not in received


def test_a_recording_over_udp_keeps_every_packet_of_both_ends(tmp_path: Path, cell: Cell) -> None:
    on_udp = keeping_packets(cell).with_link(transport="udp", host="127.0.0.1", bind="127.0.0.1")
    path = tmp_path / NAME
    with loopback_link(on_udp, simulated_by=cell.path, options=("--patience", "2")) as link:
        done = record(
            link, on_udp, path, kind="excitation", stop=Stop(), duration=1.0, durable=False
        )
    assert done.outcome == "completed"
    archive = open_archive(path)
    assert archive.outcome is not None
    assert archive.outcome.entries["packets_lost"] == "0"
    assert_decoded_packets_are_the_cycles(archive, path)
    first = next(packet for packet in packets_of(path) if len(packet[3]) == INIT_LENGTH)
    assert first[3] == archive.attachments["init_packet.bin"]
    assert check_archive(path).keeps, check_archive(path).faults


def test_packets_of_a_range_of_times_are_those_of_its_cycles(tmp_path: Path, cell: Cell) -> None:
    path = recorded(tmp_path, keeping_packets(cell))
    part = {"start": 0.25, "stop": 0.35}
    cycles = open_archive(path, topics=[CYCLE], **part).columns["cycle"]
    packets = open_archive(path, topics=[PACKETS], **part).columns["cycle"]
    assert packets.tolist() == np.repeat(cycles, 2).tolist()


def test_a_torn_archive_with_packets_is_repaired_to_one_that_keeps_the_profile(
    tmp_path: Path, cell: Cell
) -> None:
    path = recorded(tmp_path, keeping_packets(cell))
    before = packets_of(path)
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
    repaired = repair(path, tmp_path / "repaired.mcap")
    found = check_archive(repaired.output)
    assert found.keeps, found.faults
    after = packets_of(repaired.output)
    assert after
    assert before[: len(after)] == after
    assert open_archive(repaired.output).complete


def test_a_ring_says_how_many_packets_were_overwritten_and_keeps_the_newest() -> None:
    ring = PacketRing(4)
    for number in range(10):
        ring.put(number, 0.5, number % 2 == 1, bytes([number]) * 30)
    kept = ring.drain()
    assert ring.overflow == 6
    assert kept["cycle"].tolist() == [6, 7, 8, 9]
    assert kept["sent"].tolist() == [0, 1, 0, 1]
    assert kept["data"][0, :31].tolist() == [6] * 30 + [0]
    assert ring.drain().size == 0


def test_of_a_packet_too_long_for_a_controller_the_first_bytes_are_kept() -> None:
    ring = PacketRing(2)
    ring.put(0, 0.0, False, bytes(range(256)) * 6)
    (kept,) = ring.drain()
    assert kept["length"] == 1536
    assert kept["data"].tobytes() == (bytes(range(256)) * 6)[:LONGEST_PACKET]
