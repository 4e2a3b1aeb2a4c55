"""The simulated controller as the PC sees it: packets, phases, and how well it follows."""

from __future__ import annotations

from collections.abc import Callable
from math import pi
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from drivers.packets import (
    CyclicPacket,
    InitPacket,
    Mode,
    cyclic_length,
    echo,
    is_init,
    next_number,
)
from sim_fixtures import (
    ControllerSettings,
    Phase,
    PlantTruth,
    SettingError,
    SimulatedController,
    SimulatedDrive,
    UnmodelledEffects,
    ns16,
)
from sim_fixtures.controller import RUN_UP, OwnMotion
from tests.fault_matrix import small_cell

Array = NDArray[np.float64]
Make = Callable[..., SimulatedController]
HOME = np.radians([0.0, -90.0, 180.0, 0.0, 90.0, 0.0])
NOISY = {"current_noise": 0.02, "current_resolution": 0.005}
QUICK: dict[str, Any] = {"drive_off_cycles": 3, "driving_on_cycles": 4, "closed_cycles": 5}


@pytest.fixture
def make(drive: SimulatedDrive, truth: PlantTruth) -> Make:
    def build(**changes: Any) -> SimulatedController:
        options = {"drive": drive, "seed": 1, "initial_position": HOME} | {
            k: changes.pop(k)
            for k in ("drive", "seed", "initial_position", "stated", "effects")
            if k in changes
        }
        settings = ControllerSettings(**(QUICK | changes))
        physical = options.pop("drive")
        return SimulatedController(ns16.urdf_text(), physical, truth, settings, **options)

    return build


def receive(controller: SimulatedController) -> CyclicPacket:
    packet = controller.next_packet()
    assert packet is not None
    return CyclicPacket.decode(packet, 6)


def answer(
    received: CyclicPacket,
    *,
    status: int = 0,
    position: Array | None = None,
    delta: Array | None = None,
    modes: list[int] | None = None,
) -> bytes:
    reply = CyclicPacket.zeros(next_number(received.number), 6)
    reply.axes["mode"] = received.axes["mode"] if modes is None else modes
    reply.axes["d"][:, 0] = received.axes["d"][:, 0] if position is None else position
    reply.axes["d"][:, 1] = 0.0 if delta is None else delta
    return CyclicPacket(reply.number, bytes((status, 0, 0, 0)), bytes(4), reply.axes).encode()


def step(controller: SimulatedController, **reply: Any) -> CyclicPacket:
    received = receive(controller)
    controller.accept(answer(received, **reply))
    return received


def run_to(controller: SimulatedController, phase: Phase, limit: int = 3000) -> None:
    for _ in range(limit):
        if controller.phase is phase:
            return
        packet = controller.next_packet()
        assert packet is not None, controller.reason
        controller.accept(echo(packet))
    raise AssertionError(f"{phase!r} never came; stuck in {controller.phase!r}")


