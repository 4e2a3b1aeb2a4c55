"""Faults of the controller: one line of text each, and what comes of them."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

from drivers.c4g_packets import CyclicPacket, echo, is_init, next_number, packet_number
from drivers.transports.simulated import Corrupt, Delay, Duplicate, Lose, Reorder
from sim_fixtures import Phase, SettingError, SimulatedController
from sim_fixtures.faults import (
    GRAMMAR,
    FaultScriptError,
    InjectedFault,
    parse_fault,
    split_faults,
)
from tests.fault_matrix import small_cell

LINES = {
    "lose@1200x3:to_controller": Lose(1200, "to_controller", 3),
    "delay@1200:5ms": Delay(1200, seconds=0.005),
    "delay@1200:250us": Delay(1200, seconds=250e-6),
    "delay@0x4:1.5cycles:to_controller": Delay(0, cycles=1.5, direction="to_controller", count=4),
    "duplicate@1200": Duplicate(1200),
    "reorder@1200": Reorder(1200),
    "reorder@1200:to_controller": Reorder(1200, "to_controller"),
    "corrupt@1200:offset=8:mask=0x80:to_controller": Corrupt(
        1200, "to_controller", offset=8, mask=0x80
    ),
    "restart@5000": InjectedFault("restart", 5000, word="cold"),
    "restart@5000:warm": InjectedFault("restart", 5000, word="warm"),
    "drive-drop@7": InjectedFault("drive-drop", 7),
    "e-stop@7": InjectedFault("e-stop", 7),
    "axis-leaves@7:axis=3": InjectedFault("axis-leaves", 7, 3),
    "following-error@7:axis=2": InjectedFault("following-error", 7, 2, 500, "jam"),
    "following-error@7x20:axis=2:slip": InjectedFault("following-error", 7, 2, 20, "slip"),
    "saturate@7x30:axis=1": InjectedFault("saturate", 7, 1, 30),
    "push@7:axis=2": InjectedFault("push", 7, 2, 50),
    "pause@7x50:502": InjectedFault("pause", 7, count=50, word="502"),
    "pause@7:500": InjectedFault("pause", 7, count=50, word="500"),
}


@pytest.mark.parametrize(("line", "fault"), LINES.items())
def test_a_line_is_read_as_its_fault(line: str, fault: object) -> None:
    assert parse_fault(line) == fault


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("lose", "is not KIND@CYCLE"),
        ("lose@-3", "is not KIND@CYCLE"),
        ("lose@" + "9" * 5000, "is not KIND@CYCLE"),
        ("lose@1200x0", "the count 1 to"),
        ("saturate@1x1000000001:axis=1", "at most 1000000000"),
        ("lose@1200:sideways", "no option 'sideways'"),
        ("loose@1200", "none of lose, delay"),
        ("delay@1200", "needs the option time"),
        ("delay@1200:0ms", "a finite time above zero"),
        ("corrupt@1200:offset=far", "no option 'offset=far'"),
        ("corrupt@1200:offset=1:mask=0", "mask 0 is not one of 1..255"),
        ("axis-leaves@7", "needs the option axis"),
        ("axis-leaves@7:axis=0", "no option 'axis=0'"),
        ("e-stop@7x3", "takes no count"),
        ("restart@7:lukewarm", "no option"),
    ],
)
def test_an_invalid_line_is_refused_with_reason_and_grammar(line: str, reason: str) -> None:
    with pytest.raises(FaultScriptError, match=re.escape(reason)) as caught:
        parse_fault(line)
    assert GRAMMAR in str(caught.value)
    assert caught.value.text == line


def test_every_example_of_the_grammar_is_a_fault() -> None:
    examples = re.findall(r"^([a-z-]+@\S+)", GRAMMAR, re.MULTILINE)
    assert len(examples) == 13
    for line in examples:
        parse_fault(line)


def test_faults_of_link_and_controller_are_separated() -> None:
    faults = [parse_fault(line) for line in ("lose@1", "e-stop@2", "reorder@3", "restart@4")]
    assert split_faults(faults) == ((faults[0], faults[2]), (faults[1], faults[3]))


N = small_cell.N


class Holding:
    """A PC that returns every target, moved by `step` [rev per cycle] while axes are open."""

    def __init__(self, controller: SimulatedController, step: float = 0.0) -> None:
        self.controller = controller
        self.step = np.full(N, step)
        self.packets: list[bytes] = []

    def run(self, cycles: int | None = None) -> None:
        """Run some cycles, or to the end of the session."""
        end = None if cycles is None else len(self.packets) + cycles
        while len(self.packets) != end:
            packet = self.controller.next_packet()
            if packet is None:
                assert (end, self.controller.phase) == (None, Phase.ENDED), self.controller.reason
                return
            self.packets.append(packet)
            self.controller.accept(self._answer(packet) if packet else None)

    def _answer(self, packet: bytes) -> bytes:
        if is_init(packet) or len(packet) == 732:
            return echo(packet)
        received = CyclicPacket.decode(packet, N)
        reply = CyclicPacket.zeros(next_number(received.number), N)
        reply.axes["mode"] = received.axes["mode"]
        moving = self.step * (received.axes["mode"] == 4)
        reply.axes["d"][:, 0] = received.axes["d"][:, 0] + moving
        reply.axes["d"][:, 1] = moving
        return reply.encode()

    def cyclic(self, index: int) -> CyclicPacket:
        return CyclicPacket.decode(self.packets[index], N)


def run(cycles: int | None, *faults: str, step: float = 0.0, **settings: Any) -> Holding:
    pc = Holding(small_cell.controller(faults=[*map(parse_fault, faults)], **settings), step)
    pc.run(cycles)
    return pc


def opens_again(pc: Holding) -> bool:
    """Whether the axes open once the drive is switched on."""
    pc.controller.drive_on()
    pc.run(100)
    return pc.controller.phase is Phase.OPEN


@pytest.mark.parametrize(
    ("fault", "reason"), [("drive-drop@100", "dropped"), ("e-stop@100", "emergency")]
)
def test_the_drive_goes_off_in_the_packet_of_that_cycle(fault: str, reason: str) -> None:
    pc = run(300, fault)
    assert [pc.cyclic(k).status[0] for k in (99, 100, 299)] == [5, 0, 0]
    assert reason in pc.controller.reason
    assert opens_again(pc)


def test_a_cold_restart_is_silence_then_the_whole_start() -> None:
    pc = run(300, "restart@100", boot_time=0.05)
    assert pc.packets[100:150] == [b""] * 50
    numbers = [packet_number(packet) for packet in pc.packets[150:163]]
    assert numbers == list(range(1, 14))
    assert is_init(pc.packets[159])
    assert pc.cyclic(299).status[0] == 0
    assert opens_again(pc)


def test_a_warm_restart_is_the_init_packet_next() -> None:
    pc = run(120, "restart@100:warm")
    assert is_init(pc.packets[100])
    assert packet_number(pc.packets[101]) == 11
    assert pc.cyclic(101).status[0] == 0


@pytest.mark.parametrize(
    ("fault", "modes"),
    [
        ("axis-leaves@100:axis=2", [(4, 4), (4, 0), (4, 0), (4, 0)]),
        ("pause@100x20", [(4, 4), (502, 502), (502, 502), (0, 0)]),
        ("pause@100x20:500", [(4, 4), (500, 500), (500, 500), (0, 0)]),
    ],
)
def test_modes_change_in_the_cycles_of_the_fault(fault: str, modes: list[tuple[int]]) -> None:
    pc = run(140, fault)
    assert [tuple(pc.cyclic(k).axes["mode"].tolist()) for k in (99, 100, 119, 120)] == modes


@pytest.mark.parametrize(
    ("fault", "step", "trips"),
    [
        ("following-error@100:axis=1", 0.0, False),
        ("following-error@100:axis=1", 0.01, True),
        ("following-error@100x5:axis=1", 0.002, False),
    ],
)
def test_a_jam_trips_the_drive_in_motion_only(fault: str, step: float, trips: bool) -> None:
    reason = run(400, fault, step=step).controller.reason
    assert "following error of axis 1" in reason if trips else reason == ""


def test_a_slip_changes_the_reported_position_only() -> None:
    pc = run(160, "following-error@100x50:axis=2:slip")
    faultless = run(160)
    for k, slip in ((99, 0.0), (100, 1.5), (149, 1.5), (150, 0.0)):
        d = pc.cyclic(k).axes["d"].copy()
        expected = faultless.cyclic(k).axes["d"].copy()
        expected[1, 2] += slip * small_cell.FOLLOWING_ERROR
        np.testing.assert_allclose(d, expected, atol=1e-6)


def test_a_load_raises_the_current_while_it_lasts() -> None:
    pc = run(700, "saturate@100x300:axis=1")
    current = np.array([pc.cyclic(k).axes["d"][0, 4] for k in range(90, 700)])
    limit = small_cell.TABLE["current_limit"][0]
    assert np.abs(current[:10]).max() < 0.5 * limit
    assert np.abs(current[10:310]).max() > 0.8 * limit
    assert np.abs(current[-50:]).max() < 0.5 * limit


def test_an_axis_beyond_those_of_the_arm_is_refused() -> None:
    with pytest.raises(SettingError, match=r"axes 1\.\.2"):
        run(1, "axis-leaves@100:axis=3")


class TestOwnMotion:
    POSTURES = ((0.6, 0.1), (0.2, -0.6))

    def test_it_moves_with_closed_axes_and_ends_the_session(self) -> None:
        pc = run(None, own_motion=self.POSTURES, own_speed=0.8)
        controller = pc.controller
        rows = [pc.cyclic(k) for k in range(12, len(pc.packets))]
        assert {mode for row in rows for mode in row.axes["mode"].tolist()} == {0, 501, 504}
        np.testing.assert_allclose(controller.plant.position, self.POSTURES[-1], atol=1e-3)
        assert controller.reason == ""
        on = [row for row in rows if row.status[0] == 5]
        target, measured = (np.array([row.axes["d"][:, k] for row in on]) for k in (0, 2))
        assert np.ptp(target[:, 0]) > 5.0
        assert np.abs(target - measured).max() < 0.3 * small_cell.FOLLOWING_ERROR

    def test_it_ends_with_a_trip(self) -> None:
        pc = run(600, "e-stop@300", own_motion=self.POSTURES)
        np.testing.assert_array_equal(pc.controller.plant.velocity, 0.0)
        pc.controller.drive_on()
        there = pc.controller.plant.position.copy()
        pc.run()
        np.testing.assert_allclose(pc.controller.plant.position, there, atol=1e-3)

    def test_in_a_mode_that_only_corrects_it_moves_with_open_axes(self) -> None:
        pc = run(2500, own_motion=self.POSTURES, open_mode=8, own_speed=0.8)
        assert pc.controller.phase is Phase.OPEN
        np.testing.assert_allclose(pc.controller.plant.position, self.POSTURES[-1], atol=1e-3)
