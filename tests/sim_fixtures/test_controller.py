"""The simulated controller: packets, phases and open modes as the PC sees them."""

from __future__ import annotations

from collections.abc import Callable
from math import pi
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from drivers.c4g_packets import (
    CyclicPacket,
    InitPacket,
    Mode,
    echo,
    is_init,
    next_number,
)
from hil.control.own_moves import InterpolatedMoves
from sim_fixtures import (
    ControllerSettings,
    Phase,
    SettingError,
    SimulatedController,
    UnmodelledEffects,
    ns16,
)
from sim_fixtures.controller import MISSING, LoopProgram, OwnMotion, Requests
from tests.fault_matrix import small_cell
from tests.sim_fixtures.bench import (
    DRIVE,
    SMOOTH_Q,
    TRUTH,
    MinimalPC,
    make_drive,
    motor_matrix,
    play,
)

Array = NDArray[np.float64]
Fields = dict[int, Any]
"""Fields of a reply: 1..5 for D1..D5, to values of all axes."""
HOME = np.radians([0.0, -90.0, 180.0, 0.0, 90.0, 0.0])
NOISY = {"current_noise": 0.02, "current_resolution": 0.005}
QUICK: dict[str, Any] = {"drive_off_cycles": 3, "driving_on_cycles": 4, "closed_cycles": 5}
STATUS_EXIT = 1


def make(phase: Phase = Phase.START, stated: Any = None, **changes: Any) -> SimulatedController:
    """A controller of the NS 16 in this phase."""
    controller = SimulatedController(
        ns16.urdf_text(), DRIVE, TRUTH, ControllerSettings(**(QUICK | changes)),
        seed=1, initial_position=HOME, stated=stated,
    )  # fmt: skip
    run_to(controller, phase)
    return controller


def opened(**settings: Any) -> SimulatedController:
    """A controller of two axes in open mode."""
    controller = small_cell.controller(**settings)
    run_to(controller, Phase.OPEN, safe)
    return controller


def run_to(
    controller: SimulatedController, phase: Phase, reply: Callable[[bytes], bytes] = echo
) -> None:
    for _ in range(3000):
        if controller.phase is phase:
            return
        packet = controller.next_packet()
        assert packet is not None, controller.reason
        controller.accept(reply(packet))
    raise AssertionError(f"{phase!r} never came; stuck in {controller.phase!r}")


def safe(packet: bytes) -> bytes:
    """Targets back in modes led by the PC, nothing in the others."""
    if is_init(packet) or len(packet) == 732:
        return echo(packet)
    received = CyclicPacket.decode(packet, small_cell.N)
    led = np.isin(received.axes["mode"], (1, 4, 5, 0))
    return answer(received, {1: np.where(led, received.axes["d"][:, 0], 0.0)})


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
        assert init_of(make(cold_start=False, stated=wrong)).gear_ratio[0, 0] == 116.0
        stating = make(Phase.OPEN, stated=wrong)
        honest = make(Phase.OPEN)
        np.testing.assert_array_equal(receive(stating).axes, receive(honest).axes)

    def test_modes_and_status_on_the_way_to_open(self) -> None:
        controller = make(Phase.DRIVE_OFF, opening_stagger=2)
        seen: list[tuple[int, tuple[int, ...]]] = []
        while controller.phase is not Phase.OPENING:
            received = step(controller)
            state = (received.status[0], tuple(received.axes["mode"].tolist()))
            if not seen or seen[-1] != state:
                seen.append(state)
        assert seen == [(0, (0,) * 6), (5, (501,) * 6), (5, (0,) * 6)]
        d = receive(controller).axes["d"]  # the first target is where the motors are
        np.testing.assert_allclose(d[:, 0], d[:, 2], atol=2e-4)
        np.testing.assert_array_equal(d[:, 1], 0.0)