class TestStart:
    def test_nine_sync_packets_init_as_number_ten_and_two_more(self, make: Make) -> None:
        controller = make()
        packets = []
        while controller.phase is Phase.START:
            packet = controller.next_packet()
            assert packet is not None
            packets.append(packet)
            controller.accept(echo(packet))
        assert [int.from_bytes(p[:4], "little") for p in packets] == list(range(1, 13))
        assert [len(p) for p in packets] == [732] * 9 + [1200] + [732] * 2
        assert is_init(packets[9])

    def test_init_tells_the_drive(self, make: Make, drive: SimulatedDrive) -> None:
        controller = make(cold_start=False)
        packet = controller.next_packet()
        assert packet is not None
        init = InitPacket.decode(packet)
        assert init.period == 0.001
        assert [(a.arm, a.axis, a.slot) for a in init.open_axes()] == [(1, i, i) for i in range(6)]
        np.testing.assert_array_equal(init.gear_ratio[0, :6], np.float32(drive.gear_ratio))
        np.testing.assert_array_equal(init.calibration[0, :6], np.float32(drive.calibration))
        np.testing.assert_array_equal(init.current_limit[0, :6], np.float32(drive.current_limit))
        np.testing.assert_array_equal(
            init.following_error[0, :6], np.float32(drive.following_error)
        )
        assert init.wrist_coupling() == pytest.approx((0.03, -0.02, 0.035), rel=1e-7)

    def test_what_is_announced_may_differ_from_what_is_there(
        self, make: Make, make_drive: Callable[..., SimulatedDrive]
    ) -> None:
        lying = make_drive(gear_ratio=[116.0, 116.0, -106.0, -50.0, 51.5, -33.0])
        told = make(cold_start=False, stated=lying)
        honest = make(cold_start=False)
        packet = told.next_packet()
        assert packet is not None
        assert InitPacket.decode(packet).gear_ratio[0, 0] == 116.0
        told.accept(echo(packet))
        for controller in (told, honest):
            run_to(controller, Phase.OPEN)
        np.testing.assert_array_equal(receive(told).axes, receive(honest).axes)

    def test_modes_and_status_on_the_way_to_open(self, make: Make) -> None:
        controller = make(opening_stagger=2)
        run_to(controller, Phase.DRIVE_OFF)
        seen: list[tuple[int, tuple[int, ...]]] = []
        while controller.phase is not Phase.OPEN:
            received = step(controller)
            state = (received.status[0], tuple(received.axes["mode"].tolist()))
            if not seen or seen[-1] != state:
                seen.append(state)
        assert seen[:3] == [(0, (0,) * 6), (5, (501,) * 6), (5, (0,) * 6)]
        # each axis enters open mode in a cycle of its own
        assert [modes.count(4) for _, modes in seen[3:]] == [1, 2, 3, 4, 5, 6]
        assert all(status == 5 for status, _ in seen[1:])

    def test_before_the_drive_is_on_only_the_measurement_is_filled(
        self, make: Make, drive: SimulatedDrive
    ) -> None:
        controller = make(encoder_noise=0.0)
        run_to(controller, Phase.DRIVE_OFF)
        d = step(controller).axes["d"]
        np.testing.assert_array_equal(d[:, [0, 1, 3, 4]], 0.0)
        measured = np.array(drive.motor_revolutions(HOME.tolist()))
        np.testing.assert_allclose(d[:, 2], measured, atol=1.0 / drive.encoder_counts)

    def test_the_first_target_is_where_the_motors_stand(self, make: Make) -> None:
        controller = make()
        run_to(controller, Phase.OPENING)
        d = step(controller).axes["d"]
        np.testing.assert_allclose(d[:, 0], d[:, 2], atol=2e-4)
        np.testing.assert_array_equal(d[:, 1], 0.0)


class TestOpenMode:
    def test_targets_of_open_axes_are_taken_and_of_closed_axes_ignored(self, make: Make) -> None:
        controller = make(opening_stagger=50)
        run_to(controller, Phase.OPENING)
        before = step(controller).axes["d"][:, 0].copy()
        nudge = np.full(6, 0.001)
        step(controller, position=before + nudge, modes=[4] * 6)
        after = receive(controller).axes["d"][:, 0]
        np.testing.assert_allclose(after - before, [0.001, 0, 0, 0, 0, 0], atol=1e-5)

    def test_505_switches_the_drive_off_and_its_targets_are_ignored(self, make: Make) -> None:
        controller = make()
        run_to(controller, Phase.OPEN)
        resting = controller.plant.position.copy()
        step(controller, modes=[505] * 6, position=np.zeros(6))
        after = step(controller)
        assert after.status[0] == 0
        np.testing.assert_array_equal(after.axes["mode"], 0)
        for _ in range(200):
            step(controller)
        np.testing.assert_allclose(controller.plant.position, resting, atol=1e-4)

    def test_508_in_one_slot_closes_all_and_targets_are_ignored(self, make: Make) -> None:
        controller = make()
        run_to(controller, Phase.OPEN)
        before = receive(controller)
        controller.accept(answer(before, modes=[4, 4, 508, 4, 4, 4], position=np.zeros(6)))
        after = step(controller)
        assert after.status[0] == 5
        np.testing.assert_array_equal(after.axes["mode"], 0)
        np.testing.assert_array_equal(after.axes["d"][:, 0], before.axes["d"][:, 0])

    @pytest.mark.parametrize("reply", [None, b"", b"\x05\x00\x00\x00", "stale"])
    def test_a_missing_or_foreign_reply_ends_open_mode(self, make: Make, reply: Any) -> None:
        controller = make()
        run_to(controller, Phase.OPEN)
        received = receive(controller)
        if reply == "stale":
            previous = CyclicPacket(
                received.number - 1, received.status, received.functionality, received.axes
            )
            reply = answer(previous)
        controller.accept(reply)
        np.testing.assert_array_equal(step(controller).axes["mode"], 0)

    def test_a_packet_never_answered_counts_as_missing(self, make: Make) -> None:
        controller = make()
        run_to(controller, Phase.OPEN)
        receive(controller)
        np.testing.assert_array_equal(receive(controller).axes["mode"], 0)

    def test_a_jump_trips_the_drive_by_its_following_error(self, make: Make) -> None:
        controller = make()
        run_to(controller, Phase.OPEN)
        far = np.array(controller.servo.target)
        far[2] += 5.0
        for _ in range(3):
            step(controller, position=far)
        assert controller.phase is Phase.TRIPPED
        assert "axis 3" in controller.reason
        dropped = step(controller)
        assert dropped.status[0] == 0
        np.testing.assert_array_equal(dropped.axes["mode"], 4)


