"""One thing looked at, and what follows from it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Status(StrEnum):
    """How a check came out."""

    OK = "ok"
    WARN = "warn"
    """Works, but costs latency or leans on luck."""
    BAD = "bad"
    """The link will not work, or will not be answered in time."""
    UNKNOWN = "unknown"
    """Could not be found out from here; the remedy says how to."""


@dataclass(frozen=True)
class Check:
    """The outcome of one check.

    Attributes:
        name: what was looked at.
        status: how it came out.
        found: what was found, in words.
        why: what it matters for.
        remedy: commands to type, one a line, each to be typed as it stands; empty if none.
    """

    name: str
    status: Status
    found: str
    why: str
    remedy: tuple[str, ...] = ()
