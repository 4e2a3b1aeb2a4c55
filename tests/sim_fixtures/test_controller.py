"""The simulated controller: packets, phases and open modes as the PC sees them."""

from __future__ import annotations

from math import pi
from typing import Any

import numpy as np
import pinocchio as pin
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
    SettingError,
    SimulatedController,
    SimulatedDrive,
    UnmodelledEffects,
    ns16,
)
from sim_fixtures.controller import RUN_UP, OwnMotion
from sim_fixtures.program import MISSING, Answer, LoopProgram, StartStep
from tests.fault_matrix import small_cell
from tests.sim_fixtures.bench import DRIVE, SMOOTH_Q, TRUTH, make_drive, motor_matrix, play

Array = NDArray[np.float64]
Fields = dict[int, Any]
"""What is answered: field number 1..5 to values."""
HOME = np.radians([0.0, -90.0, 180.0, 0.0, 90.0, 0.0])
NOISY = {"current_noise": 0.02, "current_resolution": 0.005}
QUICK: dict[str, Any] = {"drive_off_cycles": 3, "driving_on_cycles": 4, "closed_cycles": 5}


def make(**changes: Any) -> SimulatedController:
    options = {"drive": DRIVE, "seed": 1, "initial_position": HOME} | {
        k: changes.pop(k)
        for k in ("drive", "seed", "initial_position", "stated", "effects")
        if k in changes
    }
    settings = ControllerSettings(**(QUICK | changes))
    physical = options.pop("drive")
    return SimulatedController(ns16.urdf_text(), physical, TRUTH, settings, **options)


def receive(controller: SimulatedController) -> CyclicPacket:
    packet = controller.next_packet()
    assert packet
    return CyclicPacket.decode(packet, len(controller.plant.position))


def answer(
    received: CyclicPacket, fields: Fields | None = None, *, status: int = 0, modes: Any = None
) -> bytes:
    """With these fields, or with the target received."""
    reply = CyclicPacket.zeros(next_number(received.number), len(received.axes))
    reply.axes["mode"] = received.axes["mode"] if modes is None else modes
    for number, values in (fields or {1: received.axes["d"][:, 0]}).items():
        reply.axes["d"][:, number - 1] = values
    return CyclicPacket(reply.number, bytes((status, 0, 0, 0)), bytes(4), reply.axes).encode()


def step(
    controller: SimulatedController, fields: Fields | None = None, **options: Any
) -> CyclicPacket:
    received = receive(controller)
    controller.accept(answer(received, fields, **options))
    return received


def run_to(controller: SimulatedController, phase: Phase, limit: int = 3000) -> None:
    for _ in range(limit):
        if controller.phase is phase:
            return
        packet = controller.next_packet()
        assert packet is not None, controller.reason
        controller.accept(echo(packet))
    raise AssertionError(f"{phase!r} never came; stuck in {controller.phase!r}")


def echoed(controller: SimulatedController, cycles: int) -> list[bytes]:
    """Packets of some cycles, each answered by an echo."""
    packets = []
    for _ in range(cycles):
        packet = controller.next_packet()
        assert packet
        packets.append(packet)
        controller.accept(echo(packet))
    return packets


def init_of(controller: SimulatedController) -> InitPacket:
    return InitPacket.decode(echoed(controller, 1)[0])


class TestStart:
    def test_nine_sync_packets_init_as_number_ten_and_two_more(self) -> None:
        controller = make()
        packets = echoed(controller, 12)
        assert controller.phase is not Phase.START
        assert [int.from_bytes(p[:4], "little") for p in packets] == list(range(1, 13))
        assert [len(p) for p in packets] == [732] * 9 + [1200] + [732] * 2
        assert is_init(packets[9])

    def test_the_init_packet_has_the_drive_train(self) -> None:
        init = init_of(make(cold_start=False))
        assert init.period == 0.001
        assert [(a.arm, a.axis, a.slot) for a in init.open_axes()] == [(1, i, i) for i in range(6)]
        for name in ("gear_ratio", "calibration", "current_limit", "following_error"):
            stated = np.float32(getattr(DRIVE, name))
            np.testing.assert_array_equal(getattr(init, name)[0, :6], stated, err_msg=name)
        assert init.wrist_coupling() == pytest.approx((0.03, -0.02, 0.035), rel=1e-7)

    def test_a_stated_drive_train_replaces_the_true_one_in_init_only(self) -> None:
        wrong = make_drive(gear_ratio=[116.0, 116.0, -106.0, -50.0, 51.5, -33.0])
        stating, honest = make(cold_start=False, stated=wrong), make(cold_start=False)
        assert init_of(stating).gear_ratio[0, 0] == 116.0
        for controller in (stating, honest):
            run_to(controller, Phase.OPEN)
        np.testing.assert_array_equal(receive(stating).axes, receive(honest).axes)

    def test_modes_and_status_on_the_way_to_open(self) -> None:
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

    def test_the_first_target_is_where_the_motors_stand(self) -> None:
        controller = make()
        run_to(controller, Phase.OPENING)
        d = step(controller).axes["d"]
        np.testing.assert_allclose(d[:, 0], d[:, 2], atol=2e-4)
        np.testing.assert_array_equal(d[:, 1], 0.0)