class TestEnd:
    def test_finish_is_drive_off_then_504_then_nothing(self, make: Make) -> None:
        controller = make()
        run_to(controller, Phase.OPEN)
        controller.finish()
        last: CyclicPacket | None = None
        while (packet := controller.next_packet()) is not None:
            last = CyclicPacket.decode(packet, 6)
            controller.accept(answer(last))
        assert last is not None
        np.testing.assert_array_equal(last.axes["mode"], Mode.END_OF_SESSION)
        assert last.status[0] == 0
        assert controller.next_packet() is None

    def test_numbers_wrap_after_0x7fff(self, make: Make) -> None:
        controller = make()
        run_to(controller, Phase.OPEN)
        controller._number = 0x7FFF
        assert step(controller).number == 0x7FFF
        assert step(controller).number == 1
        assert controller.phase is Phase.OPEN


class TestStandstill:
    def test_the_arm_rests_while_the_servo_trembles(self, make: Make) -> None:
        controller = make(**NOISY)
        run_to(controller, Phase.OPEN)
        for _ in range(300):
            step(controller)
        at_rest = controller.plant.position.copy()
        d = np.array([step(controller).axes["d"].copy() for _ in range(500)])
        np.testing.assert_array_equal(controller.plant.position, at_rest)
        counts = d[:, :, 2] * 65536
        assert np.ptp(counts, axis=0).max() <= 6  # encoder noise only
        assert np.all(d[:, :, 4].std(axis=0) > 0.0)
        assert np.all(d[:, :, 4].std(axis=0) < 0.01 * np.array([16.5, 22.0, 9.5, 3.5, 7.0, 10.0]))


class TestDeterminism:
    @staticmethod
    def record(play: Any, drive: SimulatedDrive, seed: int, **options: Any) -> list[bytes]:
        settings = ControllerSettings(**NOISY)
        _, log = play(drive, settings, seed=seed, **options)
        return log.raw  # type: ignore[no-any-return]

    def test_one_seed_is_one_run_bit_for_bit(self, play: Any, drive: SimulatedDrive) -> None:
        effects = UnmodelledEffects.default_sizes(6)
        first = self.record(play, drive, 3, effects=effects)
        assert len(first) > 3000
        assert first == self.record(play, drive, 3, effects=effects)

    def test_another_seed_is_another_run(self, play: Any, drive: SimulatedDrive) -> None:
        assert self.record(play, drive, 3)[500:] != self.record(play, drive, 4)[500:]


class TestFollowing:
    def test_a_smooth_motion_is_followed_within_a_fifth_of_the_threshold(
        self, play: Any, drive: SimulatedDrive, smooth_motion: Any
    ) -> None:
        controller, log = play(drive, ControllerSettings(**NOISY))
        assert controller.reason == ""
        d = log.axes["d"].astype(np.float64)
        error = np.abs(d[:, :, 0] - d[:, :, 2]).max(axis=0)
        assert np.all(error < 0.2 * np.array(drive.following_error))
        assert np.all(np.abs(d[:, :, 4]).max(axis=0) < 0.75 * np.array(drive.current_limit))
        # the arm really was where the motion wanted it, one cycle after the target was sent
        np.testing.assert_allclose(log.q[1:], smooth_motion.q[:-1], atol=4e-3)
        assert np.abs(log.qd).max() > 1.0

    def test_the_stated_velocity_is_that_of_the_motion(
        self, play: Any, drive: SimulatedDrive
    ) -> None:
        _, log = play(drive, ControllerSettings())
        d = log.axes["d"].astype(np.float64)
        np.testing.assert_allclose(d[1:-1, :, 1], 0.5 * (d[2:, :, 0] - d[:-2, :, 0]), atol=2e-5)
        # D4 is the difference of the encoder positions of this packet and the one before
        np.testing.assert_allclose(d[1:, :, 3], d[1:, :, 2] - d[:-1, :, 2], atol=2e-5)

    def test_extra_2_is_the_diagonal_inertia_on_the_joint_side(
        self, play: Any, drive: SimulatedDrive, truth: PlantTruth
    ) -> None:
        import pinocchio as pin

        controller, log = play(drive, ControllerSettings())
        k = 1500
        inertia = pin.crba(
            controller.plant.model, controller.plant.model.createData(), log.q[k]
        ).diagonal()
        np.testing.assert_allclose(log.axes["extra"][k, :, 1], inertia, rtol=0.11)


