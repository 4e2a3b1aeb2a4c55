"""Transfer of a motion source from the supervisor to the exchange process.

It is pickled into sealed memory, whose descriptor is sent over a socket; the exchange maps large
arrays read-only instead of copying them, and answers over the same socket (`Inbox`).
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

MIN_MAPPED_BYTES: Final = 4096
"""Bytes from which on an array is mapped; smaller ones are copied and writeable."""
_ALIGNMENT: Final = 64
_SEALS: Final = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_WRITE | fcntl.F_SEAL_SEAL
_COUNT: Final = struct.Struct("<Q")
_SPAN: Final = struct.Struct("<QQ")


def pack(source: MotionSource) -> int:
    """Return the descriptor of sealed memory with the pickled source; the caller closes it."""
    arrays: list[memoryview] = []

    def copied(buffer: pickle.PickleBuffer) -> bool:
        raw = buffer.raw()
        if raw.nbytes < MIN_MAPPED_BYTES:
            return True
        arrays.append(raw)
        return False

    blocks = [memoryview(pickle.dumps(source, protocol=5, buffer_callback=copied)), *arrays]
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
        block = block[written:]
        begin = begin + written


def unpack(fd: int) -> MotionSource:
    """Return the source in the memory of `pack`; raises ValueError if it is not sealed."""
    if fcntl.fcntl(fd, fcntl.F_GET_SEALS) & _SEALS != _SEALS:
        raise ValueError("the memory of a motion is not sealed")
    size = os.fstat(fd).st_size
    # Populated at once: a page fault in a later cycle would delay a reply.
    flags = mmap.MAP_SHARED | mmap.MAP_POPULATE
    whole = memoryview(mmap.mmap(fd, size, flags=flags, prot=mmap.PROT_READ))
    (count,) = _COUNT.unpack_from(whole)
    spans = [_SPAN.unpack_from(whole, _COUNT.size + k * _SPAN.size) for k in range(count)]
    body, *arrays = (whole[begin : begin + length] for begin, length in spans)
    source: MotionSource = pickle.loads(body, buffers=arrays)
    return source


MAX_MESSAGE_BYTES: Final = 1 << 16
"""Bytes."""
WITHDRAWN: Final = "it was withdrawn"
"""Reason of a refusal at the request of the supervisor."""
READ: Final = "read"
"""Message about a motion that was read and waits for `SharedState.program_id`."""
_IDENTITY: Final = struct.Struct("<Q")
_DESCRIPTOR: Final = struct.Struct("@i")


class Inbox:
    """The exchange's end of the socket; never waits. `identity` belongs to the last motion."""

    def __init__(self, channel: socket.socket) -> None:
        self.identity = 0
        self._channel = channel

    def closed(self) -> bool:
        """Whether the supervisor closed its end."""
        try:
            return not self._channel.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT)
        except BlockingIOError:
            return False
        except OSError:
            return True

    def receive(self) -> int | None:
        """Return the descriptor of the next motion, None without one; the caller closes it."""
        try:
            # Not `socket.recv_fds`, which ignores MSG_DONTWAIT.
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

    def answer(self, message: str | RequestError | None) -> None:
        """Report the motion received last as `READ`, refused, or (None) accepted."""
        content = (message.state, message.reason) if isinstance(message, RequestError) else message
        with contextlib.suppress(OSError):  # without a supervisor there is no recipient
            self._channel.send(pickle.dumps((self.identity, content)), socket.MSG_DONTWAIT)


def hand_over(channel: socket.socket, identity: int, source: MotionSource) -> None:
    """Send a motion from the supervisor's end."""
    fd = pack(source)
    try:
        socket.send_fds(channel, [_IDENTITY.pack(identity)], [fd])
    finally:
        os.close(fd)
