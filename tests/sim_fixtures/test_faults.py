"""Faults of the controller: one line of text each, and what comes of them."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

from drivers.packets import CyclicPacket, echo, is_init, next_number, packet_number
from drivers.transports.faults import Corrupt, Delay, Duplicate, Lose, Reorder
from sim_fixtures import Phase, SettingError, SimulatedController
from sim_fixtures.faults import (
    GRAMMAR,
    ControllerFault,
    FaultScriptError,
    parse_fault,
    split_faults,
)
from tests.fault_matrix import small_cell

LINES = {
    "lose@1200": Lose(1200),
    "lose@1200x3:to_controller": Lose(1200, "to_controller", 3),
    "delay@1200:5ms": Delay(1200, seconds=0.005),
    "delay@1200:250us": Delay(1200, seconds=250e-6),
    "delay@0x4:1.5cycles:to_controller": Delay(0, cycles=1.5, direction="to_controller", count=4),
    "duplicate@1200": Duplicate(1200),
    "duplicate@1200x2:to_controller": Duplicate(1200, "to_controller", 2),
    "reorder@1200": Reorder(1200),
    "reorder@1200:to_controller": Reorder(1200, "to_controller"),
    "corrupt@1200:offset=8": Corrupt(1200, offset=8),
    "corrupt@1200:offset=8:mask=0x80:to_controller": Corrupt(
        1200, "to_controller", offset=8, mask=0x80
    ),
    "restart@5000:cold": ControllerFault("restart", 5000, word="cold"),
    "restart@5000": ControllerFault("restart", 5000, word="cold"),
    "restart@5000:warm": ControllerFault("restart", 5000, word="warm"),
    "drive-drop@7": ControllerFault("drive-drop", 7),
    "e-stop@7": ControllerFault("e-stop", 7),
    "axis-leaves@7:axis=3": ControllerFault("axis-leaves", 7, 3),
    "following-error@7:axis=2": ControllerFault("following-error", 7, 2, 500, "jam"),
    "following-error@7x20:axis=2:slip": ControllerFault("following-error", 7, 2, 20, "slip"),
    "saturate@7x30:axis=1": ControllerFault("saturate", 7, 1, 30),
    "push@7:axis=2": ControllerFault("push", 7, 2, 50),
    "push@7x30:axis=1": ControllerFault("push", 7, 1, 30),
    "pause@7x50:502": ControllerFault("pause", 7, count=50, word="502"),
    "pause@7:500": ControllerFault("pause", 7, count=50, word="500"),
}


@pytest.mark.parametrize(("line", "fault"), LINES.items())
def test_a_line_says_which_fault(line: str, fault: object) -> None:
    assert parse_fault(line) == fault


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("", "is not KIND@CYCLE"),
        ("lose", "is not KIND@CYCLE"),
        ("lose@-3", "is not KIND@CYCLE"),
        ("lose@1200x0", "not positive"),
        ("lose@1x1000000001", "count is more than 1000000000"),
        ("lose@1x100000000000000000000", "count is more than"),
        ("saturate@1x2000000000:axis=1", "count is more than"),
        ("e-stop@1000000001", "cycle is more than"),
        ("lose@" + "9" * 5000, "cycle is more than"),
        ("lose@1200:sideways", "no option 'sideways'"),
        ("loose@1200", "none of lose, delay"),
        ("delay@1200", "a time"),
        ("delay@1200:0ms", "neither seconds nor cycles"),
        ("corrupt@1200", "offset=NUMBER is missing"),
        ("corrupt@1200:offset=far", "not offset=NUMBER"),
        ("corrupt@1200:offset=1:mask=0", "mask 0"),
        ("axis-leaves@7", "axis=NUMBER is missing"),
        ("axis-leaves@7:axis=0", "count from 1"),
        ("e-stop@7x3", "takes no count"),
        ("restart@7:lukewarm", "no option"),
        ("pause@7:503", "no option"),
    ],
)
def test_a_line_that_is_none_says_why_and_lists_the_grammar(line: str, reason: str) -> None:
    with pytest.raises(FaultScriptError, match=re.escape(reason)) as caught:
        parse_fault(line)
    assert GRAMMAR in str(caught.value)
    assert caught.value.text == line


def test_every_example_of_the_grammar_is_a_fault() -> None:
    examples = re.findall(r"^([a-z-]+@\S+)", GRAMMAR, re.MULTILINE)
    assert len(examples) == 13
    for line in examples:
        parse_fault(line)


def test_faults_of_link_and_controller_are_told_apart() -> None:
    faults = [parse_fault(line) for line in ("lose@1", "e-stop@2", "reorder@3", "restart@4")]
    assert split_faults(faults) == ((faults[0], faults[2]), (faults[1], faults[3]))


N = small_cell.N


class Holding:
    """A PC that gives every target back, moved by `step` [rev per cycle] while axes are open."""

    def __init__(self, controller: SimulatedController, step: float = 0.0) -> None:
        self.controller = controller
        self.step = np.full(N, step)
        self.packets: list[bytes] = []

    def run(self, cycles: int) -> None:
        for _ in range(cycles):
            packet = self.controller.next_packet()
            assert packet is not None, self.controller.reason
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


def run(cycles: int, *faults: str, step: float = 0.0, **settings: Any) -> Holding:
    pc = Holding(small_cell.controller(faults=[*map(parse_fault, faults)], **settings), step)
    pc.run(cycles)
    return pc


@pytest.mark.parametrize(
    ("fault", "reason"), [("drive-drop@100", "dropped"), ("e-stop@100", "emergency")]
)
def test_the_drive_goes_off_in_the_packet_of_that_cycle(fault: str, reason: str) -> None:
    pc = run(300, fault)
    assert [pc.cyclic(k).status[0] for k in (99, 100, 299)] == [5, 0, 0]
    assert reason in pc.controller.reason
    pc.controller.drive_on()
    pc.run(100)
    assert pc.controller.phase is Phase.OPEN


def test_a_cold_restart_is_silence_then_the_whole_start_and_waits_for_the_drive() -> None:
    pc = run(300, "restart@100", boot_time=0.05)
    assert pc.packets[100:150] == [b""] * 50
    numbers = [packet_number(packet) for packet in pc.packets[150:163]]
    assert numbers == list(range(1, 14))
    assert is_init(pc.packets[159])
    assert pc.cyclic(299).status[0] == 0
    pc.controller.drive_on()
    pc.run(100)
    assert pc.controller.phase is Phase.OPEN


def test_a_warm_restart_is_the_init_packet_next() -> None:
    pc = run(120, "restart@100:warm")
    assert is_init(pc.packets[100])
    assert packet_number(pc.packets[101]) == 11
    assert pc.cyclic(101).status[0] == 0


def test_one_axis_leaves_and_the_others_stay() -> None:
    pc = run(110, "axis-leaves@100:axis=2")
    assert pc.cyclic(99).axes["mode"].tolist() == [4, 4]
    assert pc.cyclic(100).axes["mode"].tolist() == [4, 0]
    assert pc.cyclic(109).axes["mode"].tolist() == [4, 0]


def test_a_pause_shows_for_as_long_as_it_lasts() -> None:
    pc = run(140, "pause@100x20")
    assert [pc.cyclic(k).axes["mode"][0] for k in (99, 100, 119, 120)] == [4, 502, 502, 0]


def test_a_jam_shows_only_in_motion_and_trips_the_drive_there() -> None:
    at_rest = run(400, "following-error@100:axis=1")
    assert at_rest.controller.reason == ""
    moving = run(400, "following-error@100:axis=1", step=0.01)
    assert "following error of axis 1" in moving.controller.reason
    clear = run(400, "following-error@100x5:axis=1", step=0.002)
    assert clear.controller.reason == ""


def test_a_slip_shows_in_what_is_reported_and_nowhere_else() -> None:
    pc, plain = run(160, "following-error@100x50:axis=2:slip"), run(160)
    for k, slip in ((99, 0.0), (100, 1.5), (149, 1.5), (150, 0.0)):
        d, expected = pc.cyclic(k).axes["d"].copy(), plain.cyclic(k).axes["d"].copy()
        expected[1, 2] += slip * small_cell.FOLLOWING_ERROR
        np.testing.assert_allclose(d, expected, atol=1e-6)


def test_a_load_drives_the_current_near_its_limit_and_goes_away_again() -> None:
    pc = run(700, "saturate@100x300:axis=1")
    current = np.array([pc.cyclic(k).axes["d"][0, 4] for k in range(90, 700)])
    limit = small_cell.TABLE["current_limit"][0]
    assert np.abs(current[:10]).max() < 0.5 * limit
    assert np.abs(current[10:310]).max() > 0.8 * limit
    assert np.abs(current[-50:]).max() < 0.5 * limit


def test_closed_brakes_bear_the_load() -> None:
    pc = run(300, "saturate@20x200:axis=1", drive_off_cycles=250)
    np.testing.assert_array_equal(pc.controller.plant.position, small_cell.HOME)


def test_an_axis_that_the_arm_has_not_is_refused() -> None:
    with pytest.raises(SettingError, match=r"axes 1\.\.2"):
        run(1, "axis-leaves@100:axis=3")


class TestOwnMotion:
    POSTURES = ((0.6, 0.1), (0.2, -0.6))

    def test_it_moves_with_closed_axes_and_ends_the_session(self) -> None:
        controller = small_cell.controller(own_motion=self.POSTURES, own_speed=0.8)
        pc = Holding(controller)
        while (packet := controller.next_packet()) is not None:
            pc.packets.append(packet)
            controller.accept(pc._answer(packet))
        rows = [pc.cyclic(k) for k in range(12, len(pc.packets))]
        assert {mode for row in rows for mode in row.axes["mode"].tolist()} == {0, 501, 504}
        np.testing.assert_allclose(controller.plant.position, self.POSTURES[-1], atol=1e-3)
        assert controller.reason == ""
        on = [row for row in rows if row.status[0] == 5]
        target, measured = (np.array([row.axes["d"][:, k] for row in on]) for k in (0, 2))
        assert np.ptp(target[:, 0]) > 5.0
        assert np.abs(target - measured).max() < 0.3 * small_cell.FOLLOWING_ERROR

    def test_repeated_it_goes_on_until_told_to_finish(self) -> None:
        changes = {"own_motion": self.POSTURES, "own_speed": 1.0, "own_motion_repeats": True}
        pc = run(5000, **changes)  # once through the list takes less than half of that
        assert pc.controller.phase is Phase.MOVING
        pc.controller.finish()
        while (packet := pc.controller.next_packet()) is not None:
            pc.controller.accept(pc._answer(packet))
        assert pc.controller.phase is Phase.ENDED

    def test_the_answers_of_the_pc_do_not_matter_to_it(self) -> None:
        def last(step: float) -> bytes:
            return run(900, own_motion=self.POSTURES, step=step).packets[-1]

        assert last(0.0) == last(0.01)

    def test_after_a_trip_it_is_over(self) -> None:
        pc = run(400, "e-stop@300", own_motion=self.POSTURES)
        pc.run(200)
        np.testing.assert_array_equal(pc.controller.plant.velocity, 0.0)
        pc.controller.drive_on()
        there = pc.controller.plant.position.copy()
        for _ in range(200):
            packet = pc.controller.next_packet()
            if packet is None:
                break
            pc.controller.accept(pc._answer(packet))
        assert pc.controller.phase is Phase.ENDED
        np.testing.assert_allclose(pc.controller.plant.position, there, atol=1e-3)

    def test_in_a_mode_that_only_corrects_it_moves_with_open_axes(self) -> None:
        pc = run(2500, own_motion=self.POSTURES, open_mode=8, own_speed=0.8)
        assert pc.controller.phase is Phase.OPEN
        np.testing.assert_allclose(pc.controller.plant.position, self.POSTURES[-1], atol=1e-3)


def test_one_seed_is_one_run_with_faults_too() -> None:
    faults = ("following-error@90x10:axis=2:slip", "pause@110x20", "restart@200:warm")
    settings = {"encoder_noise": 0.5, "current_noise": 0.02, "foreign_axes": 3}
    assert run(60, **settings).packets == run(60, **settings).packets
    first = _raw(faults, settings)
    assert first == _raw(faults, settings)


def _raw(faults: tuple[str, ...], settings: dict[str, Any]) -> list[bytes]:
    controller = small_cell.controller(faults=[*map(parse_fault, faults)], **settings)
    packets = []
    for _ in range(400):
        packet = controller.next_packet()
        assert packet
        packets.append(packet)
        controller.accept(echo(packet))
    return packets