class TestOpenMode:
    def test_targets_of_open_axes_apply_and_of_closed_axes_do_not(self) -> None:
        controller = make(opening_stagger=50)
        run_to(controller, Phase.OPENING)
        before = step(controller).axes["d"][:, 0].copy()
        nudge = np.full(6, 0.001)
        step(controller, {1: before + nudge}, modes=[4] * 6)
        after = receive(controller).axes["d"][:, 0]
        np.testing.assert_allclose(after - before, [0.001, 0, 0, 0, 0, 0], atol=1e-5)

    def test_505_switches_the_drive_off_and_its_targets_are_ignored(self) -> None:
        controller = make()
        run_to(controller, Phase.OPEN)
        resting = controller.plant.position.copy()
        step(controller, {1: 0.0}, modes=[505] * 6)
        after = step(controller)
        assert after.status[0] == 0
        np.testing.assert_array_equal(after.axes["mode"], 0)
        for _ in range(200):
            step(controller)
        np.testing.assert_allclose(controller.plant.position, resting, atol=1e-4)

    def test_508_in_one_slot_closes_all_and_targets_are_ignored(self) -> None:
        controller = make()
        run_to(controller, Phase.OPEN)
        before = receive(controller)
        controller.accept(answer(before, {1: 0.0}, modes=[4, 4, 508, 4, 4, 4]))
        after = step(controller)
        assert after.status[0] == 5
        np.testing.assert_array_equal(after.axes["mode"], 0)
        np.testing.assert_array_equal(after.axes["d"][:, 0], before.axes["d"][:, 0])

    @pytest.mark.parametrize("reply", ["none", None, b"", b"\x05\x00\x00\x00", "stale"])
    def test_a_missing_or_foreign_reply_ends_open_mode(self, reply: Any) -> None:
        """So does a packet without a call of `accept` ("none")."""
        controller = make()
        run_to(controller, Phase.OPEN)
        received = receive(controller)
        if reply == "stale":
            previous = CyclicPacket(
                received.number - 1, received.status, received.functionality, received.axes
            )
            reply = answer(previous)
        if reply != "none":
            controller.accept(reply)
        np.testing.assert_array_equal(receive(controller).axes["mode"], 0)

    def test_a_jump_trips_the_drive_by_its_following_error(self) -> None:
        controller = make()
        run_to(controller, Phase.OPEN)
        far = np.array(controller.servo.target)
        far[2] += 5.0
        for _ in range(3):
            step(controller, {1: far})
        assert controller.phase is Phase.TRIPPED
        assert "axis 3" in controller.reason
        dropped = step(controller)
        assert dropped.status[0] == 0
        np.testing.assert_array_equal(dropped.axes["mode"], 4)


class TestEnd:
    def test_finish_is_drive_off_then_504_then_nothing(self) -> None:
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

    def test_numbers_wrap_after_0x7fff(self) -> None:
        controller = make()
        run_to(controller, Phase.OPEN)
        controller._number = 0x7FFF
        assert step(controller).number == 0x7FFF
        assert step(controller).number == 1
        assert controller.phase is Phase.OPEN


class TestStandstill:
    def test_the_arm_rests_while_the_servo_trembles(self) -> None:
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


def test_one_seed_is_one_run_bit_for_bit() -> None:
    settings, effects = ControllerSettings(**NOISY), UnmodelledEffects.default_sizes(6)
    logs = [play(DRIVE, settings, seed=seed, effects=effects)[1] for seed in (3, 3, 4)]
    first, again, other = (log.raw for log in logs)
    assert len(first) > 3000
    assert first == again
    assert first[500:] != other[500:]