class TestOpenMode:
    def test_axes_open_in_cycles_of_their_own(self) -> None:
        controller = make(Phase.OPENING, opening_stagger=2)
        seen: list[int] = []
        while controller.phase is not Phase.OPEN:
            received = step(controller)
            assert received.status[0] == 5
            seen.append(received.axes["mode"].tolist().count(4))
        assert sorted(set(seen)) == [1, 2, 3, 4, 5, 6]
        assert seen == sorted(seen)

    def test_targets_of_open_axes_apply_and_of_closed_axes_do_not(self) -> None:
        controller = make(Phase.OPENING, opening_stagger=50)
        before = step(controller).axes["d"][:, 0].copy()
        step(controller, {1: before + 0.001}, modes=[4] * 6)
        after = receive(controller).axes["d"][:, 0]
        np.testing.assert_allclose(after - before, [0.001, 0, 0, 0, 0, 0], atol=1e-5)

    @pytest.mark.parametrize(
        ("modes", "status"), [([505] * 6, 0), ([4, 4, 508, 4, 4, 4], 5)], ids=["505", "508"]
    )
    def test_505_and_508_close_all_axes_and_ignore_targets(
        self, modes: list[int], status: int
    ) -> None:
        controller = make(Phase.OPEN)
        resting = controller.plant.position.copy()
        before = step(controller, {1: 0.0}, modes=modes)
        after = step(controller)
        assert after.status[0] == status
        np.testing.assert_array_equal(after.axes["mode"], 0)
        if status:
            np.testing.assert_array_equal(after.axes["d"][:, 0], before.axes["d"][:, 0])
            return
        for _ in range(200):
            step(controller)
        np.testing.assert_allclose(controller.plant.position, resting, atol=1e-4)

    @pytest.mark.parametrize("reply", ["none", None, b"", b"\x05\x00\x00\x00", "stale"])
    def test_a_missing_or_foreign_reply_ends_open_mode(self, reply: Any) -> None:
        """So does a packet without a call of `accept` ("none")."""
        controller = make(Phase.OPEN)
        received = receive(controller)
        if reply == "stale":
            previous = (received.number - 1, received.status, received.functionality, received.axes)
            reply = answer(CyclicPacket(*previous))
        if reply != "none":
            controller.accept(reply)
        np.testing.assert_array_equal(receive(controller).axes["mode"], 0)

    def test_a_jump_trips_the_drive_by_its_following_error(self) -> None:
        controller = make(Phase.OPEN)
        far = np.array(controller.servo.target)
        far[2] += 5.0
        for _ in range(3):
            step(controller, {1: far})
        assert controller.phase is Phase.TRIPPED
        assert "axis 3" in controller.reason
        dropped = step(controller)
        assert dropped.status[0] == 0
        np.testing.assert_array_equal(dropped.axes["mode"], 4)

    def test_numbers_wrap_after_0x7fff(self) -> None:
        controller = make(Phase.OPEN)
        controller._number = 0x7FFF
        assert [step(controller).number for _ in range(2)] == [0x7FFF, 1]
        assert controller.phase is Phase.OPEN

    def test_finish_is_drive_off_then_504_then_nothing(self) -> None:
        controller = make(Phase.OPEN)
        controller.finish()
        last: CyclicPacket | None = None
        while (packet := controller.next_packet()) is not None:
            last = CyclicPacket.decode(packet, 6)
            controller.accept(answer(last))
        assert last is not None
        np.testing.assert_array_equal(last.axes["mode"], Mode.END_OF_SESSION)
        assert last.status[0] == 0
        assert controller.next_packet() is None

    def test_the_arm_rests_while_the_servo_trembles(self) -> None:
        controller = make(Phase.OPEN, **NOISY)
        for _ in range(300):
            step(controller)
        at_rest = controller.plant.position.copy()
        d = np.array([step(controller).axes["d"].copy() for _ in range(500)])
        np.testing.assert_array_equal(controller.plant.position, at_rest)
        counts = d[:, :, 2] * 65536
        assert np.ptp(counts, axis=0).max() <= 6  # encoder noise only
        assert np.all(d[:, :, 4].std(axis=0) > 0.0)
        assert np.all(d[:, :, 4].std(axis=0) < 0.01 * np.array([16.5, 22.0, 9.5, 3.5, 7.0, 10.0]))


