"""Untrusted JSON."""

from __future__ import annotations

import json
from typing import Any


def loads(text: str | bytes) -> Any:
    """What a text holds; None where it is no JSON, or nested deeper than anybody reads."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return None


def names(text: str) -> tuple[str, ...] | None:
    """A list of names; None where it is anything else, or a name cannot be printed."""
    found = loads(text)
    if not isinstance(found, list):
        return None
    if not all(isinstance(name, str) and name.isprintable() for name in found):
        return None
    return tuple(found)
