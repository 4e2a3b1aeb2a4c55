"""A motion source on its way from one process to another.

It is pickled into sealed memory: what it holds in large arrays is not copied when it is read, but
mapped, read-only, where it lies. Its descriptor goes over the socket between supervisor and
exchange, answers come back (`Inbox`).
"""

from __future__ import annotations

import contextlib
import fcntl
import mmap
import os
import pickle
import socket
import struct
from typing import Final

from drivers.errors import RequestError
from drivers.motion_source import MotionSource

SMALLEST_MAPPED: Final = 4096
"""Bytes from which on an array is mapped; a smaller one is copied, and can be written to."""
_ALIGNMENT: Final = 64
_SEALS: Final = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_WRITE | fcntl.F_SEAL_SEAL
_COUNT: Final = struct.Struct("<Q")
_SPAN: Final = struct.Struct("<QQ")


def pack(source: MotionSource) -> int:
    """Descriptor of sealed memory that holds the source; whoever gets it closes it.

    Raises:
        Exception: whatever pickling this source raises.
    """
    arrays: list[memoryview] = []

    def keep(buffer: pickle.PickleBuffer) -> bool:
        raw = buffer.raw()
        if raw.nbytes < SMALLEST_MAPPED:
            return True
        arrays.append(raw)
        return False

    blocks = [memoryview(pickle.dumps(source, protocol=5, buffer_callback=keep)), *arrays]
    at = _COUNT.size + len(blocks) * _SPAN.size
    spans = []
    for block in blocks:
        at += -at % _ALIGNMENT
        spans.append((at, block.nbytes))
        at += block.nbytes
    fd = os.memfd_create("hil-program", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    try:
        os.ftruncate(fd, at)
        header = _COUNT.pack(len(blocks)) + b"".join(_SPAN.pack(*span) for span in spans)
        os.pwrite(fd, header, 0)
        for block, (begin, _) in zip(blocks, spans, strict=True):
            _write(fd, block, begin)
        fcntl.fcntl(fd, fcntl.F_ADD_SEALS, _SEALS)
    except BaseException:
        os.close(fd)
        raise
    return fd


def _write(fd: int, block: memoryview, begin: int) -> None:
    while block.nbytes:
        written = os.pwrite(fd, block, begin)
        block, begin = block[written:], begin + written


def unpack(fd: int) -> MotionSource:
    """The source that lies there.

    Raises:
        ValueError: memory that could still change.
        Exception: whatever unpickling raises.
    """
    if fcntl.fcntl(fd, fcntl.F_GET_SEALS) & _SEALS != _SEALS:
        raise ValueError("the memory of a program is not sealed")
    size = os.fstat(fd).st_size
    # Populated at once: a page fault in some later cycle would delay an answer.
    flags = mmap.MAP_SHARED | mmap.MAP_POPULATE
    whole = memoryview(mmap.mmap(fd, size, flags=flags, prot=mmap.PROT_READ))
    (count,) = _COUNT.unpack_from(whole)
    spans = [_SPAN.unpack_from(whole, _COUNT.size + k * _SPAN.size) for k in range(count)]
    body, *arrays = (whole[begin : begin + length] for begin, length in spans)
    source: MotionSource = pickle.loads(body, buffers=arrays)
    return source


LONGEST_MESSAGE: Final = 1 << 16
WITHDRAWN: Final = "it was withdrawn"
"""Why a program is refused that nobody wants any more."""
READ: Final = "read"
"""Said of a program that can be requested."""
_IDENTITY: Final = struct.Struct("<Q")
_DESCRIPTOR: Final = struct.Struct("@i")


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

    def take(self) -> int | None:
        """Descriptor of the next program, if one has arrived; whoever asks closes it."""
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
        return int(fd)

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
    fd = pack(source)
    try:
        socket.send_fds(channel, [_IDENTITY.pack(identity)], [fd])
    finally:
        os.close(fd)
