"""The simulated Universal Robots arm: what it reports follows from what it is."""

from __future__ import annotations

import socket
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing, suppress
from typing import ClassVar

import numpy as np
import pinocchio as pin
import pytest

from drivers.ur.connection import RtdeConnection, connected
from drivers.ur.registers import INPUTS
from drivers.ur.rtde import InputsInUseError
from drivers.ur.transport import RtdeSpec
from sim_fixtures.arm import UnmodelledEffects
from sim_fixtures.plant import Carried, build_model
from sim_fixtures.ur import (
    UR5E_URDF,
    SimulatedUr,
    SimulatedUrArm,
    UrArmTruth,
    UrFault,
    UrProgram,
    UrServer,
    UrSettings,
)
from sim_fixtures.ur.controller import UrPayload


def run_of(robot: SimulatedUr, cycles: int) -> dict[str, np.ndarray]:
    """The outputs of some cycles, by name."""
    rows = []
    for _ in range(cycles):
        robot.step()
        rows.append(robot.outputs())
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


@pytest.fixture(scope="module")
def moving() -> dict[str, np.ndarray]:
    """The outputs of a whole program."""
    robot = SimulatedUr(program=UrProgram())
    outputs = run_of(robot, round(UrProgram().duration / robot.period) + 10)
    assert robot.finished
    return outputs


def test_the_program_moves_every_joint_and_ends_at_rest(moving: dict[str, np.ndarray]) -> None:
    assert np.all(np.ptp(moving["actual_q"], axis=0) > 0.5)
    assert np.all(moving["target_qd"][[0, -1]] == 0.0)
    np.testing.assert_allclose(np.diff(moving["timestamp"]), 0.002)
    assert np.abs(moving["target_q"] - moving["actual_q"]).max() < 3e-3


@pytest.mark.parametrize(
    ("lower", "upper"), [("target_q", "target_qd"), ("target_qd", "target_qdd")]
)
def test_targets_are_derivatives_of_one_another(
    moving: dict[str, np.ndarray], lower: str, upper: str
) -> None:
    slope = np.gradient(moving[lower], 0.002, axis=0)[2:-2]
    # Where the motion has faded in, its jerk jumps by that of the fade times the amplitude.
    jump = 60.0 / (0.1 * UrProgram().period) ** 3
    np.testing.assert_allclose(slope, moving[upper][2:-2], atol=0.25 * 0.002 * jump)


def test_at_rest_the_arm_states_its_torque_constants(moving: dict[str, np.ndarray]) -> None:
    """Of the joints that gravity loads; others have no torque there."""
    truth = UrArmTruth()
    moment, current = (moving[name][100] for name in ("target_moment", "target_current"))
    loaded = np.abs(moment) > 1e-3
    assert loaded.tolist() == [False, True, True, True, True, False]
    np.testing.assert_allclose(moment[loaded] / current[loaded], truth.stated_constant[loaded])


def test_currents_are_those_of_the_true_arm(moving: dict[str, np.ndarray]) -> None:
    """Torque, by another model of the dynamics than the plant's own steps, and true friction."""
    truth = UrArmTruth()
    model = build_model(
        UR5E_URDF, (0.0, 0.0, -9.81), truth.plant.rotor_inertia, truth.plant.inertia_scale
    )
    data = model.createData()
    chosen = range(2000, 6000, 50)
    targets = [moving[name] for name in ("target_q", "target_qd", "target_qdd")]
    torque = np.array([pin.rnea(model, data, *(t[k] for t in targets)) for k in chosen])
    torque += truth.plant.friction(targets[1][chosen])
    fast = np.abs(targets[1][chosen]) > 0.1
    measured = truth.torque_constant * moving["actual_current"][chosen]
    error = np.where(fast, measured - torque, 0.0)
    noise = truth.current_noise * truth.torque_constant
    # The arm is not exactly at its targets.
    control = 0.02 * np.abs(torque).max(axis=0)
    assert np.all(np.sqrt((error**2).mean(axis=0)) < np.hypot(noise, control))


def test_the_moment_reported_is_that_of_rigid_bodies(moving: dict[str, np.ndarray]) -> None:
    """Without rotors and friction."""
    model = build_model(UR5E_URDF, (0.0, 0.0, -9.81), np.zeros(6))
    targets = [moving[name][3000] for name in ("target_q", "target_qd", "target_qdd")]
    assert np.abs(targets[2]).max() > 0.1
    expected = pin.rnea(model, model.createData(), *targets)
    np.testing.assert_allclose(moving["target_moment"][3000], expected, atol=1e-9)


