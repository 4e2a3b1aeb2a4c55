"""Packets and replies that a session counts as lost, and the limits at which a motion stops."""

from __future__ import annotations

from collections import deque
from typing import Final

LOSS_WINDOW_CYCLES: Final = 100
"""Cycles over which rejected replies are added up."""
PAUSE_CYCLES: Final = 2.0
"""Cycles by which a packet may come later than its number and `max_gap` account for."""


class LossTracker:
    """Packets and replies that were lost, by four words, and what they mean for a motion.

    ========  =====================================================  ===============================
    word      counts                                                 consequence in open mode
    ========  =====================================================  ===============================
    missed    packets before this one that never came                with the stale ones more than
    stale     packets since the last reply with an old number        `max_gap`: the motion stops
    late      cycles by which this packet came later than its        more than `PAUSE_CYCLES`: the
              number and `max_gap` account for                       arm must move as commanded
    rejected  replies of the last `LOSS_WINDOW_CYCLES` cycles that the      more than `max_gap`: the
              motion controller did not use                                 stops
    ========  =====================================================  ===============================

    Attributes:
        max_gap: packets that may be missed in a row without stopping a motion.
        missed, stale, late, rejected: as in the table.
        gap: cycles before this packet without a reply: missed and stale ones.
        restarting: sync packets came since the last reply, of a controller that restarted.
    """

    def __init__(self, max_gap: int, period: float) -> None:
        self.max_gap = max_gap
        self.missed = 0
        self.stale = 0
        self.late = 0.0
        self.rejected = 0
        self.gap = 0
        self.restarting = False
        self._period = period
        self._rejections: deque[tuple[int, int]] = deque()

    def receive(self, missed: int, elapsed: float) -> None:
        """Count the losses before a new packet that came `elapsed` s after the last one."""
        self.missed = missed
        self.late = elapsed / self._period - max(missed, self.max_gap)
        # After a corrupted number the controller's own numbers are stale for a while.
        self.gap = missed + self.stale
        self.stale = 0

    def reject(self, count: int, cycle: int) -> None:
        """Count replies that the controller, according to the packet of `cycle`, did not use."""
        rejections = self._rejections
        rejections.append((cycle, count))
        while rejections[0][0] <= cycle - LOSS_WINDOW_CYCLES:
            rejections.popleft()
        self.rejected = sum(number for _, number in rejections)

    def forget_rejected(self) -> None:
        """Begin to count rejected replies, with open mode."""
        self._rejections.clear()
        self.rejected = 0

    @property
    def is_late(self) -> bool:
        """Whether the packet came so late that the controller may have acted meanwhile."""
        return self.late > PAUSE_CYCLES

    @property
    def reason_to_stop(self) -> str | None:
        """Why the losses before this packet stop a motion, or None."""
        if self.gap > self.max_gap:
            return f"{self.gap} packets were missed in a row"
        return None

    @property
    def reason_to_stop_after_rejection(self) -> str | None:
        """Why the replies that were not used stop a motion, or None."""
        if self.rejected > self.max_gap:
            return f"{self.rejected} replies were lost in {LOSS_WINDOW_CYCLES} cycles"
        return None

    @property
    def instead_of_packets(self) -> str:
        """What came, during a silence, instead of packets that get a reply; "" for nothing."""
        if self.restarting:
            return "the controller restarted: it sent sync packets"
        if self.stale:
            return f"only packets that do not follow the last one came ({self.stale})"
        return ""
