"""Untrusted whole numbers, in an archive or on a command line."""

from __future__ import annotations

from typing import Final

LAST_PORT: Final = 65535
_MOST_DIGITS: Final = 18
"""So that 64 bits hold it, and Python reads it at all."""


def whole_number(text: str | None) -> int | None:
    """A number of 0 or more; None where the text is none, or longer than anything is counted."""
    if text is None or not (text.isascii() and text.isdecimal()) or len(text) > _MOST_DIGITS:
        return None
    return int(text)


def port_number(text: str) -> int | None:
    """The number of a UDP or TCP port, 1 to 65535; None where the text is none."""
    port = whole_number(text)
    return port if port is not None and 0 < port <= LAST_PORT else None
