"""How many of something, in words."""

from __future__ import annotations


def counted(number: int, noun: str) -> str:
    """Number and noun: 1 packet, 2 packets; the noun is one that takes an s."""
    return f"{number} {noun}{'' if number == 1 else 's'}"