@pytest.mark.safety
def test_one_seed_is_one_run_bit_for_bit() -> None:
    settings = ControllerSettings(**NOISY)
    effects = UnmodelledEffects.default_sizes(6)
    logs = [play(DRIVE, settings, seed=seed, effects=effects)[1] for seed in (3, 3, 4)]
    first, again, other = (log.raw for log in logs)
    assert len(first) > 3000
    assert first == again
    assert first[500:] != other[500:]


class TestSmoothMotion:
    def test_it_is_followed_within_a_fifth_of_the_threshold(self) -> None:
        controller, log = play(DRIVE, ControllerSettings(**NOISY))
        assert controller.reason == ""
        d = log.axes["d"].astype(np.float64)
        error = np.abs(d[:, :, 0] - d[:, :, 2]).max(axis=0)
        assert np.all(error < 0.2 * np.array(DRIVE.following_error))
        assert np.all(np.abs(d[:, :, 4]).max(axis=0) < 0.75 * np.array(DRIVE.current_limit))
        # the arm really was where the motion wanted it, one cycle after the target was sent
        np.testing.assert_allclose(log.q[1:], SMOOTH_Q[:-1], atol=4e-3)
        assert np.abs(log.qd).max() > 1.0

    def test_stated_velocities_and_inertias_are_those_of_the_motion(self) -> None:
        controller, log = play(DRIVE, ControllerSettings())
        d = log.axes["d"].astype(np.float64)
        np.testing.assert_allclose(d[1:-1, :, 1], 0.5 * (d[2:, :, 0] - d[:-2, :, 0]), atol=2e-5)
        # D4 is the difference of the encoder positions of this packet and the one before
        np.testing.assert_allclose(d[1:, :, 3], d[1:, :, 2] - d[:-1, :, 2], atol=2e-5)
        model = controller.plant.model
        inertia = pin.crba(model, model.createData(), log.q[1500]).diagonal()
        np.testing.assert_allclose(log.axes["extra"][1500, :, 1], inertia, rtol=0.11)


class TestCurrentsAreTorques:
    """Target current of the servo, converted by matrices, against inverse dynamics."""

    @pytest.fixture(scope="class")
    @staticmethod
    def residuals() -> Callable[..., Array]:
        """Relative residual per joint when currents are `delay` cycles after positions.

        Of the smooth motion without noise, with encoders so fine that the servo is quiet too.
        """
        fine = make_drive(encoder_counts=2**30)
        controller, log = play(fine, ControllerSettings(encoder_noise=0.0))
        qdd = (log.qd[2:] - log.qd[:-2]) / 0.002
        q = log.q[1:-1]
        qd = log.qd[1:-1]
        model = pin.buildModelFromXML(ns16.urdf_text())
        data = model.createData()
        rigid = np.array([pin.rnea(model, data, *state) for state in zip(q, qd, qdd, strict=True)])
        truth = controller.truth
        expected = (rigid + truth.rotor_inertia * qdd + truth.friction(qd))[10:-10]
        scale = np.sqrt(np.mean(expected**2, axis=0))
        used = (np.abs(qd) > 0.05)[10:-10]
        current = log.axes["d"][:, :, 4].astype(np.float64)
        cycles = np.arange(len(current))

        def of(drive: Any = DRIVE, delay: float = controller.current_delay_cycles) -> Array:
            shifted = np.column_stack(
                [np.interp(cycles[11:-11] + delay, cycles, column) for column in current.T]
            )
            motor_torque = shifted * drive.torque_constant
            torque = motor_torque @ (2.0 * pi * motor_matrix(drive)) * drive.joint_sign
            residual = np.where(used, torque - expected, 0.0)
            return np.sqrt((residual**2).sum(axis=0) / used.sum(axis=0)) / scale

        return of

    def test_they_agree_at_the_documented_delay(self, residuals: Callable[..., Array]) -> None:
        assert np.all(residuals() < 3e-4)
        documented = make().current_delay_cycles
        delays = documented + np.linspace(-0.9, 0.9, 37)
        a, b, _ = np.polyfit(delays, [np.sum(residuals(delay=d) ** 2) for d in delays], 2)
        assert a > 0.0
        assert -b / (2.0 * a) == pytest.approx(documented, abs=0.01)

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
        self, residuals: Callable[..., Array], flip: dict[str, Any]
    ) -> None:
        assert (residuals(make_drive(**flip)) / residuals()).max() > 50.0


