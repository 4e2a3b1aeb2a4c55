"""A payload that a campaign has weighed, in words."""

from __future__ import annotations

from typing import Any

from hil.campaign.record_messages import precision_line
from hil.payload.payload_messages import payload_as_json, payload_lines

from .weighed import Weighed


def weighed_lines(weighed: Weighed, *, settings: bool = True) -> list[str]:
    """Return what `hil payload` prints, and the precision.

    Without `settings` the commands of controllers are named and not written.
    """
    lines = payload_lines(weighed.payload, settings=settings)
    return lines if weighed.precision is None else [*lines, "", precision_line(weighed.precision)]


def weighed_as_json(weighed: Weighed) -> dict[str, Any]:
    """Return all values as JSON data."""
    precision = None if weighed.precision is None else precision_line(weighed.precision)
    return payload_as_json(weighed.payload) | {"pairs": weighed.pairs, "precision": precision}
