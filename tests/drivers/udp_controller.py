"""A controller on a UDP socket, as small as it can be, and what a test asks of its record."""

from __future__ import annotations

import select
import socket
import time

import numpy as np

from drivers import CyclicPacket, Mode
from drivers.packets import DRIVE_ON, next_number
from tests.drivers.rig import START, N, drive_train, init_packet

HOST = "127.0.0.1"


class UdpController:
    """Asks, waits for the answer, follows it. Its cycles last as long as the answers take, or
    longer where `cycle_time` says so.

    Axes open when `open` is set; an answer that asks for the end of open mode closes them, one
    that asks for drive-off switches the drive off.
    """

    def __init__(self, port: int, beat=lambda: None):
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.connect((HOST, port))
        self.socket.settimeout(0.5)
        self.beat = beat
        self.train = drive_train()
        self.init = init_packet()
        self.number = 10
        self.open = False
        self.drive = True
        self.axes = CyclicPacket.zeros(1, N).axes
        self.axes["d"][:, 0] = self.axes["d"][:, 2] = self.train.motor_revolutions(START)
        self.targets: list[np.ndarray] = []
        self.exits = 0
        self.drive_offs = 0
        self.unanswered = 0
        self.cycle_time = 0.0

    def close(self) -> None:
        self.socket.close()

    def start(self) -> None:
        """The init packet, and one closed cycle."""
        end = time.monotonic() + 30.0
        self.number = 10
        while True:
            try:
                self.socket.send(self.init.encode())
                assert len(self.socket.recv(2048)) == 1200
                break
            except (TimeoutError, ConnectionError):
                assert time.monotonic() < end, "the exchange does not answer"
        while not self.quiet(0.0):
            self.socket.recv(2048)  # to an init packet that was sent again
        self.cycle()

    def cycle(self, count: int = 1) -> None:
        for _ in range(count):
            begin = time.monotonic()
            try:
                self.post()
                self.receive()
            except (TimeoutError, ConnectionError):
                self.unanswered += 1
            if self.cycle_time:
                time.sleep(max(0.0, begin + self.cycle_time - time.monotonic()))

    def post(self) -> None:
        """Begin the next cycle."""
        self.beat()
        self.number = next_number(self.number)
        self.axes["mode"] = Mode.POSITION if self.open else Mode.CLOSED
        status = bytes([DRIVE_ON * self.drive, 0, 0, 0])
        self.socket.send(CyclicPacket(self.number, status, bytes(4), self.axes).encode())

    def receive(self) -> None:
        """Wait for the answer to the cycle begun last, and follow it."""
        expected = next_number(self.number)
        reply = self.socket.recv(2048)
        while self.unanswered and CyclicPacket.decode(reply, N).number < expected:
            reply = self.socket.recv(2048)  # that one came after it had been given up
        assert CyclicPacket.decode(reply, N).number == expected
        self._obey(reply)

    def take_what_came(self) -> None:
        """Follow the answers that are there, to whichever cycle they are."""
        while not self.quiet(0.0):
            self._obey(self.socket.recv(2048))

    def quiet(self, seconds: float) -> bool:
        """Whether no answer comes within that time."""
        return not select.select([self.socket], [], [], seconds)[0]

    def _obey(self, reply: bytes) -> None:
        answer = CyclicPacket.decode(reply, N)
        if (answer.axes["mode"] == Mode.DRIVE_OFF_REQUEST).any():
            self.drive_offs += 1
            self.drive = self.open = False
            return
        if not self.open:
            return
        told = answer.axes["d"]
        self.axes["d"][:, 0] = self.axes["d"][:, 2] = told[:, 0]
        self.axes["d"][:, 1] = self.axes["d"][:, 3] = told[:, 1]
        self.targets.append(told[:, 0].astype(float))
        if answer.status[0] == 1:
            self.exits += 1
            self.open = False

    def until(self, condition, seconds: float = 30.0) -> None:
        """Cycle until something is so."""
        end = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < end, "it did not come to that"
            self.cycle()

    @property
    def path(self) -> np.ndarray:
        """Joint positions (m, n) the arm was told to go to."""
        return self.train.joint_position(np.array(self.targets))

    @property
    def moved(self) -> float:
        """Way of joint 1 so far, rad."""
        return abs(float(self.path[-1, 0] - self.path[0, 0])) if self.targets else 0.0

    def assert_stopped_on_its_path(self, period: float) -> None:
        """The arm came to rest without a jerk, then open mode was left as it should be."""
        path = self.path
        assert (self.exits, self.drive_offs) == (1, 0), f"{self.unanswered} cycles unanswered"
        speed = np.abs(np.diff(path[:, 0])) / period
        assert speed.max() > 0.25, "it was moving"
        assert speed[-1] < 1e-3, "it is at rest"
        # The wire rounds motor revolutions to float32; differences blow that up.
        motor = np.abs(np.array(self.targets)[:, 0]).max()
        step = float(np.spacing(np.float32(motor))) * 2 * np.pi / abs(self.train.gear_ratio[0])
        for order, bound in ((2, 2.0 * 8.0), (3, 3.0 * 100.0)):
            rate = np.abs(np.diff(path[:, 0], order)) / period**order
            assert rate.max() < bound + 2 ** (order - 1) * step / period**order
        np.testing.assert_allclose(
            path[:, 1:], np.broadcast_to(START[1:], path[:, 1:].shape), atol=1e-5
        )