@pytest.fixture(scope="module")
def silent_run(play: Any, make_drive: Callable[..., SimulatedDrive]) -> Any:
    """The smooth motion without noise, with encoders so fine that the servo is quiet too."""
    return play(make_drive(encoder_counts=2**30), ControllerSettings(encoder_noise=0.0))


class TestCurrentsAreTorques:
    """Target current of the servo, converted by matrices, against inverse dynamics."""

    @staticmethod
    def torque(drive: SimulatedDrive, turn: Array, current: Array) -> Array:
        motor_torque = current * drive.torque_constant
        return motor_torque @ (2.0 * pi * turn) * drive.joint_sign

    @staticmethod
    def needed(controller: SimulatedController, q: Array, qd: Array, qdd: Array) -> Array:
        import pinocchio as pin

        plain = pin.buildModelFromXML(ns16.urdf_text())
        data = plain.createData()
        rigid = np.array([pin.rnea(plain, data, *state) for state in zip(q, qd, qdd, strict=True)])
        return rigid + controller.truth.rotor_inertia * qdd + controller.truth.friction(qd)

    def residuals(self, silent_run: Any, drive: SimulatedDrive, turn: Array, delay: float) -> Array:
        """Relative residual per joint when currents stand `delay` cycles after positions."""
        controller, log = silent_run
        qdd = (log.qd[2:] - log.qd[:-2]) / 0.002
        expected = self.needed(controller, log.q[1:-1], log.qd[1:-1], qdd)
        current = log.axes["d"][:, :, 4].astype(np.float64)
        k = np.arange(1.0, len(current) - 1.0)
        shifted = np.column_stack(
            [np.interp(k + delay, np.arange(len(current)), column) for column in current.T]
        )
        torque = self.torque(drive, turn, shifted)
        moving = np.abs(log.qd[1:-1]) > 0.05
        used = moving[10:-10]
        residual = np.where(used, torque[10:-10] - expected[10:-10], 0.0)
        scale = np.sqrt(np.mean(expected[10:-10] ** 2, axis=0))
        return np.sqrt((residual**2).sum(axis=0) / used.sum(axis=0)) / scale

    def test_they_agree(
        self, silent_run: Any, drive: SimulatedDrive, motor_matrix: Callable[..., Array]
    ) -> None:
        delay = silent_run[0].current_delay_cycles
        assert np.all(self.residuals(silent_run, drive, motor_matrix(drive), delay) < 3e-4)

    def test_the_documented_delay_is_the_best_one(
        self, silent_run: Any, drive: SimulatedDrive, motor_matrix: Callable[..., Array]
    ) -> None:
        controller = silent_run[0]
        delays = controller.current_delay_cycles + np.linspace(-0.9, 0.9, 37)
        turn = motor_matrix(drive)
        cost = [np.sum(self.residuals(silent_run, drive, turn, d) ** 2) for d in delays]
        a, b, _ = np.polyfit(delays, cost, 2)
        assert a > 0.0
        assert -b / (2.0 * a) == pytest.approx(controller.current_delay_cycles, abs=0.01)

    @pytest.mark.parametrize(
        "flip",
        [
            {"gear_ratio": [116.0, 116.0, -106.0, -50.0, 51.5, -33.0]},
            {"k54": -0.03},
            {"k64": 0.02},
            {"k65": -0.035},
            {"torque_constant": [1.1, 1.1, 0.75, 0.36, 0.46, 0.42]},
        ],
    )
    def test_one_wrong_figure_in_the_conversion_shows(
        self,
        silent_run: Any,
        drive: SimulatedDrive,
        make_drive: Callable[..., SimulatedDrive],
        motor_matrix: Callable[..., Array],
        flip: dict[str, Any],
    ) -> None:
        delay = silent_run[0].current_delay_cycles
        right = self.residuals(silent_run, drive, motor_matrix(drive), delay)
        wrong_drive = make_drive(**flip)
        wrong = self.residuals(silent_run, wrong_drive, motor_matrix(wrong_drive), delay)
        assert (wrong / right).max() > 50.0


def test_sizes_must_match(drive: SimulatedDrive) -> None:
    with pytest.raises(SettingError, match="6 axes"):
        SimulatedController(
            ns16.urdf_text(), drive, PlantTruth.frictionless(np.ones(5)), ControllerSettings(),
            seed=1,
        )  # fmt: skip