class TestFollowing:
    def test_a_smooth_motion_is_followed_within_a_fifth_of_the_threshold(self) -> None:
        controller, log = play(DRIVE, ControllerSettings(**NOISY))
        assert controller.reason == ""
        d = log.axes["d"].astype(np.float64)
        error = np.abs(d[:, :, 0] - d[:, :, 2]).max(axis=0)
        assert np.all(error < 0.2 * np.array(DRIVE.following_error))
        assert np.all(np.abs(d[:, :, 4]).max(axis=0) < 0.75 * np.array(DRIVE.current_limit))
        # the arm really was where the motion wanted it, one cycle after the target was sent
        np.testing.assert_allclose(log.q[1:], SMOOTH_Q[:-1], atol=4e-3)
        assert np.abs(log.qd).max() > 1.0

    def test_the_stated_velocity_is_that_of_the_motion(self) -> None:
        _, log = play(DRIVE, ControllerSettings())
        d = log.axes["d"].astype(np.float64)
        np.testing.assert_allclose(d[1:-1, :, 1], 0.5 * (d[2:, :, 0] - d[:-2, :, 0]), atol=2e-5)
        # D4 is the difference of the encoder positions of this packet and the one before
        np.testing.assert_allclose(d[1:, :, 3], d[1:, :, 2] - d[:-1, :, 2], atol=2e-5)

    def test_extra_2_is_the_diagonal_inertia_on_the_joint_side(self) -> None:
        controller, log = play(DRIVE, ControllerSettings())
        model = controller.plant.model
        inertia = pin.crba(model, model.createData(), log.q[1500]).diagonal()
        np.testing.assert_allclose(log.axes["extra"][1500, :, 1], inertia, rtol=0.11)


@pytest.fixture(scope="module")
def silent_run() -> Any:
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
        model = pin.buildModelFromXML(ns16.urdf_text())
        data = model.createData()
        rigid = np.array([pin.rnea(model, data, *state) for state in zip(q, qd, qdd, strict=True)])
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

    def test_they_agree(self, silent_run: Any) -> None:
        delay = silent_run[0].current_delay_cycles
        assert np.all(self.residuals(silent_run, DRIVE, motor_matrix(DRIVE), delay) < 3e-4)

    def test_the_documented_delay_is_the_best_one(self, silent_run: Any) -> None:
        controller = silent_run[0]
        delays = controller.current_delay_cycles + np.linspace(-0.9, 0.9, 37)
        turn = motor_matrix(DRIVE)
        cost = [np.sum(self.residuals(silent_run, DRIVE, turn, d) ** 2) for d in delays]
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
        self, silent_run: Any, flip: dict[str, Any]
    ) -> None:
        delay = silent_run[0].current_delay_cycles
        right = self.residuals(silent_run, DRIVE, motor_matrix(DRIVE), delay)
        wrong_drive = make_drive(**flip)
        wrong = self.residuals(silent_run, wrong_drive, motor_matrix(wrong_drive), delay)
        assert (wrong / right).max() > 50.0


def axes_at(controller: SimulatedController, phase: Phase, n: int) -> NDArray[np.void]:
    """Axis blocks of the first packet of a phase, with everything echoed until then."""
    run_to(controller, phase)
    packet = controller.next_packet()
    assert packet
    return CyclicPacket.decode(packet, n).axes


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


def test_each_arm_has_a_status_byte() -> None:
    """Also in replies: only the one of this arm ends its open mode."""
    controller = small_cell.controller(arm=3, foreign_axes=11)
    axes_at(controller, Phase.CLOSED, 13)
    packet = controller.next_packet()
    assert packet
    assert packet[4:8] == bytes((5, 5, 5, 0))
    controller = small_cell.controller(arm=2, foreign_axes=1)
    axes = axes_at(controller, Phase.OPEN, 3)
    for status, phase in (((1, 0, 0, 0), Phase.OPEN), ((0, 1, 0, 0), Phase.CLOSING)):
        number = next_number(controller._number)
        controller.accept(CyclicPacket(number, bytes(status), bytes(4), axes.copy()).encode())
        assert controller.phase is phase
        controller.next_packet()


