"""The socket between supervisor and exchange: programs one way, answers the other."""

from __future__ import annotations

import contextlib
import os
import pickle
import socket
import struct
from dataclasses import dataclass
from typing import Final

from drivers.errors import RequestError
from drivers.exchange import motion_transfer
from drivers.motion_source import MotionSource

LONGEST_MESSAGE: Final = 1 << 16
WITHDRAWN: Final = "it was withdrawn"
"""Why a program is refused that nobody wants any more."""
READ: Final = "read"
"""Said of a program that can be requested."""
_IDENTITY: Final = struct.Struct("<Q")
_DESCRIPTOR: Final = struct.Struct("@i")


@dataclass(frozen=True)
class HandedOver:
    """A program that arrived, still in its sealed memory."""

    identity: int
    fd: int

    def unpacked(self) -> MotionSource:
        """The motion source; the descriptor is closed, the memory stays mapped as needed."""
        try:
            return motion_transfer.unpack(self.fd)
        finally:
            os.close(self.fd)

    def drop(self) -> None:
        """Nobody wants it any more."""
        os.close(self.fd)


class Inbox:
    """The exchange's end; never waits.

    Attributes:
        identity: id of the program received last.
    """

    def __init__(self, channel: socket.socket) -> None:
        self.identity = 0
        self._channel = channel

    def hung_up(self) -> bool:
        """Whether the other end was closed."""
        try:
            return not self._channel.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT)
        except BlockingIOError:
            return False
        except OSError:
            return True

    def take(self) -> HandedOver | None:
        """The next program, if one has arrived."""
        try:
            # Not `socket.recv_fds`, which waits whatever flags it is given.
            message, ancillary, _, _ = self._channel.recvmsg(
                _IDENTITY.size, socket.CMSG_LEN(_DESCRIPTOR.size), socket.MSG_DONTWAIT
            )
        except BlockingIOError:
            return None
        if len(message) != _IDENTITY.size or not ancillary:
            return None
        (fd,) = _DESCRIPTOR.unpack(ancillary[0][2])
        self.identity = _IDENTITY.unpack(message)[0]
        return HandedOver(self.identity, fd)

    def read(self) -> None:
        """Say that the program received last was read."""
        self._say(READ)

    def answer(self, refusal: RequestError | None) -> None:
        """Say what became of the program received last."""
        self._say(None if refusal is None else (refusal.state, refusal.reason))

    def _say(self, message: str | tuple[str, str] | None) -> None:
        # Without a supervisor nobody wants to know.
        with contextlib.suppress(OSError):
            self._channel.send(pickle.dumps((self.identity, message)), socket.MSG_DONTWAIT)


def hand_over(channel: socket.socket, identity: int, source: MotionSource) -> None:
    """Send a program, from the supervisor's end."""
    fd = motion_transfer.pack(source)
    try:
        socket.send_fds(channel, [_IDENTITY.pack(identity)], [fd])
    finally:
        os.close(fd)