@pytest.mark.parametrize("cycle", [2, 4])
def test_currents_of_longer_cycles_have_the_documented_delay(cycle: int) -> None:
    """The loops run each millisecond; the PC sends the step of a cycle as the target's speed."""
    drive = make_drive(encoder_counts=2**30)
    controller = SimulatedController(
        ns16.urdf_text(),
        drive,
        TRUTH,
        ControllerSettings(period=0.001 * cycle, encoder_noise=0.0),
        seed=7,
        initial_position=SMOOTH_Q[0],
    )
    angles = SMOOTH_Q[::cycle] * drive.joint_sign + drive.joint_offset
    targets = angles @ motor_matrix(drive).T + drive.calibration
    steps = np.diff(targets, axis=0, prepend=targets[:1])
    log = MinimalPC(controller, targets, steps).run()
    current = log.axes["d"][:, :, 4].astype(np.float64)
    qdd = (log.qd[2:] - log.qd[:-2]) / (0.002 * cycle)
    model = pin.buildModelFromXML(ns16.urdf_text())
    data = model.createData()
    states = zip(log.q[1:-1], log.qd[1:-1], qdd, strict=True)
    rigid = np.array([pin.rnea(model, data, *state) for state in states])
    expected = rigid + TRUTH.rotor_inertia * qdd + TRUTH.friction(log.qd[1:-1])
    motor = 2.0 * pi * motor_matrix(drive)
    torque = (current * drive.torque_constant) @ motor * drive.joint_sign
    cycles = np.arange(len(torque))
    used = (np.abs(log.qd[1:-1]) > 0.05).all(axis=1)[10:-10]
    scale = np.abs(expected).max(axis=0)

    def residual(delay: float) -> float:
        at = cycles[11:-11] + delay
        shifted = np.column_stack([np.interp(at, cycles, column) for column in torque.T])
        return float(np.sum((((shifted - expected[10:-10]) / scale)[used]) ** 2))

    documented = controller.current_delay_cycles
    delays = documented + np.linspace(-0.9, 0.9, 37)
    a, b, _ = np.polyfit(delays, [residual(delay) for delay in delays], 2)
    assert -b / (2.0 * a) == pytest.approx(documented, abs=0.02)


class TestArms:
    """Axes of other arms in the packets."""

    @staticmethod
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
            (4, (19, 18), 18,
             [*((1, i) for i in range(10)), *((2, i) for i in range(8)), (4, 1), (4, 0)]),
        ],
    )  # fmt: skip
    def test_other_axes_fill_the_slots_that_are_left(
        self, arm: int, slots: tuple[int, int] | None, foreign: int, expected: list[tuple[int, int]]
    ) -> None:
        controller = small_cell.controller(
            arm=arm, slots=slots, foreign_axes=foreign, cold_start=False
        )
        init = init_of(controller)
        assert init.n_axes == 2 + foreign
        assert [(a.arm, a.axis) for a in init.open_axes()] == expected
        np.testing.assert_array_equal(init.gear_ratio[arm - 1, :2], (-100.0, 80.0))
        assert np.all(init.gear_ratio[init.open_axes_map != 0xFF] != 0.0)
        axes = self.axes_at(controller, Phase.CLOSED, 2 + foreign)
        arm_slots = list(slots or (0, 1))
        there = small_cell.drive().motor_revolutions(small_cell.HOME)
        np.testing.assert_allclose(axes["d"][arm_slots, 2], there, atol=1.0 / 65536)

    def test_each_arm_has_a_status_byte(self) -> None:
        """Also in replies: only the one of this arm ends its open mode."""
        controller = small_cell.controller(arm=3, foreign_axes=11)
        self.axes_at(controller, Phase.CLOSED, 13)
        packet = controller.next_packet()
        assert packet
        assert packet[4:8] == bytes((5, 5, 5, 0))
        controller = small_cell.controller(arm=2, foreign_axes=1)
        axes = self.axes_at(controller, Phase.OPEN, 3)
        for status, phase in (((1, 0, 0, 0), Phase.OPEN), ((0, 1, 0, 0), Phase.CLOSING)):
            number = next_number(controller._number)
            controller.accept(CyclicPacket(number, bytes(status), bytes(4), axes.copy()).encode())
            assert controller.phase is phase
            controller.next_packet()

    @pytest.mark.parametrize("opens", [False, True])
    def test_other_axes_move_only_when_they_are_open(self, opens: bool) -> None:
        controller = small_cell.controller(foreign_axes=2, foreign_open=opens)
        axes = self.axes_at(controller, Phase.OPEN, 4).copy()
        before = axes["d"][2:, 0].copy()
        assert axes["mode"].tolist() == [4, 4, *[4 if opens else 0] * 2]
        axes["d"][2:, 0] += 0.5
        axes["mode"] = 4
        reply = CyclicPacket(next_number(controller._number), bytes(4), bytes(4), axes)
        controller.accept(reply.encode())
        moved = self.axes_at(controller, Phase.OPEN, 4)["d"][2:, 0] - before
        np.testing.assert_allclose(moved, 0.5 if opens else 0.0)