def test_the_truth_is_at_hand_for_reports(make: Make, truth: PlantTruth) -> None:
    controller = make()
    assert controller.truth is truth
    planted = controller.standard_parameters()
    for name, value in ns16.standard_parameters().items():
        assert planted[name] == pytest.approx(value, rel=1e-11, abs=1e-11), name


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


PERIOD = 0.002
SPEED = np.array([2.0, 3.0])
angles = st.floats(-2.0, 2.0)


def play(motion: OwnMotion, limit: int = 20_000) -> tuple[np.ndarray, np.ndarray]:
    rows = []
    while not motion.finished:
        rows.append(tuple(part.copy() for part in motion.advance()))
        assert len(rows) < limit
    q, qd = zip(*rows, strict=True)
    return np.array(q), np.array(qd)


def motion(*postures: tuple[float, float], start: tuple[float, float] = (0.0, 0.0)) -> OwnMotion:
    made = OwnMotion(postures, speed=SPEED, period=PERIOD, dwell=0.02)
    made.begin(start)
    return made


def test_each_posture_is_reached_exactly_and_rested_in() -> None:
    postures = [(0.5, -0.3), (-0.2, 0.4)]
    q, qd = play(motion(*postures))
    np.testing.assert_array_equal(q[-1], postures[1])
    np.testing.assert_array_equal(qd[-1], 0.0)
    resting = np.all(q == postures[0], axis=1)
    assert resting.sum() == pytest.approx(0.02 / PERIOD, abs=1)
    np.testing.assert_array_equal(qd[resting], 0.0)


@given(st.tuples(angles, angles), st.tuples(angles, angles))
def test_speed_and_acceleration_keep_their_bounds(
    there: tuple[float, float], start: tuple[float, float]
) -> None:
    q, qd = play(motion(there, start=start))
    assert np.all(np.abs(qd) <= SPEED * (1.0 + 1e-9))
    steps = np.diff(np.vstack((start, q)), axis=0) / PERIOD
    assert np.all(np.abs(steps) <= SPEED * (1.0 + 1e-6))
    assert np.all(np.abs(np.diff(qd, axis=0)) / PERIOD <= SPEED / RUN_UP * (1.0 + 1e-6))


def test_the_stated_velocity_is_the_derivative_of_the_positions() -> None:
    q, qd = play(motion((1.0, -1.0)))
    np.testing.assert_allclose(qd[1:-1], (q[2:] - q[:-2]) / (2.0 * PERIOD), atol=1e-4)


def test_told_to_end_it_finishes_the_move_under_way_and_begins_no_other() -> None:
    made = motion((0.5, 0.5), (1.0, 1.0))
    while made.at_rest:
        made.advance()
    made.end()
    q, _ = play(made)
    np.testing.assert_array_equal(q[-1], (0.5, 0.5))


def test_repeated_it_goes_to_and_fro_on_the_ways_of_the_list() -> None:
    stops = [(0.5, -0.3), (-0.2, 0.4), (0.1, 0.1)]
    made = OwnMotion(stops, speed=SPEED, period=PERIOD, dwell=0.02, repeats=True)
    made.begin((0.0, 0.0))
    visited: list[tuple[float, ...]] = []
    while len(visited) < 8:
        moved = not made.at_rest
        made.advance()
        assert not made.finished
        if moved and made.at_rest:
            visited.append(tuple(made.position.tolist()))
    first, second, third = stops
    assert visited == [first, second, third, second, first, second, third, second]
    made.end()
    assert made.finished


def test_a_single_posture_repeated_is_rested_in() -> None:
    made = OwnMotion([(0.5, -0.3)], speed=SPEED, period=PERIOD, dwell=0.02, repeats=True)
    made.begin((0.0, 0.0))
    for _ in range(2000):
        made.advance()
    np.testing.assert_array_equal(made.position, (0.5, -0.3))
    np.testing.assert_array_equal(made.velocity, 0.0)


def test_a_posture_of_another_arm_is_refused() -> None:
    with pytest.raises(SettingError, match="2 joint angles"):
        OwnMotion([(0.0, 0.0, 0.0)], speed=SPEED, period=PERIOD)


@pytest.mark.parametrize("speed", [0.0, np.inf, np.nan])
def test_an_arm_without_velocity_limits_does_not_move_by_itself(speed: float) -> None:
    with pytest.raises(SettingError, match="velocity limits"):
        OwnMotion([(0.0, 0.0)], speed=[1.0, speed], period=PERIOD)