@pytest.mark.parametrize("opens", [False, True])
def test_axes_of_other_arms_move_only_when_they_are_open(opens: bool) -> None:
    controller = small_cell.controller(foreign_axes=2, foreign_open=opens)
    axes = axes_at(controller, Phase.OPEN, 4).copy()
    before = axes["d"][2:, 0].copy()
    assert axes["mode"].tolist() == [4, 4, *[4 if opens else 0] * 2]
    axes["d"][2:, 0] += 0.5
    axes["mode"] = 4
    reply = CyclicPacket(next_number(controller._number), bytes(4), bytes(4), axes)
    controller.accept(reply.encode())
    moved = axes_at(controller, Phase.OPEN, 4)["d"][2:, 0] - before
    np.testing.assert_allclose(moved, 0.5 if opens else 0.0)


def test_long_packets_have_732_bytes_and_a_tail_that_one_seed_repeats() -> None:
    def packets(**changes: Any) -> list[bytes]:
        controller = small_cell.controller(cold_start=False, **changes)
        return echoed(controller, 40)[1:]

    long, short = packets(long_packets=True), packets()
    assert {len(packet) for packet in long} == {732}
    assert {len(packet) for packet in short} == {cyclic_length(2)}
    assert [packet[: cyclic_length(2)] for packet in long] == short
    assert long[0][-100:] != long[1][-100:]
    assert long == packets(long_packets=True)
    assert long != packets(long_packets=True, seed=2)


PERIOD = 0.002
SPEED = np.array([2.0, 3.0])
angles = st.floats(-2.0, 2.0)


def played(motion: OwnMotion, limit: int = 20_000) -> tuple[np.ndarray, np.ndarray]:
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


def test_an_own_motion_rests_in_each_posture() -> None:
    postures = [(0.5, -0.3), (-0.2, 0.4)]
    q, qd = played(motion(*postures))
    np.testing.assert_array_equal(q[-1], postures[1])
    np.testing.assert_array_equal(qd[-1], 0.0)
    resting = np.all(q == postures[0], axis=1)
    assert resting.sum() == pytest.approx(0.02 / PERIOD, abs=1)
    np.testing.assert_array_equal(qd[resting], 0.0)
    np.testing.assert_allclose(qd[1:-1], (q[2:] - q[:-2]) / (2.0 * PERIOD), atol=4e-3)


@given(st.tuples(angles, angles), st.tuples(angles, angles))
def test_speed_and_acceleration_keep_their_bounds(
    there: tuple[float, float], start: tuple[float, float]
) -> None:
    q, qd = played(motion(there, start=start))
    assert np.all(np.abs(qd) <= SPEED * (1.0 + 1e-9))
    steps = np.diff(np.vstack((start, q)), axis=0) / PERIOD
    assert np.all(np.abs(steps) <= SPEED * (1.0 + 1e-6))
    assert np.all(np.abs(np.diff(qd, axis=0)) / PERIOD <= SPEED / RUN_UP * (1.0 + 1e-6))


def test_a_repeated_own_motion_moves_back_and_forth() -> None:
    a, b, c = stops = [(0.5, -0.3), (-0.2, 0.4), (0.1, 0.1)]
    for postures, expected in ((stops, [a, b, c, b, a, b, c, b]), ([a], [a])):
        made = OwnMotion(postures, speed=SPEED, period=PERIOD, dwell=0.02, repeats=True)
        made.begin((0.0, 0.0))
        visited: list[tuple[float, ...]] = []
        for _ in range(5000):
            moved = not made.at_rest
            made.advance()
            if moved and made.at_rest:
                visited.append(tuple(made.position.tolist()))
        assert visited[:8] == expected


AXES = small_cell.N
STATUS_EXIT = 1


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
    received = CyclicPacket.decode(packet, AXES)
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
        before = receive(opened(open_mode=mode)).axes["d"][:, 0].copy()
        controller = opened(open_mode=mode)
        # D1 has no effect in modes 2, 8 and 9; an offset in mode 7 is not reported either
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

        unchanged = opened(open_mode=mode)
        step(unchanged, target)
        without = receive(unchanged).axes["d"][:, 4]
        np.testing.assert_allclose(with_it - without, extra, atol=1e-6)

    @pytest.mark.parametrize("field", [1, 2])
    def test_a_number_that_is_not_finite_trips_the_drive(self, field: int) -> None:
        controller = opened()
        step(controller, {1: controller.servo.target} | {field: np.nan})
        assert receive(controller).status[0] == 0


class TestWithoutAnAnswer:
    def test_continue_extrapolates_then_ramps_down(self) -> None:
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
        assert controller.phase is Phase.DRIVE_OFF  # until it is switched on
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
            seen.append(tuple(CyclicPacket.decode(packet, AXES).axes["mode"].tolist()))
        assert seen == sorted(seen[:7], reverse=True) + sorted(seen[7:])
        assert seen[-1] == (4, 4)


