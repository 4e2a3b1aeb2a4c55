"""A motion source on its way from one process to another.

It is pickled into sealed memory: what it holds in large arrays is not copied when it is read, but
mapped, read-only, where it lies.
"""

from __future__ import annotations

import fcntl
import mmap
import os
import pickle
import struct
from typing import Final

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