def test_the_controller_knows_another_arm_than_it_has(moving: dict[str, np.ndarray]) -> None:
    """Its model current is not the measured one, and its constants are not the true ones."""
    difference = moving["actual_current"] - moving["target_current"]
    assert np.all(np.std(difference, axis=0) > 0.02)
    truth = UrArmTruth()
    assert np.all(np.abs(truth.torque_constant / truth.stated_constant - 1.0) > 0.01)


def test_only_a_payload_that_is_entered_is_in_the_model() -> None:
    def moment(settings: UrSettings | None = None, load: Carried | None = None) -> np.ndarray:
        return run_of(SimulatedUr(settings, load=load), 20)["target_moment"][-1]

    bare = moment()
    entered = moment(UrSettings(payload=UrPayload(3.0, (0.0, 0.0, 0.05))))
    unknown = moment(load=Carried(5, 3.0, np.array([0.0, 0.0, 0.15]), np.zeros((3, 3))))
    assert np.abs(entered - bare)[1] > 10.0
    np.testing.assert_array_equal(unknown, bare)


def test_joints_warm_up_by_moving(moving: dict[str, np.ndarray]) -> None:
    rise = moving["joint_temperatures"][-1] - moving["joint_temperatures"][0]
    assert np.all(rise > 0.0) and np.all(rise < 1.0)


@pytest.mark.parametrize("period", [0.002, 0.008])
@pytest.mark.parametrize("elasticity", [(), (2e-5, 2e-5, 3e-5, 0.0, 0.0, 0.0)])
def test_the_position_loop_is_stable(period: float, elasticity: tuple[float, ...]) -> None:
    """Straight out and folded, with springs in the main axes, at the cycles of both series."""
    amplitude, rate = np.linspace(0.3, 0.5, 6), np.linspace(1.0, 4.0, 6)
    for elbow in (0.0, 2.6):
        start = np.array([0.0, 0.0, elbow, 0.0, 0.0, 0.0])
        effects = UnmodelledEffects(elasticity=elasticity, delay=5e-4 if elasticity else 0.0)
        arm = SimulatedUrArm(UrArmTruth(), start, period, effects=effects)
        for cycle in range(round(1.5 / period)):
            phase = rate * cycle * period
            q = start + amplitude * (1.0 - np.cos(phase))
            qd, qdd = amplitude * rate * np.sin(phase), amplitude * rate**2 * np.cos(phase)
            arm.step(q, qd, qdd)
            assert np.abs(q - arm.plant.position).max() < 0.1


def test_a_slider_slows_the_motion() -> None:
    full, half = (
        run_of(SimulatedUr(UrSettings(slider=share), UrProgram()), 3000) for share in (1.0, 0.5)
    )
    np.testing.assert_allclose(half["target_q"][2001], full["target_q"][1000], atol=1e-9)
    assert set(half["speed_scaling"]) == {0.5}


def test_a_protective_stop_stops_the_arm() -> None:
    outputs = run_of(SimulatedUr(program=UrProgram(), faults=[UrFault("stop", 2500)]), 3000)
    assert outputs["safety_mode"][2499] == 1 and outputs["safety_mode"][2500] == 3
    assert outputs["runtime_state"][-1] == 4
    assert np.abs(outputs["actual_qd"][2800:]).max() < 0.01
    slope = np.gradient(outputs["target_q"], 0.002, axis=0)
    np.testing.assert_allclose(slope[2510:2590], outputs["target_qd"][2510:2590], atol=5e-3)


def test_without_power_nothing_flows() -> None:
    outputs = run_of(SimulatedUr(faults=[UrFault("power-off", 50)]), 100)
    assert outputs["robot_mode"][[49, 50]].tolist() == [7, 3]
    assert not outputs["actual_current"][50:].any()


def test_a_seed_is_a_run() -> None:
    first, second, other = (run_of(SimulatedUr(seed=seed), 50)["actual_q"] for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, second)
    assert (first != other).any()


SERVER = """
from sim_fixtures.ur import SimulatedUr, UrProgram, UrServer
server = UrServer(SimulatedUr(program=UrProgram(), repeats=True), rtde=30004)
print("ready", flush=True)
server.run()
"""