FINE = Answer(valid=True)
SHORT: dict[str, Any] = {
    "drive_off_cycles": 2,
    "driving_on_cycles": 3,
    "closed_cycles": 2,
    "closing_cycles": 2,
    "opening_stagger": 2,
}


def program(**changes: Any) -> LoopProgram:
    return LoopProgram(3, ControllerSettings(**(SHORT | changes)))


def advance(loop: LoopProgram, cycles: int = 1, answer: Answer = FINE) -> None:
    for _ in range(cycles):
        loop.advance(answer, at_rest=True)


def advance_to(loop: LoopProgram, phase: Phase) -> None:
    for _ in range(100):
        if loop.phase is phase:
            return
        advance(loop)
    raise AssertionError(f"{phase!r} never came; stuck in {loop.phase!r}")


def phases_to(loop: LoopProgram, last: Phase) -> list[Phase]:
    """Advance to a phase; return that of each cycle before."""
    phases = []
    while loop.phase is not last:
        phases.append(loop.phase)
        advance(loop)
    return phases


def test_a_warm_start_begins_with_an_init_packet_to_be_answered() -> None:
    loop, unanswered = program(cold_start=False), program(cold_start=False)
    assert loop.start_step is StartStep.INIT
    advance(loop)
    assert loop.phase is Phase.DRIVE_OFF
    advance(unanswered, answer=MISSING)
    assert unanswered.phase is Phase.ENDED
    assert "init" in unanswered.reason


def test_phases_last_as_long_as_set() -> None:
    loop = program()
    advance_to(loop, Phase.DRIVE_OFF)
    closed = [Phase.DRIVE_OFF] * 2 + [Phase.DRIVING_ON] * 3 + [Phase.CLOSED] * 2
    assert phases_to(loop, Phase.OPENING) == closed
    assert phases_to(loop, Phase.OPEN) == [Phase.OPENING] * 5  # an axis every other cycle


def test_one_axis_opens_alone() -> None:
    """The others stay closed, and the PC has the arm as soon as that axis is open."""
    loop = program(only_axis=2)
    advance_to(loop, Phase.OPEN)
    assert loop.open_axes == [False, True, False]
    assert loop.intervals == 1
    with pytest.raises(SettingError, match="only_axis"):
        program(only_axis=4)


def lose_opening(loop: LoopProgram) -> None:
    advance_to(loop, Phase.OPENING)
    while loop.phase is Phase.OPENING:
        advance(loop, answer=MISSING)


@pytest.mark.parametrize(
    ("lost_by", "reason"),
    [
        (MISSING, "no valid reply in 1 cycle of open mode"),
        (Answer(True, following_error=True), "the PC reported a following error (508)"),
    ],
)
def test_the_session_ends_after_some_lost_openings_in_a_row(lost_by: Answer, reason: str) -> None:
    """Each is followed by a pause."""
    loop = program(lost_openings=3, reopening_time=0.05)
    for lost in (1, 2, 3):
        assert not loop.gave_up
        advance_to(loop, Phase.OPEN)
        advance(loop, answer=lost_by)
        assert loop.openings_lost == lost
        if lost < 3:
            assert len(phases_to(loop, Phase.OPENING)) == 50
    assert loop.gave_up
    advance_to(loop, Phase.ENDED)
    assert loop.reason == f"open mode was lost 3 times in a row: {reason}"


def test_a_trip_in_open_mode_drops_the_drive_before_the_modes() -> None:
    loop = program()
    advance_to(loop, Phase.OPEN)
    loop.trip("test")
    assert not loop.powered
    assert loop.braked
    assert all(loop.open_axes)
    advance(loop, 2)
    assert loop.phase is Phase.DRIVE_OFF
    assert not any(loop.open_axes)


def test_finish_waits_until_the_arm_is_at_rest() -> None:
    loop = program()
    advance_to(loop, Phase.OPEN)
    loop.finish()
    loop.advance(FINE, at_rest=False)
    assert loop.phase is Phase.OPEN
    loop.advance(FINE, at_rest=True)
    assert loop.phase is Phase.CLOSING
    phases = phases_to(loop, Phase.ENDED)
    assert phases[-3:] == [Phase.SHUTDOWN, Phase.SHUTDOWN, Phase.ENDING]
