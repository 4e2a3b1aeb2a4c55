"""Memory of a process that supervises an arm for hours."""

from __future__ import annotations

import ctypes
from contextlib import suppress
from typing import Final

_M_MMAP_THRESHOLD: Final = -3
LARGE: Final = 128 * 1024
"""Bytes; glibc's own value, before it adapts."""


def return_large_arrays() -> None:
    """Have arrays of `LARGE` bytes and more returned to the system when they are freed.

    glibc takes larger and larger ones from its heap, once such have been freed. They come to lie
    between small ones that stay, and over hours the heap grows around the holes.
    """
    with suppress(OSError, AttributeError, TypeError):  # another C library
        ctypes.CDLL(None).mallopt(_M_MMAP_THRESHOLD, LARGE)