class TestOwnMotion:
    """Its moves are those of `planner.Interpolator`."""

    PERIOD = 0.002
    SPEED = 0.5
    angles = st.floats(-2.0, 2.0)

    def motion(
        self, *postures: tuple[float, float], start: Any = (0.0, 0.0), repeats: bool = False
    ) -> OwnMotion:
        moves = InterpolatedMoves(small_cell.limits(), self.PERIOD, self.SPEED)
        made = OwnMotion(postures, moves, period=self.PERIOD, dwell=0.02, repeats=repeats)
        made.begin(start)
        return made

    @given(there=st.tuples(angles, angles), then=st.tuples(angles, angles))
    @pytest.mark.long
    def test_it_rests_in_its_postures_within_its_limits(
        self, there: tuple[float, float], then: tuple[float, float]
    ) -> None:
        motion = self.motion(there, then)
        rows = []
        while not motion.finished:
            rows.append([part.copy() for part in motion.advance()])
            assert len(rows) < 20_000
        q, qd = np.array(rows).transpose(1, 0, 2)
        np.testing.assert_array_equal(q[-1], then)
        np.testing.assert_array_equal(qd[-1], 0.0)
        resting = np.all(q == there, axis=1)
        assert resting.sum() >= 0.02 / self.PERIOD - 1
        path = np.vstack((np.zeros((4, 2)), q, np.tile(q[-1], (3, 1))))
        limits = small_cell.limits()
        for order, (bound, share) in enumerate(
            ((limits.velocity, self.SPEED), (limits.acceleration, 1.0), (limits.jerk, 1.0)), 1
        ):
            rates = np.abs(np.diff(path, order, axis=0)) / self.PERIOD**order
            assert np.all(rates <= share * bound * (1.0 + 1e-6))
        steps = np.diff(path[3:-3], axis=0) / self.PERIOD
        moving = np.any(qd != 0.0, axis=1)
        np.testing.assert_array_equal(qd[moving], steps[moving])

    def test_its_path_is_straight(self) -> None:
        motion = self.motion((1.0, -0.5))
        q = []
        while not motion.finished:
            q.append(motion.advance()[0].copy())
        np.testing.assert_allclose(np.array(q)[:, 1], -0.5 * np.array(q)[:, 0], atol=1e-12)

    def test_it_moves_back_from_outside_its_range(self) -> None:
        motion = self.motion((1.9, 0.0), start=(2.1, 0.0))
        while not motion.finished:
            motion.advance()
        np.testing.assert_array_equal(motion.position, (1.9, 0.0))

    @pytest.mark.parametrize(
        ("posture", "speed", "reason"),
        [((2.5, 0.0), 0.5, "in the limits"), ((1.0, 0.0), 1.5, "joint speed")],
    )
    def test_what_the_interpolator_refuses_is_an_error(
        self, posture: tuple[float, float], speed: float, reason: str
    ) -> None:
        moves = InterpolatedMoves(small_cell.limits(), self.PERIOD, speed)
        with pytest.raises(SettingError, match=reason):
            moves.begin(np.zeros(2))
            moves.move_to(np.array(posture))

    def test_postures_without_moves_between_them_are_refused(self) -> None:
        settings = ControllerSettings(own_motion=((0.5, 0.0),))
        with pytest.raises(SettingError, match="moves"):
            SimulatedController(
                small_cell.URDF, small_cell.drive(), small_cell.truth(), settings, seed=1
            )

    def test_a_repeated_one_moves_back_and_forth(self) -> None:
        a, b, c = stops = [(0.5, -0.3), (-0.2, 0.4), (0.1, 0.1)]
        for postures, expected in ((stops, [a, b, c, b, a, b, c, b]), ([a], [a])):
            motion = self.motion(*postures, repeats=True)
            visited: list[tuple[float, ...]] = []
            for _ in range(5000):
                moved = not motion.at_rest
                motion.advance()
                if moved and motion.at_rest:
                    visited.append(tuple(motion.position.tolist()))
            assert visited[:8] == expected


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
        # D1 has no effect in modes 2, 8 and 9; an offset in mode 7 is not reported either
        reported = [step(controller, {1: 0.002}).axes["d"][:, 0].copy() for _ in range(6)]
        np.testing.assert_array_equal(reported, [reported[0]] * 6)

    def test_mode_7_adds_d1_to_the_controllers_own_target(self) -> None:
        controller = opened(open_mode=7)
        target = np.array(controller.servo.target)
        for k in range(200):
            step(controller, {1: 0.2 * min(1.0, k / 150)})
        np.testing.assert_allclose(controller.servo.target, target + 0.2, atol=1e-7)
        np.testing.assert_allclose(controller.servo.measured, target + 0.2, atol=0.01)

    @pytest.mark.parametrize("mode", [2, 8])
    def test_modes_2_and_8_add_d4_to_the_speed_demanded(self, mode: int) -> None:
        controller = opened(open_mode=mode)
        start = np.array(controller.servo.measured)
        speed = np.array([0.004, -0.004])
        for k in range(600):
            step(controller, {4: speed * min(1.0, k / 100)})
        moved = np.array(controller.servo.measured) - start
        # the position loop pulls back until its demand cancels what is added
        gain = controller.settings.servo.position_gain * controller.period
        np.testing.assert_allclose(moved, speed / gain, rtol=0.1)

    @pytest.mark.parametrize("mode", [1, 2, 9])
    def test_modes_1_2_and_9_add_d5_to_the_target_current(self, mode: int) -> None:
        extra = np.array([0.25, -0.125])
        current = []
        for fields in ({}, {5: extra}):
            controller = opened(open_mode=mode)
            first = receive(controller)
            target = {1: first.axes["d"][:, 0]} if mode == 1 else {}
            controller.accept(answer(first, target | fields))
            current.append(receive(controller).axes["d"][:, 4])
        np.testing.assert_allclose(current[1] - current[0], extra, atol=1e-6)

    @pytest.mark.parametrize("field", [1, 2])
    def test_a_number_that_is_not_finite_trips_the_drive(self, field: int) -> None:
        controller = opened()
        step(controller, {1: controller.servo.target} | {field: np.nan})
        assert receive(controller).status[0] == 0


