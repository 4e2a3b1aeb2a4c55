"""What each open mode takes from the PC's answer, and what the arm does without one."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from drivers.packets import CyclicPacket, echo, next_number
from sim_fixtures import Phase, SettingError, SimulatedController
from tests.fault_matrix import small_cell

N = small_cell.N
STATUS_EXIT = 1
Fields = dict[int, Any]
"""What is answered: field number 1..5 to values."""


def receive(controller: SimulatedController, n: int = N) -> CyclicPacket:
    packet = controller.next_packet()
    assert packet
    return CyclicPacket.decode(packet, n)


def answer(received: CyclicPacket, fields: Fields, *, status: int = 0, mode: int | None = None):
    reply = CyclicPacket.zeros(next_number(received.number), len(received.axes))
    reply.axes["mode"] = received.axes["mode"] if mode is None else mode
    for number, values in fields.items():
        reply.axes["d"][:, number - 1] = values
    return CyclicPacket(reply.number, bytes((status, 0, 0, 0)), bytes(4), reply.axes).encode()


def step(controller: SimulatedController, fields: Fields | None = None, **options: Any):
    received = receive(controller)
    controller.accept(answer(received, fields or {}, **options))
    return received


def opened(**settings: Any) -> SimulatedController:
    controller = small_cell.controller(**settings)
    for _ in range(500):
        if controller.phase is Phase.OPEN:
            return controller
        packet = controller.next_packet()
        assert packet is not None, controller.reason
        controller.accept(echo(packet) if controller.phase is Phase.START else safe(packet))
    raise AssertionError(controller.phase)


def safe(packet: bytes) -> bytes:
    """Targets back in modes led by the PC, nothing in the others."""
    received = CyclicPacket.decode(packet, N)
    led = np.isin(received.axes["mode"], (1, 4, 5, 0))
    return answer(received, {1: np.where(led, received.axes["d"][:, 0], 0.0)})


def drive_at_speed(controller: SimulatedController, speed: float = 0.03, cycles: int = 300):
    """Bring motor 1 up to `speed` [rev per cycle]; the last target sent."""
    target = np.array(controller.servo.target)
    for k in range(cycles):
        delta = np.array([speed * min(1.0, k / (cycles - 50)), 0.0])
        target = target + delta
        step(controller, {1: target, 2: delta})
    assert controller.phase is Phase.OPEN, controller.reason
    return target


class TestFields:
    @pytest.mark.parametrize("mode", [1, 4, 5])
    def test_in_modes_led_by_the_pc_d1_and_d2_are_the_target(self, mode: int) -> None:
        controller = opened(open_mode=mode)
        target = np.float32(np.array(controller.servo.target) + 1e-3)
        fields: Fields = {1: target, 2: 1e-3}
        step(controller, fields | ({4: 1e-3} if mode == 1 else {}))
        after = receive(controller).axes
        np.testing.assert_array_equal(after["mode"], mode)
        np.testing.assert_array_equal(after["d"][:, 0], target)
        np.testing.assert_array_equal(after["d"][:, 1], np.float32(1e-3))

    @pytest.mark.parametrize("mode", [2, 7, 8, 9])
    def test_in_the_others_the_controller_keeps_its_own_target(self, mode: int) -> None:
        controller = opened(open_mode=mode)
        before = receive(controller).axes["d"][:, 0].copy()
        controller.accept(None)
        controller = opened(open_mode=mode)
        # whatever D1 says in modes 2, 8 and 9; an offset in mode 7 is not reported either
        for _ in range(5):
            step(controller, {1: 0.002})
        np.testing.assert_array_equal(receive(controller).axes["d"][:, 0], before)

    def test_mode_7_adds_d1_to_the_controllers_own_target(self) -> None:
        controller = opened(open_mode=7)
        own = np.array(controller.servo.target)
        for k in range(200):
            step(controller, {1: 0.2 * min(1.0, k / 150)})
        np.testing.assert_allclose(controller.servo.target, own + 0.2, atol=1e-7)
        np.testing.assert_allclose(controller.servo.measured, own + 0.2, atol=0.01)

    def test_mode_4_without_a_feed_forward_ignores_d4_and_d5(self) -> None:
        def run(fields: Fields) -> bytes:
            controller = opened()
            target = np.array(controller.servo.target)
            for _ in range(20):
                step(controller, {1: target} | fields)
            return receive(controller).axes.tobytes()

        assert run({}) == run({4: 0.01, 5: 1.0})

    @pytest.mark.parametrize("mode", [2, 8])
    def test_modes_2_and_8_add_d4_to_the_speed_demanded(self, mode: int) -> None:
        controller = opened(open_mode=mode)
        own = np.array(controller.servo.measured)
        speed = np.array([0.004, -0.004])
        for k in range(600):
            step(controller, {4: speed * min(1.0, k / 100)})
        moved = np.array(controller.servo.measured) - own
        # the position loop pulls back until its demand cancels what is added
        gain = controller.settings.servo.position_gain * controller.period
        np.testing.assert_allclose(moved, speed / gain, rtol=0.1)

    @pytest.mark.parametrize("mode", [1, 2, 9])
    def test_modes_1_2_and_9_add_d5_to_the_target_current(self, mode: int) -> None:
        controller = opened(open_mode=mode)
        first = receive(controller)
        extra = np.array([0.25, -0.125])
        target = {1: first.axes["d"][:, 0]} if mode == 1 else {}
        controller.accept(answer(first, target | {5: extra}))
        with_it = receive(controller).axes["d"][:, 4]

        plain = opened(open_mode=mode)
        step(plain, target)
        without = receive(plain).axes["d"][:, 4]
        np.testing.assert_allclose(with_it - without, extra, atol=1e-6)

    def test_in_mode_1_d4_takes_the_place_of_d2_in_the_speed_loop(self) -> None:
        def current_after(d2: float, d4: float) -> Any:
            controller = opened(open_mode=1)
            target = np.array(controller.servo.target)
            for k in range(3):
                step(controller, {1: target + d2 * (k + 1), 2: d2, 4: d4})
            return receive(controller).axes["d"][:, 4]

        with_it, without = current_after(1e-3, 1e-3), current_after(1e-3, 0.0)
        as_mode_4 = opened()
        target = np.array(as_mode_4.servo.target)
        for k in range(3):
            step(as_mode_4, {1: target + 1e-3 * (k + 1), 2: 1e-3})
        np.testing.assert_array_equal(with_it, receive(as_mode_4).axes["d"][:, 4])
        assert np.all(with_it > without)

    def test_a_current_cannot_be_added_beyond_the_limit(self) -> None:
        controller = opened(open_mode=9)
        step(controller, {5: 100.0})
        limit = small_cell.TABLE["current_limit"]
        np.testing.assert_allclose(receive(controller).axes["d"][:, 4], limit, rtol=1e-6)

    @pytest.mark.parametrize("field", [1, 2])
    def test_a_number_that_is_none_trips_the_drive(self, field: int) -> None:
        controller = opened()
        step(controller, {1: controller.servo.target} | {field: np.nan})
        assert receive(controller).status[0] == 0


class TestWithoutAnAnswer:
    def test_hold_keeps_the_last_target(self) -> None:
        controller = opened(missed_replies=10)
        target = drive_at_speed(controller, speed=0.002)
        for _ in range(3):
            receive(controller)
            controller.accept(None)
        assert controller.phase is Phase.OPEN
        np.testing.assert_allclose(controller.servo.target, np.float32(target))

    def test_continue_goes_on_at_the_last_velocity_then_ramps_down(self) -> None:
        controller = opened(missed_replies=4, while_silent="continue", ramp_time=0.1)
        target = drive_at_speed(controller)
        targets, reasons = [], []
        for _ in range(300):
            receive(controller)
            controller.accept(None)
            targets.append(controller.servo.target[0])
            reasons.append(controller.reason)
        steps = np.diff([target[0], *targets])
        np.testing.assert_allclose(steps[:4], 0.03, rtol=1e-3)
        assert np.all(np.diff(steps[4:110]) <= 1e-9)
        np.testing.assert_allclose(np.diff(steps[5:100]), -0.03 * 0.001 / 0.1, rtol=1e-3)
        np.testing.assert_array_equal(steps[110:], 0.0)
        assert reasons[2:5] == ["", *["no valid reply in 4 cycles of open mode"] * 2]
        # 0.2 s after the ramp the integral parts still unwind
        assert np.abs(controller.plant.velocity).max() < 1e-3 * small_cell.SPEED[0]

    def test_axes_open_again_only_once_the_ramp_is_over(self) -> None:
        controller = opened(while_silent="continue", ramp_time=0.2)
        drive_at_speed(controller)
        receive(controller)
        controller.accept(None)
        closed = 0
        while controller.phase is Phase.CLOSED:
            receive(controller)
            controller.accept(None)
            closed += 1
        assert controller.phase is Phase.OPENING
        assert closed >= 200
        assert not any(controller.servo.delta)

    def test_drive_off_takes_the_drive_away_with_the_last_missing_answer(self) -> None:
        controller = opened(missed_replies=3, while_silent="drive_off")
        for _ in range(2):
            assert receive(controller).status[0] == 5
            controller.accept(None)
        assert step(controller, {1: controller.servo.target}).status[0] == 5
        for _ in range(3):
            assert receive(controller).status[0] == 5
            controller.accept(None)
        assert receive(controller).status[0] == 0
        assert controller.phase is Phase.TRIPPED
        for _ in range(200):
            step(controller)
        assert controller.phase is Phase.DRIVE_OFF, "it stays off until somebody switches it on"
        controller.drive_on()
        step(controller)
        assert controller.phase is Phase.DRIVING_ON


class TestLeaving:
    def test_axes_close_one_after_the_other(self) -> None:
        controller = opened(closing_cycles=2, closing_stagger=3)
        step(controller, {1: controller.servo.target}, status=STATUS_EXIT)
        modes = [tuple(step(controller).axes["mode"].tolist()) for _ in range(7)]
        assert modes == [(4, 4)] * 2 + [(0, 4)] * 3 + [(0, 0)] * 2

    def test_an_axis_that_leaves_by_itself_stays_closed_until_all_open_again(self) -> None:
        controller = opened()
        controller.axis_leaves(2)
        for _ in range(3):
            received = step(controller, {1: controller.servo.target})
            assert received.axes["mode"].tolist() == [4, 0]
        step(controller, {1: controller.servo.target}, status=STATUS_EXIT)
        seen = []
        for _ in range(30):
            packet = controller.next_packet()
            assert packet
            controller.accept(safe(packet))
            seen.append(tuple(CyclicPacket.decode(packet, N).axes["mode"].tolist()))
        assert seen == sorted(seen[:7], reverse=True) + sorted(seen[7:])
        assert seen[-1] == (4, 4)


class TestPause:
    @pytest.mark.parametrize("mode", [500, 502])
    def test_every_axis_reports_it_for_so_long_then_closed_axes(self, mode: int) -> None:
        controller = opened()
        controller.pause(mode, 5)
        modes = [tuple(step(controller).axes["mode"].tolist()) for _ in range(6)]
        assert modes == [(mode, mode)] * 5 + [(0, 0)]

    def test_without_a_drive_there_is_nothing_to_pause(self) -> None:
        controller = opened()
        controller.emergency_stop()
        controller.pause(502, 5)
        assert step(controller).axes["mode"].tolist() == [4, 4]
        assert controller.phase is Phase.TRIPPED


def test_modes_without_a_meaning_are_refused() -> None:
    for change in ({"open_mode": 3}, {"while_silent": "panic"}, {"arm": 5}, {"ramp_time": 0.0}):
        with pytest.raises(SettingError):
            small_cell.controller(**change)
