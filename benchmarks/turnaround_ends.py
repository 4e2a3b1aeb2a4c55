"""The processes of `benchmarks.turnaround`: a controller, an echo, a reader of the ring, a load."""

from __future__ import annotations

import os
import socket
import struct
import time
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from benchmarks.session import START, N, drive_train, init_packet
from drivers import CyclicPacket, Mode
from drivers.c4g_packets import DRIVE_ON, LAST_NUMBER, next_number
from drivers.cycle_records import RingReader
from drivers.exchange.realtime import RealTimeSettings, enter

Array = NDArray[np.float64]

HOST: Final = "127.0.0.1"
PERIOD_MS: Final = 1
PERIOD: Final = PERIOD_MS / 1000.0
WARM_UP: Final = 300
"""Cycles at the beginning that are not measured."""
_TIMEVAL: Final = struct.Struct("@qq")


@dataclass(frozen=True)
class Settings:
    """What the controller is to do: `blocks` times the floor, then the exchange, alternating."""

    exchange_port: int
    echo_port: int
    cycles: int
    blocks: int
    realtime: RealTimeSettings
    result: str


class Pace:
    """Absolute deadlines, one per cycle; a stall is not made up for."""

    def __init__(self) -> None:
        self.next = time.monotonic()

    def wait(self) -> float:
        """Until the next deadline; returns how late this process woke."""
        self.next += PERIOD
        now = time.monotonic()
        if now < self.next:
            time.sleep(self.next - now)
            now = time.monotonic()
        late = now - self.next
        if late > PERIOD:
            self.next = now
        return late


class Asking:
    """One socket of the controller, and the times of every request and answer."""

    def __init__(self, port: int, cycles: int) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.connect((HOST, port))
        patience = _TIMEVAL.pack(0, int(PERIOD * 1e6))
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, patience)
        self.sent = np.full(cycles, np.nan)
        self.received = np.full(cycles, np.nan)
        self.woke_late = np.full(cycles, np.nan)
        self.asked = 0

    def ask(self, packet: bytes, number: int, answer_ahead: int, late: float) -> bytes | None:
        """Send, and wait for the answer for one cycle; late ones are noted where they belong."""
        index = self.asked
        self.asked += 1
        self.woke_late[index] = late
        self.sent[index] = now = time.monotonic()
        self.socket.send(packet)
        end = now + PERIOD
        while now < end:
            try:
                answer = self.socket.recv(2048)
            except BlockingIOError:
                return None
            now = time.monotonic()
            behind = (number + answer_ahead - int.from_bytes(answer[:4], "little")) % LAST_NUMBER
            if behind <= index:
                self.received[index - behind] = now
            if behind == 0:
                return answer if now < end else None
        return None


class Controller:
    """Packets of an ideal arm in open mode."""

    def __init__(self, settings: Settings) -> None:
        self._blocks = settings.blocks
        self._block = settings.cycles // settings.blocks
        # Ten cycles more: closed, and the last answers.
        self.ours = Asking(settings.exchange_port, settings.cycles + WARM_UP + 10)
        self.floor = Asking(settings.echo_port, settings.cycles + WARM_UP + 10)
        self._number = 10
        self._packet = bytearray()
        self._view = CyclicPacket.zeros(1, N).axes
        self._view["d"][:, 0] = self._view["d"][:, 2] = drive_train().motor_revolutions(START)
        self._view["d"][:, 4] = 1.0

    def start(self) -> None:
        """Restart with the init packet."""
        init = init_packet(PERIOD_MS)
        for _ in range(100):
            self.ours.socket.send(init)
            time.sleep(0.01)
            try:
                self.ours.socket.recv(2048)
                return
            except BlockingIOError:
                continue
        raise RuntimeError("the exchange process does not answer the init packet")

    def _ask_ours(self, late: float, mode: int) -> None:
        self._number = next_number(self._number)
        self._view["mode"] = mode
        header = struct.pack("<iII", self._number, DRIVE_ON, 0)
        reply = self.ours.ask(header + self._view.tobytes(), self._number, 1, late)
        if reply is None or mode == Mode.CLOSED:
            return
        answer = np.frombuffer(reply, self._view.dtype, offset=12)
        if (answer["mode"] != mode).any():
            raise RuntimeError(f"the exchange asks for mode {answer['mode'].tolist()}")
        self._view["d"][:, 0] = self._view["d"][:, 2] = answer["d"][:, 0]
        self._view["d"][:, 1] = self._view["d"][:, 3] = answer["d"][:, 1]

    def run(self) -> None:
        """All blocks."""
        self.start()
        pace = Pace()
        for _ in range(5):
            self._ask_ours(pace.wait(), Mode.CLOSED)
        echo = 0
        for block in range(self._blocks + 1):
            cycles = self._block if block else WARM_UP
            for _ in range(cycles):
                late = pace.wait()
                echo = next_number(echo)
                self.floor.ask(struct.pack("<i", echo) + bytes(224), echo, 0, late)
            for _ in range(cycles):
                self._ask_ours(pace.wait(), Mode.POSITION)
        time.sleep(0.01)
        self.end()

    def end(self) -> None:
        """Mode 504: the session is over."""
        self._view["mode"] = Mode.END_OF_SESSION
        self._number = next_number(self._number)
        header = struct.pack("<iII", self._number, 0, 0)
        self.ours.socket.send(header + self._view.tobytes())


def control(settings: Settings) -> None:
    """The controller's process."""
    controller = Controller(settings)
    report = enter(settings.realtime)
    fault = ""
    try:
        controller.run()
    except RuntimeError as error:
        fault = str(error)
        controller.end()
    ours = controller.ours
    floor = controller.floor
    np.savez(
        settings.result,
        **{
            f"{name}_{field}": getattr(end, field)[: end.asked]
            for name, end in (("ours", ours), ("floor", floor))
            for field in ("sent", "received", "woke_late")
        },
        scheduling=np.array(report.scheduling),
        fault=np.array(fault),
    )


def echo(parent: Connection, realtime: RealTimeSettings) -> None:
    """Send packets back at once: the lower bound of the turnaround."""
    server = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    server.bind((HOST, 0))
    parent.send(server.getsockname()[1])
    enter(realtime)
    receive = server.recvfrom
    send = server.sendto
    while True:
        packet, sender = receive(1501)
        send(packet, sender)


def drain(supervisor: int, ring_fd: int, result: str) -> None:
    """Read every record in an ordinary process, and store the times of arrival."""
    reader = RingReader(os.open(f"/proc/{supervisor}/fd/{ring_fd}", os.O_RDWR), N)
    drained: list[NDArray[np.void]] = []
    done = Path(result).with_suffix(".end")
    while not done.exists() and os.getppid() == supervisor:
        time.sleep(0.02)
        drained.append(reader.drain()[["cycle", "arrival"]])
    drained.append(reader.drain()[["cycle", "arrival"]])
    records = np.concatenate(drained)
    np.savez(
        result,
        cycle=records["cycle"],
        arrival=records["arrival"],
        overflow=np.array(reader.missed),
    )


def spin(supervisor: int) -> None:
    """Keep a processor busy at ordinary priority."""
    while os.getppid() == supervisor:
        sum(range(100_000))
