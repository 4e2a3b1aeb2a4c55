"""Ports of a simulated Universal Robots controller: RTDE, primary interface and dashboard.

One thread serves all of them and runs the controller, in real time or as fast as its clients read.
"""

from __future__ import annotations

import os
import selectors
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import Final, Self

from sim_fixtures.settings import SimulationError
from sim_fixtures.ur import wire
from sim_fixtures.ur.controller import SimulatedUr, UrSettings

RTDE_PORT: Final = 30004
PRIMARY_PORT: Final = 30001
REALTIME_PORT: Final = 30003
_MAX_UNREAD_BYTES: Final = 1 << 19
"""Bytes that wait for a client in real time; further frames are skipped, as on a controller."""
_MAX_AHEAD_BYTES: Final = 1 << 16
"""Bytes by which the controller runs ahead of its clients in virtual time."""
_IDLE_WAIT: Final = 0.01  # s between two looks at `close` in virtual time
_CLOCK_POLL_PERIOD: Final = 5e-4  # s between two looks at the clock while a set-point is waited for
_STATE_PERIOD: Final = 0.1  # s between two states of the primary interface
_DEAD_CLIENT_TIMEOUT: Final = 10.0  # s after which a client that does not read is disconnected
_CHECKSUMS: Final = (0x1F2E3D4C, 0x5B6A7988, 0x97A6B5C4, 0xD3E2F100, 0x0F1E2D3C, 0x4B5A6978)
_DH: Final = (
    (0.0, -0.425, -0.3922, 0.0, 0.0, 0.0),
    (0.1625, 0.0, 0.0, 0.1333, 0.0997, 0.0996),
    (1.5707963267948966, 0.0, 0.0, 1.5707963267948966, -1.5707963267948966, 0.0),
    (0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
)
_TURN: Final = 6.283185307179586
_LIMITS: Final = tuple((-_TURN * share, _TURN * share) for share in (1, 1, 0.5, 1, 1, 1))
_RATES: Final = ((3.141592653589793, 40.0),) * 6


@dataclass(eq=False)
class _Client:
    """A connection: what it has sent, what waits for it, and how it is served."""

    socket: socket.socket
    serve: Callable[[_Client], None]
    received: bytearray = field(default_factory=bytearray)
    waiting: bytearray = field(default_factory=bytearray)
    data: wire.DataPackages | None = None
    every: int = 1  # cycles between two frames
    started: bool = False
    version: int = 1
    unread_since: float | None = None
    held_until: int = -1  # cycle before which nothing is sent
    greeted: bool = False
    written_in: int = -1  # cycle in which it wrote inputs last
    inputs: list[wire.InputRecipe] = field(default_factory=list)
    program: bytearray = field(default_factory=bytearray)
    closing: bool = False


class UrServer:
    """Serves a controller to any number of clients; `close` ends it.

    Args:
        controller: the controller, which is stepped here.
        host: address to listen at.
        rtde, primary, dashboard, realtime: ports; 0 for a free one, or None. The last
            one takes programs alone.
        cycle_extension: longest time by which a cycle is extended to wait for the set-point of a
            client, while a program takes set-points [s]: the computers of tests are busy.
        real_time: cycles last their period; otherwise as long as the clients read, and none pass
            without a client.

    Attributes:
        ports: of the three interfaces, by name.
        skipped: frames that were not sent to slow clients.
        late: cycles that began late by a period or more.
        most_clients: largest number of clients that received outputs.

    Raises:
        SimulationError: a port cannot be opened.
    """

    def __init__(
        self,
        controller: SimulatedUr,
        host: str = "127.0.0.1",
        *,
        rtde: int = 0,
        primary: int | None = 0,
        dashboard: int | None = 0,
        realtime: int | None = None,
        real_time: bool = True,
        cycle_extension: float = 0.0,
    ) -> None:
        self.controller = controller
        self._extension = cycle_extension
        self.ports: dict[str, int] = {}
        self.skipped = 0
        self.late = 0
        self.most_clients = 0
        self._real_time = real_time
        # epoll rounds its timeout up to a millisecond, half a cycle.
        self._selector = selectors.SelectSelector()
        self._clients: list[_Client] = []
        self._over = threading.Event()
        self._due = time.monotonic()
        self._next_state = 0.0
        services = (
            ("rtde", rtde, self._serve_rtde),
            ("primary", primary, self._serve_primary),
            ("dashboard", dashboard, self._serve_dashboard),
            ("real-time", realtime, self._serve_program),
        )
        for name, port, serve in services:
            if port is not None:
                self._listen(name, host, port, serve)

    def _listen(self, name: str, host: str, port: int, serve: Callable[[_Client], None]) -> None:
        try:
            listener = socket.create_server((host, port))
        except OSError as error:
            self.close()
            # `strerror` of `create_server` repeats the address.
            reason = os.strerror(error.errno or 0)
            raise SimulationError(f"{host}:{port} ({name}): {reason}") from error
        listener.setblocking(False)
        self.ports[name] = listener.getsockname()[1]
        self._selector.register(listener, selectors.EVENT_READ, serve)

    def run(self, until: Callable[[], bool] = lambda: False) -> None:
        """Serve until `close`, or until a condition that is checked every cycle."""
        self._due = time.monotonic()
        while not self._over.is_set() and not until():
            self._exchange()
            if self._cycle_is_due():
                self.controller.step()
                self._send_cycle()
                self.most_clients = max(self.most_clients, self.clients)

    @contextmanager
    def running(self) -> Iterator[Self]:
        """Serve in a thread of this process."""
        thread = threading.Thread(target=self.run, name="simulated UR", daemon=True)
        thread.start()
        try:
            yield self
        finally:
            self._over.set()
            thread.join()
            self.close()

    def close(self) -> None:
        """Close all ports and connections; may be called again."""
        self._over.set()
        for client in [*self._clients]:
            self._drop(client)
        for key in [*(self._selector.get_map() or {}).values()]:
            self._selector.unregister(key.fileobj)
            if isinstance(key.fileobj, socket.socket):
                key.fileobj.close()
        self._selector.close()

    @property
    def clients(self) -> int:
        """Number of clients that receive outputs."""
        return sum(client.started for client in self._clients)

    @property
    def _are_ready(self) -> bool:
        """Whether there are clients, and all of them have read what was sent."""
        receiving = [client for client in self._clients if client.started]
        return bool(receiving) and all(
            len(client.waiting) < _MAX_AHEAD_BYTES or self._holds(client) for client in receiving
        )

    def _holds(self, client: _Client) -> bool:
        return self.controller.cycle < client.held_until

    def _cycle_is_due(self) -> bool:
        if not self._real_time:
            return self._are_ready
        now = time.monotonic()
        if now < self._due:
            return False
        if now < self._due + self._extension and self._waits:
            return False
        self.late += now - self._due >= self.controller.period
        # After a delay of this program cycles are shifted; they are not sent in a burst.
        due = self._due + self.controller.period
        self._due = due if now < due else now + self.controller.period
        return True

    @property
    def _waits(self) -> bool:
        """Whether a program takes set-points and this cycle's has not come."""
        controller = self.controller
        return controller.takes_set_points and any(
            client.inputs and client.started and client.written_in < controller.cycle
            for client in self._clients
        )

    def _exchange(self) -> None:
        """Accept, read and write what is possible until the next cycle."""
        wait = 0.0 if self._are_ready else _IDLE_WAIT
        if self._real_time:
            wait = max(0.0, self._due - time.monotonic())
            wait = max(wait, _CLOCK_POLL_PERIOD) if self._waits else wait
        for client in self._clients:
            writes = bool(client.waiting) and not self._holds(client)
            events = selectors.EVENT_READ | (selectors.EVENT_WRITE if writes else 0)
            self._selector.modify(client.socket, events, client)
        for key, events in self._selector.select(wait):
            if isinstance(key.data, _Client):
                self._serve(key.data, events)
            elif isinstance(key.fileobj, socket.socket):
                self._accept(key.fileobj, key.data)

    def _accept(self, listener: socket.socket, serve: Callable[[_Client], None]) -> None:
        connection, _ = listener.accept()
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        client = _Client(connection, serve)
        self._clients.append(client)
        self._selector.register(connection, selectors.EVENT_READ, client)
        serve(client)

    def _serve(self, client: _Client, events: int) -> None:
        try:
            if events & selectors.EVENT_READ:
                data = client.socket.recv(1 << 16)
                if not data:
                    self._drop(client)
                    return
                client.received += data
                client.serve(client)
            if events & selectors.EVENT_WRITE:
                self._write(client)
        except OSError:
            self._drop(client)

    def _write(self, client: _Client) -> None:
        """Send what waits; a connection that broke is dropped."""
        try:
            sent = client.socket.send(client.waiting)
            del client.waiting[:sent]
            client.unread_since = None
        except BlockingIOError:
            return
        except OSError:
            self._drop(client)
        if client.closing and not client.waiting:
            self._drop(client)

    def _drop(self, client: _Client) -> None:
        if client in self._clients:
            self._clients.remove(client)
            with suppress(KeyError, ValueError):
                self._selector.unregister(client.socket)
            client.socket.close()

    def _serve_rtde(self, client: _Client) -> None:
        for kind, payload in wire.packages(client.received):
            client.waiting += self._rtde_reply(client, kind, payload)

    def _rtde_reply(self, client: _Client, kind: str, payload: bytes) -> bytes:
        match kind:
            case "V":
                wanted = int.from_bytes(payload, "big")
                client.version = wanted if wanted in (1, 2) else client.version
                return wire.package("V", bytes([wanted in (1, 2)]))
            case "v":
                return wire.package("v", struct.pack(">4I", *self.controller.settings.version))
            case "O":
                return self._set_up(client, payload)
            case "I":
                return self._claim(client, payload)
            case "U":
                for recipe in client.inputs:
                    if payload[:1] == bytes([recipe.number]):
                        self.controller.write_inputs(recipe.values(payload))
                        client.written_in = self.controller.cycle
                return b""
            case "S":
                client.started = client.data is not None
                return wire.package("S", bytes([client.started]))
            case "P":
                client.started = False
                return wire.package("P", b"\1")
        return b""

    def _set_up(self, client: _Client, payload: bytes) -> bytes:
        (frequency,) = struct.unpack_from(">d", payload)
        names = [name for name in payload[8:].decode("ascii", "replace").split(",") if name]
        absent = self.controller.settings.without
        types = [
            "NOT_FOUND" if name in absent else wire.TYPES.get(name, "NOT_FOUND") for name in names
        ]
        highest = self.controller.settings.frequency
        client.every = max(1, round(highest / min(max(frequency, 1.0), highest)))
        client.data = None
        if "NOT_FOUND" not in types:
            client.data = wire.DataPackages(1, names)
        return wire.package("O", bytes([client.data is not None]) + ",".join(types).encode())

    def _claim(self, client: _Client, payload: bytes) -> bytes:
        """Let a client write inputs that no other client writes."""
        names = [name for name in payload.decode("ascii", "replace").split(",") if name]
        others = {
            name
            for other in self._clients
            if other is not client
            for recipe in other.inputs
            for name in recipe.names
        }
        others |= {*self.controller.settings.inputs_in_use}
        types = [
            "IN_USE" if name in others else wire.INPUT_TYPES.get(name, "NOT_FOUND")
            for name in names
        ]
        number = 0
        if not {"IN_USE", "NOT_FOUND"} & {*types}:
            number = len(client.inputs) + 1
            client.inputs.append(wire.InputRecipe(number, tuple(names)))
        return wire.package("I", bytes([number]) + ",".join(types).encode())

    def _serve_program(self, client: _Client) -> None:
        client.program += client.received
        client.received.clear()
        if client.program[-5:] == b"\nend\n":
            program = bytes(client.program)
            client.program.clear()
            self.controller.upload(program.decode("utf-8", "replace"))

    def _serve_primary(self, client: _Client) -> None:
        self._serve_program(client)
        if not client.greeted:
            client.greeted = True
            client.waiting += wire.message_package("URControl") + state_of(self.controller.settings)

    def _serve_dashboard(self, client: _Client) -> None:
        if not client.greeted:
            client.greeted = True
            client.waiting += b"Connected: Universal Robots Dashboard Server\n"
        while b"\n" in client.received:
            line, _, rest = bytes(client.received).partition(b"\n")
            client.received[:] = rest
            client.waiting += dashboard_reply(
                self.controller, line.decode("utf-8", "replace")
            ).encode()
            client.waiting += b"\n"

    def _send_cycle(self) -> None:
        controller = self.controller
        cycle = controller.cycle
        outputs = None
        said, controller.said = controller.said, []
        for client in [*self._clients]:
            if client.serve == self._serve_primary:
                for error in said:
                    client.waiting += wire.error_package(*error)
                if controller.time >= self._next_state:
                    client.waiting += state_of(self.controller.settings)
                if client.waiting:
                    self._write(client)
            if not client.started or client.data is None or cycle % client.every:
                continue
            outputs = outputs or controller.outputs()
            self._send_outputs(client, client.data.package(outputs))
        if controller.time >= self._next_state:
            self._next_state = controller.time + _STATE_PERIOD

    def _send_outputs(self, client: _Client, frame: bytes) -> None:
        """Send a frame as the faults of this cycle have it."""
        cycle = self.controller.cycle
        for fault in self.controller.faults:
            begun = fault.cycle <= cycle
            within = begun and cycle < fault.cycle + fault.count
            if (within and fault.kind == "gap") or (begun and fault.kind == "silence"):
                return
            if within and fault.kind == "batch":
                client.held_until = fault.cycle + fault.count
            elif cycle == fault.cycle and fault.kind == "text":
                client.waiting += wire.text_package("a line of text in between")
            elif cycle == fault.cycle and fault.kind in ("disconnect", "truncate"):
                client.waiting += frame[: len(frame) // 2] if fault.kind == "truncate" else b""
                client.closing = True
                client.started = False
                self._write(client)
                return
        self._append(client, frame)

    def _append(self, client: _Client, frame: bytes) -> None:
        now = time.monotonic()
        if len(client.waiting) > _MAX_UNREAD_BYTES:
            self.skipped += 1
            client.unread_since = client.unread_since or now
            if now - client.unread_since > _DEAD_CLIENT_TIMEOUT:
                self._drop(client)
            return
        client.waiting += frame
        if not self._holds(client):
            self._write(client)


def state_of(settings: UrSettings) -> bytes:
    """Return a robot state of the primary interface."""
    return wire.state_package(settings.kind, _LIMITS, _RATES, _DH, _CHECKSUMS)


def dashboard_reply(controller: SimulatedUr, request: str) -> str:
    """Return the reply of the dashboard server to a line."""
    settings = controller.settings
    version = ".".join(map(str, settings.version[:3]))
    replies = {
        "PolyscopeVersion": f"URSoftware {version}.0 (simulated)",
        "get serial number": settings.serial_number,
        "get robot model": settings.model,
        "is in remote control": "true" if settings.remote_control else "false",
        "robotmode": f"Robotmode: {controller.robot_mode_name}",
        "safetystatus": f"Safetystatus: {controller.safety_name}",
        "running": f"Program running: {str(controller.playing).lower()}",
        "programState": f"{'PLAYING' if controller.playing else 'STOPPED'} program",
        "quit": "Disconnected",
    }
    return replies.get(request.strip(), f"could not understand: '{request.strip()}'")