class TestWithoutAnAnswer:
    def test_continue_extrapolates_then_ramps_down(self) -> None:
        controller = opened(missed_replies=4, while_silent="continue", ramp_time=0.1)
        target = np.array(controller.servo.target)
        for k in range(300):  # motor 1 up to 0.03 revolutions per cycle
            delta = np.array([0.03 * min(1.0, k / 250), 0.0])
            target = target + delta
            step(controller, {1: target, 2: delta})
        targets = []
        reasons = []
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

    def test_the_last_missing_reply_switches_the_drive_off(self) -> None:
        controller = opened(missed_replies=3, while_silent="drive_off")
        for answered in (False, False, True, False, False, False):
            received = receive(controller)
            assert received.status[0] == 5
            controller.accept(answer(received) if answered else None)
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
        step(controller, status=STATUS_EXIT)
        modes = [tuple(step(controller).axes["mode"].tolist()) for _ in range(7)]
        assert modes == [(4, 4)] * 2 + [(0, 4)] * 3 + [(0, 0)] * 2

    def test_an_axis_that_leaves_stays_closed_until_all_open_again(self) -> None:
        controller = opened()
        controller.program.axis_leaves(1)
        for status in (0, 0, 0, STATUS_EXIT):
            assert step(controller, status=status).axes["mode"].tolist() == [4, 0]
        seen = [tuple(step(controller).axes["mode"].tolist()) for _ in range(30)]
        assert seen == sorted(seen[:7], reverse=True) + sorted(seen[7:])
        assert seen[-1] == (4, 4)