@pytest.fixture
def served() -> Iterator[None]:
    """A controller in another process: ur-rtde does not release the interpreter as it connects."""
    with subprocess.Popen([sys.executable, "-c", SERVER], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        try:
            if process.stdout.readline() != b"ready\n":
                pytest.skip("port 30004, the only one that ur-rtde connects to, is not free")
            yield
        finally:
            process.kill()


def test_another_client_reads_the_same(served: None) -> None:
    """The receiver of ur-rtde (SDU), which asks for every output that it knows."""
    receive = pytest.importorskip("rtde_receive", reason="ur-rtde is not installed (extra `ur`)")
    client = receive.RTDEReceiveInterface("127.0.0.1")
    try:
        deadline = time.monotonic() + 20.0
        stamps = set[float]()
        while len(stamps) < 10 and time.monotonic() < deadline:
            stamps.add(client.getTimestamp())
            time.sleep(0.01)
        assert len(stamps) == 10
        assert client.getRobotMode() == 7
        assert np.all(np.abs(np.array(client.getActualQ()) - UrProgram().centre) < 2.0)
        assert client.getTargetMoment()[1] < -10.0
    finally:
        client.disconnect()


def test_another_client_writes_registers_of_its_own(served: None) -> None:
    """Inputs of ur-rtde are its own until it disconnects; those of our program stay free."""
    io = pytest.importorskip("rtde_io", reason="ur-rtde is not installed (extra `ur`)")
    client = io.RTDEIOInterface("127.0.0.1")
    theirs = ["input_int_register_18"]
    try:
        assert client.setInputIntRegister(18, 4711)
        with closing(connected(RtdeSpec("127.0.0.1"))) as connection:
            ours = RtdeConnection(connection)
            with pytest.raises(InputsInUseError, match="another program writes input_int_regis"):
                ours.claim_inputs(theirs)
            assert ours.claim_inputs(INPUTS) == 1
    finally:
        client.disconnect()
    deadline = time.monotonic() + 10.0
    number = 0
    while not number and time.monotonic() < deadline:
        with closing(connected(RtdeSpec("127.0.0.1"))) as connection, suppress(InputsInUseError):
            number = RtdeConnection(connection).claim_inputs(theirs)
    assert number == 1


CONTROLLED = """
from sim_fixtures.ur import SimulatedUr, UrServer, UrSettings
robot = SimulatedUr(UrSettings(remote_control=True))
server = UrServer(
    robot, rtde=30004, primary=30001, dashboard=29999, realtime=30003, cycle_extension=0.5
)
print("ready", flush=True)
server.run()
"""


@pytest.fixture
def controlled() -> Iterator[None]:
    """A controller in remote control, in another process, at the maker's ports."""
    with subprocess.Popen([sys.executable, "-c", CONTROLLED], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        try:
            if process.stdout.readline() != b"ready\n":
                pytest.skip("the maker's ports, the only ones that ur-rtde connects to, are taken")
            yield
        finally:
            process.kill()


def test_another_client_moves_the_arm_by_a_script_of_its_own(controlled: None) -> None:
    """The control interface of ur-rtde: movej, servoj, and the end of its script."""
    control = pytest.importorskip("rtde_control", reason="ur-rtde is not installed (extra `ur`)")
    receive = pytest.importorskip("rtde_receive", reason="ur-rtde is not installed (extra `ur`)")
    client = control.RTDEControlInterface("127.0.0.1")
    reader = receive.RTDEReceiveInterface("127.0.0.1")
    try:
        assert client.isProgramRunning()
        start = np.array(reader.getActualQ())
        target = start + np.array([0.2, 0.0, -0.1, 0.0, 0.0, 0.3])
        assert client.moveJ(target.tolist(), 0.5, 1.0)
        assert np.abs(np.array(reader.getActualQ()) - target).max() < 5e-3
        for step in range(1, 101):
            q = target + np.array([1e-3 * step, 0.0, 0.0, 0.0, 0.0, 0.0])
            assert client.servoJ(q.tolist(), 0.5, 0.5, 0.002, 0.1, 300)
            time.sleep(0.002)
        time.sleep(0.3)
        assert np.abs(np.array(reader.getActualQ()) - q).max() < 5e-3
        client.servoStop()
        client.stopScript()
    finally:
        client.disconnect()
        reader.disconnect()


class MakersBytes:
    """What UR's RTDE_Python_Client_Library (rtde/rtde.py) sends, byte by byte, and reads.

    It waits a second for a reply, skips other packages meanwhile, and raises where a type in it is
    none that it knows.
    """

    TYPES: ClassVar = {
        "DOUBLE": "d", "VECTOR6D": "6d", "INT32": "i", "UINT32": "I", "VECTOR6INT32": "6i"
    }  # fmt: skip

    def __init__(self, port: int) -> None:
        self._socket = socket.create_connection(("127.0.0.1", port), timeout=1.0)
        self._received = b""

    def ask(self, command: bytes, payload: bytes = b"") -> bytes:
        self.send(command, payload)
        return self.receive(command)

    def send(self, command: bytes, payload: bytes) -> None:
        self._socket.sendall(struct.pack(">HB", 3 + len(payload), command[0]) + payload)

    def receive(self, command: bytes) -> bytes:
        while True:
            while len(self._received) >= 3:
                size, kind = struct.unpack_from(">HB", self._received)
                if len(self._received) < size:
                    break
                package, self._received = self._received[3:size], self._received[size:]
                if kind == command[0]:
                    return package
            self._received += self._socket.recv(4096)

    def close(self) -> None:
        self._socket.close()


def test_the_bytes_of_the_makers_client_are_answered() -> None:
    """Its order: V, v, O, I, S, U, P; names without a comma at the end."""
    robot = SimulatedUr(program=UrProgram(), repeats=True)
    with UrServer(robot).running() as server:
        client = MakersBytes(server.ports["rtde"])
        assert client.ask(b"V", b"\x00\x02") == b"\x01"
        assert struct.unpack(">4I", client.ask(b"v")) == (5, 15, 2, 0)
        names = b"timestamp,actual_q,robot_mode,joint_mode"
        reply = client.ask(b"O", struct.pack(">d", 500) + names)
        assert reply[1:] == b"DOUBLE,VECTOR6D,INT32,VECTOR6INT32"
        inputs = client.ask(b"I", b"input_int_register_30,input_double_register_40")
        assert inputs[0] > 0 and inputs[1:] == b"INT32,DOUBLE"
        assert client.ask(b"S") == b"\x01"
        layout = ">B" + "".join(MakersBytes.TYPES[name] for name in reply[1:].decode().split(","))
        first, second = (struct.unpack(layout, client.receive(b"U")) for _ in range(2))
        assert first[0] == reply[0]
        assert second[1] - first[1] == pytest.approx(0.002)
        assert first[8] == 7 and first[9:] == (253,) * 6
        client.send(b"U", inputs[:1] + struct.pack(">id", 5, 2.5))
        until = time.monotonic() + 10.0
        while robot.inputs.ints.get(30) != 5 and time.monotonic() < until:
            time.sleep(0.01)
        assert (robot.inputs.ints[30], robot.inputs.floats[40]) == (5, 2.5)
        assert client.ask(b"P") == b"\x01"

        other = MakersBytes(server.ports["rtde"])
        other.ask(b"V", b"\x00\x02")
        assert other.ask(b"I", b"input_int_register_30")[1:] == b"IN_USE"
        assert b"NOT_FOUND" in other.ask(b"O", struct.pack(">d", 500) + b"no_such_output")
        other.close()
        client.close()


def test_the_makers_client_reads_the_same(served: None) -> None:
    """That of Universal Robots, in Python, which is not in the package index."""
    rtde = pytest.importorskip("rtde.rtde", reason="UR's RTDE_Python_Client_Library is not there")
    client = rtde.RTDE("127.0.0.1", 30004)
    client.connect()
    try:
        assert client.get_controller_version() == (5, 15, 2, 0)
        names = ["timestamp", "actual_q", "robot_mode", "joint_mode"]
        types = ["DOUBLE", "VECTOR6D", "INT32", "VECTOR6INT32"]
        assert client.send_output_setup(names, types, frequency=500)
        assert client.send_start()
        state = client.receive()
        assert state.robot_mode == 7 and state.joint_mode == [253] * 6
        assert np.all(np.abs(np.array(state.actual_q) - UrProgram().centre) < 2.0)
        # Every cycle while it keeps up; `receive` itself keeps the newest alone.
        stamps = [state.timestamp]
        until = time.monotonic() + 20.0
        while len(stamps) < 200 and time.monotonic() < until:
            state = client.receive_buffered()
            if state is not None:
                stamps.append(state.timestamp)
        assert np.diff(stamps[1:]) == pytest.approx(0.002, abs=1e-6)
        assert client.send_pause()
    finally:
        client.disconnect()


def test_the_makers_client_claims_and_writes_registers() -> None:
    rtde = pytest.importorskip("rtde.rtde", reason="UR's RTDE_Python_Client_Library is not there")
    robot = SimulatedUr(program=UrProgram(), repeats=True)
    names, types = ["input_int_register_30", "input_double_register_30"], ["INT32", "DOUBLE"]
    with UrServer(robot).running() as server:
        client, other = (rtde.RTDE("127.0.0.1", server.ports["rtde"]) for _ in range(2))
        try:
            for each in (client, other):
                each.connect()
                assert each.send_output_setup(["timestamp"], ["DOUBLE"], frequency=500)
                assert each.send_start()
            written = client.send_input_setup(names, types)
            with pytest.raises(ValueError, match="already in use"):
                other.send_input_setup(names, types)
            written.input_int_register_30, written.input_double_register_30 = 7, 0.25
            assert client.send(written)
            until = time.monotonic() + 10.0
            while robot.inputs.ints.get(30) != 7 and time.monotonic() < until:
                time.sleep(0.01)
            assert (robot.inputs.ints[30], robot.inputs.floats[30]) == (7, 0.25)
        finally:
            client.disconnect()
            other.disconnect()
