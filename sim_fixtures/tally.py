"""What happened while a controller was served: counts and times, in memory that does not grow."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Final

REMEMBERED: Final = 1000


class Histogram:
    """Durations in bins of 5 µs up to 50 ms; the largest is left as it is."""

    BIN: Final = 5e-6
    BINS: Final = 10_000

    def __init__(self) -> None:
        self.count = 0
        self.largest = 0.0
        self._bins = [0] * (self.BINS + 1)

    def add(self, seconds: float) -> None:
        """Count one duration."""
        self.count += 1
        self.largest = max(self.largest, seconds)
        self._bins[min(self.BINS, int(max(0.0, seconds) / self.BIN))] += 1

    def quantile(self, fraction: float) -> float:
        """Upper edge (s) of the bin that this fraction of all durations ends in; 0 for none."""
        wanted, seen = fraction * self.count, 0
        for index, entries in enumerate(self._bins):
            seen += entries
            if entries and seen >= wanted:
                return min(self.largest, (index + 1) * self.BIN)
        return 0.0


@dataclass(eq=False)
class Tally:
    """What a served session came to so far.

    Attributes:
        cycles: packets the controller sent, the repeated first one counted once.
        knocks: how often the first packet was sent until somebody answered.
        replies: answers the controller took, at most one a cycle.
        missed: cycles that no valid answer came in.
        late: answers that came after their cycle; not accepted.
        surplus: further answers to a cycle that had been answered.
        rejected: answers of wrong length, number or content.
        stretched: cycles made longer than a period to wait for their answer.
        own_late: cycles that began late by a tenth of the period or more though the answer before
            had come in time: the server's fault, not the PC's.
        slips: how many of these were late by a whole period or more; the cycle goes on from there.
        ended: whether the controller has ended its session (504); otherwise it was given up.
        stretch_max: by how much the longest stretched cycle was longer, s.
        answer: times from the packet to its answer, as seen here.
        cost: times of computing a cycle of controller and arm.
    """

    cycles: int = 0
    knocks: int = 0
    replies: int = 0
    missed: int = 0
    late: int = 0
    surplus: int = 0
    rejected: int = 0
    stretched: int = 0
    own_late: int = 0
    slips: int = 0
    ended: bool = False
    stretch_max: float = 0.0
    answer: Histogram = field(default_factory=Histogram)
    cost: Histogram = field(default_factory=Histogram)
    _unanswered: deque[int] = field(default_factory=lambda: deque(maxlen=REMEMBERED))
    _answered: deque[int] = field(default_factory=lambda: deque(maxlen=REMEMBERED))

    def take(self, number: int, *, valid: bool) -> None:
        """A reply with the right number was handed over; the controller found it valid or not."""
        if valid:
            self.replies += 1
        else:
            self.rejected += 1
            self.missed += 1
        self._answered.append(number)

    def miss(self, number: int) -> None:
        """The cycle whose answer should have carried `number` had none."""
        self.missed += 1
        self._unanswered.append(number)

    def stretch(self, seconds: float) -> None:
        """A cycle was made longer by that much."""
        self.stretched += 1
        self.stretch_max = max(self.stretch_max, seconds)

    def discard(self, number: int | None) -> None:
        """An answer that is not that of the running cycle; `number` is None if it has none."""
        if number is not None and number in self._unanswered:
            self.late += 1
            self._unanswered.remove(number)
            self._answered.append(number)
        elif number is not None and number in self._answered:
            self.surplus += 1
        else:
            self.rejected += 1