FINE = Requests(valid=True)


class TestProgram:
    @staticmethod
    def program(phase: Phase = Phase.START, **changes: Any) -> LoopProgram:
        short = {"drive_off_cycles": 2, "driving_on_cycles": 3, "closed_cycles": 2,
                 "closing_cycles": 2, "opening_stagger": 2}  # fmt: skip
        loop = LoopProgram(3, ControllerSettings(**(short | changes)))
        TestProgram.phases_to(loop, phase)
        return loop

    @staticmethod
    def phases_to(loop: LoopProgram, last: Phase) -> list[Phase]:
        """Advance to a phase; return that of each cycle before."""
        phases: list[Phase] = []
        while loop.phase is not last:
            assert len(phases) < 200, f"{last!r} never came; stuck in {loop.phase!r}"
            phases.append(loop.phase)
            loop.advance(FINE, at_rest=True)
        return phases

    def test_one_axis_opens_alone(self) -> None:
        """The others stay closed, and the PC has the arm as soon as that axis is open."""
        loop = self.program(Phase.OPEN, only_axis=2)
        assert loop.open_axes == [False, True, False]
        assert loop.intervals == 1
        with pytest.raises(SettingError, match="only_axis"):
            self.program(only_axis=4)

    @pytest.mark.parametrize(
        ("lost_by", "reason"),
        [
            (MISSING, "no valid reply in 1 cycle of open mode"),
            (Requests(True, following_error=True), "the PC reported a following error (508)"),
        ],
    )
    def test_the_session_ends_after_some_lost_openings_in_a_row(
        self, lost_by: Requests, reason: str
    ) -> None:
        """Each is followed by a pause."""
        loop = self.program(lost_openings=3, reopening_time=0.05)
        for lost in (1, 2, 3):
            assert not loop.gave_up
            self.phases_to(loop, Phase.OPEN)
            loop.advance(lost_by, at_rest=True)
            assert loop.openings_lost == lost
            if lost < 3:
                assert len(self.phases_to(loop, Phase.OPENING)) == 50
        assert loop.gave_up
        self.phases_to(loop, Phase.ENDED)
        assert loop.reason == f"open mode was lost 3 times in a row: {reason}"

    def test_a_trip_in_open_mode_drops_the_drive_before_the_modes(self) -> None:
        loop = self.program(Phase.OPEN)
        loop.trip("test")
        assert (loop.powered, loop.braked, loop.open_axes) == (False, True, [True] * 3)
        for _ in range(2):
            loop.advance(FINE, at_rest=True)
        assert loop.phase is Phase.DRIVE_OFF
        assert not any(loop.open_axes)

    def test_the_init_packet_of_a_warm_start_has_to_be_answered(self) -> None:
        loop = self.program(cold_start=False)
        loop.advance(MISSING, at_rest=True)
        assert loop.phase is Phase.ENDED
        assert "init" in loop.reason

    def test_phases_last_as_set_and_the_end_waits_for_rest(self) -> None:
        loop = self.program(Phase.DRIVE_OFF)
        closed = [Phase.DRIVE_OFF] * 2 + [Phase.DRIVING_ON] * 3 + [Phase.CLOSED] * 2
        assert self.phases_to(loop, Phase.OPENING) == closed
        assert self.phases_to(loop, Phase.OPEN) == [Phase.OPENING] * 5  # an axis every other cycle
        loop.finish()
        loop.advance(FINE, at_rest=False)
        assert loop.phase is Phase.OPEN
        assert self.phases_to(loop, Phase.ENDED)[-3:] == [Phase.SHUTDOWN] * 2 + [Phase.ENDING]
