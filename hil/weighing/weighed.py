"""A payload that a campaign has weighed, as values; `messages` words it."""

from __future__ import annotations

from dataclasses import dataclass

from hil.campaign.precision_record import PrecisionRecord
from hil.payload.payload_found import PayloadFound


@dataclass(frozen=True, eq=False)
class Weighed:
    """A payload that was weighed.

    Attributes:
        payload: as by `hil payload`.
        pairs: of recordings without and with it.
        precision: of the mass, if one was required.
    """

    payload: PayloadFound
    pairs: int
    precision: PrecisionRecord | None
