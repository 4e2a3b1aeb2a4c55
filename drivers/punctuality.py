"""Who was late: the packet of the controller on its way, or the reply of this computer.

================  ==========================================================  ==================
kind              counts                                                      to blame
================  ==========================================================  ==================
came late         packets more than a cycle later than their number says,     controller or link
                  by the time at which this computer received them
bunched           packets without a reply that came less than half a cycle    controller or link
                  before a newer one
replied to late   replies that left more than a cycle after their packet came this computer
late              other packets without a reply because a newer one was       this computer
                  waiting
================  ==========================================================  ==================

A set-point that left in time and was not used all the same is counted as "rejected", by what the
controller states. Where a link does not know when a packet came, this computer is to blame.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Self

CAME_LATE: Final = "came late"
BUNCHED: Final = "bunched"
REPLIED_TO_LATE: Final = "replied to late"
LEFT_OUT: Final = "late"
LATE_PACKETS: Final = frozenset({CAME_LATE, BUNCHED})
LATE_REPLIES: Final = frozenset({REPLIED_TO_LATE, LEFT_OUT})


@dataclass(frozen=True)
class Punctuality:
    """Packets that came late, and replies that left late or were left out for a newer packet."""

    late_packets: int
    late_replies: int

    @classmethod
    def of(cls, discarded: Mapping[str, int]) -> Self:
        """Sum up `drivers.events.Counters.discarded`."""
        return cls(
            sum(discarded.get(kind, 0) for kind in LATE_PACKETS),
            sum(discarded.get(kind, 0) for kind in LATE_REPLIES),
        )
