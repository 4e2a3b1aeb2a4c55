"""Where axes stand in the packets: slots, arms, axes of other arms, long packets."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.packets import CyclicPacket, InitPacket, cyclic_length, echo, next_number
from sim_fixtures import Phase, SettingError, SimulatedController
from tests.fault_matrix import small_cell


def init_of(controller: SimulatedController) -> InitPacket:
    packet = controller.next_packet()
    assert packet
    controller.accept(echo(packet))
    return InitPacket.decode(packet)


def axes_at(controller: SimulatedController, phase: Phase, n: int) -> NDArray[np.void]:
    """Axis blocks of the first packet of a phase, with everything echoed until then."""
    for _ in range(200):
        here = controller.phase
        packet = controller.next_packet()
        assert packet
        if here is phase:
            return CyclicPacket.decode(packet, n).axes
        controller.accept(echo(packet))
    raise AssertionError(controller.phase)


def test_axes_stand_in_the_slots_they_are_given() -> None:
    plain = axes_at(small_cell.controller(), Phase.CLOSED, 2)
    turned = small_cell.controller(slots=(1, 0), cold_start=False)
    assert [(a.arm, a.axis, a.slot) for a in init_of(turned).open_axes()] == [(1, 1, 0), (1, 0, 1)]
    np.testing.assert_array_equal(axes_at(turned, Phase.CLOSED, 2), plain[::-1])


@pytest.mark.parametrize(
    ("arm", "slots", "foreign", "expected"),
    [
        (1, None, 3, [(1, 0), (1, 1), (2, 0), (2, 1), (2, 2)]),
        (2, (3, 1), 2, [(1, 0), (2, 1), (1, 1), (2, 0)]),
        (
            4,
            (19, 18),
            18,
            [*((1, i) for i in range(10)), *((2, i) for i in range(8)), (4, 1), (4, 0)],
        ),
    ],
)
def test_axes_of_other_arms_fill_the_slots_that_are_left(
    arm: int, slots: tuple[int, int] | None, foreign: int, expected: list[tuple[int, int]]
) -> None:
    controller = small_cell.controller(arm=arm, slots=slots, foreign_axes=foreign, cold_start=False)
    init = init_of(controller)
    assert init.n_axes == 2 + foreign
    assert [(a.arm, a.axis) for a in init.open_axes()] == expected
    np.testing.assert_array_equal(init.gear_ratio[arm - 1, :2], (-100.0, 80.0))
    assert np.all(init.gear_ratio[init.open_axes_map != 0xFF] != 0.0)
    axes = axes_at(controller, Phase.CLOSED, 2 + foreign)
    own = [(slots or (0, 1))[i] for i in range(2)]
    there = small_cell.drive().motor_revolutions(small_cell.HOME)
    np.testing.assert_allclose(axes["d"][own, 2], there, atol=1.0 / 65536)


def test_every_arm_has_its_own_status_byte() -> None:
    controller = small_cell.controller(arm=3, foreign_axes=11)
    axes_at(controller, Phase.CLOSED, 13)
    packet = controller.next_packet()
    assert packet
    assert packet[4:8] == bytes((5, 5, 5, 0))


def test_the_exit_byte_of_another_arm_is_not_ours() -> None:
    controller = small_cell.controller(arm=2, foreign_axes=1)
    axes = axes_at(controller, Phase.OPEN, 3)
    number = controller._number
    for byte, phase in ((0, Phase.OPEN), (1, Phase.CLOSING)):
        status = bytes(1 if i == byte else 0 for i in range(4))
        reply = CyclicPacket(next_number(number), status, bytes(4), axes.copy())
        controller.accept(reply.encode())
        assert controller.phase is phase
        packet = controller.next_packet()
        assert packet
        number = CyclicPacket.decode(packet, 3).number


@pytest.mark.parametrize("opens", [False, True])
def test_axes_of_other_arms_obey_only_when_they_are_open(opens: bool) -> None:
    controller = small_cell.controller(foreign_axes=2, foreign_open=opens)
    axes = axes_at(controller, Phase.OPEN, 4).copy()
    before = controller.foreign_targets
    assert axes["mode"].tolist() == [4, 4, *[4 if opens else 0] * 2]
    axes["d"][2:, 0] += 0.5
    axes["mode"] = 4
    reply = CyclicPacket(next_number(controller._number), bytes(4), bytes(4), axes)
    controller.accept(reply.encode())
    moved = np.array(controller.foreign_targets) - before
    np.testing.assert_allclose(moved, 0.5 if opens else 0.0)


def test_long_packets_have_732_bytes_and_a_tail_that_one_seed_repeats() -> None:
    def packets(**changes: Any) -> list[bytes]:
        controller = small_cell.controller(cold_start=False, **changes)
        sent = []
        for _ in range(40):
            packet = controller.next_packet()
            assert packet
            sent.append(packet)
            controller.accept(echo(packet))
        return sent[1:]

    long, short = packets(long_packets=True), packets()
    assert {len(packet) for packet in long} == {732}
    assert {len(packet) for packet in short} == {cyclic_length(2)}
    assert [packet[: cyclic_length(2)] for packet in long] == short
    assert long[0][-100:] != long[1][-100:]
    assert long == packets(long_packets=True)
    assert long != packets(long_packets=True, seed=2)


@pytest.mark.parametrize("slots", [(0,), (0, 0), (0, 2), (-1, 0)])
def test_slots_that_cannot_be_are_refused(slots: tuple[int, ...]) -> None:
    with pytest.raises(SettingError, match="slots"):
        small_cell.controller(slots=slots)


def test_a_packet_has_twenty_slots_at_most() -> None:
    with pytest.raises(SettingError, match="20 axes in all"):
        small_cell.controller(foreign_axes=19)
