"""Moments that an archive names: text of whoever wrote it."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Final

_FIRST: Final = datetime(1970, 1, 1, tzinfo=UTC)
_LAST: Final = datetime(2200, 1, 1, tzinfo=UTC)
"""Of the years that calendars, time zones and figures agree on."""


def instant(when: str) -> datetime | None:
    """The moment of an ISO 8601 text, in UTC; None where it is none, or no robot's."""
    try:
        at = datetime.fromisoformat(when)
        at = (at if at.tzinfo else at.replace(tzinfo=UTC)).astimezone(UTC)
    except (ValueError, OverflowError):
        return None
    return at if _FIRST <= at < _LAST else None
