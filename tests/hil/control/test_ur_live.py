"""A UR5e on its ports, moved by exchange and archive process; the simulated one waits for both."""

from __future__ import annotations

import os
import signal
import socket
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from drivers.transports.base import TransportError
from drivers.ur.description import UrDescription
from drivers.ur.registers import INPUTS
from drivers.ur.transport import RtdeSpec
from hil.archive import open_archive
from hil.base.errors import ControllerError
from hil.cell import Cell
from hil.control.live_link import LiveLink
from hil.control.motion_watch import Stop
from hil.control.move import plan_move, send
from hil.control.ur_simulation import served_arm
from hil.doctor.checks import System, link_checks
from hil.doctor.findings import CheckStatus, RtdeReply
from sim_fixtures.ur import CELL_PATH, UrServer

pytestmark = pytest.mark.safety

WAIT = 1.0
SILENT = 10
"""Cycles in 20 ms."""


@pytest.fixture
def served(unused_ports: list[int]) -> Iterator[tuple[Cell, UrServer]]:
    rtde, primary, dashboard = unused_ports
    cell = Cell.load(CELL_PATH).with_values(
        {
            "controller.rtde.port": rtde,
            "controller.rtde.primary_port": primary,
            "controller.rtde.dashboard_port": dashboard,
        }
    )
    server = served_arm(cell, cycle_extension=WAIT)
    stages: list[int] = []
    step = server.controller.step

    def steps() -> None:
        step()
        stages.append(server.controller.output_registers.ints.get(25, 0))

    server.controller.step = steps  # type: ignore[method-assign]
    server.stages = stages  # type: ignore[attr-defined]
    with server.running():
        yield cell, server


@pytest.fixture
def unused_ports() -> list[int]:
    sockets = [socket.create_server(("127.0.0.1", 0)) for _ in range(3)]
    ports = [each.getsockname()[1] for each in sockets]
    for each in sockets:
        each.close()
    return ports


def spec_of(cell: Cell) -> RtdeSpec:
    spec = cell.transport_spec()
    assert isinstance(spec, RtdeSpec)
    return spec


def test_the_first_packet_says_who_the_arm_is(served) -> None:
    cell, _ = served
    transport = spec_of(cell).open()
    try:
        packet = transport.receive(5.0)
        assert packet is not None
        description = UrDescription.decode(packet)
        assert description.identity.serial_number == "20235500123"
        assert description.version.major == 5
        assert UrDescription.decode(description.encode()).recipe == description.recipe
        assert transport.receive(5.0)[2:3] == b"U"
    finally:
        transport.close()


def test_registers_of_another_program_are_not_taken(served) -> None:
    cell, server = served
    first = spec_of(cell).open()
    with pytest.raises(TransportError, match="another program writes input_int_register_24"):
        spec_of(cell).open()
    first.close()
    server.controller.settings = type(server.controller.settings)(
        remote_control=True, inputs_in_use=INPUTS[2:3]
    )
    deadline = time.monotonic() + 10.0
    refused = ""
    while "double" not in refused and time.monotonic() < deadline:
        with pytest.raises(TransportError) as caught:
            spec_of(cell).open()
        refused = str(caught.value)
    assert "another program writes input_double_register_24" in refused


def test_the_doctor_asks_the_controller_for_its_version(served) -> None:
    cell, _ = served
    (check,) = link_checks(cell.link_spec, System())
    assert isinstance(check.found, RtdeReply) and check.status is CheckStatus.OK
    assert check.found.version == "5.15.2.0"
    wrong = cell.with_values({"controller.rtde.port": cell.controller.rtde.dashboard_port})
    (check,) = link_checks(wrong.link_spec, System())
    assert check.status is CheckStatus.BAD


def test_a_motion_over_the_ports_is_archived_cycle_by_cycle(served, tmp_path: Path) -> None:
    cell, server = served
    with LiveLink.open(cell) as link:
        start = link.connect(Stop())
        target = start + np.radians([8.0, 0, 0, 0, 0, -5.0])
        ended = send(
            plan_move(cell, start, target, speed=0.2), cell, link, tmp_path / "a.mcap",
            stop=Stop(), durable=False,
        )  # fmt: skip
    assert ended.outcome == "completed", ended
    archive = open_archive(tmp_path / "a.mcap", fields=("commanded_position", "cycle"))
    assert "ur_arm.json" in archive.attachments
    commanded = archive.recorded("commanded_position")["commanded_position"]
    sent = commanded[np.isfinite(commanded).all(axis=1)]
    assert sent[-1] == pytest.approx(target, abs=1e-9)
    assert not server.controller.playing


def test_a_killed_exchange_ends_in_the_stop_of_the_program(served, tmp_path: Path) -> None:
    cell, server = served
    robot = server.controller
    link = LiveLink.open(cell)
    killed_at: list[int] = []
    try:
        start = link.connect(Stop())
        target = start + np.radians([60.0, 0, 0, 0, 0, 0])
        moving = plan_move(cell, start, target, speed=0.3)
        step = robot.step

        def steps() -> None:
            step()
            if not killed_at and np.abs(robot._target[1]).max() > 0.3:
                os.kill(link.port.exchange.pid, signal.SIGKILL)
                killed_at.append(robot.cycle)

        robot.step = steps  # type: ignore[method-assign]
        with pytest.raises(ControllerError, match="the exchange process ended"):
            send(moving, cell, link, tmp_path / "a.mcap", stop=Stop(), durable=False)
    finally:
        link.port.abort(RuntimeError("over"))
    assert killed_at
    until = time.monotonic() + 10.0
    while robot.playing and time.monotonic() < until:
        time.sleep(0.05)
    stages = server.stages
    assert not robot.playing and not np.any(robot._target[1])
    stopping = stages[killed_at[0] : killed_at[0] + SILENT + 2]
    assert 3 in stopping or 4 in stopping, stopping
